"""Maintenance events of a suspension."""

from __future__ import annotations

import math
from dataclasses import dataclass

from suspnet.ground.wording import kilometres

KINDS = ("exchanged", "reprofiled", "other")
"""Kinds of maintenance: a part exchanged, wheels reprofiled, or what the words say."""


@dataclass(frozen=True)
class Event:
    """Maintenance of a suspension: what trips show from then on starts anew.

    Attributes
    ----------
    mileage_km : float, [km]
        The first trips of this mileage or more are after it.
    kind : str
        One of ``KINDS``.
    words : str
        What was done.
    """

    mileage_km: float
    kind: str = "other"
    words: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.mileage_km):
            raise ValueError(f"an event needs a mileage in km, got {self.mileage_km}")
        if self.kind not in KINDS:
            raise ValueError(f"an event is one of {', '.join(KINDS)}, got {self.kind!r}")

    def __str__(self) -> str:
        """Return the event in words."""
        return f"{self.words or self.kind} at {kilometres(self.mileage_km)}"
