"""Settings of a plan, and the optimal dates of visits, from the expected costs of their parts.

Letters: T is the mileage from today until a part passes its limit, t that until a visit, L the
usual life of a new part; V, R, I and F are the costs of a visit, a replacement, an inspection and a
failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from suspnet.ground.parameters import kind_of
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.types import FloatArray, IntArray

REPLACE, INSPECT = 0, 1
"""Rows of ``PartCosts.work``."""
MAX_SOLVE_S = 30.0
"""Time limit of the search for the dates of one train, [s]; it then returns the best found so far.
A train of 40 parts and 128 dates takes 0.05 s."""
SCALE = 1e4
"""Magnitude to which costs are scaled, as the solver's absolute tolerance is 1e-6."""

MOST_DAYS = 36_525.0
"""Longest horizon, a century, [days]."""
MAX_DATES = 1000
"""Largest number of possible dates before the horizon."""


@dataclass(frozen=True)
class Costs:
    """Costs of one part, in any currency.

    Raises
    ------
    TypeError, ValueError
        If one is not a number >= 0, or one of the mileages not > 0.
    """

    replacement: float = setting(2.0, "Cost of replacing a part, in addition to the visit", low=0)
    inspection: float = setting(0.2, "Cost of inspecting a part, in addition to the visit", low=0)
    failure: float = setting(
        20.0, "Cost of passing an act limit in service, in addition to visit and replacement", low=0
    )
    reach_km: float = setting(
        50_000.0,
        "Mileage within which an inspection finds the parts that would pass their limit",
        "km",
        above=0,
    )
    usual_life_km: float = setting(
        600_000.0, "Mileage that a new part lasts if it is used until its limit", "km", above=0
    )

    def __post_init__(self) -> None:
        check_settings(self)


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
        "Days within which a notice is inspected if no limit is predicted to be passed",
        "days",
        low=0,
    )
    km_per_day: float = setting(
        500.0, "Daily mileage of trains whose trips do not determine it", "km", above=0
    )
    stale_days: float = setting(
        180.0,
        "Age of a train's newest trip beyond which its wear and mileage count as unknown; as long "
        "as the trips that determine the daily mileage",
        "days",
        above=0,
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
        name = parameter if parameter in self.costs else kind_of(parameter)
        if name not in self.costs:
            raise ValueError(f"`costs` must name {name!r}, got {tuple(self.costs)}")
        return self.costs[name]


@dataclass(frozen=True, eq=False)
class PartCosts:
    """Expected costs of one part for each possible date of a visit.

    `passed`, (n_dates,): probability that the limit is passed before each date. `failing`,
    (n_dates,): expected cost of failures until then; the last is that of no visit. `work`,
    (2, n_dates): expected cost if the part is replaced, or inspected, at each date.
    """

    passed: FloatArray
    failing: FloatArray
    work: FloatArray

    @property
    def least(self) -> FloatArray:
        """Cost of the cheaper work at each date, then that of no visit, (n_dates + 1,)."""
        return np.append(self.work.min(axis=0), self.failing[-1])


def part_costs(
    samples_km: FloatArray, dates_km: FloatArray, visit: float, end_km: float, costs: Costs
) -> PartCosts:
    """Return the expected costs of a part if it is replaced or inspected at each date.

    With T' = min(T, L), and V(x) = V max(1 - x / `end_km`, 0) for a visit after x km,

    - until t: f(t) = E[F + V(T); T <= t], as a failure needs a visit of its own,
    - replaced: f(t) + R / L E[max(T' - t, 0)], with the value of the wasted life,
    - inspected: f(t) + I + E[min(R / L (T' - t), V(T')); t < T <= u] + g(u), u = t + `reach_km`:
      an inspection finds T <= u. Such a part is replaced immediately or at a visit of its own just
      before the limit, whichever costs less. Other parts continue at the least cost g after u: the
      minimum over t' >= u of f(t') - f(u) plus the life wasted at t' plus V(t') P(T > t'), or the
      cost of failures alone.

    Every part is paid for once per life in any case, so its price enters only as R / L, the cost
    rate of renewal-reward theory (Barlow and Proschan, Mathematical Theory of Reliability, 1965,
    ch. 4). A limit that is passed already (T = 0) counts as passed just after the first date, so
    that the first visit can still prevent the failure.

    `samples_km`, (n_samples,): equally likely T >= 0, inf: never. `dates_km`, (n_dates,): each t,
    ascending. `visit` is V; from `end_km` on a visit costs nothing, as another one is due anyway.
    """
    life, rate = costs.usual_life_km, costs.replacement / costs.usual_life_km
    samples = np.sort(np.where(samples_km > 0, samples_km, np.nextafter(dates_km[0], np.inf)))
    capped, n = np.minimum(samples, life), samples.size  # T'
    # cumulative sums over sorted samples: each expectation is a difference of two of them
    until, visits, later = (
        np.append(0.0, np.cumsum(values))
        for values in (
            capped,
            visit * np.clip(1 - samples / end_km, 0, None),
            visit * np.clip(1 - capped / end_km, 0, None),
        )
    )

    def failing(n_passed: IntArray) -> FloatArray:
        paid: FloatArray = (costs.failure * n_passed + visits[n_passed]) / n
        return paid

    # replaced: i samples have passed the limit until t
    i = np.searchsorted(samples, dates_km, side="right")
    thrown_away = rate * np.clip(until[n] - until[i] - dates_km * (n - i), 0, None) / n
    # inspected: samples i to `found` are found, those up to k are replaced immediately
    found = np.searchsorted(samples, dates_km + costs.reach_km, side="right")
    # R / L (T' - t) rises with T' and V(T') falls: the former is smaller up to their crossing
    meet_km = (visit + rate * dates_km) / (rate + visit / end_km) if visit else dates_km
    k = np.clip(np.searchsorted(capped, meet_km, side="right"), i, found)
    at_once = rate * (until[k] - until[i] - dates_km * (k - i))
    # g(u): the cheapest end of a life after each date
    ends = failing(i) + thrown_away + visit * np.clip(1 - dates_km / end_km, 0, None) * (1 - i / n)
    best = np.minimum.accumulate(np.append(ends, failing(i[-1:]))[::-1])[::-1]
    go_on = best[np.searchsorted(dates_km, dates_km + costs.reach_km)] - failing(found)
    inspected = costs.inspection + (at_once + later[found] - later[k]) / n + np.clip(go_on, 0, None)
    return PartCosts(i / n, failing(i), failing(i) + np.stack([thrown_away, inspected]))


class Dates(NamedTuple):
    """Dates on which a train is visited, by index and ascending; each serves at least one part.

    `served` is the date of each part; n_dates means no visit, which is preferred at equal cost.
    `bound` is a lower bound of the cost of any choice.
    """

    dates: list[int]
    served: list[int]
    bound: float


def choose_dates(costs: FloatArray, visits: FloatArray, max_s: float = MAX_SOLVE_S) -> Dates:
    """Return the dates on which a train is visited, and the date that serves each part.

    Minimises sum_{d in D} visits[d] + sum_j min_{d in D or no visit} costs[j, d] over sets of dates
    D. That is uncapacitated facility location, a mixed-integer linear program with y_d = 1 where d
    is in D and x_jd the share of part j that is served by d:

        min sum_d visits[d] y_d + sum_jd (costs[j, d] - costs[j, n_dates]) x_jd,
        x_jd <= y_d,  sum_d x_jd <= 1,  0 <= x, y integer

    with only those x_jd that cost less than no visit. Its linear relaxation is nearly always
    integer, so HiGHS proves the optimum at the root node.

    `costs`, (n_parts, n_dates + 1): of each part at each date, and last without a visit; inf where
    forbidden. `visits`, (n_dates,): prices >= 0. After `max_s` [s] the best dates so far are
    returned. ValueError is raised if a part has no finite cost.
    """
    if not np.isfinite(costs).any(axis=1).all():
        raise ValueError("`costs` must have a finite one for each part")
    n = visits.size
    own = n - costs[:, ::-1].argmin(axis=1)  # the best date of each part, the latest of equal ones
    chosen, bound = np.unique(own[own < n]), float(costs.min(axis=1).sum())
    if visits[chosen].sum() > 0:  # else each part can have its best date
        chosen, bound = _solve(costs[np.lexsort(costs.T)], visits, chosen, bound, max_s)
    options = np.append(n, chosen)
    served = options[costs[:, options].argmin(axis=1)].tolist()
    return Dates(sorted(set(served) - {n}), served, bound)


def _solve(
    costs: FloatArray, visits: FloatArray, chosen: IntArray, bound: float, max_s: float
) -> tuple[IntArray, float]:
    """Return the dates of least cost and a lower bound; those given if the search finds none."""
    n, never = visits.size, costs[:, -1]
    free = np.where(np.isfinite(never), never, 0.0)  # paid if a part has no visit
    part, date = np.nonzero(costs[:, :n] < never[:, None])
    gain = costs[part, date] - free[part]
    scale = SCALE / max(np.abs(gain).max(), visits.max())
    pair = np.arange(part.size)
    ones = np.ones(part.size)
    each = coo_array((ones, (part, n + pair)), shape=(len(costs), n + part.size))
    opens = coo_array(
        (np.append(ones, -ones), (np.tile(pair, 2), np.append(n + pair, date))),
        shape=(part.size, n + part.size),
    )
    found = milp(
        scale * np.append(visits, gain),
        integrality=np.append(np.ones(n), np.zeros(part.size)),
        bounds=Bounds(0, 1),
        constraints=[
            LinearConstraint(each, np.where(np.isfinite(never), -np.inf, 1.0), 1.0),
            LinearConstraint(opens, -np.inf, 0.0),
        ],
        options={"mip_rel_gap": 0.0, "time_limit": max_s},
    )
    if found.mip_dual_bound is not None:
        bound = max(bound, float(found.mip_dual_bound / scale + free.sum()))
    if found.x is None:
        return chosen, bound

    def total(dates: IntArray) -> float:
        return float(costs[:, np.append(dates, n)].min(axis=1).sum() + visits[dates].sum())

    return min(np.flatnonzero(found.x[:n] > 0.5), chosen, key=total), bound
