"""The fleet from its history: overview, plan and calendar; `evaluate.py study=maintenance`."""

from __future__ import annotations

import io
import logging
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import pyarrow as pa

from suspnet.depot.overview import overview_rows, overview_table, write_page
from suspnet.depot.parts import parts_of, trains_of
from suspnet.depot.sisters import of_same_car
from suspnet.depot.state import State, fleet_state
from suspnet.dynamics import Vehicle
from suspnet.history import History
from suspnet.maintenance.calendar_figure import plan_calendar
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.limits import DEFAULT_LIMITS, read_limits
from suspnet.maintenance.plan import make_plan
from suspnet.maintenance.plan_inputs import PlanSettings
from suspnet.maintenance.sisters import SisterSettings
from suspnet.storage import write_atomically, write_json
from suspnet.trips.output import write_table

log = logging.getLogger(__name__)


def write_maintenance(
    store: str | None,
    folder: Path,
    *,
    vehicles: Mapping[str, Vehicle],
    limits: Mapping[str, Any] | None,
    changes: ChangeSettings,
    sisters: SisterSettings,
    plan: PlanSettings,
    today: str | None = None,
    seed: int = 0,
) -> list[State]:
    """Write what a depot needs: overview and plan of all suspensions of a history.

    Written are overview.html, overview.csv and .parquet, plan.csv and .parquet, calendar.png. The
    history keeps the alarms that were found.

    Parameters
    ----------
    store : str
        File or URL of the history.
    folder : Path
    vehicles : mapping of Vehicle
        Those whose limits are known; others have ``DEFAULT_LIMITS``.
    limits : mapping, optional
        In place of the vehicles': from a parameter to `notice` and `act`.
    changes : ChangeSettings
    sisters : SisterSettings
    plan : PlanSettings
    today : str, optional
        ISO 8601; the day of the computer's clock by default.
    seed : int
        Of the predicted lives.

    Returns
    -------
    list of State
        The most severe first.

    Raises
    ------
    HistoryError
        If the store cannot be used.
    ValueError
        If it is empty, or a setting is out of range.
    """
    if not store:
        raise ValueError("which history? Give store=FILE, or store=postgresql://...")
    if "://" not in store and not Path(store).is_file():
        raise ValueError(f"{store}: there is no such store; evaluate.py trips=DIR store= makes one")
    try:
        day = date.fromisoformat(str(today)) if today else date.today()
    except ValueError:
        raise ValueError(f"`today` must be a day like 2026-03-31, got {today!r}") from None
    with History(store) as history:
        fleet = history.series()
        acknowledged = history.all_acknowledgements()
    if not fleet:
        raise ValueError(f"{store}: no trip is kept here yet")
    known = {one.vehicle: DEFAULT_LIMITS for one in fleet}
    known |= {vehicle.name: vehicle.known_limits for vehicle in vehicles.values()}
    own = {name: read_limits(limits or {}, one) for name, one in known.items()}
    states = fleet_state(fleet, own, changes, sisters, seed)
    with History(store) as history:
        for state in states:
            history.keep_alarms(state.series.vehicle, state.series.place, state.watched.alarms)
    trains = trains_of(states, day, plan.km_per_day)
    planned = make_plan(parts_of(states), trains, plan, day)
    rows = overview_rows(states, acknowledged)
    write_table(pa.Table.from_pylist(rows), folder / "overview")
    jobs: list[dict[str, Any]] = planned.rows()
    if jobs:
        write_table(pa.Table.from_pylist(jobs), folder / "plan")
    figure = plan_calendar(planned)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150)
    write_atomically(folder / "calendar.png", picture.getvalue())
    places = {id(state.series): i for i, state in enumerate(states)}
    cars = [[places[id(one)] for one in car] for car in of_same_car([s.series for s in states])]
    write_page(folder / "overview.html", rows, cars, planned, figure)
    counts = {str(state.severity): 0 for state in states}
    for state in states:
        counts[str(state.severity)] += 1
    write_json(
        folder / "metrics.json",
        {
            "severities": counts,
            "n_visits": len(planned.visits),
            "n_jobs": sum(len(visit.jobs) for visit in planned.visits),
            "n_waiting": len(planned.waiting),
            "objective": planned.objective,
        },
    )
    log.info("%s\n\n%s\n-> %s", overview_table(rows), planned, folder)
    return states
