"""Motion in time of the vertical vehicle, assembled element by element.

Each spring, damper and Maxwell branch acts along a stretch u = g z - h w of coordinates z and
inputs w, and adds an outer product: k g g^T to the stiffness, k g h^T to that of the input. Letters
and equations are those of `suspnet.dynamics.vertical_response`. The coordinates are z and phi of
the body, z_i and psi_i of the measured bogie (1) and of the other one (2), q with bending, and with
roll the lateral displacement y of the body and the three roll angles. The inputs are the mean of
both rails under each wheelset, w, and with roll the angle of the track there, x.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from suspnet.dynamics.elements import (
    RAIL_LATERAL_M,
    Element,
    Layout,
    bending_element,
    guidance_element,
    lateral_element,
    longitudinal_element,
    primary_element,
    secondary_element,
)
from suspnet.dynamics.motion import Branch, LinearSystem
from suspnet.ground.types import FloatArray

BOGIES = (("", "1", 1.0, ("a", "b")), ("other_", "2", -1.0, ("c", "d")))
"""Each bogie: prefix of its numbers, suffix of its coordinates, sign of phi, its wheelsets."""

Acting = tuple[Element, FloatArray]
"""An element and the vector (g, -h) of its stretch over coordinates and inputs."""


def vertical_motion(layout: Layout, p: Mapping[str, Tensor]) -> LinearSystem:
    """Return the equations of motion of one vehicle.

    `p` holds ``PARAMETERS`` and ``UNMEASURED`` in SI units, tensors of one element.
    """
    parts, bogie, axle = layout.parts, layout.bogie, layout.axle
    n = {name: float(value) for name, value in p.items()}
    masses = _masses(n, parts)
    inputs = [f"{kind}_{wheel}" for kind in "wx"[: 1 + ("roll" in parts)] for wheel in "abcd"]
    e = dict(zip([*masses, *inputs], np.eye(len(masses) + len(inputs)), strict=True))
    forward = 1.0 if bogie == "leading" else -1.0
    vehicle = _Vehicle(p, n, parts, e)
    acting = vehicle.suspensions()
    if "longitudinal" in parts:
        acting += vehicle.links(forward)
    if "bending" in parts:
        acting.append((bending_element(p, layout.empty_body_kg), e["q"]))
    if "roll" in parts:
        acting += vehicle.rolling()
    frame, body = e["z_1"].copy(), vehicle.above("bending_at_sensor")
    if layout.frame_sensor == "axle":
        frame += e["psi_1"] if axle == "leading" else -e["psi_1"]
    body += (1 + forward * layout.body_sensor_m / n["half_pivot_distance"]) * e["phi"]
    sensors = np.array([frame, body])
    if "roll" in parts:
        lean = np.array([n["frame_lateral"] * e["theta_1"], n["body_lateral"] * e["theta"]])
        sensors = np.vstack([sensors + lean, sensors - lean])
    system = _assembled(list(masses.values()), acting, sensors, _behind(n, bogie, axle))
    if "roll" not in parts:
        return system
    roll_per_m = math.sqrt(n["cross_level"]) / RAIL_LATERAL_M
    lateral_m = n["axle_box_lateral"], n["frame_lateral"], n["body_lateral"]
    return replace(system, roll_per_m=roll_per_m, lateral_m=lateral_m)


def _masses(n: Mapping[str, float], parts: Sequence[str]) -> dict[str, float]:
    """Return each coordinate with its mass, or its moment of inertia if it is an angle."""
    bogie = n["bogie_mass"]
    pitch = bogie * (n["bogie_gyration"] / n["half_wheelbase"]) ** 2
    body_pitch = 2 * n["M_s"] * (n["body_gyration"] / n["half_pivot_distance"]) ** 2
    masses = {"z": 2 * n["M_s"], "phi": body_pitch}
    masses |= {"z_1": bogie, "psi_1": pitch, "z_2": bogie, "psi_2": pitch}
    if "bending" in parts:
        masses["q"] = n["M_s"]
    if "roll" in parts:
        roll = bogie * n["bogie_roll_gyration"] ** 2
        masses["y"] = 2 * n["M_s"]
        masses["theta"] = masses["y"] * n["body_roll_gyration"] ** 2
        masses |= {"theta_1": roll, "theta_2": roll}
    return masses


@dataclass(frozen=True)
class _Vehicle:
    """Elements of a vehicle: `p`, `n` its numbers, `e` the unit vector of each coordinate."""

    p: Mapping[str, Tensor]
    n: Mapping[str, float]
    parts: Sequence[str]
    e: Mapping[str, FloatArray]

    def above(self, shape: str) -> FloatArray:
        """Return the body's bounce, with its bending of the given `shape` at a pivot or sensor."""
        n, e = self.n, self.e
        return e["z"] + n[shape] * e["q"] if "bending" in self.parts else e["z"].copy()

    def suspensions(self) -> list[Acting]:
        """Return primary and secondary suspensions in bounce and pitch, and the axle guidance."""
        p, parts, e = self.p, self.parts, self.e
        acting = []
        body = self.above("bending_at_pivot")
        for which, i, sign, (first, last) in BOGIES:
            primary = primary_element(p, which, parts)
            acting += [
                (primary, e[f"z_{i}"] - 0.5 * (e[f"w_{first}"] + e[f"w_{last}"])),
                (primary, e[f"psi_{i}"] - 0.5 * (e[f"w_{first}"] - e[f"w_{last}"])),
                (secondary_element(p, which, parts), body + sign * e["phi"] - e[f"z_{i}"]),
            ]
            if "guidance" in parts:
                acting.append((guidance_element(p), e[f"psi_{i}"]))
        return acting

    def links(self, forward: float) -> list[Acting]:
        """Return the longitudinal links; phi is positive if the measured bogie rises."""
        n, e = self.n, self.e
        body_lever = forward * n["body_lever"] / n["half_pivot_distance"]
        lever = n["bogie_lever"] / n["half_wheelbase"]
        acting = []
        for _, i, sign, _ in BOGIES:
            turned = e["phi"].copy()
            if "bending" in self.parts:
                turned += sign * n["bending_slope"] * e["q"]
            stretch = body_lever * turned + lever * e[f"psi_{i}"]
            acting.append((longitudinal_element(self.p), stretch))
        return acting

    def rolling(self) -> list[Acting]:
        """Return the suspensions in roll and sway, for one side."""
        p, n, parts, e = self.p, self.n, self.parts, self.e
        acting = []
        aside = e["y"] + n["body_lever"] * e["theta"]
        for which, i, _, (first, last) in BOGIES:
            own, track = e[f"theta_{i}"], 0.5 * (e[f"x_{first}"] + e[f"x_{last}"])
            across = e["theta"] - own
            acting += [
                (primary_element(p, which, parts), n["primary_lateral"] * (own - track)),
                (secondary_element(p, which, parts), n["secondary_lateral"] * across),
                (Element(p["anti_roll_bar"] / 2, None), across),
                (lateral_element(p), aside + n["bogie_lever"] * own),
            ]
        return acting


def _assembled(
    masses: list[float], acting: list[Acting], sensors: FloatArray, behind_m: tuple[float, ...]
) -> LinearSystem:
    """Return the system of these masses, with each element added along its stretch."""
    n, n_all = len(masses), sensors.shape[1]
    stiffness, damping = np.zeros((2, n_all, n_all))
    branches = []
    for element, stretch in acting:
        k, c, relaxing = element.causal()
        square = np.outer(stretch, stretch)
        stiffness += k * square
        damping += c * square
        branches += [Branch(b, rate, stretch[:n], -stretch[n:]) for rate, b in relaxing.items()]
    return LinearSystem(
        mass=np.diag(masses),
        damping=damping[:n, :n],
        stiffness=stiffness[:n, :n],
        input_damping=-damping[:n, n:],
        input_stiffness=-stiffness[:n, n:],
        sensors=sensors[:, :n],
        behind_m=behind_m,
        branches=tuple(branches),
    )


def _behind(n: Mapping[str, float], bogie: str, axle: str) -> tuple[float, ...]:
    """Return the distances of the wheelsets behind the measured one, its own bogie first, [m]."""
    shift = n["half_wheelbase"] if axle == "leading" else -n["half_wheelbase"]
    pivots = 2 * n["half_pivot_distance"] * (1 if bogie == "leading" else -1)
    own = [shift - n["half_wheelbase"], shift + n["half_wheelbase"]]
    return (*own, *(pivots + distance for distance in own))
