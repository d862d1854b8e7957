"""Checked parameters of a vehicle in SI units, and the interface of response generators."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.ground.parameters import DEFAULT_LIMITS, Direction, Limits, read_limits
from suspnet.ground.parameters import PARAMETERS as PARAMETERS
from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.tensors import as_tensor
from suspnet.vehicle.motion import LinearSystem
from suspnet.vehicle.quantities import LogNormal

GEOMETRY = ("half_wheelbase_m", "half_pivot_distance_m", "bogie_gyration_m", "body_gyration_m")

FREQUENCY_RANGE_HZ = (0.2, 50.0)
"""Uncoupled natural frequencies outside this range mean that a unit is wrong."""
DAMPING_RATIO_RANGE = (1e-3, 10.0)
"""Uncoupled damping ratios outside this range mean that a unit is wrong."""
STIFFNESS_SLIPS = (
    "stiffness in kN/m (multiply by 1e3), or a mass in grams",
    "stiffness 1e3 too large (the paper's Tables III and IV print kN/m where N/m is meant), or a "
    "mass in tonnes",
)
DAMPING_SLIPS = (
    "damping coefficient in kN s/m (multiply by 1e3)",
    "damping coefficient 1e3 too large (kN s/m for N s/m)",
)
"""What is likely where a frequency or a damping ratio is below, and where it is above its range."""
_FIELD = {
    "k_p": "primary_stiffness_n_per_m",
    "c_p": "primary_damping_ns_per_m",
    "k_s": "secondary_stiffness_n_per_m",
    "c_s": "secondary_damping_ns_per_m",
    "M_s": "body_mass_kg",
}


@dataclass(frozen=True)
class Vehicle:
    """Six parameters of one bogie side's share of a vehicle, in SI units (Table III of the paper).

    On a road vehicle the primary suspension is the tyre. ValueError if an uncoupled natural
    frequency or damping ratio is so far off that a unit must be wrong; the message names the likely
    mistake.

    Examples
    --------
    >>> am96 = Vehicle("am96", 1725.0, 6300.0, 1.30e6, 3.7e3, 0.69e6, 22.6e3)
    >>> round(am96.secondary_frequency_hz, 2)
    1.67
    """

    name: Annotated[
        str,
        Setting("Name of the vehicle, which the manifests of its trips must state", rule="text"),
    ]
    bogie_mass_kg: Annotated[
        float, Setting("Mass of the bogie frame that one bogie side carries, M_p", "kg", above=0)
    ]
    body_mass_kg: Annotated[
        float,
        Setting(
            "Mass of the car body that one bogie side carries, M_s, a quarter of a rail vehicle",
            "kg",
            above=0,
        ),
    ]
    primary_stiffness_n_per_m: Annotated[
        float,
        Setting(
            "Stiffness of the primary suspension of one bogie side, k_p; sqrt(k_p / M_p) / 2π must "
            "lie in 0.2 to 50 Hz",
            "N/m",
            above=0,
        ),
    ]
    primary_damping_ns_per_m: Annotated[
        float,
        Setting(
            "Damping of the primary suspension of one bogie side, c_p; c_p / (2 sqrt(k_p M_p)) "
            "must lie in 0.001 to 10",
            "N s/m",
            above=0,
        ),
    ]
    secondary_stiffness_n_per_m: Annotated[
        float,
        Setting(
            "Stiffness of the secondary suspension of one bogie side, k_s; sqrt(k_s / M_s) / 2π "
            "must lie in 0.2 to 50 Hz",
            "N/m",
            above=0,
        ),
    ]
    secondary_damping_ns_per_m: Annotated[
        float,
        Setting(
            "Damping of the secondary suspension of one bogie side, c_s; c_s / (2 sqrt(k_s M_s)) "
            "must lie in 0.001 to 10",
            "N s/m",
            above=0,
        ),
    ]
    source: str = setting("", "Where the numbers come from", rule="text")
    half_wheelbase_m: float | None = setting(
        None,
        "Distance from a bogie's centre to its axles; without the geometry, these four numbers, "
        "a vehicle cannot pitch: generator=quarter_car",
        "m",
        above=0,
        most=100,
    )
    half_pivot_distance_m: float | None = setting(
        None, "Distance from the car body's centre to the bogies' centres", "m", above=0, most=100
    )
    bogie_gyration_m: float | None = setting(
        None, "Radius of gyration of a bogie in pitch", "m", above=0
    )
    body_gyration_m: float | None = setting(
        None, "Radius of gyration of the car body in pitch", "m", above=0
    )
    limits: Annotated[
        Mapping[str, Any] | None,
        Setting(
            "When to look (notice) and when to act: (lower, upper) of each parameter relative to "
            "healthy, and why; null raises no alarm; without limits, these numbers hold",
            rule="lower at least 0 and below 1; upper above 1; notice within act",
        ),
    ] = field(default=None, compare=False)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.limits is not None:
            limits = self.known_limits
            plain = {
                name: limits[name].to_dict() if name in limits else None for name in self.limits
            }
            object.__setattr__(self, "limits", plain)
        for suspension in ("primary", "secondary"):
            frequency_hz = getattr(self, f"{suspension}_frequency_hz")
            quantity = f"uncoupled {suspension} natural frequency [Hz]"
            _check_plausible(self, quantity, frequency_hz, FREQUENCY_RANGE_HZ, STIFFNESS_SLIPS)
            ratio = getattr(self, f"{suspension}_damping_ratio")
            quantity = f"{suspension} damping ratio"
            _check_plausible(self, quantity, ratio, DAMPING_RATIO_RANGE, DAMPING_SLIPS)

    @property
    def known_limits(self) -> dict[str, Limits]:
        """Limits of each parameter and part that has any: the vehicle's, else the default ones."""
        return read_limits(self.limits or {}, DEFAULT_LIMITS, f"the file of vehicle {self.name}")

    @property
    def primary_frequency_hz(self) -> float:
        """Uncoupled natural frequency of the bogie, sqrt(k_p / M_p) / (2 pi), [Hz]."""
        return math.sqrt(self.primary_stiffness_n_per_m / self.bogie_mass_kg) / (2 * math.pi)

    @property
    def secondary_frequency_hz(self) -> float:
        """Uncoupled natural frequency of the car body, sqrt(k_s / M_s) / (2 pi), [Hz]."""
        return math.sqrt(self.secondary_stiffness_n_per_m / self.body_mass_kg) / (2 * math.pi)

    @property
    def primary_damping_ratio(self) -> float:
        """Uncoupled damping ratio c_p / (2 sqrt(k_p M_p)), [-]."""
        critical = 2 * math.sqrt(self.primary_stiffness_n_per_m * self.bogie_mass_kg)
        return self.primary_damping_ns_per_m / critical

    @property
    def secondary_damping_ratio(self) -> float:
        """Uncoupled damping ratio c_s / (2 sqrt(k_s M_s)), [-]."""
        critical = 2 * math.sqrt(self.secondary_stiffness_n_per_m * self.body_mass_kg)
        return self.secondary_damping_ns_per_m / critical

    def degraded(self, **ratios: float) -> Vehicle:
        """Return the vehicle with parameters multiplied by ratios, e.g. ``degraded(k_p=0.5)``.

        ValueError if a name is not one of ``PARAMETERS``.
        """
        unknown = sorted(set(ratios) - set(PARAMETERS))
        if unknown:
            raise ValueError(f"`ratios` must be named as in {PARAMETERS}, got {unknown}")
        changed = {_FIELD[name]: getattr(self, _FIELD[name]) * ratios[name] for name in ratios}
        return replace(self, **changed)

    def healthy_values(self) -> tuple[float, ...]:
        """Return (k_p, c_p, k_s, c_s, M_s) of the healthy vehicle, SI units."""
        return tuple(float(getattr(self, _FIELD[name])) for name in PARAMETERS)


def check_vehicle(vehicle: object) -> None:
    """Raise TypeError unless a generator's vehicle is one."""
    if not isinstance(vehicle, Vehicle):
        raise TypeError(f"`vehicle` must be a Vehicle, got {vehicle!r}")


def _check_plausible(
    vehicle: Vehicle, quantity: str, value: float, ends: tuple[float, float], slips: tuple[str, str]
) -> None:
    """Raise ValueError with the likely slip if a value is below or above the ends of its range."""
    if not ends[0] <= value <= ends[1]:
        raise ValueError(
            f"vehicle {vehicle.name!r}: the {quantity} is {value:.3g}, outside "
            f"{ends[0]}-{ends[1]}; is the {slips[int(value > ends[1])]}? Give N/m, N s/m and kg"
        )


class ResponseGenerator:
    """Frequency responses of degraded vehicles: axle box to bogie (G_p), bogie to body (G_s).

    A generator is a frozen dataclass of this base. `vehicle` is the healthy one, `device` the torch
    device of the returned tensors; the defaults suit a generator that depends neither on speed nor
    on direction, has two bogies alike, and knows every number. `bogie` is the measured one,
    `distribution` that of the uncertain numbers, `sensor_lateral_m` the lateral place of the
    sensors on axle box, frame and body, 0 being the mean of a left and a right one.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    vehicle: Vehicle
    device: str
    speed_m_per_s: float | None = None
    bogie: str | None = None
    direction: Direction | None = None
    distribution: LogNormal | None = None
    sensor_lateral_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def responses(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> tuple[Tensor, Tensor]:
        """Return complex G_p and G_s, (n_vehicles, n_freq), [-].

        `ratios`: (n_vehicles, 5) or (n_vehicles, 6), k_p, c_p, k_s, c_s, M_s relative to healthy,
        then the speed relative to ``speed_m_per_s``; `frequencies_hz`: (n_freq,).
        """
        raise NotImplementedError

    def channels(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return axle box, frame and body for each independent input of the track, complex [-].

        Shape (n_vehicles, n_inputs, 3, n_freq). Each input is scaled to the density of the first,
        the mean of both rails, so that expected spectra are sums over inputs.
        """
        raise NotImplementedError

    def motion_system(self, ratios: ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, ratios (5,), for simulation in time."""
        raise NotImplementedError

    def magnitudes(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return abs(G_p) and abs(G_s) as one real tensor of shape (n_vehicles, 2, n_freq)."""
        return torch.stack(self.responses(ratios, frequencies_hz), dim=1).abs()

    def with_uncertain(self, ratios: Tensor, numbers: Tensor) -> Tensor:
        """Return ratios with all columns; the uncertain ones are `numbers`, (n_vehicles, n)."""
        return ratios

    def sample_unmeasured(self, ratios: Tensor, seed: int) -> Tensor:
        """Return ratios with all columns; the uncertain ones are drawn from their distribution."""
        return ratios

    def of(self, vehicle: Vehicle) -> ResponseGenerator:
        """Return the generator for another vehicle, a simpler one if its geometry is missing."""
        return replace(self, vehicle=vehicle)

    def running(self, direction: Direction) -> Self:
        """Return the same generator for another direction of travel."""
        return self

    def on(self, device: str) -> Self:
        """Return the same generator on another device."""
        return replace(self, device=device)


def angular(frequencies_hz: ArrayLike, device: str) -> Tensor:
    """Return the angular frequencies on a device, [rad/s].

    ValueError unless they are (n_freq,), finite and not negative.
    """
    omega = 2 * math.pi * as_tensor(frequencies_hz).to(device, torch.float64)
    if omega.ndim != 1 or not bool((torch.isfinite(omega) & (omega >= 0)).all()):
        raise ValueError("`frequencies_hz` must be finite and not negative, of shape (n_freq,)")
    return omega


def check_ratios(ratios: Tensor, n_parameters: int) -> None:
    """Raise ValueError unless `ratios` is a positive, finite (n_vehicles, n_parameters) tensor."""
    if ratios.ndim != 2 or ratios.shape[1] != n_parameters:
        shape = tuple(ratios.shape)
        raise ValueError(f"`ratios` must have shape (n_vehicles, {n_parameters}), got {shape}")
    if not bool((torch.isfinite(ratios) & (ratios > 0)).all()):
        raise ValueError("`ratios` must be positive and finite; 1 is healthy")
