"""Closed-form responses of a family of vehicles: body and two bogies on four wheelsets.

For a measured leading bogie, with s = j omega, kappa the dynamic stiffness of a suspension
(`suspnet.dynamics.vertical_motion`), w the track under the wheelsets, all numbers for one side::

    (kappa_p + kappa_s + s^2 M_p) z_i - kappa_s y_i                 = kappa_p m_i
    (kappa_p + gamma + s^2 M_p (rho_b / a)^2) psi_i + kappa_x (h_3 / a) r_i = kappa_p d_i
    2 M_s s^2 z + sum_i F_i = 0
    2 M_s (rho_c / L)^2 s^2 phi + F_1 - F_2 + sum_i G_i = 0
    (M_s s^2 + c_q s + k_q) q + p sum_i F_i + sigma (G_1 - G_2) = 0

z_i is the bounce of bogie i, psi_i its pitch times the half wheelbase a, m_i and d_i half the sum
and half the difference of the track under its axles. z is the bounce of the body, phi its pitch
times the half pivot distance L, q its first bending with the shape p and the slope sigma / L at the
pivots. Above the bogies the body moves by y_1 = z + phi + p q and y_2 = z - phi + p q and turns by
phi_1 / L and phi_2 / L, phi_1 = phi + sigma q, phi_2 = phi - sigma q; F_i = kappa_si (y_i - z_i).
gamma is the axle guidance, kappa_x the longitudinal links between body and bogie with the levers
h_2 and h_3, their stretch r_i = h_2 phi_i / L + h_3 psi_i / a, G_i = kappa_x (h_2 / L) r_i.

Roll and sway decouple if left and right are alike, with x_i the mean of half the cross level at
both axles, b the half distances of springs and of the rails, S_i = kappa_si b_s^2 + k_bar / 2, y
the lateral displacement of the body, kappa_y the lateral suspension between body and bogie at the
levers h_2 and h_3, whose stretch is e_i = y + h_2 theta + h_3 theta_i::

    (kappa_p b_p^2 + S_i + s^2 M_p r_b^2) theta_i - S_i theta + kappa_y h_3 e_i
                                                                    = kappa_p b_p^2 x_i / b_rail
    2 M_s r_c^2 s^2 theta + sum_i S_i (theta - theta_i) + h_2 sum_i kappa_y e_i = 0
    2 M_s s^2 y + sum_i kappa_y e_i = 0

Bogies and wheelsets do not move laterally. The bogies are eliminated; three equations in z, phi and
q, and two in theta and y remain. k_p, c_p, k_s, c_s belong to one bogie side, M_s is a quarter of
the body as in the quarter car. All wheelsets follow the same track, each delayed by its distance
over the speed. Cross level and mean are independent processes, so that spectra are sums over both.
The density of the cross level is a fraction of the mean's, times n^2 / (n^2 + n_0^2) as in the
German spectra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from suspnet.dynamics.track import CROSS_LEVEL_RAD_PER_M
from suspnet.dynamics.vertical_motion import (
    RAIL_LATERAL_M,
    Layout,
    bending_element,
    guidance_element,
    lateral_element,
    longitudinal_element,
    primary_element,
    secondary_element,
)


@dataclass(frozen=True)
class _Bogie:
    """One eliminated bogie: bounce z_i = link y_i + free, pitch psi_i = swing - tilt phi_i.

    Its secondary suspension acts on the body with the force resistance y_i - force downwards, its
    links with the moment upright phi_i - push against the body's pitch phi_i above the bogie.
    """

    link: Tensor
    free: Tensor
    resistance: Tensor
    force: Tensor
    swing: Tensor
    tilt: Tensor | float
    upright: Tensor | float
    push: Tensor


def bounced(
    layout: Layout,
    p: Mapping[str, Tensor],
    omega: Tensor,
    wheels: Sequence[Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the motion per metre of mean track, [-]: frame above the axle, frame, body sensor.

    `wheels` is the motion of each wheelset, the measured bogie's first; None is one track for all.
    They may have a leading dimension of inputs, as then has the motion.
    """
    wheels = wheels_of(layout, p, omega) if wheels is None else wheels
    forward = 1.0 if layout.bogie == "leading" else -1.0
    # phi is positive if the measured bogie rises, psi if the leading axle rises: the lever of the
    # links below the body changes its sign for a trailing bogie.
    p = {**p, "body_lever": forward * p["body_lever"]}
    link_x = longitudinal_element(p).at(omega) if "longitudinal" in layout.parts else None
    # Each bogie is eliminated: it acts as a force and a stiffness under the body.
    first = _bogie(p, "", omega, wheels[:2], link_x, layout.parts)
    other = _bogie(p, "other_", omega, wheels[2:], link_x, layout.parts)
    # Bounce and pitch of the body: a symmetric matrix (bounce, coupling, pitch) and two forces.
    inertia = 2 * p["M_s"] * omega**2
    total = first.resistance + other.resistance
    difference = first.resistance - other.resistance
    bounce_force, pitch_force = first.force + other.force, first.force - other.force
    pitch_inertia = inertia * (p["body_gyration"] / p["half_pivot_distance"]) ** 2
    matrix = [total - inertia, difference, total - pitch_inertia]
    if link_x is not None:
        matrix[2] = matrix[2] + first.upright + other.upright
        pitch_force = pitch_force + first.push + other.push
    bending: Tensor | float = 0.0
    if "bending" in layout.parts:
        own, at_pivot = _modal(layout, p, omega), p["bending_at_pivot"]
        row = [at_pivot * total, at_pivot * difference, own + at_pivot**2 * total]
        force = at_pivot * bounce_force
        if link_x is not None:
            slope = p["bending_slope"]
            row[1] = row[1] + slope * (first.upright - other.upright)
            row[2] = row[2] + slope**2 * (first.upright + other.upright)
            force = force + slope * (first.push - other.push)
        # The bending is the last of three equations. It is eliminated, so that a closed form of
        # order two serves vehicles with and without it.
        share = [row[0] / row[2], row[1] / row[2]]
        matrix = [
            matrix[0] - share[0] * row[0],
            matrix[1] - share[0] * row[1],
            matrix[2] - share[1] * row[1],
        ]
        bounce_force = bounce_force - share[0] * force
        pitch_force = pitch_force - share[1] * force
        bending = force / row[2]
    a, coupling, b = matrix
    determinant = a * b - coupling**2
    bounce = (b * bounce_force - coupling * pitch_force) / determinant
    pitch = (a * pitch_force - coupling * bounce_force) / determinant
    # Substitute back: the bending, then the motion and the turn of the body above the bogie.
    turned, over = pitch, bounce + pitch
    at_sensor: Tensor | float = 0.0
    if "bending" in layout.parts:
        bending = bending - share[0] * bounce - share[1] * pitch
        turned = pitch + p["bending_slope"] * bending
        over = over + p["bending_at_pivot"] * bending
        at_sensor = p["bending_at_sensor"] * bending
    # Motion at the places of the sensors, which need not be at the centres.
    frame = first.link * over + first.free
    tilted = first.swing - first.tilt * turned
    above = frame + (tilted if layout.axle == "leading" else -tilted)
    if layout.frame_sensor == "axle":
        frame = above
    ahead = 1 + forward * layout.body_sensor_m / p["half_pivot_distance"]
    return above, frame, bounce + ahead * pitch + at_sensor


def on_arm(p: Mapping[str, Tensor], box: Tensor, above: Tensor) -> Tensor:
    """Return (1 - e) w + e z, what a sensor on the arm of the axle box measures, [-].

    The arm leads from the axle box, which moves by w, to the frame, which moves by z above it.
    """
    return box + p["arm_share"] * (above - box)


def excited_alone(
    layout: Layout, p: Mapping[str, Tensor], wheels: Sequence[Tensor]
) -> tuple[list[Tensor], Tensor]:
    """Return the wheelsets' motion for the track and for each wheelset alone, and the axle box's.

    Each of shape (5, n_vehicles, n_freq): the track under all wheelsets, then what excites one of
    them and not the next, scaled to the density of the mean track. A share counts by its size, so
    that one of 0 has an effect on both sides of it, from which its uncertainty follows.
    """
    size = p["wheelset_share"].abs().sqrt() * torch.ones_like(wheels[0])
    rows = [torch.zeros_like(size)] * len(wheels)
    found = [
        torch.stack([wheel, *rows[:i], size, *rows[i + 1 :]]) for i, wheel in enumerate(wheels)
    ]
    return found, found[0 if layout.axle == "leading" else 1]


def _bogie(
    p: Mapping[str, Tensor],
    which: str,
    omega: Tensor,
    wheels: Sequence[Tensor],
    link_x: Tensor | None,
    parts: tuple[str, ...],
) -> _Bogie:
    """Return the measured ("") or the other bogie with its bounce and pitch eliminated."""
    kappa_p, kappa_s = (
        primary_element(p, which, parts).at(omega),
        secondary_element(p, which, parts).at(omega),
    )
    inertia = p["bogie_mass"] * omega**2
    # Bounce: driven by the mean of both wheelsets, and by the body above.
    below = kappa_p + kappa_s - inertia
    link = kappa_s / below
    free = 0.5 * (wheels[0] + wheels[1]) * kappa_p / below
    # Pitch: driven by their difference, and by the body only through the longitudinal links.
    upright = kappa_p - inertia * (p["bogie_gyration"] / p["half_wheelbase"]) ** 2
    if "guidance" in parts:
        upright = upright + guidance_element(p).at(omega)
    tilt: Tensor | float = 0.0
    righting: Tensor | float = 0.0
    driven = 0.5 * (wheels[0] - wheels[1]) * kappa_p
    if link_x is not None:
        lever = p["bogie_lever"] / p["half_wheelbase"]
        body_lever = p["body_lever"] / p["half_pivot_distance"]
        upright = upright + link_x * lever**2
        tilt = link_x * lever * body_lever / upright
        righting = link_x * body_lever * (body_lever - lever * tilt)
    return _Bogie(
        link=link,
        free=free,
        resistance=kappa_s * (1 - link),
        force=kappa_s * free,
        swing=driven / upright,
        tilt=tilt,
        upright=righting,
        push=-tilt * driven,
    )


def _modal(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return the dynamic stiffness of the body's free bending, its modal mass included."""
    own = bending_element(p, layout.empty_body_kg)
    return own.at(omega) - p["M_s"] * omega**2


def rolled(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return axle box, frame and body sensor for the cross level, (n_vehicles, 3, n_freq)."""
    wheels = wheels_of(layout, p, omega)
    bogie_inertia = p["bogie_mass"] * (p["bogie_roll_gyration"] * omega) ** 2
    aside, lever = lateral_element(p).at(omega), p["bogie_lever"]
    # theta_i = link theta - yielding u + free, with u the lateral displacement of the body at the
    # height of the springs. Each bogie is eliminated, its effects on the body are added up.
    bogies = []
    resistance = stiffening = coupling = moment = push = torch.zeros_like(wheels[0])
    for which, pair in (("", wheels[:2]), ("other_", wheels[2:])):
        below = primary_element(p, which, layout.parts).at(omega) * p["primary_lateral"] ** 2
        above = secondary_element(p, which, layout.parts).at(omega) * p["secondary_lateral"] ** 2
        above = above + p["anti_roll_bar"] / 2
        all_ = below + above - bogie_inertia + aside * lever**2
        link, yielding = above / all_, aside * lever / all_
        free = below * 0.5 * (pair[0] + pair[1]) / (RAIL_LATERAL_M * all_)
        bogies.append((link, yielding, free))
        resistance = resistance + above * (1 - link)
        stiffening = stiffening + aside * (1 - lever * yielding)
        coupling = coupling + above * yielding
        moment = moment + above * free
        push = push + aside * lever * free
    # Sway is eliminated from the body's two equations, then roll is solved for.
    inertia, height = 2 * p["M_s"] * omega**2, p["body_lever"]
    swaying = stiffening - inertia
    bent = (coupling + height * stiffening) / swaying
    total = resistance - inertia * p["body_roll_gyration"] ** 2 + height * coupling
    total = total - bent * (coupling + height * inertia)
    body = (moment - height * push + bent * push) / total
    over = -(push + (coupling + height * inertia) * body) / swaying
    # Only the measured bogie carries sensors.
    link, yielding, free = bogies[0]
    frame = link * body - yielding * over + free
    box = torch.full_like(frame, 1 / RAIL_LATERAL_M)
    if "axle_box_arm" in layout.parts:
        box = on_arm(p, box, frame)
    places = [p[f"{name}_lateral"] for name in ("axle_box", "frame", "body")]
    angles = torch.stack(
        [y * angle for y, angle in zip(places, (box, frame, body), strict=True)], 1
    )
    # The angles are for a cross level of the mean's density: scale them to its own density.
    waves = (omega / p["speed"]) ** 2
    share = p["cross_level"] * waves / (waves + CROSS_LEVEL_RAD_PER_M**2)
    return share.sqrt()[:, None] * angles


def phasor(angle: Tensor) -> Tensor:
    """Return exp(-j angle)."""
    return torch.complex(torch.cos(angle), -torch.sin(angle))


def wheels_of(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> list[Tensor]:
    """Return the motion of each wheelset relative to the measured one, exp(-j omega delay)."""
    a, pivot = p["half_wheelbase"], p["half_pivot_distance"]
    # One exponential for each of the two lengths is enough for all four wheelsets.
    unit = phasor(omega * 2 * a / p["speed"])
    other = phasor(omega * 2 * pivot / p["speed"])
    one = torch.ones_like(unit)
    own = [one, unit] if layout.axle == "leading" else [unit.conj(), one]
    if layout.bogie == "trailing":
        other = other.conj()
    return [*own, *(other * wheel for wheel in own)]
