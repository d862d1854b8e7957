"""Data files of a folder, grouped by trip, and a table (CSV) of what differs between the trips."""

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

from suspnet.ground.own_files import shortened
from suspnet.ground.parameters import SIDES
from suspnet.ground.storage import distinct, read_plain
from suspnet.ground.wording import natural
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.trips import file_contents

DEEPEST = 3  # number of levels of folders that are searched
IGNORED = ("vehicle", "outputs")  # names of folders that hold no trips
_GPS = ("gps", "gnss", "nmea")
MOST_NAME_BYTES = 245
"""Longest name of a trip; file systems allow 255 bytes, of which its manifest needs more."""


@dataclass(frozen=True)
class TripFiles:
    """Files of one trip, and the path of its manifest."""

    path: Path
    files: tuple[Path, ...]


def find_trip_files(
    folder: Path, besides: Iterable[Path] = (), loggers: Iterable[str] = ()
) -> list[TripFiles]:
    """Return the trips of a folder and its subfolders.

    Files of one folder whose names are equal without words for a place, a side or a receiver are of
    one trip: ``run_1_axle.csv``, ``run_1_bogie.csv`` and ``run_1_gps.csv``. A folder whose files
    have no other word, as ``run_1/axle.csv`` and ``run_1/bogie.csv``, is a trip by itself.
    `loggers` are more such words; the files `besides` are left out. FileNotFoundError is raised if
    there is no such folder or no data file in it.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}; give the one that holds the files")
    left_out = {path.resolve() for path in besides}
    paths = sorted(_files(folder, DEEPEST), key=lambda path: natural(str(path)))
    files = [file for file in paths if file.resolve() not in left_out]
    by_trip: dict[Path, list[Path]] = {}
    for file in files:
        by_trip.setdefault(_trip_of(file, folder, loggers), []).append(file)
    if not by_trip:
        formats = ", ".join(sorted(READERS))
        raise FileNotFoundError(f"{folder} holds no data file; they end with {formats}")
    trips = list(by_trip)
    # a folder with manifests of its own hides those of its subfolders
    if any(trip.parent == folder for trip in trips):
        trips = [folder / "_".join(trip.relative_to(folder).parts) for trip in trips]
    names = distinct(str(trip.with_name(shortened(trip.name, MOST_NAME_BYTES))) for trip in trips)
    pairs = zip(names, by_trip.values(), strict=True)
    return [TripFiles(Path(f"{name}.yaml"), tuple(files)) for name, files in pairs]


def _files(folder: Path, depth: int) -> Iterable[Path]:
    for path in folder.iterdir():
        if path.name.startswith(".") or path.name in IGNORED:
            continue
        if path.is_dir() and depth > 1:
            yield from _files(path, depth - 1)
        elif path.suffix.lower() in READERS and path.is_file():
            yield path


def without_word(name: str, word: str) -> str:
    """Return a name without a word or several, which stand between signs or at its ends."""
    return re.sub(rf"(?<![^\W_]){re.escape(word)}(?![^\W_])", "", name, flags=re.IGNORECASE)


def _trip_of(file: Path, folder: Path, loggers: Iterable[str]) -> Path:
    home = file.parent
    rest = _without_places(reduce(without_word, loggers, file.stem))
    if not rest:
        return folder / folder.resolve().name if home == folder else home
    return home / re.sub(r"[\W_]*[_\s-][\W_]*", "_", rest)


def _without_places(name: str) -> str:
    """Return a name without words for places, sides and receivers; empty if nothing is left."""
    rest = "".join(_without_place(part) for part in re.split(r"([\W_]+)", name)).strip("_-. ")
    return rest if re.search(r"[^\W_]", rest) else ""


def _without_place(part: str) -> str:
    words = file_contents.words_of(part)
    is_place = bool(words) and bool(file_contents.guessed_meaning(part) or part.lower() in _GPS)
    return "" if is_place or file_contents.guessed_side(part) in SIDES else part


FILE_NAMES = ("file", "datei", "dateiname", "filename", "trip", "fahrt")
"""Names of the column of a table that names a trip or one of its files."""
WRITTEN = ("mileage_km", "start", "direction")
"""Keys of the columns of a table that is written to be completed."""


def read_table(path: Path) -> dict[str, dict[str, file_contents.Stated]]:
    """Return what a table (CSV) states of each trip, by the name of a file or a trip.

    Columns are named as keys of a manifest, or in English or German as loggers do; others are
    ignored. ValueError if none names files, a name is given twice or a value cannot be read.
    """
    data = read_plain(path)
    # as spreadsheets save it: in UTF-8 or in the code page of Windows, with any usual delimiter
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    head = text.partition("\n")[0]
    delimiter = max(";\t,", key=head.count)
    try:
        lines = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
        rows = [row for row in lines if any(row)]
    except csv.Error as error:
        raise ValueError(f"{path} cannot be read as a table: {error}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    file = next((i for i, name in enumerate(names) if name.lower() in FILE_NAMES), None)
    if file is None:
        raise ValueError(f"{path}: no column is called file, trip, Datei or Fahrt; it has {names}")
    # a row without a name, or with one for the second time, would be lost or win by chance
    table: dict[str, dict[str, file_contents.Stated]] = {}
    for number, row in enumerate(rows[1:], start=2):
        trip = row[file].strip() if len(row) > file else ""
        if not trip or trip in table:
            fault = f"{trip!r} a second time" if trip else "no file"
            raise ValueError(f"{path}, row {number}: it names {fault}")
        table[trip] = {}
        for name, cell in zip(names, row, strict=False):
            key = file_contents.key_of(name)
            if not key or not cell.strip():
                continue
            # where ; delimits, a comma is that of a decimal; else the language of the name decides
            value = file_contents.read_value(
                key, name, cell, is_german=delimiter == ";" and "." not in cell
            )
            if value is None:
                unit = "; give its unit, as 252 km/h or 70 m/s" if key == "speed" else ""
                raise ValueError(
                    f"{path}, row {number}: {name!r} cannot be read, got {cell!r}{unit}"
                )
            table[trip][value[0]] = file_contents.Stated(value[1], f"by {path.name}")
    return table


def table_of(trips: Iterable[tuple[Path, Mapping[str, file_contents.Stated]]]) -> str:
    """Return a table as CSV, to be completed: the first file of each trip, and what is known."""
    out = io.StringIO()
    rows = csv.writer(out, delimiter=";", lineterminator="\n")
    rows.writerow(["file", *WRITTEN])
    for file, stated in trips:
        values = [stated[key].value if key in stated else "" for key in WRITTEN]
        rows.writerow([_cell_of(file.as_posix()), *values])
    return out.getvalue()


def names_of(files: Sequence[Path]) -> set[str]:
    """Return the names that a table may give to files, whose paths are relative to its folder."""
    plain = {name for file in files for name in (file.name, file.stem)}
    return plain | {name for file in files for name in (file.as_posix(), _cell_of(file.as_posix()))}


def _cell_of(name: str) -> str:
    return f"./{name}" if name.startswith(("=", "+", "-", "@")) else name
