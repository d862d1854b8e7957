"""What a simulated fleet is: its trips, their track and journeys, and the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from suspnet.dynamics.journey import Journey, service_journey, steady_journey
from suspnet.dynamics.track import track_spectrum
from suspnet.ground.checks import check_choice, check_flag, check_number
from suspnet.ground.records import HIGHEST_KM
from suspnet.ground.types import FloatArray
from suspnet.recordings.manifest import CHANNELS
from suspnet.simulation.sensors import Sensor


@dataclass(frozen=True)
class Fleet:
    """Trips of one suspension over its mileage.

    Parameters
    ----------
    n_trips : int
    last_mileage_km : float, [km]
        Of the last trip; the others lie evenly before it.
    minutes : float, [min]
        Length of a trip.
    speed_m_per_s : float, [m/s]
        Steady or cruising speed.
    journey : {"steady", "service"}
        At one speed throughout, or with start, stops and slower stretches.
    n_stops : int
        Of a service journey.
    track : str
        A name of ``suspnet.dynamics.track.TRACKS``.
    short_waves : bool
    sensors : mapping
        A `Sensor`'s arguments for each of axle_box, bogie and body.
    sides : {"both", "left"}, optional
        At each place one sensor on the left and one on the right, each with noise of its own, or
        one alone, where the generator places it. None: both if the generator has roll.
    suspension : str
        Free text for the manifests.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range.
    """

    n_trips: int = 30
    last_mileage_km: float = 308_000.0
    minutes: float = 20.0
    speed_m_per_s: float = 70.0
    journey: Literal["steady", "service"] = "steady"
    n_stops: int = 1
    track: str = "german_low"
    short_waves: bool = False
    sensors: Mapping[str, Mapping[str, Any]] | None = None
    sides: Literal["both", "left"] | None = None
    suspension: str = "simulated"

    def __post_init__(self) -> None:
        check_number("n_trips", self.n_trips, low=1, most=100_000, whole=True)
        check_number("n_stops", self.n_stops, low=0, most=1000, whole=True)
        check_flag("short_waves", self.short_waves)
        for name, most in (
            ("last_mileage_km", HIGHEST_KM),
            ("minutes", 1e4),
            ("speed_m_per_s", 200),
        ):
            check_number(name, getattr(self, name), above=0, most=most)
        check_choice("journey", self.journey, ("steady", "service"))
        if self.sides is not None:
            check_choice("sides", self.sides, ("both", "left"))
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
