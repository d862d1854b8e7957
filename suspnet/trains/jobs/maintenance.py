"""What maintenance is due, from the history of a fleet: overview, plan and calendar."""

import logging
from pathlib import Path

from suspnet.trains.history import History
from suspnet.trains.history.database import check_exists
from suspnet.trains.maintenance.plan import plan_of
from suspnet.trains.maintenance.state import State, by_urgency, state_of
from suspnet.trains.pages.board import BoardSettings
from suspnet.trains.pages.maintenance_figures import plan_calendar
from suspnet.trains.pages.output import write_fleet
from suspnet.trains.pages.overview import FleetView, overview_table

log = logging.getLogger(__name__)


def existing_history(store: str | None) -> History:
    """Return a history, to be closed; ValueError without a name, HistoryError if it is missing."""
    if not store:
        raise ValueError("which history? Give store=FILE, or store=postgresql://...")
    check_exists(store)
    return History(store)


def write_maintenance(history: History, folder: Path, settings: BoardSettings) -> list[State]:
    """Write overview, plan and calendar of all suspensions of a history, and store their alarms.

    Returns the states, the worst first. HistoryError if the store cannot be used; ValueError if it
    is empty.
    """
    fleet = history.series()
    if not fleet:
        raise ValueError(f"{history}: no trip is stored here yet")
    states = by_urgency(
        state_of(own, settings.limits_of(own.vehicle), settings.changes, settings.seed)
        for own in fleet
    )
    history.keep_all_alarms({state.key: state.watched.alarms for state in states})
    acknowledged = history.all_acknowledgements()
    planned = plan_of(states, settings.plan, settings.day())
    view = FleetView(states=tuple(states), plan=planned, acknowledged=acknowledged)
    write_fleet(view, planned, plan_calendar(planned), folder)
    log.info("%s\n\n%s\n-> %s", overview_table(view.rows), planned.summary, folder)
    return states
