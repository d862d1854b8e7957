"""Springs and dampers of a vehicle.

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
(1 + 1.4 eta) k at 20 Hz. Dry friction beside a secondary spring is the same ladder, shifted to add
nothing at ``SLIDES_HZ``. Its eta k_s is that of the healthy, empty vehicle: it is assumed not to
wear, and to be the same on all trips.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

LOSS_HZ = (0.2, 1.0, 5.0, 25.0)
"""Relaxation frequencies of the branches that represent a loss factor, [Hz]."""
LOSS_SHARES = (1.377, 1.004, 0.979, 1.421)
"""Stiffness of each branch over eta k: the minimax fit of a loss of 1 from 0.3 to 20 Hz."""
SLIDES_HZ = 0.5
"""Frequency at which dry friction is taken to add no stiffness, as motions are large, [Hz]."""
LOSS_REFERENCE_HZ = 2.7
"""Frequency at which the ladder does not change the stiffness, the middle of its band, [Hz]."""
RAIL_LATERAL_M = 0.75
"""Half distance of the rails' centres at standard gauge [m]."""
LEAST_DAMPING = 1e-3
"""Damping of a yaw damper that is as good as none [N s/m]."""


@dataclass(frozen=True)
class Layout:
    """Parts of a vehicle and places of its sensors, as the fields of ``VerticalVehicle``.

    `empty_body_kg`: M_s without payload [kg], for which the bending frequency holds; `floors`:
    places of sensors of the body that stand on local floors; `speed_scatter`: standard deviation of
    the speed over its mean [-], which only a ``SpatialVehicle`` has, as floors.
    """

    bogie: str
    axle: str
    frame_sensor: str
    body_sensor_m: float
    parts: tuple[str, ...]
    empty_body_kg: float
    floors: tuple[str, ...] = ()
    speed_scatter: float = 0.0


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
        """Return kappa at angular frequencies (n_freq,) [rad/s], (n_vehicles, n_freq), [N/m].

        The shape is (n_vehicles, n_elements, n_freq) of elements that are `stacked`.
        """
        real, imaginary = self.stiffness, torch.zeros_like(self.stiffness)
        if self.damping is not None:
            imaginary = imaginary + self.damping * omega
        if self.loss is not None:
            lossy, (stored, lost) = self.loss * self.stiffness, _ladder(omega)
            real, imaginary = real + lossy * stored, imaginary + lossy * lost
        square = omega.square()
        for stiffness, rate in self.branches:
            share = stiffness * omega / (square + rate.square())
            real = torch.addcmul(real, share, omega)
            imaginary = torch.addcmul(imaginary, share, rate)
        return torch.complex(*torch.broadcast_tensors(real, imaginary))

    def of_damper(self, omega: Tensor) -> Tensor:
        """Return the stroke of its damper over its stretch, (n_vehicles, n_freq), [-].

        The damper is alone, or in series with the spring of the first branch.
        """
        if self.damping is not None:
            return torch.ones_like(self.damping * omega, dtype=torch.complex128)
        _, rate = self.branches[0]
        return rate / torch.complex(*torch.broadcast_tensors(rate, omega))

    @classmethod
    def stacked(cls, elements: Sequence[Element]) -> Element:
        """Return elements as one, its numbers and kappa of shape (n_vehicles, n_elements, ...).

        What an element has not is 0.
        """
        none = torch.zeros_like(elements[0].stiffness)

        def column(values: Iterable[Tensor | None]) -> Tensor:
            return torch.stack([none if value is None else value for value in values], dim=1)

        # branches of stiffness 0 fill up those elements that have fewer than others
        n_branches = max(len(element.branches) for element in elements)
        absent = none, torch.ones_like(none)
        padded = [[*element.branches, *[absent] * n_branches] for element in elements]
        branches = [[of_element[j] for of_element in padded] for j in range(n_branches)]
        return cls(
            column(element.stiffness for element in elements),
            column(element.damping for element in elements),
            [(column(b for b, _ in pairs), column(r for _, r in pairs)) for pairs in branches],
            column(element.loss for element in elements),
        )

    def times(self, factor: float) -> Element:
        """Return as many of these elements side by side as a factor."""
        return Element(
            self.stiffness * factor,
            None if self.damping is None else self.damping * factor,
            [(factor * stiffness, rate) for stiffness, rate in self.branches],
            self.loss,
        )

    def causal(self) -> tuple[float, float, dict[float, float]]:
        """Return stiffness [N/m], damping [N s/m] and branches of one vehicle for motion in time.

        The branches map a rate [1/s] to a stiffness [N/m]; they include the ladder of a loss
        factor.
        """
        stiffness = float(self.stiffness)
        damping = 0.0 if self.damping is None else float(self.damping)
        pairs = [(float(b), float(rate)) for b, rate in self.branches]
        if self.loss is not None:
            lossy = float(self.loss) * stiffness
            rates = 2 * math.pi * np.array(LOSS_HZ)
            pairs += zip(lossy * np.array(LOSS_SHARES), rates.tolist(), strict=True)
            square = (2 * math.pi * LOSS_REFERENCE_HZ) ** 2
            stiffness -= lossy * float(np.dot(LOSS_SHARES, square / (square + rates**2)))
        branches: dict[float, float] = {}
        for b, rate in pairs:
            branches[rate] = branches.get(rate, 0.0) + float(b)
        return stiffness, damping, branches


def _ladder(omega: Tensor) -> tuple[Tensor, Tensor]:
    """Return real and imaginary part of Lambda at angular frequencies [rad/s], (n_freq,), [-]."""
    stored, lost = torch.zeros_like(omega), torch.zeros_like(omega)
    square, reference = omega.square(), (2 * math.pi * LOSS_REFERENCE_HZ) ** 2
    for loss_hz, share in zip(LOSS_HZ, LOSS_SHARES, strict=True):
        rate = 2 * math.pi * loss_hz
        branch = share / (square + rate**2)
        stored = stored + square * branch - share * reference / (reference + rate**2)
        lost = lost + rate * omega * branch
    return stored, lost


def primary_element(
    p: Mapping[str, Tensor], prefix: str, parts: Sequence[str], place: str = ""
) -> Element:
    """Return the primary suspension of the measured ("") or the other bogie ("other_").

    `place` is the end of the names of its numbers, "" or that of a corner, "_axle1_left".
    """
    stiffness, damping = p[f"{prefix}k_p{place}"], p[f"{prefix}c_p{place}"]
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


def secondary_element(
    p: Mapping[str, Tensor], prefix: str, parts: Sequence[str], place: str = ""
) -> Element:
    """Return the secondary suspension of the measured ("") or the other bogie ("other_").

    `place` is the end of the names of its numbers, "" or that of a side, "_left".
    """
    stiffness, damping = p[f"{prefix}k_s{place}"], p[f"{prefix}c_s{place}"]
    spring, loss = stiffness, None
    if "nonlinear_dampers" in parts:
        friction = p["secondary_loss"] * p["healthy_k_s"]
        stored, _ = _ladder(torch.full_like(friction, 2 * math.pi * SLIDES_HZ))
        spring = stiffness - friction * stored
        loss = friction / spring
    if "air_spring" in parts:
        ratio = p["volume_ratio"]
        volumes = (1 - p["area_share"]).clamp(min=0.0) * stiffness
        orifice = damping * ((1 + ratio) / ratio) ** 2
        # k_1 + k_2 = volumes (1 + N)^2 / N
        rate = volumes * (1 + ratio) ** 2 / ratio / orifice
        return Element(spring, None, [(ratio * volumes, rate)], loss)
    if "bushings" in parts:
        bushing = p["secondary_bushing"]
        return Element(spring, None, [(bushing, bushing / damping)], loss)
    return Element(spring, damping, loss=loss)


def guidance_element(p: Mapping[str, Tensor]) -> Element:
    """Return the axle guidance of one bogie side, which acts on its pitch times a."""
    return Element(
        p["guidance_stiffness"] * p["healthy_k_p"], p["guidance_damping"] * p["healthy_c_p"]
    )


def yaw_damper_element(p: Mapping[str, Tensor]) -> Element:
    """Return one yaw damper in series with its bushings."""
    damping = p["yaw_damping"]
    # the rate of the branch would be infinite without any damping
    damping = torch.where(damping.abs() < LEAST_DAMPING, LEAST_DAMPING, damping)
    return Element(
        torch.zeros_like(damping), None, [(p["yaw_bushing"], p["yaw_bushing"] / damping)]
    )


def links_of(p: Mapping[str, Tensor], parts: Sequence[str]) -> list[tuple[Element, Tensor, Tensor]]:
    """Return what links body and bogie along the train, for one side.

    Each is an element with its levers below the body's and above the bogie's centre [m].
    """
    body, bogie = p["body_lever"], p["bogie_lever"]
    links = []
    if "longitudinal" in parts:
        link = Element(p["longitudinal_stiffness"], p["longitudinal_damping"])
        links.append((link, body, bogie))
    if "yaw_dampers" in parts:
        height = p["yaw_height"]
        links.append((yaw_damper_element(p), body - height, bogie + height))
    return links


def lateral_element(p: Mapping[str, Tensor]) -> Element:
    """Return the lateral suspension between body and bogie, for one side."""
    return Element(p["lateral_stiffness"], p["lateral_damping"])


def mode_element(p: Mapping[str, Tensor], name: str, mass: Tensor | float) -> Element:
    """Return what holds a mode of this modal mass; with that when empty, payload stiffens none."""
    omega = 2 * math.pi * p[f"{name}_frequency"]
    return Element(mass * omega**2, 2 * p[f"{name}_damping"] * mass * omega)


def laden(p: dict[str, Tensor], empty_kg: float) -> dict[str, Tensor]:
    """Return the numbers with what the payload changes; the suspension is that when empty."""
    mass = p["M_s"] / empty_kg
    stiffer, tighter = mass ** p["stiffness_exponent"], mass ** p["damping_exponent"]
    changed = {name: p[name] * stiffer for name in p if name.startswith(("k_s", "other_k_s"))}
    changed |= {name: p[name] * tighter for name in p if name.startswith(("c_s", "other_c_s"))}
    # the stiffness of the empty body alone makes it fall with the root of the mass
    changed["bending_frequency"] = p["bending_frequency"] * mass ** (0.5 - p["bending_exponent"])
    changed["body_gyration"] = p["body_gyration"] * mass ** p["gyration_exponent"]
    return p | changed
