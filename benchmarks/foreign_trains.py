"""The foreign trains of the benchmarks: cases of tests/rich_train.py, and their sensors."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

TESTS = Path(__file__).parents[1] / "tests"
sys.path.insert(0, str(TESTS))

from rich_effects import FAMILY, OF_THE_TRIP  # noqa: E402
from rich_train import RichTrain  # noqa: E402

SPEED = 70.0
NOT_LINEAR = ("blow_off", "friction")
IN_SPECTRA = ("sensors", "wheelsets")


@dataclass(frozen=True)
class Case:
    """Effects of a train, where its sensors are, "mean" of a pair or "left", and its speeds.

    `tracks` are the least and the largest amplitude of its tracks over the usual one, [-].
    `numbers` of the train are fixed instead of drawn; its worn trips alone have the `faults`.
    """

    effects: tuple[str, ...] = ()
    sides: str = "mean"
    speeds: tuple[float, float] | None = None
    tracks: tuple[float, float] | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    faults: Mapping[str, float] = field(default_factory=dict)

    @property
    def in_time_only(self) -> bool:
        """Whether the train has no exact spectra."""
        return bool(set(self.effects) & set(NOT_LINEAR) or self.tracks)

    @property
    def in_spectra_only(self) -> bool:
        """Whether trips in time do not have all effects of the train."""
        return bool(set(self.effects) & set(IN_SPECTRA) or self.faults)

    def train(self, seed: int, with_faults: bool = False) -> RichTrain:
        """Return the train of healthy trips, or that of worn trips."""
        faults = self.faults if with_faults else {}
        return RichTrain.scattered(seed, self.effects, **self.numbers, **faults)

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
    },
    **{
        f"all+wheelsets {100 * share:g} %": Case(
            (*FAMILY, "wheelsets"), numbers={"wheelset_share": share}
        )
        for share in (0.001, 0.01, 0.05)
    },
    **{
        f"all+{name}, tracks of 0.6 to 1.5": Case((*FAMILY, name), tracks=(0.6, 1.5))
        for name in NOT_LINEAR
    },
    **{
        f"all+{name}, 48 to 78 m/s": Case((*FAMILY, name), speeds=(48.0, 78.0))
        for name in NOT_LINEAR
    },
    "all+other bogie at 70 %": Case(FAMILY, faults={"other_c_s": 0.7}),
    "all+other bogie flat": Case(FAMILY, faults={"other_k_s": 8.0, "other_c_s": 0.1}),
}
