"""How well each spring and damper of a bogie is read from recordings of an unknown train.

python benchmarks/parts.py [--seeds 0 1 2] [--trips 30] [--healthy 5] [--minutes 20]

Each seed is a rich train (tests/rich_train.py) with numbers of its own and springs and dampers that
differ by 5 %, on a track of mean, cross level and alignment. It is commissioned on healthy trips;
then come worn ones with one part, two, or all twelve at 50 to 130 %, a third of them each. All are
stepped in time, written and read. Writes rms errors, errors of the parts that did not wear, and
coverage of the 90 % intervals to parts.csv and parts.md.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from cells import Parser, at_least
from foreign_trains import TESTS
from mismatch import short, write
from rich_effects import FAMILY
from rich_train import RichTrain
from rich_train_trips import write_train_trips
from rich_trips import SENSORS
from tabulate import tabulate
from vehicles import AM96

from suspnet.ground.parameters import COMPONENTS
from suspnet.ground.tensors import threads
from suspnet.trains.fits.bogie_fit import commission_bogie, fit_parts
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE, bogie_trip
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.simulation import Fleet
from suspnet.vehicle import SpatialVehicle

RESULTS = TESTS.parent / "benchmarks" / "results"
N_WORN = {"one part": 1, "two parts": 2, "all twelve": 12}
LOW, HIGH = 0.5, 1.3
RATE_HZ = 100.0


def drawn_ratios(options, seed):
    """Return the ratios of each trip, (n_trips, 13), healthy ones first, and the kind of wear."""
    rng = np.random.default_rng([seed, 20])
    ratios = np.ones((options.healthy + options.trips, len(COMPONENTS)))
    ratios[:, -1] = rng.uniform(1.0, 1.15, len(ratios))
    kinds = np.array(list(N_WORN))[np.arange(options.trips) % len(N_WORN)]
    for row, kind in zip(ratios[options.healthy :], kinds, strict=True):
        worn = rng.choice(len(COMPONENTS) - 1, N_WORN[kind], replace=False)
        row[worn] = rng.uniform(LOW, HIGH, len(worn))
    return ratios, kinds


def read(options, seed, folder):
    """Return rows of one train: errors of each kind of part, for each kind of wear."""
    ratios, kinds = drawn_ratios(options, seed)
    fleet = Fleet(n_trips=len(ratios), minutes=options.minutes, sensors=SENSORS)
    train = RichTrain.scattered(seed, (*FAMILY, "unequal"))
    paths = write_train_trips(folder, train, ratios, fleet, seed)
    vehicle = SpatialVehicle(AM96, parts=PARTS_OF_BOGIE, distribution="prior")
    trips = [bogie_trip(load_recording(read_manifest(p), RATE_HZ), vehicle) for p in paths]
    start = time.perf_counter()
    commissioned = commission_bogie(vehicle, trips[: options.healthy])
    between = time.perf_counter()
    found = [fit_parts(commissioned, trip) for trip in trips[options.healthy :]]
    each = (time.perf_counter() - between) / len(found)
    truth = ratios[options.healthy :]
    errors = np.log([one.values for one in found]) - np.log(truth)
    held = np.abs(errors) < 1.645 * np.array([one.deviations for one in found])
    head = {"seed": seed, "misfit": commissioned.misfit, "commission_s": between - start}
    head |= {"trip_s": each, "n_converged": sum(one.converged for one in found)}
    rows = []
    for kind in N_WORN:
        trips_of = kinds == kind
        for name in ("k_p", "c_p", "k_s", "c_s", "M_s"):
            columns = np.array([one.startswith(name) for one in COMPONENTS])
            of = 100 * errors[np.ix_(trips_of, columns)]
            unworn = of[truth[np.ix_(trips_of, columns)] == 1.0]
            row = head | {"wear": kind, "n_trips": int(trips_of.sum()), "output": name}
            row |= {
                "rms_percent": float(np.sqrt(np.mean(of**2))),
                "largest_unworn_percent": float(np.abs(unworn).max()) if unworn.size else "",
                "coverage_percent": 100 * float(held[np.ix_(trips_of, columns)].mean()),
            }
            rows.append(row)
    return rows


def table(rows):
    """Return one line for each train and kind of wear."""
    lines = {}
    for row in rows:
        key = row["seed"], row["wear"]
        head = [*key, row["n_trips"], short(row["misfit"])]
        cell = " / ".join(
            short(row[name])
            for name in ("rms_percent", "largest_unworn_percent", "coverage_percent")
        )
        lines.setdefault(key, head).append(cell)
    outputs = list(dict.fromkeys(row["output"] for row in rows))
    headers = ["seed", "worn", "trips", "misfit", *outputs]
    return tabulate(list(lines.values()), headers, tablefmt="pipe", disable_numparse=True)


@threads(1)
def main():
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="a train each")
    parser.add_argument("--trips", type=at_least(3), default=30, help="worn trips of each train")
    parser.add_argument("--healthy", type=at_least(3), default=5, help="trips to commission on")
    parser.add_argument("--minutes", type=at_least(18, float), default=20.0, help="of a trip")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the tables")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            rows += read(options, seed, Path(folder))
        write(rows, options.output / "parts.csv")
        words = (
            f"Trips of {options.minutes:g} minutes at 70 m/s after {options.healthy} healthy "
            "ones; rms error / largest error of a part that did not wear / coverage of 90 % "
            "intervals in %. "
            f"Commissioning took {short(rows[-1]['commission_s'])} s, a trip "
            f"{short(rows[-1]['trip_s'])} s of one processor."
        )
        (options.output / "parts.md").write_text(f"{table(rows)}\n\n{words}\n")
        print(table(rows), flush=True)


if __name__ == "__main__":
    main()
