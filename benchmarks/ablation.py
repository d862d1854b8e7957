"""Where accuracy is lost between the curve and the estimate: one change at a time from a baseline.

python benchmarks/ablation.py [NAME ...] [--output FOLDER] [--with protocol=joint group=all]

Trains the baseline and each change of ``CHANGES``, or those that are named, and prints the rms
error of each output over the Cramer-Rao bound of the curves, that bound of the features over the
curves', which no unbiased regression on them passes, test curves that lack a feature, and seconds.
Runs of FOLDER that have finished are not trained again. Writes ablation.csv there.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from cells import Parser, Row
from feature_information import feature_information
from tabulate import tabulate

from suspnet import Problem, TrainedModel, load_model
from suspnet.bounds.information import cramer_rao, output_bounds, over_bound
from suspnet.curves.problem import TEST
from suspnet.ground.storage import read_json, write_atomically
from suspnet.runs.tables import in_digits, records_csv

ROOT = Path(__file__).parents[1]
N_VEHICLES = 256
"""Test vehicles over which the bounds of features are averaged."""
BASELINE = (
    "model=msvr figures=false data.n_calibrate=null data.n_test=4000 data.n_train=20000 "
    "model.C=1e4 model.sigma=3 model.epsilon=1e-6 model.feature_map=rff model.n_components=1024"
)
WIDE = "protocol.feature_set=curve model.sigma=8 protocol.curve.n_components"
"""Components of the whole curve are noisier than its peaks, so the kernel is wider."""
CHANGES = {
    "baseline": "",
    "C_100": "model.C=100",  # with epsilon_1e-3 the edge of the paper's Table V
    "C_1e6": "model.C=1e6",
    "epsilon_1e-3": "model.epsilon=1e-3",
    "sigma_1.7": "model.sigma=1.7",
    "sigma_5.5": "model.sigma=5.5",
    **{f"rff_{n}": f"model.n_components={n}" for n in (256, 512, 2048)},
    "orf": "model.feature_map=orf",
    "nystroem_512": "model.feature_map=nystroem model.n_components=512",
    "gaussian": "protocol.features.shape=gaussian",
    "window_narrow": "protocol.features.window=0.7",
    "window_wide": "protocol.features.window=1.4",
    "smoothing_less": "protocol.features.smoothing_hz=0.1",
    "smoothing_more": "protocol.features.smoothing_hz=0.4",
    **{f"curve_{n}": f"{WIDE}={n}" for n in (6, 9, 12, 20)},
    "curves_5000": "data.n_train=5000",
    "curves_80000": "data.n_train=80000",
    "noise_26_db": "data.snr_db=26",
    "noise_54_db": "data.snr_db=54",
    "mass_known": "protocol.mass_known=true",
    "log_ratios_off": "protocol.log_ratios=false",
}
"""Overrides of train.py by the name of a change."""


def trained(name: str, overrides: list[str], folder: Path) -> Path:
    """Return the folder of a run, trained unless it has finished."""
    if not (folder / "metrics.json").exists():
        words = [*BASELINE.split(), *overrides, *CHANGES[name].split(), f"hydra.run.dir={folder}"]
        subprocess.run([sys.executable, ROOT / "train.py", *words], check=True, cwd=ROOT)
    return folder


def features_ratio(model: TrainedModel) -> dict[str, float]:
    """Return the bound of each output from the features over that from the curves."""
    settings = replace(model.settings, n_test=N_VEHICLES)
    problem = Problem(model.generator, model.task, settings, model.training["seed"])
    task, ratios = model.task, problem.ratios(TEST)
    n_draws = max(64, 4 * len(task.extractor.names))
    information = feature_information(
        problem.observer, task.extractor, ratios, task.unknown, n_draws=n_draws
    )
    found = np.isfinite(information).all(axis=(1, 2))  # vehicles that have every feature
    asked = [task.unknown.index(name) for name in task.outputs]
    truth = ratios[found][:, task.output_indices]
    of_features = cramer_rao(information[found])[:, asked]
    bounds = of_features, output_bounds(task, problem.observer, ratios[found])
    ratio = over_bound(*(np.sqrt(np.mean((bound / truth) ** 2, axis=0)) for bound in bounds))
    return dict(zip(task.outputs, ratio.tolist(), strict=True))


def records(name: str, folder: Path) -> list[Row]:
    """Return a row for each output of a run."""
    run, loss = read_json(folder / "metrics.json"), features_ratio(load_model(folder))
    return [
        {
            "ablation": name,
            "change": CHANGES[name],
            "output": output,
            "rms_ratio": ratio,
            "features_ratio": loss.get(output),
            "mape_percent": run["scores"][output]["mape_percent"],
            "lost_percent": 100 * (1 - run["n_test_complete"] / run["n_test"]),
            "seconds": run["seconds"],
        }
        for output, ratio in run["rms_ratio"].items()
    ]


def table(rows: list[Row]) -> str:
    """Return a line for each change: errors and the bounds of its features by output."""
    outputs = dict.fromkeys(row["output"] for row in rows)
    lines = []
    for name in dict.fromkeys(row["ablation"] for row in rows):
        own = {row["output"]: row for row in rows if row["ablation"] == name}
        line = [name]
        for output in outputs:
            keys = ("rms_ratio", "features_ratio", "mape_percent")
            line += [in_digits(own[output][key]) for key in keys]
        first = next(iter(own.values()))
        lines.append([*line, in_digits(first["lost_percent"]), in_digits(first["seconds"])])
    header = [name for output in outputs for name in (output, "features", "MAPE %")]
    return tabulate(lines, ["ablation", *header, "lost %", "seconds"], "github")


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CHANGES))
    parser.add_argument("--with", nargs="+", default=[], dest="overrides", metavar="KEY=VALUE")
    parser.add_argument("--output", type=Path, default=ROOT / "outputs" / "ablation")
    options = parser.parse_args()
    if unknown := set(options.names) - CHANGES.keys():
        parser.error(f"NAME must be one of {', '.join(CHANGES)}; got {', '.join(unknown)}")
    folder = options.output.resolve()
    rows = [
        row
        for name in options.names or CHANGES
        for row in records(name, trained(name, options.overrides, folder / name))
    ]
    write_atomically(folder / "ablation.csv", records_csv(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
