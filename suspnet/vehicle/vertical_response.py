"""Closed-form responses of a family of vehicles: body and two bogies on four wheelsets.

For a measured leading bogie, with s = j omega, kappa the dynamic stiffness of a suspension
(`suspnet.vehicle.vertical_motion`), w the track under the wheelsets, all numbers for one side::

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
h_2 and h_3, their stretch r_i = h_2 phi_i / L + h_3 psi_i / a, G_i = kappa_x (h_2 / L) r_i. Yaw
dampers, h_d above the links, act as further links with the levers h_2 - h_d and h_3 + h_d.

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

from suspnet.vehicle.track import CROSS_LEVEL_RAD_PER_M
from suspnet.vehicle.vertical_motion import (
    RAIL_LATERAL_M,
    Layout,
    guidance_element,
    lateral_element,
    links_of,
    mode_element,
    primary_element,
    secondary_element,
)


@dataclass(frozen=True)
class _Bogie:
    """One eliminated bogie: bounce z_i = link y_i + free m_i, pitch psi_i = swing d_i - tilt phi_i.

    Its secondary suspension acts on the body with the force resistance y_i - force m_i downwards,
    its links with the moment upright phi_i - push d_i against the body's pitch phi_i above the
    bogie.
    """

    link: Tensor
    free: Tensor
    resistance: Tensor
    force: Tensor
    swing: Tensor
    tilt: Tensor | float
    upright: Tensor | float
    push: Tensor | float


def bounced(
    layout: Layout, p: Mapping[str, Tensor], omega: Tensor
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Return the motion of the places of axle box, frame and body sensor, [-].

    Each is a list of the motion per metre under one wheelset, the measured bogie's first, of shape
    (n_vehicles, n_freq), or (n_vehicles, 1) if it does not depend on frequency.
    """
    forward = 1.0 if layout.bogie == "leading" else -1.0
    # phi is positive if the measured bogie rises, psi if the leading axle rises: the lever of the
    # links below the body changes its sign for a trailing bogie.
    links = [
        (
            element.at(omega),
            forward * below_body / p["half_pivot_distance"],
            above_bogie / p["half_wheelbase"],
        )
        for element, below_body, above_bogie in links_of(p, layout.parts)
    ]
    # Each bogie is eliminated: it acts as a force and a stiffness under the body.
    first = _bogie(p, "", omega, links, layout.parts)
    other = _bogie(p, "other_", omega, links, layout.parts)
    body = _body(layout, p, omega, first, other)
    # What a place sees of the body's bounce, pitch and bending. By reciprocity (the matrix of the
    # body is symmetric) one solution for each place serves the forces of all wheelsets.
    ahead = 1 + forward * layout.body_sensor_m / p["half_pivot_distance"]
    at_body = body.answer((torch.ones_like(ahead), ahead, p["bending_at_sensor"]))
    frame = first.link, first.link, first.link * body.at_pivot
    has_arm, is_above = "axle_box_arm" in layout.parts, layout.frame_sensor == "axle"
    if has_arm or is_above:
        sign = 1.0 if layout.axle == "leading" else -1.0
        tilt, swing = sign * first.tilt, sign * first.swing
        above = body.answer((frame[0], frame[1] - tilt, frame[2] - tilt * body.slope))
        at_axle = _per_wheel(above, first, other, first.free, swing)
    measured = 0 if layout.axle == "leading" else 1
    box = [torch.full_like(ahead, float(i == measured)) for i in range(4)]
    if has_arm:
        box = [on_arm(p, *pair) for pair in zip(box, at_axle, strict=True)]
    at_frame = at_axle if is_above else _per_wheel(body.answer(frame), first, other, first.free)
    return box, at_frame, _per_wheel(at_body, first, other)


def on_arm(p: Mapping[str, Tensor], box: Tensor, above: Tensor) -> Tensor:
    """Return (1 - e) w + e z, what a sensor on the arm of the axle box measures, [-].

    The arm leads from the axle box, which moves by w, to the frame, which moves by z above it.
    """
    return box + p["arm_share"] * (above - box)


@dataclass(frozen=True)
class _Body:
    """The symmetric matrix of bounce, pitch and bending, with the bending eliminated.

    `bounce`, `coupling` and `pitch` are the entries of what is left; `shares` are those of bounce
    and pitch in the bending, `own` the entry of the bending itself, None without it.
    """

    bounce: Tensor
    coupling: Tensor
    pitch: Tensor
    shares: tuple[Tensor, Tensor] | None
    own: Tensor | None
    at_pivot: Tensor | float
    slope: Tensor | float

    def answer(self, place: tuple[Tensor, Tensor, Tensor | float]) -> tuple[Tensor, ...]:
        """Return the motion of a place for unit forces under both pivots, then unit moments.

        `place` holds what it sees of bounce, pitch and bending.
        """
        up, turn, bend = place
        if self.shares is not None:
            up, turn = up - bend * self.shares[0], turn - bend * self.shares[1]
        determinant = self.bounce * self.pitch - self.coupling**2
        z = (self.pitch * up - self.coupling * turn) / determinant
        phi = (self.bounce * turn - self.coupling * up) / determinant
        if self.shares is None or self.own is None:
            return z + phi, z - phi, phi, phi
        q = bend / self.own - self.shares[0] * z - self.shares[1] * phi
        risen, turned = z + self.at_pivot * q, self.slope * q
        return risen + phi, risen - phi, phi + turned, phi - turned


def _body(
    layout: Layout, p: Mapping[str, Tensor], omega: Tensor, first: _Bogie, other: _Bogie
) -> _Body:
    inertia = 2 * p["M_s"] * omega**2
    total = first.resistance + other.resistance
    difference = first.resistance - other.resistance
    upright = first.upright + other.upright
    pitch_inertia = inertia * (p["body_gyration"] / p["half_pivot_distance"]) ** 2
    bounce, pitch = total - inertia, total - pitch_inertia + upright
    if "bending" not in layout.parts:
        return _Body(bounce, difference, pitch, None, None, 0.0, 0.0)
    at_pivot, slope = p["bending_at_pivot"], p["bending_slope"]
    # free bending, its modal mass included
    element = mode_element(p, "bending", layout.empty_body_kg)
    free = element.at(omega) - p["M_s"] * omega**2
    own = free + at_pivot**2 * total + slope**2 * upright
    row = at_pivot * total, at_pivot * difference + slope * (first.upright - other.upright)
    shares = row[0] / own, row[1] / own
    return _Body(
        bounce - shares[0] * row[0],
        difference - shares[0] * row[1],
        pitch - shares[1] * row[1],
        shares,
        own,
        at_pivot,
        slope,
    )


def _per_wheel(
    answer: tuple[Tensor, ...],
    first: _Bogie,
    other: _Bogie,
    free: Tensor | float = 0.0,
    swing: Tensor | float = 0.0,
) -> list[Tensor]:
    """Return the motion of a place per metre under each wheelset, from its answer to forces.

    `free` and `swing` are what it moves with m_1 and d_1 alone, with the body at rest.
    """
    means = answer[0] * first.force + free, answer[1] * other.force
    differences = answer[2] * first.push + swing, answer[3] * other.push
    halves = [(0.5 * m, 0.5 * d) for m, d in zip(means, differences, strict=True)]
    return [motion for m, d in halves for motion in (m + d, m - d)]


def moved(per_wheel: Sequence[Tensor], wheels: Sequence[Tensor]) -> Tensor:
    """Return the motion of a place, summed over its motion per metre under each wheelset."""
    total, *others = (gain * wheel for gain, wheel in zip(per_wheel, wheels, strict=True))
    for motion in others:
        total = total + motion
    return total


def excited(
    layout: Layout,
    p: Mapping[str, Tensor],
    wheels: Sequence[Tensor],
    places: Sequence[Sequence[Tensor]],
) -> Tensor:
    """Return axle box, frame and body for each input, (n_vehicles, n_inputs, 3, n_freq).

    `places` are from `bounced`, `wheels` from `wheels_of`. The inputs are the track under all
    wheelsets, then, if the vehicle has the part wheelsets, what excites one of them and not the
    next, scaled to the density of the mean track. A share counts by its size, so that one of 0 has
    an effect on both sides of it, from which its uncertainty follows.
    """
    rows = [moved(place, wheels) for place in places]
    if "wheelsets" in layout.parts:
        size = root_of_size(p["wheelset_share"]) * torch.ones_like(wheels[0])
        rows += [size * place[i] for i in range(len(wheels)) for place in places]
    channels: Tensor = torch.stack(rows, dim=1).unflatten(1, (-1, 3))
    return channels


def root_of_size(share: Tensor) -> Tensor:
    """Return the root of abs(share), whose derivative at a share of 0 is 0 and not infinite."""
    size = share.abs()
    return torch.where(size > 0, size.masked_fill(size == 0, 1.0).sqrt(), 0.0)


def _bogie(
    p: Mapping[str, Tensor],
    prefix: str,
    omega: Tensor,
    links: Sequence[tuple[Tensor, Tensor, Tensor]],
    parts: tuple[str, ...],
) -> _Bogie:
    """Return the measured ("") or the other bogie with its bounce and pitch eliminated.

    `links` are kappa_x with h_2 / L and h_3 / a.
    """
    kappa_p, kappa_s = (
        primary_element(p, prefix, parts).at(omega),
        secondary_element(p, prefix, parts).at(omega),
    )
    inertia = p["bogie_mass"] * omega**2
    # Bounce: driven by the mean of both wheelsets, and by the body above.
    below = kappa_p + kappa_s - inertia
    link, free = kappa_s / below, kappa_p / below
    # Pitch: driven by their difference, and by the body only through the longitudinal links.
    upright = kappa_p - inertia * (p["bogie_gyration"] / p["half_wheelbase"]) ** 2
    if "guidance" in parts:
        upright = upright + guidance_element(p).at(omega)
    coupling: Tensor | float = 0.0
    righting: Tensor | float = 0.0
    for kappa_x, body_lever, lever in links:
        upright = upright + kappa_x * lever**2
        coupling = coupling + kappa_x * lever * body_lever
        righting = righting + kappa_x * body_lever**2
    tilt = coupling / upright if links else 0.0
    return _Bogie(
        link=link,
        free=free,
        resistance=kappa_s * (1 - link),
        force=kappa_s * free,
        swing=kappa_p / upright,
        tilt=tilt,
        upright=righting - coupling * tilt,
        push=-tilt * kappa_p,
    )


def rolled(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return axle box, frame and body sensor for the cross level, (n_vehicles, 3, n_freq)."""
    wheels = wheels_of(layout, p, omega)
    bogie_inertia = p["bogie_mass"] * (p["bogie_roll_gyration"] * omega) ** 2
    aside, lever = lateral_element(p).at(omega), p["bogie_lever"]
    # theta_i = link theta - yielding u + free, with u the lateral displacement of the body at the
    # height of the springs. Each bogie is eliminated, its effects on the body are added up.
    bogies = []
    resistance = stiffening = coupling = moment = push = torch.zeros_like(wheels[0])
    for prefix, pair in (("", wheels[:2]), ("other_", wheels[2:])):
        below = primary_element(p, prefix, layout.parts).at(omega) * p["primary_lateral"] ** 2
        above = secondary_element(p, prefix, layout.parts).at(omega) * p["secondary_lateral"] ** 2
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
    return cross_level_size(p, omega)[:, None] * angles


def cross_level_size(p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return the root of the density of half the cross level over the mean's, (n, n_freq)."""
    waves = (omega / p["speed"]) ** 2
    return (p["cross_level"] * waves / (waves + CROSS_LEVEL_RAD_PER_M**2)).sqrt()


def phasor(angle: Tensor) -> Tensor:
    """Return exp(-j angle)."""
    return torch.complex(torch.cos(angle), -torch.sin(angle))


def wheels_of(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> list[Tensor]:
    """Return the motion of each wheelset relative to the measured one, exp(-j omega delay).

    If the delays are normal with a relative deviation s, as the speed scatters, that is its mean,
    exp(-j omega delay - (s omega delay)^2 / 2).
    """
    # One exponential for each of the two lengths is enough for all four wheelsets.
    angles = [
        omega * 2 * p[name] / p["speed"] for name in ("half_wheelbase", "half_pivot_distance")
    ]
    unit, other = map(phasor, angles)
    measured = torch.ones_like(unit)
    wheels = [measured, unit] if layout.axle == "leading" else [unit.conj(), measured]
    if layout.bogie == "trailing":
        other = other.conj()
    wheels = [*wheels, *(other * wheel for wheel in wheels)]
    if not layout.speed_scatter:
        return wheels
    first = 0 if layout.axle == "leading" else -1
    own = [first * angles[0], (first + 1) * angles[0]]
    far = angles[1] if layout.bogie == "leading" else -angles[1]
    spread = [layout.speed_scatter * angle for angle in (*own, *(far + angle for angle in own))]
    return [
        wheel * torch.exp(-angle.square() / 2) for wheel, angle in zip(wheels, spread, strict=True)
    ]
