"""Manifests of all trips of a folder, from what files, a table and the command line state.

A value of a table counts more than one that is said once for all trips, and that one more than the
files': their columns, the lines of their loggers, and the name of their folder.
"""

import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.ground.parameters import DIRECTIONS, ENDS, SIDES
from suspnet.ground.wording import command
from suspnet.trains.recordings.columns import size_of
from suspnet.trains.recordings.errors import all_of
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.recordings.manifest import CHANNELS, FORMAT, RIG_CHANNELS
from suspnet.trains.recordings.manifest_sources import MIDDLE, UNITS
from suspnet.trains.trips.file_contents import (
    ACCELERATION,
    MILEAGE,
    NUMBERS,
    SPEED,
    Address,
    Contents,
    Signal,
    Stated,
    contents_of,
    is_of_another_direction,
    key_of,
    stated_in,
    words_of,
)
from suspnet.trains.trips.trip_files import TripFiles, names_of, without_word

CHOICES: Mapping[str, tuple[str, ...]] = {
    "bogie": ENDS,
    "axle": ENDS,
    "side": (*SIDES, MIDDLE),
    "direction": DIRECTIONS,
}
PLACE_KEYS = (
    *("vehicle", "suspension", "bogie", "axle", "direction", "side", "train", "car"),
    *(MILEAGE, "start", "temperature_c", "wheel_diameter_m"),
)
"""Keys of the first part of a manifest, in the order in which they are written."""
SIGNAL_KEYS = ("unit", "rate_hz", "range", "speed_unit", "speed_rate_hz")
"""Keys that hold for all accelerometers, or for the speed, of all trips."""
SAYABLE = (*PLACE_KEYS, SPEED, *(f"channels.{name}" for name in CHANNELS), *SIGNAL_KEYS)
"""Keys that may be said once for all trips."""
MOST_SHOWN = 20  # largest number of columns that are offered for a channel
OTHER = "@2"  # end of the name of a column whose sensor is at the bogie's other axle
OF_OTHER_AXLE = f", and likewise of those at the bogie's other axle, with {OTHER} at their end"
"""What may be said besides the columns of a channel."""
BY_COMMAND_LINE = "by the command line"
"""Source of a value that KEY=VALUE of the command line states."""
HOW: Mapping[str, str] = {
    "vehicle": "vehicle=NAME, one of suspnet's or of a file of yours (suspnet init --vehicle NAME)",
    "suspension": 'suspension="car 7", any name, the same in all trips of one suspension',
    "side": "side=left or right of the single sensors, or side=middle",
    "mileage_km": "a table of the trips: --table FILE, which is written if there is none",
    "speed": 'speed=70 in m/s, speed="252 km/h", or speed=COLUMN',
    "unit": "unit=m/s2 or unit=g, of all accelerometers",
    "rate_hz": "rate_hz=500, of all accelerometers",
    "range": "range=50, what full scale is in that unit, of all accelerometers in WAV files",
    "speed_unit": "speed_unit=km/h or speed_unit=m/s",
    "speed_rate_hz": "speed_rate_hz=1",
}
"""How a missing value is said, by its key."""


@dataclass(frozen=True)
class Trip:
    """A trip: path and text of its manifest, its files, and the values stated for it.

    `missing` are the keys that are to be said, of ``HOW`` or ``channels.NAME``; `guesses` those
    that are guessed from names.
    """

    path: Path
    files: tuple[Path, ...]
    stated: Mapping[str, Stated]
    signals: tuple[Signal, ...]
    text: str
    missing: tuple[str, ...]
    guesses: tuple[str, ...]


def read_settings(words: Iterable[str]) -> dict[str, str]:
    """Return the ``KEY=VALUE`` of a command line; ValueError if one is wrong."""
    settings: dict[str, str] = {}
    for word in words:
        key, _, value = word.partition("=")
        if key not in SAYABLE:
            raise ValueError(f"`{key}` is not known; allowed are {', '.join(SAYABLE)}")
        value = value.strip()
        allowed = CHOICES.get(key)
        if not value or (allowed and value not in allowed):
            rule = f"one of {', '.join(allowed)}" if allowed else "a value, not nothing"
            raise ValueError(f"`{key}` must be {rule}, got {value!r}")
        if key in settings:
            raise ValueError(f"`{key}` is given twice")
        settings[key] = value
    return settings


def folder_manifests(
    trip_files: Sequence[TripFiles],
    folder: Path,
    command_line: Mapping[str, str],
    table: Mapping[str, Mapping[str, Stated]],
    config_dir: Path | None = None,
) -> list[Trip]:
    """Return the manifests of the trips of a folder.

    `config_dir` is the folder of the user's vehicles, for the commands in the manifests. TripError
    with all `problems` if files cannot be read; ValueError if the table names a trip that is not
    there.
    """
    # a table names a trip by its manifest or by any of its files
    names = {
        trip.path: {trip.path.stem, *names_of([_relative(file, folder) for file in trip.files])}
        for trip in trip_files
    }
    if unknown := set(table).difference(*names.values()):
        raise ValueError(
            f"the table names {', '.join(sorted(unknown)[:5])}, which {folder} does not hold"
        )
    # all files are read before anything is said of one, so that all faults are reported at once
    files = [file for trip in trip_files for file in trip.files]
    contents = dict(zip(files, all_of(partial(contents_of, file) for file in files), strict=True))
    of_all = {
        key: Stated(_plain_value(key, value), BY_COMMAND_LINE)
        for key, value in command_line.items()
        if key in PLACE_KEYS
    }
    # the more specific source counts: a row of the table over the command line over the files
    trips = []
    for trip in trip_files:
        several = [contents[file] for file in trip.files]
        of_trip: dict[str, Stated] = {}
        for name in sorted(names[trip.path] & set(table)):
            of_trip |= table[name]
        signals = [signal for content in several for signal in content.signals]
        if len({file.parent for file in trip.files}) > 1:  # folders may be named by places
            signals = [replace(s, names=(*s.names, s.file.parent.name)) for s in signals]
        stated = _stated(trip, several, signals, folder)
        trips.append(
            _trip(trip, several, signals, stated | of_all | of_trip, command_line, config_dir)
        )
    _check_columns(command_line, trips)
    if MILEAGE in command_line and len(trips) > 1:
        raise ValueError(
            f"`mileage_km` is another one in each of the {len(trips)} trips: give {HOW[MILEAGE]}"
        )
    return trips


def _relative(file: Path, folder: Path) -> Path:
    return Path(os.path.relpath(file, folder))


def _check_columns(command_line: Mapping[str, str], trips: Sequence[Trip]) -> None:
    for key, value in command_line.items():
        if key.startswith("channels.") and not any(_columns(key, value, t.signals) for t in trips):
            raise ValueError(
                f"`{key}` must name one or two of the columns {names_of_columns(trips)}"
                f"{OF_OTHER_AXLE}; FILE:COLUMN is that of one file; got {value!r}"
            )


def _stated(
    trip: TripFiles, contents: Sequence[Contents], signals: Sequence[Signal], folder: Path
) -> dict[str, Stated]:
    stated: dict[str, Stated] = {}
    if trip.path.parent != folder:
        stated["suspension"] = Stated(trip.path.parent.name, "by the folder")
    for content in reversed(contents):  # the first file that states a key counts
        stated |= stated_in(content.notes)
    for signal in signals:
        if key_of(signal.name) == MILEAGE and np.isfinite(signal.first) and signal.first >= 0:
            stated[MILEAGE] = Stated(round(signal.first, 3), f"by the column {signal.name!r}")
    if any(signal.meaning == SPEED for signal in signals):
        stated.pop(SPEED, None)  # a column states more than a line
    stated.pop("start", None)  # reading the trip takes it from its files again
    return stated


def _trip(
    trip: TripFiles,
    contents: Sequence[Contents],
    signals: Sequence[Signal],
    stated: Mapping[str, Stated],
    command_line: Mapping[str, str],
    config_dir: Path | None,
) -> Trip:
    """Return the manifest of a trip as text, with what is missing in it."""
    path, stated = trip.path, dict(stated)
    names = {key: command_line.get(f"channels.{key}", "") for key in CHANNELS}
    names[SPEED] = command_line.get(SPEED, "")
    columns = {key: _columns(key, text, signals) for key, text in names.items()}
    chosen = {key: addresses for key, addresses in columns.items() if addresses}
    # a speed that was said, as a column or a number, counts more than one that files state
    if SPEED in chosen:
        stated.pop(SPEED, None)
    elif SPEED in command_line:
        stated[SPEED] = Stated(_plain_value(SPEED, command_line[SPEED]), BY_COMMAND_LINE)
    sensors = [signal for signal in signals if key_of(signal.name) != MILEAGE]
    completed = tuple(_with_settings(signal, command_line, chosen) for signal in sensors)
    # columns that were chosen count more than those that are guessed by their names
    by_meaning: dict[str, list[Signal]] = {key: [] for key in (*CHANNELS, SPEED)}
    for signal in completed:
        for key in by_meaning:
            is_guess = key not in chosen and signal.meaning == key
            if is_guess or signal.address in chosen.get(key, ()):
                by_meaning[key].append(signal)
    receivers = [s for s in by_meaning[SPEED] if {"gps", "gnss"} & set(words_of(s.name))]
    if len(receivers) == 1:  # its speed is that of the train
        by_meaning[SPEED] = receivers
    writer = _Writer(path.parent, tuple(chosen))
    read_as = [content.read_as for content in contents if content.read_as]
    # a manifest leaves out a side in the middle
    placed = [key for key in PLACE_KEYS if key in stated and stated[key].value != MIDDLE]
    options = [] if config_dir is None else ["--config-dir", config_dir]
    lines = [
        "# Manifest of one trip, written by suspnet init. What is marked as a guess is taken from",
        f"# names: check it. Then run: {command('check', path, *options)}",
        *(f"# {words}" for words in read_as),
        f"format: {FORMAT}",
        *(_stated_line(key, stated[key]) for key in placed),
        "",
        *writer.speed(stated.get(SPEED), by_meaning[SPEED]),
        "",
        "channels:",
        *(line for name in CHANNELS for line in writer.channel(name, by_meaning[name])),
    ]
    required = [key for key in ("vehicle", "suspension", MILEAGE) if key not in stated]
    is_single = any(len(by_meaning[k]) == 1 and not by_meaning[k][0].side for k in CHANNELS)
    if is_single and "side" not in stated:
        required.append("side")
    missing = tuple(dict.fromkeys([*required, *writer.missing]))
    plain = ("".join(sign if sign.isprintable() else " " for sign in line) for line in lines)
    text = "\n".join(plain) + "\n"
    return Trip(path, trip.files, stated, completed, text, missing, tuple(writer.guesses))


def _stated_line(key: str, stated: Stated) -> str:
    return f"{key}: {_yaml(stated.value)}  # {stated.source}"


class _Writer:
    """Writes the sources of a manifest in `folder`, and notes what is missing and what guessed."""

    def __init__(self, folder: Path, chosen: Sequence[str]) -> None:
        self.folder, self.chosen = folder, chosen
        self.missing: list[str] = []
        self.guesses: list[str] = []

    def speed(self, stated: Stated | None, candidates: Sequence[Signal]) -> list[str]:
        """Return the line of the speed: as stated, or the only column of speeds."""
        if stated is not None:
            return [_stated_line(SPEED, stated)]
        if len(candidates) != 1:
            self.missing.append(SPEED)
            return []
        return [f"speed: {self._entry(candidates[0], SPEED)}  # {self._how(SPEED, SPEED)}"]

    def channel(self, name: str, candidates: Sequence[Signal]) -> list[str]:
        """Return the lines of a channel: one sensor, or a left and a right one, at each axle."""
        vertical = [s for s in candidates if not is_of_another_direction(s.name)] or candidates
        sides = [[s.side for s in vertical if (s.axle == 2) == is_other] for is_other in (0, 1)]
        is_odd = [len(at_axle) > 1 and sorted(at_axle) != sorted(SIDES) for at_axle in sides]
        if not vertical or any(is_odd):
            self.missing.append(f"channels.{name}")
            return []
        entries = [f"    - {self._entry(signal, ACCELERATION)}" for signal in vertical]
        return [f"  {name}:  # {self._how(name, f'channels.{name}')}", *entries]

    def _how(self, name: str, key: str) -> str:
        if name in self.chosen:
            return BY_COMMAND_LINE
        self.guesses.append(key)
        return "guess by the name"

    def _entry(self, signal: Signal, kind: str) -> str:
        """Return a signal in YAML's flow style."""
        prefix = "speed_" if kind == SPEED else ""
        # a unit of the file that no manifest can write is left to the reader
        size = size_of(kind, signal.unit) or math.nan
        units = [unit for unit, other in UNITS[kind].items() if math.isclose(other, size)]
        if math.isnan(size) or not (units or signal.column.unit):
            self.missing.append(f"{prefix}unit")
        if not (signal.time or math.isfinite(signal.rate_hz)):
            self.missing.append(f"{prefix}rate_hz")
        is_fraction = kind == ACCELERATION and signal.column.is_fraction
        if is_fraction and math.isnan(signal.range):
            self.missing.append("range")
        content: dict[str, object] = {
            "file": _relative(signal.file, self.folder).as_posix(),
            "column": signal.name,
            "side": signal.side if kind == ACCELERATION else "",
            "axle": 2 if signal.axle == 2 else "",
            "unit": units[0] if units else "",
            "time": signal.time,
            "time_unit": signal.time_unit,
            "rate_hz": "" if signal.time else float(signal.rate_hz),
            "range": signal.range if is_fraction else "",
        }
        inside = ", ".join(f"{k}: {_yaml(v)}" for k, v in content.items() if v != "")
        return f"{{{inside}}}"


def _yaml(value: object) -> str:
    return json.dumps(value, ensure_ascii=not str(value).isprintable())


def loggers_of(command_line: Mapping[str, str]) -> list[str]:
    """Return the files of all FILE:COLUMN that are said, which are of one trip."""
    words = (
        word.strip()
        for key, names in command_line.items()
        if key == SPEED or key.startswith("channels.")
        for word in names.split(",")
    )
    files = {_file_and_column(word)[0] for word in words}
    return sorted(files - {""}, key=len, reverse=True)


def _file_and_column(word: str) -> tuple[str, str]:
    file, _, column = word.partition(":")
    ending = Path(file).suffix
    return file.removesuffix(ending) if ending.lower() in READERS else file, column


def _columns(key: str, names: str, signals: Sequence[Signal]) -> dict[Address, int]:
    """Return the columns of a channel with their axles: one, or left and right ones in turn.

    Empty if a trip does not have them: trips of one folder may be those of several loggers.
    """
    is_single = any(signal.name == names for signal in signals)
    axles: dict[Address, int] = {}
    for word in [names] if is_single else [part.strip() for part in names.split(",")]:
        first = _named(key, word, signals)
        named = first or _named(key, word.removesuffix(OTHER), signals)
        if not named:
            return {}
        axles |= dict.fromkeys(named, 1 if first else 2)
    return axles if max(Counter(axles.values()).values()) <= len(SIDES) else {}


def _named(key: str, word: str, signals: Sequence[Signal]) -> list[Address]:
    """Return the columns called COLUMN or FILE:COLUMN.

    Of several files it is the one whose name shows the channel, or a left and a right one.
    """
    file, column = _file_and_column(word)
    named = [
        signal
        for signal in signals
        if signal.name == word
        or (signal.name == column and without_word(signal.file.stem, file) != signal.file.stem)
    ]
    shown = [signal for signal in named if signal.meaning == key.removeprefix("channels.")]
    if len(named) > 1 and shown:
        named = shown[:1] if key == SPEED else shown
    by_side = {signal.side: signal.address for signal in named}
    return [by_side[side] for side in sorted(by_side)] if len(by_side) == len(named) else []


def _with_settings(
    signal: Signal, command_line: Mapping[str, str], chosen: Mapping[str, Mapping[Address, int]]
) -> Signal:
    """Return a signal with what was said for all: side, axle, unit and rate.

    Unit and rate are those of its file if it states them. Chosen columns are left and right
    in turn.
    """
    meaning, address, changes = signal.meaning, signal.address, dict[str, Any]()
    for key, columns in chosen.items():
        if address in columns:
            meaning = key
            side = SIDES[list(columns).index(address) % 2] if len(columns) > 1 else ""
            changes |= {"names": (side, *signal.names), "axle": columns[address]}
    prefix = "speed_" if meaning == SPEED else ""
    unit, rate = command_line.get(f"{prefix}unit", ""), command_line.get(f"{prefix}rate_hz")
    if unit and not signal.unit:
        changes["unit"] = unit
    if rate and not signal.time and not np.isfinite(signal.rate_hz):
        changes["rate_hz"] = float(_plain_value("rate_hz", rate))
    if "range" in command_line and signal.column.is_fraction:
        changes["range"] = float(_plain_value("range", command_line["range"]))
    return replace(signal, **changes)


def _plain_value(key: str, text: str) -> str | float:
    is_number = key in (*NUMBERS, "range") or key.endswith("rate_hz")
    try:
        return float(text) if is_number or key == SPEED else text
    except ValueError:
        if is_number:
            raise ValueError(f"`{key}` must be a number, got {text!r}") from None
        return text


def how_to_say(key: str) -> str:
    """Return how a missing value is said."""
    if key in HOW:
        return HOW[key]
    if key.removeprefix("channels.") in RIG_CHANNELS[:2]:
        return f"{key}=COLUMN"
    pair = "LEFT,RIGHT for a pair"
    if not key.endswith(CHANNELS[2]):
        pair += f", or LEFT,RIGHT,LEFT{OTHER},RIGHT{OTHER} with those of the bogie's other axle"
    return f"{key}=COLUMN, or {pair}"


def names_of_columns(trips: Sequence[Trip]) -> str:
    """Return the columns of trips, as FILE:COLUMN where several loggers have the same ones."""
    names: dict[str, None] = {}
    note = ""
    for trip in trips:
        column_names = [signal.name for signal in trip.signals]
        n_names = len(set(column_names))
        of_loggers = len(column_names) < len(CHANNELS) or n_names < len(column_names)
        for signal in trip.signals:
            logger = signal.file.stem.removeprefix(trip.path.stem).strip("_-. ") or signal.file.stem
            names[f"{logger}:{signal.name}" if of_loggers else signal.name] = None
        if of_loggers:
            note = " (files that FILE:COLUMN names are of one trip)"
    more = ", ..." if len(names) > MOST_SHOWN else ""
    return ", ".join(list(names)[:MOST_SHOWN]) + more + note


def origins(trips: Sequence[Trip]) -> list[str]:
    """Return a line for each key on where its values are from, with numbers of trips."""
    lines = []
    for key in (*PLACE_KEYS, SPEED):
        if n_trips := Counter(trip.stated[key].source for trip in trips if key in trip.stated):
            lines.append(f"{key}: {', '.join(f'{where} ({n})' for where, n in n_trips.items())}")
    if guesses := dict.fromkeys(key for trip in trips for key in trip.guesses):
        lines.append(f"guessed by names of columns, to be checked: {', '.join(guesses)}")
    return lines
