"""The speeds of a trip's segments."""

from __future__ import annotations

import math
from dataclasses import dataclass

from suspnet.features.welch import NEGLIGIBLE


@dataclass(frozen=True)
class Speeds:
    """The speeds of the segments that one estimate averages, as a quadrature.

    Attributes
    ----------
    m_per_s : tuple of float, [m/s]
    weights : tuple of float
        Of sum 1.
    """

    m_per_s: tuple[float, ...]
    weights: tuple[float, ...]

    @classmethod
    def of(cls, mean_m_per_s: float, deviation_m_per_s: float) -> Speeds:
        """Return three-point Gauss-Hermite quadrature: exact to the fifth moment of a normal."""
        if not deviation_m_per_s > NEGLIGIBLE * mean_m_per_s:
            return cls((mean_m_per_s,), (1.0,))
        step = math.sqrt(3) * deviation_m_per_s
        nodes = (mean_m_per_s - step, mean_m_per_s, mean_m_per_s + step)
        return cls(nodes, (1 / 6, 2 / 3, 1 / 6))
