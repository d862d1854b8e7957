"""The calendar of a plan of maintenance."""

from collections import defaultdict
from collections.abc import Sequence
from datetime import date
from textwrap import wrap
from typing import Any

import matplotlib.dates as mdates
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from suspnet.ground.findings import Finding
from suspnet.runs.language import ENGLISH, current
from suspnet.trains.maintenance.plan import UNKNOWN, URGENCIES, Job, Plan, Visit

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


def plan_calendar(plan: Plan, figure: Figure | None = None) -> Figure:
    """Return the calendar: trains as rows, unknown and urgent ones on top, and their visits.

    A mark is a visit with the number of its jobs, on its latest day. A question mark is a train
    with a part of unknown remaining life; a visit for one has its colour. Trains without a visit
    and without a waiting part are left out, as are those after the first ``MOST_TRAINS``; the title
    counts them. `figure` is an empty one to draw on, by default a new one.
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
        if any(job.part.unknown for job in jobs[name]):
            _draw_mark(axis, plan.today, row, UNKNOWN, "?")
        for visit in visits[name]:
            urgency = visit.urgency_of(visit.jobs[0])
            _draw_mark(axis, visit.day, row, urgency, f"{len(visit.jobs)}")
    if not shown:
        axis.text(0.5, 0.5, "nothing to be done", ha="center", transform=axis.transAxes)
    _label(axis, plan, shown, len(names))
    # every kind of mark once, the most urgent first
    handles, labels = axis.get_legend_handles_labels()
    marks = dict(zip(labels, handles, strict=True))
    if words := [word for word in WORDS.values() if word in marks]:
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2, "fontsize": "small"}
        figure.legend([marks[word] for word in words], words, **place)
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


def _draw_mark(axis: Axes, day: date, row: int, urgency: str, text: str) -> None:
    style: dict[str, Any] = {"ms": 11, "mec": "white", "clip_on": False, "zorder": 3}
    axis.plot(day, row, "o", color=COLOURS[urgency], label=WORDS[urgency], **style)  # type: ignore[arg-type]
    place: dict[str, Any] = {"ha": "center", "va": "center", "color": "white", "zorder": 4}
    axis.text(day, row, text, fontsize=6.5, clip_on=False, **place)  # type: ignore[arg-type]
