"""Store of the history of suspensions: trips, estimates, alarms and maintenance events."""

from suspnet.history.database import HistoryError
from suspnet.history.store import History

__all__ = ["History", "HistoryError"]
