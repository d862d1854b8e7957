"""How often the intervals of calibrated models hold the truth, on fresh curves.

python benchmarks/interval_coverage.py

Trains MSVR (20,000 curves) and MV-GPR (5,000) as configured, seed 0, with 30,000 calibration
curves; measures 90 % intervals on 20,000 fresh curves, seed 1000. Prints the table of docs/trust.md
and
writes coverage.csv: one row for each kind of interval and output, with the coverage of the least
and the most covered fifth of any parameter, and the share of curves that are flagged.
"""

import argparse
import csv
import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from cells import Parser, Row, at_least
from hydra import compose, initialize_config_dir
from reliability import IN_RANGE, Reliability, measure
from tabulate import tabulate

from suspnet.cli import program  # noqa: F401 - makes our resolvers known to Hydra
from suspnet.cli.kinds import build
from suspnet.curves.problem import Problem
from suspnet.estimation.checkpoint import load_model
from suspnet.runs.train import train

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
CASES = {
    "msvr": [("multi_location", "primary"), ("multi_location", "secondary"), ("joint", "all")],
    "mvgpr": [("multi_location", "primary"), ("multi_location", "secondary")],
}
N_TRAIN = {"msvr": 20_000, "mvgpr": 5_000}


def reliability(model: str, protocol: str, group: str, options: argparse.Namespace) -> Reliability:
    """Train and calibrate one model, and measure it on fresh curves."""
    overrides = [
        f"model={model}",
        f"protocol={protocol}",
        f"group={group}",
        f"data.n_train={N_TRAIN[model]}",
    ]
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        config = compose("train", overrides)
    task = build(config, "protocol").task(group)
    problem = Problem(
        build(config, "generator"), task, build(config, "data"), config.seed, options.threads
    )
    with tempfile.TemporaryDirectory() as folder:
        train(problem, build(config, "model"), Path(folder), figures=False)
        trained = load_model(folder)
    settings = replace(trained.settings, n_test=options.n_test)
    fresh = Problem(trained.generator, trained.task, settings, options.seed, options.threads)
    return measure(fresh, trained, {}, n_odd=1)


def rows_of(
    model: str, protocol: str, group: str, found: Reliability, options: argparse.Namespace
) -> list[Row]:
    """Return one row for each kind of interval and output."""
    rows = []
    case = {"model": model, "protocol": protocol, "group": group}
    setting = {
        "n_train": N_TRAIN[model],
        "n_test": options.n_test,
        "seed": options.seed,
        "flagged_percent": found.flags[IN_RANGE]["any"],
    }
    for kind, scores in found.intervals.items():
        for output, values in scores["outputs"].items():
            fifths = [v for by in scores["slices"].values() for v in by[output] if math.isfinite(v)]
            shares = {"least_fifth_percent": min(fifths), "largest_fifth_percent": max(fifths)}
            rows.append(case | {"interval": kind, "output": output} | values | shares | setting)
        joint = {"output": "all at once", "coverage_percent": scores["joint_coverage_percent"]}
        rows.append(case | {"interval": kind} | joint | setting)
    return rows


def table(rows: Sequence[Row]) -> str:
    """Return coverage % (half width %) of each model's intervals as Markdown."""
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        protocol = row["protocol"]
        line = lines.setdefault((row["model"], protocol, row["interval"]), {})
        text = f"{row['coverage_percent']:.1f}"
        if "half_width_percent" in row:
            text += f" ({row['half_width_percent']:.2g})"
        line[row["output"]] = ", ".join(filter(None, [line.get(row["output"]), text]))
        for key, best in (("least_fifth_percent", min), ("largest_fifth_percent", max)):
            if key in row:
                line[key] = f"{best(row[key], float(line.get(key, row[key]))):.1f}"
    keys = [
        "k_p",
        "c_p",
        "k_s",
        "c_s",
        "all at once",
        "least_fifth_percent",
        "largest_fifth_percent",
    ]
    body = [[*name, *(line.get(key, "-") for key in keys)] for name, line in lines.items()]
    header = ["model", "protocol", "interval", *keys[:5], "least fifth", "largest fifth"]
    return tabulate(body, header, tablefmt="github", disable_numparse=True)


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--n-test", type=at_least(100), default=20_000)
    parser.add_argument("--seed", type=at_least(1), default=1000, help="of the fresh curves")
    parser.add_argument("--threads", type=at_least(1), default=1)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the CSV")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    rows: list[Row] = []
    for model in options.models:
        for protocol, group in CASES[model]:
            found = reliability(model, protocol, group, options)
            rows += rows_of(model, protocol, group, found, options)
    options.output.mkdir(parents=True, exist_ok=True)
    with open(options.output / "coverage.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(table(rows))


if __name__ == "__main__":
    main()
