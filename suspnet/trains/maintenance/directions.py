"""Forward against reverse: an error of the model that trips in both directions show.

Estimates of consecutive trips in opposite directions should agree. With d_i the difference of the
logarithms (forward - reverse) of pair i, h_i the root of the sum of both squared half widths, and
w_i = 1 / h_i^2, an error e that all trips share widens the intervals to sqrt(h^2 + (z e)^2)::

    m = sum w_i d_i / sum w_i,    v = sum w_i (d_i - m)^2 / ((n - 1) sum w_i),
    e^2 = max(m^2 - v, 0) / 4.

e of a trip is of the pairs up to this trip, so that later trips do not change its interval.
"""

from collections.abc import Mapping
from statistics import NormalDist

import numpy as np

from suspnet.ground.parameters import FORWARD, REVERSE
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.types import FloatArray, IntArray

SIGNS: dict[str, float] = {FORWARD: 1.0, REVERSE: -1.0}
"""Number of each direction of travel in arrays."""
LEAST_PAIRS = 3  # fewest pairs whose mean difference counts
MOST = 3.0
"""Largest |d_i| / h_i that counts: a part that changed between two trips is no error of the model.
"""
Z = NormalDist().inv_cdf((1 + INTERVAL_LEVEL) / 2)
"""Half width of a normal interval of trips, in standard deviations."""


def widened(
    signs: IntArray,
    states: IntArray,
    healthy_since_km: FloatArray,
    estimates: Mapping[str, FloatArray],
    half_widths: Mapping[str, FloatArray],
) -> dict[str, FloatArray]:
    """Return the half widths with the errors that both directions show, each (n_trips,), [-].

    Trips of different `healthy_since_km`, [km], NaN for nominal vehicles, were identified with
    different models, whose errors differ. The others are as in ``opposite_pairs``.
    """
    wide = {name: column.copy() for name, column in half_widths.items()}
    for since_km in np.unique(healthy_since_km):
        both_unknown = np.isnan(healthy_since_km) & np.isnan(since_km)
        is_of_era = (healthy_since_km == since_km) | both_unknown
        pairs = opposite_pairs(np.where(is_of_era, signs, 0), states)
        for name, half in half_widths.items() if len(pairs) >= LEAST_PAIRS else ():
            errors = direction_errors(pairs, signs, estimates[name], half)
            wide[name][is_of_era] = np.hypot(half, Z * errors)[is_of_era]
    return wide


def opposite_pairs(signs: IntArray, states: IntArray) -> IntArray:
    """Return consecutive trips of one state in opposite directions, by index, (n_pairs, 2).

    `signs` (n_trips,): 1 forward, -1 reverse, 0 for trips that are not used; `states` (n_trips,)
    are numbers that differ where a part may have changed. No trip is in two pairs.
    """
    pairs, before = [], -1
    for i in np.flatnonzero(signs).tolist():
        if before >= 0 and signs[i] != signs[before] and states[i] == states[before]:
            pairs.append((before, i))
            before = -1
        else:
            before = i
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def direction_errors(
    pairs: IntArray, signs: IntArray, estimates: FloatArray, half_widths: FloatArray
) -> FloatArray:
    """Return e after each trip, (n_trips,), [-]; 0 before ``LEAST_PAIRS`` pairs.

    `pairs` and `signs` as in ``opposite_pairs``; `estimates` and `half_widths`, in logarithms:
    (n_trips,). Pairs without an estimate or a half width are left out.
    """
    first, second = pairs.T
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(estimates)
        weights = 1 / (half_widths[first] ** 2 + half_widths[second] ** 2)
        d = signs[first] * (logs[first] - logs[second])
    usable = np.isfinite(d) & np.isfinite(weights) & (weights > 0)
    weights, ends = weights[usable], second[usable]
    d = np.clip(d[usable], -MOST / np.sqrt(weights), MOST / np.sqrt(weights))
    # sums over the pairs up to each one; n - 1 is not used where it is 0
    n, total = np.arange(1, len(d) + 1), np.cumsum(weights)
    mean = np.cumsum(weights * d) / total
    squares = np.maximum(np.cumsum(weights * d**2) - total * mean**2, 0.0)
    variance = squares / (np.maximum(n - 1, 1) * total)
    errors = np.where(n >= LEAST_PAIRS, np.sqrt(np.maximum(mean**2 - variance, 0.0)) / 2, 0.0)
    n_ended = np.searchsorted(ends, np.arange(len(logs)), side="right")
    return np.asarray(np.append(0.0, errors)[n_ended])
