"""Fit a method to a problem: data, scaling, tuning, progress."""

import logging
import math
import time
import warnings
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import asdict, is_dataclass, replace
from typing import Any

from sklearn.exceptions import ConvergenceWarning

from suspnet.curves.problem import TRAIN, FeatureData, Problem
from suspnet.curves.protocols import Task
from suspnet.estimation.checkpoint import parameters
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.settings import check_settings
from suspnet.ground.tensors import check_device
from suspnet.learning import METHODS, Scaling
from suspnet.learning.search import GridSearch, SearchResult
from suspnet.runs.tensorboard import RunLog

log = logging.getLogger(__name__)
TOO_MANY_LOST = 0.02
"""Fraction of curves without one of their peaks above which a warning is logged."""
SHARES = (32, 16, 8, 4)
"""Divisors of the number of training curves in the fits that show the error by this number; all of
them take half the time of the fit itself, or less."""
LEAST_CURVES = 30  # least number of curves in such a fit


def method_name(estimator: Any) -> str:
    """Return the name of a method in ``METHODS``; TypeError if it is none of them."""
    for name, kind in METHODS.items():
        if type(estimator) is kind:
            return name
    raise TypeError(
        f"`model` must be one of {sorted(METHODS)}, got {type(estimator).__name__}, which cannot "
        "be saved: leave out the folder to score it alone, or see suspnet.register_method"
    )


def tune(problem: Problem, estimator: Any, search: GridSearch, run_log: RunLog) -> SearchResult:
    """Return the cross-validated RMSE of every setting of a search, on the training curves."""
    name = method_name(estimator)
    data = problem.features(TRAIN).complete(problem.extractor)
    inputs, outputs = scalings(problem.task, data)
    if search.n_curves is not None:
        data = data.first(search.n_curves)
    n_settings = len(search.settings_of(name))
    title = f"search of settings for {name}"
    with progress_bar(title, n_settings, unit="setting", shown=problem.progress) as bar:
        least = math.inf

        def report(setting: Mapping[str, Any], rmse: float) -> None:
            nonlocal least
            least = min(least, rmse)
            run_log.scalars("search", {"rmse": rmse, "least_rmse": least}, int(bar.n))
            bar.update()

        return search.run(
            name, estimator, inputs.apply(data.inputs), outputs.apply(data.outputs), outputs, report
        )


def check_hyperparameters(estimator: Any) -> None:
    """Raise TypeError or ValueError if a setting of a method is invalid, before curves are made."""
    if hasattr(estimator, "check_parameters"):
        estimator.check_parameters()
    else:
        check_settings(estimator)
    if isinstance(device := getattr(estimator, "device", None), str):
        check_device(device)


def fit(problem: Problem, estimator: Any, run_log: RunLog | None) -> TrainedModel:
    """Return the estimator fitted to the training curves, with its scaling and a summary.

    A regressor that is none of ``METHODS`` has its class's name.
    """
    names = {kind: name for name, kind in METHODS.items()}
    name = names.get(type(estimator), type(estimator).__name__)
    model = TrainedModel(
        name=name,
        estimator=estimator,
        task=replace(problem.task, extractor=problem.extractor),
        generator=problem.generator,
        settings=problem.settings,
        healthy_features=problem.healthy_features(),
    )
    training: dict[str, Any] = {"seed": problem.seed, "seconds": 0.0}
    # methods that work on curves learn nothing: they fit the model's own curve to each
    if not getattr(estimator, "works_on_curves", False):
        data = problem.features(TRAIN)
        complete = data.complete(problem.extractor)
        n_made, n_complete = len(data.inputs), len(complete.inputs)
        if 1 - n_complete / n_made > TOO_MANY_LOST:
            log.warning(
                "%.1f %% of the training curves lack a feature and are left out; of peaks look at "
                "figures/peaks_*.png and protocol.features (smoothing_hz, low_hz, high_hz)",
                100 * (1 - n_complete / n_made),
            )
        # scale, then fit: iterations and seconds are those of the fit alone
        of_inputs, of_outputs = scalings(problem.task, complete)
        model = replace(model, input_scaling=of_inputs, output_scaling=of_outputs)
        start = time.perf_counter()
        with _FitProgress(estimator, name, run_log, n_complete, problem.progress):
            estimator.fit(of_inputs.apply(complete.inputs), of_outputs.apply(complete.outputs))
        training["seconds"] = time.perf_counter() - start
        training |= {"n_train": n_made, "n_train_complete": n_complete}
    training |= _summary(estimator)
    return replace(model, training=training)


def refitted(problem: Problem, model: TrainedModel) -> Iterator[tuple[int, TrainedModel]]:
    """Yield the model when it learns from ever more of the training curves, and their numbers.

    The scaling stays that of all curves, and the last model is the given one. A method that works
    on curves learns from none.
    """
    if model.input_scaling is None or model.output_scaling is None:  # it works on curves
        return
    kept = problem.features(TRAIN).complete(problem.extractor)
    n_all = len(kept.inputs)
    for share in SHARES:
        part = kept.first(n_all // share)
        if len(part.inputs) < LEAST_CURVES:
            continue
        estimator = deepcopy(model.estimator)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            try:
                estimator.fit(
                    model.input_scaling.apply(part.inputs), model.output_scaling.apply(part.outputs)
                )
            except ValueError:  # a registered method may need more curves
                continue
        yield len(part.inputs), replace(model, estimator=estimator)
    yield n_all, model


def scalings(task: Task, data: FeatureData) -> tuple[Scaling, Scaling]:
    """Return the scaling of inputs and outputs that a task asks for, from complete curves."""
    if not task.standardised:
        widths = data.inputs.shape[1], data.outputs.shape[1]
        inputs, outputs = (Scaling.relative_changes(n, task.log_ratios) for n in widths)
        return inputs, outputs
    log_inputs = task.log_ratios and task.extractor.positive
    return Scaling.of(data.inputs, log_inputs), Scaling.of(data.outputs, task.log_ratios)


def _summary(estimator: Any) -> dict[str, Any]:
    fitted = {
        key.removesuffix("_"): value
        for key, value in vars(estimator).items()
        if key.endswith("_") and isinstance(value, bool | int | float)
    }
    return {"fitted": fitted, "parameters": parameters(estimator)}


class _FitProgress:
    """A progress bar and a log of the values that a fit passes to its callback.

    TensorBoard shows them by the name of the solver, if the method has several, else by its own.
    """

    def __init__(
        self, estimator: Any, name: str, run_log: RunLog | None, n_samples: int, progress: bool
    ) -> None:
        self._estimator, self._log, self._n_samples = estimator, run_log, n_samples
        self._prefix = str(getattr(estimator, "solver", name))
        self._active = run_log is not None and "callback" in estimator.get_params()
        self._bar = progress_bar(f"fit {name}", unit="step" if self._active else "", shown=progress)

    def __enter__(self) -> None:
        if self._active:
            self._estimator.set_params(callback=self._report)

    def __exit__(self, *_: object) -> None:
        if self._active:
            self._estimator.set_params(callback=None)
        self._bar.close()

    def _report(self, info: Any) -> None:
        self._bar.update()
        if self._log is not None and is_dataclass(info) and not isinstance(info, type):
            values = asdict(info)
            step = values.pop(next(iter(values)))
            if "support_fraction" in values:  # the paper's iterations have a number of vectors
                values["support"] = round(values.pop("support_fraction") * self._n_samples)
            self._log.scalars(self._prefix, values, step)
            shown = {k: f"{v:.3g}" for k, v in list(values.items())[:2]}
            self._bar.set_postfix(shown, refresh=False)
