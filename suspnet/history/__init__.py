"""History of suspensions: one store of trips, estimates, alarms and maintenance events."""

from suspnet.history.database import HistoryError
from suspnet.history.events import Event
from suspnet.history.series import Series
from suspnet.history.store import History

__all__ = ["Event", "History", "HistoryError", "Series"]
