"""A bogie as its healthy trips show it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import norm, t
from torch import Tensor

from suspnet.estimation.estimate import HealthyValues
from suspnet.estimation.suspension_law import SuspensionLaw
from suspnet.ground.parameters import BOGIE_PARTS, COMPONENTS, PARAMETERS, kind_of
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.vehicle import SpatialVehicle


@dataclass(frozen=True)
class HealthyScatter:
    """Scatter of the parts of healthy trips that were read as later ones, beyond noise.

    `own` and `alike` are standard deviations of the logarithm of a part of each of ``PARAMETERS``
    k_p, c_p, k_s and c_s: of each part alone, and of all of the kind together; `n_trips` is their
    number. Few trips tell little of it: it counts with Student's quantiles of n_trips - 1 degrees.
    `noise` (12, 12) is the mean covariance of the logarithms that noise alone gives such a trip,
    (4, 4) where all parts of a kind are equal and `own` is 0.
    """

    own: tuple[float, ...]
    alike: tuple[float, ...]
    n_trips: int
    noise: tuple[tuple[float, ...], ...]

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the logarithms of ``BOGIE_PARTS``, (12, 12)."""
        kinds = np.array([PARAMETERS.index(kind_of(name)) for name in BOGIE_PARTS])
        own, alike = np.square(self.own)[kinds], np.square(self.alike)[kinds]
        return np.diag(own) + np.where(kinds[:, None] == kinds, alike, 0.0)

    def widened(self, level: float) -> FloatArray:
        """Return what stands for the covariance in intervals of a level, (12, 12).

        It is wider by the square of Student's quantile over the normal one.
        """
        tail = (1 + level) / 2
        return self.covariance * float(t.ppf(tail, self.n_trips - 1) / norm.ppf(tail)) ** 2


@dataclass(frozen=True, repr=False)
class CommissionedBogie(ShortRepr):
    """A bogie as its healthy trips show it.

    `generator` has the posterior of its numbers as its distribution, `noise` (n_sensors,)
    [(m/s^2)^2/Hz] is that of its sensors, `misfit` the rms of the residuals over that of the noise,
    `masses` [-] the car-body mass of each trip over nominal, `scatter` that of its parts from trip
    to trip. `law` is how its damping depends on temperature and speed, None if the trips tell
    neither. `errors` (n_freq, n_sensors) [-] are the fractions of its signals that it may err by in
    each bin of a trip, `loads_m` (n_trips, 2) [m] where each trip's load has the body's centre of
    mass, from the middle towards the bogie and to the left; None: not known.
    """

    generator: SpatialVehicle
    noise: Tensor
    masses: FloatArray
    misfit: float
    converged: bool
    scatter: HealthyScatter
    law: SuspensionLaw | None = None
    errors: Tensor | None = None
    loads_m: FloatArray | None = None

    @cached_property
    def healthy(self) -> HealthyValues:
        """Healthy values of `outputs` in SI units, which estimates are relative to."""
        return HealthyValues.of(self.generator, self.outputs)

    @property
    def outputs(self) -> tuple[str, ...]:
        """What is read: each part and the mass, or all parts of a kind as equal."""
        return COMPONENTS if self.generator.shows_parts else PARAMETERS
