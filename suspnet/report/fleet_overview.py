"""All suspensions of a history, the worst first, as rows, as a table and as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tabulate import tabulate

from suspnet.dynamics import PARAMETERS
from suspnet.ground.storage import write_atomically
from suspnet.maintenance.alarms import Acknowledgement, newest_of
from suspnet.maintenance.fleet_lives import present
from suspnet.maintenance.schedule import Plan, joined
from suspnet.maintenance.state import State
from suspnet.maintenance.trend import PAYLOAD
from suspnet.recordings.manifest import Place
from suspnet.report.figures import data_uri
from suspnet.report.overview import finding
from suspnet.report.templates import render

N_SHOWN = 30
"""Largest number of suspensions in the table of a terminal."""


def overview_rows(
    states: Sequence[State],
    acknowledged: Mapping[tuple[str, Place], Sequence[Acknowledgement]],
) -> list[dict[str, Any]]:
    """Return one flat row for each suspension, in the order given.

    Parameters
    ----------
    states : sequence of State
    acknowledged : mapping from vehicle and place to acknowledgements
    """
    return [_row(one, acknowledged) for one in states]


def overview_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the worst suspensions as a table, below a sentence on all of them."""
    shown = ("train", "car", "suspension", "bogie", "side", "severity", "parameter", "reason")
    columns = [key for key in shown if any(row[key] for row in rows)]
    head = [[row[key] for key in columns] for row in rows[:N_SHOWN]]
    more = f"\n... and {len(rows) - N_SHOWN} more" if len(rows) > N_SHOWN else ""
    return f"{finding(rows)}\n{tabulate(head, columns, tablefmt='github')}{more}"


def write_page(
    path: Path,
    rows: Sequence[Mapping[str, Any]],
    sisters: Sequence[Sequence[int]],
    plan: Plan,
    figure: Figure,
) -> None:
    """Write overview, plan and sister suspensions as one page that needs no other file.

    Parameters
    ----------
    path : Path
    rows : sequence
        Of ``overview_rows``.
    sisters : sequence of sequences of int
        Places in `rows` of the suspensions of each car that has several.
    plan : Plan
    figure : Figure
        Calendar of the plan.
    """
    page = render(
        "fleet.html",
        rows=rows,
        finding=finding(rows),
        plan=plan,
        jobs=joined(plan.rows()),
        calendar=data_uri(figure),
        sisters=[[rows[i] for i in one] for one in sisters],
        parameters=[name for name in PARAMETERS if name != PAYLOAD],
    )
    write_atomically(path, page.encode("utf-8", errors="replace"))


def _row(
    state: State, acknowledged: Mapping[tuple[str, Place], Sequence[Acknowledgement]]
) -> dict[str, Any]:
    """Return one suspension as a row."""
    series, place = state.series, state.series.place
    worst = next(iter(state.alarms), None)
    seen = worst and newest_of(worst, acknowledged.get((series.vehicle, place), ()))
    shortest = state.shortest
    return {
        "vehicle": series.vehicle,
        "where": str(place),
        "train": place.train,
        "car": place.car,
        "suspension": place.suspension,
        "bogie": place.bogie,
        "side": place.side,
        "severity": str(state.severity),
        "parameter": worst.parameter if worst else "",
        "reason": worst.words if worst else _quiet(state),
        "since_km": worst.begin_km if worst else np.nan,
        "n_alarms": len(state.alarms),
        "acknowledged": f"{seen.by}, {seen.at[:10]}" if seen else "",
        "life_parameter": shortest[0] if shortest else "",
        "life_low_km": shortest[1].interval_km()[0] if shortest else np.nan,
        "life_median_km": shortest[1].quantile_km(0.5) if shortest else np.nan,
        "life_high_km": shortest[1].interval_km()[1] if shortest else np.nan,
        "life_unknown": ", ".join(state.unknown),
        "life_unknown_why": "; ".join(dict.fromkeys(state.unknown.values())),
        **{f"{name}_last": present(series, name) for name in series.estimates},
        "last_mileage_km": state.last_km,
        "n_trips": len(series.trip),
        "n_estimated": int(series.done.sum()),
        "n_flagged": int(series.flagged.sum()),
    }


def _quiet(state: State) -> str:
    """Return what is to be said of a suspension without alarms."""
    if state.unjudged:
        return state.unjudged
    why = state.watched.changes.why_not
    return f"alarms of changes not armed yet: {why}" if why else ""
