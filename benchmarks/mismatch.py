"""What it costs to read trips of a vehicle that is not the one that a model was trained for.

python benchmarks/mismatch.py [--cases none bending ...] [--readings nominal ...] [--seeds 0 1 2]

Each case is a train of tests/rich_train.py, for each seed with numbers of its own: first healthy
trips, then trips of worn vehicles, one each, stepped in time, written to files and read as
recordings are. "commissioned" is the vehicle that the healthy trips show, which reads the later
ones, as the program does. "nominal" is a method trained on the vehicle file alone. Adds bias, rms
error and coverage of the 90 % intervals to mismatch.csv, case by case, in place of what it held of
the same ones, and writes mismatch.md.
"""

import csv
import itertools
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from cells import Parser, Row, at_least
from foreign_trains import CASES, TESTS, Case
from hydra import compose, initialize_config_dir
from rich_train_trips import true_ratios, write_train_trips
from rich_trips import SENSORS, drawn_ratios
from tabulate import tabulate

from suspnet.cli import program  # noqa: F401 - makes our resolvers known to Hydra
from suspnet.cli.kinds import build
from suspnet.curves.problem import TRAIN, Problem
from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import PARAMETERS, kind_of
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.commissioning import check_generator, commission_parts
from suspnet.trains.recordings.manifest_files import find_manifests
from suspnet.trains.simulation import Fleet

RESULTS = TESTS.parent / "benchmarks" / "results"
NOMINAL, COMMISSIONED = READINGS = ("nominal", "commissioned")
KEYS = ("case", "reading", "seed")
"""Columns that tell the rows of one run."""
LEVEL = 0.9
IN_TABLE = ("bias_percent", "rms_percent", "coverage_percent")
"""What the table shows of each output, parted by a slash."""


@dataclass(frozen=True)
class Trips:
    """Trips of one train, healthy ones first.

    Attributes
    ----------
    case : Case
    given : sequence of Path
        Manifests.
    truth : array of shape (n_trips, 5), [-]
    n_healthy : int
    """

    case: Case
    given: Sequence[Path]
    truth: np.ndarray
    n_healthy: int


def configuration(options, case, *overrides):
    """Return the configuration of experiment=trips."""
    rates = [sensor["rate_hz"] for sensor in SENSORS.values()]
    given = [f"data.rates_hz={rates}", f"data.minutes={options.minutes}", *options.train]
    given += [f"generator.sensor_lateral_m={case.lateral_m}"]
    if case.speeds is not None:
        given += [f"speed_m_per_s={sum(case.speeds) / 2}"]
    with initialize_config_dir(str(TESTS.parent / "configs"), version_base="1.3"):
        return compose("train", overrides=["experiment=trips", *given, *overrides])


def made(options, case: Case, folder: Path) -> Trips:
    """Return the trips of a case."""
    n_trips = options.healthy + options.trips
    fleet = Fleet(n_trips=n_trips, minutes=options.minutes, sensors=SENSORS)
    ratios = drawn_ratios(options.healthy, fleet, options.seed)
    train = case.train(options.seed)
    truth = np.array([list(true_ratios(train, row, case.sides).values()) for row in ratios])
    sides = "pair" if case.sides == "mean" else case.sides
    each = options.healthy, options.trips, options.seed
    ways = {"speeds_m_per_s": case.speeds_of(*each), "roughness": case.roughness_of(*each)}
    write_train_trips(folder, train, ratios, fleet, options.seed, sides, **ways)
    return Trips(case, find_manifests(folder), truth, options.healthy)


def commissioned(config, trips: Trips, folder: Path) -> BogieModel:
    """Return the model that the program makes of healthy trips on disk."""
    generator, settings = check_generator(build(config, "generator")), build(config, "data")
    bound = settings.bound(generator.vehicle)
    healthy = read_healthy(folder, generator, bound, TripSettings(), n_first=trips.n_healthy)
    return BogieModel(commission_parts(healthy, TripSettings()), generator, bound)


def trained(config, generator) -> tuple[TrainedModel, float]:
    """Return the calibrated model of a generator's vehicles, and the seconds of its training."""
    task, settings = build(config, "protocol").task(config.group), build(config, "data")
    problem = Problem(generator, task, settings, seed=config.seed)
    start = time.process_time()
    problem.features(TRAIN)
    model = calibrated(problem, fit(problem, build(config, "model"), None))
    return model, time.process_time() - start


def read(model: TrainedModel | BogieModel, trips: Trips) -> list[Estimate | None]:
    """Return the estimate of each trip, None where there is none."""
    found: list[Estimate | None] = []
    for one in trips.given:
        try:
            found.append(model.estimate(one, level=LEVEL))
        except NoEstimateError as reason:
            print(reason, file=sys.stderr)
            found.append(None)
    return found


def measured(trips: Trips, estimates: Sequence[Estimate | None]) -> list[Row]:
    """Return a row for each output: errors and coverage over the trips that are not healthy."""
    worn = [i for i in range(trips.n_healthy, len(estimates)) if estimates[i] is not None]
    done = [estimates[i] for i in worn]
    head = {"n_trips": len(estimates) - trips.n_healthy, "n_read": len(done)}
    flagged = np.array([bool(e.flags.flagged[0]) for e in done], dtype=bool)
    head["n_flagged"] = int(flagged.sum())
    rows = []
    for j, name in enumerate(done[0].names if done else ()):
        values, low, high = (
            np.array([getattr(e, part)[0, j] for e in done]) for part in ("values", "low", "high")
        )
        truth = trips.truth[worn, PARAMETERS.index(kind_of(name))]  # all of a kind are worn alike
        errors, held = 100 * (values / truth - 1), (low <= truth) & (truth <= high)
        row = head | {
            "output": name,
            "bias_percent": float(errors.mean()),
            "rms_percent": float(np.sqrt(np.mean(errors**2))),
            "coverage_percent": 100 * float(held.mean()),
            "half_width_percent": 50 * float(np.median(np.log(high / low))),
        }
        if not flagged.all():
            row["unflagged_coverage_percent"] = 100 * float(held[~flagged].mean())
        rows.append(row)
    return rows


def case_rows(options, name: str, folder: Path) -> list[Row]:
    """Return the rows of one case."""
    case, trips = CASES[name], made(options, CASES[name], folder)
    head = {"case": name, "seed": options.seed}
    rows = []

    def add(reading, model, seconds, more):
        start = time.process_time()
        estimates = read(model, trips)
        each = (time.process_time() - start) / len(estimates)
        told = {"reading": reading, "train_s": seconds, "trip_s": each, **more}
        rows.extend(head | told | row for row in measured(trips, estimates))

    if NOMINAL in options.readings:
        add(NOMINAL, *nominal(options, case), {})
    if COMMISSIONED in options.readings:
        config = configuration(options, case)
        start = time.process_time()
        model = commissioned(config, trips, folder)
        more = {"misfit": model.bogie.misfit, "commission_s": time.process_time() - start}
        add(COMMISSIONED, model, 0.0, more)
    return rows


def nominal(options, case: Case) -> tuple[TrainedModel, float]:
    """Return the model of the vehicle file's numbers, the same one for cases of the same sides."""
    if case.sides not in _NOMINAL:
        config = configuration(options, Case(), "generator.parts=[]")
        _NOMINAL[case.sides] = trained(config, build(config, "generator"))
    return _NOMINAL[case.sides]


_NOMINAL: dict[str, tuple[TrainedModel, float]] = {}


def merged(old: Sequence[Row], new: Sequence[Row]) -> list[Row]:
    """Return old and new rows in the order of `CASES`, without old ones of the same runs."""
    runs = {tuple(str(row[key]) for key in KEYS) for row in new}
    kept = [r for r in old if tuple(str(r[key]) for key in KEYS) not in runs]
    order = list(CASES)

    def place(row: Row) -> tuple[int, int, int]:
        return order.index(row["case"]), READINGS.index(row["reading"]), int(row["seed"])

    return sorted([*kept, *new], key=place)


def read_table(path: Path) -> list[Row]:
    """Return the rows that a former run left, as texts; none if it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        return [r for r in rows if r.get("case") in CASES and r.get("reading") in READINGS]


def write(rows: Sequence[Row], path: Path) -> None:
    """Write rows as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, dict.fromkeys(key for row in rows for key in row))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})


def table(rows: Sequence[Row]) -> str:
    """Return one line for each case, reading and seed."""
    lines: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        key = tuple(row[name] for name in KEYS)
        counts = [f"{row['n_read']} of {row['n_trips']}", str(row["n_flagged"])]
        counts += [short(row.get(name)) for name in ("misfit", "train_s")]
        line = lines.setdefault(key, [*key, *counts])
        line.append(" / ".join(short(row.get(name)) for name in IN_TABLE))
    outputs = list(dict.fromkeys(row["output"] for row in rows))
    headers = ["train has", "reading", "seed", "read", "flagged", "misfit"]
    headers += ["training, s", *outputs]
    return tabulate(list(lines.values()), headers, tablefmt="pipe", disable_numparse=True)


def short(number) -> str:
    """Return two digits, all of those before the point."""
    if number in (None, ""):
        return "-"
    number = float(number)
    return f"{number:.0f}" if abs(number) >= 9.95 else f"{number:.2g}"


def run_all(options, folder: Path) -> None:
    """Make and read each case; the results are complete up to the last at any time."""
    for seed, name in itertools.product(options.seeds, options.cases):
        options.seed, start = seed, time.perf_counter()
        with tempfile.TemporaryDirectory(dir=folder) as trips:
            new = case_rows(options, name, Path(trips) / "trips")
        rows = merged(read_table(options.output / "mismatch.csv"), new)
        write(rows, options.output / "mismatch.csv")
        words = (
            f"Worn vehicles after {options.healthy} healthy trips, {options.minutes:g} minutes "
            f"each; bias / rms error / coverage of {100 * LEVEL:.0f} % "
            "intervals in %; seconds are of one processor."
        )
        if options.train:
            words += f" Settings: {', '.join(options.train)}."
        (options.output / "mismatch.md").write_text(f"{table(rows)}\n\n{words}\n")
        print(
            f"{name}, seed {options.seed}: {time.perf_counter() - start:.0f} s\n{table(new)}",
            flush=True,
        )


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--readings", nargs="+", choices=READINGS, default=list(READINGS))
    parser.add_argument("--trips", type=at_least(1), default=30, help="worn vehicles, a trip each")
    parser.add_argument("--healthy", type=at_least(3), default=5, help="trips to commission on")
    parser.add_argument("--minutes", type=at_least(1, float), default=20.0, help="of a trip")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="a train each")
    parser.add_argument("--train", nargs="+", default=[], help="more settings, as for train.py")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the tables")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as temporary:
            run_all(options, Path(temporary))
    except (OSError, ValueError) as error:
        parser.error(f"{error}")


if __name__ == "__main__":
    main()
