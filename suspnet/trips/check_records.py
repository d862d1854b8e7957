"""Results of the check of one trip."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.ground.records import Place
from suspnet.ground.storage import printable

READY, TOO_LITTLE, PROBLEM = "ready", "too little", "problem"
"""States of a trip: it is readable by the given models, or without any by a model of its speed; too
little of it can be used; it cannot be opened, or its channels are swapped."""


@dataclass(frozen=True)
class SteadyPart:
    """Quality of a trip's segments at one speed.

    `n_averages` counts independent averages. Coherences are means over the vehicle's band, of axle
    box and bogie and of bogie and body. `deviation_percent` is the standard deviation of the
    log-magnitude of the less certain response, median over the band.
    """

    speed_m_per_s: float
    n_averages: float
    coherence_p: float
    coherence_s: float
    deviation_percent: float


@dataclass(frozen=True)
class TripCheck:
    """What is wrong with one trip, and how much of it can be used.

    `problems` state why the trip cannot be read, without the manifest's path. `remarks` are faults
    of sensors, parts that could not be checked, and why there is too little. `sensors` names the
    channels that are pairs of sensors; `sources` are file and column of each sensor.
    `usable_percent` is the share of the recording without faults, `steady_percent` the share of its
    segments that belong to `parts`, which are the speeds with enough averages, the longest first.
    `band_hz` is where the vehicle's responses are read, and `read_by` the speeds of the models that
    decide whether the trip is ready, empty without models.
    """

    manifest: Path
    state: str = PROBLEM
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    vehicle: str = ""
    place: Place = field(default_factory=Place)
    mileage_km: float = np.nan
    sensors: str = ""
    duration_s: float = np.nan
    usable_percent: float = np.nan
    band_hz: tuple[float, float] = (np.nan, np.nan)
    parts: tuple[SteadyPart, ...] = ()
    steady_percent: float = np.nan
    sources: tuple[str, ...] = ()
    picture: str = ""
    read_by: str = ""

    @property
    def name(self) -> str:
        """Name of the trip; bytes that are not UTF-8 are shown in hex."""
        return printable(self.manifest.stem)

    @property
    def n_averages(self) -> float:
        """Independent averages at all steady speeds together."""
        return sum(part.n_averages for part in self.parts)

    @property
    def words(self) -> str:
        """Amount and quality of usable data, on one line."""
        speeds = ", ".join(
            f"{part.n_averages:.0f} averages at {part.speed_m_per_s:.1f} m/s" for part in self.parts
        )
        return f"{self.usable_percent:.3g} % usable, {speeds or 'no steady part'}, {self.sensors}"

    def row(self) -> dict[str, Any]:
        """Return the check as JSON-able values."""
        return asdict(self) | {
            "manifest": printable(str(self.manifest)),
            "n_averages": self.n_averages,
        }
