"""Train and evaluate: from a problem and a method to a run folder with scores, model and logs."""

from __future__ import annotations

import logging
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from suspnet import plots
from suspnet.checkpoint import ESTIMATORS, ModelFileError, TrainedModel, load_model, save_model
from suspnet.data import TEST, TRAIN, CurveSettings, CurveSource, FeatureData, Protocol, Task
from suspnet.data.curves import BLOCK, used_responses
from suspnet.data.storage import write_atomically, write_json
from suspnet.dynamics import PARAMETERS, QuarterCar, ResponseGenerator, Vehicle
from suspnet.evaluation.comparison import scores_table
from suspnet.evaluation.information import best_possible
from suspnet.evaluation.metrics import METRICS, score
from suspnet.learning import CurveFit, Scaling
from suspnet.learning.search import GridSearch, SearchResult
from suspnet.tracking import RunLog

log = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]
Metrics = dict[str, Any]
PACKAGES = ("suspnet", "torch", "numpy", "scipy", "scikit-learn", "hydra-core", "tensorboard")


@dataclass(frozen=True)
class Problem:
    """What is to be learnt, and with which means.

    Parameters
    ----------
    vehicle : Vehicle
    task : Task
    settings : CurveSettings
    seed : int
    threads : int
        Blocks of curves made at the same time, and threads of torch.
    device : str
    progress : bool
    """

    vehicle: Vehicle
    task: Task
    settings: CurveSettings
    seed: int = 0
    threads: int = 1
    device: str = "cpu"
    progress: bool = True

    def __post_init__(self) -> None:
        for name, low in (("seed", 0), ("threads", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ValueError(f"`{name}` must be a whole number >= {low}, got {value!r}")
        try:
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"`device`={self.device!r} cannot be used here: {reason}") from error

    @property
    def generator(self) -> ResponseGenerator:
        """The source of frequency responses."""
        return QuarterCar(self.vehicle, self.device)

    @property
    def source(self) -> CurveSource:
        """The source of noisy curves and features."""
        return CurveSource(
            self.generator, self.task, self.settings, self.seed, self.threads, self.progress
        )


@dataclass(frozen=True)
class Outcome:
    """Predictions on one stream of curves.

    Attributes
    ----------
    data : FeatureData
        The curves on which every feature was found.
    predicted : array of shape (n_curves, n_outputs), [-]
    seconds : float
    n_asked : int
        Curves asked for, those with a missing feature included.
    """

    data: FeatureData
    predicted: FloatArray
    seconds: float
    n_asked: int


def train(
    problem: Problem,
    estimator: Any,
    folder: Path,
    *,
    search: GridSearch | None = None,
    config: Mapping[str, Any] | None = None,
) -> Metrics:
    """Train one method on one problem, test it, and fill a run folder.

    Writes metrics.json, model.json, model.safetensors, environment.json, config.yaml, figures and
    TensorBoard events.

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
        What metrics.json holds.
    """
    name = method_name(estimator)
    with RunLog(folder) as run_log:
        run_log.config(config or {})
        found = None
        if search is not None:
            found = _tune(problem, estimator, search, run_log)
            estimator.set_params(**found.best)
        model, training = _fit(problem, estimator, run_log)
        outcome = predict_stream(problem, model, TEST)
        metrics = {
            **_headline(problem, name),
            **_scores(problem, outcome),
            "seconds": training["seconds"] + outcome.seconds,
            "training": training,
        }
        if found is not None:
            metrics["search"] = asdict(found) | {"best": found.best}
        save_model(folder, model)
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
    settings = CurveSettings(
        **(model.curve_settings | {"n_test": n_test, "cache_dir": None})
        | ({} if snr_db is None else {"snr_db": snr_db})
    )
    problem = Problem(model.vehicle, task, settings, seed, threads, device, progress)
    outcome = predict_stream(problem, model, TEST)
    metrics = {
        **_headline(problem, model.name),
        **_scores(problem, outcome),
        "seconds": outcome.seconds,
        "run": str(folder),
    }
    with RunLog(output) as run_log:
        _log_hyperparameters(run_log, metrics, model.training["parameters"])
        _draw_predictions(task, outcome, run_log, output / "figures")
    write_json(output / "metrics.json", metrics)
    _report(metrics, output)
    return metrics


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


def method_name(estimator: Any) -> str:
    """Return the name of a method in ``ESTIMATORS``.

    Raises
    ------
    TypeError
        If it is none of them.
    """
    for name, kind in ESTIMATORS.items():
        if type(estimator) is kind:
            return name
    raise TypeError(f"`model` must be one of {sorted(ESTIMATORS)}, got {type(estimator).__name__}")


def predict_stream(problem: Problem, model: TrainedModel, stream: int) -> Outcome:
    """Return a model's estimates for the training or test curves of a problem."""
    data = problem.source.features(stream)
    kept = data.complete()
    if not len(kept.inputs):
        raise ValueError(f"none of the {len(data.inputs)} curves has all of its peaks")
    start = time.perf_counter()
    if isinstance(model.estimator, CurveFit):
        predicted = _fit_curves(problem, model.estimator, data, stream)[data.valid]
    else:
        predicted = model.predict(kept.inputs)
    return Outcome(kept, predicted, time.perf_counter() - start, len(data.inputs))


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


def _tune(problem: Problem, estimator: Any, search: GridSearch, run_log: RunLog) -> SearchResult:
    name = method_name(estimator)
    data = problem.source.features(TRAIN).complete()
    inputs, outputs = Scaling.of(data.inputs), Scaling.of(data.outputs)
    n_settings = search.n_settings(name)
    with tqdm(total=n_settings, desc=f"search {name}", disable=not problem.progress) as bar:

        def told(setting: Mapping[str, Any], rmse: float) -> None:
            run_log.scalars("search", {"rmse": rmse}, bar.n)
            bar.update()

        return search.run(
            name,
            estimator,
            inputs.apply(data.inputs),
            outputs.apply(data.outputs),
            outputs,
            told,
        )


def _fit(problem: Problem, estimator: Any, run_log: RunLog) -> tuple[TrainedModel, dict[str, Any]]:
    source = problem.source
    name = method_name(estimator)
    settings = asdict(problem.settings)
    del settings["cache_dir"]
    model = TrainedModel(
        name, estimator, problem.task, problem.vehicle, settings, source.healthy_features()
    )
    training: dict[str, Any] = {"seed": problem.seed, "seconds": 0.0}
    if not isinstance(estimator, CurveFit):
        data = source.features(TRAIN)
        kept = data.complete()
        if not len(kept.inputs):
            raise ValueError(f"none of the {len(data.inputs)} curves has all of its peaks")
        inputs, outputs = Scaling.of(kept.inputs), Scaling.of(kept.outputs)
        model = replace(model, input_scaling=inputs, output_scaling=outputs)
        start = time.perf_counter()
        with _told(estimator, name, run_log, problem.progress):
            estimator.fit(inputs.apply(kept.inputs), outputs.apply(kept.outputs))
        training["seconds"] = time.perf_counter() - start
        training |= {"n_train": len(data.inputs), "n_train_complete": len(kept.inputs)}
    training |= _summary(estimator)
    return replace(model, training=training), training


def _summary(estimator: Any) -> dict[str, Any]:
    """Return the scalar fitted attributes of an estimator, and its parameters."""
    fitted = {
        key.removesuffix("_"): value
        for key, value in vars(estimator).items()
        if key.endswith("_") and isinstance(value, bool | int | float)
    }
    parameters = (
        dict(vars(estimator)) if isinstance(estimator, CurveFit) else estimator.get_params()
    )
    parameters.pop("callback", None)
    return {"fitted": fitted, "parameters": parameters}


class _told:
    """While fitting, show a progress bar and log what the estimator's callback is told."""

    def __init__(self, estimator: Any, name: str, run_log: RunLog, progress: bool) -> None:
        self._estimator, self._name, self._log = estimator, name, run_log
        self._active = "callback" in estimator.get_params()
        self._bar = tqdm(desc=f"fit {name}", unit="step", disable=not (progress and self._active))

    def __enter__(self) -> None:
        if self._active:
            self._estimator.set_params(callback=self._tell)

    def __exit__(self, *_: object) -> None:
        if self._active:
            self._estimator.set_params(callback=None)
        self._bar.close()

    def _tell(self, info: Any) -> None:
        self._bar.update()
        if is_dataclass(info) and not isinstance(info, type):
            values = asdict(info)
            step = int(values.pop(next(iter(values))))
            self._log.scalars(self._name, values, step)
            self._bar.set_postfix({k: f"{v:.3g}" for k, v in list(values.items())[:2]})


def _fit_curves(problem: Problem, method: CurveFit, data: FeatureData, stream: int) -> FloatArray:
    task, source = problem.task, problem.source
    forward = curve_model(problem.generator, task, problem.settings.frequencies_hz())
    known = torch.as_tensor(data.ratios[:, [PARAMETERS.index("M_s")]] if task.mass_known else data.ratios[:, :0])
    used, unknown = used_responses(task), task.unknown
    estimates = []
    with tqdm(total=len(data.ratios), desc="curve fit", disable=not problem.progress) as bar:
        for block in range(source.n_blocks(len(data.ratios))):
            rows = slice(block * BLOCK, (block + 1) * BLOCK)
            observed = source.curves(data.ratios, stream, block)[:, used]
            solution = method.fit_curves(
                forward,
                observed,
                known[rows].to(observed),
                task.lower,
                task.upper,
                len(unknown),
            )
            estimates.append(solution.parameters.cpu().numpy())
            bar.update(len(observed))
    return np.concatenate(estimates)[:, [unknown.index(name) for name in task.outputs]]


def curve_model(
    generator: ResponseGenerator, task: Task, frequencies_hz: Tensor
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return curves (n, n_responses, n_freq) as a function of the unknown and the known ratios."""
    used = used_responses(task)

    def forward(unknown: Tensor, known: Tensor) -> Tensor:
        columns = dict(zip(task.unknown, unknown.unbind(1), strict=True))
        if task.mass_known:
            columns["M_s"] = known[:, 0]
        healthy = torch.ones_like(unknown[:, 0])
        ratios = torch.stack([columns.get(name, healthy) for name in PARAMETERS], dim=1)
        return generator.magnitudes(ratios, frequencies_hz)[:, used]

    return forward


def _headline(problem: Problem, name: str) -> Metrics:
    return {
        "vehicle": problem.vehicle.name,
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
    return {
        "scores": score(data.outputs, outcome.predicted, task.outputs),
        "limit": best_possible(
            task,
            problem.generator,
            data.ratios,
            problem.settings.frequencies_hz(),
            problem.settings.snr_db,
        ),
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
    task, source = problem.task, problem.source
    frequencies_hz = problem.settings.frequencies_hz()
    run_log.figure("bode", plots.bode(problem.generator, frequencies_hz), folder)
    run_log.figure("degradation", plots.degradation(problem.generator, frequencies_hz), folder)
    example = source.curves(outcome.data.ratios[:1], TEST, 0)
    table = task.extractor.extract(example, frequencies_hz.to(example.device))
    features = dict(zip(task.extractor.names, table.values[0].tolist(), strict=True))
    fits = plots.peak_fits(frequencies_hz.numpy(), example[0].cpu().numpy(), features)
    run_log.figure("peaks", fits, folder)
    data = outcome.data
    spread = plots.feature_spread(data.inputs, task.inputs, data.outputs, task.outputs)
    run_log.figure("features", spread, folder)
    _draw_predictions(task, outcome, run_log, folder)
    objectives = getattr(model.estimator, "objectives_", None)
    if objectives is not None and len(objectives) > 1:
        run_log.figure("convergence", plots.convergence(objectives), folder)
    if found is not None:
        numbers = [
            {k: v for k, v in setting.items() if isinstance(v, int | float)}
            for setting in found.settings
        ]
        run_log.figure("search", plots.search_map(numbers, found.rmse), folder)


def _draw_predictions(task: Task, outcome: Outcome, run_log: RunLog, folder: Path) -> None:
    actual, predicted = outcome.data.outputs, outcome.predicted
    run_log.figure("parity", plots.parity(actual, predicted, task.outputs), folder)
    run_log.figure("residuals", plots.residuals(actual, predicted, task.outputs), folder)


def _report(metrics: Metrics, folder: Path) -> None:
    missing = metrics["n_test"] - metrics["n_test_complete"]
    log.info(
        "%s on protocol %s, group %s: %d test curves at %g dB (%d more without all peaks), %.1f s\n"
        "%s\n-> %s",
        metrics["model"],
        metrics["protocol"],
        metrics["group"],
        metrics["n_test_complete"],
        metrics["snr_db"],
        missing,
        metrics["seconds"],
        scores_table(metrics["scores"], metrics["limit"]),
        folder,
    )


