"""What a plan says: visits with their jobs, as a table in words and as rows."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, timedelta
from typing import Any

import numpy as np
from tabulate import tabulate

from suspnet.maintenance.plan_inputs import Part, Train

URGENCIES = ("now", "soon", "later")
"""A visit on the first possible day; one to be decided on within ``SOON_DAYS``; any other."""
SOON_DAYS = 30
MOST_NAMED = 3
"""Largest number of trains that a sentence names."""
SLACK = 0.1
"""Share of a visit's cost that it may cost more at its latest date than at its best."""


@dataclass(frozen=True, eq=False)
class Job:
    """What is done to one part at a visit, or that it waits.

    Attributes
    ----------
    part : Part
    what : {"replace", "inspect", "plan again"}
    probability : float
        That the limit is passed before the visit, or, of a part that waits, before the horizon.
    passing_days : (float, float)
        Interval of the passing of the limit, in days from today; inf: never.
    expected_cost : float
        Price of the work and cost of failures before it, without the visit; of a part that waits,
        the cost of failures before the horizon.
    unused_km : float, [km]
        Expected life, up to the usual one, that a replacement throws away; else NaN.
    plan_again_km : float, [km]
        Of a part that waits: from today, until it is to be planned again; else NaN.
    """

    part: Part
    what: str
    probability: float
    passing_days: tuple[float, float]
    expected_cost: float
    unused_km: float = np.nan
    plan_again_km: float = np.nan


@dataclass(frozen=True, eq=False)
class Visit:
    """One visit of a train.

    Attributes
    ----------
    train : str
    day, latest : date
        When it costs least, and until when it costs little more (``SLACK``).
    mileage_km, latest_km : float, [km]
        Of the train on these days.
    decide_by : date
        `latest` less the lead time.
    urgency : {"now", "soon", "later"}
    jobs : tuple of Job
        The likeliest failure first.
    expected_cost : float
        Of the visit and its jobs.
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


@dataclass(frozen=True, eq=False)
class Plan:
    """Visits of a fleet until the horizon.

    Attributes
    ----------
    today, horizon : date
    visits : tuple of Visit
        Ascending days.
    waiting : tuple of Job
        Parts without a visit that have an alarm or may pass a limit before the horizon; the first
        to be planned again first.
    n_quiet : int
        Other parts: nothing to be done.
    objective : float
        What the plan minimises, summed over trains: see ``choose_dates`` and ``part_costs``.
    level : float
        Probability of ``Job.passing_days``.
    assumed : tuple of Train
        Those whose mileage per day is assumed.
    """

    today: date
    horizon: date
    visits: tuple[Visit, ...]
    waiting: tuple[Job, ...]
    n_quiet: int
    objective: float
    level: float
    assumed: tuple[Train, ...] = ()

    @property
    def assumed_words(self) -> str:
        """Which trains run an assumed mileage per day; empty if all show theirs."""
        if not self.assumed:
            return ""
        names = ", ".join(train.name for train in self.assumed[:MOST_NAMED])
        more = len(self.assumed) - MOST_NAMED
        pace = f"{self.assumed[0].km_per_day:g} km a day"
        return (
            f"{names}{f' and {more} more' if more > 0 else ''}: {pace} are assumed, as the dates "
            "of the trips are unknown or too close."
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row for each job, visits first; days in ISO 8601, empty where none."""
        jobs = [self._row(job, visit) for visit in self.visits for job in visit.jobs]
        return jobs + [self._row(job, None) for job in self.waiting]

    def _row(self, job: Job, visit: Visit | None) -> dict[str, Any]:
        part, ends = job.part, [self.day_after(days) for days in job.passing_days]
        return {
            "train": part.train,
            "car": part.car,
            "suspension": part.suspension,
            "parameter": part.parameter,
            "what": job.what,
            "urgency": visit.urgency if visit else "",
            "severity": str(part.severity),
            "day": visit.day.isoformat() if visit else "",
            "latest": visit.latest.isoformat() if visit else "",
            "decide_by": visit.decide_by.isoformat() if visit else "",
            "mileage_km": round(visit.mileage_km) if visit else np.nan,
            "latest_km": round(visit.latest_km) if visit else np.nan,
            "probability": job.probability,
            "passing_from": ends[0].isoformat() if ends[0] else "",
            "passing_to": ends[1].isoformat() if ends[1] else "",
            "expected_cost": job.expected_cost,
            "unused_km": job.unused_km,
            "plan_again_km": job.plan_again_km,
        }

    def day_after(self, days: float) -> date | None:
        """Return the day after a time from today, or None if no calendar holds it."""
        return self.today + timedelta(days=days) if days < (date.max - self.today).days else None

    def __str__(self) -> str:
        """Return the plan as a table of visits, and what waits in one sentence."""
        n_jobs = sum(len(visit.jobs) for visit in self.visits)
        lines = [
            f"{count(len(self.visits), 'visit')} with {count(n_jobs, 'job')} until "
            f"{self.horizon}, {len(self.waiting)} parts wait, {self.n_quiet} need nothing.",
            *([self.assumed_words] if self.assumed else []),
        ]
        if self.visits:
            head = ("train", "urgency", "best day", "latest", "at km", "what", "failure before")
            table = [
                [
                    *((visit.train, visit.urgency, visit.day, visit.latest) if first else [""] * 4),
                    f"{visit.mileage_km:.0f}" if first else "",
                    _words(job),
                    "passed" if job.part.is_passed else f"{100 * job.probability:.1f} %",
                ]
                for visit in self.visits
                for first, job in zip([True] + [False] * len(visit.jobs), visit.jobs, strict=False)
            ]
            lines.append(tabulate(table, head, tablefmt="github", disable_numparse=True))
        if self.waiting:
            first = self.waiting[0]
            when = f"within {first.plan_again_km:.0f} km" if first.plan_again_km else "at each trip"
            lines.append(f"Plan again {when}, for {first.part}.")
        return "\n".join(lines)


def count(n: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{n} {noun}{'s' * (n != 1)}"


def _words(job: Job) -> str:
    """Return what is done to which part, without its train."""
    car = f"car {job.part.car}" if job.part.car else ""
    return f"{job.what} " + ", ".join(filter(None, (car, job.part.suspension, job.part.parameter)))
