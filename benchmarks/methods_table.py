"""How close methods come to the bound of the curves: a table.

    python benchmarks/methods_table.py
    python benchmarks/methods_table.py --n-train 300 1000

Every method learns from the same features of the same curves and is scored on the same test curves.
An entry is the rms error over the Cramer-Rao bound: 1 is the best that any unbiased method can do.
The methods have the defaults of their constructors, which are not tuned.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sklearn.ensemble import RandomForestRegressor
from sklearn.neighbors import KNeighborsRegressor
from tabulate import tabulate

from suspnet.cli.kinds import read_protocol, read_vehicles
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import TEST, TRAIN, Problem
from suspnet.ground.storage import write_atomically
from suspnet.learning import METHODS
from suspnet.runs.tables import MODEL_TITLES, in_digits, records_csv
from suspnet.runs.train import train
from suspnet.vehicle import QuarterCar

PEERS = {
    "nearest neighbours": lambda: KNeighborsRegressor(5, weights="distance"),
    "random forest": lambda: RandomForestRegressor(random_state=0),
}
"""Regressors of scikit-learn that are scored but not saved."""
OVER_BOUND = "stiffness / bound", "damping / bound"


def records(n_train: Sequence[int], n_test: int) -> list[dict[str, Any]]:
    """Return a record for each group, number of training curves and method, the best first."""
    makers = {MODEL_TITLES[name]: kind for name, kind in METHODS.items()} | PEERS
    vehicle, found = read_vehicles()["am96"], []
    for group in ("primary", "secondary"):
        for n in n_train:
            settings = CurveSettings(n_train=n, n_test=n_test, n_calibrate=None)
            task = read_protocol("multi_location").task(group)
            problem = Problem(QuarterCar(vehicle), task, settings)
            for stream in (TRAIN, TEST):
                problem.features(stream)  # into the cache, so that no method waits
            for title, make in makers.items():
                start = time.perf_counter()
                ratios = train(problem, make())["rms_ratio"]
                row = {"group": group, "n_train": n, "method": title}
                row |= dict(zip(OVER_BOUND, ratios.values(), strict=True))
                found.append(row | {"seconds": time.perf_counter() - start})
    return sorted(found, key=lambda r: (r["group"], r["n_train"], sum(r[k] for k in OVER_BOUND)))


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return records, or the rows of their file, as Markdown."""
    shown = [
        [
            *(r["group"], r["n_train"], r["method"]),
            *(in_digits(float(r[k])) for k in OVER_BOUND),
            f"{float(r['seconds']):.1f}",
        ]
        for r in rows
    ]
    header = ["group", "training curves", "method", *OVER_BOUND, "seconds"]
    return tabulate(shown, header, tablefmt="github", disable_numparse=True)


def main() -> None:
    """Print the table, and write it where --output says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-train", type=int, nargs="+", default=[1000])
    parser.add_argument("--n-test", type=int, default=1000)
    parser.add_argument("--output", type=Path, help="CSV file")
    options = parser.parse_args()
    rows = records(options.n_train, options.n_test)
    print(table(rows))
    if options.output is not None:
        write_atomically(options.output, records_csv(rows))


if __name__ == "__main__":
    main()
