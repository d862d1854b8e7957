"""Calibration: intervals and the out-of-distribution detector, learnt from fresh curves."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from suspnet.data import FeatureData
from suspnet.data.estimates import EstimateObserver
from suspnet.model.fitted import FittedMethod
from suspnet.model.from_curves import identified
from suspnet.problem import CALIBRATE, TRAIN, Problem
from suspnet.runs.predict import refine_stream, regress_stream
from suspnet.uncertainty.conformal import Conformal
from suspnet.uncertainty.intervals import Intervals, residuals
from suspnet.uncertainty.ood import OODDetector

N_FITS, N_UNCERTAIN_FITS = 2048, 128
"""Refined calibration curves from which the usual misfit is learnt; the second where uncertain
numbers are fitted too, which takes 0.1 to 0.2 s a curve."""
N_UNCERTAIN_REFINED = 512
"""Calibration curves of a refined model where uncertain numbers are fitted too: the coverage of a
90 % interval scatters by 1.3 %."""
N_TRIED = 1024
"""Calibration curves that show whether correcting the estimates lowers their error."""
Model = TypeVar("Model", bound=FittedMethod)


def calibrated(problem: Problem, model: Model) -> Model:
    """Return a model with intervals and OOD detector, learnt from curves like the training curves.

    Half of them teach the residual scale and half give the scores; of refined estimates, whose
    residual scale is known, all give scores. With ``settings.n_calibrate`` None the model comes
    back as it is.

    Raises
    ------
    ValueError
        If the model refines, and the curves do not identify an output.
    """
    if problem.settings.n_calibrate is None:
        return model
    data = problem.features(CALIBRATE)
    uncertain = problem.observer.directions.n > 0
    if uncertain and model.refined:
        data = data.first(min(N_UNCERTAIN_REFINED, len(data.valid)))
    kept = data.valid
    model = replace(model, corrected=_is_corrected(problem, model, data))
    predicted = regress_stream(problem, model, data, CALIBRATE)
    n_usual = N_UNCERTAIN_FITS if uncertain else N_FITS
    n_fits = len(kept) if model.refined else min(n_usual, len(kept))
    fitted = refine_stream(problem, data.first(n_fits), predicted[:n_fits], CALIBRATE)
    inputs = model.scaled(data.inputs)
    if model.refined:
        estimates, deviations = identified(model.task, fitted)
        wrong = residuals(estimates[kept], data.outputs[kept], log=True)
        intervals = Intervals(Conformal.of(wrong, deviations[kept]), True, None)
    else:
        wrong = residuals(predicted[kept], data.outputs[kept], model.log)
        known = model.with_estimates(data.inputs[kept], predicted[kept])
        intervals = Intervals.learnt(known, wrong, model.log)
    training = inputs[:0]  # a method that works on curves has no cloud of features
    if model.input_scaling is not None:
        training = model.scaled(problem.features(TRAIN).complete().inputs)
    ood = OODDetector.learnt(training, inputs[kept], fitted.misfit)
    return replace(model, intervals=intervals, ood=ood)


def _is_corrected(problem: Problem, model: FittedMethod, data: FeatureData) -> bool:
    """Return whether correcting estimates lowers the rms error of every output.

    Only estimates from trips are corrected, and only where they are all that is unknown: then they
    are a whole vehicle, with a curve. It does not pay where a regression shrinks what it cannot
    tell towards the mean.
    """
    task = model.task
    if (
        not isinstance(problem.observer, EstimateObserver)
        or model.estimator.works_on_curves
        or not set(task.unknown) <= set(task.outputs)
        or task.mass_known
        or not model.log
    ):
        return False
    some = data.first(N_TRIED).complete()
    errors = []
    for choice in (False, True):
        tried = regress_stream(problem, replace(model, corrected=choice), some, CALIBRATE)
        wrong = residuals(tried, some.outputs, log=True)
        errors.append(np.mean(wrong**2, axis=0))
    return bool((errors[1] <= errors[0]).all())
