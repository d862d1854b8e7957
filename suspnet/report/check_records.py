"""What a check found of one trip."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.ground.records import Place
from suspnet.ground.storage import printable

READY, TOO_LITTLE, PROBLEM = "ready", "too little", "problem"
"""States of a trip: the models given read it, or without any a model of its speed would; too little
of it can be used; it cannot be opened, or its channels are mixed up."""


@dataclass(frozen=True)
class SteadyPart:
    """What the segments of a trip at one speed give.

    Attributes
    ----------
    speed_m_per_s : float, [m/s]
    n_averages : float
        Independent averages.
    coherence_p, coherence_s : float, [-]
        Means over the vehicle's band of axle box and bogie, and of bogie and body.
    deviation_percent : float, [%]
        Standard deviation of the log-magnitude of the less certain response, median over the band.
    """

    speed_m_per_s: float
    n_averages: float
    coherence_p: float
    coherence_s: float
    deviation_percent: float


@dataclass(frozen=True)
class TripCheck:
    """What is wrong with one trip, and what an estimate would have to work with.

    Attributes
    ----------
    manifest : Path
    state : str
        ``READY``, ``TOO_LITTLE`` or ``PROBLEM``.
    problems : tuple of str
        Why the trip cannot be read, without the manifest's path.
    remarks : tuple of str
        Faults of sensors, what could not be checked, and why there is too little.
    vehicle : str
    place : Place
    mileage_km : float, [km]
    sensors : str
        Which channels are pairs of sensors.
    duration_s : float, [s]
    usable_percent : float, [%]
        Share of the recording without faults.
    band_hz : pair of float, [Hz]
        Where the vehicle's responses are read.
    parts : tuple of SteadyPart
        At each speed with enough averages, the longest first.
    steady_percent : float, [%]
        Share of the segments without faults that belong to `parts`.
    sources : tuple of str
        File and column of each sensor.
    picture : str
        Name of the picture; empty if there is none.
    read_by : str
        Speeds of the models that decide whether it is ready; empty without models.
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
        """Name of the trip; bytes that are not UTF-8 stand in hex."""
        return printable(self.manifest.stem)

    @property
    def n_averages(self) -> float:
        """Independent averages at all steady speeds together."""
        return sum(part.n_averages for part in self.parts)

    @property
    def words(self) -> str:
        """What an estimate would have to work with, in one line."""
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
