"""Inputs of a plan: settings, trains, and parts with their remaining life."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.parameters import Severity
from suspnet.ground.settings import check_number, check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.maintenance.visit_costs import Costs

MOST_DAYS = 36_525.0
"""Longest horizon, a century, [days]."""
MAX_DATES = 1000
"""Largest number of possible dates before the horizon."""
WINDOW_DAYS = 180
"""Number of latest days whose trips determine the mileage per day of a train."""
LEAST_DAYS = 14
"""Fewest days that the trips must span to determine the mileage per day of a train."""


@dataclass(frozen=True)
class PlanSettings:
    """Costs, dates and risks of a plan.

    Parameters
    ----------
    costs : Costs or mapping of parameter to Costs
        Costs of all parts, or of the parts behind each parameter.

    Raises
    ------
    TypeError, ValueError
        If a setting is out of range, or there are more than ``MAX_DATES`` dates.
    """

    visit: float = setting(
        1.0, "Cost of taking a train out of service once, in the currency of the other costs", low=0
    )
    costs: Costs | Mapping[str, Costs] = field(default_factory=Costs)
    lead_days: float = setting(
        14.0, "Days from today until the first possible visit", "days", low=0
    )
    horizon_days: float = setting(
        730.0,
        "Days from today until the last date that is planned",
        above=0,
        high=MOST_DAYS,
        rule="days; above lead_days, at most 36525",
    )
    step_days: float = setting(7.0, "Days between possible dates", "days", above=0)
    notice_days: float = setting(
        90.0,
        "Days within which a notice is looked at where no passing of a limit is predicted",
        "days",
        low=0,
    )
    km_per_day: float = setting(
        500.0, "Daily mileage of trains whose trips do not determine it", "km", above=0
    )
    plan_again_risk: float = setting(
        0.01,
        "Probability that a limit is passed at which a part without a visit is planned again at "
        "the latest",
        above=0,
        below=1,
    )
    level: float = setting(
        0.8,
        "Probability of the interval in which a part passes its limit, as it is shown",
        above=0,
        below=1,
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if self.horizon_days <= self.lead_days:
            raise ValueError(
                f"`horizon_days` must be > `lead_days` ({self.lead_days:g}), "
                f"got {self.horizon_days:g}"
            )
        if self.horizon_days - self.lead_days > MAX_DATES * self.step_days:
            raise ValueError(
                f"`step_days` must leave at most {MAX_DATES} dates until `horizon_days`, "
                f"got {self.step_days:g}"
            )
        given = self.costs.values() if isinstance(self.costs, Mapping) else [self.costs]
        if not all(isinstance(one, Costs) for one in given):
            raise TypeError(
                f"`costs` must be Costs or a mapping of parameters to Costs, got {self.costs!r}"
            )

    def of(self, parameter: str) -> Costs:
        """Return the costs of a parameter's part; ValueError if `costs` does not name it."""
        if isinstance(self.costs, Costs):
            return self.costs
        if parameter not in self.costs:
            raise ValueError(f"`costs` must name {parameter!r}, got {tuple(self.costs)}")
        return self.costs[parameter]


@dataclass(frozen=True)
class Train:
    """Mileage of a train now and per day.

    Parameters
    ----------
    name : str
    mileage_km : float, [km]
    on : date
        Day of that mileage.
    km_per_day : float
    is_assumed : bool
        Whether `km_per_day` is that of the settings, as the trips do not determine it.
    """

    name: str
    mileage_km: float
    on: date
    km_per_day: float
    is_assumed: bool = False

    def __post_init__(self) -> None:
        check_number(f"mileage_km of train {self.name}", self.mileage_km)
        check_number(f"km_per_day of train {self.name}", self.km_per_day, above=0)

    def mileage_at(self, day: date) -> float:
        """Return the mileage expected on a day, [km]."""
        return self.mileage_km + self.km_per_day * (day - self.on).days


@dataclass(frozen=True, eq=False)
class Part:
    """One parameter of one suspension, and its remaining life.

    Parameters
    ----------
    train, suspension, parameter : str
    samples_km : array of shape (n_samples,), [km]
        Equally likely mileages from the last trip until a limit is passed, as in
        ``Life.samples_km``; inf: never, 0: already passed.
    mileage_km : float, [km]
        Mileage of the last trip.
    severity : Severity
        Severity of its alarm.
    car : str
    unknown : str
        Why its remaining life is unknown or unreliable; empty if it is known. The visits of an
        unknown part then depend on its severity alone if `samples_km` is only inf.
    """

    train: str
    suspension: str
    parameter: str
    samples_km: FloatArray
    mileage_km: float
    severity: Severity = Severity.NONE
    car: str = ""
    unknown: str = ""

    def __post_init__(self) -> None:
        samples = np.asarray(self.samples_km, dtype=float)
        if samples.ndim != 1 or not samples.size or not (samples >= 0).all():
            raise ValueError(
                f"`samples_km` of {self} must be mileages >= 0, at least one, none of them NaN"
            )
        check_number(f"mileage_km of {self}", self.mileage_km)
        object.__setattr__(self, "samples_km", samples)
        object.__setattr__(self, "severity", Severity(self.severity))

    @property
    def place(self) -> tuple[str, str, str]:
        """Train, car and suspension."""
        return self.train, self.car, self.suspension

    @property
    def is_passed(self) -> bool:
        """Whether the limit is passed already, with certainty."""
        return bool((self.samples_km == 0).all())

    def __str__(self) -> str:
        """Return train, car, suspension and parameter as text."""
        car = f"car {self.car}" if self.car else ""
        return ", ".join(filter(None, (self.train, car, self.suspension, self.parameter)))


def km_per_day(starts: NDArray[np.datetime64], mileages_km: FloatArray, default: float) -> float:
    """Return the mileage of a train per day, from starts and mileages of its newest trips.

    `starts` (NaT: unknown) and `mileages_km` (NaN: unknown): (n_trips,). `default` is returned if
    these trips span less than ``LEAST_DAYS`` or their mileage does not rise.
    """
    if mileages_km.shape != starts.shape:
        raise ValueError(
            f"`mileages_km` must be one for each of {len(starts)} starts, "
            f"got shape {mileages_km.shape}"
        )
    known = ~np.isnat(starts) & np.isfinite(mileages_km)
    days, mileages = starts[known].astype("datetime64[D]").astype(float), mileages_km[known]
    if not days.size:
        return default
    new = days >= days.max() - WINDOW_DAYS
    span = np.ptp(days[new])
    run = mileages[new][days[new].argmax()] - mileages[new][days[new].argmin()]
    return float(run / span) if span >= LEAST_DAYS and run > 0 else default
