"""Train and evaluate: from a problem and a method to a run folder with scores, model and logs."""

from __future__ import annotations

import logging
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

from suspnet import plots
from suspnet.checkpoint import ModelFileError, TrainedModel, load_model, save_model
from suspnet.data import TEST, Protocol, Task
from suspnet.data.storage import write_json
from suspnet.evaluation.comparison import scores_table
from suspnet.evaluation.information import best_possible, output_bounds, relative_percent
from suspnet.evaluation.metrics import METRICS, score
from suspnet.features import PeakFeatures
from suspnet.fitting import Outcome, Problem, fit, method_name, predict_stream, tune
from suspnet.learning import ranks
from suspnet.learning.search import GridSearch, SearchResult
from suspnet.tracking import RunLog

log = logging.getLogger(__name__)
Metrics = dict[str, Any]
PACKAGES = ("suspnet", "torch", "numpy", "scipy", "scikit-learn", "hydra-core", "tensorboard")


def train(
    problem: Problem,
    estimator: Any,
    folder: Path,
    *,
    search: GridSearch | None = None,
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
    config : mapping, optional
        The resolved configuration, for the records.

    Returns
    -------
    dict
        What metrics.json holds; empty where another process (torchrun) writes and tests.
    """
    name = method_name(estimator)
    if search is not None and ranks.together():
        raise ValueError("a search cannot be spread over processes: start it with python")
    if not ranks.first():
        fit(problem, estimator, None)
        return {}
    with RunLog(folder) as run_log:
        run_log.config(config or {})
        found = None
        if search is not None:
            found = tune(problem, estimator, search, run_log)
            estimator.set_params(**found.best)
        model = fit(problem, estimator, run_log)
        training = model.training
        outcome = predict_stream(problem, model, TEST)
        metrics = {
            **_headline(problem, name),
            **_scores(problem, outcome),
            "seconds": training["seconds"] + outcome.seconds,
            "training": training,
        }
        if found is not None:
            metrics["search"] = asdict(found) | {"best": found.best}
        accuracy = {"test_rms_percent": rms_percent(problem.task, outcome)}
        save_model(folder, replace(model, training=training | accuracy))
        _log_hyperparameters(run_log, metrics, training["parameters"])
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
    outcome = predict_stream(problem, model, TEST)
    metrics = {
        **_headline(problem, model.name),
        **_scores(problem, outcome),
        "seconds": outcome.seconds,
        "run": str(folder),
    }
    with RunLog(output) as run_log:
        _log_hyperparameters(run_log, metrics, model.training["parameters"])
        _draw_predictions(problem, model.name, outcome, run_log, output / "figures")
    write_json(output / "metrics.json", metrics)
    _report(metrics, output)
    return metrics


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


def _headline(problem: Problem, name: str) -> Metrics:
    return {
        "vehicle": problem.vehicle.name,
        "generator": type(problem.generator).__name__,
        "protocol": problem.task.protocol,
        "group": problem.task.group,
        "model": name,
        "n_train": problem.settings.n_train,
        "snr_db": problem.settings.snr_db,
        "seed": problem.seed,
        "mass_known": problem.task.mass_known,
    }


def _scores(problem: Problem, outcome: Outcome) -> Metrics:
    task, data = problem.task, outcome.data
    bounds = output_bounds(task, problem.source.observer, data.ratios)
    spread = relative_percent(task, bounds, data.ratios)
    return {
        "scores": score(data.outputs, outcome.predicted, task.outputs),
        "limit": best_possible(task, bounds, data.ratios),
        "cramer_rao_percent": dict(zip(task.outputs, spread.tolist(), strict=True)),
        "n_test": outcome.n_asked,
        "n_test_complete": len(data.inputs),
    }


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
        "missing), %.1f s to fit and predict\n%s\n-> %s",
        metrics["model"],
        metrics["protocol"],
        metrics["group"],
        metrics["n_test_complete"],
        metrics["snr_db"],
        missing,
        metrics["seconds"],
        scores_table(metrics["scores"], metrics["limit"], metrics["cramer_rao_percent"]),
        folder,
    )
