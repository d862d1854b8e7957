"""Damping under equal conditions, for trips warmer or rougher than the healthy ones.

The oil of dampers, and rubber, lose damping as they get warmer. Dampers that blow off or stick have
less of it the faster they move. With T the temperature of a trip, v the rms speed at which its
dampers are stretched, and T_0 and v_0 the means of the healthy trips, the damping c follows::

    log c = log c_0 + b (T - T_0) + a log(v / v_0)

b [1/K] and a [-] are normal, of primary and of secondary damping each; healthy trips of different
temperatures and speeds narrow them (`suspnet.trains.fits.bogie_misfit`). Estimates are compared at
T_0 and v_0, and the uncertainty of b and a widens their intervals with the distance from there.
Springs change by a tenth of that and are left alone. Only a vehicle with the part
nonlinear_dampers has a.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import kind_of
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray

DAMPINGS = ("c_p", "c_s")
"""Parameters that depend on the conditions, in the order of slopes: all b, then all a."""
USUAL_SLOPES = (-0.004, -0.004, -0.2, -0.2)
SLOPE_DEVIATIONS = (0.002, 0.002, 0.3, 0.3)
"""Prior means and standard deviations of b [1/K] and a [-]: dampers lose more below -10 °C, and a
is -1 where the force no longer depends on the speed, 0 for a linear damper."""
N_SLOPES = len(USUAL_SLOPES)
NOTE = "damping_law"
"""Key of the law in the notes of a commissioning."""


def _squared(deviations: Sequence[float]) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, np.diag(np.square(deviations)).tolist()))


@dataclass(frozen=True)
class DampingLaw:
    """The law of a commissioned vehicle.

    `healthy_c` is T_0 [°C], `healthy_m_per_s` v_0 of each of ``DAMPINGS``, each None if unknown;
    `slopes` (4,) and `covariance` (4, 4) are the mean and the covariance of b and a.
    """

    healthy_c: float | None
    healthy_m_per_s: tuple[float | None, ...] = (None,) * len(DAMPINGS)
    slopes: tuple[float, ...] = USUAL_SLOPES
    covariance: tuple[tuple[float, ...], ...] = _squared(SLOPE_DEVIATIONS)

    def __post_init__(self) -> None:
        if self.healthy_c is not None:
            check_number(f"{NOTE}.healthy_c", self.healthy_c)
        rows = tuple(tuple(row) for row in self.covariance)
        for name, values, n in (
            ("healthy_m_per_s", tuple(self.healthy_m_per_s), len(DAMPINGS)),
            ("slopes", tuple(self.slopes), N_SLOPES),
            ("covariance", sum(rows, ()), N_SLOPES**2),
        ):
            if len(values) != n:
                raise ValueError(f"`{NOTE}.{name}` must be {n} numbers, got {values}")
            for value in values:
                if value is not None or name != "healthy_m_per_s":
                    check_number(f"{NOTE}.{name}", value)
        object.__setattr__(self, "healthy_m_per_s", tuple(self.healthy_m_per_s))
        object.__setattr__(self, "slopes", tuple(self.slopes))
        object.__setattr__(self, "covariance", rows)

    @property
    def findings(self) -> list[str]:
        """A sentence on each condition that damping is compared at."""
        slopes, deviations = np.array(self.slopes), np.sqrt(np.diag(self.covariance))
        sentences: list[str] = []
        if self.healthy_c is not None:
            each = _losses(slopes[:2], deviations[:2])
            sentences.append(Finding("damping-by-temperature", healthy_c=self.healthy_c, each=each))
        if any(self.healthy_m_per_s):
            each = _losses(slopes[2:] / 10, deviations[2:] / 10)
            sentences.append(Finding("damping-by-speed", each=each))
        return sentences

    @classmethod
    def of_trips(
        cls, temperatures_c: Sequence[float | None], speeds_m_per_s: Sequence[FloatArray]
    ) -> Self:
        """Return the law before the healthy trips, compared at the means of what is known."""
        known = [temperature_c for temperature_c in temperatures_c if temperature_c is not None]
        speeds = np.exp(np.log(np.array(speeds_m_per_s)).mean(axis=0)).tolist()
        return cls(
            float(np.mean(known)) if known else None,
            tuple(speed if np.isfinite(speed) else None for speed in speeds),
        )

    @classmethod
    def noted(cls, training: Mapping[str, Any]) -> Self | None:
        """Return the law from the record of a model's training; None if it has none."""
        note = training.get("commissioned", {}).get(NOTE)
        return cls(**note) if note else None

    def conditions(self, temperature_c: float | None, speeds_m_per_s: FloatArray) -> FloatArray:
        """Return what the slopes of a trip are multiplied by, (4,); 0 where it is not known.

        `speeds_m_per_s` (2,) are those of ``DAMPINGS``, NaN if unknown.
        """
        is_known = temperature_c is not None and self.healthy_c is not None
        warmer = temperature_c - self.healthy_c if is_known else 0.0  # type: ignore[operator]
        healthy = np.array(self.healthy_m_per_s, float)
        faster = np.nan_to_num(np.log(speeds_m_per_s / healthy))
        return np.concatenate([np.full(len(DAMPINGS), warmer), faster])

    def shifts(
        self, names: Sequence[str], temperature_c: float | None, speeds_m_per_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what the conditions of a trip add to the logarithms of parts, and its covariance.

        Shapes (n_names,) and (n_names, n_names): the errors of the slopes are the same for all
        dampers of a kind.
        """
        factors = follows(names).T * self.conditions(temperature_c, speeds_m_per_s)
        return factors @ np.array(self.slopes), factors @ np.array(self.covariance) @ factors.T


def follows(names: Sequence[str]) -> FloatArray:
    """Return whether a part follows each slope, (4, n_names): 1 for dampers of the slope's kind.

    Those of the other bogie follow as those of the measured one do.
    """
    of_kind = [
        [kind_of(name) == damping or name == f"other_{damping}" for name in names]
        for damping in DAMPINGS
    ]
    return np.array(2 * of_kind, float)


def _losses(slopes: FloatArray, deviations: FloatArray) -> str:
    each = [
        Finding("loss-of-damping", name=name, percent=-100 * slope, deviation=100 * deviation)
        for name, slope, deviation in zip(DAMPINGS, slopes, deviations, strict=True)
    ]
    return together(each, " and ")
