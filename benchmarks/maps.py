"""Which feature map gives the best accuracy per second for the features of suspnet's own curves.

python benchmarks/maps.py

Protocol `multi_location` of the AM96, seed 0: nine inputs, and the six of the peaks `secondary` and
`primary_lower`; 4,000 test curves. Prints a table in which * marks what no other map beats in
both error and seconds at the same inputs and n, and writes maps.csv.
"""

import argparse
import itertools
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import joblib
import numpy as np
from cells import WARM_UP, Parser, Row, at_least, machine, measured, run_cell, serve, write_rows
from tabulate import tabulate

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
SIZES = [20_000, 364_816]
PEAKS = {9: "[secondary,primary_lower,primary_upper]", 6: "[secondary,primary_lower]"}
EPSILON = 1e-3
MAPS = [
    *[(name, n) for name in ("rff", "orf") for n in (512, 1024, 2048, 4096)],
    *[("nystroem", n) for n in (256, 512, 1024, 2048)],
]


def prepare(n_inputs: int, n: int, group: str, path: Path) -> None:
    """Write scaled training and test data, made as train.py does."""
    from hydra import compose, initialize_config_dir

    from suspnet.cli.kinds import build
    from suspnet.curves.problem import TEST, TRAIN, Problem
    from suspnet.runs.fit import scalings

    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        config = compose(
            "train",
            [
                f"group={group}",
                f"+protocol.groups.{group}.peaks={PEAKS[n_inputs]}",
            ],
        )
    task = build(config, "protocol").task(group)
    n_train = "all" if n >= sum(task.grid_sizes) else n
    settings = replace(build(config, "data"), n_train=n_train, n_test=4000)
    problem = Problem(build(config, "generator"), task, settings, config.seed, joblib.cpu_count())
    train = problem.features(TRAIN).complete()
    test = problem.features(TEST).complete()
    inputs, outputs = scalings(task, train)
    np.savez(
        path,
        X=inputs.apply(train.inputs),
        Y=outputs.apply(train.outputs),
        X_test=inputs.apply(test.inputs),
        actual=test.outputs,
        mean=outputs.mean,
        scale=outputs.scale,
        names=task.outputs,
    )


def measure(cell: Row) -> Row:
    """Return the measurements of one map with one setting."""
    from suspnet.learning import MSVR, Scaling
    from suspnet.learning.metrics import score

    data = np.load(cell["data"])
    model = MSVR(cell["C"], cell["sigma"], EPSILON, cell["map"], cell["asked"])
    found = measured(model, data["X"], data["Y"], cell["repeats"])
    predicted = Scaling(data["mean"], data["scale"]).undo(model.predict(data["X_test"]))
    names = data["names"].tolist()
    scores = score(data["actual"], predicted, names)
    found |= {name: scores[name]["mape_percent"] for name in names}
    found["error"] = float(np.sqrt(np.prod([found[name] for name in names])))
    found |= {"used": len(model.coef_), "n_iter": model.n_iter_, "converged": model.converged_}
    return found


def run_all(options: argparse.Namespace) -> list[Row]:
    """Measure every map with every setting; the CSV is complete up to the last at any time."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for inputs, n in itertools.product(options.inputs, options.n):
            path = Path(folder) / f"{inputs}_{n}.npz"
            prepare(inputs, n, options.group, path)
            for sigma, C, (kind, asked) in itertools.product(options.sigma, options.C, MAPS):
                setting = {"map": kind, "asked": asked, "sigma": sigma, "C": C}
                cell = {"data": str(path), "repeats": options.repeats, **setting}
                found = run_cell(__file__, cell, options.limit_s)
                rows.append({"inputs": inputs, "n": n, **setting, **found})
                mark_front(rows)
                write(rows, options.output)
                print(" ".join(f"{k}={v}" for k, v in rows[-1].items() if v != ""), file=sys.stderr)
    return rows


def mark_front(rows: Sequence[Row]) -> None:
    """Mark the rows that no other row of the same inputs and n beats in error and seconds."""
    for row in rows:
        row["front"] = "error" in row and not any(
            other["error"] <= row["error"] and other["seconds"] < row["seconds"]
            for other in rows
            if "error" in other and (other["inputs"], other["n"]) == (row["inputs"], row["n"])
        )


def write(rows: Sequence[Row], output: Path) -> None:
    """Write the rows so far to maps.csv."""
    write_rows(output / "maps.csv", rows)


def table(rows: Sequence[Row], outputs: Sequence[str]) -> str:
    """Return one line for each row."""
    lines = [
        [
            row["inputs"],
            row["n"],
            "*" if row["front"] else "",
            row["map"],
            row["asked"],
            row.get("used", "-"),
            row["sigma"],
            f"{row['C']:g}",
            *[f"{row[name]:.3g}" if name in row else "-" for name in outputs],
            f"{row['seconds']:.2f}" if "seconds" in row else row["failed"],
            row.get("n_iter", "-"),
            {True: "yes", False: "NO"}.get(row.get("converged"), "-"),
        ]
        for row in rows
    ]
    headers = ["inputs", "n", "front", "map", "features", "used", "sigma", "C"]
    headers += [f"{name} MAPE %" for name in outputs] + ["s", "iterations", "converged"]
    return tabulate(lines, headers, tablefmt="pipe", disable_numparse=True)


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--n", nargs="+", type=at_least(WARM_UP), default=SIZES, help="numbers of curves"
    )
    parser.add_argument("--inputs", nargs="+", type=int, choices=PEAKS, default=list(PEAKS))
    parser.add_argument("--group", choices=("primary", "secondary"), default="primary")
    parser.add_argument("--sigma", nargs="+", type=at_least(1e-3, float), default=[1.0, 3.0])
    parser.add_argument("--C", nargs="+", type=at_least(1e-9, float), default=[1e2, 1e4])
    parser.add_argument(
        "--limit-s", type=at_least(1, float), default=300.0, help="end a fit after this"
    )
    parser.add_argument("--repeats", type=at_least(1), default=1, help="fits, of which the median")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the CSV")
    options = parser.parse_args()
    try:
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"{error}")
    print(machine())
    rows = run_all(options)
    rows.sort(key=lambda row: (row["inputs"], row["n"], row.get("error", np.inf)))
    outputs = {"primary": ["k_p", "c_p"], "secondary": ["k_s", "c_s"]}[options.group]
    print(table(rows, outputs))
    print("\nError: geometric mean of both MAPE. *: nothing else has less error in less time.")


if __name__ == "__main__":
    serve(measure) or main()
