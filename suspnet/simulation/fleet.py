"""What is simulated: a fleet's trips, the wear that they follow, and the trains they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

import numpy as np

from suspnet.dynamics import PARAMETERS
from suspnet.dynamics.track_spectra import track_spectrum
from suspnet.ground.checks import check_choice, check_flag, check_number
from suspnet.ground.records import HIGHEST_KM, Place
from suspnet.ground.types import FloatArray
from suspnet.recordings.manifest import CHANNELS
from suspnet.simulation.signals import Journey, Sensor, service_journey, steady_journey

FIRST_DAY = datetime(2015, 8, 3, 6, tzinfo=UTC)
"""Start of the first trip of the first train, a whole multiple of 20 minutes since 1970."""
HEADWAY = timedelta(minutes=20)
"""Time from the start of a train to that of the next one."""


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
        A name of ``suspnet.dynamics.track_spectra.TRACKS``.
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


@dataclass(frozen=True)
class Scenario:
    """Ratios to healthy as functions of the mileage.

    Parameters
    ----------
    name : str
    changes : mapping
        From a name of ``PARAMETERS`` to `from_km`, `to_km` and `ratio`: 1 before, in a straight
        line between, `ratio` after. A step where the two mileages are equal.
    spread : float, [-]
        On each trip k_p, c_p, k_s and c_s are also multiplied by a factor uniform in 1 +- spread.
    mass_low, mass_high : float, [-]
        The car-body mass is uniform between these on each trip: payload.

    Raises
    ------
    TypeError, ValueError
        If a name is unknown or a number is out of range.
    """

    name: str
    changes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    spread: float = 0.0
    mass_low: float = 0.9
    mass_high: float = 1.2

    def __post_init__(self) -> None:
        check_number("scenario.spread", self.spread, low=0, below=1)
        check_number("scenario.mass_low", self.mass_low, above=0)
        check_number("scenario.mass_high", self.mass_high, above=0)
        if not self.mass_low <= self.mass_high:
            raise ValueError(f"need mass_low <= mass_high, got {self.mass_low}, {self.mass_high}")
        for name, change in self.changes.items():
            if name not in PARAMETERS:
                raise ValueError(f"scenario `changes` must be named as in {PARAMETERS}: {name!r}")
            if set(change) != {"from_km", "to_km", "ratio"}:
                raise ValueError(
                    f"scenario change of {name!r} needs from_km, to_km, ratio: {sorted(change)}"
                )
            where = f"scenario.changes.{name}"
            check_number(f"{where}.from_km", change["from_km"])
            check_number(f"{where}.to_km", change["to_km"])
            check_number(f"{where}.ratio", change["ratio"], above=0)
            if change["from_km"] > change["to_km"]:
                raise ValueError(f"`{where}`: need from_km <= to_km, got {dict(change)}")

    def ratios(self, mileage_km: FloatArray, seed: int) -> FloatArray:
        """Return the parameters of each trip relative to healthy, shape (n_trips, 5), [-].

        Parameters
        ----------
        mileage_km : array of shape (n_trips,), [km]
        seed : int
            Of spread and payload.
        """
        rng = np.random.default_rng(seed)
        ratios = np.ones((len(mileage_km), len(PARAMETERS)))
        ratios[:, :4] += self.spread * rng.uniform(-1, 1, size=(len(mileage_km), 4))
        ratios[:, 4] = rng.uniform(self.mass_low, self.mass_high, size=len(mileage_km))
        for name, change in self.changes.items():
            start, end = change["from_km"], change["to_km"]
            span = end - start
            after = mileage_km > end if span == 0 else np.clip((mileage_km - start) / span, 0, 1)
            ratios[:, PARAMETERS.index(name)] *= 1 + (change["ratio"] - 1) * after
        return ratios


Bogie = Literal["leading", "trailing"]
BOGIES: tuple[Bogie, ...] = ("leading", "trailing")
"""Those of a car, in the direction of travel."""


@dataclass(frozen=True)
class Aboard:
    """Where on a train a suspension is, and what its trips share with the others there.

    Parameters
    ----------
    train, car : str
    bogie : {"leading", "trailing"}
    first_start : datetime
        Of the train's first trip.
    seed : int
        Of what the suspensions of a train share: on each trip its track and its speed.
    """

    train: str
    car: str
    bogie: Bogie
    first_start: datetime
    seed: int

    @property
    def name(self) -> str:
        """Name of the folder of its trips."""
        return f"train_{self.train}_car_{self.car}_{self.bogie}"

    def place(self, suspension: str) -> Place:
        """Return which suspension it is, under the name that the manifests give it."""
        return Place(suspension.strip(), bogie=self.bogie, train=self.train, car=self.car)


@dataclass(frozen=True)
class Trains:
    """Trains of some cars, each with a suspension at its leading and at its trailing bogie.

    Parameters
    ----------
    n_trains : int
    n_cars : int
        Of each train.
    n_wearing : int, optional
        Number of suspensions that follow the scenario, while the others stay healthy. None: all.

    Raises
    ------
    TypeError, ValueError
        If a number is out of range.
    """

    n_trains: int = 1
    n_cars: int = 1
    n_wearing: int | None = None

    def __post_init__(self) -> None:
        check_number("trains", self.n_trains, low=1, most=1000, whole=True)
        check_number("cars", self.n_cars, low=1, most=100, whole=True)
        check_number("n_wearing", self.n_wearing, low=0, most=self.n_all, whole=True, optional=True)

    @property
    def n_all(self) -> int:
        """Number of suspensions."""
        return self.n_trains * self.n_cars * len(BOGIES)

    def suspensions(self, seed: int) -> list[Suspension]:
        """Return every suspension, with a seed of its own that only its place and `seed` change.

        Those that wear are drawn by `seed` among all.
        """
        drawn: list[tuple[Aboard, int, int]] = []
        for train in range(1, self.n_trains + 1):
            shared = _seeds(seed, train)[0]
            first_start = FIRST_DAY + HEADWAY * (train - 1)
            for car in range(1, self.n_cars + 1):
                for i, bogie in enumerate(BOGIES):
                    aboard = Aboard(str(train), str(car), bogie, first_start, shared)
                    drawn.append((aboard, *_seeds(seed, train, car, i + 1)))
        by_lot = sorted(range(self.n_all), key=lambda i: drawn[i][2])
        wearing = set(by_lot[: self.n_wearing])
        return [Suspension(aboard, own, i in wearing) for i, (aboard, own, _) in enumerate(drawn)]


@dataclass(frozen=True)
class Suspension:
    """One suspension of some trains.

    Attributes
    ----------
    aboard : Aboard
    seed : int
        Of its true numbers, payload and noise.
    wears : bool
        Whether it follows the scenario.
    """

    aboard: Aboard
    seed: int
    wears: bool

    @property
    def name(self) -> str:
        """Name of the folder of its trips."""
        return self.aboard.name


def _seeds(seed: int, *place: int) -> tuple[int, int]:
    """Return two numbers that a seed and a place alone decide.

    The place is a train's number, with or without a car's and a bogie's, all counted from 1.
    """
    first, second = np.random.SeedSequence([seed, *b"trains", *place]).generate_state(2)
    return int(first), int(second)
