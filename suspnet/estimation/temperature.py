"""Damping at equal temperature, for trips warmer or colder than the healthy ones.

The oil of dampers, and rubber, lose damping as they get warmer. With T the temperature of a trip
and T_0 the mean of the healthy trips, the damping c of a suspension follows::

    log c(T) = log c(T_0) + b (T - T_0)

b [1/K] is normal, of primary and of secondary damping each; healthy trips of different temperatures
narrow it (`suspnet.trains.fits.bogie_misfit`). Estimates are compared at T_0, and the
uncertainty of b widens their intervals with abs(T - T_0). Springs change by a tenth of that and are
left alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.settings import check_number

DAMPINGS = ("c_p", "c_s")
"""Parameters that depend on the temperature."""
USUAL_SLOPE, SLOPE_DEVIATION = -0.004, 0.002
"""Prior mean and standard deviation of b, [1/K]; dampers lose more below -10 °C."""
NOTE = "damping_by_temperature"
"""Key of the law in the notes of a commissioning."""


@dataclass(frozen=True)
class DampingByTemperature:
    """The law of a commissioned vehicle.

    `healthy_c` is T_0 [°C]; `slopes` and `deviations` [1/K] are the mean and the standard deviation
    of b, of each of ``DAMPINGS``.
    """

    healthy_c: float
    slopes: tuple[float, ...] = (USUAL_SLOPE,) * len(DAMPINGS)
    deviations: tuple[float, ...] = (SLOPE_DEVIATION,) * len(DAMPINGS)

    def __post_init__(self) -> None:
        check_number(f"{NOTE}.healthy_c", self.healthy_c)
        for name in ("slopes", "deviations"):
            values = tuple(getattr(self, name))
            if len(values) != len(DAMPINGS):
                raise ValueError(f"`{NOTE}.{name}` must be {len(DAMPINGS)} numbers, got {values}")
            for value in values:
                check_number(f"{NOTE}.{name}", value)
            object.__setattr__(self, name, values)

    def __str__(self) -> str:
        each = [
            Finding("loss-per-kelvin", name=name, percent=-100 * slope, deviation=100 * deviation)
            for name, slope, deviation in zip(DAMPINGS, self.slopes, self.deviations, strict=True)
        ]
        return Finding(
            "damping-by-temperature", healthy_c=self.healthy_c, each=together(each, " and ")
        )

    @classmethod
    def noted(cls, training: Mapping[str, Any]) -> Self | None:
        """Return the law from the record of a model's training; None if it has none."""
        note = training.get("commissioned", {}).get(NOTE)
        return cls(**note) if note else None


def kelvins_warmer(temperatures_c: Sequence[float | None]) -> tuple[float | None, list[float]]:
    """Return the mean of the known temperatures of trips [°C], and each one's difference to it [K].

    The mean is None if none is known; the difference of a trip of unknown temperature is 0.
    """
    measured = [temperature_c for temperature_c in temperatures_c if temperature_c is not None]
    if not measured:
        return None, [0.0] * len(temperatures_c)
    mean = float(np.mean(measured))
    return mean, [
        0.0 if temperature_c is None else temperature_c - mean for temperature_c in temperatures_c
    ]
