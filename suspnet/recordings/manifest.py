"""Manifests of trips: where each accelerometer is stored, in which unit and at which rate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import date, datetime
from pathlib import Path
from typing import Any

import yaml

from suspnet.dynamics import PARAMETERS
from suspnet.recordings.checked_mapping import CheckedMapping, TripError
from suspnet.storage import printable, read_json, write_atomically

__all__ = [
    "ACCELERATION_UNITS",
    "BOGIES",
    "CHANNELS",
    "FORMAT",
    "SIDES",
    "SPEED_UNITS",
    "Channel",
    "Pair",
    "Place",
    "Source",
    "SpeedSource",
    "TripError",
    "TripManifest",
    "find_manifests",
    "read_manifest",
    "read_place",
    "write_manifest",
]

FORMAT = "suspnet-trip-1"

CHANNELS = ("axle_box", "bogie", "body")
"""The three vertical accelerometers, in the order of every array of signals."""

ACCELERATION_UNITS = {"m/s2": 1.0, "g": 9.80665}
"""Size of each unit in m/s2."""

SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6}
"""Size of each unit in m/s."""

BOGIES = ("leading", "trailing")
"""Bogies of a vehicle, in the direction of travel."""

SIDES = ("left", "right")
"""Sides of a vehicle, in the direction of travel."""


HIGHEST_KM = 1e9
"""Mileage that no vehicle reaches [km]."""


@dataclass(frozen=True, order=True)
class Place:
    """Which suspension a trip is of; text is empty where the manifest does not say it.

    Parameters
    ----------
    suspension : str
    bogie : str
        One of ``BOGIES``.
    side : str
        One of ``SIDES``.
    """

    suspension: str = ""
    bogie: str = ""
    side: str = ""

    def __str__(self) -> str:
        """Return the place in words."""
        where = [self.bogie and f"{self.bogie} bogie", self.side]
        return ", ".join(part for part in (self.suspension, *where) if part) or "unknown"


@dataclass(frozen=True)
class Source:
    """Where one measured quantity is stored.

    Parameters
    ----------
    file : str
        Absolute, or relative to the manifest's folder.
    unit : str
        One of ``ACCELERATION_UNITS``, or for the speed of ``SPEED_UNITS``.
    column : str, optional
        Column, MAT or HDF5 variable, or TDMS "group/channel"; None if the file has only one.
    rate_hz : float, optional, [Hz]
        Sampling rate. If `time` is given too, the two must agree within 1 %.
    time : str, optional
        Name of a column of times [s]; a time step may be missing there, and is then a gap.
    start_s : float, [s]
        Time of the first sample on the trip's clock; with `time`, what is added to those times.
    """

    file: str
    unit: str
    column: str | None = None
    rate_hz: float | None = None
    time: str | None = None
    start_s: float = 0.0


@dataclass(frozen=True)
class SpeedSource(Source):
    """Place where the speed of the train is stored."""


@dataclass(frozen=True)
class Channel(Source):
    """Where one accelerometer is stored.

    Parameters
    ----------
    sign : int
        -1 turns a sensor that was mounted upside down.
    range : float, optional, [unit]
        Largest magnitude that the sensor can give.
    side : str, optional
        One of ``SIDES``; each sensor of a pair has one.
    """

    sign: int = 1
    range: float | None = None
    side: str | None = None


Pair = tuple[Channel, Channel]
"""Two accelerometers at one place, the left one first."""


@dataclass(frozen=True)
class TripManifest:
    """One trip: a recording of accelerometers at three places and the speed.

    Parameters
    ----------
    path : Path
        The YAML file.
    name : str
        The file's name without its suffix.
    vehicle, suspension : str
        Which vehicle, and which of its suspensions, in free text.
    mileage_km : float, [km]
    start : datetime or None
    speed : float, [m/s], or SpeedSource
    channels : dict of Channel, or of Pair
        One sensor, or one on the left and one on the right, for each of ``CHANNELS``.
    truth : dict of float, [-]
        Known values of a simulated trip relative to healthy; keys from ``PARAMETERS``.
    bogie, side : str, optional
        One of ``BOGIES`` and one of ``SIDES``; None where it is not said.
    """

    path: Path
    name: str
    vehicle: str
    suspension: str
    mileage_km: float
    start: datetime | None
    speed: float | SpeedSource
    channels: Mapping[str, Channel | Pair]
    truth: dict[str, float] = field(default_factory=dict)
    bogie: str | None = None
    side: str | None = None

    def sensors(self) -> dict[str, Channel]:
        """Return every sensor by its name: the channel's, followed by the side in a pair."""
        found: dict[str, Channel] = {}
        for name, channel in self.channels.items():
            if isinstance(channel, Channel):
                found[name] = channel
            else:
                found |= {f"{name} {one.side}": one for one in channel}
        return found

    def file_of(self, source: Source) -> Path:
        """Return the path of a channel's or the speed's data file."""
        return self.path.parent / source.file


def read_manifest(path: Path) -> TripManifest:
    """Return a trip's manifest, checked.

    Raises
    ------
    TripError
        If it cannot be read, holds anything unknown, misses something or has a value of the wrong
        type or out of range, if a data file that it names is missing or not a plain file, or if two
        sensors are the same column of the same file.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TripError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise TripError(f"{path}: is not valid YAML ({' '.join(str(error).split())})") from error
    manifest = _parse(path, content)
    sensors = manifest.sensors()
    sources: dict[str, Source] = {f"channels.{name}": one for name, one in sensors.items()}
    if isinstance(manifest.speed, SpeedSource):
        sources["speed"] = manifest.speed
    for key, source in sources.items():
        if not manifest.file_of(source).is_file():
            raise TripError(
                f"{path}: `{key}.file` must name an existing plain file, got {source.file!r} "
                f"(looked in {path.parent})"
            )
    places: dict[tuple[Path, str | None], str] = {}
    for name, one in sensors.items():
        other = places.setdefault((manifest.file_of(one).resolve(), one.column), name)
        if other != name:
            raise TripError(
                f"{path}: two `channels` have the same file and column, {other} and {name}; each "
                "is one sensor"
            )
    return manifest


def read_place(path: Path) -> Place | None:
    """Return which suspension a manifest is of; None if it does not say so.

    Nothing else of it is checked, so that a faulty trip stays with the others of its suspension.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or not isinstance(content.get("suspension"), str):
        return None
    named = {"bogie": BOGIES, "side": SIDES}
    where = {key: str(content[key]) for key in named if content.get(key) in list(named[key])}
    return Place(printable(content["suspension"].strip()), **where)


def write_manifest(manifest: TripManifest) -> Path:
    """Write a manifest to its own path, atomically, and return that path.

    Raises
    ------
    TripError
        If it would not be read back: a wrong value, or a name that is not the file's.
    OSError
        If the folder cannot be written.
    """
    speed = manifest.speed
    channels = {
        name: _without_none(asdict(one))
        if isinstance(one, Channel)
        else [_without_none(asdict(sensor)) for sensor in one]
        for name, one in manifest.channels.items()
    }
    content = {
        "format": FORMAT,
        "vehicle": manifest.vehicle,
        "suspension": manifest.suspension,
        "bogie": manifest.bogie,
        "side": manifest.side,
        "mileage_km": manifest.mileage_km,
        "start": manifest.start,
        "speed": _without_none(asdict(speed)) if isinstance(speed, SpeedSource) else speed,
        "channels": channels,
        "truth": manifest.truth or None,
    }
    content = _without_none(content)
    if _parse(manifest.path, content).name != manifest.name:
        raise TripError(f"{manifest.path}: `name` must be that of the file, got {manifest.name!r}")
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return write_atomically(manifest.path, text)


def find_manifests(folder: Path) -> list[Path]:
    """Return the ``*.yaml`` files directly in a folder, sorted.

    Raises
    ------
    FileNotFoundError
        If there is no such folder, or no such file in it.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}; give the one that holds the trips")
    manifests = sorted(path for path in folder.glob("*.yaml") if path.is_file())
    if not manifests:
        raise FileNotFoundError(f"{folder} holds no *.yaml file; each trip needs one")
    return manifests


UNFINISHED = "unfinished.json"
"""Name of the file in a folder of simulated trips that are not all written yet."""


def partial_words(folder: Path) -> str:
    """Return in words how many trips a folder lacks whose simulation was interrupted; or ""."""
    if not (folder / UNFINISHED).is_file():
        return ""
    n_written = sum(path.is_file() for path in folder.glob("*.yaml"))
    try:
        wanted = f" of {int(read_json(folder / UNFINISHED)['n_trips'])}"
    except (OSError, ValueError, LookupError, TypeError):
        wanted = ""
    return f"partial: {n_written}{wanted} trips are simulated"


_SOURCE = ("column", "rate_hz", "time", "start_s")


def _parse(path: Path, content: Any) -> TripManifest:
    """Return the manifest of a YAML file's content."""
    required = ("format", "vehicle", "suspension", "mileage_km", "speed", "channels")
    top = CheckedMapping(path, "", content, required, ("start", "truth", "bogie", "side"))
    top.choice("format", [FORMAT])
    channels = CheckedMapping(path, "channels", content["channels"], CHANNELS, ()).content
    return TripManifest(
        path=path,
        name=path.stem,
        vehicle=top.text("vehicle"),
        suspension=top.text("suspension"),
        mileage_km=_parse_mileage(top),
        start=_parse_start(top) if top.has("start") else None,
        speed=_parse_speed(top),
        channels={name: _parse_channels(path, name, channels[name]) for name in CHANNELS},
        truth=_parse_truth(path, content["truth"]) if top.has("truth") else {},
        bogie=top.choice("bogie", BOGIES) if top.has("bogie") else None,
        side=top.choice("side", SIDES) if top.has("side") else None,
    )


def _parse_mileage(top: CheckedMapping) -> float:
    """Return the mileage [km]."""
    mileage = top.number("mileage_km", "a number >= 0", math.nextafter(0.0, -1.0))
    if mileage >= HIGHEST_KM:
        raise top.refuse("mileage_km", f"below {HIGHEST_KM:g}")
    return mileage


def _parse_start(top: CheckedMapping) -> datetime:
    """Return the start of a trip from a date or text."""
    value = top.content["start"]
    if isinstance(value, date) and not isinstance(value, datetime):
        return datetime(value.year, value.month, value.day)
    try:
        return value if isinstance(value, datetime) else datetime.fromisoformat(value)
    except (TypeError, ValueError) as error:
        raise top.refuse("start", "a time like 2015-08-03T08:00:00") from error


def _parse_speed(top: CheckedMapping) -> float | SpeedSource:
    """Return a constant speed [m/s] or where the speed is stored."""
    if not isinstance(top.content["speed"], dict):
        return top.number("speed", "a number of m/s > 0, or a mapping with `file` and `unit`", 0.0)
    section = CheckedMapping(top.path, "speed", top.content["speed"], ("file", "unit"), _SOURCE)
    return SpeedSource(unit=section.choice("unit", list(SPEED_UNITS)), **_parse_source(section))


def _parse_channels(path: Path, name: str, content: Any) -> Channel | Pair:
    """Return where the one accelerometer of a channel, or the left and the right, are stored."""
    if not isinstance(content, list):
        return _parse_channel(path, f"channels.{name}", content)
    if not 1 <= len(content) <= 2:
        raise TripError(
            f"{path}: `channels.{name}` must be a sensor, or a list of one on the left and one on "
            f"the right, got a list of {len(content)}"
        )
    found = [_parse_channel(path, f"channels.{name}[{i}]", one) for i, one in enumerate(content)]
    if len(found) == 1:
        return found[0]
    first, second = found
    left, right = SIDES
    if first.side is None:
        first = replace(first, side=left if second.side in (None, right) else right)
    if second.side is None:
        second = replace(second, side=left if first.side == right else right)
    if first.side == second.side:
        raise TripError(
            f"{path}: `channels.{name}` has two sensors on the {first.side}; a pair is one on the "
            "left and one on the right"
        )
    return (first, second) if first.side == left else (second, first)


def _parse_channel(path: Path, where: str, content: Any) -> Channel:
    """Return where one accelerometer is stored."""
    optional = (*_SOURCE, "sign", "range", "side")
    section = CheckedMapping(path, where, content, ("file", "unit"), optional)
    sign = section.number("sign", "1 or -1") if section.has("sign") else 1.0
    if sign not in (1.0, -1.0):
        raise section.refuse("sign", "1 or -1")
    return Channel(
        unit=section.choice("unit", list(ACCELERATION_UNITS)),
        sign=int(sign),
        range=section.positive("range") if section.has("range") else None,
        side=section.choice("side", SIDES) if section.has("side") else None,
        **_parse_source(section),
    )


def _parse_source(section: CheckedMapping) -> dict[str, Any]:
    """Return the fields that a channel and the speed have in common."""
    if not section.has("rate_hz") and not section.has("time"):
        raise TripError(f"{section.path}: `{section.where}` needs `rate_hz` or `time` (a column)")
    return {
        "file": section.text("file"),
        "column": section.text("column") if section.has("column") else None,
        "rate_hz": section.positive("rate_hz") if section.has("rate_hz") else None,
        "time": section.text("time") if section.has("time") else None,
        "start_s": section.number("start_s") if section.has("start_s") else 0.0,
    }


def _parse_truth(path: Path, content: Any) -> dict[str, float]:
    """Return the known parameters of a simulated trip."""
    section = CheckedMapping(path, "truth", content, (), PARAMETERS)
    return {key: section.positive(key) for key in section.content}


def _without_none(content: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping without the keys whose value is None."""
    return {key: value for key, value in content.items() if value is not None}
