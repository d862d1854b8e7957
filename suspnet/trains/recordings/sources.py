"""One source of a trip, open for reading, with unit, rate and times from file and manifest."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.clocks import Times, Zero
from suspnet.trains.recordings.columns import BLOCK, Column, OpenFile, agreed_size, choose, size_of
from suspnet.trains.recordings.dates import read_date
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_file, read_columns
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import FileSource, SensorSource
from suspnet.trains.recordings.uneven import POINTS, Grid, Line

RATE_TOLERANCE = 1e-4
"""Largest relative difference between a stated rate and that in the header of a file."""
WHOLE_HZ = 0.5  # largest difference from a rate that the format stores as a whole number, [Hz]
BAND_HZ = 25.0  # frequency up to which samples are used unless a reader says otherwise, [Hz]
GAP_STEPS = 1.5  # multiple of the usual time step above which a step is a gap, where steps are even


@dataclass(frozen=True)
class OpenSource:
    """A source that is open for reading.

    `size` is the factor from stored values to SI units, including the sign and, for fractions, the
    range; `full_scale` the largest magnitude of an acceleration [m/s2]. `rate_hz` is None if only
    the times give it, `times` None if the source is evenly sampled. `stated` is the origin by the
    file's header. `stated_words` state how the file is read, as known when it was opened. `where`
    names the source in errors.
    """

    path: Path
    file: OpenFile
    names: tuple[str, ...]
    size: float
    rate_hz: float | None
    times: Times | None
    stated: Zero
    full_scale: float | None
    stated_words: str
    where: str
    timeline: Timeline | None

    @property
    def words(self) -> str:
        """How the file is read, and what was repaired in the blocks so far."""
        repaired = [] if self.times is None else self.times.words
        uneven = "" if self.timeline is None else self.timeline.words
        return together((self.stated_words, *self.file.remarks, *repaired, uneven))

    @property
    def zero(self) -> Zero:
        """Origin of the times; if there are any, known after the first block."""
        if self.times is None:
            return self.stated
        return replace(self.times.zero, date=self.stated.date)

    def blocks(self) -> Iterator[tuple[FloatArray, ...]]:
        """Yield times [s], if there are any, and values in the source's unit.

        Rows without a time are left out.
        """
        n_rows = 0
        for block in read_columns(self.path, self.file, self.names):
            if self.times is None:
                yield block
                continue
            seconds, values = self.times.seconds(block[0]), block[1]
            if (untimed := np.isnan(seconds)).any():
                self.times.n_untimed += int(np.count_nonzero(untimed & ~np.isnan(values)))
                seconds, values = seconds[~untimed], values[~untimed]
            n_rows += len(values)
            yield seconds, values
        if self.times is not None and not n_rows:
            raise TripError.at(self.where, "times-empty")

    def even(self, band_hz: float = BAND_HZ) -> Iterator[FloatArray]:
        """Yield evenly sampled values in the source's unit; NaN where times are missing.

        Uneven times must allow interpolation up to `band_hz`.
        """
        if self.timeline is not None:
            self.timeline.band_hz = band_hz
            yield from self.timeline.even(self.blocks())
        else:
            for (block,) in self.blocks():
                yield block

    @property
    def known_rate_hz(self) -> float:
        """Rate as stated or by the times: approximate after the first block, exact at the end."""
        if self.timeline is None:
            assert self.rate_hz is not None  # a source has times or a rate
            return self.rate_hz
        if math.isnan(self.timeline.rate_hz):
            raise TripError(Finding("too-few-samples", where=self.where))
        return self.timeline.rate_hz

    @property
    def first_s(self) -> float:
        """Time of the first sample since `zero` [s], known after the first even block."""
        return 0.0 if self.timeline is None else self.timeline.first_s


@contextmanager
def open_source(manifest: TripManifest, source: FileSource, where: str) -> Iterator[OpenSource]:
    """Open a channel or the speed of a trip.

    `where` names the source in errors. Raises TripError if the file cannot be read or contradicts
    the manifest, or if unit or rate are unknown.
    """
    path = manifest.file_of(source)
    with open_file(path, source.csv) as file:
        columns = [source.column] if source.time is None else [source.time, source.column]
        name = choose(path, file, columns)[-1]
        column = file.column(name)
        if column.is_time:
            raise TripError.at(path, "column-of-times", name=repr(name))
        # rate and times by the manifest, the file, or else its only column of time stamps
        rate_hz = _agreed_rate(where, source.rate_hz, column)
        time = source.time or column.time
        if time is None and rate_hz is None:
            time = _only_stamps(where, path, file)
        # factor to SI units, and the sensor's range in them
        factor, words = _size(where, source, column)
        full_scale = getattr(source, "range", None)
        if full_scale is not None:
            full_scale = abs(factor) * (1.0 if column.is_fraction else full_scale)
        times = None
        if time is not None:
            choose(path, file, [time])  # raises if there is no such column
            times = Times(where, source, file.column(time), column.start_ns)
        elif source.time_unit is not None or source.time_zone is not None:
            raise TripError.at(where, "time-keys-without-time")
        date = read_date(column.date) if column.date else None
        yield OpenSource(
            path,
            file,
            (name,) if time is None else (time, name),
            factor,
            rate_hz,
            times,
            Zero(column.start_ns, not column.is_local, is_stated=True, date=date),
            full_scale,
            together((file.words, words)),
            where,
            None if times is None else Timeline(where, rate_hz),
        )


def _only_stamps(where: str, path: Path, file: OpenFile) -> str:
    stamps = [column.name for column in file.columns if column.is_time]
    if len(stamps) == 1:
        return stamps[0]
    unread = next((column for column in file.columns if column.unread), None)
    if unread is None:
        raise TripError(Finding("rate-missing", where=where, name=path.name))
    values = {"file": path.name, "name": repr(unread.name), "unread": unread.unread}
    raise TripError(Finding("needs-rate-but", where=where, **values))


def _agreed_rate(where: str, stated_hz: float | None, column: Column) -> float | None:
    own_hz = column.rate_hz
    if stated_hz is None or own_hz is None:
        return stated_hz or own_hz
    most = max(RATE_TOLERANCE * own_hz, WHOLE_HZ if column.is_whole_rate else 0)
    if abs(stated_hz - own_hz) > most:
        raise TripError.at(where, "rate-differs", stated_hz=stated_hz, found_hz=own_hz)
    return stated_hz


def _size(where: str, source: FileSource, column: Column) -> tuple[float, str]:
    size = agreed_size(where, source.kind, source.unit, column.unit)
    words = ""
    if column.unit and size_of(source.kind, column.unit) is None:
        words = Finding(
            "unit-taken", name=repr(column.name), unit=source.unit, unit2=repr(column.unit)
        )
    if column.is_fraction:
        if not isinstance(source, SensorSource) or source.range is None:
            raise TripError.at(where, "range-missing", name=repr(column.name))
        size *= source.range
    return size * (source.sign if isinstance(source, SensorSource) else 1), words


def zero_of(manifest: TripManifest, name: str) -> Zero:
    """Return the origin of the times of a source; TripError if it cannot be read."""
    with open_source(manifest, manifest.sources()[name], manifest.where(name)) as opened:
        if opened.times is not None:
            for times in read_columns(opened.path, opened.file, opened.names[:1]):
                opened.times.seconds(times[0])
                break
        return opened.zero


LONGEST_GAP_S = 1800.0  # longest gap within a trip, [s]; time stamps with a longer one are refused
TIMES_TOLERANCE = 0.01
"""Largest relative difference between the rate by time stamps and that in the manifest."""


class Timeline:
    """Converts a stream with time stamps into an evenly sampled one, independent of its blocks.

    `where` names the source in errors. The argument `rate_hz` is the rate of the manifest, or None;
    the attribute is the inverse mean time step without gaps, which is approximate after the first
    block, exact after the last, and NaN while there is no step. `first_s` is the first time stamp.
    `band_hz` is the frequency up to which the samples are used.
    """

    def __init__(self, where: str, rate_hz: float | None) -> None:
        self.where, self.stated_rate_hz, self.band_hz = where, rate_hz, BAND_HZ
        self.rate_hz = self.first_s = np.nan
        self._usual_s = self._last_s = np.nan
        self._n_steps, self._seconds = 0, 0.0
        self._rest = 0.0  # accumulated rounding error of gaps, [samples]
        self._n_given = 0  # values given so far, missing ones among them
        self._line = Line()
        self._grid: Grid | None = None
        self._last = np.empty(0), np.empty(0)  # the last samples

    @property
    def words(self) -> str:
        """What was done with uneven times; empty for even ones."""
        return "" if self._grid is None else self._grid.words

    def even(self, blocks: Iterable[tuple[FloatArray, ...]]) -> Iterator[FloatArray]:
        """Yield the values of blocks of (times [s], values), with NaN where times are missing.

        Uneven times are interpolated. Raises TripError if times do not rise, are not finite, have
        gaps above ``LONGEST_GAP_S``, are too uneven, or differ from the stated rate by more than
        ``TIMES_TOLERANCE``.
        """
        # blocks of one size: the result must not depend on how the stream is cut
        for times, values in recut(blocks, BLOCK):
            before = None if np.isnan(self._last_s) else self._last_s
            check_rising(self.where, times, before)
            if before is None:
                self.first_s = float(times[0])
            steps = np.diff(times, prepend=times[0] if before is None else before)
            if np.isnan(self._usual_s) and len(times) > 1:
                self._usual_s = float(np.median(steps[1:]))
            # times on a line keep their samples; from the first block off it on, interpolate
            if self._grid is None:
                filled = self._filled(times, steps, values)
                if filled is None:
                    self._start_grid(times)
                    times = np.concatenate([self._last[0], times])
                    values = np.concatenate([self._last[1], values])
            if self._grid is not None:
                check_gaps(self.where, steps[steps > self._grid.gap_s])
                filled = self._grid.push(times, values)
            assert filled is not None  # of the line or the grid
            yield filled
            self._last_s = float(times[-1])
            self._last = times[-3 * POINTS :], values[-3 * POINTS :]
        if self._grid is not None:
            yield self._grid.finish()

    def _filled(
        self, times: FloatArray, steps: FloatArray, values: FloatArray
    ) -> FloatArray | None:
        """Return values with NaN where samples are missing before them; None if times are uneven.

        `steps` are those to each sample.
        """
        # the mean rate so far without gaps gives the number of samples that each gap lacks
        is_gap = steps > GAP_STEPS * self._usual_s
        n_first = int(np.isnan(self._last_s))  # the very first sample follows no step
        n_steps = self._n_steps + int(np.count_nonzero(~is_gap)) - n_first
        seconds = self._seconds + float(steps[~is_gap].sum())
        rate_hz = n_steps / seconds if n_steps else self.rate_hz
        # the number of each sample, by those missing before it
        numbers = self._n_given + np.arange(len(steps))
        exact = np.cumsum(steps[is_gap] * rate_hz - 1) + self._rest
        whole = np.maximum.accumulate(np.round(exact))
        if len(whole):
            numbers += np.append(0, whole).astype(np.intp)[np.cumsum(is_gap)]
        even_steps = steps[n_first:][~is_gap[n_first:]]
        if not self._line.holds(numbers, times, even_steps, self.band_hz):
            return None
        check_gaps(self.where, steps[is_gap])
        check_rate(self.where, self.stated_rate_hz, rate_hz)
        self.rate_hz, self._n_steps, self._seconds = rate_hz, n_steps, seconds
        if len(whole):
            self._rest = float(exact[-1] - whole[-1])
        filled = np.full(int(numbers[-1]) + 1 - self._n_given, np.nan)
        filled[numbers - self._n_given] = values
        self._n_given += len(filled)
        return filled

    def _start_grid(self, times: FloatArray) -> None:
        steps = np.diff(times, prepend=self._last[0])
        first_s, step_s = float(times[0]), None
        if self._n_given:
            first_s = self._line.at(self._n_given)
            step_s = self._line.at(self._n_given + 1) - first_s
        self._grid = Grid(self.where, first_s, steps, self.band_hz, step_s)
        self.rate_hz = self._grid.rate_hz
        check_rate(self.where, self.stated_rate_hz, self.rate_hz)


def check_rising(where: str, times: FloatArray, before: float | None = None) -> None:
    """Raise TripError unless times are finite and increase, also from the one before them."""
    if not np.isfinite(times).all():
        raise TripError.at(where, "times-not-finite")
    all_times = times if before is None else np.concatenate([[before], times])
    fall = np.flatnonzero(all_times[1:] <= all_times[:-1])
    if len(fall):
        earlier, later = all_times[fall[0] : fall[0] + 2]
        reason = "are they rounded too coarsely, or stored in single precision?"
        if later < earlier:
            reason = Finding("clock-steps-back", later=earlier - later)
        raise TripError.at(where, "times-do-not-rise", later=later, earlier=earlier, reason=reason)


def check_gaps(where: str, gaps_s: FloatArray) -> None:
    """Raise TripError if gaps are longer than ``LONGEST_GAP_S`` in all."""
    if gaps_s.sum() > LONGEST_GAP_S:
        raise TripError.at(where, "gaps-too-long", sum=gaps_s.sum(), longest_gap_s=LONGEST_GAP_S)


def check_rate(where: str, stated_hz: float | None, times_hz: float) -> None:
    """Raise TripError if a stated rate differs from that of the time stamps."""
    if stated_hz is not None and abs(times_hz - stated_hz) > TIMES_TOLERANCE * stated_hz:
        raise TripError.at(where, "rate-differs-from-times", stated_hz=stated_hz, found_hz=times_hz)


def recut(blocks: Iterable[tuple[FloatArray, ...]], size: int) -> Iterator[tuple[FloatArray, ...]]:
    """Yield columns in blocks of `size` rows; the last one may be shorter."""
    pending: list[tuple[FloatArray, ...]] = []
    n_pending = 0
    for block in blocks:
        pending.append(block)
        n_pending += len(block[0])
        if n_pending < size:
            continue
        columns = [np.concatenate(parts) for parts in zip(*pending, strict=True)]
        whole = n_pending - n_pending % size
        for start in range(0, whole, size):
            yield tuple(column[start : start + size] for column in columns)
        pending, n_pending = [tuple(column[whole:] for column in columns)], n_pending - whole
    if n_pending:
        yield tuple(np.concatenate(parts) for parts in zip(*pending, strict=True))
