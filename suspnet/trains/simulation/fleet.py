"""Simulated fleets: trips, the wear that these follow, and trains."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal

import numpy as np

from suspnet.ground.parameters import (
    BOGIE_PARTS,
    COMPONENTS,
    DIRECTIONS,
    ENDS,
    ESTIMATED,
    FORWARD,
    PARAMETERS,
    Direction,
    End,
    kind_of,
)
from suspnet.ground.records import Place
from suspnet.ground.settings import Setting, check_choice, check_number, check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.simulation.signals import Journey, Sensor, service_journey, steady_journey
from suspnet.vehicle.track import track_spectrum

EFFECTS = tuple("track cross_axis torsion second_bending body_torsion equipment floors".split())
"""Parts of ``SpatialVehicle`` that a scenario may add: a track on ballast, which gives way under
the wheelsets, sensors that read a share of the lateral motion, flexible modes, and local floors."""
FIRST_DAY = datetime(2015, 8, 3, 6, tzinfo=UTC)
"""Start of the first trip of the first train, a whole multiple of 20 minutes since 1970."""
HEADWAY = timedelta(minutes=20)  # time from the start of a train to that of the next one


@dataclass(frozen=True)
class Fleet:
    """Trips of one suspension over its mileage.

    `sensors` holds arguments of `Sensor` for axle_box, bogie and body, whose rates `rate_hz` takes
    the place of.
    """

    n_trips: int = setting(
        30, "Number of trips, which lie evenly over the mileage", low=1, most=100000
    )
    last_mileage_km: float = setting(
        308_000.0,
        "Mileage of the last trip; their dates are of a train that runs 5 hours a day at its speed",
        "km",
        above=0,
        most=2e7,
    )
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
    rate_hz: float | None = setting(
        None, "Sampling rate of all sensors; null is each one's own", "Hz", above=0, most=1e6
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
        track_spectrum(self.track)
        self.loggers()

    def loggers(self) -> dict[str, Sensor]:
        """Return each channel's sensor, by default with the rates of Table II and 34 dB SNR."""
        sensors = dict(self.sensors or {})
        if set(sensors) - set(CHANNELS):
            raise ValueError(f"`sensors` must be named as in {CHANNELS}, got {sorted(sensors)}")
        rates = dict(zip(CHANNELS, (5000.0, 2000.0, 2000.0), strict=True))
        common = {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        return {
            name: Sensor(**({"rate_hz": rates[name]} | dict(sensors.get(name, {})) | common))
            for name in CHANNELS
        }

    def mileage_km(self) -> FloatArray:
        """Return the mileage of each trip, shape (n_trips,), [km]."""
        return self.last_mileage_km * np.arange(1, self.n_trips + 1) / self.n_trips

    def direction_of(self, index: int) -> Direction:
        """Return the direction of one trip, counted from 0."""
        return DIRECTIONS[index % 2] if self.direction == "both" else self.direction

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
            "For each parameter or part that wears from_km, to_km and the ratio to healthy: 1 "
            "before, in a straight line between, ratio after",
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
    by_part: bool = setting(
        False,
        "Whether each spring and damper of the bogie is a part of its own, with 5 % of scatter; "
        "it is where changes name one, or with effects",
    )
    effects: Sequence[str] = setting(
        (),
        "What the vehicle has beyond the parts of the generator, with numbers of its own",
        rule=f"list of {', '.join(EFFECTS)}",
    )

    def __post_init__(self) -> None:
        check_settings(self, "scenario")
        if not self.mass_low <= self.mass_high:
            raise ValueError(f"need mass_low <= mass_high, got {self.mass_low}, {self.mass_high}")
        mappings = self.changes, *self.changes.values()
        if not all(isinstance(change, Mapping) for change in mappings):
            raise TypeError(f"`scenario.changes` must be a mapping of mappings: {self.changes!r}")
        for name, change in self.changes.items():
            if name not in ESTIMATED:
                raise ValueError(f"scenario `changes` must be named as in {ESTIMATED}: {name!r}")
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
        for effect in self.effects:
            check_choice("scenario.effects", effect, EFFECTS)
        if self.effects or set(self.changes) & set(BOGIE_PARTS):
            object.__setattr__(self, "by_part", True)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the ratios: of the parameters, or of each part."""
        return COMPONENTS if self.by_part else PARAMETERS

    def ratios(self, mileage_km: FloatArray, seed: int) -> FloatArray:
        """Return the ``outputs`` of each trip relative to healthy, (n_trips, n_outputs), [-].

        `mileage_km`: (n_trips,); `seed` is that of spread and payload. With separate parts, the
        change of a parameter such as c_p is that of each of its parts.
        """
        rng = np.random.default_rng(seed)
        n_trips, n_wearing = len(mileage_km), len(self.outputs) - 1
        ratios = np.ones((n_trips, n_wearing + 1))
        ratios[:, :-1] += self.spread * rng.uniform(-1, 1, size=(n_trips, n_wearing))
        ratios[:, -1] = rng.uniform(self.mass_low, self.mass_high, size=n_trips)
        for name, change in self.changes.items():
            start, end = change["from_km"], change["to_km"]
            span = end - start
            after = mileage_km > end if span == 0 else np.clip((mileage_km - start) / span, 0, 1)
            worn = [i for i, output in enumerate(self.outputs) if name in (output, kind_of(output))]
            ratios[:, worn] *= (1 + (change["ratio"] - 1) * after)[:, None]
        return ratios


@dataclass(frozen=True)
class SimulatedSuspension:
    """One suspension of a train, whose first trip starts at `first_start`.

    `train_seed` determines track and speed of each trip of the train, `seed` the suspension's true
    numbers, payload and noise. It follows the scenario if it `wears`.
    """

    train: str
    car: str
    bogie: End
    first_start: datetime
    train_seed: int
    seed: int
    wears: bool

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
        return self.trains * (self.cars or 1) * len(ENDS)

    def suspensions(self, seed: int) -> list[SimulatedSuspension]:
        """Return every suspension; its own seed depends only on its place and on `seed`.

        The suspensions that wear are drawn at random.
        """
        candidates: list[SimulatedSuspension] = []
        lots: list[int] = []
        for train in range(1, self.trains + 1):
            shared = _seeds(seed, train)[0]
            first_start = FIRST_DAY + HEADWAY * (train - 1)
            for car in range(1, (self.cars or 1) + 1):
                for i, bogie in enumerate(ENDS):
                    own, lot = _seeds(seed, train, car, i + 1)
                    place = str(train), str(car), bogie, first_start, shared
                    candidates.append(SimulatedSuspension(*place, own, False))
                    lots.append(lot)
        wearing = sorted(range(self.n_all), key=lots.__getitem__)[: self.n_wearing]
        return [replace(own, wears=i in wearing) for i, own in enumerate(candidates)]


def _seeds(seed: int, *place: int) -> tuple[int, int]:
    """Return two numbers that depend only on the seed and the place.

    `place` is the number of a train, optionally with those of a car and a bogie, all from 1.
    """
    first, second = np.random.SeedSequence([seed, *b"trains", *place]).generate_state(2)
    return int(first), int(second)
