"""Store of the history of suspensions: trips, estimates, alarms and maintenance events."""

from suspnet.trains.history.database import HistoryError
from suspnet.trains.history.store import History

__all__ = ["History", "HistoryError"]
