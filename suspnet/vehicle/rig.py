"""A base-excited chain of two masses: a quarter-car test rig, or one wheel of a road vehicle.

With w, z_p and z_s the motion of base, frame and body, in displacement or acceleration alike, and
M_p = 1, the equations of `suspnet.vehicle.quarter_car` are R(s) (w, z_p, z_s) = 0 with ::

    R = P_0 + k_p P_1 + c_p P_2 + k_s P_3 + c_s P_4 + M_s P_5,    s = 2 pi j f

    P_0 = s^2 [0 1 0; 0 0 0],    P_1 = [-1 1 0; 0 0 0],    P_3 = [0 1 -1; 0 -1 1],
    P_5 = s^2 [0 0 0; 0 0 1],    P_2 = s P_1,              P_4 = s P_3

Accelerations alone show no mass: k_p, c_p, k_s, c_s and M_s are those over M_p.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from suspnet.ground.parameters import DEFAULT_LIMITS, PARAMETERS, Limits, read_limits
from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.vehicle.vehicle import Vehicle

DEVIATIONS = (1.0, 1.5, 1.0, 1.5, 0.7)
"""Standard deviations of the logarithms of k_p, c_p, k_s, c_s and M_s over M_p before a record:
frequencies may be off by a factor of 1.6, or of 2.7 at two deviations."""
LOW, HIGH = 0.2, 2.5
"""Ends of the band over the lowest and the highest natural frequency with sensors alone: rigs that
are half or twice as stiff as stated still have their modes in it."""


@dataclass(frozen=True)
class Rig:
    """What is roughly known of a rig; a factor of two is near enough.

    Examples
    --------
    >>> rig = Rig("bench", primary_hz=11.0, secondary_hz=1.4, mass_ratio=7.0)
    >>> [round(frequency, 2) for frequency in rig.modes_hz]
    [1.33, 11.62]
    """

    name: Annotated[
        str, Setting("Name of the rig, which manifests state as `vehicle`", rule="text")
    ]
    primary_hz: Annotated[
        float,
        Setting("Frequency of the frame on its spring alone, sqrt(k_p / M_p) / 2π", "Hz", above=0),
    ]
    secondary_hz: Annotated[
        float,
        Setting("Frequency of the body on its spring alone, sqrt(k_s / M_s) / 2π", "Hz", above=0),
    ]
    mass_ratio: float = setting(1.0, "Mass of the body over that of the frame, M_s / M_p", above=0)
    primary_damping: float = setting(
        0.03, "Damping ratio of the frame alone, c_p / (2 sqrt(k_p M_p))", above=0, most=10
    )
    secondary_damping: float = setting(
        0.03, "Damping ratio of the body alone, c_s / (2 sqrt(k_s M_s))", above=0, most=10
    )
    bogie_mass_kg: float | None = setting(
        None, "Mass of the frame, for values in N/m and N s/m; null if unknown", "kg", above=0
    )
    low_hz: float | None = setting(
        None, "Lower end of the band that is used; null is 0.2 times the first mode", "Hz", above=0
    )
    high_hz: float | None = setting(
        None, "Upper end of the band that is used; null is 2.5 times the second mode", "Hz", above=0
    )
    source: str = setting("", "Where the numbers come from", rule="text")
    limits: Annotated[
        Mapping[str, Any] | None,
        Setting("When to look (notice) and when to act, as of a vehicle", rule="as of a vehicle"),
    ] = field(default=None, compare=False)

    def __post_init__(self) -> None:
        check_settings(self)
        low, high = self.band_hz
        if not low < high:
            raise ValueError(f"`low_hz` must be below `high_hz`, got {low:.3g} and {high:.3g} Hz")
        if self.limits is not None:
            read_limits(self.limits)

    @classmethod
    def of(cls, vehicle: Vehicle) -> Rig:
        """Return the rig of a vehicle's numbers in SI units, without its geometry."""
        return cls(
            vehicle.name,
            vehicle.primary_frequency_hz,
            vehicle.secondary_frequency_hz,
            vehicle.body_mass_kg / vehicle.bogie_mass_kg,
            vehicle.primary_damping_ratio,
            vehicle.secondary_damping_ratio,
            vehicle.bogie_mass_kg,
            source=vehicle.source,
            limits=vehicle.limits,
        )

    @property
    def logs(self) -> FloatArray:
        """Logarithms of k_p, c_p, k_s, c_s and M_s over M_p, (5,), SI units."""
        primary, secondary = 2 * math.pi * self.primary_hz, 2 * math.pi * self.secondary_hz
        return np.log(
            [
                primary**2,
                2 * self.primary_damping * primary,
                self.mass_ratio * secondary**2,
                2 * self.secondary_damping * secondary * self.mass_ratio,
                self.mass_ratio,
            ]
        )

    @property
    def modes_hz(self) -> tuple[float, float]:
        """Natural frequencies of both masses on a base at rest, ascending, [Hz]."""
        return modes_hz(self.logs)

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lower and upper end of the band that is used, [Hz]."""
        first, second = self.modes_hz
        low = LOW * first if self.low_hz is None else self.low_hz
        return low, HIGH * second if self.high_hz is None else self.high_hz

    @property
    def known_limits(self) -> dict[str, Limits]:
        """Limits of each of k_p, c_p, k_s and c_s that has any."""
        limits = read_limits(self.limits or {}, DEFAULT_LIMITS, f"the file of rig {self.name}")
        return {name: limits[name] for name in PARAMETERS if name in limits}


def modes_hz(logs: FloatArray) -> tuple[float, float]:
    """Return the natural frequencies on a base at rest, ascending, [Hz]; `logs` as of ``Rig``."""
    k_p, _, k_s, _, m_s = np.exp(logs)
    # the roots of x^2 - (k_p + k_s + k_s / M_s) x + k_p k_s / M_s, x = omega^2
    half = (k_p + k_s + k_s / m_s) / 2
    root = math.sqrt(half**2 - k_p * k_s / m_s)
    upper = half + root
    return math.sqrt(k_p * k_s / m_s / upper) / (2 * math.pi), math.sqrt(upper) / (2 * math.pi)


def patterns(frequencies_hz: FloatArray) -> ComplexArray:
    """Return P_0 to P_5 of the module's docstring, (6, n_freq, 2, 3)."""
    s = 2j * np.pi * np.asarray(frequencies_hz, dtype=float)[:, None, None]
    frame, body = np.array([[0, 1, 0], [0, 0, 0]]), np.array([[0, 0, 0], [0, 0, 1]])
    primary, secondary = np.array([[-1, 1, 0], [0, 0, 0]]), np.array([[0, 1, -1], [0, -1, 1]])
    p, q = primary + 0 * s, secondary + 0 * s
    return np.stack([s**2 * frame, p, s * p, q, s * q, s**2 * body])


def equations(logs: FloatArray, of: ComplexArray) -> ComplexArray:
    """Return R of the module's docstring, (n_freq, 2, 3), from its patterns."""
    rows: ComplexArray = of[0] + np.tensordot(np.exp(logs), of[1:], axes=1)
    return rows
