"""How long the training of a train's model takes, from its first trips to the model.

python benchmarks/training_time.py [--cases ...] [--seeds 0] [--settings KEY=VALUE ...]

The healthy trips of a foreign train (tests/rich_train.py) are stepped in time and written as files,
20 minutes each, with pairs of sensors. What is timed is what a user waits for: `train.py
experiment=trips healthy=DIR` with its full sizes, in a process of its own, and of it what the trips
and the vehicle take: reading them, the parts, and both sides as equal, in this process. Run it on
an idle machine. Rows of the same case and seed are replaced in training_time.csv.
"""

import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from cells import Parser, machine, write_rows
from foreign_trains import CASES, TESTS
from hydra import compose, initialize_config_dir
from rich_train_trips import write_train_trips
from rich_trips import SENSORS
from tabulate import tabulate

from suspnet.cli import program  # noqa: F401 - makes our resolvers known to Hydra
from suspnet.cli.kinds import build
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.tensors import threads
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.commissioning import commission_parts
from suspnet.trains.simulation import Fleet

ROOT = TESTS.parent
RESULTS = TESTS.parent / "benchmarks" / "results"
MASSES = (0.95, 1.1, 1.0, 1.2, 1.05, 1.15, 0.9, 1.08)
TIMED = {
    "5 trips at 70 m/s": ("all", 5, "mean"),
    "8 trips at 48 to 78 m/s": ("all, 48 to 78 m/s", 8, "mean"),
    "5 trips, physics that does not fit": ("all+second_bending", 5, "mean"),
    "5 trips at 70 m/s, each part": ("all", 5, "pair"),
    "8 trips at 48 to 78 m/s, each part": ("all, 48 to 78 m/s", 8, "pair"),
}
"""Case of foreign_trains.py, number of trips, and sensors: pairs show each part."""


def main():
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=TIMED, default=list(TIMED))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="a train each")
    parser.add_argument("--minutes", type=float, default=20.0, help="of a trip")
    parser.add_argument("--settings", nargs="*", default=[], help="more settings of train.py")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the table")
    options = parser.parse_args()
    print(machine(), file=sys.stderr)
    rows = [timed(name, seed, options) for seed in options.seeds for name in options.cases]
    path = options.output / "training_time.csv"
    new = {(row["case"], str(row["seed"])) for row in rows}
    if path.exists():
        with path.open(newline="") as file:
            old = [r for r in csv.DictReader(file) if (r["case"], r["seed"]) not in new]
        rows = sorted([*old, *rows], key=lambda r: (list(TIMED).index(r["case"]), int(r["seed"])))
    write_rows(path, rows)
    print(tabulate([row.values() for row in rows], rows[0], tablefmt="github"))


def timed(name, seed, options):
    """Return the seconds of one training."""
    case_name, n_trips, sides = TIMED[name]
    case = CASES[case_name]
    with tempfile.TemporaryDirectory() as temporary:
        trips = Path(temporary) / "trips"
        ratios = np.ones((n_trips, 5))
        ratios[:, 4] = MASSES[:n_trips]
        fleet = Fleet(n_trips=n_trips, minutes=options.minutes, sensors=SENSORS)
        speeds = case.speeds_of(n_trips, 0, seed)
        write_train_trips(trips, case.train(seed), ratios, fleet, seed, sides, speeds)
        given = [
            *("experiment=trips", "vehicle=am96", f"healthy={trips}"),
            f"data.minutes={options.minutes}",
            *("progress=false", *options.settings),
        ]
        if case.speeds is not None:
            given.append("speed_m_per_s=null")
        stages = stages_of(given, trips)
        start = time.perf_counter()
        command = [sys.executable, str(ROOT / "train.py"), *given, f"hydra.run.dir={temporary}/run"]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        total_s = time.perf_counter() - start
    row = {"case": name, "seed": seed, **stages, "training, s": f"{total_s:.1f}"}
    print(row, file=sys.stderr, flush=True)
    return row


@threads(1)
def stages_of(given, trips):
    """Return the seconds of reading the trips and of the fit of their parts, and its misfit."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        config = compose("train", overrides=[*given, "speed_m_per_s=70"])
    generator, settings = build(config, "generator"), build(config, "data")
    times = [time.perf_counter()]
    bound = settings.bound(generator.vehicle)
    found = read_healthy(trips, generator, bound, TripSettings())
    times.append(time.perf_counter())
    bogie = commission_parts(found, TripSettings())
    times.append(time.perf_counter())
    read_s, parts_s = np.diff(times)
    return {
        "reading, s": f"{read_s:.1f}",
        "fit of the parts, s": f"{parts_s:.1f}",
        "misfit": f"{bogie.misfit:.2f}",
    }


if __name__ == "__main__":
    main()
