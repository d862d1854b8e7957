"""Parameters of a vehicle in SI units, checked: the quarter car's six, the geometry if known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from suspnet.ground.parameters import DEFAULT_LIMITS, Limits, read_limits
from suspnet.ground.parameters import PARAMETERS as PARAMETERS
from suspnet.ground.settings import Setting, check_settings, setting

UNITS = {"k_p": "N/m", "c_p": "N s/m", "k_s": "N/m", "c_s": "N s/m", "M_s": "kg"}
"""SI unit of each parameter."""

GEOMETRY = ("half_wheelbase_m", "half_pivot_distance_m", "bogie_gyration_m", "body_gyration_m")

FREQUENCY_RANGE_HZ = (0.2, 50.0)
DAMPING_RATIO_RANGE = (1e-3, 10.0)


@dataclass(frozen=True)
class Vehicle:
    """Six parameters of one bogie side's share of a vehicle, in SI units (Table III of the paper).

    On a road vehicle the tyre takes the place of the primary suspension.

    Raises
    ------
    TypeError
        If a parameter is not a number.
    ValueError
        If a parameter is not positive and finite, or if an uncoupled natural frequency or damping
        ratio is so far off that a unit must be wrong; the message names the likely slip.

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
            "must "
            "lie in 0.001 to 10",
            "N s/m",
            above=0,
        ),
    ]
    secondary_stiffness_n_per_m: Annotated[
        float,
        Setting(
            "Stiffness of the secondary suspension of one bogie side, k_s; sqrt(k_s / M_s) / 2π "
            "must "
            "lie in 0.2 to 50 Hz",
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
            known = self.known_limits
            own = {name: known[name].to_dict() if name in known else None for name in self.limits}
            object.__setattr__(self, "limits", own)
        _check_frequency(self, "primary", self.primary_frequency_hz)
        _check_frequency(self, "secondary", self.secondary_frequency_hz)
        _check_damping(self, "primary", self.primary_damping_ratio)
        _check_damping(self, "secondary", self.secondary_damping_ratio)

    @property
    def known_limits(self) -> dict[str, Limits]:
        """Limits of each parameter that has any, its own or the default ones."""
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

        Raises
        ------
        ValueError
            If a name is not one of ``PARAMETERS``.
        """
        unknown = sorted(set(ratios) - set(PARAMETERS))
        if unknown:
            raise ValueError(f"`ratios` must be named as in {PARAMETERS}, got {unknown}")
        changed = {_FIELD[name]: getattr(self, _FIELD[name]) * ratios[name] for name in ratios}
        return replace(self, **changed)

    def healthy_values(self) -> tuple[float, ...]:
        """Return (k_p, c_p, k_s, c_s, M_s) of the healthy vehicle, SI units."""
        return tuple(float(getattr(self, _FIELD[name])) for name in PARAMETERS)


_FIELD = {
    "k_p": "primary_stiffness_n_per_m",
    "c_p": "primary_damping_ns_per_m",
    "k_s": "secondary_stiffness_n_per_m",
    "c_s": "secondary_damping_ns_per_m",
    "M_s": "body_mass_kg",
}


def check_vehicle(vehicle: object) -> None:
    """Raise TypeError unless a generator's vehicle is one."""
    if not isinstance(vehicle, Vehicle):
        raise TypeError(f"`vehicle` must be a Vehicle, got {vehicle!r}")


def _check_frequency(vehicle: Vehicle, suspension: str, frequency_hz: float) -> None:
    """Raise ValueError if an uncoupled natural frequency suggests a wrong unit."""
    low, high = FREQUENCY_RANGE_HZ
    if low <= frequency_hz <= high:
        return
    if frequency_hz < low:
        slip = "is the stiffness in kN/m (multiply by 1e3), or a mass in grams?"
    else:
        slip = (
            "is the stiffness 1e3 too large (the paper's Tables III and IV print kN/m "
            "where N/m is meant), or a mass in tonnes?"
        )
    raise ValueError(
        f"vehicle {vehicle.name!r}: the uncoupled {suspension} natural frequency is "
        f"{frequency_hz:.3g} Hz, outside {low}-{high} Hz; {slip} Give N/m, N s/m and kg"
    )


def _check_damping(vehicle: Vehicle, suspension: str, ratio: float) -> None:
    """Raise ValueError if an uncoupled damping ratio suggests a wrong unit."""
    low, high = DAMPING_RATIO_RANGE
    if low <= ratio <= high:
        return
    slip = "in kN s/m (multiply by 1e3)" if ratio < low else "1e3 too large (kN s/m for N s/m)"
    raise ValueError(
        f"vehicle {vehicle.name!r}: the {suspension} damping ratio is {ratio:.3g}, outside "
        f"{low}-{high}; is the damping coefficient {slip}? Give N s/m"
    )
