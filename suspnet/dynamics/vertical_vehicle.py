"""A family of vehicles: body and two bogies that pitch, four wheelsets on one track.

Seen from above the leading bogie, with s = j omega, kappa the dynamic stiffness of a suspension
(`suspnet.dynamics.elements`), w the track under the wheelsets, all numbers of one side::

    (kappa_p + kappa_s + s^2 M_p) z_i - kappa_s y_i                 = kappa_p m_i
    (kappa_p + gamma + s^2 M_p (rho_b / a)^2) psi_i + kappa_x (h_3 / a) r_i = kappa_p d_i
    2 M_s s^2 z + sum_i F_i = 0
    2 M_s (rho_c / L)^2 s^2 phi + F_1 - F_2 + sum_i G_i = 0
    (M_s s^2 + c_q s + k_q) q + p sum_i F_i + sigma (G_1 - G_2) = 0

z_i is the bounce of bogie i, psi_i its pitch times the half wheelbase a, m_i and d_i half the sum
and half the difference of the track under its axles; z is the bounce of the body, phi its pitch
times the half pivot distance L, q its first bending with the shape p at the pivots and the slope
sigma / L there, so that the body moves by y_1 = z + phi + p q and y_2 = z - phi + p q above the
bogies and turns by phi_1 = phi + sigma q and phi_2 = phi - sigma q, over L; F_i = kappa_si (y_i -
z_i). gamma is the axle guidance, kappa_x the links between body and bogie along the train with the
levers h_2 and h_3, their stretch r_i = h_2 phi_i / L + h_3 psi_i / a, G_i = kappa_x (h_2 / L) r_i.

Roll stands apart where left and right are alike, with x_i the mean of half the cross level at both
axles, b the half distances of springs and of the rails, and S_i = kappa_si b_s^2 + k_bar / 2::

    (kappa_p b_p^2 + S_i + s^2 M_p r_b^2) theta_i - S_i theta = kappa_p b_p^2 x_i / b_rail
    2 M_s r_c^2 s^2 theta + sum_i S_i (theta - theta_i) = 0

The bogies are eliminated; three equations in z, phi and q, and one in theta remain. k_p, c_p, k_s,
c_s are one bogie side's, M_s a quarter of the body as in the quarter car. All wheelsets follow the
same track, each delayed by its distance over the speed. Cross level and mean are independent
processes: spectra are sums over both. The cross level has a share of the mean's density, times
n^2 / (n^2 + n_0^2) as in the German spectra.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.checks import check_choice, check_number
from suspnet.dynamics.distribution import LogNormal
from suspnet.dynamics.elements import (
    bending_element,
    guidance_element,
    longitudinal_element,
    primary,
    secondary,
)
from suspnet.dynamics.generator import ResponseGenerator, check_ratios
from suspnet.dynamics.motion import LinearSystem
from suspnet.dynamics.quantities import PARTS, QUANTITIES, UNMEASURED
from suspnet.dynamics.quarter_car import QuarterCar
from suspnet.dynamics.track_spectra import CROSS_LEVEL_RAD_PER_M
from suspnet.dynamics.vehicle import GEOMETRY, PARAMETERS, Vehicle
from suspnet.dynamics.vertical_motion import RAIL_LATERAL_M, vertical_motion
from suspnet.tensors import as_tensor, check_device

SIDES = ("leading", "trailing")
N_ALL = len(PARAMETERS) + len(UNMEASURED)


@dataclass(frozen=True)
class VerticalVehicle:
    """Frequency responses axle box -> frame -> body of a vehicle with two pitching bogies.

    Parameters
    ----------
    vehicle : Vehicle
        The healthy vehicle; it must have its four numbers of geometry.
    device : str
        Torch device of the tensors that come back.
    speed_m_per_s : float, [m/s]
    bogie, axle : {"leading", "trailing"}
        Which bogie, and which of its axle boxes, is measured.
    frame_sensor : {"axle", "centre"}
        Sensor on the frame above the measured axle, or at the bogie's centre.
    body_sensor_m : float, [m]
        Sensor on the body, ahead of the bogie's centre.
    other_bogie : {"healthy", "same"}
        The bogie that is not measured: healthy, or as degraded as the measured one.
    parts : sequence of str
        From ``PARTS``: what the vehicle has beyond rigid bodies on linear springs and dampers.
    sensor_lateral_m : sequence of 3 floats, [m]
        Lateral place of the sensors on axle box, frame and body; 0 for the mean of a left and a
        right one, which does not see roll.
    nominal : mapping, optional
        Nominal values of quantities of ``QUANTITIES`` that have one, instead of theirs, SI units.
    distribution : LogNormal or mapping or "prior", optional
        Of uncertain numbers, which training curves sample; a mapping from names of ``UNMEASURED``
        to standard deviations of their logarithms. Its median is what five columns of ratios stand
        for. None: nominal.

    Raises
    ------
    TypeError, ValueError
        If the vehicle's geometry is missing or a setting is out of range.
    """

    vehicle: Vehicle
    device: str = "cpu"
    speed_m_per_s: float = 70.0
    bogie: Literal["leading", "trailing"] = "leading"
    axle: Literal["leading", "trailing"] = "leading"
    frame_sensor: Literal["axle", "centre"] = "axle"
    body_sensor_m: float = 0.0
    other_bogie: Literal["healthy", "same"] = "healthy"
    parts: tuple[str, ...] = ()
    sensor_lateral_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    nominal: Mapping[str, float] | None = None
    distribution: LogNormal | None = None

    def __post_init__(self) -> None:
        check_device(self.device)
        missing = [name for name in GEOMETRY if getattr(self.vehicle, name) is None]
        if missing:
            raise ValueError(
                f"vehicle {self.vehicle.name!r} lacks {missing}, which `VerticalVehicle` needs; "
                "give them or use generator=quarter_car"
            )
        check_choice("bogie", self.bogie, SIDES)
        check_choice("axle", self.axle, SIDES)
        check_choice("frame_sensor", self.frame_sensor, ("axle", "centre"))
        check_choice("other_bogie", self.other_bogie, ("healthy", "same"))
        check_number("speed_m_per_s", self.speed_m_per_s, above=0)
        check_number("body_sensor_m", self.body_sensor_m)
        for part in self.parts:
            check_choice("parts", part, PARTS)
        object.__setattr__(self, "parts", tuple(p for p in PARTS if p in self.parts))
        self._check_places()
        self._check_nominal()
        object.__setattr__(self, "distribution", _distribution(self.distribution, self.parts))

    def _check_places(self) -> None:
        """Raise ValueError unless there are three lateral places, and roll where one is not 0."""
        if len(self.sensor_lateral_m) != 3:
            raise ValueError(
                f"`sensor_lateral_m` must be three places, got {self.sensor_lateral_m}"
            )
        for i, place in enumerate(self.sensor_lateral_m):
            check_number(f"sensor_lateral_m[{i}]", place, low=-2, high=2)
        object.__setattr__(self, "sensor_lateral_m", tuple(map(float, self.sensor_lateral_m)))

    def _check_nominal(self) -> None:
        """Raise ValueError unless `nominal` holds positive values of quantities that have one."""
        allowed = {quantity.name for quantity in QUANTITIES if quantity.nominal is not None}
        unknown = sorted(set(self.nominal or {}) - allowed)
        if unknown:
            raise ValueError(f"`nominal` must be named as in {sorted(allowed)}, got {unknown}")
        for name, value in (self.nominal or {}).items():
            check_number(f"nominal.{name}", value, above=0)

    def sample_unmeasured(self, ratios: Tensor | ArrayLike, seed: int) -> Tensor:
        """Return the ratios with a column for each name of ``UNMEASURED``.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5) or (n_vehicles, 6), [-]
        seed : int

        Returns
        -------
        tensor of shape (n_vehicles, 5 + n_unmeasured), [-]
            Drawn from the distribution; 1 where nothing is uncertain.
        """
        rows = as_tensor(ratios).to("cpu", torch.float64)
        if self.distribution is None or not self.distribution.names:
            return self.complete(rows).clone()
        shape = len(rows), len(self.distribution.names)
        standard = np.random.default_rng(seed).standard_normal(shape)
        return self.with_uncertain(rows, torch.as_tensor(self.distribution.ratios(standard)))

    def with_uncertain(self, ratios: Tensor, numbers: Tensor) -> Tensor:
        """Return the ratios with a column for each name of ``UNMEASURED``.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5) or (n_vehicles, 6), [-]
        numbers : tensor of shape (n_vehicles, n_names), [-]
            Those that the distribution is of.
        """
        columns = torch.tensor(self.uncertain_columns, device=ratios.device)
        return self.complete(ratios).index_copy(1, columns, numbers)

    def responses(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> tuple[Tensor, Tensor]:
        """Return complex G_p (axle box to frame sensor) and G_s (frame to body sensor).

        They are the responses to the mean of both rails; see `channels`.

        Parameters
        ----------
        ratios : tensor or array of shape (n_vehicles, 5), (n_vehicles, 6) or all columns, [-]
            ``PARAMETERS`` and, if given, speed or all of ``UNMEASURED``, relative to nominal.
        frequencies_hz : tensor or array of shape (n_freq,), [Hz]

        Returns
        -------
        G_p, G_s : complex128 tensors of shape (n_vehicles, n_freq), [-]

        Raises
        ------
        ValueError
            If `ratios` has another shape or a value that is not positive and finite.
        """
        frame, body = _bounced(self, *self._prepared(ratios, frequencies_hz))
        return frame, body / frame

    def channels(self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike) -> Tensor:
        """Return axle box, frame and body for each independent input of the track.

        Parameters
        ----------
        ratios, frequencies_hz : as of `responses`

        Returns
        -------
        complex128 tensor of shape (n_vehicles, n_inputs, 3, n_freq), [-]
            Inputs: the mean of both rails, and with roll and a sensor off the middle the cross
            level, scaled such that each input has the density of the mean.
        """
        p, omega = self._prepared(ratios, frequencies_hz)
        frame, body = _bounced(self, p, omega)
        inputs = [torch.stack([torch.ones_like(frame), frame, body], dim=1)]
        if self.rolls:
            inputs.append(_rolled(self, p, omega))
        return torch.stack(inputs, dim=1)

    @property
    def rolls(self) -> bool:
        """Whether a sensor feels roll: the vehicle has it, and a sensor is off the middle."""
        return "roll" in self.parts and any(self.sensor_lateral_m)

    def magnitudes(self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike) -> Tensor:
        """Return abs(G_p) and abs(G_s) as one real tensor of shape (n_vehicles, 2, n_freq)."""
        return torch.stack(self.responses(ratios, frequencies_hz), dim=1).abs()

    @property
    def further_places(self) -> tuple[str, ...]:
        """Names of places for further sensors: on the frame, on the body, the other axle box."""
        elsewhere = self._elsewhere
        frame = {"centre": "frame centre", "axle": "frame above the axle"}[elsewhere.frame_sensor]
        bogie = "other" if elsewhere.body_sensor_m else "measured"
        return frame, f"body above the {bogie} bogie", "second axle box"

    def further_channels(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> Tensor:
        """Return ``further_places`` for each input, (n_vehicles, n_inputs, n_places, n_freq).

        The track reaches the second axle box a wheelbase later, or earlier if it leads.
        """
        channels = self._elsewhere.channels(ratios, frequencies_hz)
        both = self._wheels(*self._prepared(ratios, frequencies_hz))[:2]
        second = both[1 if self.axle == "leading" else 0][:, None, None]
        return torch.cat([channels[:, :, 1:], second * channels[:, :, :1]], dim=2)

    @property
    def _elsewhere(self) -> VerticalVehicle:
        """Return the generator with its frame and body sensor moved to the further places."""
        half_pivot_m = self.vehicle.half_pivot_distance_m
        assert half_pivot_m is not None
        other_m = -2 * half_pivot_m if self.bogie == "leading" else 2 * half_pivot_m
        body_sensor_m = 0.0 if math.isclose(self.body_sensor_m, other_m) else other_m
        frame_sensor: Literal["axle", "centre"] = (
            "centre" if self.frame_sensor == "axle" else "axle"
        )
        return replace(self, frame_sensor=frame_sensor, body_sensor_m=body_sensor_m)

    def of(self, vehicle: Vehicle) -> ResponseGenerator:
        """Return the generator with these settings for another vehicle; see `best_generator`."""
        if all(getattr(vehicle, name) is None for name in GEOMETRY):
            return QuarterCar(vehicle, self.device)
        return replace(self, vehicle=vehicle)

    def on(self, device: str) -> VerticalVehicle:
        """Return the same generator on another device."""
        return replace(self, device=device)

    def assumptions(self) -> str:
        """Return a sentence on the assumptions of the generator."""
        return (
            "The vehicle pitches; speed, geometry, inertias and the other bogie are taken as known "
            "exactly."
        )

    def motion_system(self, ratios: Tensor | ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, for simulation in time.

        Parameters
        ----------
        ratios : tensor of shape (5,), (6,) or all columns, [-]
        """
        return vertical_motion(
            self._numbers(as_tensor(ratios)[None]),
            self.parts if self.rolls else tuple(part for part in self.parts if part != "roll"),
            bogie=self.bogie,
            axle=self.axle,
            frame_sensor=self.frame_sensor,
            body_sensor_m=self.body_sensor_m,
            empty_kg=self.vehicle.body_mass_kg,
        )

    def complete(self, ratios: Tensor) -> Tensor:
        """Return ratios with all columns: what is not given is the distribution's median."""
        if ratios.ndim == 2 and ratios.shape[1] > len(PARAMETERS) + 1:
            check_ratios(ratios, N_ALL)
            return ratios
        n_given = ratios.shape[-1] if ratios.ndim == 2 else len(PARAMETERS)
        check_ratios(ratios, max(n_given, len(PARAMETERS)))
        columns = torch.ones(len(ratios), N_ALL).to(ratios)
        if self.distribution is not None:
            columns[:, self.uncertain_columns] = (
                torch.tensor(self.distribution.mean, dtype=torch.float64).exp().to(ratios)
            )
        columns[:, :n_given] = ratios
        if self.other_bogie == "same":
            columns[:, _OTHER] = ratios[:, :4]
        return columns

    @property
    def uncertain_columns(self) -> list[int]:
        """Columns of the numbers that the distribution is of."""
        assert self.distribution is not None
        return [len(PARAMETERS) + UNMEASURED.index(name) for name in self.distribution.names]

    def _prepared(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Return every number of the vehicles, and the angular frequencies [rad/s]."""
        bins = as_tensor(frequencies_hz).to(self.device, torch.float64)
        return self._numbers(ratios), 2 * math.pi * bins

    def _numbers(self, ratios: Tensor | ArrayLike) -> dict[str, Tensor]:
        """Return every number of the vehicle in SI units, each of shape (n_vehicles, 1)."""
        columns = self.complete(as_tensor(ratios).to(self.device, torch.float64))
        nominal = torch.tensor(self.nominal_values(), dtype=torch.float64, device=self.device)
        values = (columns * nominal).T.unsqueeze(-1)
        p = dict(zip((*PARAMETERS, *UNMEASURED), values, strict=True))
        for name in PARAMETERS[:4]:  # healthy first, then what is worn of it
            p[name] = p[name] * p[f"healthy_{name}"]
            p[f"other_{name}"] = p[f"other_{name}"] * p[f"healthy_{name}"]
        return p

    def nominal_values(self) -> tuple[float, ...]:
        """Return what a ratio of 1 stands for: ``PARAMETERS``, then ``UNMEASURED``.

        SI units, but 1 for k_p, c_p, k_s, c_s of both bogies: they multiply the healthy values.
        """
        v = self.vehicle
        given = dict(
            zip((f"healthy_{name}" for name in PARAMETERS), v.healthy_values(), strict=True)
        )
        given |= {"speed": self.speed_m_per_s, "bogie_mass": v.bogie_mass_kg}
        given |= {name.removesuffix("_m"): float(getattr(v, name)) for name in GEOMETRY}
        places = zip(("axle_box", "frame", "body"), self.sensor_lateral_m, strict=True)
        given |= {f"{name}_lateral": place for name, place in places} | dict(self.nominal or {})
        first = (1.0, 1.0, 1.0, 1.0, float(v.body_mass_kg))
        standard = (1.0 if q.nominal is None else q.nominal for q in QUANTITIES)
        return first + tuple(
            float(given.get(q.name, value)) for q, value in zip(QUANTITIES, standard, strict=True)
        )

    def _wheels(self, p: Mapping[str, Tensor], omega: Tensor) -> list[Tensor]:
        """Return the motion of each wheelset relative to the measured one, exp(-j omega delay)."""
        a, pivot = p["half_wheelbase"], p["half_pivot_distance"]
        # one exponential for each length, not for each wheelset
        unit = _phasor(omega * 2 * a / p["speed"])
        apart = _phasor(omega * 2 * pivot / p["speed"])
        one = torch.ones_like(unit)
        own = [one, unit] if self.axle == "leading" else [unit.conj(), one]
        if self.bogie == "trailing":
            apart = apart.conj()
        return [*own, *(apart * wheel for wheel in own)]


def best_generator(vehicle: Vehicle, device: str = "cpu", **settings: Any) -> ResponseGenerator:
    """Return a vertical vehicle where the geometry is known, else a quarter car.

    Parameters
    ----------
    vehicle : Vehicle
    device : str
    settings
        Of ``VerticalVehicle``; a vehicle without geometry (a road vehicle) has no use for them.
    """
    if all(getattr(vehicle, name) is None for name in GEOMETRY):
        return QuarterCar(vehicle, device)
    return VerticalVehicle(vehicle, device, **settings)


_OTHER = slice(
    len(PARAMETERS) + UNMEASURED.index("other_k_p"),
    len(PARAMETERS) + UNMEASURED.index("other_c_s") + 1,
)
"""Columns of the bogie that is not measured."""


def _distribution(
    given: LogNormal | Mapping[str, Any] | str | None, parts: tuple[str, ...]
) -> LogNormal | None:
    """Return a distribution from what a configuration or a model file may hold of one."""
    if given is None or isinstance(given, LogNormal):
        return given
    if isinstance(given, str):
        check_choice("distribution", given, ("prior",))
        return LogNormal.prior(parts)
    if set(given) == {"names", "mean", "covariance"}:
        return LogNormal(**given)
    unknown = sorted(set(given) - set(UNMEASURED))
    if unknown:
        raise ValueError(f"`distribution` must be named as in {UNMEASURED}, got {unknown}")
    return LogNormal.independent(given)


@dataclass(frozen=True)
class _Bogie:
    """One bogie without its coordinates: bounce z_i = link y_i + free, pitch = swing - tilt phi_i.

    Its secondary suspension pushes the body down by resistance y_i - force, its links turn it
    back by upright phi_i - push; phi_i is the body's pitch over the bogie.
    """

    link: Tensor
    free: Tensor
    resistance: Tensor
    force: Tensor
    swing: Tensor
    tilt: Tensor | float
    upright: Tensor | float
    push: Tensor


def _bounced(
    vehicle: VerticalVehicle, p: Mapping[str, Tensor], omega: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the motion under the sensors on frame and body for 1 m of mean track."""
    wheels = vehicle._wheels(p, omega)
    forward = 1.0 if vehicle.bogie == "leading" else -1.0
    # phi counts positive where the measured bogie rises, psi where the leading axle does
    p = {**p, "body_lever": forward * p["body_lever"]}
    link_x = longitudinal_element(p).at(omega) if "longitudinal" in vehicle.parts else None
    first = _bogie(p, "", omega, wheels[:2], link_x, vehicle.parts)
    other = _bogie(p, "other_", omega, wheels[2:], link_x, vehicle.parts)
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
    if "bending" in vehicle.parts:
        own, at_pivot = _modal(vehicle, p, omega), p["bending_at_pivot"]
        row = [at_pivot * total, at_pivot * difference, own + at_pivot**2 * total]
        force = at_pivot * bounce_force
        if link_x is not None:
            slope = p["bending_slope"]
            row[1] = row[1] + slope * (first.upright - other.upright)
            row[2] = row[2] + slope**2 * (first.upright + other.upright)
            force = force + slope * (first.push - other.push)
        # the last of three equations is eliminated
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
    turned, over = pitch, bounce + pitch
    at_sensor: Tensor | float = 0.0
    if "bending" in vehicle.parts:
        bending = bending - share[0] * bounce - share[1] * pitch
        turned = pitch + p["bending_slope"] * bending
        over = over + p["bending_at_pivot"] * bending
        at_sensor = p["bending_at_sensor"] * bending
    frame = first.link * over + first.free
    if vehicle.frame_sensor == "axle":
        tilted = first.swing - first.tilt * turned
        frame = frame + (tilted if vehicle.axle == "leading" else -tilted)
    ahead = 1 + forward * vehicle.body_sensor_m / p["half_pivot_distance"]
    return frame, bounce + ahead * pitch + at_sensor


def _bogie(
    p: Mapping[str, Tensor],
    which: str,
    omega: Tensor,
    wheels: list[Tensor],
    link_x: Tensor | None,
    parts: tuple[str, ...],
) -> _Bogie:
    """Return the measured ("") or the other bogie with its bounce and pitch eliminated."""
    kappa_p, kappa_s = primary(p, which, omega, parts), secondary(p, which, omega, parts)
    inertia = p["bogie_mass"] * omega**2
    below = kappa_p + kappa_s - inertia
    link = kappa_s / below
    free = 0.5 * (wheels[0] + wheels[1]) * kappa_p / below
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


def _modal(vehicle: VerticalVehicle, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return the dynamic stiffness of the body's bending by itself."""
    own = bending_element(p, vehicle.vehicle.body_mass_kg)
    return own.at(omega) - p["M_s"] * omega**2


def _rolled(vehicle: VerticalVehicle, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return axle box, frame and body sensor for the cross level, (n_vehicles, 3, n_freq)."""
    wheels = vehicle._wheels(p, omega)
    mass = p["bogie_mass"] * (p["bogie_roll_gyration"] * omega) ** 2
    total: Tensor | float = -2 * p["M_s"] * (p["body_roll_gyration"] * omega) ** 2
    force: Tensor | float = 0.0
    links, frees = [], []
    for which, pair in (("", wheels[:2]), ("other_", wheels[2:])):
        below = primary(p, which, omega, vehicle.parts) * p["primary_lateral"] ** 2
        above = secondary(p, which, omega, vehicle.parts) * p["secondary_lateral"] ** 2
        above = above + p["anti_roll_bar"] / 2
        all_ = below + above - mass
        links.append(above / all_)
        frees.append(below * 0.5 * (pair[0] + pair[1]) / (RAIL_LATERAL_M * all_))
        total = total + above * (1 - links[-1])
        force = force + above * frees[-1]
    body = force / total
    frame = links[0] * body + frees[0]
    box = torch.full_like(frame, 1 / RAIL_LATERAL_M)
    places = [p[f"{name}_lateral"] for name in ("axle_box", "frame", "body")]
    angles = torch.stack(
        [y * angle for y, angle in zip(places, (box, frame, body), strict=True)], 1
    )
    waves = (omega / p["speed"]) ** 2
    share = p["cross_level"] * waves / (waves + CROSS_LEVEL_RAD_PER_M**2)
    return share.sqrt()[:, None] * angles


def _phasor(angle: Tensor) -> Tensor:
    """Return exp(-j angle)."""
    return torch.complex(torch.cos(angle), -torch.sin(angle))
