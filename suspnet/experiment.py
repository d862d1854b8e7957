"""Train and evaluate: from a problem and a method to a run folder with scores, model and logs."""

from __future__ import annotations

import logging
import math
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from suspnet import plots
from suspnet.checkpoint import ModelFileError, TrainedModel, load_model, save_model
from suspnet.data import TEST, Protocol, Task
from suspnet.data.storage import write_json
from suspnet.evaluation.comparison import REFINED, scores_table
from suspnet.evaluation.information import (
    best_possible,
    output_bounds,
    range_limited,
    relative_percent,
)
from suspnet.evaluation.metrics import METRICS, interval_scores, score
from suspnet.features import PeakFeatures
from suspnet.fitting import Problem, fit, method_name, tune
from suspnet.learning import ranks
from suspnet.learning.search import GridSearch, SearchResult
from suspnet.predicting import Outcome, calibrated, predict_stream
from suspnet.reliability.scope import KINDS
from suspnet.tracking import RunLog

log = logging.getLogger(__name__)
Metrics = dict[str, Any]
FloatArray = NDArray[np.float64]
LEVEL = 0.9
"""Probability of the intervals in tables."""
TOO_GOOD = 4.0
"""Standard deviations of its sampling error by which an rms error may lie below the limit."""
PACKAGES = ("suspnet", "torch", "numpy", "scipy", "scikit-learn", "hydra-core", "tensorboard")


def train(
    problem: Problem,
    estimator: Any,
    folder: Path,
    *,
    search: GridSearch | None = None,
    refine: bool = False,
    figures: bool = True,
    config: Mapping[str, Any] | None = None,
) -> Metrics:
    """Train one method on one problem, test it, and fill a run folder.

    Writes metrics.json, model.json, model.safetensors, environment.json, figures and TensorBoard
    events.

    Parameters
    ----------
    problem : Problem
    estimator : object
        An instance of one of ``ESTIMATORS``.
    folder : Path
    search : GridSearch, optional
        Tunes the method first.
    refine : bool
        Take the estimates further by Gauss-Newton steps on the curves.
    figures : bool
        Whether to draw figures of the run.
    config : mapping, optional
        The resolved configuration, for the records; its `ablation_name` goes into metrics.json.

    Returns
    -------
    dict
        What metrics.json holds; empty where another process (torchrun) writes and tests.
    """
    method_name(estimator)
    if search is not None and ranks.is_distributed():
        raise ValueError("a search cannot be spread over processes: start it with python")
    if not ranks.is_rank_zero():
        fit(problem, estimator, None)
        return {}
    with RunLog(folder) as run_log:
        run_log.config(config or {})
        found = None
        if search is not None:
            found = tune(problem, estimator, search, run_log)
            estimator.set_params(**found.best)
        model = calibrated(problem, replace(fit(problem, estimator, run_log), refined=refine))
        training = model.training
        outcome = predict_stream(problem, model, TEST)
        metrics = {
            **_headline(problem, model),
            **_scores(problem, model, outcome),
            "seconds": training["seconds"] + outcome.seconds,
            "training": training,
        }
        if found is not None:
            metrics["search"] = asdict(found) | {"best": found.best}
        if config and config.get("ablation_name"):
            metrics["ablation"] = config["ablation_name"]
        accuracy = {"test_rms_percent": rms_percent(problem.task, outcome)}
        save_model(folder, replace(model, training=training | accuracy))
        _log_hyperparameters(run_log, metrics, training["parameters"])
        if figures:
            _draw(problem, model, outcome, run_log, folder / "figures", found)
    write_json(folder / "environment.json", environment())
    write_json(folder / "metrics.json", metrics)
    _report(metrics, folder)
    return metrics


def evaluate(
    folder: Path,
    output: Path,
    *,
    seed: int,
    n_test: int | str,
    snr_db: float | None,
    protocol: Protocol | None,
    threads: int,
    device: str,
    progress: bool = True,
) -> Metrics:
    """Score the model of a run on freshly generated curves and write metrics and figures.

    Parameters
    ----------
    folder : Path
        The run.
    output : Path
        Where metrics.json and figures go.
    seed : int
        Of the fresh curves; another one than the run's.
    n_test : int or "all"
    snr_db : float, optional
        The run's own if None.
    protocol : Protocol, optional
        The run's own if None; else one with the same features that varies the model's outputs.

    Raises
    ------
    FileNotFoundError, ModelFileError
        If there is no model, or it is damaged.
    ValueError
        If the protocol does not fit the model, or the seed is the run's own.
    """
    model = load_model(folder, device)
    if seed == model.training["seed"]:
        raise ValueError(
            f"seed={seed} made the training curves of {folder}; fresh curves need another seed"
        )
    task = model.task if protocol is None else fitting_task(model.task, protocol)
    settings = replace(model.settings, n_test=n_test)
    if snr_db is not None:
        settings = replace(settings, snr_db=snr_db)
    problem = Problem(model.generator, task, settings, seed, threads, progress)
    outcome = predict_stream(problem, model, TEST, flags=True)
    metrics = {
        **_headline(problem, model),
        **_scores(problem, model, outcome),
        "seconds": outcome.seconds,
        "run": str(folder),
    }
    with RunLog(output) as run_log:
        _log_hyperparameters(run_log, metrics, model.training["parameters"])
        _draw_predictions(problem, model.name, outcome, run_log, output / "figures")
    write_json(output / "metrics.json", metrics)
    _report(metrics, output)
    return metrics


def label(model: TrainedModel) -> str:
    """Return what a model is called in every table: its method, and whether it is refined."""
    return model.name + (REFINED if model.refined else "")


def rms_percent(task: Task, outcome: Outcome) -> dict[str, float]:
    """Return the rms relative error of each output, [%]."""
    error = 100 * (outcome.predicted / outcome.data.outputs - 1)
    return dict(zip(task.outputs, np.sqrt(np.mean(error**2, axis=0)).tolist(), strict=True))


def find_runs(path: Path) -> list[Path]:
    """Return the folders with a model at or below `path`: one run, or all of a multirun.

    Raises
    ------
    FileNotFoundError
        If the path does not exist or holds no model.
    """
    if not path.exists():
        raise FileNotFoundError(f"run={path} does not exist")
    runs = sorted(file.parent for file in path.rglob("model.json"))
    if not runs:
        raise FileNotFoundError(f"run={path} holds no model.json; is it the folder of a run?")
    return runs


def fitting_task(trained: Task, protocol: Protocol) -> Task:
    """Return the task of another protocol that a model can be tested on.

    Raises
    ------
    ModelFileError
        If no group of the protocol has the model's features and varies its outputs.
    """
    tasks = [protocol.task(group) for group in protocol.groups]
    for task in sorted(tasks, key=lambda t: t.group != trained.group):
        if task.inputs == trained.inputs and set(trained.outputs) <= set(task.varied):
            return replace(task, outputs=trained.outputs)
    raise ModelFileError(
        f"a model of protocol {trained.protocol!r}, group {trained.group!r} needs the features "
        f"{trained.inputs} and estimates {trained.outputs}; protocol {protocol.name!r} does not fit"
    )


def environment() -> dict[str, Any]:
    """Return what the numbers depend on besides the configuration."""
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parent,
    )
    return {
        "python": sys.version,
        "platform": platform.platform(),
        "cpus": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "packages": {name: version(name) for name in PACKAGES},
        "commit": git.stdout.strip() or None,
    }


def _headline(problem: Problem, model: TrainedModel) -> Metrics:
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
    }


def _scores(problem: Problem, model: TrainedModel, outcome: Outcome) -> Metrics:
    task, data = problem.task, outcome.data
    bounds = output_bounds(task, problem.source.observer, data.ratios)
    spread = relative_percent(task, bounds, data.ratios)
    metrics: Metrics = {
        "scores": score(data.outputs, outcome.predicted, task.outputs),
        "limit": best_possible(task, bounds, data.ratios),
        "cramer_rao_percent": dict(zip(task.outputs, spread.tolist(), strict=True)),
        "rms_ratio": _rms_ratio(task, outcome, bounds),
        "n_test": outcome.n_asked,
        "n_test_complete": len(data.inputs),
    }
    if model.intervals is not None and outcome.difficulties is not None:
        limits = [
            model.intervals.limits(outcome.predicted, outcome.difficulties, LEVEL, joint)
            for joint in (False, True)
        ]
        metrics["intervals"] = interval_scores(data.outputs, limits[0], limits[1], task.outputs)
        metrics["intervals"]["level"] = LEVEL
    if outcome.flags is not None:
        shares = 100 * outcome.flags.found.mean(axis=0)
        metrics["flagged_percent"] = dict(zip(KINDS, shares.tolist(), strict=True))
        metrics["flagged_percent"]["any"] = 100 * float(outcome.flags.flagged.mean())
    return metrics


def _rms_ratio(task: Task, outcome: Outcome, bounds: FloatArray) -> dict[str, float]:
    """Return rms relative error over rms relative bound; warn where it is too good to be true."""
    truth = outcome.data.outputs
    error = np.sqrt(np.mean((outcome.predicted / truth - 1) ** 2, axis=0))
    ratios = error / np.sqrt(np.mean((bounds / truth) ** 2, axis=0))
    scatter = 1 / math.sqrt(2 * len(truth))
    for j, name in enumerate(task.outputs):
        if not np.isfinite(bounds[:, j]).all():
            continue
        least = range_limited(bounds[:, j], truth[:, j], *task.limits(name)) / truth[:, j]
        if error[j] < (1 - TOO_GOOD * scatter) * np.sqrt(np.mean(least**2)):
            log.warning(
                "%s: rms error %.3g %% lies below the limit of %.3g %% by more than chance and the "
                "known range explain; do test curves take part in the training?",
                name,
                100 * error[j],
                100 * np.sqrt(np.mean(least**2)),
            )
    return dict(zip(task.outputs, ratios.tolist(), strict=True))


def _log_hyperparameters(run_log: RunLog, metrics: Metrics, parameters: Mapping[str, Any]) -> None:
    finals = {
        f"{metric}_{output}": values[metric]
        for output, values in metrics["scores"].items()
        for metric in METRICS
    }
    finals["seconds"] = metrics["seconds"]
    if "search" in metrics:
        finals["cv_rmse"] = min(metrics["search"]["rmse"])
    run_log.hyperparameters({**parameters, **metrics}, finals)


def _draw(
    problem: Problem,
    model: TrainedModel,
    outcome: Outcome,
    run_log: RunLog,
    folder: Path,
    found: SearchResult | None,
) -> None:
    task, source = model.task, problem.source
    frequencies_hz = source.observer.frequencies_hz
    example = source.curves(outcome.data.ratios[:1], TEST, 0)
    data = outcome.data
    figures = {
        "bode": plots.bode(problem.generator, frequencies_hz),
        "degradation": plots.degradation(problem.generator, frequencies_hz),
        "features": plots.feature_spread(data.inputs, task.inputs, data.outputs, task.outputs),
    }
    if isinstance(task.extractor, PeakFeatures):
        table = task.extractor.extract(example, frequencies_hz.to(example.device))
        features = dict(zip(task.extractor.names, table.values[0].tolist(), strict=True))
        figures["peaks"] = plots.peak_fits(
            frequencies_hz.numpy(), example[0].abs().cpu().numpy(), features
        )
    objectives = getattr(model.estimator, "objectives_", [])
    if len(objectives) > 2:
        figures["convergence"] = plots.convergence(objectives)
    if found is not None:
        numbers = [
            {k: v for k, v in setting.items() if isinstance(v, int | float)}
            for setting in found.settings
        ]
        figures["search"] = plots.search_map(numbers, found.rmse)
    _write_figures(figures, _title(problem, model.name), run_log, folder)
    _draw_predictions(problem, model.name, outcome, run_log, folder)


def _draw_predictions(
    problem: Problem, name: str, outcome: Outcome, run_log: RunLog, folder: Path
) -> None:
    arrays = outcome.data.outputs, outcome.predicted, problem.task.outputs
    figures = {"parity": plots.parity(*arrays), "residuals": plots.residuals(*arrays)}
    _write_figures(figures, _title(problem, name), run_log, folder)


def _write_figures(
    figures: Mapping[str, Figure], title: str, run_log: RunLog, folder: Path
) -> None:
    for name, figure in figures.items():
        figure.suptitle(title, fontsize="small")
        run_log.figure(name, figure, folder)


def _title(problem: Problem, name: str) -> str:
    task = problem.task
    noise = f"{problem.settings.snr_db:g} dB, seed {problem.seed}"
    return f"{problem.vehicle.name}, protocol {task.protocol}, group {task.group}, {name}, {noise}"


def _report(metrics: Metrics, folder: Path) -> None:
    missing = metrics["n_test"] - metrics["n_test_complete"]
    log.info(
        "%s on protocol %s, group %s: %d test curves at %g dB (%d more discarded: a peak is "
        "missing), %.1f s to fit and predict\n%s%s\n-> %s",
        metrics["model"],
        metrics["protocol"],
        metrics["group"],
        metrics["n_test_complete"],
        metrics["snr_db"],
        missing,
        metrics["seconds"],
        scores_table(metrics),
        _trust(metrics),
        folder,
    )


def _trust(metrics: Metrics) -> str:
    """Return a line on joint coverage and flags, where a model was calibrated."""
    words = []
    if "intervals" in metrics:
        words.append(f"all outputs at once: {metrics['intervals']['joint_coverage_percent']:.1f} %")
    if "flagged_percent" in metrics:
        words.append(f"flagged: {metrics['flagged_percent']['any']:.2f} % of the curves")
    return "".join(f"\n{part}" for part in words)
