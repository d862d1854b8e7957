"""Results of a monitor: estimates and alarms to the history, as JSON, and to TensorBoard."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from suspnet.estimation.trained import TrainedModel
from suspnet.ground.findings import as_plain, together
from suspnet.ground.parameters import Severity
from suspnet.ground.records import ERROR, OK, TripResult, sensors_from_text
from suspnet.ground.storage import json_bytes
from suspnet.ground.wording import kilometres
from suspnet.history import History, HistoryError
from suspnet.live.source import Kind
from suspnet.live.suspension import Estimate, LiveSuspension
from suspnet.maintenance.alarms import Alarm
from suspnet.report.tensorboard import RunLog
from suspnet.trips.earlier import keep_trips
from suspnet.trips.fleet import FleetSettings

log = logging.getLogger(__name__)
LEAST_KM = 0.5
"""A section without an estimate is stored only if the train ran this far in it, [km]: a train
parked all night leaves no trips."""
WAIT_S = 5.0
"""Time until an unavailable store is tried again, [s]."""
Publish = Callable[[Kind, str, bytes], None]


class Results:
    """Stores and publishes the estimates and alarms of suspensions.

    `settings` has limits and detector of the alarms, `publish` gets "estimates" or "alarms", the
    suspension and JSON, and `tensorboard` is the folder of the events, with a subfolder for each
    suspension.
    """

    def __init__(
        self,
        store: History,
        settings: FleetSettings,
        publish: Publish,
        tensorboard: Path | None = None,
    ) -> None:
        self._store, self._settings, self._publish = store, settings, publish
        self._folder = tensorboard
        self._logs: dict[str, RunLog] = {}

    def report(self, suspension: LiveSuspension, estimate: Estimate) -> None:
        """Store and publish an estimate; that of an ended section raises and clears alarms.

        The operation is idempotent: the same estimate replaces the stored one. It blocks while the
        store is unavailable.
        """
        result = estimate.result
        moved = result.status == OK or estimate.distance_km >= LEAST_KM
        if estimate.is_final and result.status != ERROR and moved:
            alarms = self._stored(result, suspension.models)
            row = alarms_row(suspension.name, result, alarms)
            self._publish("alarms", suspension.name, json_bytes(row))
        row = estimate_row(suspension.name, estimate, self._settings.trips.level)
        self._publish("estimates", suspension.name, json_bytes(row))
        if self._folder is not None and result.status == OK:
            self._log(suspension.name).scalars(
                "trips" if estimate.is_final else "running",
                result.estimates | {"n_averages": result.quality.n_averages},
                round(result.mileage_km + (0.0 if estimate.is_final else estimate.distance_km)),
            )
        remark = result.reason or result.flags
        log.info("%s %s%s", suspension.name, summary(estimate), remark and f": {remark}")

    def close(self) -> None:
        """Close the TensorBoard events."""
        for one in self._logs.values():
            one.close()

    def _stored(self, result: TripResult, models: Sequence[TrainedModel]) -> list[Alarm]:
        """Store a trip and return the suspension's alarms; wait while the store is unavailable."""
        while True:  # ends: when the store is available, or with the process
            try:
                limits = self._settings.limits_of(models)
                return keep_trips(
                    [result], result.place, models, limits, self._settings.changes, self._store
                )
            except HistoryError as error:
                log.warning("%s; retrying every %g s, no result is lost", error, WAIT_S)
                time.sleep(WAIT_S)

    def _log(self, name: str) -> RunLog:
        assert self._folder is not None
        if name not in self._logs:
            folder = "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
            self._logs[name] = RunLog(self._folder / folder)
        return self._logs[name]


def summary(estimate: Estimate) -> str:
    """Return an estimate on one line."""
    result = estimate.result
    values = ", ".join(f"{name} {value:.4g}" for name, value in result.estimates.items())
    where = (
        f"{result.trip}, {kilometres(result.mileage_km)}{'' if estimate.is_final else ' (so far)'}"
    )
    worn = f"; worn: {result.worn}" if result.worn else ""
    return f"{where}: {values or 'no estimate'}{worn}"


def estimate_row(name: str, estimate: Estimate, level: float) -> dict[str, Any]:
    """Return an estimate as it is published."""
    result = estimate.result
    ends = {key: result.interval(key) for key in result.estimates}
    return {
        "suspension": name,
        "vehicle": result.vehicle,
        "trip": result.trip,
        "start": result.start,
        "mileage_km": result.mileage_km,
        "final": estimate.is_final,
        "status": result.status,
        "reason": result.reason,
        "flags": result.flags,
        "worn": result.worn,
        "findings": as_plain(together((result.reason, result.flags, result.worn))),
        "estimates": {
            key: {"value": value, "low": ends[key][0], "high": ends[key][1]}
            for key, value in result.estimates.items()
        },
        "level": level,
        "speed_m_per_s": result.quality.speed_m_per_s,
        "n_averages": result.quality.n_averages,
        "duration_s": result.quality.duration_s,
        "usable_percent": result.quality.usable_percent,
        "faults": result.quality.faults,
        "wheels": result.quality.wheels,
        "sensors": {
            name: asdict(one) for name, one in sensors_from_text(result.quality.sensors).items()
        },
        "frames": estimate.frames,
    }


def alarms_row(name: str, result: TripResult, alarms: Sequence[Alarm]) -> dict[str, Any]:
    """Return the active alarms as they are published."""
    active = [one for one in alarms if one.is_open]
    severity = max((one.severity for one in active), default=Severity.NONE)
    return {
        "suspension": name,
        "vehicle": result.vehicle,
        "mileage_km": result.mileage_km,
        "severity": str(severity),
        "alarms": [
            {
                "parameter": one.parameter,
                "cause": str(one.cause),
                "severity": str(one.severity),
                "begin_km": one.begin_km,
                "words": one.words,
                "findings": as_plain(one.words),
            }
            for one in active
        ],
    }
