"""Times of a source in seconds, from numbers, seconds since 1970, time stamps or file headers.

A source has an absolute clock if its times can be dated. Absolute clocks are aligned with each
other; other sources start at zero of the trip's clock.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding, together
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.trains.recordings import dates
from suspnet.trains.recordings.columns import Column, size_of
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import TIME_UNITS, FileSource

DATED_S = (3.15e8, 4.1e9)
"""Range of a first time [s] that is taken as seconds since 1970: the years 1979 to 2099."""
LONGEST_STEP_S = 60.0
"""Longest step of times [s] that count as seconds since 1970: a counter of nanoseconds passes their
numbers within seconds."""
LEAST_STEPS = 8  # least number of steps of the first block by which jumps of the times are judged
SAME_NS = 1000  # largest difference [ns] between starts stated by files that count as the same


@dataclass(frozen=True)
class Zero:
    """Origin of the times of a source.

    `ns` is counted from 1970, in UTC or, unless `is_zoned`, in the logger's unknown time zone; None
    if unknown. `is_stated` means stated by a file header rather than by time stamps. `date` is from
    a header that is too coarse to align clocks. `is_midnight` means the midnight before times of
    day whose date is unknown.
    """

    ns: int | None = None
    is_zoned: bool = True
    is_stated: bool = False
    date: datetime | None = None
    is_midnight: bool = False

    @property
    def moment(self) -> datetime | None:
        """Start of the times; without a zone if that is unknown."""
        if self.ns is None:
            return self.date
        start = dates.EPOCH + timedelta(seconds=self.ns // dates.SECOND_NS)
        return start if self.is_zoned else start.replace(tzinfo=None)


class Times:
    """Converts the times of a source into seconds, block by block.

    `column` holds the times; `start_ns` is their origin as the file states it of the values, else
    it is that of `column`. `zero` is known after the first block. Times continue where a counter or
    a day starts again, and where clocks are changed in spring and autumn; `words` states it.
    `n_untimed` counts the values without a time, which are left out.
    """

    def __init__(
        self, where: str, source: FileSource, column: Column, start_ns: int | None
    ) -> None:
        self.where, self.source, self.column = where, source, column
        start_ns = column.start_ns if start_ns is None else start_ns
        self.zero = Zero(start_ns, not column.is_local, is_stated=start_ns is not None)
        self._begun = False
        self._size, self._first = 1.0, 0.0
        self._usual: float | None = None
        self._last: Any = None
        self._shift = 0
        self._repairs: Counter[str] = Counter()
        self.n_untimed = 0

    @property
    def words(self) -> list[str]:
        """What was repaired in the times so far."""
        words: list[str] = [Finding("times-jump", why=why, n=n) for why, n in self._repairs.items()]
        if self.n_untimed:
            words.append(Finding("rows-without-time", n_untimed=self.n_untimed))
        return words

    def seconds(self, times: NDArray[np.generic]) -> FloatArray:
        """Return times in seconds since `zero`, NaN where missing.

        Raises TripError if unit or time zone contradict the file, or a local time is ambiguous.
        """
        is_stamp = times.dtype.kind == "M"
        raw = times.astype("datetime64[ns]").view(np.int64) if is_stamp else times
        missing = np.isnat(times) if is_stamp else ~np.isfinite(times.astype(np.float64))
        if not self._begun and len(times):
            self._begun = True
            (self._begin_stamps if is_stamp else self._begin_numbers)(times)
        raw = self._continued(raw, missing, is_stamp)
        if is_stamp:
            elapsed = (raw - int(self._first)).astype(np.float64) / dates.SECOND_NS
            elapsed[missing] = np.nan
            return np.asarray(elapsed)
        return np.asarray((raw.astype(np.float64) - self._first) * self._size)

    def _continued(self, raw: NDArray[Any], missing: BoolArray, is_stamp: bool) -> NDArray[Any]:
        present = raw[~missing] if missing.any() else raw
        if not len(present):
            return raw
        steps = np.diff(present, prepend=present[0] if self._last is None else self._last)
        self._last = present[-1]
        if self._usual is None:
            self._usual = float(np.median(steps[1:])) if len(steps) > LEAST_STEPS else 0.0
        hour = 3600 * dates.SECOND_NS if is_stamp else np.inf
        jumps = np.flatnonzero((steps < 0) | (steps > hour / 2))
        if self._usual <= 0 or not len(jumps):
            return raw + self._shift if self._shift else raw
        # a jump is repaired if it is a known one and leaves a step like the others
        shifts = np.zeros(len(present), dtype=present.dtype)
        for reason, period in self._periods(is_stamp):
            off = np.abs(steps[jumps] + period - self._usual)
            if abs(period) == hour:
                off = np.maximum(off, present[jumps] % hour)
            is_it = (off < 1.5 * self._usual) & (shifts[jumps] == 0)
            if is_it.any():
                shifts[jumps[is_it]] = period
                self._repairs[reason] += int(np.count_nonzero(is_it))
        total = self._shift + np.cumsum(shifts)
        self._shift = total[-1]
        continued = raw.copy()
        continued[~missing] += total
        return continued

    def _periods(self, is_stamp: bool) -> list[tuple[str, float]]:
        """Return what times may jump by: as text, and in their unit."""
        if not is_stamp:
            counters = {f"2^{bits}": 2.0**bits for bits in (16, 24, 31, 32)}
            counters |= {f"2^32 {unit}": 2.0**32 * s / self._size for unit, s in TIME_UNITS.items()}
            return [*counters.items(), ("a day", 86400 / self._size)]
        hour = 3600 * dates.SECOND_NS
        if self.zero.is_midnight:  # stamps of minutes and seconds start again every hour
            return [("a day", 24 * hour), ("an hour", hour)]
        # local clocks are changed in autumn and spring
        return [] if self.column.is_zoned else [("an hour", hour), ("an hour", -hour)]

    def _begin_stamps(self, times: NDArray[np.generic]) -> None:
        seconds = times[~np.isnat(times)].astype("datetime64[s]")
        if not len(seconds):
            raise TripError.at(self.where, "times-empty")
        first = int(seconds[0].astype(np.int64)) * dates.SECOND_NS
        self._first = first
        zone = self.source.time_zone
        if seconds[0].astype("datetime64[D]") == dates.NO_DATE:
            if zone is not None:
                raise TripError.at(self.where, "no-date-for-zone")
            self._first = int(dates.NO_DATE.astype("datetime64[ns]").astype(np.int64))
            self.zero = Zero(is_midnight=True)
        elif zone is None:
            self.zero = Zero(first, self.column.is_zoned)
        elif self.column.is_zoned:
            raise TripError.at(self.where, "zone-named-twice")
        else:
            self.zero = Zero(first - self._offset_ns(first, zone))

    def _offset_ns(self, first: int, zone: str) -> int:
        early, late = (dates.ahead_ns(first, dates.time_zone(zone), fold) for fold in (0, 1))
        if early != late:
            naive = (dates.EPOCH + timedelta(seconds=first // dates.SECOND_NS)).replace(tzinfo=None)
            raise TripError.at(self.where, "ambiguous-time", naive=naive, zone=zone)
        return early

    def _begin_numbers(self, times: NDArray[np.generic]) -> None:
        """Set unit and zero of numbers; a unit that makes the first one a date is assumed."""
        numbers = times.astype(np.float64)
        finite = numbers[np.isfinite(numbers)]
        first = float(finite[0]) if len(finite) else 0.0
        # the unit by the manifest or the file, which must not contradict each other
        stated, unit = self.source.time_unit, self.column.unit
        written_s = size_of("time", unit)
        if stated is not None and written_s is not None and written_s != TIME_UNITS[stated]:
            raise TripError.at(
                self.where, "time-unit-differs", stated=repr(stated), unit=repr(unit)
            )
        if stated is None and written_s is None and unit:
            units = {"unit": repr(unit), "time_units": list(TIME_UNITS)}
            raise TripError.at(self.where, "time-unit-unknown", **units)
        size_s = written_s if stated is None else TIME_UNITS[stated]
        sizes_s = TIME_UNITS.values() if size_s is None else [size_s]
        step = float(np.median(np.diff(finite))) if len(finite) > 1 else 0.0
        # numbers that make the first one a date are counted from 1970; a unit in which successive
        # samples lie far apart is too large, and of several the coarsest, the first, is taken
        low, high = DATED_S
        dated = [s for s in sizes_s if low <= first * s <= high and step * s < LONGEST_STEP_S]
        self._size = dated[0] if dated else (size_s or 1.0)
        if dated:
            # the zero is a whole second, so that later times keep their digits
            whole_s = int(first * self._size)
            self._first = whole_s / self._size
            if self._size < 1:  # then its inverse is exact
                self._first = float(whole_s * round(1 / self._size))
            self.zero = Zero(whole_s * dates.SECOND_NS)
        if self.source.time_zone is not None:
            if self.zero.ns is None or self.zero.is_zoned:
                raise TripError.at(self.where, "zone-for-numbers")
            ahead = self._offset_ns(self.zero.ns, self.source.time_zone)
            self.zero = replace(self.zero, ns=self.zero.ns - ahead, is_zoned=True)


def first_moment(zeros: Iterable[Zero]) -> tuple[datetime | None, str]:
    """Return the earliest start of the sources, and why it is left out if implausible.

    Exact times take precedence over header dates, and times with a zone over others. The start is
    None if no source is dated or the date is implausible.
    """
    dated = [(zero.ns is None, at.tzinfo is None, at) for zero in zeros if (at := zero.moment)]
    if not dated:
        return None, ""
    *_, first = min(dated)
    if problem := dates.date_problem(first):
        return None, Finding("date-left-out", time=first.isoformat(" "), problem=problem)
    return first, ""


def offsets_s(manifest: TripManifest, zeros: Mapping[str, Zero]) -> dict[str, float]:
    """Return the zero of each source's times on the trip's clock, [s].

    The trip's clock starts with the earliest absolute clock. If some sources are not dated, they
    and the clock start at the manifest's `start`; or with the other files, if the headers of those
    state one common start. Raises TripError if `start` or a time zone is missing.
    """
    # sources without dates start together, as do files that state one common start
    starts = {name: zero.ns for name, zero in zeros.items() if zero.ns is not None}
    others = [name for name in zeros if name not in starts]
    if not starts:
        return dict.fromkeys(zeros, 0.0)
    earliest, latest = min(starts.values()), max(starts.values())
    if others and latest - earliest <= SAME_NS and all(zeros[name].is_stated for name in starts):
        return dict.fromkeys(zeros, 0.0)
    first, is_zoned, midnight_s = earliest // dates.SECOND_NS * dates.SECOND_NS, None, 0.0
    if others:
        start = manifest.start
        if start is None:
            missing = together(others, ", ")
            names = {"starts": together(starts, ", "), "others": missing, "others2": missing}
            raise TripError.at(manifest.path, "start-missing", **names)
        first, is_zoned = dates.nanoseconds(start), start.tzinfo is not None
        # times of day count from the midnight before it
        midnight = start.replace(hour=0, minute=0, second=0, microsecond=0)
        midnight_s = (midnight - start).total_seconds()
    # clocks in unknown time zones can be aligned with each other only
    local = [name for name in starts if not zeros[name].is_zoned]
    if local and (len(local) < len(starts) or is_zoned):
        raise TripError.at(manifest.path, "times-without-zone", local=together(local, ", "))
    if not local and is_zoned is False:
        raise TripError.at(manifest.path, "start-without-zone", starts=together(starts, ", "))
    undated = {name: midnight_s if zeros[name].is_midnight else 0.0 for name in others}
    return undated | {name: (ns - first) / dates.SECOND_NS for name, ns in starts.items()}
