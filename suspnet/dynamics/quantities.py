"""Numbers of a vehicle that its drawings tell badly, with what is believed of them beforehand.

Each multiplies a nominal value: that of the vehicle file or, for the parts of a vehicle that files
rarely hold, the one below. Priors are log-normal, their medians the nominal values, their
deviations from what public vehicle models disagree about. Of numbers that may as well be 0, one
plus the ratio to nominal is log-normal: their logarithm could not come near 0, and what is fitted
of a part that a vehicle does not have is then taken from its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.ground.checks import check_number
from suspnet.ground.types import FloatArray

PARTS = ("bushings", "rubber", "guidance", "longitudinal", "bending", "roll", "air_spring")
"""Parts that a vehicle may have beyond rigid bodies on linear springs and dampers."""


@dataclass(frozen=True)
class Quantity:
    """One number that may differ from nominal.

    Attributes
    ----------
    name : str
    deviation : float, [-]
        Standard deviation of its logarithm before any trip; 0 where it is taken as known.
    unit : str
        Of the nominal value; "" for ratios.
    meaning : str
    part : str
        The one of ``PARTS`` that it belongs to; empty if every vehicle has it.
    nominal : float or None
        None where the vehicle or the generator's settings give it.
    may_be_absent : bool
        Whether it may be 0; `deviation` is then that of log(1 + ratio to nominal).
    """

    name: str
    deviation: float
    unit: str
    meaning: str
    part: str = ""
    nominal: float | None = None
    may_be_absent: bool = False


QUANTITIES = (
    Quantity("speed", 0.0, "m/s", "speed"),
    Quantity("other_k_p", 0.0, "", "primary stiffness of the other bogie over healthy"),
    Quantity("other_c_p", 0.0, "", "primary damping of the other bogie over healthy"),
    Quantity("other_k_s", 0.0, "", "secondary stiffness of the other bogie over healthy"),
    Quantity("other_c_s", 0.0, "", "secondary damping of the other bogie over healthy"),
    Quantity("bogie_mass", 0.0, "kg", "bogie mass a side, which fixes the scale of all forces"),
    Quantity("half_wheelbase", 0.05, "m", "half wheelbase"),
    Quantity("half_pivot_distance", 0.05, "m", "half pivot distance"),
    Quantity("bogie_gyration", 0.15, "m", "radius of gyration of the bogie in pitch"),
    Quantity("body_gyration", 0.15, "m", "radius of gyration of the body in pitch"),
    Quantity("healthy_k_p", 0.2, "N/m", "healthy primary stiffness"),
    Quantity("healthy_c_p", 0.4, "N s/m", "healthy primary damping"),
    Quantity("healthy_k_s", 0.2, "N/m", "healthy secondary stiffness"),
    Quantity("healthy_c_s", 0.3, "N s/m", "healthy secondary damping"),
    Quantity("primary_bushing", 1.0, "N/m", "bushing of the primary damper", "bushings", 2e6),
    Quantity("secondary_bushing", 1.0, "N/m", "bushing of the secondary damper", "bushings", 1e7),
    Quantity(
        "rubber_share",
        0.6,
        "",
        "stiffness of the rubber's Maxwell branch over k_p",
        "rubber",
        0.05,
        may_be_absent=True,
    ),
    Quantity(
        "rubber_frequency",
        0.3,
        "Hz",
        "relaxation frequency of the rubber's Maxwell branch",
        "rubber",
        5.0,
    ),
    Quantity(
        "rubber_loss", 0.6, "", "loss factor of the rubber", "rubber", 0.03, may_be_absent=True
    ),
    Quantity(
        "guidance_stiffness",
        0.9,
        "",
        "pitch stiffness of the axle guidance over k_p a²",
        "guidance",
        0.1,
        may_be_absent=True,
    ),
    Quantity(
        "guidance_damping",
        0.9,
        "",
        "pitch damping of the axle guidance over c_p a²",
        "guidance",
        0.1,
        may_be_absent=True,
    ),
    Quantity(
        "longitudinal_stiffness",
        1.0,
        "N/m",
        "stiffness of the longitudinal links, a side",
        "longitudinal",
        1e5,
    ),
    Quantity(
        "longitudinal_damping",
        1.0,
        "N s/m",
        "damping of the longitudinal links, a side",
        "longitudinal",
        1e4,
    ),
    Quantity(
        "body_lever",
        0.3,
        "m",
        "lever of the longitudinal links below the body's centre",
        "longitudinal",
        0.75,
    ),
    Quantity(
        "bogie_lever",
        0.3,
        "m",
        "lever of the longitudinal links above the bogie's centre",
        "longitudinal",
        0.42,
    ),
    Quantity(
        "bending_frequency", 0.25, "Hz", "frequency of the body's first bending", "bending", 10.0
    ),
    Quantity(
        "bending_damping", 0.5, "", "damping ratio of the body's first bending", "bending", 0.015
    ),
    Quantity(
        "bending_at_pivot", 0.5, "", "shape of the first bending at the pivots", "bending", 0.45
    ),
    Quantity(
        "bending_at_sensor", 0.5, "", "shape of the first bending at the sensor", "bending", 0.45
    ),
    Quantity(
        "bending_slope",
        0.5,
        "",
        "slope of the first bending at the pivots times half their distance",
        "bending",
        2.25,
    ),
    Quantity(
        "body_roll_gyration", 0.25, "m", "radius of gyration of the body in roll", "roll", 1.3
    ),
    Quantity(
        "bogie_roll_gyration", 0.25, "m", "radius of gyration of the bogie in roll", "roll", 0.8
    ),
    Quantity("primary_lateral", 0.2, "m", "half distance of the primary springs", "roll", 1.0),
    Quantity("secondary_lateral", 0.2, "m", "half distance of the secondary springs", "roll", 1.0),
    Quantity("anti_roll_bar", 1.0, "N m/rad", "stiffness of a bogie's anti-roll bar", "roll", 1e6),
    Quantity(
        "lateral_stiffness",
        1.0,
        "N/m",
        "lateral stiffness between body and bogie, a side",
        "roll",
        1.6e5,
    ),
    Quantity(
        "lateral_damping",
        1.0,
        "N s/m",
        "lateral damping between body and bogie, a side",
        "roll",
        1.6e4,
    ),
    Quantity(
        "cross_level", 0.7, "", "density of half the cross level over the mean's", "roll", 0.5
    ),
    Quantity("axle_box_lateral", 0.1, "m", "lateral place of the axle box's sensor", "roll"),
    Quantity("frame_lateral", 0.1, "m", "lateral place of the frame's sensor", "roll"),
    Quantity("body_lateral", 0.1, "m", "lateral place of the body's sensor", "roll"),
    Quantity("volume_ratio", 0.5, "", "auxiliary volume over the air spring's", "air_spring", 2.0),
    Quantity("area_share", 1.0, "", "change of area over k_s", "air_spring", 0.1),
)
UNMEASURED = tuple(quantity.name for quantity in QUANTITIES)
"""Names of the quantities: columns of ratios after ``PARAMETERS``, the speed first."""
OFFSETS = {quantity.name: float(quantity.may_be_absent) for quantity in QUANTITIES}
"""What is added to each ratio before its logarithm is taken: 1 where it may be absent, else 0."""


TOLERANCE = 1e-9
"""Largest negative eigenvalue of a covariance, relative to its largest one, that is rounding."""


@dataclass(frozen=True)
class LogNormal:
    """A joint log-normal distribution of numbers relative to their nominal values.

    Of numbers that may be absent, 1 + ratio is log-normal: they reach 0, and where trips show none
    of them may come out between -1 and 0.

    Parameters
    ----------
    names : tuple of str
        From ``UNMEASURED``.
    mean : tuple of n floats, [-]
        Of the logarithms; nominal is 0, of numbers that may be absent log 2.
    covariance : tuple of n tuples of n floats, [-]
        Of the logarithms.

    Raises
    ------
    ValueError
        If names are unknown or repeated, shapes differ, or the covariance is none.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "mean", tuple(float(value) for value in self.mean))
        rows = tuple(tuple(float(value) for value in row) for row in self.covariance)
        object.__setattr__(self, "covariance", rows)
        unknown = [name for name in self.names if name not in UNMEASURED]
        if unknown or len(set(self.names)) < len(self.names):
            raise ValueError(f"`names` must be from {UNMEASURED}, each once, got {self.names}")
        n = len(self.names)
        if len(self.mean) != n or len(rows) != n or any(len(row) != n for row in rows):
            raise ValueError(f"`mean` and `covariance` must be of {n} numbers, as the names are")
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
        """Return independent numbers about nominal with the standard deviations of their logs."""
        for name, value in deviations.items():
            check_number(f"distribution.{name}", value, low=0, below=10)
        names = tuple(name for name, value in deviations.items() if value > 0)
        variances = np.diag([float(deviations[name]) ** 2 for name in names])
        mean = tuple(math.log1p(OFFSETS[name]) for name in names)
        return cls(names, mean, tuple(map(tuple, variances.tolist())))

    @classmethod
    def prior(cls, parts: Sequence[str]) -> LogNormal:
        """Return what is believed before any trip of a vehicle with some of ``PARTS``."""
        known = ("", *parts)
        return cls.independent({q.name: q.deviation for q in QUANTITIES if q.part in known})

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of the logarithms, shape (n,), [-]."""
        return np.sqrt([row[i] for i, row in enumerate(self.covariance)])

    @property
    def offsets(self) -> FloatArray:
        """What is taken off the exponential of each logarithm, shape (n,), [-]."""
        return np.array([OFFSETS[name] for name in self.names])

    @property
    def median(self) -> FloatArray:
        """Numbers relative to nominal, shape (n,), [-]."""
        return self.quantile(0.0)

    def quantile(self, n_deviations: float) -> FloatArray:
        """Return each number so many standard deviations of its logarithm above the median."""
        logs = np.array(self.mean) + n_deviations * self.deviations
        return np.asarray(np.exp(logs) - self.offsets)

    @property
    def factor(self) -> FloatArray:
        """A matrix F with F F^T the covariance, its columns ever less important, (n, n)."""
        n = len(self.names)
        values, vectors = np.linalg.eigh(np.array(self.covariance).reshape(n, n))
        return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0)))[:, ::-1])

    def ratios(self, standard: FloatArray) -> FloatArray:
        """Return numbers relative to nominal, (n_rows, n), from standard normal ones."""
        return np.asarray(np.exp(np.array(self.mean) + standard @ self.factor.T) - self.offsets)
