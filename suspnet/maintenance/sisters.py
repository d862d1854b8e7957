"""Comparison of sister suspensions: one that differs from the others of its car has changed.

Values are relative to each suspension's own healthy value, so healthy sisters are alike;
common-mode changes, for example from cold or load, are not reported. With L_i the mean logarithm of
the last ``N_LAST`` values of suspension i, and n sisters,

    d_i = L_i - median_j L_j,    var d_i = s_i^2 + min(1, pi / 2n) mean_j s_j^2,
    s_i^2 = C sigma_i^2 + sigma_0i^2,

where j runs over the sisters, sigma_i is the standard deviation of a trip, C sigma_i^2 the variance
of the mean of correlated trips, and sigma_0i the standard deviation of the healthy value. An alarm
starts where |d_i| exceeds both the least difference and Student's quantile times sqrt(var d_i).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from scipy import stats

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import BOGIE_PARTS, Cause, Severity, kind_of, part_words
from suspnet.ground.records import INTERVAL_LEVEL, Key
from suspnet.ground.settings import Setting, check_number, check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.maintenance.alarms import Alarm, spans
from suspnet.maintenance.judge import N_LAST
from suspnet.maintenance.noise import robust_spread
from suspnet.maintenance.series import Series, of_same_car

CORRELATION = 0.5
"""Largest assumed correlation between the errors of successive trips."""
OF_STEPS = 2 * (1 - CORRELATION)
"""Variance of the difference of successive trips over that of a trip."""
N_REFERENCE = 20
"""Number of first trips of each suspension from which its scatter is estimated."""
EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation for normal numbers: its degrees of freedom per
sample, relative to the standard deviation's."""
LOWEST_PROBABILITY, HIGHEST_PROBABILITY = 1e-12, 0.05
"""Bounds of the probability of a false alarm at one trip."""
LEAST_PERCENT = {"k_p": 2.0, "c_p": 5.0, "k_s": 2.0, "c_s": 5.0}
"""Smallest differences that are reported, [%]; assumed: a fifth or a quarter of those at the notice
limits."""


@dataclass(frozen=True)
class SisterSettings:
    """Settings of the comparison of sister suspensions.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range.
    """

    km_per_false_alarm: float = setting(
        1e7,
        "Mileage of a healthy suspension in which one false alarm of a sister is expected at "
        "most, over all its parameters",
        "km",
        above=0,
    )
    least_percent: Annotated[
        Mapping[str, float],
        Setting(
            "Smallest reported difference of each parameter, and of each of its parts, from the "
            "sisters",
            rule="%; at least 0 and below 100",
        ),
    ] = field(default_factory=lambda: dict(LEAST_PERCENT))
    max_apart_km: float = setting(
        20_000.0, "Largest mileage by which a sister's newest trip may lag", "km", above=0
    )
    level: float = setting(
        INTERVAL_LEVEL,
        "Probability with which the intervals of the trips hold the truth",
        low=0.01,
        most=0.999,
    )

    def __post_init__(self) -> None:
        check_settings(self)
        for name, least in self.least_percent.items():
            check_number(f"least_percent.{name}", least, low=0, below=100)


@dataclass(frozen=True, eq=False)
class Sister:
    """One parameter of one suspension, to be compared with its sisters.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        Ascending.
    values : array of shape (n_trips,), [-]
        Relative to healthy; NaN: no estimate, or a flagged one.
    half_widths : array of shape (n_trips,), [-]
        Half-widths of their intervals, in logarithms; NaN: none.
    healthy_half_width : float, [-]
        Half-width of the healthy value's interval, unless `half_widths` include it.
    """

    mileage_km: FloatArray
    values: FloatArray
    half_widths: FloatArray
    healthy_half_width: float = 0.0


def sister_alarms(
    parameter: str, sisters: Sequence[Sister], settings: SisterSettings
) -> list[list[Alarm]]:
    """Return the alarms of each suspension of a car, active or cleared, as its trips raised them.

    An alarm uses only the trips up to its own, so later trips do not change it. It ends where the
    difference is below half of the threshold. The severity is always a notice: limits determine
    which part is worn and how far.

    The false-alarm rate of a healthy suspension is at most one in `km_per_false_alarm` if errors
    are normal, correlated by at most ``CORRELATION`` from trip to trip, and scatter as the
    intervals or the first ``N_REFERENCE`` trips of all sisters show.

    Parameters
    ----------
    parameter : str
    sisters : sequence of Sister
        Suspensions of one car; none is compared if there is only one.
    settings : SisterSettings

    Returns
    -------
    list of n_sisters lists of Alarm
    """
    nothing: list[list[Alarm]] = [[] for _ in sisters]
    kind = kind_of(parameter)
    if len(sisters) < 2 or kind not in settings.least_percent:
        return nothing
    km = np.unique(np.concatenate([_known(one)[0] for one in sisters]))
    if len(km) < N_LAST:
        return nothing
    levels, variances = _levels(sisters, km, settings)
    n_compared = len(settings.least_percent) if kind == parameter else len(BOGIE_PARTS)
    scale = _quantiles(sisters, km, settings, n_compared)
    least = -math.log1p(-settings.least_percent[kind] / 100)
    return [
        _alarms(parameter, km, _compared(i, levels, variances), scale, least)
        for i in range(len(sisters))
    ]


@dataclass(frozen=True, eq=False)
class _Compared:
    """One suspension and the median of its sisters at each trip of any of them; (n_km,).

    `deviation` is the standard deviation of the difference, in logarithms; `n_apart` counts the
    sisters that differ from the suspension.
    """

    level: FloatArray
    median: FloatArray
    deviation: FloatArray
    n_sisters: FloatArray
    n_apart: FloatArray


def _known(one: Sister) -> tuple[FloatArray, FloatArray, FloatArray]:
    values = np.asarray(one.values, dtype=float)
    known = np.isfinite(one.mileage_km) & np.isfinite(values) & (values > 0)
    halves = np.nan_to_num(np.asarray(one.half_widths, dtype=float)[known], posinf=np.inf)
    return np.asarray(one.mileage_km, dtype=float)[known], np.log(values[known]), halves


def _levels(
    sisters: Sequence[Sister], km: FloatArray, settings: SisterSettings
) -> tuple[FloatArray, FloatArray]:
    """Return mean logarithm and its variance at each mileage, (n_sisters, n_km); NaN: unknown."""
    z = stats.norm.ppf((1 + settings.level) / 2)
    levels, variances = np.full((2, len(sisters), len(km)), np.nan)
    pooled = _pooled_scatter(sisters, km)
    for i, one in enumerate(sisters):
        own_km, logs, halves = _known(one)
        if len(logs) < N_LAST:
            continue
        n = np.searchsorted(own_km, km, side="right")  # trips up to each mileage
        newest = np.maximum(n - 1, 0)
        known = (n >= N_LAST) & (km - own_km[newest] <= settings.max_apart_km)
        last = np.clip(n - N_LAST, 0, len(logs) - N_LAST)
        windows = np.lib.stride_tricks.sliding_window_view(np.stack([logs, halves**2]), N_LAST, 1)
        level, square = windows.mean(axis=-1)[:, last]
        own = _scatter_until(logs)[np.minimum(n, N_REFERENCE)]
        sigma = np.fmax(np.sqrt(square) / z, np.fmax(own, pooled))
        variance = _of_mean() * sigma**2 + (one.healthy_half_width / z) ** 2
        levels[i, known], variances[i, known] = level[known], variance[known]
    return levels, variances


def _of_mean() -> float:
    """Return C, the variance of the mean of ``N_LAST`` correlated trips over that of one."""
    lags = np.arange(1, N_LAST)
    return float(1 + 2 * np.sum((1 - lags / N_LAST) * CORRELATION**lags)) / N_LAST


def _scatter_until(logs: FloatArray) -> FloatArray:
    """Return the robust standard deviation of the first 0, 1, ... ``N_REFERENCE`` trips, or NaN.

    It uses differences of successive trips, to be insensitive to drifts and steps.
    """
    steps = np.abs(np.diff(logs[:N_REFERENCE]))
    found = np.full(N_REFERENCE + 1, np.nan)
    for n in range(N_LAST, N_REFERENCE + 1):
        found[n] = robust_spread(steps[: n - 1], OF_STEPS)
    return found


def _pooled(sisters: Sequence[Sister], km: FloatArray) -> list[tuple[int, FloatArray]]:
    """Return indices of `km` and, for each, the absolute differences of all sisters up to there."""
    steps, ends = [], []
    for one in sisters:
        own_km, logs, _ = _known(one)
        steps.append(np.abs(np.diff(logs[:N_REFERENCE])))
        ends.append(own_km[1:N_REFERENCE])
    size, end = np.concatenate(steps), np.concatenate(ends)
    places = np.searchsorted(km, np.unique(end))
    return [(int(place), size[end <= km[place]]) for place in places]


def _pooled_scatter(sisters: Sequence[Sister], km: FloatArray) -> FloatArray:
    found = np.full(len(km), np.nan)
    for place, steps in _pooled(sisters, km):
        found[place:] = robust_spread(steps, OF_STEPS)
    return found


def _quantiles(
    sisters: Sequence[Sister], km: FloatArray, settings: SisterSettings, n_parameters: int
) -> FloatArray:
    """Return Student's quantile at each mileage, for the false-alarm rate shared by parameters."""
    degrees = np.ones(len(km))
    for place, steps in _pooled(sisters, km):
        degrees[place:] = max(1.0, EFFICIENCY * len(steps))
    gap_km = (km - km[0]) / np.maximum(np.arange(len(km)), 1)
    probability = gap_km / settings.km_per_false_alarm / n_parameters
    limited = np.clip(probability, LOWEST_PROBABILITY, HIGHEST_PROBABILITY)
    found: FloatArray = stats.t.isf(limited / 2, degrees)
    return found


def _compared(i: int, levels: FloatArray, variances: FloatArray) -> _Compared:
    others, own = np.delete(levels, i, axis=0), levels[i]
    there = np.isfinite(others)
    n = there.sum(axis=0)
    filled = np.where(there, others, np.inf)
    ordered, column = np.sort(filled, axis=0), np.arange(len(own))
    middle = ordered[np.maximum(n - 1, 0) // 2, column], ordered[n // 2, column]
    median = np.where(n > 0, (middle[0] + middle[1]) / 2, np.nan)
    mean = np.nansum(np.delete(variances, i, axis=0), axis=0) / np.maximum(n, 1)
    variance = variances[i] + np.minimum(1.0, np.pi / 2 / np.maximum(n, 1)) * mean
    distant = there & (np.abs(others - own) > np.abs(own - median) / 2)
    return _Compared(own, median, np.sqrt(variance), n, distant.sum(axis=0))


def _alarms(
    parameter: str, km: FloatArray, found: _Compared, scale: FloatArray, least: float
) -> list[Alarm]:
    size = np.abs(found.level - found.median)
    threshold = np.maximum(scale * found.deviation, least)
    is_odd = 2 * found.n_apart >= found.n_sisters + 1  # most of them are elsewhere, or half
    raised, cleared = is_odd & (size > threshold), size < threshold / 2
    alarms = []
    for begin, end in spans(raised, cleared):
        last = len(km) if end is None else end
        # a cleared alarm reports its largest difference, an active one the newest
        place = begin + int(np.nanargmax(size[begin:last])) if end is not None else _newest(size)
        end_km = math.nan if end is None else float(km[end])
        words = _words(parameter, found, place)
        alarms.append(
            Alarm(parameter, Cause.SISTER, Severity.NOTICE, float(km[begin]), end_km, words)
        )
    return alarms


def _newest(size: FloatArray) -> int:
    return int(np.flatnonzero(np.isfinite(size))[-1])


def _words(parameter: str, found: _Compared, place: int) -> str:
    n, n_apart = int(found.n_sisters[place]), int(found.n_apart[place])
    level, median = math.exp(found.level[place]), math.exp(found.median[place])
    percent = 100 * (level / median - 1)
    which = "-one" if n == 1 else "-some" if 2 * n_apart == n + 1 else ""
    return Finding(
        f"sister-{'below' if percent < 0 else 'above'}{which}",
        part=part_words(parameter),
        percent=abs(percent),
        own=100 * level,
        other=100 * median,
        n_apart=n_apart,
        n=n,
    )


def alarms_of_sisters(series: Sequence[Series], settings: SisterSettings) -> dict[Key, list[Alarm]]:
    """Return the alarms of each suspension that differs, or differed, from its sisters.

    Flagged trips, and those before a suspension's last commissioning or maintenance, are ignored.
    """
    found: dict[Key, list[Alarm]] = {}
    for car in of_same_car(series):
        names = dict.fromkeys(name for one in car for name in one.estimates)
        for parameter in (name for name in names if kind_of(name) in settings.least_percent):
            those = [one for one in car if parameter in one.estimates]
            alarms = sister_alarms(parameter, [_sister(one, parameter) for one in those], settings)
            for one, own in zip(those, alarms, strict=True):
                if own:
                    found.setdefault((one.vehicle, one.place), []).extend(own)
    return found


def _sister(one: Series, parameter: str) -> Sister:
    used = one.recent & ~one.flagged
    return Sister(
        one.mileage_km[used], one.estimates[parameter][used], one.half_widths[parameter][used]
    )
