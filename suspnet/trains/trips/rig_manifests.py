"""Manifests of a rig's records, made of those that a folder's files would have as trips."""

from collections.abc import Iterable
from dataclasses import replace

from suspnet.ground.core_yaml import dump_yaml, parse_yaml
from suspnet.ground.wording import command
from suspnet.trains.recordings.manifest import CHANNELS, RECORD_FORMAT, RIG_CHANNELS
from suspnet.trains.trips.folder_manifests import Trip

STATED = ("vehicle", "start", "temperature_c")  # keys of a trip that a record has, too
OF_CHANNELS = {
    f"channels.{ours}": f"channels.{theirs}"
    for ours, theirs in zip(CHANNELS, RIG_CHANNELS, strict=True)
}
"""Key of each channel in the manifest of a record, by that of a trip."""


def rig_words(text: str) -> str:
    """Return a text on the channels of trips as one on those of records."""
    for ours, theirs in OF_CHANNELS.items():
        text = text.replace(ours, theirs)
    return text


def as_said_for_trips(words: Iterable[str]) -> list[str]:
    """Return the KEY=VALUE of a command line with the keys of trips for those of records.

    ValueError if one is of a key that records have not.
    """
    ours, said = {theirs: key for key, theirs in OF_CHANNELS.items()}, []
    allowed = (*STATED, *ours, "unit", "rate_hz", "range")
    for word in words:
        key, equals, value = word.partition("=")
        if key not in allowed:
            raise ValueError(f"`{key}` is not known for a rig; allowed are {', '.join(allowed)}")
        said.append(f"{ours.get(key, key)}{equals}{value}")
    return said


def as_record(trip: Trip) -> Trip:
    """Return the manifest of a trip as that of a record, which needs neither place nor speed."""
    content = parse_yaml(trip.text)
    channels, missing = (
        {},
        [key for key in trip.missing if key in ("vehicle", "unit", "rate_hz", "range")],
    )
    for ours, theirs in zip(CHANNELS, RIG_CHANNELS, strict=True):
        sources = (content.get("channels") or {}).get(ours, [])
        if len(sources) == 1:
            channels[theirs] = {k: v for k, v in sources[0].items() if k not in ("side", "axle")}
        else:
            missing.append(f"channels.{theirs}")
    record = {key: content[key] for key in STATED if key in content}
    text = (
        "# Manifest of one record of a rig, written by suspnet init; "
        f"then run: {command('check', trip.path)}\n"
        + dump_yaml({"format": RECORD_FORMAT} | record | {"channels": channels})
    )
    stated = {key: value for key, value in trip.stated.items() if key in STATED}
    guesses = tuple(OF_CHANNELS[key] for key in trip.guesses if key in OF_CHANNELS)
    return replace(trip, stated=stated, text=text, missing=tuple(missing), guesses=guesses)
