"""Trains and parts, and the plan for them: visits with their jobs, as rows and as a text table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
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

URGENCIES = UNKNOWN, NOW, SOON, LATER = "unknown", "now", "soon", "later"
"""Urgencies of jobs: remaining life unknown, visit on the first possible day, visit to be decided
on within ``SOON_DAYS``, any other visit."""
SOON_DAYS = 30
WAIT = "plan again"
"""What is done with a part that has no visit before the horizon."""
MOST_NAMED = 3
"""Largest number of trains that a sentence names."""


@dataclass(frozen=True)
class Train:
    """Mileage of a train on a day, [km], and per day.

    `is_assumed`: `km_per_day` is that of the settings, as the trips do not determine it.
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

    `samples_km`, (n_samples,), are equally likely mileages from the last trip, at `mileage_km`,
    until a limit is passed, as in ``Life.samples_km``; inf: never, 0: already passed. `severity` is
    that of its alarm. `unknown` is why its remaining life is unknown or unreliable; empty if it is
    known.
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

    def __str__(self) -> str:
        """Return train, car, suspension and parameter or part as text."""
        car = Finding("car", name=self.car) if self.car else ""
        return together((self.train, car, self.suspension, part_words(self.parameter)), ", ")


@dataclass(frozen=True, eq=False)
class Job:
    """Work on one part at a visit, or the decision that the part waits.

    `what` is replace, inspect, ``WAIT``, or "unknown" for a part of unknown remaining life without
    a visit. `probability` is that of passing the limit before the visit, or before the horizon
    without one; `passing_days` is the interval in which it is passed, in days from today, inf:
    never. Both are NaN if the remaining life is unknown.
    """

    part: Part
    what: str
    probability: float
    passing_days: tuple[float, float]

    @property
    def is_passed(self) -> bool:
        """Whether the limit has certainly been passed already."""
        return bool((self.part.samples_km == 0).all()) or self.passing_days == (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Visit:
    """One visit of a train, and its jobs: parts of unknown life first, then the likeliest to fail.

    `day` is the last one on which no part exceeds the accepted risk, `mileage_km` that of the train
    on it, NaN if its trips are too old to know; `decide_by` is `day` minus the lead time.
    """

    train: str
    day: date
    mileage_km: float
    decide_by: date
    urgency: str
    jobs: tuple[Job, ...]

    def words_of(self, job: Job) -> str:
        """Return the work of one of its jobs and its day: "replace at the visit of 2026-03-15"."""
        return Finding("work-at-visit", what=job.what, day=self.day.isoformat())

    def urgency_of(self, job: Job) -> str:
        """Return the urgency of one of its jobs: "now" or "unknown" if its life is unknown."""
        return UNKNOWN if job.part.unknown and self.urgency != NOW else self.urgency


@dataclass(frozen=True, eq=False)
class Plan:
    """Visits of a fleet until the horizon.

    `visits` are sorted: those for parts of unknown remaining life first, then by day. `unknown` are
    parts without a visit whose remaining life is unknown, `waiting` those that may pass a limit
    before the horizon, the likeliest first; `n_quiet` counts the other parts, which need nothing.
    `level` is the probability of the interval ``Job.passing_days``. The mileage per day of trains
    in `assumed` is assumed; the newest trip of those in `stale` is too old to plan by, so that the
    lives of their parts are unknown.
    """

    today: date
    horizon: date
    unknown: tuple[Job, ...]
    visits: tuple[Visit, ...]
    waiting: tuple[Job, ...]
    n_quiet: int
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
        newest = max(train.on for train in self.stale)
        return Finding(
            "plan-stale",
            names=_names(self.stale),
            days=thousands((self.today - newest).days),
            newest=newest,
            today=str(newest + timedelta(days=1)),
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row for each job; dates in ISO 8601, empty if there is none.

        Unknown parts come first, then visits, then parts that wait.
        """
        pairs = [(job, visit) for visit in self.visits for job in visit.jobs]
        unknown, waiting = ([(job, None) for job in jobs] for jobs in (self.unknown, self.waiting))
        return [self._row(job, visit) for job, visit in (*unknown, *pairs, *waiting)]

    def _row(self, job: Job, visit: Visit | None) -> dict[str, Any]:
        part = job.part
        row: dict[str, Any] = {
            "train": part.train,
            "car": part.car,
            "suspension": part.suspension,
            "parameter": part.parameter,
            "part": part_words(part.parameter),
            "what": job.what,
            "visit": "",
            "urgency": UNKNOWN if part.unknown else "",
            "severity": str(part.severity),
            "unknown": part.unknown,
            "passed": job.is_passed,
            "day": "",
            "decide_by": "",
            "mileage_km": np.nan,
            "probability": job.probability,
            "passing_from": self._day_after(job.passing_days[0]),
            "passing_to": self._day_after(job.passing_days[1]),
        }
        if visit is not None:
            km = visit.mileage_km
            row |= {
                "visit": visit.words_of(job),
                "urgency": visit.urgency_of(job),
                "day": visit.day.isoformat(),
                "decide_by": visit.decide_by.isoformat(),
                "mileage_km": round(km) if math.isfinite(km) else km,
            }
        return row

    def _day_after(self, days: float) -> str:
        """Return the date `days` after today; empty if it is unknown or exceeds ``date.max``."""
        is_day = days < (date.max - self.today).days
        return (self.today + timedelta(days=days)).isoformat() if is_day else ""

    @property
    def summary(self) -> str:
        """Trips that are too old, numbers of visits and jobs, and assumed mileages."""
        words = Finding(
            "plan",
            visits=Finding("visits", n=len(self.visits)),
            jobs=Finding("jobs", n=sum(len(visit.jobs) for visit in self.visits)),
            day=self.horizon,
            waiting=Finding("maybe-later", n=len(self.waiting)),
            quiet=Finding("need-nothing", n=self.n_quiet),
        )
        if self.unknown:
            words = Finding("plan-unknown", n=len(self.unknown), words=words)
        return together((self.stale_words, words, self.assumed_words), " ")

    def __str__(self) -> str:
        """Return the plan as a text table, and a line on the first part that needs work later."""
        lines, table, before = [self.summary], [], None
        for row in joined(row for row in self.rows() if row["what"] != WAIT):
            km = number(row["mileage_km"], 0) if row["day"] else ""
            visit = [row["train"], row["urgency"], row["day"], km]
            failure = "passed" if row["passed"] else f"{100 * row['probability']:.1f} %"
            # a visit is named once, before its first job
            shown = visit if visit != before else [""] * len(visit)
            table.append([*shown, _words(row), UNKNOWN if row["unknown"] else failure])
            before = visit
        if table:
            head = ("train", "urgency", "latest", "at km", "what", "failure before")
            lines.append(tabulate(table, head, tablefmt="github", disable_numparse=True))
        if self.waiting:
            first = self.waiting[0]
            chance = f"{100 * first.probability:.1f} % until {self.horizon}"
            lines.append(f"First of those that may: {first.part}; {chance}.")
        return "\n".join(lines)


def _names(trains: Sequence[Train]) -> str:
    names = ", ".join(train.name for train in trains[:MOST_NAMED])
    n_more = len(trains) - MOST_NAMED
    return Finding("and-more", names=names, n=n_more) if n_more > 0 else names


def joined(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of a plan, with unknown parts of a suspension with the same reason merged.

    Each row gets a list of its parameters as "parameters".
    """
    merged: dict[tuple[Any, ...], dict[str, Any]] = {}
    for i, row in enumerate(rows):
        where = row["train"], row["car"], row["suspension"]
        alike = (*where, row["unknown"], row["severity"], row["day"]) if row["unknown"] else (i,)
        merged.setdefault(alike, {**row, "parameters": []})["parameters"].append(row["parameter"])
    return list(merged.values())


def _words(row: Mapping[str, Any]) -> str:
    """Return work and part, without its train, and why its life is unknown."""
    car = f"car {row['car']}" if row["car"] else ""
    parts = map(part_words, condensed(row["parameters"]))
    where = ", ".join(filter(None, (car, row["suspension"], *parts)))
    what = "" if row["what"] == UNKNOWN else f"{row['what']} "
    return f"{what}{where}" + (f": {row['unknown']}" if row["unknown"] else "")
