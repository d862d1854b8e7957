"""Figures for maintenance: the calendar of a plan, and a suspension along its mileage."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from textwrap import wrap
from typing import Any

import matplotlib.dates as mdates
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, Severity
from suspnet.runs.figures import MILEAGE_LABEL, SYMBOLS, say
from suspnet.runs.language import ENGLISH, current
from suspnet.trains.maintenance.plan import UNKNOWN, URGENCIES, Job, Plan, Visit
from suspnet.trains.pages.trend import (
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
    MileageTrend,
    Panel,
    Points,
    alarm_label,
    percent_words,
    running_median,
)

COLOURS = dict(zip(URGENCIES, ("tab:purple", "tab:red", "tab:orange", "tab:blue"), strict=True))
WORDS = {
    UNKNOWN: "remaining life unknown",
    "now": "visit on the first possible day",
    "soon": "visit to be decided on within a month",
    "later": "later visit",
}
MOST_TRAINS = 30
LEAST_ROWS = 3  # of a calendar, also if fewer trains are shown
LONGEST_LINE = 28  # letters of a train's name in each of its two lines
BARS = 5  # parts of one train whose intervals are drawn, those that pass first
BAND = 0.7  # share of a train's row that intervals take
DUE = "passing"  # label of the bars, which the legend replaces by a text with the level


def plan_calendar(plan: Plan, figure: Figure | None = None) -> Figure:
    """Return the calendar: trains as rows, unknown and urgent ones on top, and their visits.

    A mark is a visit with the number of its jobs, on its latest day.
    A thin bar is the interval in which one part passes its limit without a visit. A question mark
    is a train with a part of unknown remaining life; a visit for one has its colour. Trains without
    a visit and without a waiting part are left out, as are those after the first ``MOST_TRAINS``;
    the title counts them. `figure` is an empty one to draw on, by default a new one.
    """
    visits: dict[str, list[Visit]] = defaultdict(list)
    jobs: dict[str, list[Job]] = defaultdict(list)
    for visit in plan.visits:
        visits[visit.train].append(visit)
        jobs[visit.train] += visit.jobs
    for job in plan.unknown:
        jobs[job.part.train].append(job)
    # the most urgent trains on top, as only the first of many are shown
    names = sorted(jobs, key=lambda name: _urgency(visits[name], jobs[name], name))
    shown = names[:MOST_TRAINS]
    figure = figure or Figure(
        figsize=(8.0, 1.8 + 0.3 * max(len(shown), LEAST_ROWS)), layout="constrained"
    )
    axis: Axes = figure.subplots()
    for row, name in enumerate(shown):
        _draw_intervals(axis, plan, row, jobs[name])
        if any(job.part.unknown for job in jobs[name]):
            _draw_mark(axis, float(mdates.date2num(plan.today)), row, UNKNOWN, "?")
        for visit in visits[name]:
            _draw_visit(axis, row, visit)
    if not shown:
        axis.text(0.5, 0.5, "nothing to be done", ha="center", transform=axis.transAxes)
    _label(axis, plan, shown, len(names))
    _calendar_legend(figure, axis, plan.level)
    return figure


def _day_formats() -> dict[str, list[str]]:
    """Return the formats of the days of a calendar, as in the tables, without names of months."""
    month, day, full = "%Y-%m", "%m-%d", "%Y-%m-%d"
    if current() != ENGLISH:
        month, day, full = "%m.%Y", "%d.%m.", "%d.%m.%Y"
    return {
        "formats": ["%Y", month, day, *["%H:%M"] * 3],
        "zero_formats": ["", month, day, day, *["%H:%M"] * 2],
        "offset_formats": ["", "", "%Y", *[full] * 3],
    }


def _label(axis: Axes, plan: Plan, shown: Sequence[str], n_trains: int) -> None:
    """Label trains, days and the numbers of visits; shade every other train."""
    axis.set_ylim(max(len(shown), LEAST_ROWS) - 0.5, -0.5)
    names_in_lines = ["\n".join(wrap(name, LONGEST_LINE)[:2]) for name in shown]
    axis.set_yticks(range(len(shown)), names_in_lines, fontsize="small")
    axis.set_xlim(mdates.date2num(plan.today), mdates.date2num(plan.horizon))
    locator = mdates.AutoDateLocator()
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(mdates.ConciseDateFormatter(locator, **_day_formats()))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_xlabel("day of the visit")
    axis.set_ylabel("train")
    axis.grid(True, axis="x", alpha=0.3)
    for row in range(1, len(shown), 2):
        axis.axhspan(row - 0.5, row + 0.5, color="0.95", zorder=0, lw=0)
    axis.tick_params(axis="x", labelsize="small")
    axis.tick_params(axis="y", length=0, pad=9)  # a mark of today extends beyond the axis
    visits = Finding("visits", n=len(plan.visits))
    n_jobs = Finding("jobs", n=sum(len(visit.jobs) for visit in plan.visits))
    days = {"today": plan.today, "day": plan.horizon}
    title = Finding("plan-title", visits=visits, jobs=n_jobs, **days)
    if plan.unknown:
        parts = Finding("parts", n=len(plan.unknown))
        title = Finding("plan-title-unknown", title=title, parts=parts)
    if n_trains > len(shown):
        title = Finding("trains-shown", title=title, n=len(shown), n_all=n_trains)
    axis.set_title(title, fontsize="medium")


def _urgency(visits: Sequence[Visit], jobs: Sequence[Job], name: str) -> tuple[Any, ...]:
    first = min(((URGENCIES.index(v.urgency), v.day.toordinal()) for v in visits), default=(9, 0))
    probabilities = [job.probability for job in jobs if not job.part.unknown]
    return (len(probabilities) == len(jobs), *first, -max(probabilities, default=0.0), name)


def _draw_visit(axis: Axes, row: int, visit: Visit) -> None:
    urgency = visit.urgency_of(visit.jobs[0])
    _draw_mark(axis, float(mdates.date2num(visit.day)), row, urgency, f"{len(visit.jobs)}")


def _draw_mark(axis: Axes, day: float, row: int, urgency: str, text: str) -> None:
    style: dict[str, Any] = {"ms": 11, "mec": "white", "clip_on": False, "zorder": 3}
    axis.plot(day, row, "o", color=COLOURS[urgency], label=WORDS[urgency], **style)
    place: dict[str, Any] = {"ha": "center", "va": "center", "color": "white", "zorder": 4}
    axis.text(day, row, text, fontsize=6.5, clip_on=False, **place)


def _draw_intervals(axis: Axes, plan: Plan, row: int, jobs: Sequence[Job]) -> None:
    begin, end = (float(mdates.date2num(day)) for day in (plan.today, plan.horizon))
    ends = sorted(job.passing_days for job in jobs if begin + job.passing_days[0] < end)[:BARS]
    for i, (low, high) in enumerate(ends):
        height = row + BAND * ((i + 0.5) / len(ends) - 0.5)
        style: dict[str, Any] = {"color": "0.45", "lw": 1.2, "alpha": 0.7, "zorder": 1}
        axis.plot([begin + low, min(begin + high, end)], [height, height], label=DUE, **style)


def _calendar_legend(figure: Figure, axis: Axes, level: float) -> None:
    """Label every kind of mark once, the most urgent first."""
    handles, labels = axis.get_legend_handles_labels()
    marks = dict(zip(labels, handles, strict=True))
    order = [word for word in (*WORDS.values(), DUE) if word in marks]
    words = [Finding("passing-interval", level=100 * level) if w == DUE else w for w in order]
    if order:
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2, "fontsize": "small"}
        figure.legend([marks[word] for word in order], words, **place)


SMALL_INCHES = 4.0, 2.1  # size of the figure of one part, of which several are side by side
SMALL_MARGINS = {"left": 0.17, "right": 0.98, "top": 0.89, "bottom": 0.24}
"""Its margins, as shares of its size; they hold a title and percentages with two decimals."""
HOLLOW: dict[str, Any] = {"mfc": "none", "color": FLAGGED_COLOUR, "ls": ""}
AHEAD = 0.5  # largest share of the mileage so far by which a figure extends into the future


def small_trends(trend: MileageTrend) -> dict[str, Figure]:
    """Draw a figure of each parameter where parts of a bogie are read; else none.

    Those without a finding are small. All have the same range of mileages.
    """
    if not any(panel.name in BOGIE_PARTS for panel in trend.panels):
        return {}
    figures = {
        panel.name: health_trend(replace(trend, panels=(panel,)), panel.severity == Severity.NONE)
        for panel in trend.panels
    }
    ends = [figure.axes[0].get_xlim() for figure in figures.values()]
    for figure in figures.values():
        figure.axes[0].set_xlim(min(low for low, _ in ends), max(high for _, high in ends))
    return figures


def health_trend(trend: MileageTrend, is_small: bool = False) -> Figure:
    """Draw each parameter in % of healthy along the mileage (Fig. 10).

    Dots are trips with their interval, the line is the running median of all; a flagged trip is
    hollow. A red tick at the bottom is a trip without an estimate, a thin black line the truth of
    simulated trips, a triangle at the top the start of an alarm. Dashed lines are limits within the
    axis. A bar at the bottom is the range in which the act limit will be passed, as far as it lies
    in the figure, which grows by half of its mileage at most. Trips without a mileage are left out,
    and counted in the title. A small figure has no legend.
    """
    n = len(trend.panels)
    size = SMALL_INCHES if is_small else (7.0, 1.0 + 1.7 * n)
    figure = Figure(figsize=size, layout=None if is_small else "constrained")
    axes: list[Axes] = list(figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0])
    if is_small:  # the same for all, and in half the time
        figure.subplots_adjust(**SMALL_MARGINS)
    for axis, panel in zip(axes, trend.panels, strict=True):
        kind = "of-nominal-axis" if panel.name == BODY_MASS else "of-healthy-axis"
        axis.set_ylabel(Finding(kind, symbol=SYMBOLS[panel.name]))
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
    # last, as it extends the common axis into the future
    if len(trend.km):
        _draw_passing(axes, trend)
    axes[-1].set_xlabel(MILEAGE_LABEL)
    figure.align_ylabels(axes)
    if is_small:
        axes[0].set_ylabel(axes[0].get_ylabel().partition("[")[2].rstrip("]"))
    else:
        _legend(figure, axes)
    if trend.n_unplaced:
        axes[0].set_title(Finding("unplaced-trips", n_unplaced=trend.n_unplaced), fontsize="small")
    return figure


def _draw_trips(axis: Axes, points: Points, level: float) -> None:
    clear, thousands_km = ~points.flagged, points.km / 1000
    style: dict[str, Any] = {"color": TRIP_COLOUR}
    if clear.any():
        axis.plot(thousands_km[clear], points.values[clear], ".", ms=6, label=TRIP, **style)
    has_interval = np.isfinite(points.intervals[:, 0])
    if has_interval.any():
        label = Finding("interval", level=100 * level)
        ends = points.intervals[has_interval].T
        axis.vlines(thousands_km[has_interval], *ends, label=label, alpha=0.5, lw=0.9, **style)
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
            place: dict[str, Any] = {"xycoords": edges, "textcoords": "offset points"}
            place |= {"va": "top" if edge else "bottom", "color": FLAGGED_COLOUR}
            offset = (6, -2 if edge else 2)
            axis.annotate(percent_words(value), (km, edge), offset, fontsize="x-small", **place)


def _mark_edges(axis: Axes, panel: Panel) -> None:
    """Mark trips without an estimate at the bottom of an axis, and alarms at its top."""
    style: dict[str, Any] = {"transform": axis.get_xaxis_transform(), "clip_on": False}
    if len(panel.missing_km):
        tick = style | {"ms": 12, "mew": 2, "color": MISSING_COLOUR, "label": MISSING}
        axis.plot(panel.missing_km / 1000, np.zeros(len(panel.missing_km)), "|", **tick)
    for alarm in panel.alarms:
        colour, label = LIMIT_COLOURS[str(alarm.severity)], alarm_label(alarm)
        axis.plot(alarm.begin_km / 1000, 1, "v", ms=7, color=colour, label=label, **style)


def _draw_passing(axes: Sequence[Axes], trend: MileageTrend) -> None:
    """Draw when the act limits will be passed, and extend the axis for it."""
    last = trend.km.max()
    most = last + AHEAD * (last - trend.km.min())
    shown = [
        (axis, panel.passing.low_km, min(panel.passing.high_km, most))
        for axis, panel in zip(axes, trend.panels, strict=True)
        if panel.passing and panel.passing.low_km < most
    ]
    style: dict[str, Any] = {"color": LIMIT_COLOURS["act"], "lw": 5, "alpha": 0.5}
    style |= {"solid_capstyle": "butt", "label": PASSING}
    for axis, low, high in shown:
        ends = [low / 1000, high / 1000]
        axis.plot(ends, [0.06, 0.06], transform=axis.get_xaxis_transform(), **style)
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
