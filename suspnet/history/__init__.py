"""Store of the history of suspensions: trips, estimates, alarms and maintenance events."""

from suspnet.history.arrays import TripResponses
from suspnet.history.database import HistoryError
from suspnet.history.store import History
from suspnet.maintenance.series import Event, Series

__all__ = ["Event", "History", "HistoryError", "Series", "TripResponses"]
