"""The fleet from its history: overview, plan and calendar; `evaluate.py study=maintenance`."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from suspnet.dynamics import Vehicle
from suspnet.ground.storage import write_json
from suspnet.history import History
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.fleet import fleet_state
from suspnet.maintenance.fleet_plan import Planner
from suspnet.maintenance.plan_inputs import PlanSettings
from suspnet.maintenance.sisters import SisterSettings
from suspnet.maintenance.state import State
from suspnet.report.board import BoardSettings
from suspnet.report.calendar_figure import plan_calendar
from suspnet.report.output import write_fleet
from suspnet.report.overview import fleet_view, overview_table

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
    """Write overview and plan of all suspensions of a history; return states, the worst first.

    The files are overview.html, .csv and .parquet, plan.csv and .parquet, calendar.png and
    metrics.json. The alarms found are stored in the history.

    `vehicles`: those with known limits, others have ``DEFAULT_LIMITS``; `limits`: by parameter,
    `notice` and `act` in place of the vehicles'; `today`: ISO 8601, None is the computer's date;
    `seed`: of the predicted lives.

    HistoryError if the store cannot be used; ValueError if it is empty, or a setting is out of
    range.
    """
    if not store:
        raise ValueError("which history? Give store=FILE, or store=postgresql://...")
    if "://" not in store and not Path(store).is_file():
        raise ValueError(f"{store}: there is no such store; evaluate.py trips=DIR store= makes one")
    settings = BoardSettings(vehicles, limits, changes, sisters, plan, today, seed)
    with History(store) as history:
        fleet = history.series()
        if not fleet:
            raise ValueError(f"{store}: no trip is stored here yet")
        own = {one.vehicle: settings.limits_of(one.vehicle) for one in fleet}
        states = fleet_state(fleet, own, changes, sisters, seed)
        history.keep_all_alarms({state.key: state.watched.alarms for state in states})
        acknowledged = history.all_acknowledgements()
    planned = Planner(plan).plan(states, settings.day())
    view = fleet_view(states, own, acknowledged, planned)
    write_fleet(view, planned, plan_calendar(planned), folder)
    counts = Counter(str(state.severity) for state in states)
    write_json(
        folder / "metrics.json",
        {
            "severities": counts,
            "n_visits": len(planned.visits),
            "n_jobs": sum(len(visit.jobs) for visit in planned.visits),
            "n_waiting": len(planned.waiting),
            "n_unknown": len(planned.unknown),
            "objective": planned.objective,
            "gap": planned.gap,
        },
    )
    log.info("%s\n\n%s\n-> %s", overview_table(view.rows), planned, folder)
    return states
