"""Time stamps as loggers write them, as text: recognised one by one, read a column at a time."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.types import BoolArray, IntArray

NO_DATE = np.datetime64("1900-01-01", "D")
"""Day of times of day whose date is unknown."""
YEARS = (1700, 2250)
"""Years that nanoseconds since 1970 can hold."""
MOST_LAYOUTS = 500
"""Largest number of layouts of one block's stamps, by widths of numbers and names of months."""
MONTHS = (
    *("jan", "feb", "mar|mrz", "apr", "may|mai", "jun"),
    *("jul", "aug", "sep", "oct|okt", "nov", "dec|dez"),
)
"""First letters of the names of months, in English and German."""
ZERO = np.uint8(ord("0"))
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
_ALONE = (
    rf"{_MINUTE}{_SECOND}{_ZONE}",
    r"(?P<minute>\d\d):(?P<second>\d\d)[.,](?P<fraction>\d{1,9})",
)
_PATTERNS = tuple(
    re.compile(pattern, re.IGNORECASE | re.ASCII)
    for pattern in (*(rf"{date}(?: ?[T,;_] ?| ){CLOCK}" for date in DATES), *_ALONE)
)


@dataclass(frozen=True)
class Notation:
    """How a column writes its time stamps.

    `pattern` is an index; `is_zoned` means with a time zone, `is_dated` with a date. Day and month
    are unclear in stamps that are not dated although their pattern has a date.
    """

    pattern: int
    is_zoned: bool
    is_dated: bool

    def is_like(self, other: Notation) -> bool:
        """Return whether only the dates of one of them may be unclear."""
        return (self.pattern, self.is_zoned) == (other.pattern, other.is_zoned)

    def is_that_of(self, text: str) -> bool:
        """Return whether a text is a valid time stamp in this notation."""
        try:
            letters = np.frombuffer(text.encode("ascii"), np.uint8)
            return len(read_stamps(letters, np.array([0, len(letters)]), self)) == 1
        except ValueError:
            return False

    @property
    def is_unclear(self) -> bool:
        """Whether a date is ignored, as its day and month are unclear."""
        return not self.is_dated and self.pattern < len(DATES)


def _match(text: str) -> tuple[int, re.Match[str]] | None:
    matches = ((i, pattern.fullmatch(text)) for i, pattern in enumerate(_PATTERNS))
    return next(((i, match) for i, match in matches if match is not None), None)


def notation_of(text: str) -> Notation | None:
    """Return how a time stamp is written; None if a text is none."""
    matched = _match(text)
    if matched is None:
        return None
    pattern, match = matched
    fields = match.groupdict()
    is_dated = bool(fields.get("year"))
    if fields.get("first"):
        is_dated = max(int(fields["first"]), int(fields["other"])) > 12
    return Notation(pattern, bool(fields.get("zone")), is_dated)


def read_stamps(
    letters: NDArray[np.uint8], ends: NDArray[Any], notation: Notation, day: np.datetime64 = NO_DATE
) -> IntArray:
    """Return time stamps in nanoseconds since 1970, in UTC if they have a zone, (n,).

    Stamp i is ``letters[ends[i] : ends[i + 1]]``, ASCII without blanks at its ends. `day` is that
    of stamps without a date. Stamps of one layout are read at once, digit by digit of all of them.

    Raises ValueError, whose text is the stamp, if one is not written in this notation or is no
    valid time.
    """
    starts, widths = ends[:-1], np.diff(ends)
    stamps = np.empty(len(starts), dtype=np.int64)
    rest = np.arange(len(starts))
    for _ in range(MOST_LAYOUTS):
        if not len(rest):
            return stamps
        # the first of the rest gives the next layout
        first = rest[0]
        text = letters[starts[first] : ends[first + 1]].tobytes().decode("latin-1")
        match = _match(text)
        if match is None or (match[0], bool(match[1].groupdict().get("zone"))) != (
            notation.pattern,
            notation.is_zoned,
        ):
            raise ValueError(text)
        # all stamps with digits in the same places, and the same characters between them
        alike = widths[rest] == widths[first]
        at = rest if alike.all() else rest[alike]
        if len(at) == len(starts):
            rows = letters[starts[0] : ends[-1]].reshape(len(at), -1)
        else:
            rows = letters[starts[at, None] + np.arange(widths[first])]
        places = np.ascontiguousarray(rows.T)
        same = np.ones(len(at), dtype=np.bool_)
        for place in places:
            is_digit = 48 <= place[0] < 58
            same &= place - ZERO < 10 if is_digit else place == place[0]
        if not same.all():
            places = places[:, same]
        values, is_valid = _nanoseconds(places - ZERO, match[1], notation, day)
        stamps[at[same]] = values
        if not is_valid.all():
            wrong = places[:, int(is_valid.argmin())]
            raise ValueError(wrong.tobytes().decode("latin-1"))
        alike[alike] = same
        rest = rest[~alike]
    raise ValueError(text)


def _nanoseconds(
    digits: NDArray[np.uint8], match: re.Match[str], notation: Notation, day: np.datetime64
) -> tuple[IntArray, BoolArray]:
    """Return stamps of one layout, whose first is matched, and which of them are valid times."""
    fields = match.groupdict()

    def number(name: str) -> NDArray[np.int32]:
        """Return a field of all stamps; zero if they have none."""
        value = np.zeros(digits.shape[1], dtype=np.int32)  # at most nine digits
        if fields.get(name):
            for place in range(*match.span(name)):
                value *= 10
                value += digits[place]
        return value

    hour, minute, second = number("hour"), number("minute"), number("second")
    is_valid = (hour < 24) & (minute < 60) & (second < 61)
    if half := fields.get("half"):
        hour = hour % 12 + 12 * (half in "pP")
    if notation.is_dated:
        days, is_date = _days(number, fields)
        is_valid &= is_date
    else:
        days = np.full(digits.shape[1], day).astype(np.int64)
    seconds = 86400 * days + (3600 * hour + 60 * minute + second)
    offset = 3600 * number("zone_hour") + 60 * number("zone_minute")
    seconds -= -offset if fields.get("sign") == "-" else offset
    fraction = number("fraction") * 10 ** (9 - len(fields.get("fraction") or "0"))
    return np.asarray(10**9 * seconds + fraction), is_valid


def _days(
    number: Callable[[str], NDArray[np.int32]], fields: dict[str, Any]
) -> tuple[IntArray, BoolArray]:
    """Return the days of dates since 1970, and which of them are valid, by their numbers."""
    year = number("year")
    if len(fields["year"]) == 2:
        year += np.where(year < 70, 2000, 1900).astype(np.int32)
    month, of_month = number("month"), number("day")
    is_valid = (year >= YEARS[0]) & (year <= YEARS[1])
    if name := fields.get("name"):
        month += next(i for i, names in enumerate(MONTHS, 1) if name.lower() in names.split("|"))
    elif "first" in fields:
        first, other = number("first"), number("other")
        month, of_month = np.minimum(first, other), np.maximum(first, other)
        is_valid &= of_month > 12
    months = (year - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1)
    days = months.astype("datetime64[D]") + (of_month - 1)
    is_valid &= (1 <= month) & (month <= 12) & (1 <= of_month)
    is_valid &= days.astype("datetime64[M]") == months
    return days.astype(np.int64), is_valid
