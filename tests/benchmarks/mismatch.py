"""What it costs to read trips of a vehicle that is not the one a model was trained for.

python tests/benchmarks/mismatch.py [--folder DIR] [--effects none bending ... all a+b]

For each effect (tests/rich_vehicle.py says what each is, with sources) one folder of trips of one
AM96 suspension is simulated: first the healthy ones, then one another vehicle each. They are read
with models trained without the effect. Prints a table of bias, rms error and coverage of the 90 %
intervals in % over the vehicles that are not healthy, and writes mismatch.csv and mismatch.md.
Models and trips stay in DIR; models found there are taken as they are.
"""

import csv
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from cells import Parser, Row, at_least
from tabulate import tabulate

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from rich_trips import EFFECTS, SENSORS, drawn_ratios, write_rich_trips  # noqa: E402

from suspnet.model import TrainedModel  # noqa: E402
from suspnet.model.checkpoint import load_model  # noqa: E402
from suspnet.model.from_recording import TripSettings  # noqa: E402
from suspnet.recordings.manifest import find_manifests  # noqa: E402
from suspnet.simulation import Fleet  # noqa: E402
from suspnet.trips.records import OK, TripResult, relative_to_first  # noqa: E402
from suspnet.trips.trip import evaluate_trip  # noqa: E402

RESULTS = Path(__file__).parent / "results"
SAMPLED = {
    "bogie_mass": 0.10,
    "half_wheelbase": 0.10,
    "half_pivot_distance": 0.10,
    "bogie_gyration": 0.15,
    "body_gyration": 0.15,
    "speed": 0.02,
}
UNCERTAIN = [f"+generator.distribution.{name}={width}" for name, width in SAMPLED.items()]
READINGS = {
    "nominal": [],
    "sampled": UNCERTAIN,
    "sampled, to 6.5 Hz": [*UNCERTAIN, "protocol.curve.high_hz=6.5"],
}
"""Models, by what they are trained with beyond experiment=trips."""


def bias(results: Sequence[TripResult], name: str) -> float:
    """Return the mean relative error of one output, [%]."""
    return float(np.mean(errors_percent(results, name)))


def rms(results: Sequence[TripResult], name: str) -> float:
    """Return the rms relative error of one output, [%]."""
    return float(np.sqrt(np.mean(np.square(errors_percent(results, name)))))


def coverage(results: Sequence[TripResult], name: str) -> float:
    """Return how often the 90 % interval of one output holds the truth, [%]."""
    limits = [r.interval(name) for r in results]
    held = [low <= r.truth[name] <= high for r, (low, high) in zip(results, limits, strict=True)]
    return 100 * float(np.mean(held))


MEASURES: dict[str, Callable[[Sequence[TripResult], str], float]] = {
    "bias_percent": bias,
    "rms_percent": rms,
    "coverage_percent": coverage,
}
"""Columns of the CSV for each output, from the trips that have an estimate; add one here."""
IN_TABLE = ("bias_percent", "rms_percent", "coverage_percent")
"""Those that the table shows, parted by a slash."""


def errors_percent(results: Sequence[TripResult], name: str) -> list[float]:
    """Return the error of each estimate relative to the truth, [%]."""
    return [100 * (r.estimates[name] / r.truth[name] - 1) for r in results]


def train(folder: Path, overrides: Sequence[str]) -> TrainedModel:
    """Return the model of a folder, trained first if there is none."""
    if not folder.exists():
        rates = [sensor["rate_hz"] for sensor in SENSORS.values()]
        command = [sys.executable, "train.py", "experiment=trips", "threads=1", "progress=false"]
        command += [f"data.rates_hz={rates}", f"hydra.run.dir={folder}", *overrides]
        subprocess.run(command, cwd=ROOT, check=True, stdout=sys.stderr)
    return load_model(folder)


def parts(effect: str) -> tuple[str, ...]:
    """Return the effects behind a name on the command line, such as all or bending+contact."""
    names = {"none": (), "all": EFFECTS}.get(effect, tuple(effect.split("+")))
    unknown = sorted(set(names) - set(EFFECTS))
    if unknown:
        raise ValueError(f"effects must be none, all or some of {EFFECTS} joined by +: {unknown}")
    return names


def read(trips: Path, models: Mapping[str, TrainedModel], n_healthy: int, effect: str) -> list[Row]:
    """Return a row for each model, reference and output."""
    rows = []
    for reading, model in models.items():
        results = [evaluate_trip(p, [model], TripSettings()) for p in find_manifests(trips)]
        for reason in sorted({r.reason for r in results if r.status != OK}):
            print(f"{effect}, {reading}: {reason}", file=sys.stderr)
        found = {"vehicle": results}
        if all(r.status == OK for r in results[:n_healthy]):
            found["first_trips"] = relative_to_first(results, n_healthy)
        for reference, trips_read in found.items():
            done = [r for r in trips_read[n_healthy:] if r.status == OK]
            head = {"effect": effect, "trained": reading, "reference": reference}
            head |= {"n_trips": len(results) - n_healthy, "n_read": len(done)}
            head |= {"n_flagged": sum(bool(r.flags) for r in done)}
            for name in model.task.outputs:
                measured = {key: one(done, name) for key, one in MEASURES.items() if done}
                rows.append(head | {"output": name} | measured)
    return rows


def run_all(options, folder: Path) -> list[Row]:
    """Simulate and read each effect; the CSV is complete up to the last at any time."""
    rows: list[Row] = []
    models = {
        name: train(folder / f"model_{list(READINGS).index(name)}", READINGS[name] + options.train)
        for name in options.readings
    }
    fleet = Fleet(n_trips=options.healthy + options.trips, minutes=options.minutes, sensors=SENSORS)
    ratios = drawn_ratios(options.healthy, fleet, options.seed)
    for effect in options.effects:
        trips = folder / effect
        if trips.exists():
            shutil.rmtree(trips)
        start = time.perf_counter()
        write_rich_trips(trips, parts(effect), ratios, fleet, options.seed)
        written = time.perf_counter()
        rows += read(trips, models, options.healthy, effect)
        seconds = (
            f"simulated in {written - start:.0f} s, read in {time.perf_counter() - written:.0f}"
        )
        print(f"{effect}: {fleet.n_trips} trips {seconds} s", file=sys.stderr)
        write(rows, options.output)
        if not options.keep:
            shutil.rmtree(trips)
    return rows


def write(rows: Sequence[Row], output: Path) -> None:
    """Write the rows so far to mismatch.csv."""
    with (output / "mismatch.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, dict.fromkeys(key for row in rows for key in row))
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})


def table(rows: Sequence[Row]) -> str:
    """Return one line for each effect, model and reference."""
    lines: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        key = (row["effect"], row["trained"], row["reference"])
        counts = [f"{row['n_read']} of {row['n_trips']}", str(row["n_flagged"])]
        line = lines.setdefault(key, [*key, *counts])
        line.append(" / ".join(short(row.get(k)) for k in IN_TABLE))
    outputs = list(dict.fromkeys(row["output"] for row in rows))
    headers = ["effect", "trained", "healthy is", "read", "flagged", *outputs]
    return tabulate(list(lines.values()), headers, tablefmt="pipe", disable_numparse=True)


def short(percent: float | None) -> str:
    """Return two digits, all of those before the point."""
    if percent is None:
        return "-"
    return f"{percent:.0f}" if abs(percent) >= 9.95 else f"{percent:.2g}"


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--effects",
        nargs="+",
        default=["none", *EFFECTS, "all"],
        help=f"none, all, or some of {', '.join(EFFECTS)}, joined by +",
    )
    parser.add_argument("--readings", nargs="+", choices=READINGS, default=list(READINGS))
    parser.add_argument("--trips", type=at_least(1), default=16, help="vehicles, a trip each")
    parser.add_argument("--healthy", type=at_least(1), default=5, help="first trips, the reference")
    parser.add_argument("--minutes", type=at_least(1, float), default=20.0, help="of a trip")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--train", nargs="+", default=[], help="more overrides for train.py")
    parser.add_argument("--folder", type=Path, help="of models and trips; default: a temporary one")
    parser.add_argument("--keep", action="store_true", help="keep the trips: 11 MB each")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the tables")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        for effect in options.effects:
            parts(effect)
        options.output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as temporary:
            rows = run_all(options, (options.folder or Path(temporary)).resolve())
    except (OSError, ValueError) as error:
        parser.error(f"{error}")
    words = (
        f"{options.trips} vehicles after {options.healthy} healthy trips, {options.minutes:g} "
        f"minutes each, seed {options.seed}; bias / rms error in %"
    )
    text = f"{table(rows)}\n\n{words}\n"
    (options.output / "mismatch.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
