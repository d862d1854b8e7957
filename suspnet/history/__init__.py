"""History of suspensions: one store of trips, estimates, alarms and maintenance events.

The names are imported when they are first used: programs that keep no store need no SQLAlchemy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from suspnet.history.curves import TripResponses
    from suspnet.history.database import HistoryError
    from suspnet.history.events import Event
    from suspnet.history.series import Series
    from suspnet.history.store import History

_HOME = {
    "TripResponses": "curves",
    "HistoryError": "database",
    "Event": "events",
    "Series": "series",
    "History": "store",
}

__all__ = ["Event", "History", "HistoryError", "Series", "TripResponses"]


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
