"""The fleet from its history: overview, plan and calendar; `evaluate.py study=maintenance`."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

from suspnet.ground.storage import write_json
from suspnet.history import History
from suspnet.history.database import check_exists
from suspnet.maintenance.fleet import fleet_state
from suspnet.maintenance.plan import Planner
from suspnet.maintenance.state import State
from suspnet.report.board import BoardSettings
from suspnet.report.maintenance_figures import plan_calendar
from suspnet.report.output import write_fleet
from suspnet.report.tables import fleet_view, overview_table

log = logging.getLogger(__name__)


def write_maintenance(store: str | None, folder: Path, settings: BoardSettings) -> list[State]:
    """Write overview and plan of all suspensions of a history; return states, the worst first.

    The files are overview.html, .csv and .parquet, plan.csv and .parquet, calendar.png and
    metrics.json. The alarms found are stored in the history.

    HistoryError if the store cannot be used; ValueError if it is missing or empty, or the limits
    are inconsistent.
    """
    if not store:
        raise ValueError("which history? Give store=FILE, or store=postgresql://...")
    check_exists(store)
    with History(store) as history:
        fleet = [one.relative_to_first(settings.n_first) for one in history.series()]
        if not fleet:
            raise ValueError(f"{store}: no trip is stored here yet")
        own = {one.vehicle: settings.limits_of(one.vehicle) for one in fleet}
        states = fleet_state(fleet, own, settings.changes, settings.sisters, settings.seed)
        history.keep_all_alarms({state.key: state.watched.alarms for state in states})
        acknowledged = history.all_acknowledgements()
    planned = Planner(settings.plan).plan(states, settings.day())
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
