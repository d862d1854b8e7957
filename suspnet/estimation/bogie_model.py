"""A model that reads each spring and damper of a commissioned bogie on trips."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from suspnet.curves.estimates import EstimateSettings
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.estimate import Estimate, HealthyValues
from suspnet.estimation.fitted import Model
from suspnet.estimation.trained import READS_TRIPS
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_number
from suspnet.vehicle import VerticalVehicle

if TYPE_CHECKING:
    from suspnet.trains.recordings.recording import Recording

BOGIE = "bogie"  # name of such models, beside those of ``suspnet.learning.METHODS``


@dataclass(frozen=True, repr=False)
class BogieModel(Model):
    """A model that reads springs and dampers of a commissioned bogie, at any speed, both ways.

    It reads each of them, or all of a kind as equal where the sensors do not show each.

    No method was fitted for it: a trip is explained by the bogie itself. `generator` has the
    bogie's numbers with both sides and axles as equal: it checks the channels, and `settings` are
    those of the responses that are shown. `training` notes the healthy trips.
    """

    bogie: CommissionedBogie
    generator: VerticalVehicle
    settings: EstimateSettings
    training: dict[str, Any] = field(default_factory=dict)
    name: str = field(default=BOGIE, init=False)

    def __repr__(self) -> str:
        read = "each part" if self.bogie.generator.shows_parts else "springs and dampers"
        return f"BogieModel({read} of {self.vehicle.name}, misfit {self.bogie.misfit:.3g})"

    @cached_property
    def healthy(self) -> HealthyValues:
        """Healthy values of ``COMPONENTS`` in SI units, which estimates are relative to."""
        return self.bogie.healthy

    def estimate(
        self,
        data: Recording | Path | str,
        *,
        level: float = INTERVAL_LEVEL,
        settings: TripSettings | None = None,
    ) -> Estimate:
        """Return each part of a trip, its recording or its manifest's path, relative to healthy.

        The estimate is one row with intervals of `level`; `settings` are how recordings are read.
        FileNotFoundError and TripError are raised if its files are missing or wrong,
        NoEstimateError if nothing can be estimated from it, ValueError if the level is none.
        """
        check_number("level", level, above=0, below=1)
        chosen = replace(settings or TripSettings(), level=level)
        estimate: Estimate = import_module(READS_TRIPS).estimate_trip(self, data, chosen)
        return estimate
