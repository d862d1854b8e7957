"""Dynamic stiffness of springs and dampers, kappa(s) with s = j omega, batched over vehicles.

Each element is a spring, a damper and Maxwell branches (a spring b in series with a damper b / r)::

    kappa = k (1 + eta Lambda(s)) + c s + sum_i b_i s / (s + r_i)

A damper c in series with a bushing k_b is the branch b = k_b, r = k_b / c. Rubber adds a branch of
a fraction of k at about 5 Hz. An air spring with an auxiliary volume N times its own behind an
orifice (Nishimura) is k_1 in series with k_2 parallel to the orifice, all parallel to the stiffness
k_3 of the changing area: with k_s = k_3 + k_1 k_2 / (k_1 + k_2) and N = k_1 / k_2 this is the
branch b = N k_1 k_2 / (k_1 + k_2), r = (k_1 + k_2) / c. c_s is its damping at low frequency, c
times the square of k_1 / (k_1 + k_2).

A constant loss factor, j eta at every frequency, is not causal and has no motion in time. Instead,
Lambda(s) = sum_i l_i (s / (s + r_i) - (its real part at 2.7 Hz)) is a ladder of Maxwell branches
(``LOSS_HZ``, ``LOSS_SHARES``). From 0.3 to 20 Hz its imaginary part is 1 within 1.3 %; the
stiffness increases with frequency, as causality requires: (1 - 1.5 eta) k at 0.3 Hz, k at 2.7 Hz,
(1 + 1.4 eta) k at 20 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

LOSS_HZ = (0.2, 1.0, 5.0, 25.0)
"""Relaxation frequencies of the branches that represent a loss factor, [Hz]."""
LOSS_SHARES = (1.377, 1.004, 0.979, 1.421)
"""Stiffness of each branch over eta k: the minimax fit of a loss of 1 from 0.3 to 20 Hz."""
LOSS_REFERENCE_HZ = 2.7
"""Frequency at which the ladder does not change the stiffness, the middle of its band, [Hz]."""
RAIL_LATERAL_M = 0.75
"""Half distance of the rails' centres at standard gauge [m]."""


@dataclass(frozen=True)
class Layout:
    """Parts of a vehicle and places of its sensors, as the fields of ``VerticalVehicle``.

    `empty_body_kg`: M_s without payload [kg], for which the bending frequency holds.
    """

    bogie: str
    axle: str
    frame_sensor: str
    body_sensor_m: float
    parts: tuple[str, ...]
    empty_body_kg: float


@dataclass(frozen=True)
class Element:
    """A spring and damper with Maxwell branches, its numbers of shape (n_vehicles, 1).

    `stiffness` [N/m], `damping` [N s/m], `branches`: pairs of stiffness [N/m] and rate [1/s],
    `loss`: loss factor of the spring [-]; None is absent.
    """

    stiffness: Tensor
    damping: Tensor | None
    branches: Sequence[tuple[Tensor, Tensor]] = ()
    loss: Tensor | None = None

    def at(self, omega: Tensor) -> Tensor:
        """Return kappa at angular frequencies (n_freq,) [rad/s], (n_vehicles, n_freq), [N/m]."""
        real, imaginary = self.stiffness, torch.zeros_like(self.stiffness)
        if self.damping is not None:
            imaginary = imaginary + self.damping * omega
        if self.loss is not None:
            lossy, ladder = self.loss * self.stiffness, _ladder(omega)
            real, imaginary = real + lossy * ladder.real, imaginary + lossy * ladder.imag
        for stiffness, rate in self.branches:
            share = stiffness * omega / (omega**2 + rate**2)
            real, imaginary = real + share * omega, imaginary + share * rate
        return torch.complex(*torch.broadcast_tensors(real, imaginary))

    def causal(self) -> tuple[float, float, dict[float, float]]:
        """Return stiffness [N/m], damping [N s/m] and branches of one vehicle for motion in time.

        The branches map a rate [1/s] to a stiffness [N/m]; they include the ladder of a loss
        factor.
        """
        stiffness = float(self.stiffness)
        damping = 0.0 if self.damping is None else float(self.damping)
        given = [(float(one), float(rate)) for one, rate in self.branches]
        if self.loss is not None:
            lossy = float(self.loss) * stiffness
            rates = 2 * math.pi * np.array(LOSS_HZ)
            given += zip(lossy * np.array(LOSS_SHARES), rates.tolist(), strict=True)
            square = (2 * math.pi * LOSS_REFERENCE_HZ) ** 2
            stiffness -= lossy * float(np.dot(LOSS_SHARES, square / (square + rates**2)))
        branches: dict[float, float] = {}
        for one, rate in given:
            branches[rate] = branches.get(rate, 0.0) + float(one)
        return stiffness, damping, branches


def _ladder(omega: Tensor) -> Tensor:
    """Return Lambda at angular frequencies (n_freq,) [rad/s], complex (n_freq,), [-]."""
    rates = 2 * math.pi * torch.tensor(LOSS_HZ, dtype=omega.dtype, device=omega.device)
    shares = torch.tensor(LOSS_SHARES, dtype=omega.dtype, device=omega.device)
    square = (2 * math.pi * LOSS_REFERENCE_HZ) ** 2
    branches = 1j * omega[:, None] / (1j * omega[:, None] + rates)
    return ((branches - square / (square + rates**2)) * shares).sum(dim=1)


def primary_element(p: Mapping[str, Tensor], which: str, parts: Sequence[str]) -> Element:
    """Return the primary suspension of the measured ("") or the other bogie ("other_")."""
    stiffness, damping = p[which + "k_p"], p[which + "c_p"]
    branches: list[tuple[Tensor, Tensor]] = []
    if "bushings" in parts:
        branches.append((p["primary_bushing"], p["primary_bushing"] / damping))
    if "rubber" in parts:
        branches.append((p["rubber_share"] * stiffness, 2 * math.pi * p["rubber_frequency"]))
    return Element(
        stiffness,
        None if "bushings" in parts else damping,
        branches,
        p["rubber_loss"] if "rubber" in parts else None,
    )


def secondary_element(p: Mapping[str, Tensor], which: str, parts: Sequence[str]) -> Element:
    """Return the secondary suspension of the measured ("") or the other bogie ("other_")."""
    stiffness, damping = p[which + "k_s"], p[which + "c_s"]
    if "air_spring" in parts:
        ratio = p["volume_ratio"]
        volumes = (1 - p["area_share"]).clamp(min=0.0) * stiffness
        orifice = damping * ((1 + ratio) / ratio) ** 2
        # k_1 + k_2 = volumes (1 + N)^2 / N
        rate = volumes * (1 + ratio) ** 2 / ratio / orifice
        return Element(stiffness, None, [(ratio * volumes, rate)])
    if "bushings" in parts:
        bushing = p["secondary_bushing"]
        return Element(stiffness, None, [(bushing, bushing / damping)])
    return Element(stiffness, damping)


def guidance_element(p: Mapping[str, Tensor]) -> Element:
    """Return the axle guidance of one bogie side, which acts on its pitch times a."""
    return Element(
        p["guidance_stiffness"] * p["healthy_k_p"], p["guidance_damping"] * p["healthy_c_p"]
    )


def longitudinal_element(p: Mapping[str, Tensor]) -> Element:
    """Return the longitudinal links between body and bogie, for one side."""
    return Element(p["longitudinal_stiffness"], p["longitudinal_damping"])


def lateral_element(p: Mapping[str, Tensor]) -> Element:
    """Return the lateral suspension between body and bogie, for one side."""
    return Element(p["lateral_stiffness"], p["lateral_damping"])


def bending_element(p: Mapping[str, Tensor], empty_kg: float) -> Element:
    """Return the body's first bending per modal mass of M_s; payload does not stiffen it."""
    own = 2 * math.pi * p["bending_frequency"]
    return Element(empty_kg * own**2, 2 * p["bending_damping"] * empty_kg * own)
