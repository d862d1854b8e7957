"""Alarms of a suspension, and what people said who saw them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

import numpy as np

from suspnet.maintenance.limits import Severity


class Cause(StrEnum):
    """Ground of an alarm."""

    LIMIT = "limit"
    """A parameter is beyond a limit."""
    CHANGE = "change"
    """A parameter is no longer what its reference trips showed."""
    SISTER = "sister"
    """A parameter differs from that of the sister suspensions of the car."""


OWN_CAUSES = (Cause.LIMIT, Cause.CHANGE)
"""Causes of alarms that the trips of a suspension tell by themselves."""


@dataclass(frozen=True)
class Alarm:
    """One parameter called for attention, from one trip on until another.

    Parameters
    ----------
    parameter : str
    cause : Cause
    severity : Severity
        The worst while it stood.
    begin_km : float, [km]
        Mileage of the trip that raised it.
    end_km : float, [km]
        Mileage of the trip that ended it; NaN: it stands still.
    words : str
        The reason.

    Raises
    ------
    ValueError
        If it has no begin, or ends before it.
    """

    parameter: str
    cause: Cause
    severity: Severity
    begin_km: float
    end_km: float = np.nan
    words: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cause", Cause(self.cause))
        object.__setattr__(self, "severity", Severity(self.severity))
        if not math.isfinite(self.begin_km):
            raise ValueError(f"an alarm needs a mileage in km, got {self.begin_km}")
        if self.end_km < self.begin_km:
            raise ValueError(f"an alarm of {self.begin_km} km ends before, at {self.end_km} km")

    @property
    def is_open(self) -> bool:
        """Whether it stands still."""
        return math.isnan(self.end_km)


@dataclass(frozen=True)
class Acknowledgement:
    """A person has seen an alarm.

    Parameters
    ----------
    parameter : str
    cause : Cause
    severity : Severity
        Of the alarm when it was seen.
    at_km : float, [km]
        Mileage of the newest trip then.
    by : str
        Name of the person.
    at : str
        Time, ISO 8601 with its zone.
    words : str
        What the person says.

    Raises
    ------
    ValueError
        If a name, a mileage or a time is missing.
    """

    parameter: str
    cause: Cause
    severity: Severity
    at_km: float
    by: str
    at: str
    words: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cause", Cause(self.cause))
        object.__setattr__(self, "severity", Severity(self.severity))
        if not math.isfinite(self.at_km):
            raise ValueError(f"an acknowledgement needs a mileage in km, got {self.at_km}")
        if not self.by.strip():
            raise ValueError("an acknowledgement needs the name of a person")
        try:
            zoned = datetime.fromisoformat(self.at).tzinfo is not None
        except ValueError:
            zoned = False
        if not zoned:
            raise ValueError(
                f"the time of an acknowledgement must be ISO 8601 with its zone, got {self.at!r}"
            )

    def covers(self, alarm: Alarm) -> bool:
        """Return whether it is of an alarm as severe as that is now: a worse one asks again."""
        there = alarm.begin_km <= self.at_km and not self.at_km > alarm.end_km
        same = (self.parameter, self.cause) == (alarm.parameter, alarm.cause)
        return same and there and alarm.severity <= self.severity


def newest_of(alarm: Alarm, seen: Iterable[Acknowledgement]) -> Acknowledgement | None:
    """Return the newest of the acknowledgements that cover an alarm; None if there is none."""
    covering = (one for one in seen if one.covers(alarm))
    return max(covering, key=lambda one: datetime.fromisoformat(one.at), default=None)
