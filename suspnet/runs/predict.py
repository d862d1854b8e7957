"""Estimates for the curves of a problem, and the calibration of intervals and flags on them."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from torch import Tensor

from suspnet.curves.estimate_observer import EstimateObserver
from suspnet.curves.problem import (
    BATCH,
    BLOCK,
    CALIBRATE,
    STREAM_NAMES,
    TRAIN,
    FeatureData,
    Problem,
    pool_of,
)
from suspnet.curves.protocols import BODY_MASS_COLUMN
from suspnet.estimation.estimate import Flags
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.flags import OODDetector
from suspnet.estimation.from_curves import identified, refine_curves, regress, residual_scales
from suspnet.estimation.intervals import Conformal, Intervals, residuals
from suspnet.estimation.refine import Refined
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.types import FloatArray

N_FITS, N_UNCERTAIN_FITS = 2048, 48
"""Refined calibration curves from which the usual misfit is learnt; the second number applies
where uncertain numbers are fitted too, which takes 0.1 to 0.2 s per curve."""
N_UNCERTAIN = 2048
"""Largest number of calibration curves where the fit of the curve reads trips and the regression
only starts it: enough for the thresholds of flags."""
N_UNCERTAIN_REFINED = 512
"""Calibration curves of a refined model where uncertain numbers are fitted too: with these the
coverage of a 90 % interval has a standard deviation of 1.3 %."""
N_TRIED = 1024  # calibration curves that show whether correcting the estimates lowers their error
Model = TypeVar("Model", bound=FittedMethod)
Part = TypeVar("Part")


@dataclass(frozen=True)
class Outcome:
    """Estimates on one stream of curves.

    `data`: the curves with an estimate, on which every feature was found; `predicted`: (n_curves,
    n_outputs), ratios to healthy; `n_asked`: all curves, also those with a missing feature;
    `scales`: (n_curves, n_outputs), see ``Intervals``, None without calibration; `flags`: of all
    `n_asked` curves, None if not asked for.
    """

    data: FeatureData
    predicted: FloatArray
    seconds: float
    n_asked: int
    scales: FloatArray | None = None
    flags: Flags | None = None


def predict_stream(
    problem: Problem, model: FittedMethod, stream: int, flags: bool = False
) -> Outcome:
    """Return a model's estimates for a stream of curves; with `flags` each curve is fitted as well.

    ValueError if no curve has every feature, or the model cannot use such curves.
    """
    data = problem.features(stream)
    complete = data.complete(model.task.extractor)
    start = time.perf_counter()
    predicted = regress_stream(problem, model, data, stream)
    refined = None
    if model.refined or (flags and model.ood is not None):
        refined = refine_stream(problem, data, predicted, stream)
    if model.refined and refined is not None:
        predicted = identified(model.task, refined)[0]
    seconds = time.perf_counter() - start
    scales = None
    if model.intervals is not None:
        scales = residual_scales(model, data.inputs, predicted, refined)[data.valid]
    flagged = None
    if flags and model.ood is not None and refined is not None:
        flagged = model.flags(data.inputs, data.reasons, refined)
    return Outcome(complete, predicted[data.valid], seconds, len(data.inputs), scales, flagged)


def regress_stream(
    problem: Problem, model: FittedMethod, data: FeatureData, stream: int
) -> FloatArray:
    """Return the regression's estimates, (n_curves, n_outputs); NaN where a feature is missing."""
    if not getattr(model.estimator, "works_on_curves", False):

        def batch(start: int) -> FloatArray:
            inputs = data.inputs[start : start + BATCH]
            return regress(model, problem.observer, inputs, Tensor())

        with pool_of(problem.threads if model.corrected else 1) as pool:
            starts = range(0, len(data.inputs), BATCH)
            return np.concatenate(list(pool.map(batch, starts)))

    def fit(curves: Tensor, rows: slice, mass: FloatArray | None) -> FloatArray:
        return regress(model, problem.observer, data.inputs[rows], curves, mass)

    return np.concatenate(_over_blocks(problem, data, stream, fit))


def refine_stream(
    problem: Problem, data: FeatureData, predicted: FloatArray, stream: int
) -> Refined:
    """Return refined estimates for the curves of a stream, block by block."""

    def fit(curves: Tensor, rows: slice, mass: FloatArray | None) -> Refined:
        return refine_curves(problem.task, problem.observer, curves, predicted[rows], mass)

    return Refined.joined(_over_blocks(problem, data, stream, fit))


def _over_blocks(
    problem: Problem,
    data: FeatureData,
    stream: int,
    fit: Callable[[Tensor, slice, FloatArray | None], Part],
) -> list[Part]:
    """Return the results of `fit` for each block's curves, rows and known masses."""
    mass = data.ratios[:, BODY_MASS_COLUMN] if problem.task.mass_known else None
    n_curves = len(data.ratios)
    title = f"fits of {STREAM_NAMES[stream]} curves"
    with progress_bar(title, n_curves, unit="curve", shown=problem.progress) as bar:

        def fit_block(block: int) -> Part:
            rows = slice(block * BLOCK, (block + 1) * BLOCK)
            curves = problem.curves(data.ratios, stream, block)
            fitted = fit(curves, rows, None if mass is None else mass[rows])
            bar.update(len(curves))
            return fitted

        with pool_of(problem.threads) as pool:
            return list(pool.map(fit_block, range(problem.n_blocks(n_curves))))


def calibrated(problem: Problem, model: Model) -> Model:
    """Return a model with intervals and OOD detector, learnt from curves like the training curves.

    One half of them trains the residual scale and the other half gives the scores; refined
    estimates have a known residual scale, so all of them give scores. ValueError if the model
    refines and the curves do not identify an output.
    """
    if problem.settings.n_calibrate is None:
        return model
    uncertain = problem.observer.directions.n > 0
    n_enough = N_UNCERTAIN_REFINED if model.refined else N_UNCERTAIN
    data = problem.features(CALIBRATE, n_enough if uncertain else None)
    # decide on the correction first: intervals must describe the estimates that the model will give
    is_complete = data.valid
    model = replace(model, corrected=_is_corrected(problem, model, data))
    predicted = regress_stream(problem, model, data, CALIBRATE)
    # fit curves too: the misfit feeds the OOD detector, and refined models estimate by these fits
    n_usual = N_UNCERTAIN_FITS if uncertain else N_FITS
    n_fits = len(is_complete) if model.refined else min(n_usual, len(is_complete))
    fitted = refine_stream(problem, data.first(n_fits), predicted[:n_fits], CALIBRATE)
    inputs = model.scaled(data.inputs)
    if model.refined:
        estimates, deviations = identified(model.task, fitted)
        wrong = residuals(estimates[is_complete], data.outputs[is_complete], log=True)
        intervals = Intervals(Conformal.of(wrong, deviations[is_complete]), True, None)
    else:
        wrong = residuals(predicted[is_complete], data.outputs[is_complete], model.log)
        knowledge = model.with_estimates(data.inputs[is_complete], predicted[is_complete])
        intervals = Intervals.learnt(knowledge, wrong, model.log)
    training = inputs[:0]  # a method that works on curves has no cloud of features
    if model.input_scaling is not None:
        training = model.scaled(problem.features(TRAIN).complete(model.task.extractor).inputs)
    ood = OODDetector.learnt(training, inputs[is_complete], fitted.misfit)
    return replace(model, intervals=intervals, ood=ood)


def _is_corrected(problem: Problem, model: FittedMethod, data: FeatureData) -> bool:
    """Return whether correcting estimates lowers the rms error of every output.

    Only estimates from trips are corrected, and only if they contain all unknowns: then they
    describe a whole vehicle, whose curve can be computed. The correction does not help where a
    regression shrinks what it cannot determine towards the mean.
    """
    task = model.task
    if (
        not isinstance(problem.observer, EstimateObserver)
        or getattr(model.estimator, "works_on_curves", False)
        or not set(task.unknown) <= set(task.outputs)
        or task.mass_known
        or not model.log
    ):
        return False
    some = data.first(N_TRIED).complete(model.task.extractor)
    errors = []
    for choice in (False, True):
        tried = regress_stream(problem, replace(model, corrected=choice), some, CALIBRATE)
        wrong = residuals(tried, some.outputs, log=True)
        errors.append(np.mean(wrong**2, axis=0))
    return bool((errors[1] <= errors[0]).all())
