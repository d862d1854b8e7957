"""Times of a source in seconds: numbers, numbers counted from 1970, time stamps, headers of files.

A source is on an absolute clock if its times can be dated. Absolute clocks are aligned with each
other; the others begin at zero of the trip's clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.types import FloatArray
from suspnet.recordings.columns import Column, size_of
from suspnet.recordings.dates import date_problem, read_date, time_zone
from suspnet.recordings.manifest import TIME_UNITS, Source, TripManifest
from suspnet.recordings.manifest_keys import TripError

SECOND_NS = 10**9
DATED_S = (3.15e8, 4.1e9)
"""Numbers of seconds that are counted from 1970 if a source's times begin with them: the years
1979 to 2099."""

SAME_NS = 1000
"""Starts stated by files that differ by no more than this [ns] are one."""


@dataclass(frozen=True)
class Zero:
    """What the times of a source are counted from.

    Parameters
    ----------
    ns : int or None, [ns]
        Since 1970; None if that is not known.
    is_zoned : bool
        In UTC; otherwise in the zone of the logger, which is not known.
    is_stated : bool
        A header of the file says it, rather than each time stamp.
    date : datetime or None
        What a header says that is too coarse to align clocks by.
    """

    ns: int | None = None
    is_zoned: bool = True
    is_stated: bool = False
    date: datetime | None = None

    @property
    def moment(self) -> datetime | None:
        """When the times begin; without a zone if that is not known."""
        if self.ns is None:
            return self.date
        found = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=self.ns // SECOND_NS)
        return found if self.is_zoned else found.replace(tzinfo=None)


class Times:
    """Turns the times of a source into seconds, block by block.

    Parameters
    ----------
    where : str
        Named in errors.
    source : Source
    column : Column
        Of the times.
    start_ns : int or None, [ns]
        What the file says its numbers are counted from.

    Attributes
    ----------
    zero : Zero
        Known after the first block.
    """

    def __init__(self, where: str, source: Source, column: Column, start_ns: int | None) -> None:
        self.where, self.source, self.column = where, source, column
        self.zero = Zero(start_ns, is_stated=start_ns is not None)
        self._begun = False
        self._size, self._first = 1.0, 0.0

    def seconds(self, times: NDArray[np.generic]) -> FloatArray:
        """Return times in seconds since `zero`, NaN where there is none.

        Raises
        ------
        TripError
            If the unit contradicts the file's, or the time zone is ambiguous or needless.
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
        """Find zero of time stamps: the whole second of the first one."""
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
        """Return what a local time is ahead of UTC, [ns]."""
        naive = datetime(1970, 1, 1) + timedelta(seconds=first // SECOND_NS)
        local = naive.replace(tzinfo=time_zone(zone))
        early, late = (local.replace(fold=fold).utcoffset() for fold in (0, 1))
        assert early is not None  # every zone has an offset
        if early != late:
            raise TripError(
                f"{self.where}: {naive} is not one instant in {zone}, as clocks are changed there; "
                "give `time_zone` as an offset like +02:00"
            )
        return round(early.total_seconds()) * SECOND_NS

    def _begin_numbers(self, times: NDArray[np.generic]) -> None:
        numbers = times.astype(np.float64)
        known = numbers[np.isfinite(numbers)]
        first = float(known[0]) if len(known) else 0.0
        stated, found = self.source.time_unit, size_of("time", self.column.unit)
        if stated is not None and found is not None and found != TIME_UNITS[stated]:
            raise TripError(
                f"{self.where}: `time_unit` says {stated!r}, its file says {self.column.unit!r}"
            )
        size = found if stated is None else TIME_UNITS[stated]
        sizes = TIME_UNITS.values() if size is None else [size]
        dated = [one for one in sizes if DATED_S[0] <= first * one <= DATED_S[1]]
        self._size = dated[0] if dated else (size or 1.0)
        if dated:
            whole_s = int(first * self._size)
            self._first = float(whole_s * round(1 / self._size))
            self.zero = Zero(whole_s * SECOND_NS)
        if self.source.time_zone is not None:
            raise TripError(f"{self.where}: `time_zone` is for time stamps, its times are numbers")


def header_date(column: Column) -> datetime | None:
    """Return the date and time of day in the header of a file; None if it has none."""
    return read_date(column.date) if column.date else None


def first_moment(zeros: Iterable[Zero]) -> tuple[datetime | None, str]:
    """Return the first of the moments when sources begin, by time stamps rather than by dates.

    Returns
    -------
    moment : datetime or None
        None if no source is dated, or the date cannot be right.
    words : str
        Why a date is left out; otherwise empty.
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
    """Return when the times of each source begin on the trip's clock, [s].

    The trip's clock begins with the first absolute clock. If some sources are not dated it begins
    with the manifest's `start`, and so do these; or with the headers of all other files, if these
    state one and the same start.

    Raises
    ------
    TripError
        If clocks cannot be aligned: `start` is missing, or a time zone.
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
        start, is_zoned = manifest.start, manifest.start.tzinfo is not None
        whole = start.replace(tzinfo=start.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
        first = whole // timedelta(microseconds=1) * 1000
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
