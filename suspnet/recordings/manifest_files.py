"""Manifests as YAML files: found in folders, read, checked in full, and written."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from datetime import UTC, datetime, tzinfo
from functools import partial
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from suspnet.dynamics import PARAMETERS
from suspnet.ground.records import HIGHEST_KM, Place
from suspnet.ground.storage import NotPlainError, printable, read_json, read_plain, write_atomically
from suspnet.recordings.checked_mapping import CheckedMapping, TripError, all_of
from suspnet.recordings.core_yaml import MOST_BYTES, dump_yaml, parse_yaml
from suspnet.recordings.dates import date_problem
from suspnet.recordings.manifest import (
    ACCELERATION_UNITS,
    BOGIES,
    CHANNELS,
    DELIMITERS,
    FORMAT,
    MIDDLE,
    SIDES,
    SPEED_UNITS,
    TEMPERATURES_C,
    TIME_UNITS,
    Channel,
    CsvDialect,
    Pair,
    SpeedSource,
    TripManifest,
)


def read_manifest(path: Path) -> TripManifest:
    """Return a trip's manifest, checked.

    Raises
    ------
    TripError
        If it cannot be read, holds anything unknown, misses something or has a value of the wrong
        type or out of range, if a data file that it names is missing or not a plain file, or if two
        sensors are the same column of the same file. Its `problems` are all that is wrong.
    """
    return parse_manifest(path, read_content(path))


def read_content(path: Path) -> Any:
    """Return what the YAML file of a manifest holds, unchecked; TripError if it is none."""
    try:
        return parse_yaml(read_plain(path, MOST_BYTES).decode("utf-8-sig"))
    except OSError as error:
        raise TripError(f"{path}: cannot be read ({error.strerror})") from error
    except NotPlainError as error:
        raise TripError(str(error)) from error
    except ValueError as error:
        raise TripError(f"{path}: is not valid YAML ({error})") from error


def parse_manifest(path: Path, content: Any) -> TripManifest:
    """Return the manifest that the content of a file makes; raises as `read_manifest`."""
    manifest: TripManifest
    manifest, _ = all_of([lambda: _parse(path, content), lambda: _check_files(path, content)])
    _check_places(manifest)
    return manifest


def read_live_manifest(path: Path) -> TripManifest:
    """Return the manifest of sensors whose samples come as frames; files are not looked for.

    Raises
    ------
    TripError
        As `read_manifest`, but for files: `file` may be missing.
    """
    content = read_content(path)
    if isinstance(content, dict):
        content = content | {"speed": _with_file(content.get("speed"))}
        channels = content.get("channels")
        if isinstance(channels, dict):
            content["channels"] = {name: _with_file(one) for name, one in channels.items()}
    return _parse(path, content)


def _with_file(source: Any) -> Any:
    """Return a source, or each of a pair, with a name for its file if it has none."""
    if isinstance(source, list):
        return [_with_file(one) for one in source]
    return {"file": "frames"} | source if isinstance(source, dict) else source


def named_sources(content: Any) -> dict[str, dict[str, Any]]:
    """Return each mapping of a manifest's content that names a file, whatever else is wrong."""
    if not isinstance(content, dict):
        return {}
    sources, channels = {"speed": content.get("speed")}, content.get("channels")
    for name, one in channels.items() if isinstance(channels, dict) else ():
        several = one if isinstance(one, list) else []
        sources[f"channels.{name}"] = one
        sources |= {f"channels.{name}[{i}]": sensor for i, sensor in enumerate(several)}
    return {
        key: source
        for key, source in sources.items()
        if isinstance(source, dict) and isinstance(source.get("file"), str)
    }


def read_place(path: Path) -> Place | None:
    """Return which suspension a manifest is of; None if it does not say so.

    Nothing else of it is checked, so that a faulty trip stays with the others of its suspension.
    """
    try:
        content = read_content(path)
    except TripError:
        return None
    if not isinstance(content, dict) or not isinstance(content.get("suspension"), str):
        return None
    named = {"bogie": BOGIES, "side": SIDES}
    where = {key: str(content[key]) for key in named if content.get(key) in list(named[key])}
    texts = {key: content.get(key) for key in ("train", "car")}
    told = {key: printable(one.strip()) for key, one in texts.items() if isinstance(one, str)}
    return Place(printable(content["suspension"].strip()), **where, **told)


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
        "train": manifest.train,
        "car": manifest.car,
        "mileage_km": manifest.mileage_km,
        "start": manifest.start,
        "temperature_c": manifest.temperature_c,
        "speed": _without_none(asdict(speed)) if isinstance(speed, SpeedSource) else speed,
        "channels": channels,
        "truth": manifest.truth or None,
    }
    content = _without_none(content)
    if _parse(manifest.path, content).name != manifest.name:
        raise TripError(f"{manifest.path}: `name` must be that of the file, got {manifest.name!r}")
    return write_atomically(manifest.path, dump_yaml(content))


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
    """Return in words what a folder lacks whose simulation was interrupted; or "".

    That is trips of a suspension, or suspensions of some trains.
    """
    if not (folder / UNFINISHED).is_file():
        return ""
    try:
        marked = read_json(folder / UNFINISHED)
        what = "suspensions" if "n_suspensions" in marked else "trips"
        wanted = f" of {int(marked[f'n_{what}'])}"
    except (OSError, ValueError, LookupError, TypeError):
        what, wanted = "trips", ""
    if what == "suspensions":
        begun = {path.parent for path in folder.glob("*/*.yaml")}
        n_written = sum(not (part / UNFINISHED).exists() for part in begun)
    else:
        n_written = sum(path.is_file() for path in folder.glob("*.yaml"))
    return f"partial: {n_written}{wanted} {what} are simulated"


_CONSTANT_SPEED = re.compile(r"([1-9]\d{0,2}(?:\.\d+)?) *(m/s|km/h)")
"""Constant speed with its unit, as text: 252 km/h."""
_SOURCE = ("unit", "column", "rate_hz", "time", "start_s", "time_unit", "time_zone", "csv")


def _parse(path: Path, content: Any) -> TripManifest:
    """Return the manifest of a YAML file's content."""
    required = ("format", "vehicle", "suspension", "mileage_km", "speed", "channels")
    optional = ("start", "truth", "bogie", "side", "train", "car", "temperature_c")
    top = CheckedMapping(path, "", content, required, optional)
    found = top.read(
        {
            "format": lambda: top.choice("format", [FORMAT]),
            "vehicle": lambda: top.text("vehicle"),
            "suspension": lambda: top.text("suspension"),
            "mileage_km": lambda: _parse_mileage(top),
            "start": lambda: _parse_start(top),
            "speed": lambda: _parse_speed(top),
            "channels": lambda: _parse_channels(path, content["channels"]),
            "truth": lambda: _parse_truth(path, content["truth"]),
            "bogie": lambda: top.choice("bogie", BOGIES),
            "side": lambda: top.choice("side", SIDES),
            "train": lambda: top.text("train").strip(),
            "car": lambda: top.text("car").strip(),
            "temperature_c": lambda: _parse_temperature(top),
        }
    )
    del found["format"]
    return TripManifest(path=path, name=path.stem, **({"start": None} | found))


def _check_files(path: Path, content: Any) -> None:
    """Raise TripError if a file that a manifest names is missing, whatever else is wrong in it."""
    problems = [
        f"{path}: `{key}.file` must name an existing plain file, got {source['file']!r} "
        f"(looked in {path.parent})"
        for key, source in named_sources(content).items()
        if not os.path.isfile(path.parent / source["file"])  # a name too long is none either
    ]
    if problems:
        raise TripError(*problems)


def _check_places(manifest: TripManifest) -> None:
    """Raise TripError if two sensors are the same column of the same file."""
    places: dict[tuple[Path, str | None], str] = {}
    for name, one in manifest.sensors().items():
        other = places.setdefault((manifest.file_of(one).resolve(), one.column), name)
        if other != name:
            raise TripError(
                f"{manifest.path}: two `channels` have the same file and column, {other} and "
                f"{name}; each is one sensor"
            )


def _parse_mileage(top: CheckedMapping) -> float:
    """Return the mileage [km]."""
    mileage = top.number("mileage_km", "a number >= 0", math.nextafter(0.0, -1.0))
    if mileage > HIGHEST_KM:
        raise top.refuse("mileage_km", f"at most {HIGHEST_KM:.0f} km (is it in metres?)")
    return mileage


def _parse_temperature(top: CheckedMapping) -> float:
    """Return the temperature outside [°C]."""
    low, high = TEMPERATURES_C
    rule = f"a number from {low:g} to {high:g}"
    temperature = top.number("temperature_c", rule)
    if not low <= temperature <= high:
        raise top.refuse("temperature_c", rule)
    return temperature


def _parse_start(top: CheckedMapping) -> datetime:
    """Return the start of a trip from text, or from the datetime of a manifest to be written."""
    value = top.content["start"]
    try:
        start = value if isinstance(value, datetime) else datetime.fromisoformat(value)
    except (TypeError, ValueError) as error:
        raise top.refuse("start", "a time like 2015-08-03T08:00:00") from error
    if problem := date_problem(start):
        raise TripError(
            f"{top.path}: `start` {start.isoformat()} {problem}; correct it, or leave it out if it "
            "is not known"
        )
    return start


def _parse_speed(top: CheckedMapping) -> float | SpeedSource:
    """Return a constant speed [m/s] or where the speed is stored."""
    value = top.content["speed"]
    if isinstance(value, str) and (found := _CONSTANT_SPEED.fullmatch(value.strip())):
        return float(found[1]) * SPEED_UNITS[found[2]]
    if not isinstance(value, dict):
        rule = "a number of m/s > 0, one with its unit (252 km/h), or a mapping with `file`"
        return top.number("speed", rule, 0.0)
    section = CheckedMapping(top.path, "speed", top.content["speed"], ("file",), _SOURCE)
    return SpeedSource(**section.read(_parse_source(section, SPEED_UNITS)))


def _parse_channels(path: Path, content: Any) -> dict[str, Channel | Pair]:
    """Return where the accelerometers of every channel are stored."""
    channels = CheckedMapping(path, "channels", content, CHANNELS, ())
    return channels.read(
        {name: partial(_parse_place, path, name, channels.content.get(name)) for name in CHANNELS}
    )


def _parse_place(path: Path, name: str, content: Any) -> Channel | Pair:
    """Return where the one accelerometer of a channel, or the left and the right, are stored."""
    if not isinstance(content, list):
        return _parse_channel(path, f"channels.{name}", content, single=True)
    if not 1 <= len(content) <= 2:
        raise TripError(
            f"{path}: `channels.{name}` must be a sensor, or a list of one on the left and one on "
            f"the right, got a list of {len(content)}"
        )
    single = len(content) == 1
    found: list[Channel] = all_of(
        partial(_parse_channel, path, f"channels.{name}[{i}]", one, single=single)
        for i, one in enumerate(content)
    )
    if single:
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


def _parse_channel(path: Path, where: str, content: Any, *, single: bool) -> Channel:
    """Return where one accelerometer is stored."""
    optional = (*_SOURCE, "sign", "range", "side")
    section = CheckedMapping(path, where, content, ("file",), optional)
    found = section.read(
        {
            "sign": lambda: _parse_sign(section),
            "range": lambda: section.positive("range"),
            "side": lambda: section.choice("side", (*SIDES, MIDDLE) if single else SIDES),
        }
        | _parse_source(section, ACCELERATION_UNITS)
    )
    return Channel(**found)


def _parse_sign(section: CheckedMapping) -> int:
    """Return 1 or -1."""
    sign = section.number("sign", "1 or -1")
    if sign not in (1.0, -1.0):
        raise section.refuse("sign", "1 or -1")
    return int(sign)


def _parse_source(
    section: CheckedMapping, units: Mapping[str, float]
) -> dict[str, Callable[[], Any]]:
    """Return what reads the fields that a channel and the speed have in common."""
    return {
        "file": lambda: section.text("file"),
        "unit": lambda: section.choice("unit", list(units)),
        "column": lambda: section.text("column"),
        "rate_hz": lambda: section.positive("rate_hz"),
        "time": lambda: section.text("time"),
        "start_s": lambda: section.number("start_s"),
        "time_unit": lambda: section.choice("time_unit", list(TIME_UNITS)),
        "time_zone": lambda: _parse_zone(section),
        "csv": lambda: _parse_csv(section),
    }


def _parse_zone(section: CheckedMapping) -> str:
    """Return the name of a time zone that is known here."""
    name = section.text("time_zone")
    try:
        time_zone(name)
    except ValueError as error:
        raise section.refuse("time_zone", 'one like "UTC", "+02:00" or "Europe/Berlin"') from error
    return name


def time_zone(name: str) -> tzinfo:
    """Return a time zone by its name or its offset from UTC.

    Raises
    ------
    ValueError
        If it is not known.
    """
    if name == "UTC":
        return UTC
    try:
        if name[:1] in ("+", "-"):
            zone = datetime.strptime(name, "%z").tzinfo
            assert zone is not None  # the format asks for one
            return zone
        return ZoneInfo(name)
    except (KeyError, OSError) as error:
        raise ValueError(f"the time zone {name!r} is not known") from error


def _parse_csv(source: CheckedMapping) -> CsvDialect:
    """Return how a CSV file is said to be written."""
    keys = ("delimiter", "decimal", "header_line", "encoding")
    where = f"{source.where}.csv"
    section = CheckedMapping(source.path, where, source.content["csv"], (), keys)
    names = {**DELIMITERS, **{sign: sign for sign in DELIMITERS.values()}}
    found = section.read(
        {
            "delimiter": lambda: names[section.choice("delimiter", list(names))],
            "decimal": lambda: section.choice("decimal", [".", ","]),
            "header_line": lambda: _parse_header_line(section),
            "encoding": lambda: _parse_encoding(section),
        }
    )
    return CsvDialect(**found)


def _parse_header_line(section: CheckedMapping) -> int:
    """Return the number of a line, or 0."""
    line = section.content["header_line"]
    if isinstance(line, bool) or not isinstance(line, int) or line < 0:
        raise section.refuse("header_line", "a line counted from 1, or 0 if there are no names")
    return line


def _parse_encoding(section: CheckedMapping) -> str:
    """Return the name of an encoding that is known here."""
    encoding = section.text("encoding")
    try:
        "a;1".encode(encoding)
    except (LookupError, ValueError) as error:
        raise section.refuse("encoding", "one like utf-8, utf-16 or latin-1") from error
    return encoding


def _parse_truth(path: Path, content: Any) -> dict[str, float]:
    """Return the known parameters of a simulated trip."""
    section = CheckedMapping(path, "truth", content, (), PARAMETERS)
    return section.read({key: partial(section.positive, key) for key in PARAMETERS})


def _without_none(content: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping without the keys whose value is None, in the mappings within it too."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in content.items()
        if value is not None
    }
