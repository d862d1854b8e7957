"""Figures of a suspension along its mileage; all values are in % of healthy, mileages in km."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.ground import records
from suspnet.ground.findings import Finding
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, Severity
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.runs.figures import MILEAGE_LABEL, SYMBOLS, say
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.judge import ABSURD
from suspnet.trains.maintenance.state import State

TRIP_COLOUR, FLAGGED_COLOUR, MISSING_COLOUR = "#3b82c4", "#9467bd", "#d64545"
LIMIT_COLOURS = {"notice": "#d9822b", "act": "#d64545"}
AGAIN = "commissioned again"
AGAIN_OF_FIRST = f"{AGAIN}; % is of the first healthy values"
LEAST_SPAN_PERCENT = 2.0
"""Smallest span of a parameter's axis, [%], so that spread does not look like change."""
MARGIN = 0.05  # share of the span that stays free above and below
SMALL_INCHES = 4.0, 2.1  # size of the figure of one part, of which several are side by side
ONE_INCHES = 5.6, 3.4  # size of the figure of one finding, which is read on a phone too
LEFT_INCHES, BOTTOM_INCHES = 0.85, 0.5  # margins that hold percentages with two decimals
HOLLOW: dict[str, Any] = {"mfc": "none", "color": FLAGGED_COLOUR, "ls": ""}
AHEAD = 0.5  # largest share of the mileage so far by which a figure extends into the future


@dataclass(frozen=True, eq=False)
class Panel:
    """One parameter along the mileage; values are in % of healthy.

    `km`, `values` and `flagged` are (n_trips,), `intervals` (n_trips, 2), of the trips with an
    estimate; intervals of flagged trips are NaN. `missing_km` are trips without an estimate.
    `limits` are pairs of kind ("notice" or "act") and value. `passing_km` is the 80 % interval in
    which the act limit will be passed; None if it never is, or is passed already. `axis` is the
    range of the figure.
    """

    name: str
    km: FloatArray
    values: FloatArray
    intervals: FloatArray
    flagged: BoolArray
    missing_km: FloatArray
    limits: tuple[tuple[str, float], ...]
    alarms: tuple[Alarm, ...]
    passing_km: tuple[float, float] | None
    axis: tuple[float, float]
    severity: Severity


@dataclass(frozen=True, eq=False)
class MileageTrend:
    """A suspension along its mileage.

    `km` are the mileages of all trips; `maintenance_km` those of maintenance, `again_km` those of
    the later commissionings, and `again` their label. `n_unplaced` trips have no mileage and are
    not shown. `level` is the probability of the intervals.
    """

    panels: tuple[Panel, ...]
    km: FloatArray
    maintenance_km: tuple[float, ...] = ()
    again_km: tuple[float, ...] = ()
    again: str = AGAIN
    n_unplaced: int = 0
    level: float = records.INTERVAL_LEVEL


def trend_of_trips(
    results: Sequence[records.TripResult],
    state: State,
    outputs: Sequence[str],
    level: float = records.INTERVAL_LEVEL,
    commissionings: Sequence[records.Commissioning] = (),
) -> MileageTrend:
    """Return the trend of a report.

    `results` may have any order, and are relative to the first of several `commissionings`; the
    limits of their `state` are relative to the last one.
    """
    placed = [r for r in records.by_mileage(results) if np.isfinite(r.mileage_km)]
    km = np.array([r.mileage_km for r in placed])
    flagged = np.array([bool(r.flags) for r in placed], dtype=bool)
    now = commissionings[-1].relative if commissionings else {}
    panels = []
    for name in outputs:
        values = np.array([r.estimates.get(name, np.nan) for r in placed], dtype=float)
        intervals = np.array([r.interval(name) for r in placed], dtype=float).reshape(-1, 2)
        panels.append(_panel(name, state, km, values, intervals, flagged, now.get(name, 1.0)))
    return MileageTrend(
        tuple(panels),
        km,
        tuple(event.mileage_km for event in state.series.events),
        tuple(commissioning.since_km for commissioning in commissionings[1:]),
        AGAIN_OF_FIRST,
        len(results) - len(placed),
        level,
    )


def trend_of_state(state: State) -> MileageTrend:
    """Return the trend of a page, each trip relative to its own healthy values."""
    series = state.series
    placed = np.isfinite(series.mileage_km)
    km, flagged = series.mileage_km[placed], series.flagged[placed]
    panels = []
    for name in (name for name in series.outputs if name != BODY_MASS):
        values, half = series.estimates[name][placed], series.half_widths[name][placed]
        intervals = np.stack(records.interval_ends(values, half), axis=1)
        panels.append(_panel(name, state, km, values, intervals, flagged))
    since_km = series.healthy_since_km
    again_km = tuple(np.unique(since_km[np.isfinite(since_km)])[1:].tolist())
    maintenance_km = tuple(event.mileage_km for event in series.events)
    return MileageTrend(tuple(panels), km, maintenance_km, again_km)


def running_median(values: FloatArray) -> FloatArray:
    """Return the median of the five values around each, fewer near the ends.

    There are as many before as after, so that the line follows a slope to its first and last value.
    `values`: (n_trips,), in the order of the mileage, without NaN.
    """
    n = len(values)
    halves = [min(i, n - 1 - i, 2) for i in range(n)]
    return np.array([np.median(values[i - half : i + half + 1]) for i, half in enumerate(halves)])


def _panel(
    name: str,
    state: State,
    km: FloatArray,
    values: FloatArray,
    intervals: FloatArray,
    flagged: BoolArray,
    healthy: float = 1.0,
) -> Panel:
    """Return a parameter of ratios; `healthy` is the level that its limits are relative to."""
    is_estimated = np.isfinite(values)
    shown, ends = 100 * values[is_estimated], 100 * intervals[is_estimated]
    flagged_shown = flagged[is_estimated]
    ends[flagged_shown | ~np.isfinite(ends).all(axis=1)] = np.nan
    limits, life, passing_km = state.limits.get(name), state.lives.get(name), None
    if life is not None:
        low_km, high_km = (state.last_km + km for km in life.interval_km())
        if np.isfinite(low_km) and high_km > state.last_km:
            passing_km = low_km, high_km
    # the axis holds the act limit that the parameter has passed or will pass
    act = np.nan
    if limits and (passing_km or any(a.severity == Severity.ACT for a in state.alarms_of(name))):
        limit = limits.act[0] if state.now(name) < 1 else limits.act[1]
        act = 100 * healthy * limit if 0 < limit < np.inf else np.nan
    return Panel(
        name,
        km[is_estimated],
        shown,
        ends,
        flagged_shown,
        km[~is_estimated],
        tuple(
            (kind, 100 * healthy * value)
            for kind in LIMIT_COLOURS
            for value in getattr(limits, kind, ())
            if 0 < value < np.inf
        ),
        tuple(alarm for alarm in state.watched.alarms if alarm.parameter == name),
        passing_km,
        _axis(shown, ends, flagged_shown, act),
        state.severities.get(name, Severity.NONE),
    )


def _axis(
    values: FloatArray, intervals: FloatArray, flagged: BoolArray, act: float
) -> tuple[float, float]:
    """Return the range of an axis: all required values, and trips and intervals near these.

    One odd trip must not squeeze all others. The axis includes 100 %, the limit `act` unless it is
    NaN, unflagged trips (all if all are flagged) and the running median between its ends, which
    follows a lasting change even if flagged, but no level above that of any real suspension. Other
    trips widen it by up to its span on each side, intervals by up to half of that.
    """
    clear = np.ones(len(values), dtype=bool) if flagged.all() else ~flagged
    levels = np.append(values[clear], running_median(values)[1:-1])
    base = np.concatenate([[100.0, act], np.minimum(levels, 100 * ABSURD)])
    low, high = np.nanmin(base), np.nanmax(base)
    span = max(high - low, LEAST_SPAN_PERCENT)
    near = values[(values >= low - span) & (values <= high + span)]
    ends = intervals[np.isfinite(intervals)].clip(low - span / 2, high + span / 2)
    wide = np.concatenate([[low, high], near, ends])
    middle, size = (wide.min() + wide.max()) / 2, wide.max() - wide.min()
    half = max((1 + 2 * MARGIN) * size, LEAST_SPAN_PERCENT) / 2
    return float(middle - half), float(middle + half)


def small_trends(trend: MileageTrend) -> dict[str, Figure]:
    """Draw a figure of each parameter with a finding, and of each part of a bogie.

    Those without a finding are small. All have the same range of mileages.
    """
    has_parts = any(panel.name in BOGIE_PARTS for panel in trend.panels)
    figures = {
        panel.name: health_trend(replace(trend, panels=(panel,)), panel.severity == Severity.NONE)
        for panel in trend.panels
        if has_parts or panel.severity > Severity.NONE
    }
    ends = [figure.axes[0].get_xlim() for figure in figures.values()]
    for figure in figures.values():
        figure.axes[0].set_xlim(min(low for low, _ in ends), max(high for _, high in ends))
    return figures


def health_trend(trend: MileageTrend, is_small: bool = False) -> Figure:
    """Draw each parameter in % of healthy along the mileage (Fig. 10).

    Dots are trips with their interval, the line is the running median of all; a flagged trip is
    hollow. A red tick at the bottom is a trip without an estimate, a triangle at the top the start
    of an alarm. Dashed lines are limits within the axis. A bar at the bottom is the range in which
    the act limit will be passed, as far as it lies in the figure, which grows by half of its
    mileage at most. Trips without a mileage are left out, and counted in the title. A small figure
    has no legend.
    """
    n = len(trend.panels)
    size = SMALL_INCHES if is_small else ONE_INCHES if n == 1 else (7.0, 1.0 + 1.7 * n)
    figure = Figure(figsize=size)
    axes: list[Axes] = list(figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0])
    for axis, panel in zip(axes, trend.panels, strict=True):
        kind = "of-nominal-axis" if panel.name == BODY_MASS else "of-healthy-axis"
        axis.set_ylabel(Finding(kind, symbol=SYMBOLS[panel.name]))
        if len(panel.km):
            _draw_trips(axis, panel, trend.level)
            _draw_levels(axis, panel)
            _mark_beyond(axis, panel)
        else:
            say(axis, "no trip with an estimate and a mileage", keep_x=len(trend.km) > 0)
        _mark_edges(axis, panel)
        for km in trend.again_km:
            axis.axvline(km / 1000, color="0.3", lw=0.9, ls="-.", label=trend.again)
        for km in trend.maintenance_km:
            axis.axvline(km / 1000, color="0.3", lw=0.9, ls=":", label="maintenance")
    # last, as it extends the common axis into the future
    if len(trend.km):
        _draw_passing(axes, trend)
    axes[-1].set_xlabel(MILEAGE_LABEL)
    figure.align_ylabels(axes)
    n_lines = 0
    if is_small:
        axes[0].set_ylabel(axes[0].get_ylabel().partition("[")[2].rstrip("]"))
    else:
        n_lines = _legend(figure, axes)
    # not "constrained", which takes half of the time of drawing
    width, height = size
    figure.subplots_adjust(
        left=LEFT_INCHES / width,
        right=1 - 0.1 / width,
        bottom=BOTTOM_INCHES / height,
        top=1 - (0.25 + 0.21 * n_lines) / height,
        hspace=0.12,
    )
    if trend.n_unplaced:
        axes[0].set_title(Finding("unplaced-trips", n_unplaced=trend.n_unplaced), fontsize="small")
    return figure


def _draw_trips(axis: Axes, panel: Panel, level: float) -> None:
    clear, thousands_km = ~panel.flagged, panel.km / 1000
    style: dict[str, Any] = {"color": TRIP_COLOUR}
    if clear.any():
        axis.plot(thousands_km[clear], panel.values[clear], ".", ms=6, label="trip", **style)
    has_interval = np.isfinite(panel.intervals[:, 0])
    if has_interval.any():
        ends = panel.intervals[has_interval].T
        words = Finding("interval", level=100 * level)
        axis.vlines(thousands_km[has_interval], *ends, label=words, alpha=0.5, lw=0.9, **style)
    if not clear.all():
        values, label = panel.values[~clear], "flagged: see the table"
        axis.plot(thousands_km[~clear], values, "o", ms=4.5, label=label, **HOLLOW)
    if len(thousands_km) > 2:
        median, label = running_median(panel.values), "median of five neighbouring trips"
        axis.plot(thousands_km, median, alpha=0.6, label=label, **style)


def _draw_levels(axis: Axes, panel: Panel) -> None:
    """Set the range of the axis, and draw the healthy level and the limits within it."""
    low, high = panel.axis
    axis.set_ylim(low, high)
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.axhline(100, color="0.6", lw=0.8, ls=":", zorder=0)
    axis.grid(True, alpha=0.3)
    for kind, value in panel.limits:
        if low < value < high:
            colour = LIMIT_COLOURS[kind]
            axis.axhline(value, color=colour, lw=0.9, ls="--", label=f"{kind} limit", zorder=0)


def _mark_beyond(axis: Axes, panel: Panel) -> None:
    """Mark trips beyond the axis at its edge, with their value unless no suspension has it."""
    values, edges = panel.values, axis.get_xaxis_transform()
    ends = (values < panel.axis[0], "v", 0), (values > panel.axis[1], "^", 1)
    for beyond, marker, edge in ends:
        for km, value in zip(panel.km[beyond] / 1000, values[beyond], strict=True):
            style: dict[str, Any] = {"ms": 6, "clip_on": False, "transform": edges, **HOLLOW}
            axis.plot(km, edge, marker, label="beyond the axis", **style)
            text: str = f"{value:.0f} %"
            if value > 100 * ABSURD:
                text = Finding("over-percent", percent=100 * ABSURD)
            place: dict[str, Any] = {"xycoords": edges, "textcoords": "offset points"}
            place |= {"va": "top" if edge else "bottom", "color": FLAGGED_COLOUR}
            offset = (6, -2 if edge else 2)
            axis.annotate(text, (km, edge), offset, fontsize="x-small", **place)


def _mark_edges(axis: Axes, panel: Panel) -> None:
    """Mark trips without an estimate at the bottom of an axis, and alarms at its top."""
    style: dict[str, Any] = {"transform": axis.get_xaxis_transform(), "clip_on": False}
    if len(panel.missing_km):
        tick = style | {"ms": 12, "mew": 2, "color": MISSING_COLOUR}
        bottom = np.zeros(len(panel.missing_km))
        label = "trip without an estimate"
        axis.plot(panel.missing_km / 1000, bottom, "|", label=label, **tick)
    for alarm in panel.alarms:
        severity = str(alarm.severity)
        style |= {"color": LIMIT_COLOURS[severity]}
        style |= {"label": Finding("start-of-alarm", severity=severity)}
        axis.plot(alarm.begin_km / 1000, 1, "v", ms=7, **style)


def _draw_passing(axes: Sequence[Axes], trend: MileageTrend) -> None:
    """Draw when the act limits will be passed, and extend the axis for it."""
    last = trend.km.max()
    most = last + AHEAD * (last - trend.km.min())
    shown = [
        (axis, panel.passing_km[0], min(panel.passing_km[1], most))
        for axis, panel in zip(axes, trend.panels, strict=True)
        if panel.passing_km and panel.passing_km[0] < most
    ]
    style: dict[str, Any] = {"color": LIMIT_COLOURS["act"], "lw": 5, "alpha": 0.5}
    style |= {"solid_capstyle": "butt", "label": "act limit will be passed (80 %)"}
    for axis, low, high in shown:
        ends = [low / 1000, high / 1000]
        axis.plot(ends, [0.06, 0.06], transform=axis.get_xaxis_transform(), **style)
    if shown:
        axes[0].set_xlim(right=max(high for *_, high in shown) / 1000)


def _legend(figure: Figure, axes: Sequence[Axes]) -> int:
    """Label every kind of mark once, above the axes; return the number of lines."""
    marks: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            marks.setdefault(label, handle)
    n_columns = 3 if len(axes) > 1 else 2
    if marks:
        place: dict[str, Any] = {"loc": "upper center", "fontsize": "small"}
        figure.legend(list(marks.values()), list(marks), ncols=n_columns, **place)
    return -(-len(marks) // n_columns)
