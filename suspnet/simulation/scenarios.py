"""Scenarios of wear: parameters of a suspension along the mileage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from suspnet.dynamics import PARAMETERS
from suspnet.ground.checks import check_number
from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.types import FloatArray


@dataclass(frozen=True)
class Scenario:
    """Ratios to healthy as functions of the mileage.

    Raises
    ------
    TypeError, ValueError
        If a name is unknown or a number is out of range.
    """

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
            Of spread and pay-load.
        """
        rng = np.random.default_rng(seed)
        ratios = np.ones((len(mileage_km), len(PARAMETERS)))
        ratios[:, :4] += self.spread * rng.uniform(-1, 1, size=(len(mileage_km), 4))
        ratios[:, 4] = rng.uniform(self.mass_low, self.mass_high, size=len(mileage_km))
        for name, change in self.changes.items():
            begin, end = change["from_km"], change["to_km"]
            span = end - begin
            after = mileage_km > end if span == 0 else np.clip((mileage_km - begin) / span, 0, 1)
            ratios[:, PARAMETERS.index(name)] *= 1 + (change["ratio"] - 1) * after
        return ratios
