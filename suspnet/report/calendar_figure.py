"""The calendar of a plan: when each train is visited, and when its parts pass their limits."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from textwrap import wrap
from typing import Any

import matplotlib.dates as mdates
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from suspnet.ground.wording import count
from suspnet.maintenance.schedule import UNKNOWN, URGENCIES, Job, Plan, Visit

COLOURS = dict(zip(URGENCIES, ("tab:purple", "tab:red", "tab:orange", "tab:blue"), strict=True))
WORDS = {
    UNKNOWN: "remaining life unknown",
    "now": "visit on the first possible day",
    "soon": "visit to be decided on within a month",
    "later": "later visit",
}
MOST_TRAINS = 30
LEAST_ROWS = 3
"""Smallest number of rows of a calendar, also if fewer trains are shown."""
LONGEST_LINE = 28
"""Number of letters of a train's name in each of its two lines."""
BARS = 5
"""Largest number of parts of one train whose intervals are drawn, those that pass first."""
BAND = 0.7
"""Share of a train's row that intervals take."""
PASSING = "passing"
"""Internal label of the bars; the legend replaces it by a text with the level."""


def plan_calendar(plan: Plan, figure: Figure | None = None) -> Figure:
    """Return the calendar: trains as rows, unknown and urgent ones on top, and their visits.

    A mark is a visit with the number of its jobs; the line behind it extends to its latest day.
    A thin bar is the interval in which one part passes its limit without a visit. A question mark
    is a train with a part of unknown remaining life; a visit for one has its colour. Trains without
    a visit and without a waiting part are left out, as are those after the first ``MOST_TRAINS``;
    the title counts them.

    Parameters
    ----------
    plan : Plan
    figure : Figure, optional
        An empty one to draw on; by default a new one of suitable size.
    """
    visits: dict[str, list[Visit]] = defaultdict(list)
    jobs: dict[str, list[Job]] = defaultdict(list)
    for visit in plan.visits:
        visits[visit.train].append(visit)
        jobs[visit.train] += visit.jobs
    for job in (*plan.unknown, *plan.waiting):
        jobs[job.part.train].append(job)
    names = sorted(jobs, key=lambda name: _urgency(visits[name], jobs[name], name))
    shown = names[:MOST_TRAINS]
    figure = figure or Figure(
        figsize=(8.0, 1.8 + 0.3 * max(len(shown), LEAST_ROWS)), layout="constrained"
    )
    axis: Axes = figure.subplots()
    for row, name in enumerate(shown):
        _draw_passing(axis, plan, row, jobs[name])
        if any(job.part.unknown for job in jobs[name]):
            _draw_mark(axis, float(mdates.date2num(plan.today)), row, UNKNOWN, "?")
        for visit in visits[name]:
            _draw_visit(axis, row, visit)
    if not shown:
        axis.text(0.5, 0.5, "nothing to be done", ha="center", transform=axis.transAxes)
    _label(axis, plan, shown, len(names))
    _legend(figure, axis, plan.level)
    return figure


def _label(axis: Axes, plan: Plan, shown: Sequence[str], n_trains: int) -> None:
    """Label trains, days and the numbers of visits; shade every other train."""
    axis.set_ylim(max(len(shown), LEAST_ROWS) - 0.5, -0.5)
    names_in_lines = ["\n".join(wrap(name, LONGEST_LINE)[:2]) for name in shown]
    axis.set_yticks(range(len(shown)), names_in_lines, fontsize="small")
    axis.set_xlim(mdates.date2num(plan.today), mdates.date2num(plan.horizon))
    locator = mdates.AutoDateLocator()
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(mdates.ConciseDateFormatter(locator))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_xlabel("day of the visit")
    axis.set_ylabel("train")
    axis.grid(True, axis="x", alpha=0.3)
    for row in range(1, len(shown), 2):
        axis.axhspan(row - 0.5, row + 0.5, color="0.95", zorder=0, lw=0)
    axis.tick_params(axis="y", length=0, pad=9)  # a mark of today extends beyond the axis
    n_jobs = sum(len(visit.jobs) for visit in plan.visits)
    title = (
        f"Plan of {plan.today}: {count(len(plan.visits), 'visit')}, {count(n_jobs, 'job')} "
        f"until {plan.horizon}"
    )
    if plan.unknown:
        title += f", {count(len(plan.unknown), 'part')} unknown"
    if n_trains > len(shown):
        title += f"\n{len(shown)} trains of {n_trains}, the most urgent"
    axis.set_title(title, fontsize="medium")


def _urgency(visits: Sequence[Visit], jobs: Sequence[Job], name: str) -> tuple[Any, ...]:
    first = min(((URGENCIES.index(v.urgency), v.day.toordinal()) for v in visits), default=(9, 0))
    known = [job.probability for job in jobs if not job.part.unknown]
    return (len(known) == len(jobs), *first, -max(known, default=0.0), name)


def _draw_visit(axis: Axes, row: int, visit: Visit) -> None:
    urgency = visit.urgency_of(visit.jobs[0])
    colour = COLOURS[urgency]
    day, latest = (float(mdates.date2num(one)) for one in (visit.day, visit.latest))
    axis.plot([day, latest], [row, row], color=colour, lw=2, alpha=0.6, solid_capstyle="butt")
    _draw_mark(axis, day, row, urgency, f"{len(visit.jobs)}")


def _draw_mark(axis: Axes, day: float, row: int, urgency: str, text: str) -> None:
    style: dict[str, Any] = {"ms": 11, "mec": "white", "clip_on": False, "zorder": 3}
    axis.plot(day, row, "o", color=COLOURS[urgency], label=WORDS[urgency], **style)
    place: dict[str, Any] = {"ha": "center", "va": "center", "color": "white", "zorder": 4}
    axis.text(day, row, text, fontsize=6.5, clip_on=False, **place)


def _draw_passing(axis: Axes, plan: Plan, row: int, jobs: Sequence[Job]) -> None:
    begin, end = (float(mdates.date2num(day)) for day in (plan.today, plan.horizon))
    ends = sorted(job.passing_days for job in jobs if begin + job.passing_days[0] < end)[:BARS]
    for i, (low, high) in enumerate(ends):
        height = row + BAND * ((i + 0.5) / len(ends) - 0.5)
        style: dict[str, Any] = {"color": "0.45", "lw": 1.2, "alpha": 0.7, "zorder": 1}
        axis.plot([begin + low, min(begin + high, end)], [height, height], label=PASSING, **style)


def _legend(figure: Figure, axis: Axes, level: float) -> None:
    """Label every kind of mark once, the most urgent first."""
    handles, labels = axis.get_legend_handles_labels()
    marks = dict(zip(labels, handles, strict=True))
    order = [word for word in (*WORDS.values(), PASSING) if word in marks]
    words = [f"limit passed: {100 * level:g} % interval" if w == PASSING else w for w in order]
    if order:
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2, "fontsize": "small"}
        figure.legend([marks[word] for word in order], words, **place)
