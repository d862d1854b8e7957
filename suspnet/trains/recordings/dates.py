"""Dates of recordings: read from file headers, and checked for plausibility."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta, tzinfo
from zoneinfo import ZoneInfo

import numpy as np

from suspnet.ground.findings import Finding
from suspnet.trains.recordings.stamps import CLOCK, DATES, notation_of, read_stamps

EARLIEST_YEAR = 1990
"""Earliest plausible year: digital loggers are younger, and unset clocks start in 1970 or 1980."""
AHEAD = timedelta(days=2)
"""Largest plausible time ahead of this computer's clock: time zones differ by a day."""
LONGEST_LINE = 200
"""Number of characters above which a line is not searched for dates and other keys."""
_NAMED = re.compile(
    r"\W*(?:(?:start|record|measured|date|datum|(?:mess)?beginn|aufnahme|aufgenommen)[\w /.-]*"
    r"|time|zeit|uhrzeit)\W*?[:=;,\t]\W*(\d.*)",
    re.IGNORECASE,
)
_DAYS = tuple(re.compile(rf"{date}(?!\d)", re.IGNORECASE | re.ASCII) for date in DATES)
_TIME = re.compile(CLOCK, re.IGNORECASE | re.ASCII)
_CLOCK = re.compile(r"\d{1,2}:\d\d(?::\d\d(?:[.,]\d+)?)?")


EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
SECOND_NS = 10**9


def nanoseconds(moment: datetime, zone: tzinfo = UTC) -> int:
    """Return a date and time, in `zone` if it has none, in nanoseconds since 1970 in UTC."""
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)
    return (aware - EPOCH) // timedelta(microseconds=1) * 1000


def ahead_ns(local_ns: int, zone: tzinfo, fold: int = 0) -> int:
    """Return how far a local time since 1970 is ahead of UTC, [ns]; `fold` as of datetime."""
    naive = datetime(1970, 1, 1) + timedelta(seconds=local_ns // SECOND_NS)
    offset = naive.replace(tzinfo=zone, fold=fold).utcoffset()
    assert offset is not None  # every zone has an offset
    return round(offset.total_seconds()) * SECOND_NS


def now() -> datetime:
    """Return the time by this computer's clock, in UTC."""
    return datetime.now(UTC)


def date_problem(moment: datetime) -> str:
    """Return why a date (UTC if it has no zone) is implausible; empty if it is plausible."""
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    if aware.year < EARLIEST_YEAR:
        return Finding("before-year", year=EARLIEST_YEAR)
    if aware > now() + AHEAD:
        return Finding("in-future", day=f"{now():%Y-%m-%d}")
    return ""


def read_date(text: str) -> datetime | None:
    """Return the date and time of day in a header; None if there is none or it is ambiguous.

    "03/08/2015" is ambiguous: the order of day and month depends on the country.

    Examples
    --------
    >>> read_date("03.08.2015 08:00:05").isoformat()
    '2015-08-03T08:00:05'
    >>> read_date("2015-08-03T08:00:00+02:00").isoformat()
    '2015-08-03T08:00:00+02:00'
    >>> read_date("03/08/2015") is None
    True
    """
    plain = " ".join(text.split())
    with suppress(ValueError):
        return datetime.fromisoformat(plain)
    day = next(filter(None, (pattern.match(plain) for pattern in _DAYS)), None)
    if day is None:
        return None
    clock = _TIME.search(plain, day.end())
    stamp = f"{day[0]} {clock[0] if clock else '00:00'}"
    notation = notation_of(stamp)
    if notation is None or not notation.is_dated:
        return None
    letters = np.frombuffer(stamp.encode(), np.uint8)
    with suppress(ValueError):
        (ns,) = read_stamps(letters, np.array([0, len(letters)]), notation)
        moment = EPOCH + timedelta(microseconds=int(ns) // 1000)
        return moment if notation.is_zoned else moment.replace(tzinfo=None)
    return None


def short_lines(lines: Iterable[str]) -> list[str]:
    """Return the lines that are short enough to be searched."""
    return [line for line in lines if len(line) <= LONGEST_LINE]


def date_in_lines(lines: Sequence[str]) -> str | None:
    """Return the start stated above a table, in one line or as separate date and time of day.

    Examples
    --------
    >>> date_in_lines(["Logger 7", "Datum;03.08.2015", "Uhrzeit;08:00:05"])
    '03.08.2015 08:00:05'
    """
    matches = [_NAMED.match(line) for line in short_lines(lines)]
    values = [match[1].rstrip(" \t;,\"'") for match in matches if match is not None]
    clock = next((value for value in values if _CLOCK.fullmatch(value)), "")
    for value in values:
        if read_date(value) is not None:
            return value if _CLOCK.search(value) else f"{value} {clock}".strip()
    return None


def time_zone(name: str) -> tzinfo:
    """Return a time zone by its name or its offset from UTC; ValueError if it is unknown."""
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
