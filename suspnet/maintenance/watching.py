"""Alarms of a suspension's trips: since its last commissioning, and anew after each maintenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from suspnet.estimation.trained import TrainedModel
from suspnet.history import Event, History
from suspnet.history.records import TripResult
from suspnet.maintenance.alarms import OWN_CAUSES, Alarm
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.limits import Limits
from suspnet.maintenance.trend import PAYLOAD
from suspnet.maintenance.watch import Watched, watch
from suspnet.recordings.manifest import Place
from suspnet.trips.commissionings import commissionings, of_last_era
from suspnet.trips.earlier import with_earlier


def watch_trips(
    results: Sequence[TripResult],
    events: Sequence[Event],
    outputs: Sequence[str],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
) -> Watched:
    """Return the alarms of trips that are relative to one healthy state.

    Parameters
    ----------
    results : sequence of TripResult
        In any order; those without a mileage are left out.
    events : sequence of Event
    outputs : sequence of str
        Parameters; the car-body mass is a covariate, as are speed and temperature.
    limits, settings
        Of ``watch``.
    """
    names = [name for name in outputs if name != PAYLOAD]
    return watch(
        [r.mileage_km for r in results],
        {name: [r.estimates.get(name, np.nan) for r in results] for name in names},
        {name: [r.half_widths.get(name, np.nan) for r in results] for name in names},
        [bool(r.flags) for r in results],
        covariates(results),
        limits,
        settings,
        [event.mileage_km for event in events],
    )


def keep_trips(
    results: Sequence[TripResult],
    place: Place,
    models: Sequence[TrainedModel],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
    store: History,
) -> list[Alarm]:
    """Keep trips of a suspension in the store, and the alarms that its whole history raises.

    Raises
    ------
    HistoryError
        If the store cannot be used.
    """
    vehicle, outputs = models[0].vehicle.name, models[0].task.outputs
    every = with_earlier(results, place, models, store)
    era = of_last_era(every, commissionings(models, every))
    watched = watch_trips(era, store.events(vehicle, place), outputs, limits, settings)
    store.keep_alarms(vehicle, place, watched.alarms, OWN_CAUSES)
    return watched.alarms


def covariates(results: Sequence[TripResult]) -> dict[str, list[float]]:
    """Return what changes stiffness and damping without wear: pay-load, speed, temperature."""
    return {
        "pay-load": [r.estimates.get(PAYLOAD, np.nan) for r in results],
        "speed": [r.quality.speed_m_per_s for r in results],
        "temperature": [r.temperature_c for r in results],
    }
