"""Results of a monitor: estimates and alarms to the history."""

import logging
import time
from dataclasses import replace

from suspnet.depot.live.suspension import LiveSuspension, SectionEstimate
from suspnet.ground.records import ERROR, OK
from suspnet.ground.wording import kilometres
from suspnet.trains.history import History, HistoryError
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.maintenance.series import N_LAST
from suspnet.trains.trips.earlier import keep_trips
from suspnet.trains.trips.joint_verdicts import with_joint_verdicts

log = logging.getLogger(__name__)
MIN_KM = 0.5
"""A section without an estimate is stored only if the train ran this far in it, [km]: a train
parked all night leaves no trips."""
WAIT_S = 5.0  # time until an unavailable store is tried again, [s]


def report(
    store: History, settings: FleetSettings, suspension: LiveSuspension, estimate: SectionEstimate
) -> None:
    """Store an estimate, which raises and clears alarms by the settings, and log it.

    A trip also names what it shows with those stored before it. The operation is idempotent: the
    same estimate replaces the stored one. It blocks while the store is unavailable.
    """
    result, models = estimate.result, suspension.models
    has_moved = result.status == OK or estimate.distance_km >= MIN_KM
    is_stored = result.status == ERROR or not has_moved
    limits = settings.limits_of(models)
    while not is_stored:  # ends: when the store is available, or with the process
        try:
            last = [*store.last_before(result, N_LAST - 1), result]
            result = with_joint_verdicts(last, models, settings.trips.level)[-1]
            keep_trips([result], result.place, models, limits, settings.changes, store)
            is_stored = True
        except HistoryError as error:
            log.warning("%s; retrying every %g s, no result is lost", error, WAIT_S)
            time.sleep(WAIT_S)
    log.info("%s %s", suspension.name, summary(replace(estimate, result=result)))


def summary(estimate: SectionEstimate) -> str:
    """Return an estimate on one line, with the counts of its frames."""
    result = estimate.result
    values = ", ".join(f"{name} {value:.4g}" for name, value in result.estimates.items())
    worn = f"worn: {result.worn}" if result.worn else ""
    remarks = "; ".join(filter(None, (values or "no estimate", worn, result.reason, result.flags)))
    frames = ", ".join(f"{n} {name}" for name, n in estimate.frames.items())
    return f"{result.trip}, {kilometres(result.mileage_km)}: {remarks} (frames: {frames})"
