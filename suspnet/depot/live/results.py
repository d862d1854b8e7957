"""Results of a monitor: estimates and alarms to the history, and as JSON."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from suspnet.depot.live.source import ResultKind
from suspnet.depot.live.suspension import LiveSuspension, SectionEstimate
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.findings import as_plain, together
from suspnet.ground.parameters import Severity
from suspnet.ground.records import ERROR, OK, TripResult, sensors_from_text
from suspnet.ground.storage import json_bytes
from suspnet.ground.wording import kilometres
from suspnet.trains.history import History, HistoryError
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.trips.earlier import keep_trips

log = logging.getLogger(__name__)
MIN_KM = 0.5
"""A section without an estimate is stored only if the train ran this far in it, [km]: a train
parked all night leaves no trips."""
WAIT_S = 5.0  # time until an unavailable store is tried again, [s]


class Results:
    """Stores and publishes the estimates and alarms of suspensions.

    `settings` has limits and detector of the alarms; `publish` gets "estimates" or "alarms", the
    suspension and JSON.
    """

    def __init__(
        self,
        store: History,
        settings: FleetSettings,
        publish: Callable[[ResultKind, str, bytes], None],
    ) -> None:
        self._store, self._settings, self._publish = store, settings, publish

    def report(self, suspension: LiveSuspension, estimate: SectionEstimate) -> None:
        """Store and publish an estimate, which raises and clears alarms.

        The operation is idempotent: the same estimate replaces the stored one. It blocks while the
        store is unavailable.
        """
        result = estimate.result
        has_moved = result.status == OK or estimate.distance_km >= MIN_KM
        if result.status != ERROR and has_moved:
            alarms = self._stored(result, suspension.models)
            row = alarms_row(suspension.name, result, alarms)
            self._publish("alarms", suspension.name, json_bytes(row))
        row = estimate_row(suspension.name, estimate, self._settings.trips.level)
        self._publish("estimates", suspension.name, json_bytes(row))
        remark = result.reason or result.flags
        log.info("%s %s%s", suspension.name, summary(estimate), remark and f": {remark}")

    def _stored(self, result: TripResult, models: Sequence[TrainedModel]) -> list[Alarm]:
        """Store a trip and return the suspension's alarms; wait while the store is unavailable."""
        limits = self._settings.limits_of(models)
        while True:  # ends: when the store is available, or with the process
            try:
                return keep_trips(
                    [result], result.place, models, limits, self._settings.changes, self._store
                )
            except HistoryError as error:
                log.warning("%s; retrying every %g s, no result is lost", error, WAIT_S)
                time.sleep(WAIT_S)


def summary(estimate: SectionEstimate) -> str:
    """Return an estimate on one line."""
    result = estimate.result
    values = ", ".join(f"{name} {value:.4g}" for name, value in result.estimates.items())
    worn = f"; worn: {result.worn}" if result.worn else ""
    where = f"{result.trip}, {kilometres(result.mileage_km)}"
    return f"{where}: {values or 'no estimate'}{worn}"


def estimate_row(name: str, estimate: SectionEstimate, level: float) -> dict[str, Any]:
    """Return an estimate as it is published."""
    result, quality = estimate.result, estimate.result.quality
    estimates = {}
    for key, value in result.estimates.items():
        low, high = result.interval(key)
        estimates[key] = {"value": value, "low": low, "high": high}
    return {
        "suspension": name,
        "vehicle": result.vehicle,
        "trip": result.trip,
        "start": result.start,
        "mileage_km": result.mileage_km,
        "status": result.status,
        "reason": result.reason,
        "flags": result.flags,
        "worn": result.worn,
        "findings": as_plain(together((result.reason, result.flags, result.worn))),
        "estimates": estimates,
        "level": level,
        "speed_m_per_s": quality.speed_m_per_s,
        "n_averages": quality.n_averages,
        "duration_s": quality.duration_s,
        "usable_percent": quality.usable_percent,
        "faults": quality.faults,
        "wheels": quality.wheels,
        "sensors": {key: asdict(item) for key, item in sensors_from_text(quality.sensors).items()},
        "frames": estimate.frames,
    }


def alarms_row(name: str, result: TripResult, alarms: Sequence[Alarm]) -> dict[str, Any]:
    """Return the active alarms as they are published."""
    active = [alarm for alarm in alarms if alarm.is_open]
    return {
        "suspension": name,
        "vehicle": result.vehicle,
        "mileage_km": result.mileage_km,
        "severity": str(max((alarm.severity for alarm in active), default=Severity.NONE)),
        "alarms": [
            {
                "parameter": alarm.parameter,
                "cause": str(alarm.cause),
                "severity": str(alarm.severity),
                "begin_km": alarm.begin_km,
                "words": alarm.words,
                "findings": as_plain(alarm.words),
            }
            for alarm in active
        ],
    }
