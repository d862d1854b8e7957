"""Data files of a folder, grouped by trip: those whose names differ by places and sides only."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

from suspnet.ground.ledger import shortened
from suspnet.ground.parameters import SIDES
from suspnet.ground.storage import distinct
from suspnet.ground.wording import natural
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.trips.file_contents import guessed_meaning, guessed_side, words_of

DEEPEST = 3
"""Number of levels of folders that are searched."""
IGNORED = ("vehicle", "outputs")
"""Names of folders that hold no trips."""
NO_DATA = (
    *(".yaml", ".yml", ".json", ".xml", ".ini", ".log", ".md", ".pdf", ".html", ".doc", ".docx"),
    *(".png", ".jpg", ".jpeg", ".svg", ".py", ".ipynb", ".m", ".sh", ".tdms_index", ""),
)
"""Suffixes of files that hold no recording and are left out without a word."""
_GPS = ("gps", "gnss", "nmea")
FILE_NAMES = ("file", "datei", "dateiname", "filename", "trip", "fahrt")
"""Names of the column of a table that names a trip or one of its files."""
MOST_NAME_BYTES = 245
"""Longest name of a trip; file systems allow 255 bytes, of which its manifest needs more."""
HEAD_BYTES = 65_536
"""Size of the start of a file that shows whether it is a table of trips."""


@dataclass(frozen=True)
class TripFiles:
    """Files of one trip, and the path of its manifest."""

    path: Path
    files: tuple[Path, ...]


def find_trip_files(
    folder: Path, besides: Iterable[Path] = (), loggers: Iterable[str] = ()
) -> list[TripFiles]:
    """Return the trips of a folder and its subfolders, without the files `besides`.

    Files of one folder whose names are equal without words for a place, a side or a receiver are of
    one trip: ``run_1_axle.csv``, ``run_1_bogie.csv`` and ``run_1_gps.csv``. A folder whose files
    have no other word, as ``run_1/axle.csv`` and ``run_1/bogie.csv``, is a trip by itself. Folders
    next to each other may be named by places as well: ``axle/run_1.csv``, ``bogie/run_1.csv``.
    `loggers` are more such words. FileNotFoundError is raised if there is no such folder or no data
    file in it.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}; give the one that holds the files")
    left_out = {path.resolve() for path in besides}
    files = [file for file in _data_files(folder) if file.resolve() not in left_out]
    places = _folders_of_places({file.parent for file in files})
    by_trip: dict[Path, list[Path]] = {}
    for file in sorted(files, key=lambda path: natural(str(path))):
        by_trip.setdefault(_trip_of(file, folder, loggers, places), []).append(file)
    if not by_trip:
        others = unread_files(folder) or [f"they end with {', '.join(sorted(READERS))}"]
        raise FileNotFoundError(f"{folder} holds no data file; {'; '.join(others)}")
    trips = list(by_trip)
    # a folder with manifests of its own hides those of its subfolders
    if any(trip.parent == folder for trip in trips):
        trips = [folder / "_".join(trip.relative_to(folder).parts) for trip in trips]
    names = distinct(str(trip.with_name(shortened(trip.name, MOST_NAME_BYTES))) for trip in trips)
    return [
        TripFiles(Path(f"{name}.yaml"), tuple(own))
        for name, own in zip(names, by_trip.values(), strict=True)
    ]


def unread_files(folder: Path) -> list[str]:
    """Return a line on the data files in a folder that are not read, and one on deep folders."""
    by_type: dict[str, list[str]] = {}
    for path in sorted(_files(folder, DEEPEST), key=lambda path: natural(str(path))):
        suffix = "/" if path.is_dir() else path.suffix.lower()
        if suffix not in NO_DATA and not (suffix in READERS and path.is_file()):
            by_type.setdefault(suffix, []).append(str(path))
    too_deep = ", ".join(by_type.pop("/", []))
    lines = []
    if by_type:
        files = ", ".join(
            f"{first} and {len(more)} more" if more else first for first, *more in by_type.values()
        )
        lines.append(f"not read: {files}; export them to one of {', '.join(sorted(READERS))}")
    if too_deep:
        levels = f"below {DEEPEST} levels of folders, give each by itself"
        lines.append(f"not searched: {too_deep}: {levels}")
    return lines


def find_tables(folder: Path) -> list[Path]:
    """Return the tables of trips (CSV) that lie in a folder or its subfolders, next to recordings.

    Such a table has a column of ``FILE_NAMES`` that names another data file of the folder, or a
    trip. OSError is raised if a folder cannot be read.
    """
    files = sorted(_data_files(folder)) if folder.is_dir() else []
    names = {file: {_trip_of(file, folder).name, *names_of([file], folder)} for file in files}
    n_files = Counter(name for own in names.values() for name in own)
    return [
        file
        for file, own in names.items()
        if file.suffix.lower() == ".csv"
        and any(n_files[cell] > (cell in own) for cell in _named_files(file))
    ]


def _named_files(file: Path) -> set[str]:
    """Return the files and trips that a table names; none if it is no table of trips."""
    with suppress(OSError, ValueError), file.open("rb") as stream:
        rows, _ = table_rows(stream.read(HEAD_BYTES), str(file))
        columns = columns_of_files([name.strip() for name in rows[0]] if rows else [])
        return {row[i].strip() for i in columns for row in rows[1:] if i < len(row)}
    return set()


def table_rows(data: bytes, name: str) -> tuple[list[list[str]], str]:
    """Return the rows of a table (CSV) that are not empty, and its delimiter.

    ValueError, whose message starts with `name`, is raised if it is none.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    head = text.partition("\n")[0]
    delimiter = max(";\t,", key=head.count)
    try:
        lines = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
        return [row for row in lines if any(row)], delimiter
    except csv.Error as error:
        raise ValueError(f"{name} cannot be read as a table: {error}") from None


def columns_of_files(names: Sequence[str]) -> list[int]:
    """Return which columns of a table name trips or files."""
    return [i for i, name in enumerate(names) if name.lower() in FILE_NAMES]


def names_of(files: Iterable[Path], folder: Path) -> set[str]:
    """Return the names that a table may give to files of a folder."""
    paths = {file: file.relative_to(folder).as_posix() for file in files}
    own = {name for file in paths for name in (file.name, file.stem)}
    return own | {name for path in paths.values() for name in (path, cell_of(path))}


def cell_of(name: str) -> str:
    """Return the name of a file as a cell that a spreadsheet does not take for a formula."""
    return f"./{name}" if name.startswith(("=", "+", "-", "@")) else name


def _data_files(folder: Path) -> list[Path]:
    paths = _files(folder, DEEPEST)
    return [path for path in paths if path.suffix.lower() in READERS and path.is_file()]


def _files(folder: Path, depth: int) -> Iterable[Path]:
    """Yield what a folder and its subfolders hold, and folders that are too deep."""
    for path in folder.iterdir():
        if path.name.startswith(".") or path.name in IGNORED:
            continue
        if path.is_dir() and depth > 1:
            yield from _files(path, depth - 1)
        else:
            yield path


def without_word(name: str, word: str) -> str:
    """Return a name without a word or several, which stand between signs or at its ends."""
    return re.sub(rf"(?<![^\W_]){re.escape(word)}(?![^\W_])", "", name, flags=re.IGNORECASE)


def _trip_of(
    file: Path, folder: Path, loggers: Iterable[str] = (), places: Collection[Path] = ()
) -> Path:
    """Return the path of a file's trip, without a suffix: by its name, or by that of its folder."""
    home = file.parent.parent if file.parent in places else file.parent
    rest = _without_places(reduce(without_word, loggers, file.stem))
    if not rest:
        return folder / folder.resolve().name if home == folder else home
    return home / re.sub(r"[\W_]*[_\s-][\W_]*", "_", rest)


def _folders_of_places(folders: Iterable[Path]) -> set[Path]:
    """Return the folders that are named by nothing but places, of several channels."""
    by_parent: dict[Path, dict[Path, str]] = {}
    for folder in folders:
        if not _without_places(folder.name):
            by_parent.setdefault(folder.parent, {})[folder] = guessed_meaning(folder.name)
    several = (own for own in by_parent.values() if len(set(own.values()) & set(CHANNELS)) > 1)
    return {folder for own in several for folder in own}


def _without_places(name: str) -> str:
    """Return a name without words for places, sides and receivers; empty if nothing is left."""
    rest = "".join(_without_place(part) for part in re.split(r"([\W_]+)", name)).strip("_-. ")
    return rest if re.search(r"[^\W_]", rest) else ""


def _without_place(part: str) -> str:
    """Return a part of a name, empty if it is a word for a place, a side or a receiver."""
    words = words_of(part)
    is_place = bool(words) and bool(guessed_meaning(part) or part.lower() in _GPS)
    return "" if is_place or guessed_side(part) in SIDES else part
