"""What a plan from predicted lives costs, beside fixed intervals and running to the limit.

python benchmarks/plan.py

A fleet of trains with ten parts each runs ``DURATION_KM``. Each part follows a wear history of
wear_histories.py; when it is replaced, by plan or after its failure, the next history in a fixed
order takes its place. All policies see the same histories, and pay the same: V for each visit of a
train, which may serve several parts, R for each replacement, and F for each limit passed in
service, after which that part alone is replaced at a visit of its own.

- plan: made again each ``STEP_KM`` from `predict_life` on what was measured until then, with a lead
  time of ``STEP_KM``; a visit that is to be decided on before the next plan is carried out then.
- known lives: the same, with the true lives.
- fixed: replaced by age (and with it those of the train that are within a share of it), or the
  whole train at a time; "customary" at the mileage before which 10 % fail (L10, as of bearings),
  "best" at the mileage and share that turn out cheapest on these very histories.
- to the limit: replaced when the limit is passed.
- bound: nobody can do better: every life is used up to its end, without a failure, and a train is
  visited as often as the part that needs most replacements.

Prints costs for 1,000,000 km of a part, in units of V, and writes plan.csv.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from cells import Parser, at_least, write_rows
from tabulate import tabulate
from wear_histories import KINDS, PER_TRAIN, WearHistory, make_histories

from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance.life import MIN_TRIPS, predict_life
from suspnet.trains.maintenance.plan import Part, PlanSettings, Train, make_plan

STEP_KM = 20_000.0
DURATION_KM = 3_000_000.0
KM_PER_DAY = 500.0
TODAY = date(2026, 1, 1)
STRIDE = 101
"""A part is followed by the history so many further on: 101 and 300 have no common divisor."""
SHARES = (0.0, 0.2, 0.4)
RATIOS = (
    (2, 0),
    (2, 1),
    (2, 2),
    (2, 5),
    (2, 10),
    (2, 20),
    (2, 50),
    (2, 100),
    (0.5, 10),
    (5, 10),
    (10, 20),
)
"""R and F in units of V."""
RESULTS = Path(__file__).parent / "results"


@dataclass
class Fleet:
    """Parts in service, and what was paid.

    Attributes
    ----------
    lives : array of shape (n,)
        Of all histories.
    history : int array of shape (n,)
        History that each part follows.
    born_km : array of shape (n,)
        Mileage at which it was new.
    """

    lives: FloatArray
    seed: int
    n_visits: int = 0
    n_replaced: int = 0
    n_failed: int = 0
    history: np.ndarray = field(init=False)
    born_km: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.history = np.arange(self.lives.size)
        self.born_km = -np.floor(self.lives * rng.uniform(0, 0.8, self.lives.size))

    def run_until(self, km: float) -> None:
        """Replace parts that pass their limit until then."""
        ends = self.born_km + self.lives[self.history]
        for part in np.flatnonzero(ends <= km):
            self.n_failed += 1
            self.replace([part], ends[part])

    def replace(self, parts: Sequence[int], km: float) -> None:
        """Replace parts of one train at one visit."""
        self.n_visits += 1
        self.n_replaced += len(parts)
        self.born_km[parts] = km
        self.history[parts] = (self.history[parts] + STRIDE) % self.lives.size

    def cost(self, replacement: float, failure: float) -> float:
        """Return the cost of 1,000,000 km of a part, in visits."""
        paid = self.n_visits + replacement * self.n_replaced + failure * self.n_failed
        return paid / (self.lives.size * DURATION_KM / 1e6)


def steps() -> FloatArray:
    """Return the mileages at which plans are made."""
    return np.arange(0.0, DURATION_KM, STEP_KM)


def trains(n: int) -> Iterator[np.ndarray]:
    """Yield the parts of each train."""
    yield from np.split(np.arange(n), range(PER_TRAIN, n, PER_TRAIN))


def run_to_limit(lives: FloatArray, seed: int) -> Fleet:
    fleet = Fleet(lives, seed)
    for km in steps():
        fleet.run_until(km)
    return fleet


def run_fixed(lives: FloatArray, seed: int, interval_km: float, share: float | None) -> Fleet:
    """Replace a part at an age and those of its train near it; if `share` is None, the train."""
    fleet = Fleet(lives, seed)
    done = -np.floor(
        interval_km * np.random.default_rng(seed + 1).random(-(-lives.size // PER_TRAIN))
    )
    for km in steps():
        fleet.run_until(km)
        for number, parts in enumerate(trains(lives.size)):
            age = km - fleet.born_km[parts]
            if share is None:
                due = np.full(parts.size, km - done[number] >= interval_km)
                done[number] = km if due.any() else done[number]
            else:
                due = age >= (1 - share) * interval_km if age.max() >= interval_km else age < 0
            if due.any():
                fleet.replace(parts[due], km)
    return fleet


Predict = Callable[[int, float], tuple[FloatArray, float]]
"""Of a history, at an age: samples and the age from which they count."""


def run_plan(lives: FloatArray, seed: int, settings: PlanSettings, predict: Predict) -> Fleet:
    fleet = Fleet(lives, seed)
    numbers = list(trains(lives.size))
    booked: list[tuple[np.ndarray, np.ndarray]] = []
    for km in steps():
        fleet.run_until(km)
        for parts, histories in booked:
            still = parts[fleet.history[parts] == histories]
            if still.size:
                fleet.replace(still, km)
        today = TODAY + timedelta(days=km / KM_PER_DAY)
        items = []
        for train, parts in enumerate(numbers):
            for part in parts:
                samples, at = predict(int(fleet.history[part]), km - fleet.born_km[part])
                born = float(fleet.born_km[part])
                items.append(Part(f"{train}", f"{part}", "c_p", samples, born + at))
        running = [Train(f"{train}", km, today, KM_PER_DAY) for train in range(len(numbers))]
        plan = make_plan(items, running, settings, today)
        booked = []
        for visit in plan.visits:
            if visit.decide_by < today + timedelta(days=STEP_KM / KM_PER_DAY):
                chosen = np.array([int(job.part.suspension) for job in visit.jobs])
                booked.append((chosen, fleet.history[chosen].copy()))
    return fleet


def bound(lives: FloatArray, seed: int) -> Fleet:
    """Return the replacements of parts that all last until their end, with the fewest visits."""
    fleet = Fleet(lives, seed)
    counts = np.zeros(lives.size, dtype=int)
    last = steps()[-1]
    for _ in range(int(DURATION_KM / lives.min()) + 2):
        ends = fleet.born_km + lives[fleet.history]
        for part in np.flatnonzero(ends <= last):
            counts[part] += 1
            fleet.replace([part], ends[part])
    fleet.n_visits = sum(int(counts[parts].max()) for parts in trains(lives.size))
    return fleet


@dataclass
class Predicted:
    """Remaining lives from what was measured until an age, each asked for once.

    Attributes
    ----------
    histories : sequence of WearHistory
    known : dict of (history, age) to samples and the age from which they count
    """

    histories: Sequence[WearHistory]
    known: dict[tuple[int, float], tuple[FloatArray, float]] = field(default_factory=dict)

    def __call__(self, history: int, age_km: float) -> tuple[FloatArray, float]:
        age = STEP_KM * np.floor(
            age_km / STEP_KM
        )  # until the step before, so that few are asked for
        if (history, age) not in self.known:
            one = self.histories[history]
            mileage, values, half_widths = one.until(age)
            found = np.array([np.inf]), float(age)
            if np.isfinite(values).sum() >= MIN_TRIPS:
                life = predict_life(mileage, values, half_widths, one.limits, seed=history)
                found = life.samples_km, float(mileage[-1])
            self.known[history, age] = found
        return self.known[history, age]


def compare(histories: Sequence[WearHistory], seed: int, risk: float) -> list[dict[str, float]]:
    """Return the costs of all policies for each pair of R and F."""
    lives = np.array([one.crossing_km for one in histories])
    customary_km = float(np.quantile(lives, 0.1))
    intervals = [customary_km, *np.arange(4 * STEP_KM, np.quantile(lives, 0.99), STEP_KM)]
    fixed = {
        (km, share): run_fixed(lives, seed, km, share)
        for km in intervals
        for share in (None, *SHARES)
    }
    settings = PlanSettings(risk=risk, lead_days=STEP_KM / KM_PER_DAY)
    plan = run_plan(lives, seed, settings, Predicted(histories))
    known = run_plan(lives, seed, settings, lambda i, _: (lives[i : i + 1], 0.0))
    to_limit, least = run_to_limit(lives, seed), bound(lives, seed)
    rows = []
    for R, F in RATIOS:
        costs = {key: fleet.cost(R, F) for key, fleet in fixed.items()}
        best = min(costs, key=lambda key: costs[key])
        rows.append(
            {
                "R": R,
                "F": F,
                "plan": plan.cost(R, F),
                "customary": min(v for (km, _), v in costs.items() if km == customary_km),
                "best fixed": costs[best],
                "best km": best[0],
                "to limit": to_limit.cost(R, F),
                "known lives": known.cost(R, F),
                "bound": least.cost(R, F),
                "failures": plan.n_failed,
                "replaced": plan.n_replaced,
                "visits": plan.n_visits,
            }
        )
        rows[-1] |= {
            f"plan / {other}": rows[-1]["plan"] / rows[-1][other]
            for other in ("customary", "best fixed", "to limit")
        }
    return rows


def main() -> None:
    parser = Parser(description="Costs of a plan beside other policies.")
    parser.add_argument("--n", type=at_least(1), default=300, help="number of wear histories")
    parser.add_argument("--seed", type=at_least(0), default=0)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), help="of wear histories")
    parser.add_argument("--risk", type=at_least(0, float), default=PlanSettings.risk)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    histories = make_histories(options.n, options.seed, kinds=options.kinds)
    rows = compare(histories, options.seed, options.risk)
    lives = np.array([one.crossing_km for one in histories])
    print(
        f"{options.n} histories ({', '.join(options.kinds)}), seed {options.seed}: lives "
        f"{lives.min():.0f} to {lives.max():.0f} km, mean {lives.mean():.0f}, "
        f"L10 {np.quantile(lives, 0.1):.0f}; {DURATION_KM:.0f} km, step and lead {STEP_KM:.0f} km; "
        f"V = 1, costs for 1,000,000 km of a part; risk {options.risk:g}"
    )
    print(tabulate(rows, "keys", tablefmt="github", floatfmt=".4g"))
    write_rows(options.output / "plan.csv", rows)


if __name__ == "__main__":
    main()
