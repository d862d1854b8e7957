"""Time stamps of a stream: checked, turned into a rate, and their gaps filled with NaN."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from suspnet.ground.types import FloatArray, IntArray
from suspnet.recordings.manifest import TripError

GAP_STEPS = 1.5
"""A time step longer than this multiple of the usual one is a gap."""

LONGEST_GAP_S = 1800.0
"""Longest gap within a trip [s]; after a longer one its time stamps are refused."""

RATE_TOLERANCE = 0.01
"""Largest relative difference of the rate by time stamps from that in the manifest."""

BLOCK = 2**18


class Timeline:
    """Makes an evenly sampled stream of one with time stamps, whatever its blocks.

    Parameters
    ----------
    where : str
        Named in errors, e.g. "trip.yaml: channel 'body'".
    rate_hz : float, optional, [Hz]
        Rate in the manifest; None if only the time stamps say it.

    Attributes
    ----------
    rate_hz : float, [Hz]
        One over the mean time step, gaps left out: roughly after the first block, exactly after
        the last; NaN while there is no step.
    first_s : float, [s]
        The first time stamp.
    """

    def __init__(self, where: str, rate_hz: float | None) -> None:
        self.where, self.stated_rate_hz = where, rate_hz
        self.rate_hz = self.first_s = np.nan
        self._usual_s = self._last_s = np.nan
        self._n_steps, self._seconds = 0, 0.0
        self._rest = 0.0  # what rounding gaps to whole samples has left over, [samples]

    def even(self, blocks: Iterable[tuple[FloatArray, ...]]) -> Iterator[FloatArray]:
        """Yield the values of blocks of (times [s], values), with NaN where times are missing.

        Raises
        ------
        TripError
            If times do not rise or are not finite, leave out more than ``LONGEST_GAP_S``, or
            disagree with the stated rate by more than ``RATE_TOLERANCE``.
        """
        for times, values in _recut(blocks):
            before = self._last_s if self._n_steps else None
            check_rising(self.where, times, before)
            if before is None:
                self.first_s = float(times[0])
            steps = np.diff(times, prepend=times[0] if before is None else before)
            if np.isnan(self._usual_s) and len(times) > 1:
                self._usual_s = float(np.median(steps[1:]))
            gaps = np.flatnonzero(steps > GAP_STEPS * self._usual_s)
            self._count(steps, gaps)
            self._last_s = float(times[-1])
            if len(gaps) == 0:
                yield values
                continue
            shift = np.zeros(len(times), dtype=np.intp)
            shift[gaps] = self._missing(steps[gaps])
            shift = np.cumsum(shift)
            filled = np.full(len(times) + int(shift[-1]), np.nan)
            filled[np.arange(len(times)) + shift] = values
            yield filled

    def _count(self, steps: FloatArray, gaps: IntArray) -> None:
        """Update the mean rate by some time steps, gaps left out."""
        n_first = 0 if self._n_steps else 1  # the very first sample follows no step
        self._n_steps += len(steps) - n_first - len(gaps)
        self._seconds += float(steps.sum() - steps[gaps].sum())
        if self._n_steps:
            self.rate_hz = self._n_steps / self._seconds
            check_rate(self.where, self.stated_rate_hz, self.rate_hz)

    def _missing(self, gaps_s: FloatArray) -> FloatArray:
        """Return how many samples each gap lacks; rounding does not add up."""
        if gaps_s.sum() > LONGEST_GAP_S:
            raise TripError(
                f"{self.where}: its times leave out {gaps_s.sum():.6g} s at once; the most is "
                f"{LONGEST_GAP_S:g} s, so divide the trip in two or correct the times"
            )
        exact = np.cumsum(gaps_s * self.rate_hz - 1) + self._rest
        whole = np.maximum.accumulate(np.round(exact))
        self._rest = float(exact[-1] - whole[-1])
        return np.asarray(np.diff(whole, prepend=0.0))


def check_rising(where: str, times: FloatArray, before: float | None = None) -> None:
    """Raise TripError unless times are finite and rise, from the one before them on."""
    if not np.isfinite(times).all():
        raise TripError(f"{where}: its times hold an empty or infinite value")
    all_times = times if before is None else np.concatenate([[before], times])
    fall = np.flatnonzero(all_times[1:] <= all_times[:-1])
    if len(fall):
        earlier, later = all_times[fall[0] : fall[0] + 2]
        raise TripError(
            f"{where}: times must rise, but {later:.9g} s follows {earlier:.9g} s; are they "
            "rounded too coarsely, or stored in single precision?"
        )


def check_rate(where: str, stated_hz: float | None, found_hz: float) -> None:
    """Raise TripError if a stated rate is not that of the time stamps."""
    if stated_hz is not None and abs(found_hz - stated_hz) > RATE_TOLERANCE * stated_hz:
        raise TripError(
            f"{where}: `rate_hz` says {stated_hz:g} Hz, its times say {found_hz:.6g} Hz; they must "
            "agree within 1 %, so correct one or leave it out"
        )


def _recut(blocks: Iterable[tuple[FloatArray, ...]]) -> Iterator[tuple[FloatArray, ...]]:
    """Yield the same stream in blocks of ``BLOCK`` samples, the last one shorter."""
    pending: list[tuple[FloatArray, ...]] = []
    held = 0
    for block in blocks:
        pending.append(block)
        held += len(block[0])
        if held < BLOCK:
            continue
        columns = [np.concatenate(parts) for parts in zip(*pending, strict=True)]
        whole = held - held % BLOCK
        for start in range(0, whole, BLOCK):
            yield tuple(column[start : start + BLOCK] for column in columns)
        pending, held = [tuple(column[whole:] for column in columns)], held - whole
    if held:
        yield tuple(np.concatenate(parts) for parts in zip(*pending, strict=True))
