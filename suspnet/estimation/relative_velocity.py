"""Damping at equal relative velocity, for trips rougher, smoother or faster than the healthy ones.

A damper that blows off has the slope c up to the relative velocity v_b, and ``SLOPE_AFTER`` c
beyond. Dry friction parallel to a damper is a force that does not grow with velocity. With sigma
the rms relative velocity across a suspension, normal, statistical linearisation gives the damping::

    c g(sigma / v_b) + c_f,    g(y) = rho + (1 - rho) erf(1 / (sqrt(2) y))

(Roberts and Spanos, Random vibration and statistical linearization, 1990.) The friction's c_f goes
with sigma^-a: a is 1 where it slips, and 0 where it creeps before it slips, as that of rubber does.
With sigma_0 the geometric mean over the healthy trips, u = 1 / v_b [s/m] and s [-] such that
friction is the share s / (s + (1 - s) g(sigma_0 u)) of the healthy damping, an estimate x relative
to healthy is that of a damper at the ratio r with ::

    x = ((1 - s) r g(sigma u) + s k (sigma_0 / sigma)^a) / ((1 - s) g(sigma_0 u) + s)

The friction is that of rubber or leaves: it does not wear with the damper, but changes as much as
the spring, k times; where it sticks it is a share s' of the spring, x = k (1 - s' + s' sigma_0 /
sigma). Worn dampers blow off at the same velocity, with less force. s is between 0 and the vehicle
file's `primary_friction_share`, s' up to a quarter of it, u between 0 and the inverse of
`primary_blow_off_m_per_s` or `secondary_blow_off_m_per_s`. Healthy trips of different sigma narrow
all of them (`suspnet.estimation.damping_laws`). Estimates are compared as r and k; draws of them
give the mean and the uncertainty, which widens the intervals.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np
import torch
from scipy.stats import norm, qmc
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.estimation.estimate import Estimate
from suspnet.ground.findings import Finding, together
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.vehicle import Vehicle

SUSPENSIONS = ((0, 1), (1, 2))
"""Sensors on both sides of primary and secondary suspension."""
CHANGING = {"k_p": 0, "c_p": 0, "c_s": 1}
"""Parameters that depend on the relative velocity, each with its suspension."""
UNKNOWN = ("s' of k_p", "s of c_p", "a of c_p", "u of c_p", "u of c_s")
"""What the law does not know, in the order of its numbers."""
NOTE = "damping_by_velocity"
"""Key of the law in the notes of a commissioning."""
SLOPE_AFTER = 0.2
"""rho, the slope beyond blow-off over that before it: assumed, as data sheets give 0.1 to 0.3."""
STUCK = 0.25
"""Largest s' over that of s: friction that slips for most of the time is no spring. Trips of a
train with rubber friction, on tracks of different roughness, gave s' / s of about 0.15."""
LEAST_RATIO = 0.01
"""Smallest ratio r of a damper next to friction, which may be all that is left of the damping."""
FASTER = 1.3
"""Velocity over the healthy trips' for which the loss of damping is reported."""
N_DRAWS = 256
"""Draws of s and u; their mean and spread are of log r, to a hundredth of that spread."""


@dataclass(frozen=True)
class DampingByVelocity:
    """The law of a commissioned vehicle.

    `healthy_m_per_s` (2,) is sigma_0 [m/s] of each suspension. `numbers`, `most` (5,) and
    `covariance` (5, 5) are the mean of ``UNKNOWN``, their upper ends and their covariance: normal,
    moved to 0 or to the upper end where beyond.
    """

    healthy_m_per_s: tuple[float, ...]
    numbers: tuple[float, ...]
    most: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        n_numbers = len(UNKNOWN)
        shapes = {"healthy_m_per_s": 2, "numbers": n_numbers, "most": n_numbers}
        for name, n in shapes.items():
            values = tuple(getattr(self, name))
            if len(values) != n:
                raise ValueError(f"`{NOTE}.{name}` must be {n} numbers, got {values}")
            for value in values:
                if name == "healthy_m_per_s":
                    check_number(f"{NOTE}.{name}", value, above=0)
                else:
                    check_number(f"{NOTE}.{name}", value, low=0)
            object.__setattr__(self, name, values)
        rows = tuple(tuple(row) for row in self.covariance)
        wrong = f"`{NOTE}.covariance` must be 5 x 5, symmetric, without negative variances"
        if len(rows) != n_numbers or any(len(row) != n_numbers for row in rows):
            raise ValueError(wrong)
        for row in rows:
            for value in row:
                check_number(f"{NOTE}.covariance", value)
        matrix = np.array(rows)
        scale = np.abs(matrix).max()
        if (matrix != matrix.T).any() or np.linalg.eigvalsh(matrix).min() < -1e-9 * scale:
            raise ValueError(wrong)
        object.__setattr__(self, "covariance", rows)

    def __str__(self) -> str:
        primary, secondary = (1000 * velocity for velocity in self.healthy_m_per_s)
        losses = []
        for name, i in CHANGING.items():
            healthy = self.healthy_m_per_s[i]
            parts = linear(self.draws(), name, FASTER * healthy, healthy)
            remaining = torch.stack(parts).sum(dim=0).numpy()
            low, high = np.quantile(100 * (1 - remaining), [0.05, 0.95])
            losses.append(Finding("loss", name=name, low=max(low, 0.0), high=max(high, 0.0)))
        return Finding(
            "compared-at-velocities",
            primary=primary,
            secondary=secondary,
            more=100 * (FASTER - 1),
            losses=together(losses, ", "),
        )

    @classmethod
    def noted(cls, training: Mapping[str, Any]) -> Self | None:
        """Return the law from the record of a model's training; None if it has none."""
        note = training.get("commissioned", {}).get(NOTE)
        return cls(**note) if note else None

    def draws(self) -> Tensor:
        """Return draws of the numbers, (n_draws, 5)."""
        power, vectors = np.linalg.eigh(np.array(self.covariance))
        spread = _standard() @ (vectors * np.sqrt(np.clip(power, 0.0, None))).T
        return torch.as_tensor(np.clip(np.array(self.numbers) + spread, 0.0, self.most))

    def compared(self, estimate: Estimate, velocities_m_per_s: Sequence[float]) -> Estimate:
        """Return a trip's estimate with damping as it would be at the healthy trips' velocities.

        `velocities_m_per_s` are the trip's sigma of each suspension, from `relative_velocities`.
        """
        values, low, high = (part.copy() for part in (estimate.values, estimate.low, estimate.high))
        z, numbers = norm.ppf((1 + estimate.level) / 2), self.draws()
        springs: FloatArray = np.ones(len(values))
        for name, i in CHANGING.items():
            if name not in estimate.names:
                continue
            j = estimate.names.index(name)
            law = linear(numbers, name, velocities_m_per_s[i], self.healthy_m_per_s[i])
            slope, offset = (part.numpy()[:, None] for part in law)
            offset = offset * springs
            logs = np.log(np.maximum((estimate.values[:, j] - offset) / slope, LEAST_RATIO))
            values[:, j] = np.exp(logs.mean(axis=0))
            if name == "k_p":
                springs = values[:, j]
            # friction is the same absolute amount of a small damping and of a large one
            gain = np.maximum(estimate.values[:, j] / (slope.mean() * values[:, j]), 1.0)
            for end, sign in ((low, -1), (high, 1)):
                with np.errstate(divide="ignore", over="ignore"):  # an interval may reach 0
                    half = gain * np.log(end[:, j] / estimate.values[:, j])
                    end[:, j] = values[:, j] * np.exp(sign * np.hypot(half, z * logs.std(axis=0)))
        return replace(estimate, values=values, low=low, high=high)


def linear(
    numbers: Tensor, name: str, own_m_per_s: float, healthy_m_per_s: float
) -> tuple[Tensor, Tensor]:
    """Return slope and offset of an estimate over the part's ratio, each (n_rows,), [-].

    `numbers` (n_rows, 5) are those of ``UNKNOWN``, `name` is of ``CHANGING``. The offset is that of
    a healthy spring.
    """
    slower = healthy_m_per_s / own_m_per_s
    if name == "k_p":
        return 1 - numbers[:, 0] + numbers[:, 0] * slower, torch.zeros_like(numbers[:, 0])
    is_primary = name == "c_p"
    share = numbers[:, 1] if is_primary else torch.zeros_like(numbers[:, 1])
    inverse = numbers[:, 3 if is_primary else 4]
    whole = (1 - share) * _slope(healthy_m_per_s * inverse) + share
    slope = (1 - share) * _slope(own_m_per_s * inverse) / whole
    return slope, share * slower ** numbers[:, 2] / whole


def _slope(over_blow_off: Tensor) -> Tensor:
    """Return g(y), which does not depend on the sign of y and has no edge at 0."""
    small = over_blow_off.abs().clamp(min=1e-3)
    return SLOPE_AFTER + (1 - SLOPE_AFTER) * torch.erf(1 / (math.sqrt(2) * small))


def most(vehicle: Vehicle) -> FloatArray:
    """Return the upper ends of the numbers of ``UNKNOWN`` for a vehicle, (5,)."""
    ends = vehicle.primary_blow_off_m_per_s, vehicle.secondary_blow_off_m_per_s
    share = vehicle.primary_friction_share
    return np.array(
        [STUCK * share, share, float(share > 0), *(0.0 if v is None else 1 / v for v in ends)]
    )


def prior(vehicle: Vehicle) -> tuple[FloatArray, FloatArray]:
    """Return prior mean and standard deviation of ``UNKNOWN``, (5,) each, of uniform numbers."""
    return most(vehicle) / 2, most(vehicle) / math.sqrt(12)


def relative_velocities(spectra: CrossSpectra, frequencies_hz: Tensor) -> FloatArray:
    """Return the rms relative velocity across each suspension, (2,), [m/s].

    `spectra` (3, n_freq) are those of a trip on bins `frequencies_hz` (n_freq,).
    """
    powers = []
    for x, y in SUSPENSIONS:
        between = spectra.auto[x] + spectra.auto[y] - 2 * spectra.between(x, y).real
        powers.append(between.clamp(min=0.0) / (2 * math.pi * frequencies_hz) ** 2)
    total = torch.trapezoid(torch.stack(powers), frequencies_hz.expand(len(powers), -1))
    return np.asarray(total.sqrt().cpu().numpy())


@cache
def _standard() -> FloatArray:
    """Return standard normal points that fill the space evenly, (n_draws, 5)."""
    points = qmc.Sobol(len(UNKNOWN), scramble=True, rng=0).random(N_DRAWS)
    return np.asarray(norm.ppf(points))
