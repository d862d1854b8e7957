"""A plan for a fleet: what to inspect or replace, where and until when, bundled into visits."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta

import numpy as np

from suspnet.ground.limits import Severity
from suspnet.ground.types import FloatArray
from suspnet.maintenance.plan_inputs import Part, PlanSettings, Train
from suspnet.maintenance.schedule import SLACK, SOON_DAYS, UNKNOWN, URGENCIES, Job, Plan, Visit
from suspnet.maintenance.visit_costs import REPLACE, PartCosts, choose_dates, part_costs

WORK = ("replace", "inspect")
"""Words for the rows of ``PartCosts.work``."""
WAIT = "plan again"
"""Word for a part that is at no visit before the horizon."""
N_COARSE = 24
"""Number of dates between the horizon and the end of a usual life, which make late parts wait."""


def make_plan(
    parts: Sequence[Part], trains: Sequence[Train], settings: PlanSettings, today: date
) -> Plan:
    """Return the visits that cost least, for each train by itself.

    A part whose alarm says "act" is seen to at the first possible visit. One with a notice, but no
    visit before the horizon that would pay, is seen to within `notice_days`, at a visit for others
    where there is one. All others are seen to when it costs least, at no visit if waiting does.

    Parameters
    ----------
    parts : sequence of Part
        Of the whole fleet, in any order.
    trains : sequence of Train
        Each that a part is of.
    settings : PlanSettings
    today : date

    Raises
    ------
    ValueError
        If a part occurs twice, its train is missing or given twice, or `costs` lacks a parameter.
    """
    named = {train.name: train for train in trains}
    if len(named) < len(trains):
        raise ValueError(f"`trains` must have different names, got {[one.name for one in trains]}")
    groups: dict[str, list[Part]] = defaultdict(list)
    seen: set[tuple[str, ...]] = set()
    for part in parts:
        key = (part.train, part.car, part.suspension, part.parameter)
        if key in seen:
            raise ValueError(f"`parts` must name each part once, got {part} twice")
        if part.train not in named:
            raise ValueError(f"`trains` must hold the train of each part, not that of {part}")
        seen.add(key)
        groups[part.train].append(part)
    planned = [_plan_train(named[name], groups[name], settings, today) for name in sorted(groups)]
    visits = tuple(visit for found in planned for visit in found[0])
    waiting = tuple(job for found in planned for job in found[1])
    unknown = tuple(job for found in planned for job in found[2])
    n_jobs = sum(len(visit.jobs) for visit in visits)
    n_quiet = len(parts) - n_jobs - len(waiting) - len(unknown)
    objective, bound = sum(found[3] for found in planned), sum(found[4] for found in planned)
    horizon = today + timedelta(days=settings.horizon_days)
    assumed = tuple(one for one in trains if one.is_assumed)
    shown = (unknown, visits, waiting, n_quiet)
    return _sorted(Plan(today, horizon, *shown, objective, bound, settings.level, assumed))


def join_plans(plans: Sequence[Plan]) -> Plan:
    """Return the plan for several fleets, from the plans for each by itself.

    Raises
    ------
    ValueError
        If there is none, or they are not of the same days and level.
    """
    if len({(plan.today, plan.horizon, plan.level) for plan in plans}) != 1:
        raise ValueError("plans to be joined must be of the same days and level")
    first = plans[0]
    return _sorted(
        Plan(
            first.today,
            first.horizon,
            tuple(job for plan in plans for job in plan.unknown),
            tuple(visit for plan in plans for visit in plan.visits),
            tuple(job for plan in plans for job in plan.waiting),
            sum(plan.n_quiet for plan in plans),
            sum(plan.objective for plan in plans),
            sum(plan.bound for plan in plans),
            first.level,
            tuple(train for plan in plans for train in plan.assumed),
        )
    )


def _sorted(plan: Plan) -> Plan:
    """Return a plan with unknown parts, visits and waiting jobs in order."""
    return replace(
        plan,
        unknown=tuple(sorted(plan.unknown, key=lambda job: job.part.place)),
        visits=tuple(
            sorted(
                plan.visits,
                key=lambda one: (one.urgency_of(one.jobs[0]) != UNKNOWN, one.day, one.train),
            )
        ),
        waiting=tuple(sorted(plan.waiting, key=lambda job: (job.plan_again_km, str(job.part)))),
    )


@dataclass(frozen=True, eq=False)
class _Calendar:
    """Possible days of visits of one train.

    Attributes
    ----------
    train : Train
    settings : PlanSettings
    today : date
    days : array of shape (n_dates,)
        From today; from `n_near` on beyond the horizon.
    n_near : int
    end_km : float, [km]
        From today until the end of a usual life.
    prices : array of shape (n_dates,)
        Of a visit at each date, V of ``part_costs``.
    """

    train: Train
    settings: PlanSettings
    today: date
    days: FloatArray
    n_near: int
    end_km: float
    prices: FloatArray

    def table(self, part: Part) -> PartCosts:
        """Return the expected costs of a part at each date."""
        dates_km = self.train.km_per_day * self.days
        costs = self.settings.of(part.parameter)
        return part_costs(self.to_go(part), dates_km, self.settings.visit, self.end_km, costs)

    def to_go(self, part: Part) -> FloatArray:
        """Return the samples of a part as mileages from today."""
        run = self.train.mileage_at(self.today) - part.mileage_km
        return np.clip(part.samples_km - run, 0, None)

    def allowed(self, table: PartCosts, severity: Severity) -> FloatArray:
        """Return the costs at each date and of no visit, infinite where the severity forbids it."""
        costs = table.least
        if severity == Severity.ACT:
            costs[1:] = np.inf
        elif severity == Severity.NOTICE:
            alone = costs + np.append(self.prices, 0.0)
            if alone[: self.n_near].min() >= alone[self.n_near :].min():
                within = np.searchsorted(self.days, self.settings.notice_days, side="right")
                costs[max(1, within) :] = np.inf
        return costs

    def job(self, part: Part, table: PartCosts, at: int) -> Job:
        """Return what is done to a part at a date; it waits if that is beyond the horizon."""
        settings, samples = self.settings, self.to_go(part)
        costs, pace = settings.of(part.parameter), self.train.km_per_day
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
                return Job(part, WORK[what], np.nan, (np.nan, np.nan), price)
            cost = price + float(table.failing[at])
            # with what was passed before today, though the first visit is in time for its failure
            probability = float((samples <= pace * self.days[at]).mean())
            return Job(part, WORK[what], probability, passing, cost, unused)
        if part.unknown:
            return Job(part, UNKNOWN, np.nan, (np.nan, np.nan), np.nan)
        horizon_km = pace * settings.horizon_days
        safe = np.quantile(samples, settings.plan_again_risk, method="lower")
        again = float(np.clip(safe - pace * settings.lead_days, 0, horizon_km))
        risk = float(table.failing[self.n_near - 1])
        return Job(part, WAIT, float((samples <= horizon_km).mean()), passing, risk, np.nan, again)

    def visit(self, at: int, jobs: Sequence[Job], costs: FloatArray) -> Visit:
        """Return the visit at a date, with its jobs and their `costs`, (n_jobs, n_dates + 1)."""
        totals = costs[:, : self.n_near].sum(axis=0) + self.prices[: self.n_near]
        dear = np.flatnonzero(totals[at:] > totals[at] + SLACK * self.settings.visit)
        latest = at + int(dear[0]) - 1 if dear.size else self.n_near - 1
        day, last = (self.today + timedelta(days=float(self.days[i])) for i in (at, latest))
        decide_by = last - timedelta(days=self.settings.lead_days)
        soon = (decide_by - self.today).days <= SOON_DAYS
        return Visit(
            self.train.name,
            day,
            last,
            self.train.mileage_at(day),
            self.train.mileage_at(last),
            decide_by,
            URGENCIES[1 if at == 0 else 2 if soon else 3],
            tuple(sorted(jobs, key=_likeliest_first)),
            self.settings.visit + sum(job.expected_cost for job in jobs),
        )


def _calendar(
    train: Train, parts: Sequence[Part], settings: PlanSettings, today: date
) -> _Calendar:
    """Return the days from the lead time to the end of a usual life, coarse beyond the horizon."""
    end_km = max(settings.of(part.parameter).usual_life_km for part in parts)
    end_days = end_km / train.km_per_day
    near = np.arange(settings.lead_days, settings.horizon_days, settings.step_days)
    near = np.unique(np.ceil(near))  # whole days, none before the lead time is over
    near = near[: max(1, int(np.searchsorted(near, end_days)))]
    days = near
    if end_days > settings.horizon_days:
        far = np.geomspace(settings.horizon_days, end_days, N_COARSE + 1)[:-1]
        days = np.append(near, far)
    prices = settings.visit * np.clip(1 - days / end_days, 0, None)
    return _Calendar(train, settings, today, days, near.size, end_km, prices)


def _plan_train(
    train: Train, parts: Sequence[Part], settings: PlanSettings, today: date
) -> tuple[list[Visit], list[Job], list[Job], float, float]:
    """Return visits, waiting and unknown jobs, objective and lower bound of one train."""
    calendar = _calendar(train, parts, settings, today)
    tables = [calendar.table(part) for part in parts]
    costs = np.stack(
        [calendar.allowed(one, part.severity) for one, part in zip(tables, parts, strict=True)]
    )
    dates, served, bound = choose_dates(costs, calendar.prices)
    jobs = [calendar.job(*one) for one in zip(parts, tables, served, strict=True)]
    visits = []
    for at in (one for one in dates if one < calendar.n_near):
        chosen = [j for j, one in enumerate(served) if one == at]
        visits.append(calendar.visit(at, [jobs[j] for j in chosen], costs[chosen]))
    left = [job for job, at in zip(jobs, served, strict=True) if at >= calendar.n_near]
    unknown = [job for job in left if job.part.unknown]
    waiting = [
        job
        for job in left
        if not job.part.unknown and (job.probability or job.part.severity >= Severity.NOTICE)
    ]
    objective = calendar.prices[dates].sum() + costs[np.arange(len(parts)), served].sum()
    return visits, waiting, unknown, float(objective), bound


def _likeliest_first(job: Job) -> tuple[bool, float, str]:
    """Return what the jobs of a visit are sorted by: unknown ones first."""
    probability = 0.0 if job.part.unknown else -job.probability
    return not job.part.unknown, probability, str(job.part)
