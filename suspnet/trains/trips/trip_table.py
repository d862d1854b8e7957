"""A table (CSV) of what differs between the trips of a folder, read and written."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from suspnet.ground.storage import read_plain
from suspnet.trains.recordings.logger_notes import Stated, key_of, read_value

FILE_NAMES = ("file", "datei", "dateiname", "filename", "trip", "fahrt")
"""Names of the column of a table that names a trip or one of its files."""
WRITTEN = ("mileage_km", "start", "direction")
"""Keys of the columns of a table that is written to be completed."""


def read_table(path: Path) -> dict[str, dict[str, Stated]]:
    """Return what a table (CSV) states of each trip, by the name of a file or a trip.

    Columns are named as keys of a manifest, or in English or German as loggers do; others are
    ignored. ValueError if none names files, a name is given twice or a value cannot be read.
    """
    data = read_plain(path)
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
    table: dict[str, dict[str, Stated]] = {}
    for number, row in enumerate(rows[1:], start=2):
        trip = row[file].strip() if len(row) > file else ""
        if not trip or trip in table:
            what = f"{trip!r} a second time" if trip else "no file"
            raise ValueError(f"{path}, row {number}: it names {what}")
        table[trip] = {}
        for name, cell in zip(names, row, strict=False):
            key = key_of(name)
            if not key or not cell.strip():
                continue
            value = read_value(key, name, cell, is_german=delimiter == ";" and "." not in cell)
            if value is None:
                unit = "; give its unit, as 252 km/h or 70 m/s" if key == "speed" else ""
                raise ValueError(
                    f"{path}, row {number}: {name!r} cannot be read, got {cell!r}{unit}"
                )
            table[trip][value[0]] = Stated(value[1], f"by {path.name}")
    return table


def table_of(trips: Iterable[tuple[Path, Mapping[str, Stated]]]) -> str:
    """Return a table as CSV, to be completed: the first file of each trip, and what is known."""
    out = io.StringIO()
    rows = csv.writer(out, delimiter=";", lineterminator="\n")
    rows.writerow(["file", *WRITTEN])
    for file, known in trips:
        values = [known[key].value if key in known else "" for key in WRITTEN]
        rows.writerow([_cell_of(file.as_posix()), *values])
    return out.getvalue()


def names_of(files: Sequence[Path]) -> set[str]:
    """Return the names that a table may give to files, whose paths are relative to its folder."""
    own = {name for file in files for name in (file.name, file.stem)}
    return own | {name for file in files for name in (file.as_posix(), _cell_of(file.as_posix()))}


def _cell_of(name: str) -> str:
    """Return the name of a file as a cell that a spreadsheet does not take for a formula."""
    return f"./{name}" if name.startswith(("=", "+", "-", "@")) else name
