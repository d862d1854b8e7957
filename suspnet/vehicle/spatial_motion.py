"""Springs and dampers of a vehicle of twelve separate parts, each along its own stretch.

An element of dynamic stiffness kappa (`suspnet.vehicle.vertical_motion`) that is stretched by u
acts with the force kappa u against it. Letters of the vertical family hold (i = 1 the measured
bogie, 2 the other one, sigma = +1, -1; a half wheelbase, L half pivot distance, b half distances, h
levers, r_0 wheel radius), for the whole vehicle and not one side of it. Further, epsilon = +1, -1
for axle 1, 2 (or 3, 4 of the other bogie; 3 is at the same end as 1), s = +1, -1 for left, right.
Where the body's centre of mass, by its load and to balance the equipment about the middle, is x_l
from its middle towards the measured bogie and y_l to the left, sigma - x_l / L is in place of sigma
with phi and chi, and s b - y_l in place of s b with theta and chi of the body. Angles are
multiplied by L (body: phi, chi) or a (bogie and wheelsets: psi, chi), but not the rolls theta; y is
lateral, to the left, chi yaw and positive where the measured bogie or axle 1 moves to the left;
rho_t tau_i is the rise of a frame's corners in torsion. f = +1, -1 if the measured bogie leads or
trails, t likewise for axle 1. With w, x, v the height of the track under a wheelset, its angle and
its lateral place, the stretches are::

    primary, corner    kappa_p / 2   z_i + eps psi_i + s b_p theta_i + eps s rho_t tau_i
                                       - w - s b_p x
    secondary, side    kappa_s       z + p q + sigma phi + s b_s theta - z_i - s b_s theta_i
    guidance           2 gamma       psi_i
    longitudinal, side kappa_x       f (h_2 / L) (phi + sigma slope q) + t (h_3 / a) psi_i
                                       - s b_s (f chi / L - t chi_i / a)
    yaw damper, side   kappa_d       likewise, with h_2 - h_d, h_3 + h_d and b_d
    anti-roll bar      k_bar         theta - theta_i
    lateral            2 kappa_y     y + sigma chi + h_2 theta - y_i + h_3 theta_i
    axle guide         2 kappa_g     y_i + eps chi_i + h_g theta_i - y_w
    axle boxes         2 kappa_b     (b_p / a) (chi_i - chi_w)
    bending, torsion   kappa_q, k_t  q, tau_i
    equipment          kappa_e       z_e less the rise of the body where it hangs
    local floor        kappa_f       z_f less the rise of the body where its sensor is

    track, rail        k_w / 2       z_w + s b_r theta_w - w - s b_r x

y_w is v - r_0 x, so that the wheelset stays on its track, or a coordinate with creep. z_w and
theta_w take the place of w and x above and below where the track gives way. With the
speed V, half gauge b_r, conicity lambda and creep coefficients of a wheel, c along and rho c across
(linear), the wheelset is pulled by its creepages to the left and in yaw::

    F   = -2 rho c (s (y_w + r_0 x) / V - t chi_w / a)
    M   = -2 c b_r (lambda (y_w + r_0 x - v) / r_0 + s b_r t chi_w / (a V))

A sensor sees the rise of its place, on the body that of its floor, and with cross_axis a share of
the motion to the left there::

    y + (1 + f m / L) chi + h_2 theta   (body, m ahead of the pivot),   y_1 + eps chi_1,   y_w

Gravity and the stiffness of flanges are left out: both are small against creep above 0.3 Hz. What
the vehicle's parts do not have is held at 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.types import FloatArray
from suspnet.vehicle.motion import Branch, LinearSystem
from suspnet.vehicle.quantities import ADDITIONS, LATERAL
from suspnet.vehicle.vertical_motion import (
    RAIL_LATERAL_M,
    Element,
    Layout,
    guidance_element,
    lateral_element,
    links_of,
    mode_element,
    primary_element,
    secondary_element,
)

T = TypeVar("T")
Row = dict[str, Tensor | float]
"""Factors of coordinates and inputs by name, numbers or tensors of shape (n_vehicles, 1)."""
TORSION_MASS = 0.2
"""Modal mass of the torsion over the frame's mass."""
LEAST_COMPLIANCE = 1e-13
"""Least compliance of a track that counts as other than rigid, [m/N]; springs have 1e-7."""
SOFTNESS = 1e-9
"""Least softness of a local floor that counts as other than rigid, [s^2]; one at 13 Hz has 1e-4."""
SIGNS = {"left": 1.0, "right": -1.0, "middle": 0.0}
"""Lateral place of a side in units of that of the left one."""


@dataclass(frozen=True)
class Joint:
    """An element, its stretch, and what it pulls: the coordinates of the stretch if None.

    `damper` is the name of the one that it holds, "c_p_axle1_left" or "other_c_s_right".
    """

    element: Element
    stretch: Row
    pull: Row | None = None
    damper: str | None = None


def coordinates(layout: Layout) -> tuple[str, ...]:
    """Return the names of the coordinates of a vehicle."""
    parts = layout.parts
    rigid = ("z", "phi", "z_1", "psi_1", "z_2", "psi_2")
    further = {"roll": ("y", "theta", "theta_1", "theta_2"), "bending": ("q",), **ADDITIONS}
    added = (name for part, names in further.items() if part in parts for name in names)
    return (*rigid, *added, *(f"z_{place}" for place in layout.floors))


def wheel_inputs(parts: Sequence[str]) -> tuple[str, ...]:
    """Return the names of height, angle and lateral place of the track under each wheelset."""
    kinds = "wxv" if is_lateral(parts) else "wx" if "roll" in parts else "w"
    return tuple(f"{kind}{wheel}" for kind in kinds for wheel in range(1, 5))


def is_lateral(parts: Iterable[str]) -> bool:
    """Return whether the alignment of the track moves anything."""
    return any(part in LATERAL for part in parts)


def masses(layout: Layout, p: Mapping[str, Tensor]) -> list[Tensor]:
    """Return the mass of each coordinate [kg], of an angle in rad the inertia, (n_vehicles, 1)."""
    parts, hung = layout.parts, _hung_kg(layout, p)
    body, frame = 4 * p["M_s"], 2 * p["bogie_mass"]
    bodily = (p["body_gyration"] / p["half_pivot_distance"]) ** 2
    pitch = (p["bogie_gyration"] / p["half_wheelbase"]) ** 2
    mass_of = {"z": body, "y": body, "phi": body * bodily, "q": body / 2}
    mass_of |= {"theta": body * p["body_roll_gyration"] ** 2}
    mass_of |= {"chi": body * bodily * p["body_yaw"] ** 2}
    mass_of |= {"q_b": body / 2, "tau_b": body * p["body_roll_gyration"] ** 2}
    if "equipment" in parts:  # the rest of the body is lighter by it
        mass_of |= {"z": body - hung, "z_e": hung}
    for i in "12":
        mass_of |= {f"z_{i}": frame, f"y_{i}": frame, f"psi_{i}": frame * pitch}
        mass_of |= {f"theta_{i}": frame * p["bogie_roll_gyration"] ** 2}
        mass_of |= {f"chi_{i}": frame * pitch * p["bogie_yaw"] ** 2}
        mass_of |= {f"tau_{i}": frame * TORSION_MASS}
    turned = (p["wheelset_yaw_gyration"] / p["half_wheelbase"]) ** 2
    for wheel in range(1, 5):
        mass, rolled = p["wheelset_mass"], p["wheelset_yaw_gyration"] ** 2
        mass_of |= {f"y_w{wheel}": mass, f"chi_w{wheel}": mass * turned}
        mass_of |= {f"z_w{wheel}": mass, f"theta_w{wheel}": mass * rolled}
    mass_of |= {f"z_{place}": p[f"floor_mass_{place}"] for place in layout.floors}
    return [mass_of[name] for name in coordinates(layout)]


def _hung_kg(layout: Layout, p: Mapping[str, Tensor]) -> Tensor:
    """Return the mass hung below the floor, [kg]."""
    share = p["equipment_share"]
    return 4 * layout.empty_body_kg * share / (1 + share)


def acting(layout: Layout, p: Mapping[str, Tensor]) -> list[Joint]:
    """Return every element of vehicles whose numbers `p` have the shape (n_vehicles, 1)."""
    parts = layout.parts
    joints = [*_suspensions(layout, p), *_linked(layout, p)]
    if "bending" in parts:
        joints.append(Joint(mode_element(p, "bending", 2 * layout.empty_body_kg), {"q": 1.0}))
    if "second_bending" in parts:
        joints.append(Joint(mode_element(p, "second", 2 * layout.empty_body_kg), {"q_b": 1.0}))
    if "body_torsion" in parts:
        inertia = 4 * layout.empty_body_kg * p["body_roll_gyration"] ** 2
        joints.append(Joint(mode_element(p, "twist", inertia), {"tau_b": 1.0}))
    if "equipment" in parts:
        joints.append(_hung(layout, p))
    joints += [_floor(layout, p, place) for place in layout.floors]
    if "torsion" in parts:
        torsion = mode_element(p, "torsion", 2 * p["bogie_mass"] * TORSION_MASS)
        joints += [Joint(torsion, {f"tau_{i}": 1.0}) for i in "12"]
    if "track" in parts:
        joints += _carried(p)
    if is_lateral(parts):
        joints += _guided(layout, p)
    if "creep" in parts:
        joints += _creeping(layout, p)
    return joints


def _hung(layout: Layout, p: Mapping[str, Tensor]) -> Joint:
    """Return what holds the equipment below the floor."""
    ahead = p["equipment_ahead"] / p["half_pivot_distance"]
    aside = _across(layout, p, p["equipment_aside"])
    body: Row = {"z": -1.0, "phi": -_along(layout, p, ahead), "theta": -aside}
    body |= {"q": -p["equipment_at_bending"], "q_b": -p["equipment_at_second"]}
    body |= {"tau_b": -p["equipment_at_twist"] * p["equipment_aside"]}
    return Joint(mode_element(p, "equipment", _hung_kg(layout, p)), {"z_e": 1.0, **body})


def _floor(layout: Layout, p: Mapping[str, Tensor], place: str) -> Joint:
    """Return what holds the local floor below a sensor of the body."""
    mass, softness = p[f"floor_mass_{place}"], _away_from_0(p[f"floor_softness_{place}"], SOFTNESS)
    held = {name: -factor for name, factor in _body_rise(layout, p, place).items()}
    floor = Element(mass / softness, mass * p[f"floor_damping_{place}"])
    return Joint(floor, {f"z_{place}": 1.0, **held})


def _away_from_0(value: Tensor, least: float) -> Tensor:
    """Return numbers whose inverse is finite: 0 is rigid, and a search may step to either side."""
    return torch.where(value.abs() < least, torch.where(value < 0, -least, least), value)


def _body_roll(p: Mapping[str, Tensor], sigma: float, factor: Tensor | float) -> Row:
    """Return `factor` times the roll of the body at a pivot, its torsion included."""
    return {"theta": factor, "tau_b": sigma * p["twist_at_pivot"] * factor}


def _along(layout: Layout, p: Mapping[str, Tensor], place: Tensor | float) -> Tensor | float:
    """Return how far a place over L is ahead of the body's centre of mass, over L."""
    metres = _centre_m(layout.parts, p, "ahead")
    return place if metres is None else place - metres / p["half_pivot_distance"]


def _across(layout: Layout, p: Mapping[str, Tensor], place: Tensor | float) -> Tensor | float:
    """Return how far a place is to the left of the body's centre of mass."""
    metres = _centre_m(layout.parts, p, "aside")
    return place if metres is None else place - metres


def _centre_m(parts: Sequence[str], p: Mapping[str, Tensor], direction: str) -> Tensor | None:
    """Return where the body without its equipment has its centre of mass; None: in the middle."""
    metres = []
    if "load" in parts:
        metres.append(p[f"load_{direction}"])
    if "equipment" in parts:  # the body balances it about the middle
        metres.append(-p["equipment_share"] * p[f"equipment_{direction}"])
    return sum(metres[1:], metres[0]) if metres else None


def _height(parts: Sequence[str], wheel: int) -> str:
    """Return what the height of a wheelset is: its own, or that of the track under it."""
    return f"z_w{wheel}" if "track" in parts else f"w{wheel}"


def _roll(parts: Sequence[str], wheel: int) -> str:
    """Return what the roll of a wheelset is: its own, or the angle of the track under it."""
    return f"theta_w{wheel}" if "track" in parts else f"x{wheel}"


def _carried(p: Mapping[str, Tensor]) -> list[Joint]:
    """Return the track under each rail of a wheelset."""
    stiffness = 1 / _away_from_0(p["track_compliance"], LEAST_COMPLIANCE)
    rail = Element(stiffness, p["track_time"] * stiffness).times(0.5)
    joints = []
    for wheel in range(1, 5):
        for aside in (RAIL_LATERAL_M, -RAIL_LATERAL_M):
            above: Row = {f"z_w{wheel}": 1.0, f"theta_w{wheel}": aside}
            joints.append(Joint(rail, {**above, f"w{wheel}": -1.0, f"x{wheel}": -aside}))
    return joints


def _corner(i: int, end: float, lateral: Tensor | float, p: Mapping[str, Tensor]) -> Row:
    """Return the rise of frame `i` above axle 1 (`end` 1), axle 2 (-1) or at its centre (0)."""
    twist = p["torsion_rise"] * end * lateral / p["primary_lateral"]
    return {f"z_{i}": 1.0, f"psi_{i}": end, f"theta_{i}": lateral, f"tau_{i}": twist}


def _suspensions(layout: Layout, p: Mapping[str, Tensor]) -> list[Joint]:
    """Return the springs and dampers of both bogies, and what acts on their pitch and roll."""
    parts, joints = layout.parts, []
    guidance = guidance_element(p).times(2)
    bar = Element(p["anti_roll_bar"], None)
    for i, prefix, sigma in ((1, "", 1.0), (2, "other_", -1.0)):
        for side in ("left", "right"):
            lateral = SIGNS[side] * p["primary_lateral"]
            for axle, end in ((1, 1.0), (2, -1.0)):
                wheel = axle + 2 * (i - 1)
                corner = f"_axle{axle}_{side}"
                spring = primary_element(p, prefix, parts, corner).times(0.5)
                below: Row = {_height(parts, wheel): -1.0, _roll(parts, wheel): -lateral}
                stretch = {**_corner(i, end, lateral, p), **below}
                joints.append(Joint(spring, stretch, damper=f"{prefix}c_p{corner}"))
            spring = secondary_element(p, prefix, parts, f"_{side}")
            lateral = SIGNS[side] * p["secondary_lateral"]
            body: Row = {"z": 1.0, "q": p["bending_at_pivot"], "phi": _along(layout, p, sigma)}
            body |= {"q_b": sigma * p["second_at_pivot"], **_body_roll(p, sigma, lateral)}
            body |= {"theta": _across(layout, p, lateral)}
            stretch = {**body, f"z_{i}": -1.0, f"theta_{i}": -lateral}
            joints.append(Joint(spring, stretch, damper=f"{prefix}c_s_{side}"))
        if "guidance" in parts:
            joints.append(Joint(guidance, {f"psi_{i}": 1.0}))
        joints.append(Joint(bar, {**_body_roll(p, sigma, 1.0), f"theta_{i}": -1.0}))
    return joints


def _linked(layout: Layout, p: Mapping[str, Tensor]) -> list[Joint]:
    """Return links, yaw dampers and lateral suspension between body and bogies."""
    f, t = _ends(layout)
    a, pivot = p["half_wheelbase"], p["half_pivot_distance"]
    aside = lateral_element(p).times(2)
    halves = {"longitudinal": "secondary_lateral", "yaw_dampers": "yaw_lateral"}
    half_m = [p[name] for part, name in halves.items() if part in layout.parts]
    along = list(zip(links_of(p, layout.parts), half_m, strict=True))
    joints = []
    for i, sigma in (1, 1.0), (2, -1.0):
        for (element, below_body, above_bogie), half in along:
            body, bogie = f * below_body / pivot, t * above_bogie / a
            pitched: Row = {"phi": body, "q": sigma * p["bending_slope"] * body, f"psi_{i}": bogie}
            pitched |= {"q_b": p["second_slope"] * body}
            for lateral in half, -half:
                from_centre = _across(layout, p, lateral)
                yawed: Row = {"chi": -f * from_centre / pivot, f"chi_{i}": t * lateral / a}
                joints.append(Joint(element, {**pitched, **yawed}))
        swayed: Row = {"y": 1.0, "chi": _along(layout, p, sigma)}
        swayed |= _body_roll(p, sigma, p["body_lever"])
        swayed |= {f"y_{i}": -1.0, f"theta_{i}": p["bogie_lever"]}
        joints.append(Joint(aside, swayed))
    return joints


def _guided(layout: Layout, p: Mapping[str, Tensor]) -> list[Joint]:
    """Return what holds the wheelsets in the frames."""
    guide = Element(2 * p["guide_stiffness"], 2 * p["guide_damping"])
    yawing = Element(2 * p["axle_box_stiffness"], 2 * p["axle_box_damping"])
    joints = []
    for wheel in range(1, 5):
        i, end = 1 + (wheel > 2), 1.0 if wheel % 2 else -1.0
        aside: Row = {f"y_{i}": 1.0, f"chi_{i}": end, f"theta_{i}": p["guide_lever"]}
        if "creep" not in layout.parts:
            wheelset: Row = {f"v{wheel}": -1.0, _roll(layout.parts, wheel): p["wheel_radius"]}
            joints.append(Joint(guide, {**aside, **wheelset}))
            continue
        joints.append(Joint(guide, {**aside, f"y_w{wheel}": -1.0}))
        lever = p["primary_lateral"] / p["half_wheelbase"]
        joints.append(Joint(yawing, {f"chi_{i}": lever, f"chi_w{wheel}": -lever}))
    return joints


def _creeping(layout: Layout, p: Mapping[str, Tensor]) -> list[Joint]:
    """Return the creepages of the wheelsets; those that depend on speed are dampers."""
    _, t = _ends(layout)
    along = 2 * p["creep_coefficient"]
    across = along * p["creep_ratio"]
    none = torch.zeros_like(along)
    creep, damper = Element(along, None), Element(none, along / p["speed"])
    creep_aside, damper_aside = Element(across, None), Element(none, across / p["speed"])
    lever, cone = RAIL_LATERAL_M / p["half_wheelbase"], p["conicity"] / p["wheel_radius"]
    joints = []
    for wheel in range(1, 5):
        y, chi, roll = f"y_w{wheel}", f"chi_w{wheel}", _roll(layout.parts, wheel)
        contact: Row = {y: 1.0, roll: p["wheel_radius"]}
        joints += [
            Joint(damper_aside, contact),
            Joint(damper, {chi: lever}),
            Joint(creep_aside, {chi: -t / p["half_wheelbase"]}, contact),
            Joint(
                creep,
                {y: cone, roll: p["conicity"], f"v{wheel}": -cone},
                {chi: t * lever},
            ),
        ]
    return joints


def sensed(layout: Layout, p: Mapping[str, Tensor], sensors: Sequence[str]) -> list[Row]:
    """Return what the sensors at some of ``PLACES`` see of coordinates and inputs."""
    return [_seen(layout, p, place) for place in sensors]


def _seen(layout: Layout, p: Mapping[str, Tensor], place: str) -> Row:
    upwards = _upwards(layout, p, place)
    if "cross_axis" not in layout.parts:
        return upwards
    share, aside = p[f"cross_axis_{place}"], _aside(layout, p, place)
    names = dict.fromkeys((*upwards, *aside))
    return {name: upwards.get(name, 0.0) + share * aside.get(name, 0.0) for name in names}


def _aside(layout: Layout, p: Mapping[str, Tensor], place: str) -> Row:
    """Return the lateral motion of a place, to the left."""
    if place.startswith("body"):
        return {"y": 1.0, "chi": _ahead(layout, p), **_body_roll(p, 1.0, p["body_lever"])}
    axle, end = _axle_of(place)
    if place.startswith("frame"):
        return {"y_1": 1.0, "chi_1": end}
    if "creep" in layout.parts:
        return {f"y_w{axle}": 1.0}
    return {f"v{axle}": 1.0, _roll(layout.parts, axle): -p["wheel_radius"]}


def _ahead(layout: Layout, p: Mapping[str, Tensor]) -> Tensor | float:
    """Return how far ahead of the body's centre its sensors are, over the pivot's distance."""
    f, _ = _ends(layout)
    return _along(layout, p, 1 + f * layout.body_sensor_m / p["half_pivot_distance"])


def _axle_of(place: str) -> tuple[int, float]:
    """Return the axle of a place, 0 if it is at none, and its end of the bogie."""
    axle = next((axle for axle in (1, 2) if f"axle{axle}" in place), 0)
    return axle, (0.0, 1.0, -1.0)[axle]


def _body_rise(layout: Layout, p: Mapping[str, Tensor], place: str) -> Row:
    """Return the rise of the body where a sensor is, of its local floor none."""
    lateral = SIGNS[place.rpartition("_")[2]] * p["body_lateral"]
    bent: Row = {"z": 1.0, "q": p["bending_at_sensor"], "phi": _ahead(layout, p)}
    bent |= {"q_b": p["second_at_sensor"]}
    return {**bent, **_body_roll(p, 1.0, lateral), "theta": _across(layout, p, lateral)}


def _upwards(layout: Layout, p: Mapping[str, Tensor], place: str) -> Row:
    if place in layout.floors:
        return {f"z_{place}": 1.0}
    if place.startswith("body"):
        return _body_rise(layout, p, place)
    sign = SIGNS[place.rpartition("_")[2]]
    axle, end = _axle_of(place)
    if place.startswith("frame"):
        return _corner(1, end, sign * p["frame_lateral"], p)
    lateral = sign * p["axle_box_lateral"]
    box: Row = {_height(layout.parts, axle): 1.0, _roll(layout.parts, axle): lateral}
    if "axle_box_arm" not in layout.parts:
        return box
    arm, above = p["arm_share"], _corner(1, end, lateral, p)
    seen: Row = {name: (1 - arm) * value for name, value in box.items()}
    seen |= {name: arm * value for name, value in above.items()}
    return seen


def _ends(layout: Layout) -> tuple[float, float]:
    """Return 1 for a leading, -1 for a trailing bogie; then the same for axle 1."""
    signs = {"leading": 1.0, "trailing": -1.0}
    return signs[layout.bogie], signs[layout.axle]


def by_axle(layout: Layout, wheels: Sequence[T]) -> list[T]:
    """Return what belongs to leading and trailing wheelsets of both bogies as axles 1, 2, 3, 4."""
    order = (0, 1, 2, 3) if layout.axle == "leading" else (1, 0, 3, 2)
    return [wheels[i] for i in order]


def spatial_motion(layout: Layout, p: Mapping[str, Tensor], sensors: Sequence[str]) -> LinearSystem:
    """Return the equations of motion of one vehicle, its inputs as `wheel_inputs` names them.

    An element with the stretch u = g z - h w of coordinates z and inputs w adds k g g^T to the
    stiffness, k g h^T to that of the input; creep pulls elsewhere than along its stretch.
    """
    moving, wheels = coordinates(layout), wheel_inputs(layout.parts)
    place = {name: i for i, name in enumerate((*moving, *wheels))}
    n, n_all = len(moving), len(place)

    def vector(row: Row) -> FloatArray:
        total = np.zeros(n_all)
        for name in row.keys() & place.keys():
            total[place[name]] = float(row[name])
        return total

    stiffness, damping = np.zeros((2, n_all, n_all))
    branches = []
    for joint in acting(layout, p):
        k, c, relaxing = joint.element.causal()
        stretch = vector(joint.stretch)
        square = np.outer(stretch if joint.pull is None else vector(joint.pull), stretch)
        stiffness += k * square
        damping += c * square
        branches += [Branch(b, rate, stretch[:n], -stretch[n:]) for rate, b in relaxing.items()]
    seen = np.array([vector(row) for row in sensed(layout, p, sensors)])
    numbers = {name: float(value) for name, value in p.items()}
    rolls, moves_aside = "roll" in layout.parts, is_lateral(layout.parts)
    return LinearSystem(
        mass=np.diag([float(mass) for mass in masses(layout, p)]),
        damping=damping[:n, :n],
        stiffness=stiffness[:n, :n],
        input_damping=-damping[:n, n:],
        input_stiffness=-stiffness[:n, n:],
        sensors=seen[:, :n],
        feedthrough=seen[:, n:] if seen[:, n:].any() else None,
        behind_m=tuple(by_axle(layout, _behind(numbers, layout))),
        branches=tuple(branches),
        roll_per_m=math.sqrt(numbers["cross_level"]) / RAIL_LATERAL_M if rolls else 0.0,
        alignment=math.sqrt(numbers["alignment"]) if moves_aside else 0.0,
        lateral_m=(numbers["axle_box_lateral"], numbers["frame_lateral"], numbers["body_lateral"]),
    )


def _behind(n: Mapping[str, float], layout: Layout) -> list[float]:
    """Return the distances of the wheelsets behind the measured one, its own bogie first, [m]."""
    shift = n["half_wheelbase"] if layout.axle == "leading" else -n["half_wheelbase"]
    pivots = 2 * n["half_pivot_distance"] * (1 if layout.bogie == "leading" else -1)
    offsets = [shift - n["half_wheelbase"], shift + n["half_wheelbase"]]
    return [*offsets, *(pivots + distance for distance in offsets)]
