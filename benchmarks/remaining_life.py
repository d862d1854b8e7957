"""How often the predicted remaining life holds the truth, on simulated wear histories.

python benchmarks/remaining_life.py

Predicts the life of 300 simulated histories (``wear_histories.py``) at shares of the true life, and
of healthy ones at shares of their history. Prints one table for each way that histories are made
and writes remaining_life.csv.
"""

import argparse
import csv
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cells import Parser, Row, at_least
from prognostics import alpha_lambda, cumulative_relative_accuracy
from scipy.stats import binomtest
from tabulate import tabulate
from wear_histories import KINDS, WearHistory, make_histories

from suspnet.trains.maintenance.life import HORIZON_KM, Life, predict_life

RESULTS = Path(__file__).parent / "results"
LEVEL = 0.8
JUDGED = (0.5, 0.75)
"""Shares of the true life at which intervals are judged."""
SHARES = (0.5, 0.625, 0.75, 0.875)
"""Shares of the true life of the predictions that the cumulative relative accuracy is of."""
ALPHA, BETA = 0.2, 0.5
STEP_SHARES, STEP_TRIPS, TRIPS_AFTER = (0.2, 0.9), (8, 60), (1, 2, 3, 5, 10, 20)
"""Size of a single step as a share of the way to the lower limit, and trips before and after it."""
HEALTHY_KM = (100_000.0, 300_000.0, 600_000.0, 1_200_000.0)
CASES: dict[str, dict[str, Any]] = {
    "as simulated": {"kinds": KINDS},
    "twice the noise, correlation 0.5": {"kinds": KINDS, "noise": 2.0, "correlation": 0.5},
    "wear that is no model": {"kinds": ("power", "bent", "jumps")},
}


@dataclass(frozen=True)
class Predicted:
    """One prediction and the mileage that was really still to go."""

    kind: str
    share: float
    life: Life
    now_km: float
    event_km: float

    @property
    def to_go_km(self) -> float:
        """Return the true remaining life."""
        return self.event_km - self.now_km

    @property
    def missed(self) -> int:
        """Return 0 if the interval holds the truth, -1 if that came earlier, 1 if later."""
        low, high = self.life.interval_km(LEVEL)
        return int(self.to_go_km > high) - int(self.to_go_km < low)

    @property
    def relative_width(self) -> float:
        """Return the width of the interval relative to the true remaining life."""
        low, high = self.life.interval_km(LEVEL)
        return (high - low) / self.to_go_km if np.isfinite(low) else np.inf

    @property
    def events_km(self) -> np.ndarray:
        """Return samples of the mileage of the event; never counts as the horizon."""
        return self.now_km + np.minimum(self.life.samples_km, HORIZON_KM)


def predict(history: WearHistory, km: float, share: float) -> Predicted:
    """Return the prediction at a mileage."""
    mileage, values, half_widths = history.until(km)
    life = predict_life(mileage, values, half_widths, history.limits)
    now = float(mileage[np.isfinite(values)][-1])
    return Predicted(history.kind, share, life, now, history.crossing_km)


def scores(predicted: Sequence[Predicted]) -> Row:
    """Return one row of the table, of histories at one share of their lives."""
    held = [p.missed == 0 for p in predicted]
    range_ = binomtest(sum(held), len(held)).proportion_ci(0.95)
    named = Counter(p.life.model for p in predicted)
    return {
        "n": len(held),
        "coverage_percent": 100 * np.mean(held),
        "least_percent": 100 * range_.low,
        "most_percent": 100 * range_.high,
        "earlier_percent": 100 * np.mean([p.missed < 0 for p in predicted]),
        "later_percent": 100 * np.mean([p.missed > 0 for p in predicted]),
        "median_width": float(np.median([p.relative_width for p in predicted])),
        "median_ratio": float(np.median([p.life.quantile_km(0.5) / p.to_go_km for p in predicted])),
        "alpha_lambda_percent": 100
        * np.mean(
            [alpha_lambda(p.events_km, p.now_km, p.event_km, ALPHA, BETA) for p in predicted]
        ),
        "models": " ".join(f"{name}:{count}" for name, count in named.most_common()),
    }


def accuracy(predicted: Sequence[Predicted], n_histories: int) -> dict[str, float]:
    """Return medians of the cumulative relative accuracy; predictions are share after share."""
    rows = np.arange(len(predicted)).reshape(-1, n_histories)

    def median(centre: Any) -> float:
        return float(
            np.median(
                [
                    cumulative_relative_accuracy(
                        [centre(predicted[i].events_km) for i in column],
                        predicted[column[0]].event_km,
                    )
                    for column in rows.T
                ]
            )
        )

    return {"cra_mean": median(np.mean), "cra_median": median(np.median)}


def measure(name: str, n: int, seed: int) -> tuple[list[Row], float]:
    """Return the rows of one way to make histories, and user seconds of one prediction."""
    histories = make_histories(n, seed, **CASES[name])
    begin = time.process_time()
    predicted = [predict(h, s * h.crossing_km, s) for s in SHARES for h in histories]
    seconds = (time.process_time() - begin) / len(predicted)
    rows = []
    for kind in ("all", *CASES[name]["kinds"]):
        of_kind = [p for p in predicted if kind in ("all", p.kind)]
        cra = accuracy(of_kind, len(of_kind) // len(SHARES))
        for share in JUDGED:
            row = scores([p for p in of_kind if p.share == share])
            case = {"histories": name, "seed": seed, "kind": kind, "share_of_life": share}
            rows.append(case | row | cra)
    return rows, seconds


def healthy(n: int, seed: int, **settings: Any) -> tuple[list[Row], float]:
    """Return how often a healthy history is said to have no trend, and user seconds of one."""
    histories = make_histories(n, seed, kinds=("healthy",), **settings)
    begin = time.process_time()
    rows = []
    for km in HEALTHY_KM:
        lives = [predict(h, km, 0.0).life for h in histories]
        rows.append(
            {
                "km": km,
                "no trend (%)": 100 * np.mean([life.model == "no trend" for life in lives]),
                "crossing within 500,000 km (%)": 100
                * np.mean([life.probability(5e5) for life in lives]),
                "interval of 80 % ends (%)": 100
                * np.mean([np.isfinite(life.interval_km(LEVEL)[1]) for life in lives]),
            }
        )
    return rows, (time.process_time() - begin) / n / len(HEALTHY_KM)


def stepped(n: int, seed: int) -> list[Row]:
    """Return how often an end is read out of one step of 20 to 90 % of the way to a limit."""
    histories = make_histories(n, seed, kinds=("healthy",))
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(*STEP_SHARES, n)
    at = rng.integers(*STEP_TRIPS, n)  # trips with an estimate before the step
    rows = []
    for after in TRIPS_AFTER:
        lives = []
        for history, size, first in zip(histories, sizes, at, strict=True):
            known = np.flatnonzero(np.isfinite(history.values))[: first + after]
            values = history.values[known]
            values[first:] *= 1 - size * (1 - history.limits[0])
            series = history.mileage_km[known], values, history.half_widths[known]
            lives.append(predict_life(*series, history.limits))
        rows.append(
            {
                "trips after the step": after,
                "named a step (%)": 100 * np.mean([life.model == "step" for life in lives]),
                "crossing within 20,000 km (%)": 100
                * np.mean([life.probability(2e4) for life in lives]),
                "interval of 80 % ends (%)": 100
                * np.mean([np.isfinite(life.interval_km(LEVEL)[1]) for life in lives]),
            }
        )
    return rows


def table(rows: list[Row]) -> str:
    """Return rows as text."""
    short = [
        {
            k.removesuffix("_percent").replace("_", " "): v
            for k, v in row.items()
            if k != "histories"
        }
        for row in rows
    ]
    return tabulate(short, headers="keys", floatfmt=".3g")


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print the tables and write remaining_life.csv."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=at_least(3), default=300, help="histories of each way")
    parser.add_argument("--seed", type=at_least(0), default=0)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(argv)
    rows: list[Row] = []
    print(f"Intervals of {100 * LEVEL:.0f} %, n = {options.n}, seed {options.seed}, in %")
    for name in options.cases:
        found, seconds = measure(name, options.n, options.seed)
        rows += found
        print(f"\n{name}: {1e3 * seconds:.1f} ms user time a prediction\n{table(found)}")
    options.output.mkdir(parents=True, exist_ok=True)
    with open(options.output / "remaining_life.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    quiet, seconds = healthy(options.n, options.seed)
    print(f"\nhealthy: {1e3 * seconds:.1f} ms user time a prediction\n{table(quiet)}")
    print(f"\none step, nothing after it\n{table(stepped(options.n, options.seed))}")


if __name__ == "__main__":
    main()
