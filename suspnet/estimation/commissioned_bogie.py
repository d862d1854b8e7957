"""A bogie as its healthy trips show it."""

from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from suspnet.estimation.estimate import HealthyValues
from suspnet.estimation.temperature import DampingByTemperature
from suspnet.ground.parameters import COMPONENTS
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.vehicle import SpatialVehicle


@dataclass(frozen=True, repr=False)
class CommissionedBogie(ShortRepr):
    """A bogie as its healthy trips show it.

    `generator` has the posterior of its numbers as its distribution, `noise` (n_sensors,)
    [(m/s^2)^2/Hz] is that of its sensors, `misfit` the rms of the residuals over that of the noise,
    `masses` [-] the car-body mass of each trip over nominal. `law` is how its damping depends on
    the temperature, None if that of no healthy trip is known.
    """

    generator: SpatialVehicle
    noise: Tensor
    masses: FloatArray
    misfit: float
    converged: bool
    law: DampingByTemperature | None = None

    @cached_property
    def healthy(self) -> HealthyValues:
        """Healthy values of ``COMPONENTS`` in SI units, which estimates are relative to."""
        return HealthyValues.of(self.generator, COMPONENTS)
