"""A plan for a fleet: parts to inspect or replace, and when, bundled into visits."""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import astuple, replace
from datetime import date, timedelta
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import ESTIMATED, Severity
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import thousands
from suspnet.maintenance.schedule import (
    SLACK,
    SOON_DAYS,
    UNKNOWN,
    URGENCIES,
    Job,
    Part,
    Plan,
    Train,
    Visit,
)
from suspnet.maintenance.state import State
from suspnet.maintenance.visit_costs import (
    REPLACE,
    PartCosts,
    PlanSettings,
    choose_dates,
    part_costs,
)

WORK = ("replace", "inspect")
"""Texts for the rows of ``PartCosts.work``."""
WAIT = "plan again"
"""Text for a part without a visit before the horizon."""
N_COARSE = 24
"""Number of dates between the horizon and the end of a usual life; a part served there waits."""
WINDOW_DAYS = 180
"""Number of latest days whose trips determine the mileage per day of a train."""
LEAST_DAYS = 14
"""Fewest days that the trips must span to determine the mileage per day of a train."""


def make_plan(
    parts: Sequence[Part], trains: Sequence[Train], settings: PlanSettings, today: date
) -> Plan:
    """Return the plan of visits with the least expected cost, for each train separately.

    A part whose alarm is "act" is visited on the first possible date. A part with a notice, for
    which no visit before the horizon would pay off, is visited within `notice_days`, together with
    other parts if possible. All other parts are visited when it costs least, or not at all if
    waiting costs least.

    `parts` and `trains` are those of the whole fleet, in any order. ValueError is raised if a part
    occurs twice, its train is missing or given twice, or `costs` lacks a parameter.
    """
    named = {train.name: train for train in trains}
    if len(named) < len(trains):
        raise ValueError(f"`trains` must have different names, got {[one.name for one in trains]}")
    groups: dict[str, list[Part]] = defaultdict(list)
    seen: set[tuple[str, ...]] = set()
    for part in parts:
        key = (*part.place, part.parameter)
        if key in seen:
            raise ValueError(f"`parts` must name each part once, got {part} twice")
        if part.train not in named:
            raise ValueError(f"`trains` must hold the train of each part, not that of {part}")
        seen.add(key)
        groups[part.train].append(part)
    stale = tuple(one for one in trains if one.age_days(today) > settings.stale_days)
    for train in stale:
        if own := groups.get(train.name):
            groups[train.name] = [_of_unknown_life(part, train, today) for part in own]
    planned = [_Calendar(named[one], groups[one], settings, today) for one in sorted(groups)]
    horizon = today + timedelta(days=settings.horizon_days)
    assumed = tuple(one for one in trains if one.is_assumed and one not in stale)
    empty = Plan(today, horizon, (), (), (), 0, 0.0, 0.0, settings.level, assumed, stale)
    return join_plans([empty, *(one.plan(horizon) for one in planned)])


def join_plans(plans: Sequence[Plan]) -> Plan:
    """Return one plan from plans of different trains, of the same days and level."""
    if len({(plan.today, plan.horizon, plan.level) for plan in plans}) != 1:
        raise ValueError("plans to be joined must be of the same days and level")
    unknown, visits, waiting, assumed, stale = (
        tuple(chain.from_iterable(getattr(plan, name) for plan in plans))
        for name in ("unknown", "visits", "waiting", "assumed", "stale")
    )
    return Plan(
        plans[0].today,
        plans[0].horizon,
        tuple(sorted(unknown, key=lambda job: job.part.place)),
        tuple(
            sorted(
                visits, key=lambda one: (one.urgency_of(one.jobs[0]) != UNKNOWN, one.day, one.train)
            )
        ),
        tuple(sorted(waiting, key=lambda job: (job.plan_again_km, str(job.part)))),
        sum(plan.n_quiet for plan in plans),
        sum(plan.objective for plan in plans),
        sum(plan.bound for plan in plans),
        plans[0].level,
        assumed,
        stale,
    )


def _of_unknown_life(part: Part, train: Train, today: date) -> Part:
    """Return a part of a train whose newest trip is too old: only its severity plans its visit."""
    why = Finding("newest-trip-old", days=thousands(train.age_days(today)))
    return replace(part, samples_km=np.array([np.inf]), unknown=why)


class _Calendar:
    """The parts of one train, and the possible days of its visits.

    `days`, (n_dates,), count from today, from the lead time to the end of a usual life at `end_km`;
    those from index `n_near` on are coarse and beyond the horizon. `prices`, (n_dates,), are those
    of a visit, V(t) of ``part_costs``.
    """

    def __init__(
        self, train: Train, parts: Sequence[Part], settings: PlanSettings, today: date
    ) -> None:
        self.train, self.parts, self.settings, self.today = train, parts, settings, today
        self.end_km = max(settings.of(part.parameter).usual_life_km for part in parts)
        end_days = self.end_km / train.km_per_day
        near = np.arange(settings.lead_days, settings.horizon_days, settings.step_days)
        near = np.unique(np.ceil(near))  # whole days, none before the lead time has passed
        self.days = near = near[: max(1, int(np.searchsorted(near, end_days)))]
        self.n_near = near.size
        if end_days > settings.horizon_days:
            far = np.geomspace(settings.horizon_days, end_days, N_COARSE + 1)[:-1]
            self.days = np.append(near, far)
        self.prices = settings.visit * np.clip(1 - self.days / end_days, 0, None)

    def plan(self, horizon: date) -> Plan:
        """Return the plan for this train, with the horizon as a date."""
        tables = [self._table(part) for part in self.parts]
        costs = np.stack(list(map(self._allowed, tables, self.parts)))
        dates, served, bound = choose_dates(costs, self.prices)
        jobs = list(map(self._job, self.parts, tables, served))
        visits = []
        for at in (one for one in dates if one < self.n_near):
            chosen = [j for j, one in enumerate(served) if one == at]
            visits.append(self._visit(at, [jobs[j] for j in chosen], costs[chosen]))
        rest = [job for job, at in zip(jobs, served, strict=True) if at >= self.n_near]
        unknown = tuple(job for job in rest if job.part.unknown)
        waiting = tuple(
            job
            for job in rest
            if not job.part.unknown and (job.probability or job.part.severity >= Severity.NOTICE)
        )
        n_quiet = len(rest) - len(unknown) - len(waiting)
        objective = float(self.prices[dates].sum() + costs[np.arange(len(jobs)), served].sum())
        shown = unknown, tuple(visits), waiting, n_quiet
        return Plan(self.today, horizon, *shown, objective, bound, self.settings.level)

    def _to_go(self, part: Part) -> FloatArray:
        """Return the samples of a part as mileages from today, [km]."""
        run = self.train.mileage_at(self.today) - part.mileage_km
        return np.clip(part.samples_km - run, 0, None)

    def _table(self, part: Part) -> PartCosts:
        dates_km = self.train.km_per_day * self.days
        costs = self.settings.of(part.parameter)
        return part_costs(self._to_go(part), dates_km, self.settings.visit, self.end_km, costs)

    def _allowed(self, table: PartCosts, part: Part) -> FloatArray:
        """Return the costs at each date and of no visit, infinite where the severity forbids it."""
        costs = table.least
        if part.severity == Severity.ACT:
            costs[1:] = np.inf
        elif part.severity == Severity.NOTICE:
            # within notice_days unless a visit for this part alone pays off before the horizon
            alone = costs + np.append(self.prices, 0.0)
            if alone[: self.n_near].min() >= alone[self.n_near :].min():
                within = np.searchsorted(self.days, self.settings.notice_days, side="right")
                costs[max(1, within) :] = np.inf
        return costs

    def _job(self, part: Part, table: PartCosts, at: int) -> Job:
        """Return the job of a part at a date; it waits if the date is beyond the horizon."""
        settings, samples = self.settings, self._to_go(part)
        costs, pace = settings.of(part.parameter), self.train.km_per_day
        nothing = np.nan, (np.nan, np.nan)
        tail = (1 - settings.level) / 2
        ends = np.quantile(samples, [tail, 1 - tail], method="inverted_cdf") / pace
        passing = float(ends[0]), float(ends[1])
        if at < self.n_near:
            what = int(table.work[:, at].argmin())
            price, unused = costs.inspection, np.nan
            if what == REPLACE:
                left = np.minimum(samples, costs.usual_life_km) - pace * self.days[at]
                price, unused = costs.replacement, float(np.clip(left, 0, None).mean())
            if part.unknown:
                return Job(part, WORK[what], *nothing, price)
            cost = price + float(table.failing[at])
            # a limit passed before today counts, though the first visit is in time for its failure
            probability = float((samples <= pace * self.days[at]).mean())
            return Job(part, WORK[what], probability, passing, cost, unused)
        if part.unknown:
            return Job(part, UNKNOWN, *nothing, np.nan)
        horizon_km = pace * settings.horizon_days
        safe = np.quantile(samples, settings.plan_again_risk, method="lower")
        again = float(np.clip(safe - pace * settings.lead_days, 0, horizon_km))
        risk = float(table.failing[self.n_near - 1])
        return Job(part, WAIT, float((samples <= horizon_km).mean()), passing, risk, np.nan, again)

    def _visit(self, at: int, jobs: Sequence[Job], costs: FloatArray) -> Visit:
        """Return the visit at a date; `costs` of its jobs are of shape (n_jobs, n_dates + 1)."""
        totals = costs[:, : self.n_near].sum(axis=0) + self.prices[: self.n_near]
        too_expensive = np.flatnonzero(totals[at:] > totals[at] + SLACK * self.settings.visit)
        latest = at + int(too_expensive[0]) - 1 if too_expensive.size else self.n_near - 1
        day, last = (self.today + timedelta(days=float(self.days[i])) for i in (at, latest))
        decide_by = last - timedelta(days=self.settings.lead_days)
        soon = (decide_by - self.today).days <= SOON_DAYS
        is_known = self.train.age_days(self.today) <= self.settings.stale_days
        return Visit(
            self.train.name,
            day,
            last,
            self.train.mileage_at(day) if is_known else np.nan,
            self.train.mileage_at(last) if is_known else np.nan,
            decide_by,
            URGENCIES[1 if at == 0 else 2 if soon else 3],
            tuple(sorted(jobs, key=_likeliest_first)),
            self.settings.visit + sum(job.expected_cost for job in jobs),
        )


def _likeliest_first(job: Job) -> tuple[bool, float, str]:
    """Return the key that sorts jobs: unknown parts first, then by probability of failure."""
    probability = 0.0 if job.part.unknown else -job.probability
    return not job.part.unknown, probability, str(job.part)


class Planner:
    """Plans the visits of a fleet, each train separately, and caches the plans of trains."""

    def __init__(self, settings: PlanSettings) -> None:
        self.settings = settings
        self._made: dict[str, tuple[list[State], Plan]] = {}

    def plan(self, states: Sequence[State], today: date) -> Plan:
        """Return the plan of ``make_plan`` for a fleet.

        A train is replanned if one of its states is another object than in the last call, or the
        day is another one.
        """
        of_train: dict[str, list[State]] = {}
        for state in states:
            of_train.setdefault(train_of(state), []).append(state)
        self._made = {name: self._of(name, own, today) for name, own in sorted(of_train.items())}
        nothing = make_plan([], [], self.settings, today)
        return join_plans([nothing, *(plan for _, plan in self._made.values())])

    def _of(self, name: str, states: list[State], today: date) -> tuple[list[State], Plan]:
        known = self._made.get(name)
        if known is not None and known[1].today == today and _same_objects(states, known[0]):
            return known
        trains = trains_of(states, today, self.settings.km_per_day)
        return states, make_plan(parts_of(states), trains, self.settings, today)


def _same_objects(states: Sequence[State], others: Sequence[State]) -> bool:
    return len(states) == len(others) and all(map(operator.is_, states, others))


def parts_of(states: Sequence[State]) -> list[Part]:
    """Return a part for each parameter of each suspension that has an alarm or limits."""
    found = []
    for state in states:
        named = {*state.lives, *state.unknown, *(one.parameter for one in state.alarms)}
        for name in (one for one in ESTIMATED if one in named):
            life = state.lives.get(name)
            samples = np.array([np.inf]) if life is None else life.samples_km
            place = state.series.place
            found.append(
                Part(
                    train_of(state),
                    suspension_of(state),
                    name,
                    samples,
                    float(np.nan_to_num(state.last_km)),  # NaN only if no remaining life is known
                    state.severities.get(name, Severity.NONE),
                    place.car,
                    state.unknown.get(name, "" if life else "it has no limits"),
                )
            )
    return found


def trains_of(states: Sequence[State], today: date, default_km_per_day: float) -> list[Train]:
    """Return each train, with the mileage of its newest trip and its mileage per day.

    A trip without a start is assumed to be of today. A train without any mileage is at 0 km: the
    remaining lives of its parts are unknown, so it has no visits.
    """
    of_train = defaultdict(list)
    for state in states:
        of_train[train_of(state)].append(state.series)
    found = []
    for name, several in sorted(of_train.items()):
        km = np.concatenate([one.mileage_km for one in several])
        starts = np.concatenate([one.start for one in several])
        order = np.argsort(km, kind="stable")[: int(np.isfinite(km).sum())]
        if not len(order):
            found.append(Train(name, 0.0, today, default_km_per_day))
            continue
        km, starts = km[order], starts[order]
        day = today if np.isnat(starts[-1]) else starts[-1].item().date()
        pace = km_per_day(starts, km, np.nan)
        is_assumed = bool(np.isnan(pace))
        pace = default_km_per_day if is_assumed else pace
        found.append(Train(name, float(km[-1]), min(day, today), pace, is_assumed))
    return found


def train_of(state: State) -> str:
    """Return the name of a suspension's train, or where that is not named, its vehicle and place.

    That place has no bogie and side: both bogies of a car are in one train.
    """
    place = state.series.place
    if place.train:
        return place.train
    car = replace(place, bogie="", side="")
    return f"{state.series.vehicle}: {car}" if any(astuple(car)) else state.series.vehicle


def suspension_of(state: State) -> str:
    """Return the name of a suspension within its car."""
    place = state.series.place
    where = (place.suspension, place.bogie and f"{place.bogie} bogie", place.side)
    return ", ".join(filter(None, where)) or state.series.vehicle


def place_of(state: State) -> tuple[str, str, str]:
    """Return train, car and suspension, as ``Part.place``."""
    return train_of(state), state.series.place.car, suspension_of(state)


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
