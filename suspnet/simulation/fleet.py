"""Simulated fleets: trips, the wear that these follow, trains, and true numbers of vehicles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal

import numpy as np
import torch

from suspnet.dynamics import PARAMETERS, QuarterCar, VerticalVehicle
from suspnet.dynamics.quantities import MEDIANS, QUANTITIES, UNMEASURED, LogNormal
from suspnet.dynamics.track import track_spectrum
from suspnet.ground.parameters import DIRECTIONS, FORWARD, Direction
from suspnet.ground.records import Place
from suspnet.ground.settings import Setting, check_number, check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.recordings.manifest import CHANNELS
from suspnet.simulation.signals import (
    Journey,
    OutOfRound,
    Sensor,
    service_journey,
    steady_journey,
)

FIRST_DAY = datetime(2015, 8, 3, 6, tzinfo=UTC)
"""Start of the first trip of the first train, a whole multiple of 20 minutes since 1970."""
HEADWAY = timedelta(minutes=20)
"""Time from the start of a train to that of the next one."""
MAX_DRAWS = 100
"""Largest number of draws in the search for a physical vehicle."""
STREAM = b"scatter"
"""Part of the seed that makes these draws independent of those of trips and payload."""
HEALTHY = tuple(f"healthy_{name}" for name in PARAMETERS[:4])


@dataclass(frozen=True)
class Fleet:
    """Trips of one suspension over its mileage.

    `sensors` holds arguments of `Sensor` for axle_box, bogie and body.
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
    direction: Literal["forward", "reverse", "both"] = setting(
        FORWARD, "Direction of travel; both alternates from trip to trip, forward first"
    )
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
    wheel_order: int = setting(
        0,
        "Waves around the out-of-round wheels of the wheelset that is measured; 0 is round wheels",
        low=0,
        most=100,
    )
    wheel_mm: float = setting(
        0.2, "Amplitude of these waves, half of peak to valley", "mm", above=0, most=10
    )
    wheel_diameter_m: float = setting(0.92, "Diameter of these wheels", "m", low=0.2, most=2)

    def __post_init__(self) -> None:
        check_settings(self)
        track_spectrum(self.track, self.short_waves)
        self.loggers()

    def loggers(self) -> dict[str, Sensor]:
        """Return each channel's sensor, by default with the rates of Table II and 34 dB SNR."""
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

    def direction_of(self, index: int) -> Direction:
        """Return the direction of one trip, counted from 0."""
        return DIRECTIONS[index % 2] if self.direction == "both" else self.direction

    def wheels(self) -> OutOfRound | None:
        """Return the wheels of the wheelset that is measured, None if they are round."""
        if not self.wheel_order:
            return None
        return OutOfRound(self.wheel_order, 1e-3 * self.wheel_mm, self.wheel_diameter_m)

    def journey_of(self, seed: int) -> Journey:
        """Return the speed along one trip."""
        duration_s = 60 * self.minutes
        if self.journey == "steady":
            return steady_journey(self.speed_m_per_s, duration_s)
        return service_journey(self.speed_m_per_s, duration_s, self.n_stops, seed)


@dataclass(frozen=True)
class Scenario:
    """Ratios to healthy as functions of the mileage."""

    name: Annotated[str, Setting("Name of the scenario in folders and manifests", rule="text")]
    changes: Annotated[
        Mapping[str, Mapping[str, float]],
        Setting(
            "For each parameter that wears from_km, to_km and the ratio to healthy: 1 before, in a "
            "straight line between, ratio after",
            rule="mapping; from_km at most to_km; ratio above 0",
        ),
    ] = field(default_factory=dict)
    spread: float = setting(
        0.0, "Half width of factors drawn for stiffness and damping of each trip", low=0, below=1
    )
    mass_low: float = setting(
        0.9,
        "Least mass of the car body relative to the vehicle's, drawn for each trip; at most "
        "mass_high",
        above=0,
    )
    mass_high: float = setting(
        1.2, "Largest mass of the car body relative to the vehicle's", above=0
    )

    def __post_init__(self) -> None:
        check_settings(self, "scenario")
        if not self.mass_low <= self.mass_high:
            raise ValueError(f"need mass_low <= mass_high, got {self.mass_low}, {self.mass_high}")
        if not all(isinstance(one, Mapping) for one in (self.changes, *self.changes.values())):
            raise TypeError(f"`scenario.changes` must be a mapping of mappings: {self.changes!r}")
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
        """Return the parameters of each trip relative to healthy, (n_trips, 5), [-].

        `mileage_km`: (n_trips,); `seed` is that of spread and payload.
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
"""Bogies of a car, as it runs forward."""


@dataclass(frozen=True)
class Aboard:
    """Place of a suspension on a train, with the start of the train's first trip and its seed.

    The seed determines track and speed of each of its trips.
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
        """Return the place of the suspension, with its name in the manifests."""
        return Place(suspension.strip(), bogie=self.bogie, train=self.train, car=self.car)


@dataclass(frozen=True)
class Trains:
    """The suspensions of several trains; those that do not wear stay healthy."""

    trains: int = setting(
        1,
        "Number of trains of a fleet, each of whose suspensions has a subfolder of `out`, a "
        "vehicle of its own and starts, mileage, track and speed of its train; null is one "
        "suspension alone, in `out`",
        low=1,
        most=1000,
        rule="whole number; 1 to 1000; or null",
    )
    cars: int | None = setting(
        None,
        "Number of cars of each train, with a suspension at the leading and one at the trailing "
        "bogie; null is 1",
        low=1,
        most=100,
    )
    n_wearing: int | None = setting(
        None,
        "Number of suspensions of the fleet that follow the scenario, drawn by the seed, while "
        "nothing of the others wears; null is all",
        low=0,
    )

    def __post_init__(self) -> None:
        check_settings(self)
        check_number("n_wearing", self.n_wearing, most=self.n_all, whole=True, optional=True)

    @property
    def n_all(self) -> int:
        """Number of suspensions of all trains."""
        return self.trains * (self.cars or 1) * len(BOGIES)

    def suspensions(self, seed: int) -> list[Suspension]:
        """Return every suspension; its own seed depends only on its place and on `seed`.

        The suspensions that wear are drawn at random.
        """
        drawn: list[tuple[Aboard, int, int]] = []
        for train in range(1, self.trains + 1):
            shared = _seeds(seed, train)[0]
            first_start = FIRST_DAY + HEADWAY * (train - 1)
            for car in range(1, (self.cars or 1) + 1):
                for i, bogie in enumerate(BOGIES):
                    aboard = Aboard(str(train), str(car), bogie, first_start, shared)
                    drawn.append((aboard, *_seeds(seed, train, car, i + 1)))
        by_lot = sorted(range(self.n_all), key=lambda i: drawn[i][2])
        wearing = set(by_lot[: self.n_wearing])
        return [Suspension(aboard, own, i in wearing) for i, (aboard, own, _) in enumerate(drawn)]


@dataclass(frozen=True)
class Suspension:
    """One suspension of a train; it follows the scenario if it `wears`.

    `seed` determines its true numbers, payload and noise.
    """

    aboard: Aboard
    seed: int
    wears: bool

    @property
    def name(self) -> str:
        """Name of the folder of its trips."""
        return self.aboard.name


def _seeds(seed: int, *place: int) -> tuple[int, int]:
    """Return two numbers that depend only on the seed and the place.

    `place` is the number of a train, optionally with those of a car and a bogie, all from 1.
    """
    first, second = np.random.SeedSequence([seed, *b"trains", *place]).generate_state(2)
    return int(first), int(second)


def scattered(generator: Any, scatter: float, seed: int) -> Any:
    """Return a generator whose nominal vehicle has randomly drawn true numbers.

    They are drawn from ``LogNormal.prior`` of its parts, deviations multiplied by `scatter` (0 to
    5), until ``Vehicle`` accepts them and its motion decays. Of a quarter car the springs and
    dampers are drawn, the masses are not. ValueError if none of ``MAX_DRAWS`` vehicles is physical.
    """
    check_number("scatter", scatter, low=0, high=5)
    if scatter == 0:
        return generator
    if not isinstance(generator, QuarterCar | VerticalVehicle):
        raise TypeError(f"`scatter` needs a generator of suspnet, got {type(generator).__name__}")
    prior = LogNormal.prior(getattr(generator, "parts", ()))
    medians = np.array([MEDIANS[name] for name in prior.names])
    least = np.where((prior.offsets > 0) & (medians > 0), 0.0, -np.inf)  # others have either sign
    rng = np.random.default_rng([seed, *STREAM])
    for _ in range(MAX_DRAWS):
        steps = scatter * prior.deviations * rng.standard_normal(len(prior.names))
        logs = np.maximum(np.array(prior.mean) + steps, least)
        drawn = _with_numbers(generator, prior.names, logs)
        if drawn is not None and _decays(drawn):
            return drawn
    raise ValueError(
        f"none of {MAX_DRAWS} vehicles drawn with `scatter`={scatter} is physical; lower it"
    )


def true_numbers(generator: Any) -> dict[str, dict[str, Any]]:
    """Return value, unit and ratio to nominal of each true number of a generator's vehicle.

    The ratios of a quarter car are 1, as its vehicle holds the true numbers itself.
    """
    if isinstance(generator, QuarterCar):
        nominal, ratios = generator.vehicle.healthy_values()[:4], np.ones(4)
        names: tuple[str, ...] = HEALTHY
    else:
        names, nominal = UNMEASURED, generator.nominal_values()[len(PARAMETERS) :]
        given = generator.distribution or LogNormal((), (), ())
        medians = dict(zip(given.names, given.median, strict=True))
        ratios = np.array([medians.get(name, MEDIANS[name]) for name in names])
    parts = getattr(generator, "parts", ())
    known = {q.name: q for q in QUANTITIES if q.part in parts or (q.unit and not q.part)}
    return {
        name: {"value": value * float(ratio), "unit": known[name].unit, "ratio": float(ratio)}
        for name, value, ratio in zip(names, nominal, ratios, strict=True)
        if name in known and name != "speed"
    }


def _with_numbers(
    generator: QuarterCar | VerticalVehicle, names: tuple[str, ...], logs: FloatArray
) -> QuarterCar | VerticalVehicle | None:
    """Return the generator with its numbers multiplied; None if ``Vehicle`` rejects them."""
    certain = LogNormal(names, tuple(logs), ((0.0,) * len(names),) * len(names))
    ratios = dict(zip(names, certain.median.tolist(), strict=True))
    try:
        vehicle = generator.vehicle.degraded(
            **{name: ratios[healthy] for name, healthy in zip(PARAMETERS, HEALTHY, strict=False)}
        )
    except ValueError:
        return None
    if isinstance(generator, QuarterCar):
        return replace(generator, vehicle=vehicle)
    # Responses to five columns of ratios use the median of the distribution, here the true numbers.
    return replace(generator, distribution=certain)


def _decays(generator: QuarterCar | VerticalVehicle) -> bool:
    a, *_ = generator.motion_system(torch.ones(len(PARAMETERS))).state_space()
    return bool(np.linalg.eigvals(a).real.max() < 0)
