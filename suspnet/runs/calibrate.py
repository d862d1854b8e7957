"""Calibration: intervals and the out-of-distribution detector, learnt from fresh curves."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch

from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_curves import estimate_curves, identified
from suspnet.estimation.intervals import Conformal, Intervals, residuals
from suspnet.estimation.ood import OODDetector
from suspnet.estimation.physics import WORN, Residual, Unexplained
from suspnet.estimation.problem import CALIBRATE, TRAIN, FeatureData, Problem
from suspnet.runs.predict import refine_stream, regress_stream
from suspnet.spectra.estimates import EstimateObserver

N_FITS, N_UNCERTAIN_FITS = 2048, 128
"""Refined calibration curves from which the usual misfit is learnt; the second number applies
where uncertain numbers are fitted too, which takes 0.1 to 0.2 s per curve."""
N_UNCERTAIN_REFINED = 512
"""Calibration curves of a refined model where uncertain numbers are fitted too: with these the
coverage of a 90 % interval has a standard deviation of 1.3 %."""
N_TRIED = 1024
"""Calibration curves that show whether correcting the estimates lowers their error."""
N_COST, N_UNCERTAIN_COST = 256, 16
"""Curves for the cost of the unexplained residual; the second number is for a refined model
where uncertain numbers are fitted too, which takes about a second per curve if they do not
explain it."""
Model = TypeVar("Model", bound=FittedMethod)


def calibrated(problem: Problem, model: Model) -> Model:
    """Return a model with intervals and OOD detector, learnt from curves like the training curves.

    One half of them trains the residual scale and the other half gives the scores; refined
    estimates have a known residual scale, so all of them give scores. If ``settings.n_calibrate``
    is None the model is returned as it is. ValueError if the model refines and the curves do not
    identify an output.
    """
    if problem.settings.n_calibrate is None:
        return model
    data = problem.features(CALIBRATE)
    uncertain = problem.observer.directions.n > 0
    if uncertain and model.refined:
        data = data.first(min(N_UNCERTAIN_REFINED, len(data.valid)))
    # decide on the correction first: intervals must describe the estimates that the model will give
    kept = data.valid
    model = replace(model, corrected=_is_corrected(problem, model, data))
    predicted = regress_stream(problem, model, data, CALIBRATE)
    # fit curves too: the misfit feeds the OOD detector, and refined models estimate by these fits
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


def with_unexplained(problem: Problem, model: Model, residual: Residual) -> Model:
    """Return a model with the cost of the residual that its healthy trips leave unexplained.

    The cost is `WORN` times the rms log change of the estimates of noise-free vehicles like the
    training ones, when their curves are multiplied by exp(+-residual). ValueError if none of these
    curves has an estimate.
    """
    if not residual.logs.any():
        nothing = np.zeros(len(model.task.outputs))
        return replace(model, unexplained=Unexplained(residual.misfit, nothing))
    slow = model.refined and problem.observer.directions.n > 0
    ratios = problem.task.sample(N_UNCERTAIN_COST if slow else N_COST, problem.seed, CALIBRATE)
    curves = problem.noise_free(ratios)
    bare = replace(model, intervals=None, ood=None, unexplained=None)
    factor = torch.as_tensor(residual.logs).exp().to(curves.device)
    level = 0.9  # unused without intervals
    logs = [
        np.log(estimate_curves(bare, problem.observer, shifted, level).values)
        for shifted in (curves, curves * factor, curves / factor)
    ]
    changes = np.stack(logs[1:]) - logs[0]  # (2, n_curves, n_outputs)
    known = changes[np.isfinite(changes).all(axis=2)]
    if not len(known):
        raise ValueError(
            "no curve keeps its features when changed by the unexplained residual of the healthy "
            "trips: the vehicle file, the sensors' places or the band are wrong"
        )
    costs = WORN * np.sqrt(np.mean(known**2, axis=0))
    return replace(model, unexplained=Unexplained(residual.misfit, costs))


def _is_corrected(problem: Problem, model: FittedMethod, data: FeatureData) -> bool:
    """Return whether correcting estimates lowers the rms error of every output.

    Only estimates from trips are corrected, and only if they contain all unknowns: then they
    describe a whole vehicle, whose curve can be computed. The correction does not help where a
    regression shrinks what it cannot determine towards the mean.
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
