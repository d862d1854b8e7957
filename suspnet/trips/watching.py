"""Alarms of a suspension's trips: since its last commissioning, and anew after each maintenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.history import Event
from suspnet.history.records import TripResult
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.limits import Limits
from suspnet.maintenance.watch import Watched, watch
from suspnet.trips.earlier import between
from suspnet.trips.trend import PAYLOAD


def watch_trips(
    results: Sequence[TripResult],
    events: Sequence[Event],
    outputs: Sequence[str],
    limits: Mapping[str, Limits],
    settings: ChangeSettings,
    least_percent: Mapping[str, float],
) -> Watched:
    """Return the alarms of trips that are relative to one healthy state.

    Those that stood when maintenance was done end with it. What the detector can do is said of the
    trips since the last.

    Parameters
    ----------
    results : sequence of TripResult
        In any order; those without a mileage are left out.
    events : sequence of Event
    outputs : sequence of str
        Parameters; the car-body mass is a covariate, as are speed and temperature.
    limits, settings, least_percent
        Of ``watch``.
    """
    names = [name for name in outputs if name != PAYLOAD]
    ends = [*sorted(event.mileage_km for event in events), np.nan]
    alarms = []
    found = Watched()
    for trips, end in zip(between(events, results), ends, strict=True):
        found = watch(
            [r.mileage_km for r in trips],
            {name: [r.estimates.get(name, np.nan) for r in trips] for name in names},
            {name: [r.half_widths.get(name, np.nan) for r in trips] for name in names},
            [bool(r.flags) for r in trips],
            covariates(trips),
            limits,
            settings,
            least_percent,
        )
        alarms += [replace(one, end_km=end) if one.is_open else one for one in found.alarms]
    return replace(found, alarms=alarms)


def covariates(results: Sequence[TripResult]) -> dict[str, list[float]]:
    """Return what changes stiffness and damping without wear: pay-load, speed, temperature."""
    return {
        "pay-load": [r.estimates.get(PAYLOAD, np.nan) for r in results],
        "speed": [r.quality.speed_m_per_s for r in results],
        "temperature": [r.temperature_c for r in results],
    }
