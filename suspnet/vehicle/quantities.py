"""Numbers of a vehicle that its drawings do not determine well, and their log-normal priors.

Each multiplies a nominal value: that of the vehicle file or, for parts that files rarely describe,
that of quantities.csv. Priors are log-normal with the nominal values as medians and the spread
between public vehicle models as deviations. For numbers that may be 0, one plus the ratio to
nominal is log-normal: with a log-normal ratio a part that the vehicle does not have could not be
fitted as absent, and its neighbours would be fitted wrongly in compensation.

Nominal values of the lateral numbers are those of the passenger vehicle of the Manchester
benchmarks (Iwnicki, Vehicle System Dynamics 30, 295, 1998) as multibody programs publish it,
rounded; the creep coefficient is that of Kalker's linear theory for a wheel load of about 50 kN.
Yaw dampers are those of high-speed bogies, 100 to 500 kN s/m behind bushings of 5 to 10 MN/m (from
memory: no source was at hand).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from suspnet.ground.parameters import COMPONENTS, CORNERS, SIDES
from suspnet.ground.settings import check_choice, check_number
from suspnet.ground.types import FloatArray

TOLERANCE = 1e-9
"""A negative eigenvalue of a covariance up to this fraction of the largest one is rounding."""


@dataclass(frozen=True)
class Quantity:
    """One number that may differ from nominal.

    `part` is one of ``PARTS``, empty if every vehicle has the number; `deviation` the prior
    standard deviation of its logarithm, 0 if it is taken as known; `unit` that of the nominal
    value, "" for ratios; `nominal` None if the vehicle or the generator's settings give it. If it
    `may_be_absent` (0), `deviation` is that of log(1 + ratio to nominal). The prior
    `median` of the ratio is 0 for what is usually absent and of either sign. `symbol` is that in
    the equations of the vehicle, if it has one.
    """

    part: str
    name: str
    deviation: float
    unit: str
    meaning: str
    nominal: float | None = None
    may_be_absent: bool = False
    median: float = 1.0
    symbol: str = ""

    @property
    def offset(self) -> float:
        """Number added to the ratio before its logarithm is taken, [-]."""
        return float(self.may_be_absent)


PARTS = (
    *("bushings", "rubber", "guidance", "longitudinal", "yaw_dampers", "bending", "roll"),
    *("other_bogie", "payload", "sensors", "wheelsets", "axle_box_arm", "air_spring"),
)
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
LOAD_DEVIATIONS = {"load_ahead": 0.25, "load_aside": 0.03}
"""Standard deviations of where a trip's load has the body's centre of mass, [m], assumed: a fifth
of the mass, whose own centre scatters by 1.25 m along the car and by .15 m across."""
MASS_MEAN, MASS_DEVIATION = math.log(1.05), 0.15
"""Prior mean and standard deviation of the logarithm of a trip's car-body mass over nominal."""
BOGIE_MASS_DEVIATION = 0.04
"""Standard deviation of the logarithm of a bogie's mass about the drawing's, assumed. Accelerations
show masses relative to it: the car body's errs by as much, equally on all trips."""

IN_BETWEEN = tuple(
    f"{place}_axle{axle}_middle" for place in ("axle_box", "frame") for axle in (1, 2)
)
"""Places of sensors in the middle, or of the mean of a left and a right one: they show no part."""
PLACES = (
    *(f"axle_box_{corner}" for corner in CORNERS),
    *(f"frame_{corner}" for corner in CORNERS),
    *(f"frame_centre_{side}" for side in (*SIDES, "middle")),
    *(f"body_{side}" for side in (*SIDES, "middle")),
    *IN_BETWEEN,
)
"""Places of vertical accelerometers: axle boxes of the measured bogie, its frame above the axles or
at its centre, the body above the bogie; axles and sides as in ``CORNERS``."""
LEAST_SENSORS = 4
"""Least number of sensors that show each spring and damper whatever the track does: one more than
the unknown spectra of elevation, cross level and alignment."""
ADDITIONS: dict[str, tuple[str, ...]] = {
    "frame_sway": ("y_1", "y_2"),
    "frame_yaw": ("chi_1", "chi_2"),
    "body_yaw": ("chi",),
    "creep": tuple(f"{motion}_w{wheel}" for wheel in range(1, 5) for motion in ("y", "chi")),
    "torsion": ("tau_1", "tau_2"),
    "track": tuple(f"{motion}_w{wheel}" for wheel in range(1, 5) for motion in ("z", "theta")),
    "second_bending": ("q_b",),
    "body_torsion": ("tau_b",),
    "equipment": ("z_e",),
    "floors": (),
    "cross_axis": (),
    "load": (),
    "nonlinear_dampers": (),
}
"""Parts that only a vehicle of twelve separate parts may have, each with its coordinates."""
LATERAL = ("frame_sway", "frame_yaw", "creep")
"""Parts with which the alignment of the track reaches the bogie frames."""


def _read(of: str, each: Sequence[str] = ("",)) -> list[Quantity]:
    """Return the rows of quantities.csv that are `of` a "vertical" or "spatial" vehicle.

    Those of a "component" or "place" of the spatial one are a number for `each`, whose name is in
    place of "{}".
    """
    with (Path(__file__).parent / "quantities.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["of"] == of]
    return [
        Quantity(
            "other_bogie" if row["name"] in OF_THE_TRIP else row["part"],
            row["name"].format(name),
            float(row["deviation"]),
            row["unit"],
            row["meaning"].format(name),
            float(row["nominal"]) if row["nominal"] else None,
            row["may_be_absent"] == "yes",
            float(row["median"] or 1.0),
            row["symbol"],
        )
        for row in rows
        for name in each
    ]


_SPATIAL = _read("spatial")
QUANTITIES = (
    *_read("vertical"),
    *(q for q in _SPATIAL if q.part == "yaw_dampers" and q.name != "yaw_lateral"),
)
"""Every number of a vertical vehicle, in the order of ``UNMEASURED``."""
UNMEASURED = tuple(quantity.name for quantity in QUANTITIES)
"""Names of the quantities: columns of ratios after ``PARAMETERS``, the speed first."""
SPATIAL_QUANTITIES = (*_read("component", COMPONENTS[:-1]), *_SPATIAL, *_read("place", PLACES))
"""Numbers that only a vehicle of twelve separate springs and dampers has. Sensitivity and delay of
a sensor are relative to the first one of the vehicle's list."""
_KNOWN = {quantity.name: quantity for quantity in (*QUANTITIES, *SPATIAL_QUANTITIES)}


def show_parts(places: Sequence[str]) -> bool:
    """Return whether sensors at these places show each part.

    They do if there are ``LEAST_SENSORS``, some on each side, or axle box, frame and body are
    measured beside the middle.
    """
    showing = [place.split("_") for place in places if place not in IN_BETWEEN]
    beside = [words for words in showing if words[-1] in SIDES]
    if len(showing) >= LEAST_SENSORS and len({words[-1] for words in beside}) == len(SIDES):
        return True
    return {words[0] for words in beside} == {"axle", "frame", "body"}


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

    def moved(self, standard: FloatArray, covariance: FloatArray) -> LogNormal:
        """Return the distribution of numbers whose standard normal ones (n,) have moved there.

        `covariance` (n, n) is theirs.
        """
        logs = np.array(self.mean) + self.factor @ standard
        spread = self.factor @ covariance @ self.factor.T
        rows = tuple(map(tuple, ((spread + spread.T) / 2).tolist()))
        return LogNormal(self.names, tuple(logs.tolist()), rows)
