"""A plan for a fleet: which parts to inspect or replace, until when, bundled into visits.

A part is due on the last day on which the probability that its limit is passed is at most the
accepted risk; with an alarm "act" it is due on the first possible day, with a notice at the latest
after ``NOTICE_DAYS``. The first due part of a train sets the day of a visit, and all parts that are
due within `bundle_days` after it are done at it. A part that is more likely than not to pass its
limit within ``REACH_KM`` after the visit is replaced, any other one is inspected.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from datetime import date, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import ESTIMATED, Severity, part_words
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import natural, thousands
from suspnet.trains.maintenance.state import WINDOW_DAYS, State

URGENCIES = UNKNOWN, NOW, SOON, LATER = "unknown", "now", "soon", "later"
"""Urgencies of jobs: remaining life unknown, visit on the first possible day, visit to be decided
on within ``SOON_DAYS``, any other visit."""
SOON_DAYS = 30
REPLACE, INSPECT = "replace", "inspect"  # what is done with a part
NEVER = np.array([np.inf])  # samples of the remaining life of a part whose life is unknown
LEAST_DAYS = 14  # fewest days that the trips must span to determine the mileage per day of a train
REACH_KM = 50_000.0
"""Mileage after a visit within which a part that is likely to pass its limit is replaced."""
NOTICE_DAYS = 90.0  # days within which a notice is inspected if no limit is predicted to be passed
PASSED = 0.9  # least share of samples in which a limit is passed already for it to count as passed
MOST_NAMED = 3  # largest number of trains that a sentence names


@dataclass(frozen=True)
class PlanSettings:
    """Days and risks of a plan; TypeError or ValueError if one is out of range."""

    risk: float = setting(
        0.02, "Probability of passing a limit that is accepted before a visit", above=0, below=1
    )
    bundle_days: float = setting(
        90.0, "Days by which a job comes earlier to share the visit of another one", "days", low=0
    )
    lead_days: float = setting(
        14.0, "Days from today until the first possible visit", "days", low=0
    )
    horizon_days: float = setting(
        730.0,
        "Days from today until the last date that is planned",
        above=0,
        high=36_525.0,
        rule="days; above lead_days, at most 36525",
    )
    km_per_day: float = setting(
        500.0, "Daily mileage of trains whose trips do not determine it", "km", above=0
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if self.horizon_days <= self.lead_days:
            raise ValueError(
                f"`horizon_days` must be > `lead_days` ({self.lead_days:g}), "
                f"got {self.horizon_days:g}"
            )


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
    """Work on one part at a visit, or a part of unknown remaining life without one.

    `what` is replace, inspect, or "unknown" without a visit. `probability` is that of passing the
    limit before the visit, NaN if the remaining life is unknown; `is_passed` whether it is already.
    """

    part: Part
    what: str
    probability: float
    is_passed: bool = False

    @property
    def order(self) -> tuple[bool, float, str]:
        """Key that sorts jobs: unknown parts first, then by probability of failure."""
        is_known = not self.part.unknown
        return is_known, -self.probability if is_known else 0.0, str(self.part)


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
    parts without a visit whose remaining life is unknown; `n_quiet` counts the other parts, which
    need nothing before the horizon. The mileage per day of trains in `assumed` is assumed; the
    newest trip of those in `stale` is too old to plan by, so that the lives of their parts are
    unknown.
    """

    today: date
    horizon: date
    unknown: tuple[Job, ...]
    visits: tuple[Visit, ...]
    n_quiet: int
    assumed: tuple[Train, ...] = ()
    stale: tuple[Train, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row for each job, unknown parts first, then by visit.

        Dates are in ISO 8601, empty if there is none.
        """
        unknown = [self._row(job, None) for job in self.unknown]
        return unknown + [self._row(job, visit) for visit in self.visits for job in visit.jobs]

    def _row(self, job: Job, visit: Visit | None) -> dict[str, Any]:
        part, km = job.part, visit.mileage_km if visit else np.nan
        return {
            "train": part.train,
            "car": part.car,
            "suspension": part.suspension,
            "parameter": part.parameter,
            "part": part_words(part.parameter),
            "what": job.what,
            "visit": visit.words_of(job) if visit else "",
            "urgency": visit.urgency_of(job) if visit else UNKNOWN if part.unknown else "",
            "severity": str(part.severity),
            "unknown": part.unknown,
            "passed": job.is_passed,
            "day": visit.day.isoformat() if visit else "",
            "decide_by": visit.decide_by.isoformat() if visit else "",
            "mileage_km": round(km) if math.isfinite(km) else km,
            "probability": job.probability,
        }

    @property
    def summary(self) -> str:
        """Trips that are too old, numbers of visits and jobs, and assumed mileages."""
        words = Finding(
            "plan",
            visits=Finding("visits", n=len(self.visits)),
            jobs=Finding("jobs", n=sum(len(visit.jobs) for visit in self.visits)),
            day=self.horizon,
            quiet=Finding("need-nothing", n=self.n_quiet),
        )
        if self.unknown:
            words = Finding("plan-unknown", n=len(self.unknown), words=words)
        sentences = [words]
        if self.stale:  # with what to do: plan as of the day after the newest trip
            newest = max(train.on for train in self.stale)
            names, days = _names(self.stale), thousands((self.today - newest).days)
            day = str(newest + timedelta(days=1))
            old = Finding("plan-stale", names=names, days=days, newest=newest, today=day)
            sentences.insert(0, old)
        if self.assumed:
            names, km_per_day = _names(self.assumed), self.assumed[0].km_per_day
            sentences.append(Finding("plan-assumed", names=names, km_per_day=km_per_day))
        return together(sentences, " ")


def _names(trains: Sequence[Train]) -> str:
    names = ", ".join(train.name for train in trains[:MOST_NAMED])
    n_more = len(trains) - MOST_NAMED
    return Finding("names-and-more", names=names, n=n_more) if n_more > 0 else names


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


def make_plan(
    parts: Sequence[Part], trains: Sequence[Train], settings: PlanSettings, today: date
) -> Plan:
    """Return the plan of a fleet's visits, for each train separately.

    `parts` and `trains` are those of the whole fleet, in any order. ValueError is raised if the
    train of a part is missing.
    """
    named = {train.name: train for train in trains}
    of_train: dict[str, list[Part]] = defaultdict(list)
    for part in parts:
        if part.train not in named:
            raise ValueError(f"`trains` must hold the train of each part, not that of {part}")
        of_train[part.train].append(part)

    # trains do not share visits
    visits: list[Visit] = []
    unknown: list[Job] = []
    n_quiet = 0
    for name, parts_of_train in sorted(of_train.items(), key=lambda item: natural(item[0])):
        calendar = _Calendar(named[name], settings, today)
        due = [(calendar.due_day(part), part) for part in map(calendar.as_known, parts_of_train)]
        rest = [part for days, part in due if days >= settings.horizon_days]
        unknown += [calendar.job(part, UNKNOWN, 0.0) for part in rest if part.unknown]
        n_quiet += sum(not part.unknown for part in rest)
        remaining = [pair for pair in due if pair[0] < settings.horizon_days]
        while remaining:  # ends: the part that is due first is taken off
            day = min(days for days, _ in remaining)
            last = day + settings.bundle_days
            visits.append(
                calendar.visit(int(day), [part for days, part in remaining if days <= last])
            )
            remaining = [pair for pair in remaining if pair[0] > last]

    # what is not known first, then what is soonest or likeliest
    unknown.sort(key=lambda job: job.part.place)
    visits.sort(key=lambda visit: (visit.urgency_of(visit.jobs[0]) != UNKNOWN, visit.day))
    stale = tuple(train for train in trains if _is_stale(train, today))
    return Plan(
        today,
        today + timedelta(days=settings.horizon_days),
        tuple(unknown),
        tuple(visits),
        n_quiet,
        tuple(train for train in trains if train.is_assumed and train not in stale),
        stale,
    )


def _is_stale(train: Train, today: date) -> bool:
    return (today - train.on).days > WINDOW_DAYS


@dataclass(frozen=True)
class _Calendar:
    """The visits of one train; days count from today."""

    train: Train
    settings: PlanSettings
    today: date

    def as_known(self, part: Part) -> Part:
        """Return the part as far as it is known: not its life if the newest trip is too old."""
        if not _is_stale(self.train, self.today):
            return part
        days = thousands((self.today - self.train.on).days)
        return replace(part, samples_km=NEVER, unknown=Finding("newest-trip-old", days=days))

    def due_day(self, part: Part) -> float:
        """Return the last day for a visit of a part, inf if it needs none."""
        first_day = math.ceil(self.settings.lead_days)
        if part.severity == Severity.ACT:
            return first_day
        samples = np.sort(self._to_go(part))
        last_km = samples[int(self.settings.risk * samples.size)]
        # a day earlier than that on which the risk would be exceeded
        days = np.ceil(last_km / self.train.km_per_day) - 1
        if part.severity == Severity.NOTICE and days >= self.settings.horizon_days:
            days = NOTICE_DAYS
        return float(max(days, first_day))

    def _to_go(self, part: Part) -> FloatArray:
        """Return the samples of a part as mileages from today, [km]."""
        run = self.train.mileage_at(self.today) - part.mileage_km
        return np.clip(part.samples_km - run, 0, None)

    def job(self, part: Part, what: str, day: float) -> Job:
        """Return the job on a part until a day."""
        if part.unknown:
            return Job(part, what, np.nan, bool((part.samples_km == 0).all()))
        samples = self._to_go(part)
        probability = float((samples <= self.train.km_per_day * day).mean())
        return Job(part, what, probability, bool((samples == 0).mean() >= PASSED))

    def visit(self, days: int, parts: Sequence[Part]) -> Visit:
        """Return the visit after some days at which these parts are done."""
        reach_km = self.train.km_per_day * days + REACH_KM
        likely = [(self._to_go(part) <= reach_km).mean() > 0.5 for part in parts]
        works = [REPLACE if is_likely else INSPECT for is_likely in likely]
        jobs = [self.job(part, work, days) for part, work in zip(parts, works, strict=True)]
        day = self.today + timedelta(days=days)
        decide_by = day - timedelta(days=self.settings.lead_days)
        is_soon = (decide_by - self.today).days <= SOON_DAYS
        return Visit(
            self.train.name,
            day,
            np.nan if _is_stale(self.train, self.today) else self.train.mileage_at(day),
            decide_by,
            NOW if days <= math.ceil(self.settings.lead_days) else SOON if is_soon else LATER,
            tuple(sorted(jobs, key=lambda job: job.order)),
        )


def plan_of(states: Sequence[State], settings: PlanSettings, today: date) -> Plan:
    """Return the plan of a fleet from the states of its suspensions.

    It has a part for each parameter of each suspension that has an alarm or limits.
    """
    parts = []
    for state in states:
        train, car, suspension = place_of(state)
        named = {*state.lives, *state.unknown, *(alarm.parameter for alarm in state.alarms)}
        for name in (name for name in ESTIMATED if name in named):
            life = state.lives.get(name)
            samples_km = life.samples_km if life else NEVER
            last_km = float(np.nan_to_num(state.last_km))  # NaN only if no remaining life is known
            severity = state.severities.get(name, Severity.NONE)
            unknown = state.unknown.get(name, "" if life else "it has no limits")
            parts.append(Part(train, suspension, name, samples_km, last_km, severity, car, unknown))
    return make_plan(parts, trains_of(states, today, settings.km_per_day), settings, today)


def trains_of(states: Sequence[State], today: date, default_km_per_day: float) -> list[Train]:
    """Return each train, with the mileage of its newest trip and its mileage per day.

    A trip without a start is assumed to be of today. A train without any mileage is at 0 km: the
    remaining lives of its parts are unknown, so it has no visits.
    """
    of_train = defaultdict(list)
    for state in states:
        of_train[place_of(state)[0]].append(state.newest_trips)
    trains = []
    for name, several in sorted(of_train.items()):
        starts, km = (np.concatenate(columns) for columns in zip(*several, strict=True))
        order = np.argsort(km, kind="stable")
        if not len(order):
            trains.append(Train(name, 0.0, today, default_km_per_day))
            continue
        km, starts = km[order], starts[order]
        day = today if np.isnat(starts[-1]) else starts[-1].item().date()
        pace = km_per_day(starts, km)
        is_assumed = bool(np.isnan(pace))
        pace = default_km_per_day if is_assumed else pace
        trains.append(Train(name, float(km[-1]), min(day, today), pace, is_assumed))
    return trains


def place_of(state: State) -> tuple[str, str, str]:
    """Return train, car and suspension, as ``Part.place``.

    A train that is not named is the vehicle and the place without bogie and side: both bogies of a
    car are in one train.
    """
    vehicle, place = state.key
    car = replace(place, bogie="", side="")
    train = place.train or (f"{vehicle}: {car}" if any(astuple(car)) else vehicle)
    where = (place.suspension, place.bogie and f"{place.bogie} bogie", place.side)
    return train, place.car, ", ".join(filter(None, where)) or vehicle


def km_per_day(starts: NDArray[np.datetime64], mileages_km: FloatArray) -> float:
    """Return the mileage of a train per day, from starts and mileages of its newest trips.

    `starts` (NaT: unknown) and `mileages_km` (NaN: unknown): (n_trips,). NaN is returned if
    these trips span less than ``LEAST_DAYS`` or their mileage does not rise.
    """
    is_known = ~np.isnat(starts) & np.isfinite(mileages_km)
    days, mileages = starts[is_known].astype("datetime64[D]").astype(float), mileages_km[is_known]
    if not days.size:
        return math.nan
    new = days >= days.max() - WINDOW_DAYS
    span = np.ptp(days[new])
    run = mileages[new][days[new].argmax()] - mileages[new][days[new].argmin()]
    return float(run / span) if span >= LEAST_DAYS and run > 0 else math.nan
