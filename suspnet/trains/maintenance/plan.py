"""A plan for a fleet: which parts to inspect or replace, until when, bundled into visits.

A part is due on the last day on which the probability that its limit is passed is at most the
accepted risk; with an alarm "act" it is due on the first possible day, with a notice at the latest
after `notice_days`. The first due part of a train sets the day of a visit, and all parts that are
due within `bundle_days` after it are done at it. A part that is more likely than not to pass its
limit within `reach_km` after the visit is replaced, any other one is inspected.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from datetime import date, timedelta

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import ESTIMATED, Severity
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import thousands
from suspnet.trains.maintenance.life import SHOWN_LEVEL
from suspnet.trains.maintenance.schedule import (
    LATER,
    NOW,
    SOON,
    SOON_DAYS,
    UNKNOWN,
    WAIT,
    Job,
    Part,
    Plan,
    Train,
    Visit,
)
from suspnet.trains.maintenance.state import State

REPLACE, INSPECT = "replace", "inspect"
NEVER = np.array([np.inf])
"""Samples of the remaining life of a part whose life is unknown."""
MOST_DAYS = 36_525.0
"""Longest horizon, a century, [days]."""
WINDOW_DAYS = 180
"""Number of latest days whose trips determine the mileage per day of a train; if its newest trip is
older, its wear and mileage count as unknown."""
LEAST_DAYS = 14
"""Fewest days that the trips must span to determine the mileage per day of a train."""


@dataclass(frozen=True)
class PlanSettings:
    """Days and risks of a plan; TypeError or ValueError if one is out of range."""

    risk: float = setting(
        0.02, "Probability of passing a limit that is accepted before a visit", above=0, below=1
    )
    bundle_days: float = setting(
        90.0, "Days by which a job comes earlier to share the visit of another one", "days", low=0
    )
    reach_km: float = setting(
        50_000.0,
        "Mileage after a visit within which a part must be likely to pass its limit to be replaced "
        "and not inspected",
        "km",
        low=0,
    )
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
    notice_days: float = setting(
        90.0,
        "Days within which a notice is inspected if no limit is predicted to be passed",
        "days",
        low=0,
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


def make_plan(
    parts: Sequence[Part], trains: Sequence[Train], settings: PlanSettings, today: date
) -> Plan:
    """Return the plan of a fleet's visits, for each train separately.

    `parts` and `trains` are those of the whole fleet, in any order. ValueError is raised if a part
    occurs twice, or its train is missing or given twice.
    """
    # each part once, with its train
    named = {train.name: train for train in trains}
    if len(named) < len(trains):
        raise ValueError(f"`trains` must have different names, got {[t.name for t in trains]}")
    parts_of_train: dict[str, list[Part]] = defaultdict(list)
    seen: set[tuple[str, ...]] = set()
    for part in parts:
        key = (*part.place, part.parameter)
        if key in seen:
            raise ValueError(f"`parts` must name each part once, got {part} twice")
        if part.train not in named:
            raise ValueError(f"`trains` must hold the train of each part, not that of {part}")
        seen.add(key)
        parts_of_train[part.train].append(part)

    # trains do not share visits
    visits: list[Visit] = []
    rest: list[Job] = []
    for name, own in sorted(parts_of_train.items()):
        calendar = _Calendar(named[name], settings, today)
        due = [(calendar.due_day(part), part) for part in map(calendar.as_known, own)]
        visits += calendar.visits(due)
        rest += calendar.without_visit(due)

    # what is not known first, then what is soonest or likeliest
    unknown = sorted((job for job in rest if job.part.unknown), key=lambda job: job.part.place)
    waiting = sorted((j for j in rest if not j.part.unknown and j.probability), key=_likeliest)
    visits.sort(key=lambda visit: (visit.urgency_of(visit.jobs[0]) != UNKNOWN, visit.day))
    stale = tuple(train for train in trains if train.age_days(today) > WINDOW_DAYS)
    return Plan(
        today,
        today + timedelta(days=settings.horizon_days),
        tuple(unknown),
        tuple(visits),
        tuple(waiting),
        len(rest) - len(unknown) - len(waiting),
        SHOWN_LEVEL,
        tuple(train for train in trains if train.is_assumed and train not in stale),
        stale,
    )


@dataclass(frozen=True)
class _Calendar:
    """The visits of one train; days count from today."""

    train: Train
    settings: PlanSettings
    today: date

    @property
    def is_stale(self) -> bool:
        return self.train.age_days(self.today) > WINDOW_DAYS

    @property
    def first_day(self) -> int:
        return math.ceil(self.settings.lead_days)

    def visits(self, due: Sequence[tuple[float, Part]]) -> list[Visit]:
        """Return the visits of all parts that are due before the horizon, by day."""
        left = [pair for pair in due if pair[0] < self.settings.horizon_days]
        visits = []
        while left:  # ends: the part that is due first is taken off
            day = min(days for days, _ in left)
            last = day + self.settings.bundle_days
            visits.append(self._visit(int(day), [part for days, part in left if days <= last]))
            left = [pair for pair in left if pair[0] > last]
        return visits

    def without_visit(self, due: Sequence[tuple[float, Part]]) -> list[Job]:
        """Return the other parts, with the probability that their limit is passed until then."""
        horizon = self.settings.horizon_days
        return [
            self._job(part, UNKNOWN if part.unknown else WAIT, horizon)
            for days, part in due
            if days >= horizon
        ]

    def as_known(self, part: Part) -> Part:
        """Return the part as far as it is known: not its life if the newest trip is too old."""
        if not self.is_stale:
            return part
        why = Finding("newest-trip-old", days=thousands(self.train.age_days(self.today)))
        return replace(part, samples_km=NEVER, unknown=why)

    def due_day(self, part: Part) -> float:
        """Return the last day for a visit of a part, inf if it needs none."""
        if part.severity == Severity.ACT:
            return self.first_day
        samples = np.sort(self._to_go(part))
        last_km = samples[int(self.settings.risk * samples.size)]
        # a day earlier than that on which the risk would be exceeded
        days = np.ceil(last_km / self.train.km_per_day) - 1
        if part.severity == Severity.NOTICE and days >= self.settings.horizon_days:
            days = math.floor(self.settings.notice_days)
        return float(max(days, self.first_day))

    def _to_go(self, part: Part) -> FloatArray:
        """Return the samples of a part as mileages from today, [km]."""
        run = self.train.mileage_at(self.today) - part.mileage_km
        return np.clip(part.samples_km - run, 0, None)

    def _job(self, part: Part, what: str, day: float) -> Job:
        if part.unknown:
            return Job(part, what, np.nan, (np.nan, np.nan))
        samples, tail = self._to_go(part), (1 - SHOWN_LEVEL) / 2
        ends = np.quantile(samples, [tail, 1 - tail], method="inverted_cdf") / self.train.km_per_day
        probability = float((samples <= self.train.km_per_day * day).mean())
        return Job(part, what, probability, (float(ends[0]), float(ends[1])))

    def _visit(self, days: int, parts: Sequence[Part]) -> Visit:
        reach_km = self.train.km_per_day * days + self.settings.reach_km
        likely = [(self._to_go(part) <= reach_km).mean() > 0.5 for part in parts]
        works = [REPLACE if is_likely else INSPECT for is_likely in likely]
        jobs = [self._job(part, work, days) for part, work in zip(parts, works, strict=True)]
        day = self.today + timedelta(days=days)
        decide_by = day - timedelta(days=self.settings.lead_days)
        is_soon = (decide_by - self.today).days <= SOON_DAYS
        return Visit(
            self.train.name,
            day,
            np.nan if self.is_stale else self.train.mileage_at(day),
            decide_by,
            NOW if days <= self.first_day else SOON if is_soon else LATER,
            tuple(sorted(jobs, key=_likeliest)),
        )


def _likeliest(job: Job) -> tuple[bool, float, str]:
    """Return the key that sorts jobs: unknown parts first, then by probability of failure."""
    probability = 0.0 if job.part.unknown else -job.probability
    return not job.part.unknown, probability, str(job.part)


def plan_of(states: Sequence[State], settings: PlanSettings, today: date) -> Plan:
    """Return the plan of a fleet from the states of its suspensions."""
    return make_plan(
        parts_of(states), trains_of(states, today, settings.km_per_day), settings, today
    )


def parts_of(states: Sequence[State]) -> list[Part]:
    """Return a part for each parameter of each suspension that has an alarm or limits."""
    parts = []
    for state in states:
        train, car, suspension = place_of(state)
        named = {*state.lives, *state.unknown, *(alarm.parameter for alarm in state.alarms)}
        for name in (name for name in ESTIMATED if name in named):
            life = state.lives.get(name)
            parts.append(
                Part(
                    train,
                    suspension,
                    name,
                    life.samples_km if life else NEVER,
                    float(np.nan_to_num(state.last_km)),  # NaN only if no remaining life is known
                    state.severities.get(name, Severity.NONE),
                    car,
                    state.unknown.get(name, "" if life else "it has no limits"),
                )
            )
    return parts


def trains_of(states: Sequence[State], today: date, default_km_per_day: float) -> list[Train]:
    """Return each train, with the mileage of its newest trip and its mileage per day.

    A trip without a start is assumed to be of today. A train without any mileage is at 0 km: the
    remaining lives of its parts are unknown, so it has no visits.
    """
    of_train = defaultdict(list)
    for state in states:
        of_train[train_of(state)].append(state.series)
    trains = []
    for name, several in sorted(of_train.items()):
        km = np.concatenate([series.mileage_km for series in several])
        starts = np.concatenate([series.start for series in several])
        order = np.argsort(km, kind="stable")[: int(np.isfinite(km).sum())]
        if not len(order):
            trains.append(Train(name, 0.0, today, default_km_per_day))
            continue
        km, starts = km[order], starts[order]
        day = today if np.isnat(starts[-1]) else starts[-1].item().date()
        pace = km_per_day(starts, km, np.nan)
        is_assumed = bool(np.isnan(pace))
        pace = default_km_per_day if is_assumed else pace
        trains.append(Train(name, float(km[-1]), min(day, today), pace, is_assumed))
    return trains


def train_of(state: State) -> str:
    """Return the name of a suspension's train, or where that is not named, its vehicle and place.

    That place has no bogie and side: both bogies of a car are in one train.
    """
    place = state.series.place
    if place.train:
        return place.train
    car = replace(place, bogie="", side="")
    return f"{state.series.vehicle}: {car}" if any(astuple(car)) else state.series.vehicle


def place_of(state: State) -> tuple[str, str, str]:
    """Return train, car and suspension, as ``Part.place``."""
    place = state.series.place
    where = (place.suspension, place.bogie and f"{place.bogie} bogie", place.side)
    return train_of(state), place.car, ", ".join(filter(None, where)) or state.series.vehicle


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
    is_known = ~np.isnat(starts) & np.isfinite(mileages_km)
    days, mileages = starts[is_known].astype("datetime64[D]").astype(float), mileages_km[is_known]
    if not days.size:
        return default
    new = days >= days.max() - WINDOW_DAYS
    span = np.ptp(days[new])
    run = mileages[new][days[new].argmax()] - mileages[new][days[new].argmin()]
    return float(run / span) if span >= LEAST_DAYS and run > 0 else default
