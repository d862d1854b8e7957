"""Saying that somebody has seen alarms of a suspension."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from suspnet.history.store import History
from suspnet.maintenance.alarms import Acknowledgement, Alarm
from suspnet.recordings.manifest import Place


def acknowledge_alarms(
    store: History,
    vehicle: str,
    place: Place,
    alarms: Sequence[Alarm],
    at_km: float,
    by: str,
    words: str = "",
) -> list[Acknowledgement]:
    """Keep that a person has seen alarms of a suspension now, and return what is kept.

    Parameters
    ----------
    store : History
    vehicle : str
    place : Place
    alarms : sequence of Alarm
        As they were seen: one that gets worse asks again.
    at_km : float, [km]
        Mileage of the newest trip.
    by, words : str
        Name of the person, and what is done about it.

    Raises
    ------
    HistoryError
        If the store knows no trip of the suspension, or cannot be written.
    ValueError
        If the name or the mileage is missing.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    seen = [
        Acknowledgement(one.parameter, one.cause, one.severity, at_km, by, now, words)
        for one in alarms
    ]
    store.acknowledge(vehicle, place, seen)
    return seen
