"""Train: from a problem and a method to a run folder with scores, model, figures and logs."""

import logging
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from suspnet.curves.problem import TEST, Problem
from suspnet.estimation.checkpoint import check_restores, check_saveable, write_model
from suspnet.estimation.trained import TrainedModel
from suspnet.ground import own_files
from suspnet.ground.progress import stage
from suspnet.ground.storage import write_json
from suspnet.learning.search import GridSearch, SearchResult
from suspnet.runs.fit import check_hyperparameters, fit, method_name, refitted, tune
from suspnet.runs.predict import Outcome, calibrated, predict_stream
from suspnet.runs.scores import Metrics, draw_run, headline, log_scores, report, rms_percent, scores
from suspnet.runs.tensorboard import ERROR_BY_N, RunLog

log = logging.getLogger(__name__)
PACKAGES = ("suspnet", "torch", "numpy", "scipy", "scikit-learn", "hydra-core", "tensorboard")


@dataclass(frozen=True)
class RunContext:
    """What the calling program adds to the records and figures of a run.

    `config` is the resolved configuration; its `reading_name` and `search_name` go into
    metrics.json. `swept` are the keys that a multirun varies.
    """

    config: Mapping[str, Any] = field(default_factory=dict)
    swept: Sequence[str] = ()


def train(
    problem: Problem,
    estimator: Any,
    folder: Path | str | None = None,
    *,
    search: GridSearch | None = None,
    refine: bool = False,
    figures: bool = True,
    context: RunContext | None = None,
) -> Metrics:
    """Train one method on one problem, test it, and fill a run folder.

    Writes metrics.json, model.json, model.safetensors, environment.json, figures and TensorBoard
    events.

    Parameters
    ----------
    estimator : object
        An instance of one of ``suspnet.learning.METHODS``, or a registered one; without a folder
        any regressor with scikit-learn's interface. It is fitted here, to scaled features.
    folder : path or str, optional
        Where the run is written, in place of an earlier run there; None scores the method and
        writes nothing.
    search : GridSearch, optional
        Tunes the method first.
    refine : bool
        Refine the estimates by Gauss-Newton steps on the curves.

    Returns
    -------
    dict
        Content of metrics.json.

    Raises
    ------
    TypeError, ValueError
        If the method cannot be saved to `folder`, a search has no folder, or the method does not
        predict finite numbers of the right shape, and the same ones once it is restored.
    FileExistsError
        If the folder holds files that are not suspnet's.
    """
    context = context or RunContext()
    check_hyperparameters(estimator)
    if folder is None:
        if search is not None:
            raise ValueError("`search` needs a `folder`: its table is written there")
        model = calibrated(problem, replace(fit(problem, estimator, None), refined=refine))
        return _metrics(problem, model, predict_stream(problem, model, TEST), None, context)
    folder = Path(folder)
    method_name(estimator)
    check_saveable(estimator, problem)
    if not context.config:  # programs look at their folder before
        own_files.begin(folder)
    with RunLog(folder, is_new=True) as run_log:
        run_log.config(context.config)
        search_result, search_notes = None, {}
        tried = [] if search is None else search.settings_of(method_name(estimator))
        if len(tried) == 1:  # nothing to compare
            estimator.set_params(**tried[0])
        elif search is not None:
            start = time.perf_counter()
            search_result = tune(problem, estimator, search, run_log)
            search_notes = {"search_seconds": time.perf_counter() - start}
            estimator.set_params(**search_result.best)
        model = replace(fit(problem, estimator, run_log), refined=refine)
        check_restores(model)  # before the calibration, which may take longer than the fit
        model.training.update(search_notes)
        if problem.settings.n_calibrate is not None:
            stage("calibration of intervals and flags")
        model = calibrated(problem, model)
        stage("test")
        outcome = predict_stream(problem, model, TEST)
        metrics = _metrics(problem, model, outcome, search_result, context)
        # the accuracy goes into the model's file for those who have no run folder
        accuracy = {"test_rms_percent": metrics["rms_percent"]}
        stage("figures and tables of the run")
        write_model(folder, replace(model, training=model.training | accuracy))
        log_scores(run_log, metrics, model.training["parameters"], context.swept)
        if figures:
            log_error_by_n(problem, model, outcome, run_log)
            draw_run(problem, model, outcome, run_log, folder / "figures")
    write_json(folder / "environment.json", environment())
    write_json(folder / "metrics.json", metrics)  # last: it marks the run as finished
    report(metrics, folder)
    return metrics


def log_error_by_n(
    problem: Problem, model: TrainedModel, outcome: Outcome, run_log: RunLog
) -> None:
    """Write the rms error of the regression when it learns from fewer curves, up to all of them."""
    for n, part in refitted(problem, model):
        predicted = part.predict(outcome.data.inputs)
        errors = rms_percent(problem.task, replace(outcome, predicted=predicted))
        run_log.scalars(ERROR_BY_N, errors, n)


def _metrics(
    problem: Problem,
    model: TrainedModel,
    outcome: Outcome,
    search: SearchResult | None,
    context: RunContext,
) -> Metrics:
    """Return the content of metrics.json."""
    metrics: Metrics = {
        **headline(problem, model),
        **scores(problem, model, outcome),
        "seconds": model.training["seconds"] + outcome.seconds,
        "training": model.training,
    }
    if search is not None:
        metrics["search"] = asdict(search) | {"best": search.best}
    for key, name in (("reading", "reading_name"), ("search_name", "search_name")):
        if context.config.get(name):
            metrics[key] = context.config[name]
    metrics["rms_percent"] = rms_percent(problem.task, outcome)
    return metrics


def environment() -> dict[str, Any]:
    """Return what the numbers depend on in addition to the configuration."""
    command = ["git", "describe", "--always", "--dirty"]
    git = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent)
    return {
        "python": sys.version,
        "platform": platform.platform(),
        "cpus": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "packages": {name: version(name) for name in PACKAGES},
        "commit": git.stdout.strip() or None,
    }
