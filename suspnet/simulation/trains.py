"""Trains of several cars: where each suspension is, what it shares with the others, which wear."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from suspnet.ground.checks import check_number
from suspnet.ground.records import Place

FIRST_DAY = datetime(2015, 8, 3, 6, tzinfo=UTC)
"""Start of the first trip of the first train, a whole multiple of 20 minutes since 1970."""
HEADWAY = timedelta(minutes=20)
"""Time from the start of a train to that of the next one."""
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
        Of its true numbers, pay-load and noise.
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
