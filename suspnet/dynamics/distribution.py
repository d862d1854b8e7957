"""Log-normal distributions of a vehicle's uncertain numbers: priors and posteriors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.dynamics.quantities import OFFSETS, QUANTITIES, UNMEASURED
from suspnet.ground.checks import check_number
from suspnet.ground.types import FloatArray

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
