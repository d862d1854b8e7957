"""Dates and time stamps as loggers write them: recognised in text, read a column at a time."""

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from suspnet.ground.findings import Finding
from suspnet.ground.types import BoolArray, IntArray

NO_DATE = np.datetime64("1900-01-01", "D")  # day of times of day whose date is unknown
YEARS = (1700, 2250)  # years that nanoseconds since 1970 can hold
MONTHS = {
    **{"jan": 1, "feb": 2, "mar": 3, "mrz": 3, "apr": 4, "may": 5, "mai": 5, "jun": 6, "jul": 7},
    **{"aug": 8, "sep": 9, "oct": 10, "okt": 10, "nov": 11, "dec": 12, "dez": 12},
}
"""Months by the first letters of their names, in English and German."""
_NAME = rf"(?P<name>{'|'.join(MONTHS)})[a-z]{{0,6}}"
DATES = (
    r"(?P<year>\d{4})[-/.:](?P<month>\d\d?)[-/.:](?P<day>\d\d?)",
    r"(?P<day>\d\d?)\. ?(?P<month>\d\d?)\. ?(?P<year>\d{4})",
    rf"(?P<day>\d\d?)[-. /]{{0,2}}{_NAME}[-. /]{{0,2}}(?P<year>\d{{4}}|\d\d)",
    r"(?P<first>\d\d?)/(?P<other>\d\d?)/(?P<year>\d{4})",
)
"""Dates; the last one leaves open which number is the day, unless one is above 12."""
_SECOND = r":(?P<second>\d\d)(?:[.,:](?P<fraction>\d{1,9}))?"
_OFFSET = r"(?P<sign>[+-])(?P<zone_hour>\d\d)(?::?(?P<zone_minute>\d\d))?"
_ZONE = rf"(?: ?(?P<half>[ap])\.?m\.?)?(?: ?(?P<zone>Z|UTC|GMT|{_OFFSET}))?"
_MINUTE = r"(?P<hour>\d\d?):(?P<minute>\d\d)"
CLOCK = rf"{_MINUTE}(?:{_SECOND})?{_ZONE}"
_STAMPS = (
    *(rf"{date}(?: ?[T,;_] ?| ){CLOCK}" for date in DATES),
    rf"{_MINUTE}{_SECOND}{_ZONE}",
    r"(?P<minute>\d\d):(?P<second>\d\d)[.,](?P<fraction>\d{1,9})",
)
"""Notations of time stamps, in the common syntax of Python and of RE2, which Arrow uses."""
_PATTERNS = tuple(re.compile(stamp, re.IGNORECASE | re.ASCII) for stamp in _STAMPS)
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


@dataclass(frozen=True)
class Notation:
    """How a column writes its time stamps.

    `pattern` is an index; `is_zoned` means with a time zone, `is_dated` with a date. Day and month
    are unclear in stamps that are not dated although their pattern has a date.
    """

    pattern: int
    is_zoned: bool
    is_dated: bool

    def is_that_of(self, text: str) -> bool:
        """Return whether a text is a time stamp like this; its date may be unclear."""
        other = notation_of(text)
        mine = self.pattern, self.is_zoned
        return other is not None and (other.pattern, other.is_zoned) == mine

    @property
    def is_unclear(self) -> bool:
        """Whether a date is ignored, as its day and month are unclear."""
        return not self.is_dated and self.pattern < len(DATES)


def notation_of(text: str) -> Notation | None:
    """Return how a time stamp is written; None if a text is none."""
    matches = ((i, pattern.fullmatch(text)) for i, pattern in enumerate(_PATTERNS))
    pattern, match = next(((i, match) for i, match in matches if match), (0, None))
    if match is None:
        return None
    fields = match.groupdict()
    is_dated = bool(fields.get("year"))
    if fields.get("first"):
        is_dated = max(int(fields["first"]), int(fields["other"])) > 12
    return Notation(pattern, bool(fields.get("zone")), is_dated)


def read_stamps(
    texts: pa.Array, notation: Notation, day: np.datetime64 = NO_DATE
) -> tuple[IntArray, BoolArray]:
    """Return time stamps in nanoseconds since 1970, in UTC if they have a zone, (n,).

    The second result is whether each is a valid time in this notation. `day` is that of stamps
    without a date.
    """
    pattern = f"(?i)^(?:{_STAMPS[notation.pattern]})$"
    matches = pc.extract_regex(pc.utf8_trim_whitespace(texts), pattern)
    names = [field.name for field in matches.type]

    def text(name: str) -> pa.Array:
        if name not in names:
            return pa.array([""] * len(texts), pa.string())
        return pc.fill_null(matches.field(name), "")

    def number(name: str, width: int = 1) -> IntArray:
        """Return a field of all stamps, padded with zeros to a width; 0 if they have none."""
        padded = pc.utf8_rpad(text(name), width, "0")
        return np.asarray(padded.cast(pa.int64()).to_numpy(zero_copy_only=False))

    def matched(name: str, letters: str) -> BoolArray:
        wanted = pa.array(list(letters))
        return np.asarray(pc.is_in(text(name), wanted).to_numpy(zero_copy_only=False))

    hour, minute, second = number("hour"), number("minute"), number("second")
    is_zoned = ~np.asarray(pc.equal(text("zone"), "").to_numpy(zero_copy_only=False))
    is_valid = np.asarray(matches.is_valid().to_numpy(zero_copy_only=False))
    # a stamp that only looks alike, such as one without the zone of the others, is no time
    is_valid = is_valid & (is_zoned == notation.is_zoned)
    is_valid &= (hour < 24) & (minute < 60) & (second < 61)
    afternoon = matched("half", "pP")
    hour = np.where(afternoon | matched("half", "aA"), hour % 12 + 12 * afternoon, hour)
    days: Any = np.full(len(texts), day).astype(np.int64)
    if notation.is_dated:
        days, is_date = _days(number, text("name"))
        is_valid &= is_date
    seconds = 86400 * days + 3600 * hour + 60 * minute + second
    offset = 3600 * number("zone_hour") + 60 * number("zone_minute")
    seconds -= np.where(matched("sign", "-"), -offset, offset)
    return np.asarray(10**9 * seconds + number("fraction", 9)), is_valid


def _days(number: Callable[[str], IntArray], names: pa.Array) -> tuple[IntArray, BoolArray]:
    """Return the days of dates since 1970, and which of them are valid, by their numbers."""
    year, first, other = number("year"), number("first"), number("other")
    year = year + np.where(year < 70, 2000, np.where(year < 100, 1900, 0))
    is_valid = (year >= YEARS[0]) & (year <= YEARS[1])
    # the month is a number, a name, or the smaller one of two numbers
    places = pc.index_in(pc.utf8_lower(names), pa.array(list(MONTHS)))
    named = np.array([*MONTHS.values(), 0])[pc.fill_null(places, -1).to_numpy()]
    month = number("month") + named + np.minimum(first, other)
    of_month = number("day") + np.maximum(first, other)
    is_valid &= (first == 0) | (of_month > 12)
    year, month = np.where(is_valid, year, 1970), np.where(is_valid, month, 1)
    months = (year - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1)
    days = months.astype("datetime64[D]") + (of_month - 1)
    is_valid &= (month >= 1) & (month <= 12) & (of_month >= 1)
    is_valid &= days.astype("datetime64[M]") == months
    return days.astype(np.int64), is_valid


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

    >>> read_date("03.08.2015 08:00:05").isoformat()
    '2015-08-03T08:00:05'
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
    (ns,), (is_valid,) = read_stamps(pa.array([stamp]), notation)
    if not is_valid:
        return None
    moment = EPOCH + timedelta(microseconds=int(ns) // 1000)
    return moment if notation.is_zoned else moment.replace(tzinfo=None)


def short_lines(lines: Iterable[str]) -> list[str]:
    """Return the lines that are short enough to be searched."""
    return [line for line in lines if len(line) <= LONGEST_LINE]


def date_in_lines(lines: Sequence[str]) -> str | None:
    """Return the start stated above a table, in one line or as separate date and time of day.

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
