"""Coverage of a calibrated model's intervals, and the share of curves that it flags.

python benchmarks/reliability.py outputs/train/RUN [--n-test 20000] [--n-odd 200]

Intervals are measured on fresh curves like the training curves, over all and in each fifth of each
parameter; flags on these and on curves that the model was not trained for: parameters out of range,
swapped sensors and vehicles of another type. The model is trained with data.n_calibrate=30000.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cells import Parser, at_least
from scipy.stats import norm
from tabulate import tabulate
from torch import Tensor

from suspnet.cli import program  # noqa: F401 - makes our resolvers known to Hydra
from suspnet.cli.kinds import read_vehicles
from suspnet.curves.problem import BLOCK, TEST, Problem
from suspnet.curves.protocols import BODY_MASS_COLUMN, Task
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.estimate import KINDS
from suspnet.estimation.from_curves import estimate_curves
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.learning import MVGPR
from suspnet.learning.metrics import covers, interval_scores
from suspnet.runs.evaluate import FreshCurves, find_runs
from suspnet.runs.predict import Outcome, predict_stream
from suspnet.runs.scores import LEVEL, label
from suspnet.runs.tables import MODEL_TITLES
from suspnet.vehicle import PARAMETERS, Vehicle

N_SLICES = 5
LOW, HIGH = 0.3, 2.5
"""Ratios to healthy outside the range of every protocol."""
IN_RANGE = "in range"


def measure(
    problem: Problem, model: TrainedModel, others: Mapping[str, Vehicle], n_odd: int
) -> Reliability:
    """Return coverage and flagged shares of one calibrated model."""
    outcome = predict_stream(problem, model, TEST, flags=True)
    assert outcome.flags is not None
    flags = {IN_RANGE: _shares(outcome.flags.found)}
    sets = dict(_odd_sets(problem, others, n_odd))
    observer = problem.observer
    for name, (ratios, curves) in sets.items():
        known = ratios[:, BODY_MASS_COLUMN] if problem.task.mass_known else None
        found = []
        for start in range(0, n_odd, BLOCK):
            rows = slice(start, start + BLOCK)
            mass = None if known is None else known[rows]
            found.append(estimate_curves(model, observer, curves[rows], LEVEL, mass).flags.found)
        flags[name] = _shares(np.concatenate(found))
    title = f"{MODEL_TITLES[label(model)]}, {model.task.protocol}/{model.task.group}"
    return Reliability(title, _intervals(problem, model, outcome), flags)


def _intervals(
    problem: Problem, model: TrainedModel, outcome: Outcome
) -> dict[str, dict[str, Any]]:
    intervals, scales = model.intervals, outcome.scales
    assert intervals is not None
    assert scales is not None
    kinds = {
        "conformal": tuple(
            intervals.ends(outcome.predicted, scales, LEVEL, joint) for joint in (False, True)
        )
    }
    if isinstance(model.estimator, MVGPR) and not model.refined:
        n_outputs = len(problem.task.outputs)
        kinds["GP's own"] = tuple(
            _gp_intervals(model, outcome.data.inputs, level)
            for level in (LEVEL, LEVEL ** (1 / n_outputs))
        )
    actual = outcome.data.outputs
    return {
        kind: interval_scores(actual, single, joint, problem.task.outputs)
        | {"slices": _slices(problem.task, outcome.data.ratios, covers(actual, single))}
        for kind, (single, joint) in kinds.items()
    }


def _gp_intervals(
    model: TrainedModel, inputs: FloatArray, level: float
) -> tuple[FloatArray, FloatArray]:
    assert model.output_scaling is not None
    mean, deviation = model.estimator.predict(model.scaled(inputs), return_std=True)
    half = norm.ppf((1 + level) / 2) * deviation
    return model.output_scaling.undo(mean - half), model.output_scaling.undo(mean + half)


def _slices(task: Task, ratios: FloatArray, within: BoolArray) -> dict[str, dict[str, list[float]]]:
    """Return the coverage [%] of each output in each fifth of each parameter that varies."""
    slices: dict[str, dict[str, list[float]]] = {}
    for name in task.varied:
        low, high = task.range(name)
        column = ratios[:, PARAMETERS.index(name)]
        place = np.clip(((column - low) / (high - low) * N_SLICES).astype(int), 0, N_SLICES - 1)
        slices[name] = {
            output: [_share(within[place == k, j]) for k in range(N_SLICES)]
            for j, output in enumerate(task.outputs)
        }
    return slices


def _share(within: BoolArray) -> float:
    return 100 * float(within.mean()) if len(within) else math.nan


def _odd_sets(
    problem: Problem, others: Mapping[str, Vehicle], n_odd: int
) -> Iterator[tuple[str, tuple[FloatArray, Tensor]]]:
    """Yield the name, ratios and noisy curves of sets that a model was not trained for."""
    task, observer = problem.task, problem.observer
    ratios = task.sample(n_odd, problem.seed, TEST)
    for column, name in enumerate(PARAMETERS):
        for value in (LOW, HIGH):
            odd = ratios.copy()
            odd[:, column] = value
            curves = observer.observe(torch.as_tensor(odd), problem.seed + 1)
            yield f"{name} at {100 * value:g} %", (odd, curves)
    curves = observer.observe(torch.as_tensor(ratios), problem.seed + 2)
    primary, secondary = curves.unbind(1)
    for title, swapped in {
        "axle box and bogie swapped": (1 / primary, primary * secondary),
        "bogie and body swapped": (primary * secondary, 1 / secondary),
        "axle box and body swapped": (1 / secondary, 1 / primary),
    }.items():
        yield title, (ratios, torch.stack(swapped, dim=1))
    for name, vehicle in others.items():
        if name != problem.vehicle.name:
            observer = problem.settings.observer(problem.generator.of(vehicle))
            yield f"vehicle {name}", (ratios, observer.observe(torch.as_tensor(ratios), 1))


def _shares(found: BoolArray) -> dict[str, float]:
    """Return the share of curves with each kind of flag, and with any flag, in %."""
    shares = dict(zip(KINDS, (100 * found.mean(axis=0)).tolist(), strict=True))
    return {"any": 100 * float(found.any(axis=1).mean())} | shares


@dataclass(frozen=True)
class Reliability:
    """Coverage and flags of one model; `name` is its method, protocol and group.

    `intervals`: ``interval_scores`` of each kind, with `slices`, the coverage of each output in
    each fifth of each parameter; `flags`: {set of curves: {kind of flag, or any: share [%]}}.
    """

    name: str
    intervals: dict[str, dict[str, Any]]
    flags: dict[str, dict[str, float]]


def markdown(one: Reliability) -> str:
    """Return one model's coverage and flags as Markdown."""
    rows = []
    for kind, scores in one.intervals.items():
        for output, values in scores["outputs"].items():
            sliced = [v for by in scores["slices"].values() for v in by[output] if math.isfinite(v)]
            row = [values["half_width_percent"], values["coverage_percent"]]
            rows.append([kind, output, *row, min(sliced), max(sliced)])
        rows.append([kind, "all at once", None, scores["joint_coverage_percent"], None, None])
    title = f"{100 * LEVEL:g} % interval"
    header = [title, "output", "+- %", "covers %", "least slice %", "largest slice %"]
    formats = ("", "", ".3g", ".2f", ".1f", ".1f")
    first = tabulate(rows, header, tablefmt="github", floatfmt=formats, missingval="-")
    flags = [[name, *shares.values()] for name, shares in one.flags.items()]
    header = ["curves", "flagged %", "peak missing", "beyond cloud", "out of range", "misfit"]
    second = tabulate(flags, header, tablefmt="github", floatfmt=".2f")
    return f"## {one.name}\n\n{first}\n\n{second}\n"


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a run, or of several")
    parser.add_argument("--n-test", type=at_least(1), default=20_000)
    parser.add_argument("--n-odd", type=at_least(1), default=200)
    parser.add_argument("--seed", type=at_least(0), default=1000)
    options = parser.parse_args()
    for path in find_runs(options.run):
        model = load_model(path)
        if model.intervals is None or model.ood is None:
            parser.error(f"the model of {path} was not calibrated: train with data.n_calibrate")
        problem = FreshCurves(options.seed, options.n_test).problem(model, path)
        print(markdown(measure(problem, model, read_vehicles(), options.n_odd)))


if __name__ == "__main__":
    main()
