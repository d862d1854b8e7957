"""Comparison of sister suspensions: one that differs from the others of its car has changed.

Values are relative to each suspension's own healthy value, so healthy sisters are alike;
common-mode changes, for example from cold or load, are not reported. With L_i the mean logarithm of
the last ``N_LAST`` values of suspension i, and n sisters,

    d_i = L_i - median_j L_j,    var d_i = C (sigma_i^2 + min(1, pi / 2n) mean_j sigma_j^2),

where j runs over the sisters, sigma_i is the standard deviation of a trip with that of the healthy
value, and C sigma_i^2 the variance of the mean of correlated trips. An alarm starts where |d_i|
exceeds both the least difference and Student's quantile times sqrt(var d_i).
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
from suspnet.trains.maintenance.alarms import Alarm, spans
from suspnet.trains.maintenance.noise import robust_spread
from suspnet.trains.maintenance.series import N_LAST, Series, of_same_car

CORRELATION = 0.5
"""Largest assumed correlation between the errors of successive trips."""
OF_STEPS = 2 * (1 - CORRELATION)
"""Variance of the difference of successive trips over that of a trip."""
_LAGS = np.arange(1, N_LAST)
OF_MEAN = float(1 + 2 * np.sum((1 - _LAGS / N_LAST) * CORRELATION**_LAGS)) / N_LAST
"""C, the variance of the mean of ``N_LAST`` correlated trips over that of one."""
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
    """Settings of the comparison of sister suspensions; TypeError or ValueError if out of range."""

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
    """One parameter of one suspension, to be compared with its sisters; arrays are (n_trips,).

    `mileage_km` ascends. `values` [-] are relative to healthy (NaN: no estimate, or a flagged one),
    `half_widths` [-] those of their intervals, with the healthy value's, in logarithms (NaN: none).
    """

    mileage_km: FloatArray
    values: FloatArray
    half_widths: FloatArray

    def usable(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mileage, logarithms and half-widths of the trips with an estimate."""
        values, halves = (np.asarray(x, dtype=float) for x in (self.values, self.half_widths))
        usable = np.isfinite(self.mileage_km) & np.isfinite(values) & (values > 0)
        km = np.asarray(self.mileage_km, dtype=float)[usable]
        return km, np.log(values[usable]), np.nan_to_num(halves[usable], posinf=np.inf)


def sister_alarms(
    parameter: str, sisters: Sequence[Sister], settings: SisterSettings
) -> list[list[Alarm]]:
    """Return the alarms of each suspension of a car, active or cleared, as its trips raised them.

    An alarm uses only the trips up to its own, so later trips do not change it. It ends where the
    difference is below half of the threshold. The severity is always a notice: limits determine
    which part is worn and how far. None is compared if there is only one suspension.

    The false-alarm rate of a healthy suspension is at most one in `km_per_false_alarm` if errors
    are normal, correlated by at most ``CORRELATION`` from trip to trip, and scatter as the
    intervals or the first ``N_REFERENCE`` trips of all sisters show.
    """
    nothing: list[list[Alarm]] = [[] for _ in sisters]
    kind = kind_of(parameter)
    if len(sisters) < 2 or kind not in settings.least_percent:
        return nothing
    trips = [sister.usable() for sister in sisters]
    km = np.unique(np.concatenate([own_km for own_km, _, _ in trips]))
    if len(km) < N_LAST:
        return nothing
    n_compared = len(settings.least_percent) if kind == parameter else len(BOGIE_PARTS)
    pooled, quantiles = _pooled(trips, km, settings.km_per_false_alarm * n_compared)
    levels, variances = np.full((2, len(sisters), len(km)), np.nan)
    z = stats.norm.ppf((1 + settings.level) / 2)
    for i, own in enumerate(trips):
        if len(own[0]) >= N_LAST:
            levels[i], variances[i] = _level(own, km, pooled, z, settings.max_apart_km)
    least = -math.log1p(-settings.least_percent[kind] / 100)
    return [
        _alarms(parameter, km, _compared(i, levels, variances), quantiles, least)
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


_Trips = tuple[FloatArray, FloatArray, FloatArray]
"""Mileage, logarithms and half-widths of a suspension's trips."""


def _level(
    trips: _Trips, km: FloatArray, pooled: FloatArray, z: float, max_apart_km: float
) -> tuple[FloatArray, FloatArray]:
    """Return L and C sigma^2 of a suspension at each mileage, (n_km,); NaN: unknown."""
    own_km, logs, halves = trips
    n = np.searchsorted(own_km, km, side="right")  # trips up to each mileage
    is_known = (n >= N_LAST) & (km - own_km[np.maximum(n - 1, 0)] <= max_apart_km)
    last = np.clip(n - N_LAST, 0, len(logs) - N_LAST)
    windows = np.lib.stride_tricks.sliding_window_view(np.stack([logs, halves**2]), N_LAST, 1)
    level, square = windows.mean(axis=-1)[:, last]
    # the scatter is that of the intervals, of the own first trips or of all sisters' if larger;
    # differences of successive trips are insensitive to drifts and steps
    steps = np.abs(np.diff(logs[:N_REFERENCE]))
    scatter = np.full(N_REFERENCE + 1, np.nan)
    for size in range(N_LAST, N_REFERENCE + 1):
        scatter[size] = robust_spread(steps[: size - 1], OF_STEPS)
    own = scatter[np.minimum(n, N_REFERENCE)]
    sigma = np.fmax(np.sqrt(square) / z, np.fmax(own, pooled))
    return np.where(is_known, level, np.nan), np.where(is_known, OF_MEAN * sigma**2, np.nan)


def _pooled(
    several: Sequence[_Trips], km: FloatArray, km_per_false_alarm: float
) -> tuple[FloatArray, FloatArray]:
    """Return the scatter of the first trips of all sisters, and Student's quantile, (n_km,).

    Both are those of the trips up to each mileage.
    """
    size = np.concatenate([np.abs(np.diff(logs[:N_REFERENCE])) for _, logs, _ in several])
    end = np.concatenate([own_km[1:N_REFERENCE] for own_km, _, _ in several])
    scatter, degrees = np.full(len(km), np.nan), np.ones(len(km))
    for place in np.searchsorted(km, np.unique(end)).tolist():
        steps = size[end <= km[place]]
        scatter[place:] = robust_spread(steps, OF_STEPS)
        degrees[place:] = max(1.0, EFFICIENCY * len(steps))
    gap_km = (km - km[0]) / np.maximum(np.arange(len(km)), 1)
    probability = np.clip(gap_km / km_per_false_alarm, LOWEST_PROBABILITY, HIGHEST_PROBABILITY)
    return scatter, stats.t.isf(probability / 2, degrees)


def _compared(i: int, levels: FloatArray, variances: FloatArray) -> _Compared:
    others, own = np.delete(levels, i, axis=0), levels[i]
    is_known = np.isfinite(others)
    n = is_known.sum(axis=0)
    # the median of those that are known: the middle of the sorted ones, the unknown last
    ordered, column = np.sort(np.where(is_known, others, np.inf), axis=0), np.arange(len(own))
    middle = ordered[np.maximum(n - 1, 0) // 2, column], ordered[n // 2, column]
    median = np.where(n > 0, (middle[0] + middle[1]) / 2, np.nan)
    mean = np.nansum(np.delete(variances, i, axis=0), axis=0) / np.maximum(n, 1)
    variance = variances[i] + np.minimum(1.0, np.pi / 2 / np.maximum(n, 1)) * mean
    distant = is_known & (np.abs(others - own) > np.abs(own - median) / 2)
    return _Compared(own, median, np.sqrt(variance), n, distant.sum(axis=0))


def _alarms(
    parameter: str, km: FloatArray, compared: _Compared, quantiles: FloatArray, least: float
) -> list[Alarm]:
    size = np.abs(compared.level - compared.median)
    threshold = np.maximum(quantiles * compared.deviation, least)
    # most of its sisters are elsewhere, or half of them
    is_odd = 2 * compared.n_apart >= compared.n_sisters + 1
    alarms = []
    for begin, end in spans(is_odd & (size > threshold), size < threshold / 2):
        # an active alarm reports the newest difference, a cleared one its largest
        place, end_km = int(np.flatnonzero(np.isfinite(size))[-1]), math.nan
        if end is not None:
            place, end_km = begin + int(np.nanargmax(size[begin:end])), float(km[end])
        words = _words(parameter, compared, place)
        alarms.append(
            Alarm(parameter, Cause.SISTER, Severity.NOTICE, float(km[begin]), end_km, words)
        )
    return alarms


def _words(parameter: str, compared: _Compared, place: int) -> str:
    n, n_apart = int(compared.n_sisters[place]), int(compared.n_apart[place])
    level, median = math.exp(compared.level[place]), math.exp(compared.median[place])
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
    of_key: dict[Key, list[Alarm]] = {}
    for car in of_same_car(series):
        for parameter in dict.fromkeys(name for sister in car for name in sister.estimates):
            estimated = [sister for sister in car if parameter in sister.estimates]
            sisters = [_sister(sister, parameter) for sister in estimated]
            alarms = sister_alarms(parameter, sisters, settings)
            for sister, own in zip(estimated, alarms, strict=True):
                if own:
                    of_key.setdefault(sister.key, []).extend(own)
    return of_key


def _sister(series: Series, parameter: str) -> Sister:
    used = series.recent & ~series.flagged
    columns = series.mileage_km, series.estimates[parameter], series.half_widths[parameter]
    return Sister(*(column[used] for column in columns))
