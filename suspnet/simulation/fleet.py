"""What a simulated fleet is: its trips, their track and journeys, and the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from suspnet.dynamics.journey import Journey, service_journey, steady_journey
from suspnet.dynamics.track import track_spectrum
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.recordings.manifest import CHANNELS
from suspnet.simulation.sensors import Sensor


@dataclass(frozen=True)
class Fleet:
    """Trips of one suspension over its mileage.

    Parameters
    ----------
    sensors : mapping
        A `Sensor`'s arguments for each of axle_box, bogie and body.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range.
    """

    n_trips: int = setting(
        30, "Number of trips, which lie evenly over the mileage", low=1, most=100000
    )
    last_mileage_km: float = setting(308_000.0, "Mileage of the last trip", "km", above=0, most=2e7)
    minutes: float = setting(20.0, "Length of a trip", "min", above=0, most=10000)
    speed_m_per_s: float = setting(
        70.0, "Steady or cruising speed, as the line's", "m/s", above=0, most=200
    )
    journey: Literal["steady", "service"] = setting(
        "steady",
        "Speed along a trip: the same throughout, or with start, stops and slower stretches",
    )
    n_stops: int = setting(1, "Number of stops of a service journey", low=0, most=1000)
    track: str = setting("german_low", "Roughness of the track, as the line's", rule="as track")
    short_waves: bool = setting(
        False,
        "Whether to add the short waves of a rail head to the track, below 2.5 m; not on roads",
    )
    sensors: Mapping[str, Mapping[str, Any]] | None = None
    sides: Literal["both", "left"] | None = setting(
        None,
        "Sensors at each place: one on the left and one on the right, or one alone; null is both "
        "if the vehicle has roll",
    )
    suspension: str = setting("simulated", "Name of the suspension in the manifests", rule="text")

    def __post_init__(self) -> None:
        check_settings(self)
        track_spectrum(self.track, self.short_waves)
        self.loggers()

    def loggers(self) -> dict[str, Sensor]:
        """Return each channel's sensor; those of Table II with 34 dB where none is given."""
        given = dict(self.sensors or {})
        if set(given) - set(CHANNELS):
            raise ValueError(f"`sensors` must be named as in {CHANNELS}, got {sorted(given)}")
        rates = dict(zip(CHANNELS, (5000.0, 2000.0, 2000.0), strict=True))
        return {
            name: Sensor(**({"rate_hz": rates[name]} | dict(given.get(name, {}))))
            for name in CHANNELS
        }

    def mileage_km(self) -> FloatArray:
        """Return the mileage of each trip, shape (n_trips,), [km]."""
        return self.last_mileage_km * np.arange(1, self.n_trips + 1) / self.n_trips

    def journey_of(self, seed: int) -> Journey:
        """Return the speed along one trip."""
        duration_s = 60 * self.minutes
        if self.journey == "steady":
            return steady_journey(self.speed_m_per_s, duration_s)
        return service_journey(self.speed_m_per_s, duration_s, self.n_stops, seed)
