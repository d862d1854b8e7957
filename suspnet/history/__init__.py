"""History of suspensions: one store of trips, estimates and maintenance events."""

from suspnet.history.store import Event, History, HistoryError

__all__ = ["Event", "History", "HistoryError"]
