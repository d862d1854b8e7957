"""Times of a source in seconds, from numbers, seconds since 1970, time stamps or file headers.

A source has an absolute clock if its times can be dated. Absolute clocks are aligned with each
other; other sources start at zero of the trip's clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.types import FloatArray
from suspnet.recordings.columns import Column, size_of
from suspnet.recordings.dates import (
    EPOCH,
    SECOND_NS,
    ahead_ns,
    date_problem,
    nanoseconds,
    read_date,
    time_zone,
)
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import TripManifest
from suspnet.recordings.manifest_sources import TIME_UNITS, Source

DATED_S = (3.15e8, 4.1e9)
"""Range of a first time [s] that is taken as seconds since 1970: the years 1979 to 2099."""
SAME_NS = 1000
"""Largest difference [ns] between starts stated by files that count as the same."""


@dataclass(frozen=True)
class Zero:
    """Origin of the times of a source.

    `ns` is counted from 1970, in UTC or, unless `is_zoned`, in the logger's unknown time zone; None
    if unknown. `is_stated` means stated by a file header rather than by time stamps. `date` is from
    a header that is too coarse to align clocks.
    """

    ns: int | None = None
    is_zoned: bool = True
    is_stated: bool = False
    date: datetime | None = None

    @property
    def moment(self) -> datetime | None:
        """Start of the times; without a zone if that is unknown."""
        if self.ns is None:
            return self.date
        found = EPOCH + timedelta(seconds=self.ns // SECOND_NS)
        return found if self.is_zoned else found.replace(tzinfo=None)


class Times:
    """Converts the times of a source into seconds, block by block.

    `column` holds the times; `start_ns` is their origin as the file states it of the values, else
    it is that of `column`. `zero` is known after the first block.
    """

    def __init__(self, where: str, source: Source, column: Column, start_ns: int | None) -> None:
        self.where, self.source, self.column = where, source, column
        start_ns = column.start_ns if start_ns is None else start_ns
        self.zero = Zero(start_ns, not column.is_local, is_stated=start_ns is not None)
        self._begun = False
        self._size, self._first = 1.0, 0.0

    def seconds(self, times: NDArray[np.generic]) -> FloatArray:
        """Return times in seconds since `zero`, NaN where missing.

        Raises TripError if unit or time zone contradict the file, or a local time is ambiguous.
        """
        if not self._begun and len(times):
            self._begun = True
            (self._begin_stamps if times.dtype.kind == "M" else self._begin_numbers)(times)
        if times.dtype.kind == "M":
            stamps = times.astype("datetime64[ns]")
            elapsed = (stamps - np.datetime64(int(self._first), "ns")).astype(
                np.float64
            ) / SECOND_NS
            elapsed[np.isnat(stamps)] = np.nan
            return np.asarray(elapsed)
        return np.asarray((times.astype(np.float64) - self._first) * self._size)

    def _begin_stamps(self, times: NDArray[np.generic]) -> None:
        """Set the zero of time stamps to the whole second of the first one."""
        known = times[~np.isnat(times)]
        if not len(known):
            raise TripError(f"{self.where}: its times are empty")
        first = int(known[0].astype("datetime64[ns]").astype(np.int64)) // SECOND_NS * SECOND_NS
        self._first = first
        zone = self.source.time_zone
        if zone is None:
            self.zero = Zero(first, self.column.is_zoned)
        elif self.column.is_zoned:
            raise TripError(f"{self.where}: its time stamps name a zone; leave out `time_zone`")
        else:
            self.zero = Zero(first - self._offset_ns(first, zone))

    def _offset_ns(self, first: int, zone: str) -> int:
        """Return how far a local time is ahead of UTC, [ns]."""
        early, late = (ahead_ns(first, time_zone(zone), fold) for fold in (0, 1))
        if early != late:
            naive = (EPOCH + timedelta(seconds=first // SECOND_NS)).replace(tzinfo=None)
            raise TripError(
                f"{self.where}: {naive} is not one instant in {zone}, as clocks are changed there; "
                "give `time_zone` as an offset like +02:00"
            )
        return early

    def _begin_numbers(self, times: NDArray[np.generic]) -> None:
        """Set unit and zero of numbers; a unit that makes the first one a date is assumed."""
        numbers = times.astype(np.float64)
        known = numbers[np.isfinite(numbers)]
        first = float(known[0]) if len(known) else 0.0
        stated, found = self.source.time_unit, size_of("time", self.column.unit)
        if stated is not None and found is not None and found != TIME_UNITS[stated]:
            raise TripError(
                f"{self.where}: `time_unit` says {stated!r}, its file says {self.column.unit!r}"
            )
        if stated is None and found is None and self.column.unit:
            raise TripError(
                f"{self.where}: its times are in {self.column.unit!r}, which is not known; give "
                f"`time_unit`, one of {list(TIME_UNITS)}"
            )
        size = found if stated is None else TIME_UNITS[stated]
        sizes = TIME_UNITS.values() if size is None else [size]
        dated = [one for one in sizes if DATED_S[0] <= first * one <= DATED_S[1]]
        self._size = dated[0] if dated else (size or 1.0)
        if dated:
            whole_s = int(first * self._size)
            is_small = self._size < 1  # then its inverse is exact
            self._first = float(
                whole_s * round(1 / self._size) if is_small else whole_s / self._size
            )
            self.zero = Zero(whole_s * SECOND_NS)
        if self.source.time_zone is not None:
            if self.zero.ns is None or self.zero.is_zoned:
                raise TripError(
                    f"{self.where}: `time_zone` is for time stamps, its times are numbers"
                )
            ahead = self._offset_ns(self.zero.ns, self.source.time_zone)
            self.zero = replace(self.zero, ns=self.zero.ns - ahead, is_zoned=True)


def header_date(column: Column) -> datetime | None:
    """Return the date and time of day in the header of a file; None if it has none."""
    return read_date(column.date) if column.date else None


def first_moment(zeros: Iterable[Zero]) -> tuple[datetime | None, str]:
    """Return the earliest start of the sources, and why it is left out if implausible.

    Exact times take precedence over header dates, and times with a zone over others. The start is
    None if no source is dated or the date is implausible.
    """
    known = [zero for zero in zeros if zero.moment is not None]
    exact = [zero for zero in known if zero.ns is not None]
    zoned = [zero for zero in exact or known if zero.moment and zero.moment.tzinfo is not None]
    moments = [zero.moment for zero in zoned or exact or known if zero.moment is not None]
    if not moments:
        return None, ""
    first = min(moments)
    problem = date_problem(first)
    if problem:
        return None, f"the date by its files, {first.isoformat(' ')}, is left out: it {problem}"
    return first, ""


def offsets_s(manifest: TripManifest, zeros: Mapping[str, Zero]) -> dict[str, float]:
    """Return the zero of each source's times on the trip's clock, [s].

    The trip's clock starts with the earliest absolute clock. If some sources are not dated, they
    and the clock start at the manifest's `start`; or with the other files, if the headers of those
    state one common start. Raises TripError if `start` or a time zone is missing.
    """
    dated = {name: zero for name, zero in zeros.items() if zero.ns is not None}
    others = [name for name in zeros if name not in dated]
    starts = [zero.ns for zero in dated.values() if zero.ns is not None]
    if not dated:
        return dict.fromkeys(zeros, 0.0)
    stated = all(zero.is_stated for zero in dated.values())
    if others and stated and max(starts) - min(starts) <= SAME_NS:
        return dict.fromkeys(zeros, 0.0)
    first, is_zoned = min(starts) // SECOND_NS * SECOND_NS, None
    if others:
        if manifest.start is None:
            raise TripError(
                f"{manifest.path}: {', '.join(dated)} have absolute times, {', '.join(others)} "
                f"have not; give `start`, the time at which {', '.join(others)} begin"
            )
        first, is_zoned = nanoseconds(manifest.start), manifest.start.tzinfo is not None
    local = [name for name, zero in dated.items() if not zero.is_zoned]
    if local and (len(local) < len(dated) or is_zoned):
        raise TripError(
            f"{manifest.path}: the times of {', '.join(local)} name no time zone, others do; give "
            'their `time_zone`, like "UTC", "+02:00" or "Europe/Berlin"'
        )
    if not local and is_zoned is False:
        raise TripError(
            f"{manifest.path}: the times of {', '.join(dated)} are in UTC; write the time zone "
            "into `start` too, like 2015-08-03T08:00:00+02:00"
        )
    return {
        name: 0.0 if zero.ns is None else (zero.ns - first) / SECOND_NS
        for name, zero in zeros.items()
    }
