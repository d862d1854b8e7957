"""Springs and dampers under equal conditions, for trips warmer or rougher than the healthy ones.

The oil of dampers, and rubber, lose damping as they get warmer. Dampers that blow off or stick have
less of it the faster they are stretched, and dry friction in springs adds less stiffness and less
loss. With T the temperature of a trip, v the rms speed at which a suspension is stretched, and T_0
and v_0 the means of the healthy trips, a stiffness, damping or loss p follows::

    log p = log p_0 + b (T - T_0) + a log(v / v_0)

b [1/K] and a [-] are normal, of each number one of ``SLOPES``; healthy trips of different
temperatures and speeds narrow them (`suspnet.trains.fits.bogie_misfit`). Later trips are read as at
T_0 and v_0, and the uncertainty of b and a widens their intervals with the distance from there.
Only a vehicle with the part nonlinear_dampers has a. v is that between sensors at both ends of a
suspension. Each damper also has a speed of its own, which the vehicle knows
(`BogieMisfit.own_speeds`): the trailing axle moves more than the leading one, and wear changes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import DAMPERS, kind_of
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray


class Slope(NamedTuple):
    """How a number depends on a condition: prior mean and standard deviation of b [1/K] or a [-].

    `condition` is one of ``CONDITIONS``.
    """

    number: str
    condition: str
    mean: float
    deviation: float


CONDITIONS = ("temperature", "primary speed", "secondary speed")
SLOPES = (
    Slope("c_p", "temperature", -0.004, 0.002),
    Slope("c_s", "temperature", -0.004, 0.002),
    Slope("c_p", "primary speed", -0.2, 0.3),
    Slope("c_s", "secondary speed", 0.0, 0.5),
    Slope("k_p", "primary speed", 0.0, 0.05),
    Slope("k_s", "secondary speed", 0.0, 0.05),
    Slope("rubber_loss", "primary speed", -0.5, 0.5),
)
"""Dampers lose more below -10 °C. A damper whose force does not depend on the speed has a = -1, a
linear one 0, and the choke of an air spring, of which the force grows with the power 1.8 of the
speed, 0.8. The loss of a spring with dry friction has -1, of one without 0."""
USUAL = np.array([slope.mean for slope in SLOPES])
DEVIATIONS = np.array([slope.deviation for slope in SLOPES])
N_OF_TEMPERATURE = sum(slope.condition == CONDITIONS[0] for slope in SLOPES)
"""Number of slopes of the temperature, which are the first."""
BY_SPEED = np.arange(len(SLOPES)) >= N_OF_TEMPERATURE
"""Whether each slope is one over the speed, (7,)."""


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


@dataclass(frozen=True)
class SuspensionLaw:
    """The law of a commissioned vehicle.

    `healthy_c` is T_0 [°C], `healthy_m_per_s` v_0 of the primary and the secondary suspension, each
    None if unknown; `slopes` (7,) and `covariance` (7, 7) are mean and covariance of ``SLOPES``.
    `own_speeds` (12,) are the logarithms of v_0 [m/s] of each of ``DAMPERS``, 0 where no slope is
    of the speed.
    """

    healthy_c: float | None
    healthy_m_per_s: tuple[float | None, ...] = (None, None)
    slopes: tuple[float, ...] = tuple(USUAL.tolist())
    covariance: tuple[tuple[float, ...], ...] = _rows(np.diag(DEVIATIONS**2))
    own_speeds: tuple[float, ...] = (0.0,) * len(DAMPERS)

    def __post_init__(self) -> None:
        if self.healthy_c is not None:
            check_number("law.healthy_c", self.healthy_c)
        for name, values, n in (
            ("healthy_m_per_s", self.healthy_m_per_s, 2),
            ("slopes", self.slopes, len(SLOPES)),
            ("own_speeds", self.own_speeds, len(DAMPERS)),
            ("covariance", sum(self.covariance, ()), len(SLOPES) ** 2),
        ):
            if len(values) != n:
                raise ValueError(f"`law.{name}` must be {n} numbers, got {values}")
            for value in values:
                if value is not None or name != "healthy_m_per_s":
                    check_number(f"law.{name}", value)

    @property
    def findings(self) -> list[str]:
        """A sentence on each condition that damping is compared at."""
        sentences: list[str] = []
        if self.healthy_c is not None:
            each = self._losses(CONDITIONS[:1], 1.0)
            sentences.append(Finding("damping-by-temperature", healthy_c=self.healthy_c, each=each))
        if any(self.healthy_m_per_s):
            sentences.append(Finding("damping-by-speed", each=self._losses(CONDITIONS[1:], 0.1)))
        return sentences

    def _losses(self, conditions: Sequence[str], size: float) -> str:
        """Return what dampers lose where a condition is larger by a size."""
        each = [
            Finding(
                "loss-of-damping",
                name=slope.number,
                percent=-100 * size * self.slopes[i],
                deviation=100 * size * float(np.sqrt(self.covariance[i][i])),
            )
            for i, slope in enumerate(SLOPES)
            if slope.condition in conditions and slope.number.startswith("c_")
        ]
        return together(each, " and ")

    @classmethod
    def of_trips(
        cls, temperatures_c: Sequence[float | None], speeds_m_per_s: Sequence[FloatArray]
    ) -> Self:
        """Return the law before the healthy trips, at the means of what is known."""
        known = [temperature_c for temperature_c in temperatures_c if temperature_c is not None]
        speeds = np.exp(np.log(np.array(speeds_m_per_s)).mean(axis=0)).tolist()
        return cls(
            float(np.mean(known)) if known else None,
            tuple(speed if np.isfinite(speed) else None for speed in speeds),
        )

    def fitted(
        self, slopes: FloatArray, covariance: FloatArray, own_speeds: FloatArray
    ) -> Self | None:
        """Return the law with its first slopes as fitted, the others 0, in deviations of the prior.

        `own_speeds` (12,) are the means of the healthy trips. None if neither the temperatures nor
        the speeds of the trips count.
        """
        n, by_speed = len(slopes), len(slopes) > N_OF_TEMPERATURE
        if self.healthy_c is None and not by_speed:
            return None
        means, wide = np.zeros(len(SLOPES)), np.zeros((len(SLOPES),) * 2)
        means[:n] = USUAL[:n] + DEVIATIONS[:n] * slopes
        wide[:n, :n] = DEVIATIONS[:n, None] * covariance * DEVIATIONS[:n]
        speeds = self.healthy_m_per_s if by_speed else (None, None)
        own = tuple(own_speeds.tolist())
        return type(self)(self.healthy_c, speeds, tuple(means.tolist()), _rows(wide), own)

    def conditions(self, temperature_c: float | None, speeds_m_per_s: FloatArray) -> FloatArray:
        """Return what each slope of a trip is multiplied by, (7,); 0 where it is not known.

        `speeds_m_per_s` (2,) are those of both suspensions, NaN if unknown.
        """
        warmer = 0.0
        if temperature_c is not None and self.healthy_c is not None:
            warmer = temperature_c - self.healthy_c
        healthy = np.array(self.healthy_m_per_s, float)
        faster = np.nan_to_num(np.log(speeds_m_per_s / healthy))
        of = dict(zip(CONDITIONS, (warmer, *faster), strict=True))
        return np.array([of[slope.condition] for slope in SLOPES])

    def beside(
        self, names: Sequence[str], conditions: FloatArray, faster: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return by how much parts read are off, and the covariance of their logarithms by slopes.

        Shapes (n_names,) and (n_names, n_names). They were read under `conditions` (7,), and
        ``DAMPERS`` are faster than these say by factors with the logarithms `faster` (12,). The
        errors of the slopes are the same for all parts of a kind.
        """
        own = (faster @ by_dampers(names)).T
        factors = follows(names).T * conditions + own
        return own @ np.array(self.slopes), factors @ np.array(self.covariance) @ factors.T


def follows(names: Sequence[str]) -> FloatArray:
    """Return whether a number follows each slope, (7, n_names): 1 for parts of the slope's kind.

    Those of the other bogie follow as those of the measured one do.
    """
    of_slopes = [
        [slope.number in (name, kind_of(name)) or name == f"other_{slope.number}" for name in names]
        for slope in SLOPES
    ]
    return np.array(of_slopes, float)


def by_dampers(names: Sequence[str]) -> FloatArray:
    """Return by how much each slope of a number follows the speed of each damper, (7, 12, n_names).

    1 for one of ``DAMPERS`` and the spring beside it, equal shares where all of a kind are one.
    """
    places = [name.replace("k_", "c_") for name in names]
    of_damper = np.array([[place in (d, d[:3]) for place in places] for d in DAMPERS], float)
    shares = of_damper / np.maximum(1, of_damper.sum(axis=0))
    kinds = np.array([name.removeprefix("other_")[:3] for name in names])
    numbers = np.where(BY_SPEED, [slope.number for slope in SLOPES], "")
    return np.asarray(shares * (kinds == numbers[:, None])[:, None])


def beyond_pairs(own_speeds: FloatArray, conditions: FloatArray) -> FloatArray:
    """Return how much faster each of ``DAMPERS`` is than `conditions` (..., 7) say, (..., 12).

    `own_speeds` (..., 12) are the logarithms of their speeds over those of the healthy trips.
    """
    of_speed = {slope.number: i for i, slope in enumerate(SLOPES) if BY_SPEED[i]}
    of_pairs = [of_speed[name.removeprefix("other_")[:3]] for name in DAMPERS]
    return np.asarray(own_speeds - conditions[..., of_pairs])
