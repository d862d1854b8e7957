"""The reliability study: coverage of prediction intervals, and how much is flagged.

Everything is measured on fresh curves: intervals on curves like the training curves, over all and
by slices of each parameter; flags on these and on curves that a model was not trained for.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm
from tabulate import tabulate
from torch import Tensor

from suspnet.dynamics import PARAMETERS, Vehicle
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.estimate import KINDS
from suspnet.estimation.from_curves import estimate_curves
from suspnet.estimation.problem import BLOCK, TEST, Problem
from suspnet.estimation.protocols import BODY_MASS_COLUMN, Task
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.settings import check_number
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.learning.metrics import covers, interval_scores
from suspnet.report.figures import SYMBOLS
from suspnet.runs.evaluate import FreshCurves, find_runs
from suspnet.runs.plots import BOUND_COLOUR, OUR_COLOUR
from suspnet.runs.predict import Outcome, predict_stream
from suspnet.runs.scores import LEVEL, label
from suspnet.runs.tables import MODEL_TITLES, write_study
from suspnet.spectra.observation import MOST_CURVES

log = logging.getLogger(__name__)
N_SLICES = 5
LOW, HIGH = 0.3, 2.5
"""Ratios to healthy outside the range of every protocol."""
IN_RANGE = "in range"
Record = dict[str, Any]
NOMINAL, TOLERANCE = 90.0, 1.5
"""Nominal coverage and the tolerance of a slice's coverage, both in %."""


def write_reliability(
    run: str,
    others: Mapping[str, Vehicle],
    folder: Path,
    fresh: FreshCurves,
    n_odd: int,
    device: str,
) -> list[Reliability]:
    """Write reliability.md, .csv, .json and .png of every model at or below `run`; print tables.

    `others`: vehicles of another type than the model's, by name; `fresh`: curves like the training
    curves; `n_odd`: curves in each set unlike them.
    """
    check_number("n_odd", n_odd, low=1, most=MOST_CURVES, whole=True)
    found = []
    for path in find_runs(Path(run)):
        model = load_model(path, device)
        if model.intervals is None or model.ood is None:
            raise ValueError(
                f"the model of {path} was not calibrated: train it with data.n_calibrate=30000"
            )
        problem = fresh.problem(model, path)
        found.append(measure(problem, model, others, n_odd))
    text = "\n".join(markdown(one) for one in found)
    content = {one.name: vars(one) for one in found}
    figures = {"reliability": reliability_figure(found)}
    write_study(folder, "reliability", text, content, list(records(found)), figures)
    log.info("%s\n-> %s/reliability.*", text, folder)
    return found


def measure(
    problem: Problem, model: TrainedModel, others: Mapping[str, Vehicle], n_odd: int
) -> Reliability:
    """Return coverage and flagged shares of one calibrated model."""
    outcome = predict_stream(problem, model, TEST, flags=True)
    assert outcome.flags is not None
    flags = {IN_RANGE: _shares(outcome.flags.found)}
    sets = dict(_odd_sets(problem, others, n_odd))
    observer = problem.observer
    n_all = len(sets) * n_odd
    with progress_bar("curves out of range", n_all, unit="curve", shown=problem.progress) as bar:
        for name, (ratios, curves) in sets.items():
            known = ratios[:, BODY_MASS_COLUMN] if problem.task.mass_known else None
            found = []
            for start in range(0, n_odd, BLOCK):
                rows = slice(start, start + BLOCK)
                mass = None if known is None else known[rows]
                found.append(
                    estimate_curves(model, observer, curves[rows], LEVEL, mass).flags.found
                )
                bar.update(len(found[-1]))
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
    if model.estimator.gives_deviations and not model.refined:
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


def records(found: list[Reliability]) -> Iterator[Record]:
    """Yield one record for each measured number: model, what, of, value [%]."""
    for one in found:
        for kind, scores in one.intervals.items():
            for output, values in scores["outputs"].items():
                for what, value in values.items():
                    yield _record(one, f"{kind} {what}", output, value)
            joint = scores["joint_coverage_percent"]
            yield _record(one, f"{kind} coverage_percent", "all at once", joint)
            for name, by_output in scores["slices"].items():
                for output, values in by_output.items():
                    for k, value in enumerate(values):
                        of = f"{output}, {name} in fifth {k + 1}"
                        yield _record(one, f"{kind} coverage_percent", of, value)
        for name, shares in one.flags.items():
            for kind, value in shares.items():
                yield _record(one, f"flagged_percent {kind}", name, value)


def _record(one: Reliability, what: str, of: str, value: float) -> Record:
    return {"model": one.name, "what": what, "of": of, "percent": value}


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


def reliability_figure(found: Sequence[Reliability]) -> Figure:
    """Draw the coverage of each parameter's slices and the share of flagged curves of each set."""
    height = max(3.2, 0.9 + 0.2 * len(found[0].flags))
    figure = Figure(figsize=(10.0, height * len(found)), layout="constrained")
    axes = figure.subplots(len(found), 2, squeeze=False, width_ratios=(1.3, 1))
    for one, (left, right) in zip(found, axes, strict=True):
        _draw_slices(left, one)
        left.set_title(one.name, fontsize="medium")
        _draw_flags(right, one)
    return figure


def _draw_slices(axis: Axes, one: Reliability) -> None:
    axis.axhspan(NOMINAL - TOLERANCE, NOMINAL + TOLERANCE, color="0.9")
    axis.axhline(NOMINAL, color=BOUND_COLOUR, lw=0.8)
    for style, scores in zip(("o-", "s--"), one.intervals.values(), strict=False):
        for place, by_output in enumerate(scores["slices"].values()):
            for j, (output, values) in enumerate(by_output.items()):
                x = [place + (k - 2) * 0.17 for k in range(len(values))]
                named = SYMBOLS[output] if place == 0 and style == "o-" else None
                axis.plot(x, values, style, color=f"C{j}", ms=3, lw=1, label=named)
    names = list(next(iter(one.intervals.values()))["slices"])
    axis.set_xticks(range(len(names)), [f"fifths of {SYMBOLS[name]}" for name in names])
    axis.set_ylabel(f"coverage of {NOMINAL:g} % intervals [%]")
    axis.margins(y=0.25)
    axis.legend(ncols=4, fontsize="small", loc="lower center")


def _draw_flags(axis: Axes, one: Reliability) -> None:
    names = list(one.flags)[::-1]
    values = [one.flags[name]["any"] for name in names]
    axis.barh(names, values, color=[OUR_COLOUR if v > 1 else "0.6" for v in values])
    for place, value in enumerate(values):
        axis.text(min(value, 100) + 1, place, f"{value:.3g}", va="center", fontsize="x-small")
    axis.tick_params(axis="y", labelsize="x-small")
    axis.set(xlabel="flagged [%]", xlim=(0, 112))
