"""Damping at equal relative velocity, for trips rougher, smoother or faster than the healthy ones.

Dampers that blow off lose damping as they move faster. Dry friction beside a damper is a force that
does not grow with velocity: where it slips, it is worth sqrt(2 / pi) F / sigma of damping. With
sigma the rms relative velocity across a suspension on a trip and sigma_0 its geometric mean over
the healthy trips, the damping of a healthy vehicle follows::

    c(sigma) = c(sigma_0) (sigma / sigma_0)^-d

d [-] is uniform from 0 to what the vehicle file allows for: `primary_friction_share`, as d is the
share of friction in the primary damping, and `secondary_degression`. Healthy trips of different
sigma narrow it (`suspnet.estimation.healthy_trips`). Friction does not wear with the damper beside
it: an estimate x relative to healthy is that of a damper at r with ::

    x = (1 - d) r + d sigma_0 / sigma        primary
    x = r (sigma / sigma_0)^-d               secondary

Estimates are compared as r, and the uncertainty of d widens their intervals by its deviation times
abs(d log r / d d).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from scipy.stats import norm
from torch import Tensor

from suspnet.dynamics import Vehicle
from suspnet.estimation.estimate import Estimate
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.spectra.cross_spectra import CrossSpectra

SUSPENSIONS = {"c_p": (0, 1), "c_s": (1, 2)}
"""Damping of each suspension, and the sensors on both sides of it."""
NOTE = "damping_by_velocity"
"""Key of the law in the notes of a commissioning."""
LEAST_RATIO = 0.01
"""Smallest ratio r of a damper beside friction, which may be all that is left of the damping."""


@dataclass(frozen=True)
class DampingByVelocity:
    """The law of a commissioned vehicle, each of primary and secondary damping.

    `healthy_m_per_s` is sigma_0 [m/s]; `exponents` and `deviations` [-] are the mean and the
    standard deviation of d.
    """

    healthy_m_per_s: tuple[float, ...]
    exponents: tuple[float, ...]
    deviations: tuple[float, ...]

    def __post_init__(self) -> None:
        limits = {"healthy_m_per_s": (0.0, math.inf), "exponents": (-1e-9, 0.9)}
        for name in ("healthy_m_per_s", "exponents", "deviations"):
            values = tuple(getattr(self, name))
            if len(values) != len(SUSPENSIONS):
                raise ValueError(f"`{NOTE}.{name}` must be {len(SUSPENSIONS)} numbers: {values}")
            above, most = limits.get(name, (-1e-9, math.inf))
            for value in values:
                check_number(f"{NOTE}.{name}", value, above=above, most=most)
            object.__setattr__(self, name, values)

    def __str__(self) -> str:
        at = " and ".join(f"{1000 * one:.3g}" for one in self.healthy_m_per_s)
        powers = [
            f"{name} falls with its power {d:.2g} ± {deviation:.1g}"
            for name, d, deviation in zip(SUSPENSIONS, self.exponents, self.deviations, strict=True)
            if d or deviation
        ]
        return (
            f"Damping is compared at {at} mm/s (rms) across primary and secondary suspension; "
            f"{' and '.join(powers)}."
        )

    @classmethod
    def noted(cls, training: Mapping[str, Any]) -> Self | None:
        """Return the law from the record of a model's training; None if it has none."""
        note = training.get("commissioned", {}).get(NOTE)
        return cls(**note) if note else None

    def compared(self, estimate: Estimate, velocities_m_per_s: Sequence[float]) -> Estimate:
        """Return a trip's estimate with damping as it would be at the healthy trips' velocities.

        `velocities_m_per_s` are the trip's sigma of each suspension, from `relative_velocities`.
        """
        values, low, high = (part.copy() for part in (estimate.values, estimate.low, estimate.high))
        z = norm.ppf((1 + estimate.level) / 2)
        rows = zip(SUSPENSIONS, self.exponents, self.deviations, self.healthy_m_per_s, strict=True)
        for (name, d, deviation, healthy), own in zip(rows, velocities_m_per_s, strict=True):
            if name not in estimate.names:
                continue
            j = estimate.names.index(name)
            found, slower = estimate.values[:, j], healthy / own
            if name == "c_p":
                ratio = np.maximum((found - d * slower) / (1 - d), LEAST_RATIO)
                slope, gain = np.abs(found - slower) / (1 - d) ** 2 / ratio, found / ratio / (1 - d)
            else:
                ratio = found * slower**-d
                slope, gain = np.full_like(found, abs(math.log(slower))), np.ones_like(found)
            values[:, j] = ratio
            for end, sign in ((low, -1), (high, 1)):
                with np.errstate(divide="ignore", over="ignore"):  # an interval may reach 0
                    half = gain * np.log(end[:, j] / found)
                    end[:, j] = ratio * np.exp(sign * np.hypot(half, z * deviation * slope))
        return replace(estimate, values=values, low=low, high=high)


def allowed(vehicle: Vehicle) -> FloatArray:
    """Return the largest d of primary and secondary damping, (2,), [-]."""
    return np.array([vehicle.primary_friction_share, vehicle.secondary_degression])


def prior(vehicle: Vehicle) -> tuple[FloatArray, FloatArray]:
    """Return the prior mean and standard deviation of d, each (2,), [-]."""
    return allowed(vehicle) / 2, allowed(vehicle) / math.sqrt(12)


def relative_velocities(spectra: CrossSpectra, frequencies_hz: Tensor) -> FloatArray:
    """Return the rms relative velocity across each suspension, (2,), [m/s].

    `spectra` (3, n_freq) are those of a trip on bins `frequencies_hz` (n_freq,).
    """
    powers = []
    for x, y in SUSPENSIONS.values():
        between = spectra.auto[x] + spectra.auto[y] - 2 * spectra.between(x, y).real
        powers.append(between.clamp(min=0.0) / (2 * math.pi * frequencies_hz) ** 2)
    total = torch.trapezoid(torch.stack(powers), frequencies_hz.expand(len(powers), -1))
    return np.asarray(total.sqrt().cpu().numpy())
