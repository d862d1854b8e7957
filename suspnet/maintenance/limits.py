"""Limits of maintenance: how far from healthy a parameter calls for a look, or for work."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from suspnet.ground.parameters import DEFAULT_LIMITS, Limits, read_limits
from suspnet.ground.types import BoolArray, IntArray

__all__ = [
    "DEFAULT_LIMITS",
    "N_CONFIRMING",
    "N_LAST",
    "Judged",
    "Limits",
    "Severity",
    "judge",
    "read_limits",
]

N_LAST = 5
"""Number of last trips that are compared with the limits."""
N_CONFIRMING = 3
"""Number of the last trips beyond a limit that confirm each other."""


class Severity(IntEnum):
    """Urgency of a finding; the larger, the worse."""

    NONE = 0
    UNKNOWN = 1
    """Nothing can be told: no estimate, or one that is too uncertain."""
    NOTICE = 2
    """Look at the suspension when it is next at hand."""
    ACT = 3
    """The suspension needs work."""

    def __str__(self) -> str:
        """Return the name in small letters, as it stands in tables."""
        return self.name.lower()


@dataclass(frozen=True)
class Judged:
    """The last trips compared with the limits; all arrays have one shape, that of the cases.

    Attributes
    ----------
    severity : int array
        Values of ``Severity``.
    side : int array
        -1 below, 1 above the limits, 0 within.
    run : int array
        How many of the newest trips in a row lie beyond the limit that the severity is of.
    count : int array
        How many of the last trips do.
    weak : bool array
        A notice that rests on newest trips that are flagged or have no interval.
    """

    severity: IntArray
    side: IntArray
    run: IntArray
    count: IntArray
    weak: BoolArray


def judge(
    values: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    flagged: ArrayLike,
    limits: Limits,
) -> Judged:
    """Return how severe it is where the last trips lie, whatever was before them.

    A limit is crossed if

    - the newest trips in a row lie beyond it, and the interval of one of them does so wholly; or
    - ``N_CONFIRMING`` of the last trips lie beyond it. Of these a trip counts if its interval is
      shorter on either side than the limit is far from healthy, or if it has no interval.

    A flagged trip, and one without an interval, gives no more than a notice by itself. A newest
    trip that lies beyond the notice limit, but not surely so, makes the severity unknown.

    False alarms of a healthy suspension, with independent errors and intervals of 90 %: as long as
    the half-width is at most as large as the limit is far from healthy, the second rule is wrong in
    at most 2 * 10 * 0.05^3 = 0.25 % of cases and the first in less than 0.2 %; at 60 % of that
    half-width, both in less than 0.01 %. Recordings too short for that raise more: 2 % at twice and
    6 % at four times the half-width (measured, 200,000 series).

    Parameters
    ----------
    values, low, high : arrays of shape (..., n_last), [-]
        Estimates and their intervals of the last trips, the newest last; NaN: none.
    flagged : bool array of shape (..., n_last)
    limits : Limits

    Returns
    -------
    Judged
        Of shape (...).
    """
    centre, lower, upper = (np.asarray(part, dtype=float) for part in (values, low, high))
    unsure = np.asarray(flagged, dtype=bool) | ~(np.isfinite(lower) & np.isfinite(upper))
    shape = centre.shape[:-1]
    severity, side, run, count = (np.zeros(shape, dtype=np.int64) for _ in range(4))
    weak = np.zeros(shape, dtype=bool)
    for sign in (-1, 1):
        for level, pair in ((Severity.NOTICE, limits.notice), (Severity.ACT, limits.act)):
            limit = pair[(sign + 1) // 2]
            out = sign * (centre - limit) > 0
            wholly = out & ~unsure & (sign * ((lower if sign > 0 else upper) - limit) > 0)
            reach = np.where(sign > 0, centre - lower, upper - centre)
            newest = np.logical_and.accumulate(out[..., ::-1], axis=-1)[..., ::-1]
            telling = out & (unsure | (reach <= abs(limit - 1)))
            sure = (newest & wholly).any(axis=-1) | (telling.sum(axis=-1) >= N_CONFIRMING)
            found, alone = np.where(sure, level, Severity.NONE), np.zeros(shape, dtype=bool)
            if level == Severity.NOTICE:
                maybe = newest.any(axis=-1) & ~sure
                alone = maybe & (newest & unsure).any(axis=-1)
                found = np.where(maybe, Severity.UNKNOWN, found)
                found = np.where(alone, Severity.NOTICE, found)
            worse = (found > severity) | ((found == severity) & (found > 0) & newest[..., -1])
            severity = np.where(worse, found, severity)
            side = np.where(worse, sign, side)
            run = np.where(worse, newest.sum(axis=-1), run)
            count = np.where(worse, out.sum(axis=-1), count)
            weak = np.where(worse, alone, weak)
    return Judged(severity, side, run, count, weak)
