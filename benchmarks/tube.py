"""The study of the tube: where epsilon, and one tube for all outputs, lower the error of MSVR.

python benchmarks/tube.py [--workers 16]    # 10 minutes
python benchmarks/tube.py --protocol multi_location --n-outputs 2 --no-sines

At epsilon = 0 MSVR is kernel ridge regression. A tube can help where the labels, the stiffness and
damping of the training curves, are wrong by bounded amounts. The study gives them errors of several
kinds, all with the rms error of uniform ones within a tolerance, tunes on these labels as a user
would, and scores against the truth. The inputs are the features of the protocol's first group.
"""

from __future__ import annotations

from argparse import ArgumentTypeError, Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
from cells import Parser, at_least
from matplotlib.figure import Figure
from sklearn.multioutput import MultiOutputRegressor
from tqdm import tqdm

from suspnet import CurveSettings, QuarterCar, read_protocol, read_vehicles
from suspnet.curves.problem import TEST, TRAIN, Problem
from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.types import FloatArray
from suspnet.ground.workers import LostWorkerError, each
from suspnet.learning import MSVR, Scaling
from suspnet.learning.search import GridSearch
from suspnet.runs.plots import grid
from suspnet.runs.tables import Record, grouped, markdown, write_study

STUDIED = ("exact", "uniform_5", "uniform_10", "ball_10", "sphere_10", "steps_10", "normal_10")
"""Errors of the labels that are studied unless others are named: kind and tolerance in percent."""
LABELS = {
    "exact": "none",
    "uniform": "uniform within ±{:g} %",
    "ball": "uniform in a ball",
    "sphere": "of constant length",
    "steps": "steps of {:g} %",
    "normal": "normal",
}
"""Title of each kind of errors of the labels."""
SINES = "sines"
"""Name of the problem whose inputs have no noise."""
RIDGE_GRID = {"C": [10.0, 100.0, 1e3, 1e4], "sigma": [1.0, 1.7, 3.0, 5.5, 10.0], "epsilon": [0.0]}
EPSILONS = [0.1, 0.2, 0.4]
"""Radii of the tube that are tried, in deviations of the outputs."""
FACTORS = (1.0, 10.0)
"""Factors on the best C of ridge regression: a tube leaves less loss, so its best C is larger."""
PREFIXES = {"joint": "", "separate": "estimator__"}
"""Prefix of the settings of MSVR in the estimator of each method."""
N_TUNE = 400
"""Number of curves that settings are tuned on; larger problems are studied with few outputs."""
MOST_EXACT = 1000
"""Largest number of curves with the exact kernel; 256 landmarks take its place above."""
CAPTION = (
    "Each cell: the error of MSVR with a joint tube over that of kernel ridge regression "
    "(epsilon = 0), mean ± deviation over seeds; in brackets the same with the epsilon that is "
    "best on the test curves; then the error over that of a separate tube for each output. C, "
    f"sigma and epsilon are chosen by five-fold cross-validation on the labels of at most {N_TUNE} "
    "curves. Errors are rms over test curves and outputs, against the truth, in deviations of the "
    "output."
)


@dataclass(frozen=True)
class _Cell:
    """Inputs and true outputs of one problem, for training and test, and how to spoil the labels.

    `at` are the place of the labels in the study and the seed.
    """

    problem: str
    label: str
    at: tuple[int, int]
    arrays: Sequence[FloatArray]
    n_train: Sequence[int]


@dataclass
class _Trial:
    """The best values of C and sigma at one epsilon, with errors in cross-validation and test."""

    method: str
    epsilon: float
    values: dict[str, Any]
    rmse: float
    percent: float = float("inf")


def write_tube(study: Namespace) -> list[Record]:
    """Write tube.csv, .json, .md and .png; print the table; return one record for each seed."""
    generator = QuarterCar(read_vehicles()["am96"])
    settings = CurveSettings(n_train=max(study.n_train), n_test=1000)
    protocol = read_protocol(study.protocol)
    task = protocol.task(next(iter(protocol.groups)))
    task = replace(task, outputs=PARAMETERS[: max(study.n_outputs)])
    cells = []
    for seed in range(study.seed, study.seed + study.n_seeds):
        problem = Problem(generator, task, settings, seed)
        train, test = (problem.features(stream).complete() for stream in (TRAIN, TEST))
        curves = train.inputs, train.outputs, test.inputs, test.outputs
        cells += _cells(study, protocol.name, seed, curves)
        if not study.no_sines:
            sines = _sines(seed, len(train.inputs), len(test.inputs))
            cells += _cells(study, SINES, seed, sines)
    records = []
    for _, compared in tqdm(each(_compared, cells, study.workers), "tube", len(cells)):
        if isinstance(compared, LostWorkerError):
            raise compared
        records += compared
    records.sort(key=lambda r: (r["n_train"], r["seed"]))  # the pool has no order
    labels = list(study.labels)
    records.sort(key=lambda r: (r["problem"] == SINES, r["n_outputs"], labels.index(r["labels"])))
    text = f"{CAPTION}\n\n{tube_markdown(records)}\n"
    figures = {"tube": tube_figure(records)}
    write_study(study.output, "tube", "Where the tube pays", text, records, records, figures)
    print(text)
    return records


def _cells(study: Namespace, problem: str, seed: int, arrays: Sequence[FloatArray]) -> list[_Cell]:
    X, Y, X_test, Y_test = arrays
    cells = []
    for n_outputs in study.n_outputs:
        is_first = n_outputs == study.n_outputs[0]
        sizes = [n for n in study.n_train if is_first or n <= N_TUNE]
        own = X, Y[:, :n_outputs], X_test, Y_test[:, :n_outputs]
        cells += [
            _Cell(problem, label, (seed, place), own, sizes)
            for place, label in enumerate(study.labels)
        ]
    return cells


def _sines(seed: int, *n_samples: int) -> list[FloatArray]:
    """Return functions of two inputs with about the mean and deviation of the parameters."""
    rng = np.random.default_rng([seed, 0])
    slopes = np.array([[3.0, -2.0, 1.0, 2.5], [1.0, 2.0, -3.0, 2.5]])
    arrays: list[FloatArray] = []
    for n in n_samples:
        X = rng.uniform(-1, 1, (n, 2))
        arrays += [X, 1 + 0.45 * np.sin(X @ slopes + np.array([0.0, 0.5, 1.0, 1.5]))]
    return arrays


def with_errors(label: str, values: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return values (n, n_outputs) with the relative errors that a label such as uniform_5 names.

    Each output's rms error is t / sqrt(3), with the tolerance t; steps are 2 t of healthy wide.
    """
    kind, _, percent = label.partition("_")
    t, n_outputs = float(percent or 0) / 100, values.shape[1]
    if kind == "steps":
        return np.asarray(2 * t * np.round(values / (2 * t)))
    normal = rng.normal(size=values.shape)
    lengths = np.linalg.norm(normal, axis=1, keepdims=True)
    radii = rng.uniform(size=lengths.shape) ** (1 / n_outputs)
    errors = {
        "exact": np.zeros_like(values),
        "uniform": np.sqrt(3) * rng.uniform(-1, 1, values.shape),
        "normal": normal,
        "sphere": np.sqrt(n_outputs) * normal / lengths,
        "ball": np.sqrt(n_outputs + 2) * radii * normal / lengths,
    }
    return np.asarray(values * (1 + t / np.sqrt(3) * errors[kind]))


def _compared(cell: _Cell) -> list[Record]:
    """Return a record for each number of training curves."""
    X, truth, X_test, Y_test = cell.arrays
    Y = with_errors(cell.label, truth, np.random.default_rng([*cell.at, 1]))
    records, tuned = [], {}
    for n_train in cell.n_train:
        inputs, outputs = (Scaling.of(values[:n_train], log=False) for values in (X, Y))
        A, B = inputs.apply(X[:n_train]), outputs.apply(Y[:n_train])
        # larger problems share the settings of the first N_TUNE curves, which are found once
        n_tune = min(n_train, N_TUNE)
        if n_tune not in tuned:
            tuned[n_tune] = _tuned(A[:n_tune], B[:n_tune], cell.at[0])
        ridge, *trials = tuned[n_tune]
        # a radius of 0 is among the choices of both, joint and separate tubes
        separate = min((t for t in (ridge, *trials) if t.method != "joint"), key=_rmse)
        joint = [t for t in (ridge, *trials) if t.method != "separate"]
        # each is fitted again on all curves, and scored against the truth
        for trial in (*joint, separate):
            model = _estimator(trial.method, n_train).set_params(**trial.values).fit(A, B)
            wrong = outputs.undo(model.predict(inputs.apply(X_test))) - Y_test
            trial.percent = 100 * float(np.sqrt(np.mean((wrong / Y_test.std(axis=0)) ** 2)))
        chosen, best = min(joint, key=_rmse), min(joint, key=lambda t: t.percent)
        records.append(
            {
                "problem": cell.problem,
                "n_outputs": Y.shape[1],
                "labels": cell.label,
                "n_train": n_train,
                "seed": cell.at[0],
                "ridge_percent": ridge.percent,
                "joint_percent": chosen.percent,
                "separate_percent": separate.percent,
                "best_percent": best.percent,
                "epsilon": chosen.epsilon,
                "best_epsilon": best.epsilon,
                "separate_epsilon": separate.epsilon,
            }
        )
    return records


def _tuned(X: FloatArray, Y: FloatArray, seed: int) -> list[_Trial]:
    """Return the trial of least cross-validated RMSE of ridge regression, then of each tube."""
    # equations without a tube are linear, so that the whole box of C and sigma is cheap
    first = _trials("ridge", RIDGE_GRID, X, Y, seed)[0].values
    near = {"C": [first["C"] * factor for factor in FACTORS], "sigma": [first["sigma"]]}
    # ridge regression has the same values of C as the tubes
    ridge = _trials("ridge", {**near, "epsilon": [0.0]}, X, Y, seed)
    joint, separate = (
        _trials(name, {**near, "epsilon": EPSILONS}, X, Y, seed) for name in ("joint", "separate")
    )
    return [*ridge, *joint, *separate]


def _trials(
    method: str, grid: Mapping[str, Sequence[float]], X: FloatArray, Y: FloatArray, seed: int
) -> list[_Trial]:
    """Return the best trial of each epsilon."""
    prefix = PREFIXES.get(method, "")
    grids = {method: {prefix + name: values for name, values in grid.items()}}
    unscaled = Scaling(np.zeros(Y.shape[1]), np.ones(Y.shape[1]), log=False)
    result = GridSearch(grids, seed=seed).run(method, _estimator(method, len(X)), X, Y, unscaled)
    every = [
        _Trial(method, values[f"{prefix}epsilon"], values, rmse)
        for values, rmse in zip(result.settings, result.rmse, strict=True)
    ]
    return [
        min((t for t in every if t.epsilon == epsilon), key=_rmse) for epsilon in grid["epsilon"]
    ]


def _rmse(trial: _Trial) -> float:
    return trial.rmse


def _estimator(method: str, n_train: int) -> Any:
    model = MSVR(feature_map="exact", tol=1e-4)  # errors within 0.1 %
    if n_train > MOST_EXACT:
        model.set_params(feature_map="nystroem", n_components=256)
    return MultiOutputRegressor(model) if method == "separate" else model


def label_title(label: str) -> str:
    """Return the errors of labels as text.

    >>> label_title("steps_10")
    'steps of 20 %'
    """
    kind, _, percent = label.partition("_")
    return LABELS[kind].format(float(percent or 0) * (2 if kind == "steps" else 1))


def _ratio(records: Sequence[Record], over: str, method: str = "joint") -> tuple[float, float]:
    """Return mean and deviation over seeds of a method's error over another one's."""
    ratios = [r[f"{method}_percent"] / r[f"{over}_percent"] for r in records]
    return fmean(ratios), stdev(ratios) if len(ratios) > 1 else 0.0


def tube_markdown(records: Sequence[Record]) -> str:
    """Return a row for each problem and kind of labels, a column for each number of curves."""
    sizes = sorted({r["n_train"] for r in records})
    rows = []
    groups = grouped(records, "problem", "n_outputs", "labels")
    for (problem, n_outputs, label), same in groups.items():
        by_size = grouped(same, "n_train")
        cells = [_cell_text(by_size[size,]) if (size,) in by_size else "-" for size in sizes]
        rows.append([problem, str(n_outputs), label_title(label), *cells])
    header = ["inputs", "outputs", "errors of labels", *(f"n = {size}" for size in sizes)]
    return markdown(rows, header)


def _cell_text(records: Sequence[Record]) -> str:
    mean, deviation = _ratio(records, "ridge")
    best, separate = _ratio(records, "ridge", "best")[0], _ratio(records, "separate")[0]
    return f"{mean:.2f} ± {deviation:.2f} ({best:.2f}), {separate:.2f}"


def tube_figure(records: Sequence[Record]) -> Figure:
    """Draw the error of the joint tube over ridge regression's against the number of curves."""
    panels = grouped(records, "problem", "n_outputs")
    figure, (axes,) = grid(1, len(panels), size=(5.2, 5.6), sharey=True)
    for axis, ((problem, n_outputs), panel) in zip(axes, panels.items(), strict=True):
        axis.axhline(1, color="black", lw=1)
        sizes = sorted({r["n_train"] for r in panel})
        for (label,), same in grouped(panel, "labels").items():
            by_size = grouped(same, "n_train")
            mean, deviation = np.array([_ratio(some, "ridge") for some in by_size.values()]).T
            axis.errorbar(sizes, mean, deviation, fmt="o-", capsize=3, label=label_title(label))
        axis.set_title(f"{problem}, {n_outputs} outputs", fontsize=12)
        axis.set_xlabel("training curves", fontsize=12)
        axis.set_xscale("log")
        axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
        axis.minorticks_off()
        axis.tick_params(labelsize=12)
    axes[0].set_ylabel("error over ridge regression's", fontsize=12)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2 * len(panels), fontsize=12)
    return figure


def label(text: str) -> str:
    """Return a kind of errors of the labels, as uniform_5, if there is such a kind."""
    kind, _, percent = text.partition("_")
    if kind not in LABELS or (kind != "exact" and not 0 < float(percent or 0) < 50):
        raise ArgumentTypeError(f"must be one of {', '.join(LABELS)}, as uniform_5, got {text!r}")
    return text


if __name__ == "__main__":
    parser = Parser(description="Where the tube of MSVR lowers the error.")
    parser.add_argument("--labels", nargs="+", type=label, default=list(STUDIED))
    parser.add_argument("--n-train", nargs="+", type=at_least(10), default=[60, 200, 1000, 5000])
    parser.add_argument("--n-outputs", nargs="+", type=int, choices=(2, 3, 4), default=[2, 4])
    parser.add_argument("--no-sines", action="store_true", help="study curves alone")
    parser.add_argument("--n-seeds", type=at_least(2), default=5)
    parser.add_argument("--seed", type=at_least(0), default=0)
    parser.add_argument("--protocol", default="paper")
    parser.add_argument("--workers", type=at_least(1), default=2)
    parser.add_argument("--output", type=Path, default=Path("outputs/tube"))
    write_tube(parser.parse_args())
