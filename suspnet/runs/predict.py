"""Estimates for the curves of a problem: predicted, refined, with intervals and flags."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from suspnet.data import CALIBRATE, TRAIN, CurveSettings, FeatureData, Task
from suspnet.data.curves import CurveObserver
from suspnet.data.estimates import EstimateObserver
from suspnet.data.misfit import CurveMisfit, EstimateMisfit, Misfit
from suspnet.data.source import BLOCK, pool_of, quiet, single_threaded_torch, used_responses
from suspnet.dynamics import PARAMETERS, ResponseGenerator
from suspnet.learning import CurveFit
from suspnet.model.checkpoint import TrainedModel
from suspnet.runs.fit import Problem
from suspnet.uncertainty.conformal import Conformal
from suspnet.uncertainty.intervals import Intervals, residuals
from suspnet.uncertainty.ood import Flags, Scope
from suspnet.uncertainty.refine import Refined, refine

FloatArray = NDArray[np.float64]
N_FITS = 2048
"""Refined calibration curves from which the usual misfit is learnt."""


@dataclass(frozen=True)
class Outcome:
    """Estimates on one stream of curves.

    Attributes
    ----------
    data : FeatureData
        The curves with an estimate: those on which every feature was found.
    predicted : array of shape (n_curves, n_outputs), [-]
    seconds : float
    n_asked : int
        Curves asked for, those with a missing feature included.
    scales : array of shape (n_curves, n_outputs), or None
        Of a calibrated model: see ``Intervals``.
    flags : Flags or None
        Of all `n_asked` curves, if they were asked for.
    """

    data: FeatureData
    predicted: FloatArray
    seconds: float
    n_asked: int
    scales: FloatArray | None = None
    flags: Flags | None = None


def predict_stream(
    problem: Problem, model: TrainedModel, stream: int, flags: bool = False
) -> Outcome:
    """Return a model's estimates for the curves of a stream of a problem.

    With `flags` each curve is fitted too, and it is said what speaks against its estimate.

    Raises
    ------
    ValueError
        If none of the curves has all of its peaks, or the model cannot use such curves.
    """
    data = problem.source.features(stream)
    kept = data.complete()
    start = time.perf_counter()
    predicted = _predicted(problem, model, data, stream)
    refined = None
    if model.refined or (flags and model.scope is not None):
        refined = refine_stream(problem, data, predicted, stream)
    if model.refined and refined is not None:
        predicted = _identified(model, refined)[0]
    seconds = time.perf_counter() - start
    scales = None
    if model.intervals is not None:
        scales = residual_scales(model, data.inputs, predicted, refined)[data.valid]
    found = None
    if flags and model.scope is not None and refined is not None:
        found = model.scope.flags(
            model.task, missing_words(model.task, data), model.scaled(data.inputs), refined
        )
    return Outcome(kept, predicted[data.valid], seconds, len(data.inputs), scales, found)


def calibrated(problem: Problem, model: TrainedModel) -> TrainedModel:
    """Return a model with intervals and scope, learnt from fresh curves like the training curves.

    Half of them teach the residual scale and half give the scores; of refined estimates, whose
    residual scale is known, all give scores.
    """
    if problem.settings.n_calibrate is None:
        return model
    data = problem.source.features(CALIBRATE)
    kept = data.valid
    predicted = _predicted(problem, model, data, CALIBRATE)
    n_fits = len(kept) if model.refined else min(N_FITS, len(kept))
    fitted = refine_stream(problem, data.first(n_fits), predicted[:n_fits], CALIBRATE)
    inputs = model.scaled(data.inputs)
    if model.refined:
        estimates, deviations = _identified(model, fitted)
        wrong = residuals(estimates[kept], data.outputs[kept], log=True)
        intervals = Intervals(Conformal.of(wrong, deviations[kept]), True, None)
    else:
        log = model.output_scaling is None or model.output_scaling.log
        wrong = residuals(predicted[kept], data.outputs[kept], log)
        known = model.with_estimates(data.inputs[kept], predicted[kept])
        intervals = Intervals.learnt(known, wrong, log)
    training = inputs[:0]  # a method that works on curves has no cloud of features
    if model.input_scaling is not None:
        training = model.scaled(problem.source.features(TRAIN).complete().inputs)
    scope = Scope.learnt(training, inputs[kept], fitted.misfit)
    return replace(model, intervals=intervals, scope=scope)


def flags_of(
    model: TrainedModel,
    observer: CurveObserver | EstimateObserver,
    curves: Tensor,
    mass: FloatArray | None = None,
) -> Flags:
    """Return what speaks against a calibrated model's estimates for any curves.

    Parameters
    ----------
    model : TrainedModel
    observer : CurveObserver or EstimateObserver
        How the curves were observed, with the model's own generator.
    curves : tensor of shape (n_curves, 2, n_freq), [-]
    mass : array of shape (n_curves,), optional
        The measured car-body mass ratio, where the task knows it.
    """
    assert model.scope is not None
    task = model.task
    table = task.extractor.extract(curves, observer.frequencies_hz.to(curves.device))
    inputs = task.extractor.relative(table.values.cpu().numpy(), model.healthy_features)
    if mass is not None:
        inputs = np.column_stack([inputs, mass])
    scaled = model.scaled(inputs)
    predicted = np.full((len(inputs), len(task.outputs)), np.nan)
    complete = np.isfinite(scaled).all(axis=1)
    if complete.any() and model.input_scaling is not None:
        predicted[complete] = model.predict(inputs[complete])
    misfit = misfit_of(observer, task, curves, _near(task, predicted, mass))
    refined = refine(task, misfit, predicted, mass)
    reasons = table.reasons.cpu().numpy()
    missing = [task.extractor.missing(row) if row.any() else "" for row in reasons]
    return model.scope.flags(task, missing, scaled, refined)


def residual_scales(
    model: TrainedModel, inputs: FloatArray, predicted: FloatArray, refined: Refined | None
) -> FloatArray:
    """Return the residual scale of curves for a calibrated model, (n_curves, n_outputs), [-].

    NaN where a peak is missing and the model cannot do without.
    """
    intervals = model.intervals
    assert intervals is not None
    if intervals.residual_scale is None:
        assert refined is not None
        return refined.of(model.task.outputs)[1]
    known = model.with_estimates(inputs, predicted)
    complete = np.isfinite(known).all(axis=1)
    values = np.full((len(inputs), len(model.task.outputs)), np.nan)
    values[complete] = intervals.residual_scale.predict(known[complete])
    return values


def refine_stream(
    problem: Problem, data: FeatureData, predicted: FloatArray, stream: int
) -> Refined:
    """Return refined estimates for the curves of a stream, block by block."""
    source, task = problem.source, problem.task
    mass = data.ratios[:, PARAMETERS.index("M_s")] if task.mass_known else None
    with tqdm(total=len(predicted), desc="refine", disable=quiet(problem.progress)) as bar:

        def fit(block: int) -> Refined:
            rows = slice(block * BLOCK, (block + 1) * BLOCK)
            curves = source.curves(data.ratios, stream, block)
            known = None if mass is None else mass[rows]
            near = _near(task, predicted[rows], known)
            found = refine(
                task, misfit_of(source.observer, task, curves, near), predicted[rows], known
            )
            bar.update(len(curves))
            return found

        with single_threaded_torch(problem.threads), pool_of(problem.threads) as pool:
            return Refined.joined(list(pool.map(fit, range(source.n_blocks(len(predicted))))))


def _identified(model: TrainedModel, refined: Refined) -> tuple[FloatArray, FloatArray]:
    """Return refined outputs and deviations; ValueError if the curves do not tell an output."""
    estimates, deviations = refined.of(model.task.outputs)
    for name, column in zip(model.task.outputs, deviations.T, strict=True):
        if not np.isfinite(column).all():
            raise ValueError(
                f"refine=true needs curves that tell {name}, and these of protocol "
                f"{model.task.protocol!r} do not: see python evaluate.py "
                f"experiment=identifiability protocol={model.task.protocol}"
            )
    return estimates, deviations


def misfit_of(
    observer: CurveObserver | EstimateObserver, task: Task, curves: Tensor, near: FloatArray
) -> Misfit:
    """Return the misfit of curves (n, 2, n_freq) of vehicles with ratios about `near` (n, 5)."""
    if isinstance(observer, CurveObserver):
        return CurveMisfit(observer, curves, tuple(used_responses(task)))
    ratios = torch.as_tensor(near, device=curves.device)
    return EstimateMisfit(observer, curves, observer.covariance(ratios))


def missing_words(task: Task, data: FeatureData) -> list[str]:
    """Return what is missing of each curve, in words; empty where nothing is."""
    return [task.extractor.missing(row) if row.any() else "" for row in data.reasons]


def _near(task: Task, predicted: FloatArray, mass: FloatArray | None) -> FloatArray:
    """Return complete ratios (n, 5): the estimates, and healthy where there is none."""
    full = np.ones((len(predicted), len(PARAMETERS)))
    limits = np.array([task.limits(name) for name in task.outputs])
    inside = np.clip(predicted, limits[:, 0], limits[:, 1])
    full[:, task.output_indices] = np.where(np.isfinite(predicted), inside, 1.0)
    if mass is not None:
        full[:, PARAMETERS.index("M_s")] = mass
    return full


def _predicted(problem: Problem, model: TrainedModel, data: FeatureData, stream: int) -> FloatArray:
    """Return estimates of all curves, (n_curves, n_outputs); NaN where a peak is missing."""
    if not isinstance(model.estimator, CurveFit):
        predicted = np.full((len(data.inputs), len(model.task.outputs)), np.nan)
        predicted[data.valid] = model.predict(data.inputs[data.valid])
        return predicted
    if not isinstance(problem.settings, CurveSettings):
        raise ValueError(
            "model=curve_fit fits magnitudes with white noise; it cannot be used with data=trips"
        )
    return _fit_curves(problem, model.estimator, data, stream)


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


def _fit_curves(problem: Problem, method: CurveFit, data: FeatureData, stream: int) -> FloatArray:
    task, source = problem.task, problem.source
    forward = curve_model(problem.generator, task, problem.settings.frequencies_hz())
    known = torch.as_tensor(
        data.ratios[:, [PARAMETERS.index("M_s")]] if task.mass_known else data.ratios[:, :0]
    )
    used, unknown = used_responses(task), task.unknown
    estimates = []
    with tqdm(total=len(data.ratios), desc="curve fit", disable=quiet(problem.progress)) as bar:
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
