"""The foreign trains of the benchmarks: cases of tests/rich_train.py, and their sensors."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

TESTS = Path(__file__).parents[1] / "tests"
sys.path.insert(0, str(TESTS))

from rich_effects import FAMILY, OF_THE_TRIP  # noqa: E402
from rich_train import RichTrain  # noqa: E402

SPEED = 70.0
NOT_LINEAR = ("blow_off", "friction")
NOT_IN_TIME = ("sensors", "wheelsets")
"""Effects of trips that stepping in time does not have."""


@dataclass(frozen=True)
class Case:
    """Effects of a train, where its sensors are, "mean" of a pair or "left", and its speeds.

    `tracks` are the least and the largest amplitude of its tracks over the usual one, [-].
    """

    effects: tuple[str, ...] = ()
    sides: str = "mean"
    speeds: tuple[float, float] | None = None
    tracks: tuple[float, float] | None = None

    def train(self, seed: int) -> RichTrain:
        """Return the train, with numbers of its own."""
        return RichTrain.scattered(seed, self.effects)

    def speeds_of(self, n_healthy: int, n_worn: int, seed: int) -> list[float]:
        """Return the speed of each trip, [m/s]: even over the range of healthy ones, else drawn."""
        return _spread(self.speeds or (SPEED, SPEED), n_healthy, n_worn, seed + 7)

    def roughness_of(self, n_healthy: int, n_worn: int, seed: int) -> list[float]:
        """Return the amplitude of each trip's track over the usual one, [-], as the speeds."""
        logs = np.log(self.tracks or (1.0, 1.0))
        return np.exp(_spread(logs, n_healthy, n_worn, seed + 8)).tolist()

    @property
    def lateral_m(self) -> list[float]:
        """Return the lateral place of each channel's sensor, [m]."""
        return [0.0 if self.sides == "mean" else 1.0] * 3


def _spread(between, n_even: int, n_drawn: int, seed: int) -> list[float]:
    """Return numbers between two ends: even ones, then drawn ones."""
    drawn = np.random.default_rng(seed).uniform(*between, n_drawn)
    return [*np.linspace(*between, n_even).tolist(), *drawn.tolist()]


CASES = {
    "none": Case(),
    **{name: Case((name,)) for name in FAMILY},
    "roll, left": Case(("roll",), "left"),
    "vertical all": Case(tuple(name for name in FAMILY if name != "roll")),
    "all": Case(FAMILY),
    "all, left": Case(FAMILY, "left"),
    "all, 48 to 78 m/s": Case(FAMILY, speeds=(48.0, 78.0)),
    **{
        f"all+{name}": Case((*FAMILY, name))
        for name in (*OF_THE_TRIP, "second_bending", "one_side", *NOT_LINEAR)
        if name not in NOT_IN_TIME
    },
    **{
        f"all+{name}, tracks of 0.6 to 1.5": Case((*FAMILY, name), tracks=(0.6, 1.5))
        for name in NOT_LINEAR
    },
    **{
        f"all+{name}, 48 to 78 m/s": Case((*FAMILY, name), speeds=(48.0, 78.0))
        for name in NOT_LINEAR
    },
}
