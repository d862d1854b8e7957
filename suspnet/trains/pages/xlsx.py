"""Tables as a spreadsheet (XLSX): typed numbers and times, units in the headers, no formulas."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

from suspnet.ground.extras import import_extra
from suspnet.ground.parameters import ESTIMATED, SI_COLUMNS
from suspnet.ground.storage import printable, write_atomically

UNITS = (
    ("_ns_per_m", "N s/m"),
    ("_n_per_m", "N/m"),
    ("_m_per_s", "m/s"),
    ("_percent", "%"),
    ("_km", "km"),
    ("_kg", "kg"),
    ("_hz", "Hz"),
    ("temperature_c", "°C"),
    ("coherence_s", "1"),
    ("coherence_p", "1"),
    ("_s", "s"),
    ("seconds", "s"),
)
"""Ends of the names of columns, and the unit that each means; the first match counts."""
INTERVAL_ENDS = r"(_low|_high|_healthy)$"
MAX_ROWS, MAX_CHARACTERS = 1_048_575, 32_767  # below the header of a sheet, and of a cell
MAX_WIDTH = 60  # of a column, in characters
TIMES = ("start", "at", "day", "decide_by", "passing_from", "passing_to", "since")
"""Columns whose texts are days or times in ISO 8601."""


def write_xlsx(tables: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> Path:
    """Write tables atomically, a sheet for each that has rows; return the path.

    Numbers are numbers, without NaN and infinity; texts in ISO 8601 of columns named ``start``,
    ``at``, ``day`` and the like are times, with a zone in UTC; all other texts are texts, whatever
    they begin with. ValueError is raised if XlsxWriter is missing, or a table is too long.
    """
    xlsxwriter = import_extra("xlsxwriter", "xlsx", "a spreadsheet")
    stream = io.BytesIO()
    options = {
        "in_memory": True,
        "strings_to_formulas": False,
        "strings_to_urls": False,
        "strings_to_numbers": False,
    }
    with xlsxwriter.Workbook(stream, options) as book:
        formats = {
            "header": book.add_format({"bold": True, "text_wrap": True, "valign": "top"}),
            "time": book.add_format({"num_format": "yyyy-mm-dd hh:mm:ss"}),
            "day": book.add_format({"num_format": "yyyy-mm-dd"}),
            "plain": book.add_format(),
        }
        for name, rows in tables.items():
            if rows:
                _write(book.add_worksheet(name[:31]), name, rows, formats)
    return write_atomically(path, stream.getvalue())


def header_of(name: str) -> str:
    """Return the name of a column with its unit.

    >>> header_of("mileage_km"), header_of("k_p"), header_of("trip")
    ('mileage_km [km]', 'k_p [1]', 'trip')
    """
    plain = re.sub(INTERVAL_ENDS, "", name)
    if plain in SI_COLUMNS.values():
        return f"{name} [{_unit(plain)}]"
    if re.sub(r"_(low|high|raw|truth|last)$", "", name) in ESTIMATED:  # relative to healthy
        return f"{name} [1]"
    unit = _unit(name)
    return f"{name} [{unit}]" if unit else name


def _unit(name: str) -> str:
    return next((unit for end, unit in UNITS if name.endswith(end)), "")


def _write(sheet: Any, name: str, rows: Sequence[Mapping[str, Any]], formats: Any) -> None:
    if len(rows) > MAX_ROWS:
        raise ValueError(
            f"{name} has {len(rows)} rows, a sheet holds {MAX_ROWS}: use the Parquet file"
        )
    columns = list(dict.fromkeys(column for row in rows for column in row))
    widths = [min(len(header_of(column)) + 2, 24) for column in columns]
    for j, column in enumerate(columns):
        _write_text(sheet, (0, j), _text(header_of(column)), formats["plain"], formats["header"])
        for i, row in enumerate(rows, start=1):
            value = _typed(column, row.get(column))
            if isinstance(value, str):
                _write_text(sheet, (i, j), value, formats["plain"])
                widths[j] = max(widths[j], min(len(value), MAX_WIDTH))
            elif isinstance(value, bool):
                sheet.write_boolean(i, j, value)
            elif isinstance(value, datetime):
                sheet.write_datetime(i, j, value, formats["time"])
            elif isinstance(value, date):
                sheet.write_datetime(i, j, value, formats["day"])
            elif value is not None:
                sheet.write_number(i, j, value)
        sheet.set_column(j, j, widths[j])
    sheet.freeze_panes(1, 1)
    sheet.autofilter(0, 0, len(rows), len(columns) - 1)


def _write_text(sheet: Any, at: tuple[int, int], text: str, plain: Any, *format: Any) -> None:
    """Write a text as it is, also one that XlsxWriter would write as markup: in two pieces."""
    if text.startswith("<r>") and text.endswith("</r>"):
        sheet.write_rich_string(*at, text[0], plain, text[1:], *format)
    else:
        sheet.write_string(*at, text, *format)


def _typed(column: str, value: Any) -> Any:
    """Return a value as it is written: None for what is missing, times of Excel without a zone."""
    if isinstance(value, str):
        return _time(value) if column in TIMES and value else _text(value) or None
    if value is None or isinstance(value, (bool, datetime, date)):
        return value
    if isinstance(value, (int, float)) or hasattr(value, "__float__"):
        return float(value) if math.isfinite(value) else None
    return _text(str(value))


def _time(text: str) -> Any:
    try:
        is_day = re.fullmatch(r"\d{4}-\d\d-\d\d", text)
        time = date.fromisoformat(text) if is_day else datetime.fromisoformat(text)
        if isinstance(time, datetime) and time.tzinfo is not None:
            time = time.astimezone(UTC).replace(tzinfo=None)
    except (OverflowError, ValueError):
        return _text(text)
    return time if time.year >= 1900 else _text(text)


def _text(text: str) -> str:
    return printable(text)[:MAX_CHARACTERS]
