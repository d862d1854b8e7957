"""Manifests of all trips of a folder, from what files, a table and the command line state.

A value of a table counts more than one that is said once for all trips, and that one more than the
files': their columns, the lines of their loggers, the name of their folder, and the time of the
file as the last resort.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from suspnet.ground.parameters import DIRECTIONS, ENDS, SIDES
from suspnet.ground.storage import read_plain
from suspnet.trains.recordings.clocks import first_moment
from suspnet.trains.recordings.errors import all_of
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.recordings.logger_notes import NUMBERS, Stated, key_of, read_value, stated_in
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_sources import MIDDLE
from suspnet.trains.trips.file_contents import (
    ABOUT_TRIP,
    SPEED,
    Address,
    Contents,
    Signal,
    contents_of,
    guessed_axle,
    guessed_bogie,
    is_of_another_direction,
    words_of,
)
from suspnet.trains.trips.manifest_template import BY_COMMAND_LINE, PLACE_LINES, Template, template
from suspnet.trains.trips.trip_files import (
    TripFiles,
    cell_of,
    columns_of_files,
    names_of,
    table_rows,
    without_word,
)

CHOICES: Mapping[str, tuple[str, ...]] = {
    "bogie": ENDS,
    "axle": ENDS,
    "side": (*SIDES, MIDDLE),
    "direction": DIRECTIONS,
}
SIGNAL_KEYS = ("unit", "rate_hz", "range", "speed_unit", "speed_rate_hz")
"""Keys that hold for all accelerometers, or for the speed, of all trips."""
SAYABLE = (*PLACE_LINES, SPEED, *(f"channels.{name}" for name in CHANNELS), *SIGNAL_KEYS)
"""Keys that may be said once for all trips."""
MOST_SHOWN = 20
"""Largest number of columns that are offered for a channel."""
OTHER = "@2"
"""End of the name of a column whose sensor is at the bogie's other axle."""
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
COPIED_S = 60.0
"""Files whose times are less far apart on average were copied: these say nothing of the trips."""
BY_FILE_TIME = "by the time of the file, the last resort: when it was written or copied"


@dataclass(frozen=True)
class Trip:
    """A trip of a folder: path of its manifest, files, what is known and the manifest itself."""

    path: Path
    files: tuple[Path, ...]
    known: Mapping[str, Stated]
    signals: tuple[Signal, ...]
    manifest: Template

    @property
    def missing(self) -> tuple[str, ...]:
        """What is to be said, as keys of ``HOW`` or ``channels.NAME``."""
        return tuple(dict.fromkeys(map(_asked, self.manifest.blanks)))


def read_said(words: Iterable[str]) -> dict[str, str]:
    """Return what ``KEY=VALUE`` of a command line say; ValueError if one is wrong."""
    said: dict[str, str] = {}
    for word in words:
        key, _, value = word.partition("=")
        if key not in SAYABLE:
            raise ValueError(f"`{key}` is not known; allowed are {', '.join(SAYABLE)}")
        value = value.strip()
        allowed = CHOICES.get(key)
        if not value or (allowed and value not in allowed):
            rule = f"one of {', '.join(allowed)}" if allowed else "a value, not nothing"
            raise ValueError(f"`{key}` must be {rule}, got {value!r}")
        if key in said:
            raise ValueError(f"`{key}` is given twice")
        said[key] = value
    return said


def read_table(path: Path) -> dict[str, dict[str, Stated]]:
    """Return what a table (CSV) states of each trip, by the name of a file or a trip.

    Columns are named as keys of a manifest, or in English or German as loggers do; others are
    ignored. ValueError if none names files, a name is given twice or a value cannot be read.
    """
    rows, delimiter = table_rows(read_plain(path), str(path))
    names = [name.strip() for name in rows[0]] if rows else []
    files = columns_of_files(names)
    if not files:
        raise ValueError(f"{path}: no column is called file, trip, Datei or Fahrt; it has {names}")
    table: dict[str, dict[str, Stated]] = {}
    for number, row in enumerate(rows[1:], start=2):
        trip = row[files[0]].strip() if len(row) > files[0] else ""
        if not trip or trip in table:
            what = f"{trip!r} a second time" if trip else "no file"
            raise ValueError(f"{path}, row {number}: it names {what}")
        table[trip] = {}
        for name, cell in zip(names, row, strict=False):
            key = key_of(name)
            if not key or not cell.strip():
                continue
            is_german = delimiter == ";" and "." not in cell
            value = read_value(key, name, cell, is_german)
            if value is None:
                unit = "; give its unit, as 252 km/h or 70 m/s" if key == "speed" else ""
                raise ValueError(
                    f"{path}, row {number}: {name!r} cannot be read, got {cell!r}{unit}"
                )
            table[trip][value[0]] = Stated(value[1], f"by {path.name}")
    return table


def table_of(trips: Sequence[Trip], folder: Path) -> str:
    """Return a table of the trips as CSV, with what is known of them, to be completed."""
    keys = ("mileage_km", "start", "direction")
    out = io.StringIO()
    rows = csv.writer(out, delimiter=";", lineterminator="\n")
    rows.writerow(["file", *keys])
    for trip in trips:
        known = [trip.known[key].value if key in trip.known else "" for key in keys]
        rows.writerow([cell_of(trip.files[0].relative_to(folder).as_posix()), *known])
    return out.getvalue()


def folder_manifests(
    found: Sequence[TripFiles],
    folder: Path,
    said: Mapping[str, str],
    table: Mapping[str, Mapping[str, Stated]],
    config_dir: Path | None = None,
) -> list[Trip]:
    """Return the manifests of the trips of a folder.

    A file with columns of both bogies gives a trip of each. `config_dir` is the folder of the
    user's vehicles, for the commands in the manifests. TripError with all `problems` if files
    cannot be read; ValueError if the table names a trip that is not there.
    """
    names = {one.path: {one.path.stem, *names_of(one.files, folder)} for one in found}
    if unknown := set(table).difference(*names.values()):
        raise ValueError(
            f"the table names {', '.join(sorted(unknown)[:5])}, which {folder} does not hold"
        )
    # all files are read before anything is said of one, so that all faults are reported at once
    contents = all_of(
        partial(lambda one: [contents_of(file) for file in one.files], one) for one in found
    )
    times = [_file_time(one).timestamp() for one in found]
    is_copy = len(found) > 1 and max(times) - min(times) < COPIED_S * (len(found) - 1)
    of_all = {
        key: Stated(_plain_value(key, value), BY_COMMAND_LINE)
        for key, value in said.items()
        if key in PLACE_LINES
    }
    trips = []
    for one, several in zip(found, contents, strict=True):
        of_trip: dict[str, Stated] = {}
        for name in sorted(names[one.path] & set(table)):
            of_trip |= table[name]
        for path, signals, by_columns in _by_bogie(one.path, _signals(several)):
            stated = _stated(one, several, signals, folder)
            if not is_copy and "start" not in stated and not _is_dated(signals):
                stated["start"] = Stated(_file_time(one).isoformat(), BY_FILE_TIME)
            bogie, word = guessed_bogie(path.stem)
            by_name = {"bogie": Stated(bogie, f"guess by files named {word}")} if bogie else {}
            # the later ones count more; columns of both bogies more than a line of the file
            both = {key: value for key, value in by_columns.items() if key == "bogie"}
            known = by_name | by_columns | stated | both | of_all | of_trip
            trips.append(_trip(path, one.files, several, signals, known, said, config_dir))
    _check_columns(said, trips)
    if "mileage_km" in said and len(trips) > 1:
        raise ValueError(
            f"`mileage_km` is another one in each of the {len(trips)} trips: give "
            f"{HOW['mileage_km']}"
        )
    return trips


def _check_columns(said: Mapping[str, str], trips: Sequence[Trip]) -> None:
    """Raise ValueError if no trip has the columns that were said of a channel."""
    for key, value in said.items():
        if not key.startswith("channels.") or any(_columns(key, value, t.signals) for t in trips):
            continue
        files = [_file_and_column(word.strip())[0] for word in value.split(",") if ":" in word]
        stems = [signal.file.stem for trip in trips for signal in trip.signals]
        gone = [file for file in files if all(without_word(stem, file) == stem for stem in stems)]
        raise ValueError(
            f"`{key}` must name one or two of the columns {_names_of_columns(trips)}, and "
            f"likewise of those at the bogie's other axle, with {OTHER} at their end; "
            f"FILE:COLUMN is that of one file; got {value!r}"
            + (f": there is no file {gone[0]}" if gone else "")
        )


def _signals(contents: Sequence[Contents]) -> list[Signal]:
    """Return the columns of a trip; files of several folders are named by these as well."""
    signals = [signal for content in contents for signal in content.signals]
    if len({content.file.parent for content in contents}) == 1:
        return signals
    return [replace(s, names=(*s.names, s.file.parent.name)) for s in signals]


def _by_bogie(
    path: Path, signals: Sequence[Signal]
) -> list[tuple[Path, tuple[Signal, ...], dict[str, Stated]]]:
    """Return a trip of each bogie that the names of columns state, with guesses of its place."""
    axles = [guessed_axle(*signal.names) for signal in signals]
    stated = [guessed_bogie(*signal.names) for signal in signals]
    if max(axles, default=0) > len(ENDS):  # axles are numbered along the vehicle
        stated = [
            (bogie, word) if bogie or not axle else (ENDS[axle > len(ENDS)], f"axle {axle}")
            for (bogie, word), axle in zip(stated, axles, strict=True)
        ]
    bogies: list[str] = [end for end in ENDS if end in dict(stated)]
    parts = []
    for bogie in bogies or [""]:
        own = [i for i, (end, _) in enumerate(stated) if end in ("", bogie)]
        known: dict[str, Stated] = {}
        if bogie:
            word = next(word for end, word in stated if end == bogie)
            known["bogie"] = Stated(bogie, f"guess by columns named {word}")
        numbers = {axles[i] for i in own if axles[i] and signals[i].side}
        if len(numbers) == 1:
            (axle,) = numbers
            known["axle"] = Stated(ENDS[(axle - 1) % 2], f"guess by columns named axle {axle}")
        end = f"_{bogie}" if len(bogies) > 1 else ""
        its_path = path.with_name(f"{path.stem}{end}.yaml")
        parts.append((its_path, tuple(signals[i] for i in own), known))
    return parts


def _stated(
    trip: TripFiles, contents: Sequence[Contents], signals: Sequence[Signal], folder: Path
) -> dict[str, Stated]:
    """Return what the files of a trip state."""
    stated: dict[str, Stated] = {}
    if trip.path.parent != folder:
        stated["suspension"] = Stated(trip.path.parent.name, "by the folder")
    for content in reversed(contents):  # the first file that states a key counts
        stated |= stated_in(content.notes)
    stated |= _by_columns(signals)
    if any(signal.meaning == SPEED for signal in signals):
        stated.pop(SPEED, None)  # a column states more than a line
    if _is_dated(signals):
        stated.pop("start", None)  # the template takes that of the files' clocks
    return stated


def _is_dated(signals: Sequence[Signal]) -> bool:
    return first_moment(signal.zero for signal in signals)[0] is not None


def _file_time(one: TripFiles) -> datetime:
    """Return when the first file of a trip was written, in the zone of this computer."""
    written = datetime.fromtimestamp(min(file.stat().st_mtime for file in one.files))
    return written.replace(microsecond=0)


def _by_columns(signals: Sequence[Signal]) -> dict[str, Stated]:
    """Return mileage and direction where columns have them: their first value, and their sign."""
    stated: dict[str, Stated] = {}
    for signal in signals:
        key = key_of(signal.name)
        source = f"by the column {signal.name!r}"
        if key == "mileage_km" and np.isfinite(signal.first) and signal.first >= 0:
            stated[key] = Stated(round(signal.first, 3), source)
        if key == "direction" and signal.deviation == 0 and signal.mean in (1, -1):
            stated[key] = Stated(DIRECTIONS[signal.mean < 0], source)
    return stated


def _trip(
    path: Path,
    files: tuple[Path, ...],
    contents: Sequence[Contents],
    signals: Sequence[Signal],
    known: Mapping[str, Stated],
    said: Mapping[str, str],
    config_dir: Path | None,
) -> Trip:
    known, names = dict(known), {key: said.get(f"channels.{key}", "") for key in CHANNELS}
    names[SPEED] = said.get(SPEED, "")
    columns = {key: _columns(key, text, signals) for key, text in names.items()}
    chosen = {key: addresses for key, addresses in columns.items() if addresses}
    # a speed that was said, as a column or a number, counts more than one that files state
    if SPEED in chosen:
        known.pop(SPEED, None)
    elif SPEED in said:
        known[SPEED] = Stated(_plain_value(SPEED, said[SPEED]), BY_COMMAND_LINE)
    # columns about the trip are no sensors
    sensors = [signal for signal in signals if key_of(signal.name) not in ABOUT_TRIP]
    own = tuple(_with_said(signal, said, chosen) for signal in sensors)
    speeds = [signal for signal in own if signal.meaning == SPEED]
    if len(speeds) > 1 and SPEED not in said:  # a receiver's is that of the train
        best = next((s for s in speeds if {"gps", "gnss"} & set(words_of(s.name))), speeds[0])
        own = tuple(signal for signal in own if signal is best or signal not in speeds)
    words = [content.read_as for content in contents if content.read_as]
    manifest = template(own, path, words, known, chosen, config_dir)
    return Trip(path, files, known, own, manifest)


def loggers_of(said: Mapping[str, str]) -> list[str]:
    """Return the files of all FILE:COLUMN that are said, which are of one trip."""
    words = (
        word.strip()
        for key, names in said.items()
        if key == SPEED or key.startswith("channels.")
        for word in names.split(",")
    )
    files = {_file_and_column(word)[0] for word in words}
    return sorted(files - {""}, key=len, reverse=True)


def _file_and_column(word: str) -> tuple[str, str]:
    """Return both parts of FILE:COLUMN, the first without the ending of data files."""
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


def _with_said(
    signal: Signal, said: Mapping[str, str], chosen: Mapping[str, Mapping[Address, int]]
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
    unit, rate = said.get(f"{prefix}unit", ""), said.get(f"{prefix}rate_hz")
    by_user: list[str] = []
    if unit and not signal.unit:
        changes["unit"] = unit
        by_user.append("unit")
    if rate and not signal.time and not np.isfinite(signal.rate_hz):
        changes["rate_hz"] = float(_plain_value("rate_hz", rate))
        by_user.append("rate_hz")
    if "range" in said and meaning != SPEED and signal.column.full_scale is not None:
        changes["range"] = float(_plain_value("range", said["range"]))
    return replace(signal, **changes, said=tuple(by_user))


def _plain_value(key: str, text: str) -> str | float:
    """Return what was said as a number where the key has one; ValueError if it is none."""
    is_number = key in (*NUMBERS, "range") or key.endswith("rate_hz")
    try:
        return float(text) if is_number or key == SPEED else text
    except ValueError:
        if is_number:
            raise ValueError(f"`{key}` must be a number, got {text!r}") from None
        return text


def _asked(blank: str) -> str:
    """Return the key by which a blank of a manifest is said once for all trips."""
    for key in ("unit", "rate_hz", "range"):
        if blank.endswith(f".{key}"):
            return f"speed_{key}" if blank.startswith(SPEED) else key
    return blank


def how_to_say(key: str, trips: Sequence[Trip]) -> str:
    """Return how a missing value is said, with the columns to choose from."""
    if key in HOW:
        return HOW[key]
    pair = "LEFT,RIGHT for a pair"
    if not key.endswith(CHANNELS[2]):
        pair += f", or LEFT,RIGHT,LEFT{OTHER},RIGHT{OTHER} with those of the bogie's other axle"
    return f"{key}=COLUMN, or {pair}; columns: {_names_of_columns(trips)}"


def hint_at_one_trip(trips: Sequence[Trip]) -> str:
    """Return how channels of one trip are said; empty unless each file has too few for a trip."""
    columns = [[s.name for s in t.signals if not is_of_another_direction(s.name)] for t in trips]
    have_few = (
        len(trip.files) == 1 and 0 < len(names) < len(CHANNELS)
        for trip, names in zip(trips, columns, strict=True)
    )
    if len(trips) < 2 or not all(have_few):
        return ""
    words = [
        quote(f"channels.{name}={trip.files[0].stem}:{names[0]}")
        for name, trip, names in zip(CHANNELS, trips, columns, strict=False)
    ]
    return f"  if these files are the sensors of one trip: {' '.join(words)}"


def _names_of_columns(trips: Sequence[Trip]) -> str:
    """Return the columns of trips, as FILE:COLUMN where several loggers have the same ones."""
    names: dict[str, None] = {}
    note = ""
    for trip in trips:
        own = [signal.name for signal in trip.signals]
        of_loggers = len(own) < len(CHANNELS) or len(set(own)) < len(own)
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
    for key in (*PLACE_LINES, SPEED):
        if n_trips := Counter(trip.known[key].source for trip in trips if key in trip.known):
            lines.append(f"{key}: {', '.join(f'{where} ({n})' for where, n in n_trips.items())}")
    if guesses := dict.fromkeys(key for trip in trips for key in trip.manifest.guesses):
        lines.append(f"guessed by names of columns, to be checked: {', '.join(guesses)}")
    return lines
