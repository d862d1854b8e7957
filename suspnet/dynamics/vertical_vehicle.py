"""A vehicle that pitches: body and two bogies, four wheelsets on one track, six coordinates.

Seen from above the leading bogie, with kappa = k + j omega c, the bogies' bounce z_1, z_2, the
body's bounce z and its pitch times the half pivot distance phi (so that the body moves by
y_1 = z + phi and y_2 = z - phi above the bogies), psi the bogie's pitch times the half wheelbase::

    (kappa_p + kappa_s - omega^2 M_p) z_i - kappa_s y_i = kappa_p (w_i1 + w_i2) / 2
    (kappa_p - omega^2 M_p (rho_b / a)^2) psi_i         = kappa_p (w_i1 - w_i2) / 2
    2 M_s omega^2 z = sum_i kappa_si (y_i - z_i),
    2 M_s (rho_c / L)^2 omega^2 phi = kappa_s1 (y_1 - z_1) - kappa_s2 (y_2 - z_2)

k_p, c_p, k_s, c_s are one bogie side's, M_s a quarter of the body as in the quarter car. Bogie
pitch stands alone and the bounces can be eliminated, so that two equations in z and phi remain;
their closed solution costs a few products for each frequency, no 6 x 6 system. All wheelsets follow
the same track, each delayed by its distance over the speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.checks import check_choice, check_number
from suspnet.dynamics.generator import ResponseGenerator, check_ratios
from suspnet.dynamics.motion import LinearSystem
from suspnet.dynamics.quarter_car import QuarterCar
from suspnet.dynamics.vehicle import GEOMETRY, PARAMETERS, Vehicle
from suspnet.tensors import as_tensor, check_device
from suspnet.types import FloatArray

UNMEASURED = (
    "other_k_p",
    "other_c_p",
    "other_k_s",
    "other_c_s",
    "bogie_mass",
    "half_wheelbase",
    "half_pivot_distance",
    "bogie_gyration",
    "body_gyration",
    "speed",
)
"""Quantities that may differ from nominal besides ``PARAMETERS``, as further columns of ratios."""
SIDES = ("leading", "trailing")


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
    other_bogie : {"healthy", "same", "varies"}
        The bogie that is not measured: healthy, as degraded as the measured one, or apart from it
        (uniform, healthy times 1 +- `other_spread`).
    other_spread : float, [-]
    uncertainty : mapping, optional
        Names from ``UNMEASURED`` to half widths: training curves sample 1 +- half width.

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
    other_bogie: Literal["healthy", "same", "varies"] = "healthy"
    other_spread: float = 0.4
    uncertainty: Mapping[str, float] = field(default_factory=dict)

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
        check_choice("other_bogie", self.other_bogie, ("healthy", "same", "varies"))
        check_number("speed_m_per_s", self.speed_m_per_s, above=0)
        check_number("other_spread", self.other_spread, low=0, below=1)
        unknown = sorted(set(self.uncertainty) - set(UNMEASURED))
        if unknown:
            raise ValueError(f"`uncertainty` must be named as in {UNMEASURED}, got {unknown}")
        for name, value in self.uncertainty.items():
            check_number(f"uncertainty.{name}", value, low=0, below=1)

    def sample_unmeasured(self, ratios: Tensor | ArrayLike, seed: int) -> Tensor:
        """Return the ratios with a random column for each name of ``UNMEASURED``.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5), [-]
        seed : int

        Returns
        -------
        tensor of shape (n_vehicles, 15), [-]
            Uniform in 1 +- half width; 1 where nothing is uncertain.
        """
        widths = dict.fromkeys(UNMEASURED, 0.0) | dict(self.uncertainty)
        if self.other_bogie == "varies":
            widths |= dict.fromkeys(UNMEASURED[:4], self.other_spread)
        ratios = as_tensor(ratios).to("cpu", torch.float64)
        half = torch.tensor([widths[name] for name in UNMEASURED], dtype=torch.float64)
        source = torch.Generator().manual_seed(seed)
        draws = torch.rand(len(ratios), len(half), generator=source, dtype=torch.float64)
        columns = self._complete(ratios)[:, len(PARAMETERS) :]
        return torch.cat([ratios, columns * (1 + half * (2 * draws - 1))], 1)

    def responses(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> tuple[Tensor, Tensor]:
        """Return complex G_p (axle box to frame sensor) and G_s (frame to body sensor).

        Parameters
        ----------
        ratios : tensor or array of shape (n_vehicles, 5) or (n_vehicles, 15), [-]
            ``PARAMETERS`` and, if given, ``UNMEASURED``, relative to healthy and nominal.
        frequencies_hz : tensor or array of shape (n_freq,), [Hz]

        Returns
        -------
        G_p, G_s : complex128 tensors of shape (n_vehicles, n_freq), [-]

        Raises
        ------
        ValueError
            If `ratios` has another shape or a value that is not positive and finite.
        """
        p = self._numbers(ratios)
        omega = 2 * math.pi * as_tensor(frequencies_hz).to(self.device, torch.float64)
        wheels = self._wheels(p, omega)
        first, other = _bogie(p, "", omega, wheels[:2]), _bogie(p, "other_", omega, wheels[2:])
        inertia = 2 * p["M_s"] * omega**2
        total = first.resistance + other.resistance
        difference = first.resistance - other.resistance
        bounce_force, pitch_force = first.force + other.force, first.force - other.force
        a, b = total - inertia, total - inertia * (p["body_gyration"] / p["half_pivot"]) ** 2
        determinant = a * b - difference**2
        bounce = (b * bounce_force - difference * pitch_force) / determinant
        pitch = (a * pitch_force - difference * bounce_force) / determinant
        frame = first.link * (bounce + pitch) + first.free
        if self.frame_sensor == "axle":
            frame = frame + (first.pitch if self.axle == "leading" else -first.pitch)
        forward = 1.0 if self.bogie == "leading" else -1.0
        body = bounce + (1 + forward * self.body_sensor_m / p["half_pivot"]) * pitch
        return frame, body / frame

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

    def further_responses(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> Tensor:
        """Return the responses from the axle box to ``further_places``, (n_vehicles, 3, n_freq).

        The track reaches the second axle box a wheelbase later, or earlier if it leads.
        """
        frame, to_body = self._elsewhere.responses(ratios, frequencies_hz)
        half_wheelbase_m = self.vehicle.half_wheelbase_m
        assert half_wheelbase_m is not None
        delay_s = 2 * half_wheelbase_m / self.speed_m_per_s
        behind = 1.0 if self.axle == "leading" else -1.0
        bins = as_tensor(frequencies_hz).to(frame.device)
        delay = torch.exp(-2j * math.pi * behind * delay_s * bins)
        return torch.stack([frame, frame * to_body, delay.expand_as(frame)], dim=1)

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

        Coordinates: z, phi of the body, then z_i and psi_i of the measured and the other bogie.

        Parameters
        ----------
        ratios : tensor of shape (5,) or (15,), [-]
        """
        p = {name: float(v.squeeze()) for name, v in self._numbers(as_tensor(ratios)[None]).items()}
        m_p, m_s = p["bogie_mass"], p["M_s"]
        pitch = m_p * (p["bogie_gyration"] / p["half_wheelbase"]) ** 2
        body_pitch = 2 * m_s * (p["body_gyration"] / p["half_pivot"]) ** 2
        mass = np.diag([2 * m_s, body_pitch, m_p, pitch, m_p, pitch])
        damping, stiffness = (_couple(p, kind) for kind in "ck")
        input_damping, input_stiffness = (_drive(p, kind) for kind in "ck")
        sensors = np.zeros((2, 6))
        sensors[0, 2] = 1.0
        if self.frame_sensor == "axle":
            sensors[0, 3] = 1.0 if self.axle == "leading" else -1.0
        forward = 1.0 if self.bogie == "leading" else -1.0
        sensors[1, :2] = 1.0, 1 + forward * self.body_sensor_m / p["half_pivot"]
        behind = self._behind(p["half_wheelbase"], p["half_pivot"])
        return LinearSystem(
            mass, damping, stiffness, input_damping, input_stiffness, sensors, tuple(behind)
        )

    def _complete(self, ratios: Tensor) -> Tensor:
        """Return ratios with all 15 columns: what is not given is nominal."""
        if ratios.ndim == 2 and ratios.shape[1] > len(PARAMETERS):
            check_ratios(ratios, len(PARAMETERS) + len(UNMEASURED))
            return ratios
        check_ratios(ratios, len(PARAMETERS))
        same = ratios[:, :4] if self.other_bogie == "same" else torch.ones_like(ratios[:, :4])
        rest = torch.ones(len(ratios), len(UNMEASURED) - 4).to(ratios)
        return torch.cat([ratios, same, rest], dim=1)

    def _numbers(self, ratios: Tensor | ArrayLike) -> dict[str, Tensor]:
        """Return every number of the vehicle in SI units, each of shape (n_vehicles, 1)."""
        v = self.vehicle
        healthy = v.healthy_values()
        geometry = [float(getattr(v, name)) for name in GEOMETRY]
        nominal = [*healthy, *healthy[:4], v.bogie_mass_kg, *geometry, self.speed_m_per_s]
        names = [*PARAMETERS, *UNMEASURED[:5], "half_wheelbase", "half_pivot"]
        names += ["bogie_gyration", "body_gyration", "speed"]
        values = self._complete(as_tensor(ratios).to(self.device, torch.float64))
        values = values * torch.tensor(nominal, dtype=torch.float64, device=self.device)
        return dict(zip(names, values.T.unsqueeze(-1), strict=True))

    def _behind(self, half_wheelbase: float, half_pivot: float) -> list[float]:
        """Return how far the wheelsets run behind the measured one: its bogie's two, the other's.

        Phi and psi count positive where the measured bogie, and the leading axle, rise.
        """
        shift = half_wheelbase if self.axle == "leading" else -half_wheelbase
        apart = 2 * half_pivot if self.bogie == "leading" else -2 * half_pivot
        own = [shift - half_wheelbase, shift + half_wheelbase]
        return own + [apart + distance for distance in own]

    def _wheels(self, p: Mapping[str, Tensor], omega: Tensor) -> list[Tensor]:
        """Return the motion of each wheelset relative to the measured one, exp(-j omega delay)."""
        a, pivot = p["half_wheelbase"], p["half_pivot"]
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


@dataclass(frozen=True)
class _Bogie:
    """One bogie with its bounce eliminated: z_i = link y_i + free, force on body f - r y_i."""

    link: Tensor
    free: Tensor
    resistance: Tensor
    force: Tensor
    pitch: Tensor


def _bogie(p: Mapping[str, Tensor], which: str, omega: Tensor, wheels: list[Tensor]) -> _Bogie:
    """Return the measured ("") or the other bogie with its bounce eliminated."""
    primary = torch.complex(*torch.broadcast_tensors(p[which + "k_p"], omega * p[which + "c_p"]))
    secondary = torch.complex(*torch.broadcast_tensors(p[which + "k_s"], omega * p[which + "c_s"]))
    inertia = p["bogie_mass"] * omega**2
    link = secondary / (primary + secondary - inertia)
    rest = 0.5 * (wheels[0] + wheels[1]) * primary
    pitch = 0.5 * (wheels[0] - wheels[1]) * primary
    pitch_inertia = inertia * (p["bogie_gyration"] / p["half_wheelbase"]) ** 2
    free = rest / (primary + secondary - inertia)
    return _Bogie(
        link=link,
        free=free,
        resistance=secondary * (1 - link),
        force=secondary * free,
        pitch=pitch / (primary - pitch_inertia),
    )


def _phasor(angle: Tensor) -> Tensor:
    """Return exp(-j angle)."""
    return torch.complex(torch.cos(angle), -torch.sin(angle))


def _couple(p: Mapping[str, float], kind: str) -> FloatArray:
    """Return the damping (c) or stiffness (k) matrix for (z, phi, z_1, psi_1, z_2, psi_2)."""
    matrix = np.zeros((6, 6))
    for which, sign, row in (("", 1.0, 2), ("other_", -1.0, 4)):
        secondary, primary = p[f"{which}{kind}_s"], p[f"{which}{kind}_p"]
        stretch = np.zeros(6)
        stretch[[0, 1, row]] = 1.0, sign, -1.0
        matrix += secondary * np.outer(stretch, stretch)
        matrix[row, row] += primary
        matrix[row + 1, row + 1] += primary
    return matrix


def _drive(p: Mapping[str, float], kind: str) -> FloatArray:
    """Return the input matrix of the four wheelsets, (6, 4)."""
    matrix = np.zeros((6, 4))
    for which, row, column in (("", 2, 0), ("other_", 4, 2)):
        half = 0.5 * p[f"{which}{kind}_p"]
        matrix[row : row + 2, column : column + 2] = [[half, half], [half, -half]]
    return matrix
