"""A suspension along its mileage, as plain data for figures.

All values are in % of healthy, all mileages in km.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import BODY_MASS, Severity
from suspnet.ground.records import INTERVAL_LEVEL, Commissioning, TripResult, by_mileage
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import kilometres, thousands
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.judge import ABSURD
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.state import State

TRIP_COLOUR, FLAGGED_COLOUR, MISSING_COLOUR = "#3b82c4", "#9467bd", "#d64545"
LIMIT_COLOURS = {"notice": "#d9822b", "act": "#d64545"}
TRIP, FLAGGED, MISSING = "trip", "flagged: see the table", "trip without an estimate"
MEDIAN, BEYOND = "median of five neighbouring trips", "beyond the axis"
PASSING = "act limit will be passed (80 %)"
MAINTENANCE, AGAIN = "maintenance", "commissioned again"
AGAIN_OF_FIRST = f"{AGAIN}; % is of the first healthy values"
LEAST_SPAN_PERCENT = 2.0
"""Smallest span of a parameter's axis, [%], so that spread does not look like change."""
MARGIN = 0.05  # share of the span that stays free above and below


@dataclass(frozen=True, eq=False)
class Points:
    """One parameter of several trips by mileage; NaN is unknown.

    Arrays are (n_trips,); `intervals` is (n_trips, 2). The truth is that of simulated trips.
    """

    trips: NDArray[np.str_]
    km: FloatArray
    values: FloatArray
    intervals: FloatArray
    flagged: BoolArray
    truth: FloatArray

    def chosen(self, which: BoolArray) -> Points:
        """Return some of the trips."""
        return Points(**{name: column[which] for name, column in vars(self).items()})


@dataclass(frozen=True)
class Passing:
    """Mileages where the act limit will be passed: the 80 % interval and its median."""

    low_km: float
    median_km: float
    high_km: float

    def __str__(self) -> str:
        ends = {name.removesuffix("_km"): km for name, km in vars(self).items()}
        texts = {name: thousands(km) if np.isfinite(km) else "no end" for name, km in ends.items()}
        return Finding("passes", **texts)


@dataclass(frozen=True, eq=False)
class Panel:
    """One parameter along the mileage.

    `points` are trips with an estimate; the intervals of flagged trips are NaN. `missing_km` are
    trips without an estimate. `limits` are pairs of kind ("notice" or "act") and value. `act` is
    the act limit that the parameter has passed or will pass. `axis` is the range of the figure.
    """

    name: str
    points: Points
    missing_km: FloatArray
    truth_km: FloatArray
    truth: FloatArray
    limits: tuple[tuple[str, float], ...]
    alarms: tuple[Alarm, ...]
    passing: Passing | None
    act: float | None
    axis: tuple[float, float]
    severity: Severity


@dataclass(frozen=True, eq=False)
class MileageTrend:
    """A suspension along its mileage.

    `km` are the mileages of all trips, ascending; `events` pairs of mileage and text of each
    maintenance; `again_km` the later commissionings, and `again` their label. `n_unplaced` trips
    have no mileage and are not shown. `level` is the probability of the intervals.
    """

    panels: tuple[Panel, ...]
    km: FloatArray
    events: tuple[tuple[float, str], ...] = ()
    again_km: tuple[float, ...] = ()
    again: str = AGAIN
    n_unplaced: int = 0
    level: float = INTERVAL_LEVEL


def trend_of_trips(
    results: Sequence[TripResult],
    state: State,
    outputs: Sequence[str],
    level: float = INTERVAL_LEVEL,
    commissionings: Sequence[Commissioning] = (),
) -> MileageTrend:
    """Return the trend of a report.

    `results` may have any order, and are relative to the first of several `commissionings`; the
    limits of their `state` are relative to the last one.
    """
    placed = [r for r in by_mileage(results) if np.isfinite(r.mileage_km)]
    # limits are relative to the last commissioning, the figure to the first
    now = commissionings[-1].relative if commissionings else {}
    panels = []
    for name in outputs:
        points = Points(
            np.array([r.trip for r in placed]),
            np.array([r.mileage_km for r in placed]),
            _percent([r.estimates.get(name, np.nan) for r in placed]),
            _percent([r.interval(name) for r in placed]).reshape(-1, 2),
            np.array([bool(r.flags) for r in placed], dtype=bool),
            _percent([r.truth.get(name, np.nan) for r in placed]),
        )
        panels.append(_panel(name, points, state, now.get(name, 1.0)))
    return MileageTrend(
        tuple(panels),
        np.array([r.mileage_km for r in placed]),
        _events(state),
        tuple(commissioning.since_km for commissioning in commissionings[1:]),
        AGAIN_OF_FIRST,
        len(results) - len(placed),
        level,
    )


def trend_of_state(state: State) -> MileageTrend:
    """Return the trend of a page, each trip relative to its own healthy values."""
    series = state.series
    placed = np.isfinite(series.mileage_km)
    panels = []
    for name in (name for name in series.outputs if name != BODY_MASS):
        values, half = series.estimates[name], series.half_widths[name]
        with np.errstate(over="ignore"):
            intervals = np.stack([values * np.exp(-half), values * np.exp(half)], axis=1)
        unknown = np.full(len(values), np.nan)
        numbers = series.mileage_km, 100 * values, 100 * intervals, series.flagged, unknown
        panels.append(_panel(name, Points(series.trip, *numbers).chosen(placed), state))
    since_km = series.healthy_since_km
    again_km = tuple(np.unique(since_km[np.isfinite(since_km)])[1:].tolist())
    return MileageTrend(tuple(panels), series.mileage_km[placed], _events(state), again_km)


def ranges(trend: MileageTrend) -> list[tuple[str, float, float]]:
    """Return useful ranges of the mileage to show: name, first and last km."""
    if len(trend.km) == 0:
        return []
    first, newest = float(trend.km.min()), float(trend.km.max())
    ahead = [panel.passing.high_km for panel in trend.panels if panel.passing]
    last = max([newest, *(km for km in ahead if np.isfinite(km))])
    last = min(last, newest + max(newest - first, 100_000.0))
    pad = 0.02 * max(last - first, 1000.0)
    shown = [("All", max(first - pad, min(first, 0.0)), last + pad)]
    if newest - first > 100_000:
        shown.append((f"Last {kilometres(100_000)}", newest - 100_000, newest + 2000))
    if len(trend.km) > 20:
        start = float(np.sort(trend.km)[-20])
        pad = 0.02 * max(newest - start, 1000.0)
        shown.append(("Last 20 trips", start - pad, newest + pad))
    return shown


def running_median(values: FloatArray, window: int = 5) -> FloatArray:
    """Return the median of the `window` values around each, fewer near the ends.

    There are as many before as after, so that the line follows a slope to its first and last value.
    `values`: (n_trips,), in the order of the mileage, without NaN; `window` is odd.
    """
    n = len(values)
    halves = [min(i, n - 1 - i, window // 2) for i in range(n)]
    return np.array([np.median(values[i - half : i + half + 1]) for i, half in enumerate(halves)])


def percent_words(value: float, form: str = ".0f") -> str:
    """Return a value in %, without the number if it is above any real suspension's."""
    return (
        f"{value:{form}} %"
        if value <= 100 * ABSURD
        else Finding("over-percent", percent=100 * ABSURD)
    )


def alarm_label(alarm: Alarm) -> str:
    """Return the label of a mark at the start of an alarm."""
    return Finding("start-of-alarm", severity=str(alarm.severity))


def _panel(name: str, points: Points, state: State, healthy: float = 1.0) -> Panel:
    """Return a parameter; `healthy` is the level in the figure that its limits are relative to."""
    is_estimated, has_truth = np.isfinite(points.values), np.isfinite(points.truth)
    shown = points.chosen(is_estimated)
    shown.intervals[shown.flagged | ~np.isfinite(shown.intervals).all(axis=1)] = np.nan
    limits, passing = state.limits.get(name), _passing(state.lives.get(name), state.last_km)
    act = None
    if limits and (passing or any(a.severity == Severity.ACT for a in state.alarms_of(name))):
        limit = limits.act[0] if state.now(name) < 1 else limits.act[1]
        act = 100 * healthy * limit if 0 < limit < np.inf else None
    return Panel(
        name,
        shown,
        points.km[~is_estimated],
        points.km[has_truth],
        points.truth[has_truth],
        tuple(
            (kind, 100 * healthy * value)
            for kind in LIMIT_COLOURS
            for value in getattr(limits, kind, ())
            if 0 < value < np.inf
        ),
        tuple(alarm for alarm in state.watched.alarms if alarm.parameter == name),
        passing,
        act,
        _axis(shown, act),
        state.severities.get(name, Severity.NONE),
    )


def _events(state: State) -> tuple[tuple[float, str], ...]:
    return tuple((event.mileage_km, event.words or event.kind) for event in state.series.events)


def _passing(life: Life | None, last_km: float) -> Passing | None:
    """Return where the act limit will be passed; None if it never is, or is already passed."""
    if life is None:
        return None
    low, high = life.interval_km()
    if not np.isfinite(last_km + low) or high <= 0:
        return None
    return Passing(last_km + low, last_km + life.quantile_km(0.5), last_km + high)


def _axis(points: Points, act: float | None) -> tuple[float, float]:
    """Return the range of an axis: all required values, and trips and intervals near these.

    One odd trip must not squeeze all others. The axis includes 100 %, a passed act limit, unflagged
    trips (all if all are flagged) and the running median between its ends, which follows a lasting
    change even if flagged, but no level above that of any real suspension. Other trips widen it by
    up to its span on each side, intervals by up to half of that.
    """
    clear = ~points.flagged if not points.flagged.all() else np.ones(len(points.km), dtype=bool)
    held = np.append(points.values[clear], running_median(points.values)[1:-1])
    truth = points.truth[clear]
    base = np.concatenate([[100.0], np.minimum(held, 100 * ABSURD), truth[np.isfinite(truth)]])
    base = base if act is None else np.append(base, act)
    low, high = base.min(), base.max()
    span = max(high - low, LEAST_SPAN_PERCENT)
    near = points.values[(points.values >= low - span) & (points.values <= high + span)]
    ends = points.intervals[np.isfinite(points.intervals)].clip(low - span / 2, high + span / 2)
    wide = np.concatenate([[low, high], near, ends])
    middle, size = (wide.min() + wide.max()) / 2, wide.max() - wide.min()
    half = max((1 + 2 * MARGIN) * size, LEAST_SPAN_PERCENT) / 2
    return float(middle - half), float(middle + half)


def _percent(ratios: Sequence[object]) -> FloatArray:
    return 100 * np.array(ratios, dtype=float)
