"""Detection of changes along the mileage, with a stated rate of false alarms."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from suspnet.ground.findings import Finding
from suspnet.ground.settings import LARGEST, Checked, setting
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.trains.maintenance import cusum

N_BACK = 5  # least number of trips whose median must be back near the reference for a change to end
BACK = 0.25  # a change has ended when the median deviation is below this share of its size
SURE = 8.0
"""A change ends only after enough trips that the standard error of their mean is at most the size
of the change over this."""
LONGEST_GAP = 2e4
"""Largest mileage between two trips that counts, [km]: a long pause allows no extra false alarm."""
VARIES = 0.01
"""Least relative standard deviation of a covariate that is used, also after regression on the
others."""


@dataclass(frozen=True)
class ChangeSettings(Checked):
    """Settings of the change detector; ValueError if one is out of range."""

    km_per_false_alarm: float = setting(
        1e6,
        "Mileage of a healthy suspension in which one false alarm of a change is expected at "
        "most, over all its parameters",
        "km",
        low=1000,
        high=1e9,
    )
    least_percent: float = setting(
        0.1, "Smallest change that is reported", "% of healthy", low=0, below=100
    )


@dataclass(frozen=True)
class Change:
    """A change of one parameter, by indices of trips.

    `onset` is the most likely first trip, `begin` the trip that raised the alarm, `end` the trip at
    which the parameter was back (None: the change lasts). `percent` is the median deviation from
    the expected value, from onset to alarm.
    """

    onset: int
    begin: int
    end: int | None
    percent: float


@dataclass(frozen=True)
class Changes:
    """Changes of the parameters of one suspension, as ``find_changes`` returns them.

    `by_parameter` has the changes of each parameter in the order of the trips, `covariates` the
    names of those that were used. `n_reference` counts the usable trips so far, of which detection
    needs `n_needed`. `n_unlike` trips are not judged, as a covariate is missing or unlike the
    reference. `why_not` is why nothing can be detected; empty if it can.
    """

    by_parameter: dict[str, list[Change]] = field(default_factory=dict)
    covariates: tuple[str, ...] = ()
    n_reference: int = 0
    n_needed: int = 0
    n_unlike: int = 0
    why_not: str = ""


def find_changes(
    mileage_km: ArrayLike,
    values: Mapping[str, ArrayLike],
    covariates: Mapping[str, ArrayLike],
    settings: ChangeSettings,
    *,
    usable: ArrayLike | None = None,
    widths: Mapping[str, ArrayLike] | None = None,
) -> Changes:
    """Return the changes of the parameters of one suspension since its last maintenance.

    A CUSUM of each parameter's deviations from earlier trips (``residuals``) raises an alarm at the
    ``threshold`` for a false-alarm rate that all parameters share. The rate per trip follows from
    the mean spacing of the latest trips, so that later ones change neither whether nor when an
    alarm is raised. If the interval of a trip is wider than the median one of the reference, its
    deviation is divided by their ratio. A change has ended when the median deviation of ``N_BACK``
    trips is below ``BACK`` times its size, of more trips if their mean is uncertain (``SURE``). The
    detector then starts again without the trips of the change.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        Ascending; NaN: not used.
    values : mapping from parameter to array of shape (n_trips,), [-]
        Relative to healthy; NaN: no estimate.
    covariates : mapping from name to array of shape (n_trips,)
        Ignored if, in the reference, constant, a linear combination of the others, or missing for a
        trip. Later trips that lack a covariate in use are not judged.
    settings : ChangeSettings
    usable : bool array of shape (n_trips,), optional
        Trips to use, such as those without flags. All by default.
    widths : mapping from parameter to array of shape (n_trips,), [-], optional
        Half-widths of the intervals, in logarithms.

    Raises
    ------
    ValueError
        If shapes differ, no parameter is given, or the mileage falls.
    """
    km, widths = np.asarray(mileage_km, dtype=float), widths or {}
    marks = {} if usable is None else {"usable": usable}
    columns = {"values": values, "covariates": covariates, "widths": widths, "usable": marks}
    if not values or km.ndim != 1:
        raise ValueError("`values` must have one parameter at least, `mileage_km` one dimension")
    for kind, several in columns.items():
        for name, column in several.items():
            if np.shape(column) != km.shape:
                raise ValueError(
                    f"`{kind}` must have {len(km)} trips each, got {np.shape(column)} for {name}"
                )
    if (np.diff(km[np.isfinite(km)]) < 0).any():
        raise ValueError("`mileage_km` must ascend")
    # a trip counts for all parameters or for none
    names = tuple(values)
    estimates = np.stack([np.asarray(values[name], dtype=float) for name in names], axis=-1)
    good = np.isfinite(km) & (np.isfinite(estimates) & (estimates > 0)).all(axis=-1)
    if usable is not None:
        good &= np.asarray(usable, dtype=bool)
    trips = np.flatnonzero(good)
    needed = cusum.N_REFERENCE
    if len(trips) < needed:
        why = Finding("reference-incomplete", n_trips=len(trips), needed=needed)
        return Changes(n_reference=len(trips), n_needed=needed, why_not=why)
    used_names, z, has_all = _covariates(covariates, trips, needed)
    n_lacking = int((~has_all).sum())
    trips, z = trips[has_all], z[has_all]
    # all parameters at once against their references; each then has its own CUSUM
    judged = _Judged(trips, z, _limits(km[trips], len(names), settings), settings)
    logs = np.log(estimates[trips])
    rest = cusum.residuals(logs, np.repeat(z[:, None], len(names), 1), needed)
    by_parameter = {
        name: _changes_of(
            judged, logs[:, i], _relative_widths(widths.get(name), trips, needed), rest.of(i)
        )
        for i, name in enumerate(names)
    }
    n_unlike = n_lacking + int((rest.leverage > 1).any(axis=-1).sum())
    return Changes(by_parameter, used_names, len(trips), needed, n_unlike)


@dataclass(frozen=True)
class _Judged:
    """The usable trips: their indices, covariates (n_trips, n_covariates) and thresholds."""

    trips: IntArray
    covariates: FloatArray
    limits: FloatArray
    settings: ChangeSettings


def _limits(km: FloatArray, n_parameters: int, settings: ChangeSettings) -> FloatArray:
    """Return the threshold at each trip, starting with the last one of the reference.

    The rate per trip uses a moving mean of the gaps. Each gap enters it equally often, so the
    expected number of false alarms per km does not depend on the spacing of the trips.
    """
    n_gaps = cusum.N_REFERENCE - 1
    counted = np.cumsum(np.minimum(np.diff(km, prepend=km[0]), LONGEST_GAP))
    spacing = np.maximum((counted[n_gaps:] - counted[:-n_gaps]) / n_gaps, 1.0)
    return cusum.threshold(np.minimum(spacing / settings.km_per_false_alarm / n_parameters, 0.05))


def _changes_of(
    judged: _Judged, logs: FloatArray, widths: FloatArray, rest: cusum.Residuals
) -> list[Change]:
    """Return the changes of one parameter; arrays have one entry for each usable trip."""
    changes = []
    trips, needed = judged.trips, cusum.N_REFERENCE
    used = np.arange(len(logs))
    start = needed
    for _ in range(len(logs)):  # each turn ends, or leaves out a trip
        # trips too unlike the reference are not judged
        standard = np.where(rest.leverage > 1, 0, rest.standard)[start - needed :]
        alarm = _first(
            standard / widths[used[start:]],
            rest.deviations[start - needed :],
            judged.limits[used[start:] - needed + 1],
            judged.settings.least_percent,
        )
        if alarm is None:
            break
        onset, begin, size = alarm[0] + start, alarm[1] + start, alarm[2]
        # deviations from the reference as it was at the alarm: later trips must not change it
        n_known = max(needed, min(onset, int(rest.n_reference[begin - needed])))
        usual = np.concatenate([np.ones(needed, bool), rest.usual])[:n_known]
        x = np.concatenate([np.ones((len(used), 1)), judged.covariates[used]], axis=1)
        fit = np.linalg.lstsq(x[:n_known][usual], logs[used][:n_known][usual], rcond=None)[0]
        away = logs[used] - x @ fit
        spread = float(away[:n_known][usual].std())
        last = _end(away, begin, size, spread, float(rest.correlation[begin - needed]))
        changes.append(
            Change(
                int(trips[used[onset]]),
                int(trips[used[begin]]),
                None if last is None else int(trips[used[last]]),
                100 * float(np.expm1(min(size, 700))),  # of a double
            )
        )
        if last is None:
            break
        # start again without the trips of the change
        used = np.delete(used, np.arange(onset, last + 1))
        start = onset
        if start >= len(used):
            break
        rest = cusum.residuals(logs[used][:, None], judged.covariates[used][:, None], needed).of(0)
    return changes


def _end(away: FloatArray, begin: int, size: float, spread: float, phi: float) -> int | None:
    """Return the trip after `begin` at which a change has ended, or None; `away`: (n_trips,).

    The mean of n trips has the variance spread^2 (1 + phi) / (1 - phi) / n.
    """
    n_sure = (SURE * spread / max(abs(size), 1e-9)) ** 2 * (1 + phi) / (1 - phi)
    n_back = max(N_BACK, int(np.ceil(min(n_sure, len(away)))))
    if len(away) - begin <= n_back:
        return None
    medians = np.median(sliding_window_view(away[begin + 1 :], n_back), axis=-1)
    back = np.flatnonzero(np.abs(medians) < BACK * abs(size))
    return begin + int(back[0]) + n_back if len(back) else None


def _first(
    standard: FloatArray, deviations: FloatArray, limits: FloatArray, least: float
) -> tuple[int, int, float] | None:
    """Return onset, alarm and size (in logarithms) of the first change of at least `least` %.

    The onset maximises (sum z)^2 / n over the trips since the CUSUM was last zero.
    """
    sums = cusum.cusum(standard)
    z = np.clip(standard, -cusum.CLIP, cusum.CLIP)
    for begin in np.flatnonzero((sums > limits).any(axis=0)):
        side = int(np.argmax(sums[:, begin]))
        zeros = np.flatnonzero(sums[side, :begin] == 0)
        since = int(zeros[-1]) + 1 if len(zeros) else 0
        totals = np.cumsum(z[since : begin + 1][::-1])
        onset = int(begin - np.argmax(totals**2 / np.arange(1, len(totals) + 1)))
        size = float(np.median(deviations[onset : begin + 1]))
        if abs(100 * np.expm1(min(size, 700))) >= least:
            return onset, int(begin), size
    return None


def _covariates(
    values_of: Mapping[str, ArrayLike], trips: IntArray, needed: int
) -> tuple[tuple[str, ...], FloatArray, BoolArray]:
    """Return names and values of the usable covariates, and which trips have all of them.

    Values are standardised by the reference, (n_trips, n_covariates).
    """
    names, columns, has_all = [], [np.ones(len(trips))], np.ones(len(trips), dtype=bool)
    for name, values in values_of.items():
        column = np.asarray(values, dtype=float)[trips]
        is_known = np.abs(column) < LARGEST  # False for NaN
        if not is_known[:needed].all():
            continue
        mean, spread = float(column[:needed].mean()), float(column[:needed].std())
        if spread <= VARIES * max(abs(mean), 1e-9):
            continue
        column = np.where(is_known, (column - mean) / spread, 0)
        others = np.stack(columns, axis=-1)[:needed]
        fit = np.linalg.lstsq(others, column[:needed], rcond=None)[0]
        if (column[:needed] - others @ fit).std() > VARIES:
            names.append(name)
            columns.append(column)
            has_all &= is_known
    used = np.stack(columns[1:], axis=-1) if names else np.empty((len(trips), 0))
    return tuple(names), used, has_all


def _relative_widths(widths: ArrayLike | None, trips: IntArray, needed: int) -> FloatArray:
    """Return each trip's interval width over the median one of the reference, at least 1."""
    if widths is None:
        return np.ones(len(trips))
    clipped = np.clip(np.asarray(widths, dtype=float)[trips], 1e-12, LARGEST)
    if not np.isfinite(clipped[:needed]).any():
        return np.ones(len(trips))
    usual = float(np.nanmedian(clipped[:needed]))
    return np.asarray(np.maximum(np.nan_to_num(clipped / usual, nan=1.0), 1.0))
