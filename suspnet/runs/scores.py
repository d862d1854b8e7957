"""The scores of one run next to the Cramer-Rao bound, as a table and as figures."""

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from suspnet.bounds.information import best_possible, output_bounds, over_bound, relative_percent
from suspnet.curves.problem import TEST, Problem
from suspnet.curves.protocols import Task
from suspnet.estimation.estimate import KINDS
from suspnet.estimation.fitted import FittedMethod
from suspnet.ground.types import FloatArray
from suspnet.learning.metrics import METRICS, interval_scores, score, score_where
from suspnet.runs import plots
from suspnet.runs.plots import PEAKS
from suspnet.runs.predict import Outcome
from suspnet.runs.tables import REFINED, scores_table
from suspnet.runs.tensorboard import RunLog

log = logging.getLogger(__name__)
Metrics = dict[str, Any]
LEVEL = 0.9  # level of the prediction intervals in tables
N_BOUND = 200
"""Largest number of curves whose bounds are computed where numbers are uncertain, as bounds are
expensive there."""
TOO_GOOD = 4.0  # an rms error this many standard deviations below its bound raises a warning
NARROW = 0.05
"""Largest bound, over the range, for which that is so: an error far below may come from knowing a
range that is hardly wider than the bound."""


def label(model: FittedMethod) -> str:
    """Return a model's name in tables: its method, and whether it is refined."""
    return model.name + (REFINED if model.refined else "")


def rms_percent(task: Task, outcome: Outcome) -> dict[str, float]:
    """Return the rms relative error of each output, [%]."""
    error = 100 * (outcome.predicted / outcome.data.outputs - 1)
    return dict(zip(task.outputs, np.sqrt(np.mean(error**2, axis=0)).tolist(), strict=True))


def headline(problem: Problem, model: FittedMethod) -> Metrics:
    """Return what tables show of a run: vehicle, protocol, group, method, counts, noise."""
    return {
        "vehicle": problem.vehicle.name,
        "generator": type(problem.generator).__name__,
        "protocol": problem.task.protocol,
        "group": problem.task.group,
        "model": label(model),
        "n_train": problem.settings.n_train,
        "snr_db": problem.settings.snr_db,
        "seed": problem.seed,
        "mass_known": problem.task.mass_known,
        "starts_fits": problem.is_uncertain and not model.refined,
    }


def scores(problem: Problem, model: FittedMethod, outcome: Outcome) -> Metrics:
    """Return the scores of estimates on one stream of curves, in the form of metrics.json."""
    task, data = problem.task, outcome.data
    # bounds with uncertain numbers are expensive: the mean over some curves is as informative
    n_bound = N_BOUND if problem.is_uncertain else len(data.ratios)
    ratios = data.ratios[:n_bound]
    bounds = output_bounds(task, problem.observer, ratios)
    spread = relative_percent(task, bounds, ratios)
    metrics: Metrics = {
        "scores": score(data.outputs, outcome.predicted, task.outputs),
        "scores_where": score_where(data.outputs, outcome.predicted, task.outputs),
        "bound": best_possible(task, bounds, ratios),
        "cramer_rao_percent": dict(zip(task.outputs, spread.tolist(), strict=True)),
        "rms_ratio": _rms_ratio(task, outcome, bounds),
        "n_test": outcome.n_asked,
        "n_test_complete": len(data.inputs),
        "n_bound": len(bounds),
    }
    if model.intervals is not None and outcome.scales is not None:
        single, joint = (
            model.intervals.ends(outcome.predicted, outcome.scales, LEVEL, is_joint)
            for is_joint in (False, True)
        )
        scores_of = interval_scores(data.outputs, single, joint, task.outputs)
        metrics["intervals"] = scores_of | {"level": LEVEL}
    if outcome.flags is not None:
        shares = 100 * outcome.flags.found.mean(axis=0)
        metrics["flagged_percent"] = dict(zip(KINDS, shares.tolist(), strict=True))
        metrics["flagged_percent"]["any"] = 100 * float(outcome.flags.flagged.mean())
    return metrics


def _rms_ratio(task: Task, outcome: Outcome, bounds: FloatArray) -> dict[str, float]:
    """Return rms relative error over rms relative bound; warn where it is implausibly small.

    NaN where the bound is infinite.
    """
    every = outcome.data.outputs
    error = np.sqrt(np.mean((outcome.predicted / every - 1) ** 2, axis=0))
    truth = every[: len(bounds)]
    least = np.sqrt(np.mean((bounds / truth) ** 2, axis=0))
    scatter = 1 / math.sqrt(2 * len(truth))
    for j, name in enumerate(task.outputs):
        if not np.isfinite(bounds[:, j]).all():
            continue
        low, high = task.range(name)
        is_narrow = least[j] < NARROW * (high - low)
        if is_narrow and error[j] < (1 - TOO_GOOD * scatter) * least[j]:
            log.warning(
                "%s: rms error %.3g %% lies below the bound of %.3g %% by more than chance "
                "explains; are test curves also used in the training?",
                *(name, 100 * error[j], 100 * least[j]),
            )
    return dict(zip(task.outputs, over_bound(error, least).tolist(), strict=True))


def log_scores(
    run_log: RunLog, metrics: Metrics, parameters: Mapping[str, Any], swept: Sequence[str] = ()
) -> None:
    """Write the table of scores, and hyperparameters and scores for TensorBoard's HPARAMS tab.

    `swept` are the keys that a multirun varies.
    """
    run_log.text("scores", scores_table(metrics))
    errors = metrics["rms_percent"]
    finals = {"rms_percent": fmean(errors.values())}
    columns = ["rms_percent", *(["cv_rmse"] if "search" in metrics else []), "seconds"]
    # which outputs there are depends on these
    if not {"group", "protocol", "experiment"} & set(swept):
        columns += [f"mape_percent_{output}" for output in errors]
    finals |= {
        f"{metric}_{output}": values[metric]
        for output, values in metrics["scores"].items()
        for metric in METRICS
    }
    finals |= {f"rms_ratio_{output}": ratio for output, ratio in metrics["rms_ratio"].items()}
    finals = {name: value for name, value in finals.items() if math.isfinite(value)}
    finals["seconds"] = metrics["seconds"]
    if "search" in metrics:
        finals["cv_rmse"] = min(metrics["search"]["rmse"])
    names = [key.rpartition(".")[2] for key in swept]
    run_log.hyperparameters({**parameters, **metrics}, finals, columns, names)


def report(metrics: Metrics, folder: Path) -> None:
    """Log the scores of a run as a table, with coverage and flags if it was calibrated."""
    missing = metrics["n_test"] - metrics["n_test_complete"]
    log.info(
        "%s on protocol %s, group %s: %d test curves at %g dB (%d more discarded: a peak is "
        "missing), %.1f s to fit and predict\n%s%s\n-> %s",
        *(metrics[key] for key in ("model", "protocol", "group", "n_test_complete", "snr_db")),
        *(missing, metrics["seconds"], scores_table(metrics), _trust(metrics), folder),
    )


def _trust(metrics: Metrics) -> str:
    words = []
    if metrics["n_bound"] < metrics["n_test_complete"]:
        words.append(f"Bounds are those of {metrics['n_bound']} of these curves.")
    if metrics.get("starts_fits"):
        words.append(
            "These are the estimates of the regression alone: on trips it only starts the fit of "
            "the curve, which reads them."
        )
    if "intervals" in metrics:
        words.append(f"all outputs at once: {metrics['intervals']['joint_coverage_percent']:.1f} %")
    if "flagged_percent" in metrics:
        words.append(f"flagged: {metrics['flagged_percent']['any']:.2f} % of the curves")
    return "".join(f"\n{part}" for part in words)


def draw_run(
    problem: Problem, model: FittedMethod, outcome: Outcome, run_log: RunLog, folder: Path
) -> None:
    """Draw estimates of a run against truth and, of a model that reads peaks, those of a curve.

    Each figure has one axis, as TensorBoard shows it small.
    """
    task = model.task
    figures = {
        f"parity_{name}": plots.parity(outcome.data.outputs[:, j], outcome.predicted[:, j], name)
        for j, name in enumerate(task.outputs)
    }
    if task.extractor.kind == "peaks":
        frequencies_hz = problem.observer.frequencies_hz
        example = problem.curves(outcome.data.ratios[:1], TEST, 0)
        table = task.extractor.extract(example, frequencies_hz.to(example.device))
        features = dict(zip(task.extractor.names, table.values[0].tolist(), strict=True))
        curves = example[0].abs().cpu().numpy()
        for suspension, curve in zip(PEAKS, curves, strict=True):
            figures[f"peaks_{suspension}"] = plots.peak_fit(
                frequencies_hz.numpy(), curve, features, suspension
            )
    for key, figure in figures.items():
        run_log.figure(key, figure, folder)
