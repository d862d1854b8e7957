"""Numbers of a vehicle that its drawings do not determine well, and their log-normal priors.

Each multiplies a nominal value: that of the vehicle file or, for parts that files rarely describe,
the one below. Priors are log-normal with the nominal values as medians and the spread between
public vehicle models as deviations. For numbers that may be 0, one plus the ratio to nominal is
log-normal: with a log-normal ratio a part that the vehicle does not have could not be fitted as
absent, and its neighbours would be fitted wrongly in compensation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from suspnet.ground.settings import check_choice, check_number
from suspnet.ground.types import FloatArray
from suspnet.vehicle.spatial_numbers import SPATIAL_NUMBERS

TOLERANCE = 1e-9
"""A negative eigenvalue of a covariance up to this fraction of the largest one is rounding."""


@dataclass(frozen=True)
class Quantity:
    """One number that may differ from nominal.

    `part` is one of ``PARTS``, empty if every vehicle has the number; `deviation` the prior
    standard deviation of its logarithm, 0 if it is taken as known; `unit` that of the nominal
    value, "" for ratios; `nominal` None if the vehicle or the generator's settings give it. If it
    `may_be_absent` (0), `deviation` is that of log(1 + ratio to nominal). The prior
    `median` of the ratio is 0 for what is usually absent and of either sign.
    """

    part: str
    name: str
    deviation: float
    unit: str
    meaning: str
    nominal: float | None = None
    may_be_absent: bool = False
    median: float = 1.0

    @property
    def offset(self) -> float:
        """Number added to the ratio before its logarithm is taken, [-]."""
        return float(self.may_be_absent)


_NUMBERS: dict[str, tuple[tuple[Any, ...], ...]] = {
    "": (
        ("speed", 0.0, "m/s", "speed"),
        ("other_k_p", 0.0, "", "primary stiffness of the other bogie over healthy"),
        ("other_c_p", 0.0, "", "primary damping of the other bogie over healthy"),
        ("other_k_s", 0.2, "", "secondary stiffness of the other bogie over healthy"),
        ("other_c_s", 0.2, "", "secondary damping of the other bogie over healthy"),
        ("bogie_mass", 0.0, "kg", "bogie mass a side, which fixes the scale of all forces"),
        ("half_wheelbase", 0.05, "m", "half wheelbase"),
        ("half_pivot_distance", 0.05, "m", "half pivot distance"),
        ("bogie_gyration", 0.15, "m", "radius of gyration of the bogie in pitch"),
        ("body_gyration", 0.15, "m", "radius of gyration of the body in pitch"),
        ("healthy_k_p", 0.2, "N/m", "healthy primary stiffness"),
        ("healthy_c_p", 0.4, "N s/m", "healthy primary damping"),
        ("healthy_k_s", 0.2, "N/m", "healthy secondary stiffness"),
        ("healthy_c_s", 0.3, "N s/m", "healthy secondary damping"),
    ),
    "bushings": (
        ("primary_bushing", 1.0, "N/m", "bushing of the primary damper", 2e6),
        ("secondary_bushing", 1.0, "N/m", "bushing of the secondary damper", 1e7),
    ),
    "rubber": (
        ("rubber_share", 0.6, "", "stiffness of the rubber's Maxwell branch over k_p", 0.05, True),
        ("rubber_frequency", 0.3, "Hz", "relaxation frequency of the rubber's Maxwell branch", 5.0),
        ("rubber_loss", 0.6, "", "loss factor of the rubber", 0.03, True),
    ),
    "guidance": (
        (
            "guidance_stiffness",
            0.9,
            "",
            "pitch stiffness of the axle guidance over k_p a²",
            0.1,
            True,
        ),
        ("guidance_damping", 0.9, "", "pitch damping of the axle guidance over c_p a²", 0.1, True),
    ),
    "longitudinal": (
        ("longitudinal_stiffness", 1.0, "N/m", "stiffness of the longitudinal links, a side", 1e5),
        ("longitudinal_damping", 1.0, "N s/m", "damping of the longitudinal links, a side", 1e4),
        ("body_lever", 0.3, "m", "lever of the longitudinal links below the body's centre", 0.75),
        ("bogie_lever", 0.3, "m", "lever of the longitudinal links above the bogie's centre", 0.42),
    ),
    "yaw_dampers": (),  # those of ``SPATIAL_NUMBERS`` but for their lateral place
    "bending": (
        ("bending_frequency", 0.25, "Hz", "frequency of the body's first bending", 10.0),
        ("bending_damping", 0.5, "", "damping ratio of the body's first bending", 0.015),
        ("bending_at_pivot", 0.5, "", "shape of the first bending at the pivots", 0.45),
        ("bending_at_sensor", 0.5, "", "shape of the first bending at the sensor", 0.45),
        (
            "bending_slope",
            0.5,
            "",
            "slope of the first bending at the pivots times half their distance",
            2.25,
        ),
    ),
    "roll": (
        ("body_roll_gyration", 0.25, "m", "radius of gyration of the body in roll", 1.3),
        ("bogie_roll_gyration", 0.25, "m", "radius of gyration of the bogie in roll", 0.8),
        ("primary_lateral", 0.2, "m", "half distance of the primary springs", 1.0),
        ("secondary_lateral", 0.2, "m", "half distance of the secondary springs", 1.0),
        ("anti_roll_bar", 1.0, "N m/rad", "stiffness of a bogie's anti-roll bar", 1e6),
        (
            "lateral_stiffness",
            1.0,
            "N/m",
            "lateral stiffness between body and bogie, a side",
            1.6e5,
        ),
        ("lateral_damping", 1.0, "N s/m", "lateral damping between body and bogie, a side", 1.6e4),
        ("cross_level", 0.7, "", "density of half the cross level over the mean's", 0.5),
        ("axle_box_lateral", 0.1, "m", "lateral place of the axle box's sensor"),
        ("frame_lateral", 0.1, "m", "lateral place of the frame's sensor"),
        ("body_lateral", 0.1, "m", "lateral place of the body's sensor"),
    ),
    "other_bogie": (),  # ``OF_THE_TRIP``, which every vehicle has
    "payload": (
        (
            "bending_exponent",
            0.3,
            "",
            "exponent with which the bending frequency falls with the body's mass",
            0.35,
            True,
        ),
        (
            "gyration_exponent",
            0.1,
            "",
            "exponent of the body's radius of gyration over its mass",
            1.0,
            True,
            0.0,
        ),
        (
            "stiffness_exponent",
            0.5,
            "",
            "exponent of the secondary stiffness over the body's mass",
            0.35,
            True,
        ),
        (
            "damping_exponent",
            0.3,
            "",
            "exponent of the secondary damping over the body's mass",
            1.0,
            True,
            0.0,
        ),
    ),
    "sensors": (
        ("frame_gain", 0.02, "", "sensitivity of the frame's sensor over the axle box's", 1.0),
        ("body_gain", 0.02, "", "sensitivity of the body's sensor over the axle box's", 1.0),
        ("frame_delay", 0.1, "s", "delay of the frame's sensor", 5e-3, True, 0.0),
        ("body_delay", 0.1, "s", "delay of the body's sensor", 5e-3, True, 0.0),
    ),
    "wheelsets": (
        (
            "wheelset_share",
            1.0,
            "",
            "density of what excites each wheelset alone over the mean track's",
            0.002,
            True,
            0.0,
        ),
    ),
    "axle_box_arm": (
        (
            "arm_share",
            0.1,
            "",
            "share of the frame's motion under the axle box's sensor, which sits on its arm",
            1.0,
            True,
            0.0,
        ),
    ),
    "air_spring": (
        ("volume_ratio", 0.5, "", "auxiliary volume over the air spring's", 2.0),
        ("area_share", 1.0, "", "change of area over k_s", 0.1),
    ),
}
"""Fields of ``Quantity`` after the part, by part; "" is for every vehicle."""
PARTS = tuple(part for part in _NUMBERS if part)
"""Parts that a vehicle may have beyond rigid bodies on linear springs and dampers."""
IN_MOTION = tuple(part for part in PARTS if part not in ("sensors", "wheelsets", "axle_box_arm"))
"""Parts of the vehicle's motion; the others describe measurement and excitation."""
OF_THE_TRIP = ("other_k_s", "other_c_s")
"""Numbers that differ from trip to trip, as the other bogie wears: trips do not determine those of
later ones."""
FAILED_OTHER = {
    "its air spring looks flat": (8.0, 0.1),
    "the choke of its air spring looks blocked": (2.8, 0.1),
}
"""Medians of ``OF_THE_TRIP`` over healthy where the other bogie's air spring has failed, assumed as
in configs/scenarios.yaml."""
FAILED_DEVIATION = 0.5
"""Standard deviation of their logarithms then: a flat one is 4 to 12 times as stiff."""
QUANTITIES = tuple(
    Quantity("other_bogie" if row[0] in OF_THE_TRIP else part, *row)
    for part, rows in _NUMBERS.items()
    for row in rows
) + tuple(
    Quantity("yaw_dampers", *row)
    for row in SPATIAL_NUMBERS["yaw_dampers"]
    if row[0] != "yaw_lateral"
)
"""Every number, in the order of ``UNMEASURED``."""
UNMEASURED = tuple(quantity.name for quantity in QUANTITIES)
"""Names of the quantities: columns of ratios after ``PARAMETERS``, the speed first."""
MASS_MEAN, MASS_DEVIATION = math.log(1.05), 0.15
"""Prior mean and standard deviation of the logarithm of a trip's car-body mass over nominal."""

SPATIAL_QUANTITIES = tuple(
    Quantity(part, *row) for part, rows in SPATIAL_NUMBERS.items() for row in rows
)
"""Numbers that only a vehicle of twelve separate springs and dampers has."""
_KNOWN = {quantity.name: quantity for quantity in (*QUANTITIES, *SPATIAL_QUANTITIES)}


@dataclass(frozen=True)
class LogNormal:
    """A joint log-normal distribution of numbers relative to their nominal values.

    For numbers that may be absent, 1 + ratio is log-normal: the ratio can reach 0, and estimates of
    an absent part may lie between -1 and 0. `names` are those of quantities; `mean` and
    `covariance` are those of the logarithms: nominal is 0, or log 2 for numbers that may be absent.
    ValueError if names are unknown or repeated, shapes differ, or `covariance` is not a covariance
    matrix.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "mean", tuple(float(value) for value in self.mean))
        rows = tuple(tuple(float(value) for value in row) for row in self.covariance)
        object.__setattr__(self, "covariance", rows)
        unknown = [name for name in self.names if name not in _KNOWN]
        if unknown or len(set(self.names)) < len(self.names):
            raise ValueError(f"`names` must be from {tuple(_KNOWN)}, each once, got {self.names}")
        n = len(self.names)
        if len(self.mean) != n or len(rows) != n or any(len(row) != n for row in rows):
            raise ValueError(f"`mean` and `covariance` must have {n} numbers, one for each name")
        matrix = np.array(rows).reshape(n, n)
        if not (np.isfinite(self.mean).all() and np.isfinite(matrix).all()):
            raise ValueError("`mean` and `covariance` must be finite")
        if n and not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
            raise ValueError("`covariance` must be symmetric")
        eigenvalues = np.linalg.eigvalsh(matrix) if n else np.zeros(1)
        if eigenvalues[0] < -TOLERANCE * max(eigenvalues[-1], 0.0):
            raise ValueError("`covariance` must not have a negative eigenvalue")

    @classmethod
    def independent(cls, deviations: Mapping[str, float]) -> LogNormal:
        """Return independent numbers with nominal medians and these deviations of their logs."""
        for name, value in deviations.items():
            check_number(f"distribution.{name}", value, low=0, below=10)
        names = tuple(name for name, value in deviations.items() if value > 0)
        variances = np.diag([float(deviations[name]) ** 2 for name in names])
        mean = tuple(math.log(_KNOWN[name].median + _KNOWN[name].offset) for name in names)
        return cls(names, mean, tuple(map(tuple, variances.tolist())))

    @classmethod
    def prior(cls, parts: Sequence[str], quantities: Sequence[Quantity] = QUANTITIES) -> LogNormal:
        """Return the prior of a vehicle with these parts and of those `quantities` they have."""
        groups = ("", *parts)
        return cls.independent({q.name: q.deviation for q in quantities if q.part in groups})

    @classmethod
    def read(
        cls,
        value: LogNormal | Mapping[str, Any] | str | None,
        parts: Sequence[str],
        quantities: Sequence[Quantity] = QUANTITIES,
    ) -> LogNormal | None:
        """Return a distribution from its form in a configuration or in a model file.

        ValueError if it has a name that is none of `quantities`.
        """
        if value is None:
            return None
        if isinstance(value, str):
            check_choice("distribution", value, ("prior",))
            return cls.prior(parts, quantities)
        if not isinstance(value, LogNormal) and set(value) == {"names", "mean", "covariance"}:
            value = cls(**value)
        names = value.names if isinstance(value, LogNormal) else tuple(value)
        allowed = tuple(quantity.name for quantity in quantities)
        unknown = sorted(set(names) - set(allowed))
        if unknown:
            raise ValueError(f"`distribution` must be named as in {allowed}, got {unknown}")
        return value if isinstance(value, LogNormal) else cls.independent(value)

    def renewed(
        self,
        names: Sequence[str],
        changes: Sequence[float] | None = None,
        deviation: float | None = None,
    ) -> LogNormal:
        """Return the distribution with some numbers as uncertain as before, independent of others.

        Their medians are multiplied by `changes`, one for each name; None: they stay. `deviation`
        is that of their logarithms; None: of the priors.
        """
        factors = dict(zip(names, [1.0] * len(names) if changes is None else changes, strict=True))
        covariance = np.array(self.covariance).reshape(len(self.names), len(self.names))
        mean = np.array(self.mean)
        for i, name in enumerate(self.names):
            if name in names:
                covariance[i], covariance[:, i] = 0.0, 0.0
                covariance[i, i] = (_KNOWN[name].deviation if deviation is None else deviation) ** 2
                mean[i] += math.log(factors[name])
        rows = tuple(map(tuple, covariance.tolist()))
        return LogNormal(self.names, tuple(mean.tolist()), rows)

    def without(self, names: Sequence[str]) -> LogNormal:
        """Return the distribution of the other numbers, whatever these are."""
        others = [i for i, name in enumerate(self.names) if name not in names]
        rows = tuple(tuple(self.covariance[i][j] for j in others) for i in others)
        return LogNormal(
            tuple(self.names[i] for i in others), tuple(self.mean[i] for i in others), rows
        )

    def extended(self, other: LogNormal) -> LogNormal:
        """Return the joint distribution with the numbers that only another one has, independent."""
        more = other.without(self.names)
        if not more.names:
            return self
        rows = block_diag(self.covariance, more.covariance) if self.names else more.covariance
        rows = tuple(map(tuple, np.asarray(rows).tolist()))
        return LogNormal(self.names + more.names, self.mean + more.mean, rows)

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of the logarithms, shape (n,), [-]."""
        return np.sqrt([row[i] for i, row in enumerate(self.covariance)])

    @property
    def offsets(self) -> FloatArray:
        """Number subtracted from the exponential of each logarithm, shape (n,), [-]."""
        return np.array([_KNOWN[name].offset for name in self.names])

    @property
    def median(self) -> FloatArray:
        """Numbers relative to nominal, shape (n,), [-]."""
        return self.quantile(0.0)

    def quantile(self, n_deviations: float) -> FloatArray:
        """Return each number at `n_deviations` standard deviations of its log above the median."""
        logs = np.array(self.mean) + n_deviations * self.deviations
        return np.asarray(np.exp(logs) - self.offsets)

    @cached_property
    def factor(self) -> FloatArray:
        """A matrix F with F F^T the covariance, its columns in descending importance, (n, n)."""
        n = len(self.names)
        values, vectors = np.linalg.eigh(np.array(self.covariance).reshape(n, n))
        root: FloatArray = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, ::-1].copy()
        root.setflags(write=False)  # every caller has this one
        return root

    def ratios(self, standard: FloatArray) -> FloatArray:
        """Return numbers relative to nominal from standard normal ones, both (n_rows, n)."""
        return np.asarray(np.exp(np.array(self.mean) + standard @ self.factor.T) - self.offsets)
