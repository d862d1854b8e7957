"""Speeds at which a trip is read, and ranges of speeds that one model reads."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from suspnet.curves.welch import NEGLIGIBLE
from suspnet.ground.findings import Finding, together

ROUNDING = 1e-9
"""Relative rounding error of a range's ends, which are computed from middle and half width."""


class NoEstimateError(Exception):
    """The trip is valid but gives no estimate; the message states the reason."""


@dataclass(frozen=True)
class Speeds:
    """Speeds of the segments that one estimate averages, as a quadrature with weights of sum 1."""

    m_per_s: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean speed, [m/s]."""
        return sum(v * weight for v, weight in zip(self.m_per_s, self.weights, strict=True))

    @classmethod
    def of(cls, mean_m_per_s: float, deviation_m_per_s: float) -> Self:
        """Return three-point Gauss-Hermite quadrature, exact to the fifth moment of a normal."""
        if not deviation_m_per_s > NEGLIGIBLE * mean_m_per_s:
            return cls((mean_m_per_s,), (1.0,))
        step = math.sqrt(3) * deviation_m_per_s
        nodes = (mean_m_per_s - step, mean_m_per_s, mean_m_per_s + step)
        return cls(nodes, (1 / 6, 2 / 3, 1 / 6))


@dataclass(frozen=True)
class SpeedRange:
    """Range of speeds that one model reads."""

    low_m_per_s: float
    high_m_per_s: float

    @classmethod
    def around(cls, trained_m_per_s: float, half_width: float) -> Self:
        """Return the speeds within 1 +- `half_width` of that of the training curves."""
        return cls(trained_m_per_s * (1 - half_width), trained_m_per_s * (1 + half_width))

    @property
    def trained_m_per_s(self) -> float:
        """Speed of the training curves, the middle of the range."""
        return (self.low_m_per_s + self.high_m_per_s) / 2

    def holds(self, speed_m_per_s: float) -> bool:
        """Return whether a speed is in the range, including its ends with rounding."""
        low, high = self.low_m_per_s, self.high_m_per_s
        return low * (1 - ROUNDING) <= speed_m_per_s <= high * (1 + ROUNDING)


def reading_range(speed_m_per_s: float, ranges: Iterable[SpeedRange]) -> SpeedRange | None:
    """Return the range that contains a speed, by the nearest middle; None if there is none."""
    holding = [speeds for speeds in ranges if speeds.holds(speed_m_per_s)]
    return min(
        holding, key=lambda r: abs(math.log(speed_m_per_s / r.trained_m_per_s)), default=None
    )


def range_words(ranges: Iterable[SpeedRange]) -> str:
    """Return the union of some ranges as text.

    >>> range_words([SpeedRange(70, 80), SpeedRange(60, 70), SpeedRange(20, 25)])
    '20.0 to 25.0 and 60.0 to 80.0 m/s'
    """
    joined: list[SpeedRange] = []
    for speeds in sorted(ranges, key=lambda speeds: speeds.low_m_per_s):
        if joined and joined[-1].holds(speeds.low_m_per_s):
            high = max(joined[-1].high_m_per_s, speeds.high_m_per_s)
            joined[-1] = SpeedRange(joined[-1].low_m_per_s, high)
        else:
            joined.append(speeds)
    words = (Finding("range", low=r.low_m_per_s, high=r.high_m_per_s) for r in joined)
    return Finding("metres-per-second", words=together(words, " and "))
