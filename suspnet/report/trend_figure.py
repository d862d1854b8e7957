"""A suspension along its mileage as a matplotlib figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.ground.parameters import PAYLOAD
from suspnet.report.figures import MILEAGE_LABEL, SYMBOLS, say
from suspnet.report.trend import (
    BEYOND,
    FLAGGED,
    FLAGGED_COLOUR,
    LIMIT_COLOURS,
    MAINTENANCE,
    MEDIAN,
    MISSING,
    MISSING_COLOUR,
    PASSING,
    TRIP,
    TRIP_COLOUR,
    Panel,
    Points,
    Trend,
    alarm_label,
    percent_words,
    running_median,
)

HOLLOW: dict[str, Any] = {"mfc": "none", "color": FLAGGED_COLOUR, "ls": ""}
AHEAD = 0.5
"""Largest share of the mileage so far by which a figure extends into the future."""


def health_trend(trend: Trend) -> Figure:
    """Draw each parameter in % of healthy along the mileage (Fig. 10).

    Dots are trips with their interval, the line is the running median of all; a flagged trip is
    hollow. A red tick at the bottom is a trip without an estimate, a thin black line the truth of
    simulated trips, a triangle at the top the start of an alarm. Dashed lines are limits within the
    axis. A bar at the bottom is the range in which the act limit will be passed, as far as it lies
    in the figure, which grows by half of its mileage at most. Trips without a mileage are left out,
    and counted in the title.
    """
    n = len(trend.panels)
    figure = Figure(figsize=(7.0, 1.0 + 1.7 * n), layout="constrained")
    axes: list[Axes] = list(figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0])
    for axis, panel in zip(axes, trend.panels, strict=True):
        what = "nominal" if panel.name == PAYLOAD else "healthy"
        axis.set_ylabel(f"{SYMBOLS[panel.name]} [% of {what}]")
        if len(panel.points.km):
            _draw_trips(axis, panel.points, trend.level)
            _draw_levels(axis, panel)
            _mark_beyond(axis, panel)
        else:
            say(axis, "no trip with an estimate and a mileage", keep_x=len(trend.km) > 0)
        _mark_edges(axis, panel)
        for km in trend.again_km:
            axis.axvline(km / 1000, color="0.3", lw=0.9, ls="-.", label=trend.again)
        for km, _ in trend.events:
            axis.axvline(km / 1000, color="0.3", lw=0.9, ls=":", label=MAINTENANCE)
    if len(trend.km):
        _draw_passing(axes, trend)
    axes[-1].set_xlabel(MILEAGE_LABEL)
    figure.align_ylabels(axes)
    _legend(figure, axes)
    if trend.n_unplaced:
        axes[0].set_title(f"without a mileage, not shown: {trend.n_unplaced}", fontsize="small")
    return figure


def _draw_trips(axis: Axes, points: Points, level: float) -> None:
    clear, thousands_km = ~points.flagged, points.km / 1000
    style: dict[str, Any] = {"color": TRIP_COLOUR}
    if clear.any():
        axis.plot(thousands_km[clear], points.values[clear], ".", ms=6, label=TRIP, **style)
    known = np.isfinite(points.intervals[:, 0])
    if known.any():
        label = f"its {100 * level:g} % interval"
        ends = points.intervals[known].T
        axis.vlines(thousands_km[known], *ends, label=label, alpha=0.5, lw=0.9, **style)
    if not clear.all():
        values = points.values[~clear]
        axis.plot(thousands_km[~clear], values, "o", ms=4.5, label=FLAGGED, **HOLLOW)
    if len(thousands_km) > 2:
        axis.plot(thousands_km, running_median(points.values), alpha=0.6, label=MEDIAN, **style)


def _draw_levels(axis: Axes, panel: Panel) -> None:
    """Set the range of the axis, and draw truth, healthy level and the limits within it."""
    low, high = panel.axis
    if len(panel.truth):
        style: dict[str, Any] = {"lw": 0.8} if len(panel.truth) > 1 else {"marker": "x", "ls": ""}
        label = "truth (simulated)"
        axis.plot(panel.truth_km / 1000, panel.truth, color="black", label=label, **style)
    axis.set_ylim(low, high)
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.axhline(100, color="0.6", lw=0.8, ls=":", zorder=0)
    axis.grid(True, alpha=0.3)
    for kind, value in panel.limits:
        if low < value < high:
            colour = LIMIT_COLOURS[kind]
            axis.axhline(value, color=colour, lw=0.9, ls="--", label=f"{kind} limit", zorder=0)


def _mark_beyond(axis: Axes, panel: Panel) -> None:
    values, edges = panel.points.values, axis.get_xaxis_transform()
    for beyond, marker, edge in (
        (values < panel.axis[0], "v", 0),
        (values > panel.axis[1], "^", 1),
    ):
        for km, value in zip(panel.points.km[beyond] / 1000, values[beyond], strict=True):
            style: dict[str, Any] = {"ms": 6, "clip_on": False, "transform": edges, **HOLLOW}
            axis.plot(km, edge, marker, label=BEYOND, **style)
            axis.annotate(
                percent_words(value),
                (km, edge),
                (6, -2 if edge else 2),
                xycoords=edges,
                textcoords="offset points",
                va="top" if edge else "bottom",
                fontsize="x-small",
                color=FLAGGED_COLOUR,
            )


def _mark_edges(axis: Axes, panel: Panel) -> None:
    """Mark trips without an estimate at the bottom of an axis, and alarms at its top."""
    style: dict[str, Any] = {"transform": axis.get_xaxis_transform(), "clip_on": False}
    if len(panel.missing_km):
        at = np.zeros(len(panel.missing_km))
        colour = MISSING_COLOUR
        axis.plot(
            panel.missing_km / 1000, at, "|", ms=12, mew=2, color=colour, label=MISSING, **style
        )
    for one in panel.alarms:
        colour, label = LIMIT_COLOURS[str(one.severity)], alarm_label(one)
        axis.plot(one.begin_km / 1000, 1, "v", ms=7, color=colour, label=label, **style)


def _draw_passing(axes: Sequence[Axes], trend: Trend) -> None:
    """Draw when the act limits will be passed, and extend the axis for it."""
    last = trend.km.max()
    most = last + AHEAD * (last - trend.km.min())
    shown = [
        (axis, panel.passing.low_km, min(panel.passing.high_km, most))
        for axis, panel in zip(axes, trend.panels, strict=True)
        if panel.passing and panel.passing.low_km < most
    ]
    for axis, low, high in shown:
        axis.plot(
            [low / 1000, high / 1000],
            [0.06, 0.06],
            color=LIMIT_COLOURS["act"],
            lw=5,
            alpha=0.5,
            solid_capstyle="butt",
            transform=axis.get_xaxis_transform(),
            label=PASSING,
        )
    if shown:
        axes[0].set_xlim(right=max(high for *_, high in shown) / 1000)


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """Label every kind of mark once, above the axes."""
    marks: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            marks.setdefault(label, handle)
    if marks:
        figure.legend(
            list(marks.values()), list(marks), loc="outside upper center", ncols=3, fontsize="small"
        )
