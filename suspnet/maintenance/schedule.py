"""Trains and parts, and the plan for them: visits with their jobs, as rows and as a text table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import Any

import numpy as np
from tabulate import tabulate

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import Severity, condensed, part_words
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import number, thousands

URGENCIES = ("unknown", "now", "soon", "later")
"""Urgencies of jobs: remaining life unknown, visit on the first possible day, visit to be decided
on within ``SOON_DAYS``, any other visit."""
UNKNOWN = URGENCIES[0]
SOON_DAYS = 30
MOST_NAMED = 3
"""Largest number of trains that a sentence names."""
PROVEN = 1e-6
"""Relative gap between objective and bound that is due to the solver's rounding."""
SLACK = 0.1
"""Largest extra cost at the latest date of a visit, as a share of the cost of a visit."""


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

    def age_days(self, today: date) -> int:
        """Return the age of its newest trip, [days]."""
        return (today - self.on).days

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
        """Return train, car, suspension and parameter or part as text."""
        car = Finding("car", name=self.car) if self.car else ""
        part = part_words(self.parameter)
        return together((self.train, car, self.suspension, part), ", ")


@dataclass(frozen=True, eq=False)
class Job:
    """Work on one part at a visit, or the decision that the part waits.

    Attributes
    ----------
    part : Part
    what : {"replace", "inspect", "plan again", "unknown"}
        "unknown" is a part of unknown remaining life without a visit.
    probability : float
        Probability that the limit is passed before the visit, or before the horizon if the part
        waits; NaN if the remaining life is unknown.
    passing_days : (float, float)
        Interval in which the limit is passed, in days from today; inf: never, NaN: unknown.
    expected_cost : float
        Price of the work and expected cost of failures before it, without the visit. If the part
        waits, the cost of failures before the horizon; if its life is unknown, the price alone.
    unused_km : float, [km]
        Expected life, up to the usual one, that a replacement wastes; NaN for other work.
    plan_again_km : float, [km]
        Mileage from today until a part that waits is planned again; NaN for other parts.
    """

    part: Part
    what: str
    probability: float
    passing_days: tuple[float, float]
    expected_cost: float
    unused_km: float = np.nan
    plan_again_km: float = np.nan

    @property
    def is_passed(self) -> bool:
        """Whether the limit has certainly been passed already."""
        return self.part.is_passed or self.passing_days == (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Visit:
    """One visit of a train.

    Attributes
    ----------
    train : str
    day, latest : date
        Day of least cost, and last day on which the extra cost is small (``SLACK``).
    mileage_km, latest_km : float, [km]
        Mileage of the train on these days; NaN if its trips are too old to know.
    decide_by : date
        `latest` minus the lead time.
    urgency : {"now", "soon", "later"}
    jobs : tuple of Job
        Parts of unknown remaining life first, then by falling probability of failure.
    expected_cost : float
        Cost of the visit and its jobs.
    """

    train: str
    day: date
    latest: date
    mileage_km: float
    latest_km: float
    decide_by: date
    urgency: str
    jobs: tuple[Job, ...]
    expected_cost: float

    def words_of(self, job: Job) -> str:
        """Return the work of one of its jobs and its day: "replace at the visit of 2026-03-15"."""
        return Finding("work-at-visit", what=job.what, day=self.day.isoformat())

    def urgency_of(self, job: Job) -> str:
        """Return the urgency of one of its jobs: "now" or "unknown" if its life is unknown."""
        return UNKNOWN if job.part.unknown and self.urgency != "now" else self.urgency


@dataclass(frozen=True, eq=False)
class Plan:
    """Visits of a fleet until the horizon.

    Attributes
    ----------
    today, horizon : date
    unknown : tuple of Job
        Parts without a visit whose remaining life is unknown.
    visits : tuple of Visit
        Visits for parts of unknown remaining life first, then by day.
    waiting : tuple of Job
        Parts without a visit that have an alarm or may pass a limit before the horizon, in the
        order in which they are planned again.
    n_quiet : int
        Number of other parts, which need nothing.
    objective : float
        Expected cost that the plan minimises, over all trains (``choose_dates``, ``part_costs``).
    bound : float
        Lower bound of the objective of any plan.
    level : float
        Probability of the interval ``Job.passing_days``.
    assumed : tuple of Train
        Trains whose mileage per day is assumed.
    stale : tuple of Train
        Trains whose newest trip is too old to plan by: the lives of their parts are unknown.
    """

    today: date
    horizon: date
    unknown: tuple[Job, ...]
    visits: tuple[Visit, ...]
    waiting: tuple[Job, ...]
    n_quiet: int
    objective: float
    bound: float
    level: float
    assumed: tuple[Train, ...] = ()
    stale: tuple[Train, ...] = ()

    @property
    def assumed_words(self) -> str:
        """Text on trains with an assumed mileage per day; empty if there are none."""
        if not self.assumed:
            return ""
        pace = self.assumed[0].km_per_day
        return Finding("plan-assumed", names=_names(self.assumed), km_per_day=pace)

    @property
    def stale_words(self) -> str:
        """Text on trains whose newest trip is too old, and what follows; empty if none is."""
        if not self.stale:
            return ""
        newest = max(self.stale, key=lambda train: train.on).on
        return Finding(
            "plan-stale",
            names=_names(self.stale),
            days=thousands((self.today - newest).days),
            newest=newest,
            today=str(newest + timedelta(days=1)),
        )

    @property
    def gap(self) -> float:
        """Relative gap between objective and bound; 0: the plan is proven optimal.

        It is above 0 only if a search reached ``MAX_SOLVE_S``.
        """
        excess = self.objective - self.bound
        return excess / self.objective if excess > PROVEN * self.objective else 0.0

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row for each job; dates in ISO 8601, empty if there is none.

        Unknown parts come first, then visits, then parts that wait.
        """
        jobs = [self._row(job, visit) for visit in self.visits for job in visit.jobs]
        rest = (self._row(job, None) for job in self.waiting)
        return [*(self._row(job, None) for job in self.unknown), *jobs, *rest]

    def _row(self, job: Job, visit: Visit | None) -> dict[str, Any]:
        part, ends = job.part, [self.day_after(days) for days in job.passing_days]
        urgency = visit.urgency_of(job) if visit else UNKNOWN if part.unknown else ""
        return {
            "train": part.train,
            "car": part.car,
            "suspension": part.suspension,
            "parameter": part.parameter,
            "part": part_words(part.parameter),
            "what": job.what,
            "visit": visit.words_of(job) if visit else "",
            "urgency": urgency,
            "severity": str(part.severity),
            "unknown": part.unknown,
            "passed": job.is_passed,
            "day": visit.day.isoformat() if visit else "",
            "latest": visit.latest.isoformat() if visit else "",
            "decide_by": visit.decide_by.isoformat() if visit else "",
            "mileage_km": _whole(visit.mileage_km) if visit else np.nan,
            "latest_km": _whole(visit.latest_km) if visit else np.nan,
            "probability": job.probability,
            "passing_from": ends[0].isoformat() if ends[0] else "",
            "passing_to": ends[1].isoformat() if ends[1] else "",
            "expected_cost": job.expected_cost,
            "unused_km": job.unused_km,
            "plan_again_km": job.plan_again_km,
        }

    def day_after(self, days: float) -> date | None:
        """Return the date `days` after today, or None if it exceeds ``date.max``."""
        return self.today + timedelta(days=days) if days < (date.max - self.today).days else None

    @property
    def summary(self) -> str:
        """Too old trips, numbers of visits and jobs, the optimum, and assumed mileages."""
        n_jobs = sum(len(visit.jobs) for visit in self.visits)
        n_waiting = len(self.waiting)
        words = Finding(
            "plan",
            visits=Finding("visits", n=len(self.visits)),
            jobs=Finding("jobs", n=n_jobs),
            day=self.horizon,
            waiting=Finding("maybe-later", n=n_waiting),
            quiet=Finding("need-nothing", n=self.n_quiet),
        )
        if self.unknown:
            words = Finding("plan-unknown", n=len(self.unknown), words=words)
        best = Finding("plan-best")
        if self.gap:
            best = Finding("plan-ended", percent=100 * self.gap)
        return together((self.stale_words, words, best, self.assumed_words), " ")

    def __str__(self) -> str:
        """Return the plan as a text table, and a line on the first part that needs work later."""
        lines, table, before = [self.summary], [], None
        for row in joined(self.rows()):
            if row["what"] == "plan again":
                break
            km = number(row["mileage_km"], 0) if row["day"] else ""
            visit = [row["train"], row["urgency"], row["day"], row["latest"], km]
            failure = "passed" if row["passed"] else f"{100 * row['probability']:.1f} %"
            shown = visit if visit != before else [""] * len(visit)
            table.append([*shown, _words(row), UNKNOWN if row["unknown"] else failure])
            before = visit
        if table:
            head = ("train", "urgency", "best day", "latest", "at km", "what", "failure before")
            lines.append(tabulate(table, head, tablefmt="github", disable_numparse=True))
        if self.waiting:
            first = self.waiting[0]
            when = f"within {first.plan_again_km:.0f} km" if first.plan_again_km else "at each trip"
            lines.append(f"First of those that may: {first.part}; plan again {when}.")
        return "\n".join(lines)


def _whole(value: float) -> float:
    return round(value) if math.isfinite(value) else value


def _names(trains: Sequence[Train]) -> str:
    names = ", ".join(train.name for train in trains[:MOST_NAMED])
    n_more = len(trains) - MOST_NAMED
    return Finding("and-more", names=names, n=n_more) if n_more > 0 else names


def joined(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of a plan, with unknown parts of a suspension with the same reason merged.

    Each row gets a list of its parameters as "parameters".
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for i, row in enumerate(rows):
        where = row["train"], row["car"], row["suspension"]
        alike = (*where, row["unknown"], row["severity"], row["day"]) if row["unknown"] else i
        one = found.setdefault((alike,), {**row, "parameters": []})
        one["parameters"].append(row["parameter"])
    return list(found.values())


def _words(row: Mapping[str, Any]) -> str:
    """Return work and part, without its train, and why its life is unknown."""
    car = f"car {row['car']}" if row["car"] else ""
    parts = map(part_words, condensed(row["parameters"]))
    where = ", ".join(filter(None, (car, row["suspension"], *parts)))
    what = "" if row["what"] == UNKNOWN else f"{row['what']} "
    return f"{what}{where}" + (f": {row['unknown']}" if row["unknown"] else "")
