"""From observed curves to estimates: regression, refinement on the curve, intervals, flags."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from suspnet.data.observation import Misfit, Observer
from suspnet.data.protocols import Task
from suspnet.dynamics import PARAMETERS, ResponseGenerator
from suspnet.features import FeatureSet
from suspnet.model.estimate import Estimate
from suspnet.model.fitted import FittedMethod
from suspnet.types import FloatArray, IntArray
from suspnet.uncertainty.ood import Flags
from suspnet.uncertainty.refine import Refined, complete_ratios, refine

MASS = PARAMETERS.index("M_s")


def estimate_curves(
    method: FittedMethod,
    observer: Observer,
    curves: Tensor,
    level: float,
    mass: FloatArray | None = None,
) -> Estimate:
    """Return estimates, intervals and flags of any curves.

    Parameters
    ----------
    method : FittedMethod
    observer : Observer
        How the curves were observed, with the method's own generator.
    curves : tensor of shape (n_curves, 2, n_freq), [-]
    level : float
        Probability of the intervals.
    mass : array of shape (n_curves,), optional
        The measured car-body mass ratio, where the task knows it.

    Raises
    ------
    ValueError
        If the curves do not fit the method, or none identifies an output that is to be refined.
    """
    task = method.task
    table = task.extractor.extract(curves, observer.frequencies_hz.to(curves.device))
    inputs = task.extractor.relative(table.values.cpu().numpy(), method.healthy_features)
    if mass is not None:
        inputs = np.column_stack([inputs, mass])
    predicted = regress(method, observer, inputs, curves, mass)
    refined = None
    if method.refined or method.ood is not None:
        refined = refine_curves(task, observer, curves, predicted, mass)
    values = predicted
    if method.refined and refined is not None:
        values, deviations = refined.of(task.outputs)
        told = np.asarray(np.isfinite(deviations).all(axis=1))
        if not told.any():
            identified(task, refined)
        values = np.where(told[:, None], values, np.nan)
    low = high = np.full_like(values, np.nan)
    if method.intervals is not None:
        scales = residual_scales(method, inputs, values, refined)
        low, high = method.intervals.ends(values, scales, level)
    flags = Flags.none(len(values))
    if method.ood is not None and refined is not None:
        missing = missing_words(task.extractor, table.reasons.cpu().numpy())
        flags = method.ood.flags(task, missing, method.scaled(inputs), refined)
    return Estimate(task.outputs, values, low, high, level, flags)


def regress(
    method: FittedMethod,
    observer: Observer,
    inputs: FloatArray,
    curves: Tensor,
    mass: FloatArray | None = None,
) -> FloatArray:
    """Return the regression's estimates, shape (n_curves, n_outputs); NaN where a peak is missing.

    Parameters
    ----------
    method : FittedMethod
    observer : Observer
    inputs : array of shape (n_curves, n_inputs), [-]
        Features relative to healthy (and the mass).
    curves : tensor of shape (n_curves, 2, n_freq), [-]
        Input of a method that works on curves.
    mass : array of shape (n_curves,), optional
    """
    if method.estimator.works_on_curves:
        return _fit_curves(method, observer, curves, mass)
    predicted = np.full((len(inputs), len(method.task.outputs)), np.nan)
    complete = np.isfinite(inputs).all(axis=1)
    if complete.any():
        predicted[complete] = method.predict(inputs[complete])
    return predicted


def refine_curves(
    task: Task, observer: Observer, curves: Tensor, predicted: FloatArray, mass: FloatArray | None
) -> Refined:
    """Return maximum-likelihood estimates of all unknown parameters, started from `predicted`."""

    def misfit(near: Tensor) -> Misfit:
        return observer.misfit(curves, near, task.used_responses)

    start = misfit(torch.as_tensor(complete_ratios(task, predicted, mass)))
    return refine(task, start, predicted, mass, directions=observer.directions, near=misfit)


def identified(task: Task, refined: Refined) -> tuple[FloatArray, FloatArray]:
    """Return refined outputs and their standard deviations, each (n_curves, n_outputs).

    Raises
    ------
    ValueError
        If the curves do not identify an output.
    """
    estimates, deviations = refined.of(task.outputs)
    for name, column in zip(task.outputs, deviations.T, strict=True):
        if not np.isfinite(column).all():
            raise ValueError(
                f"refine=true needs curves that tell {name}, and these of protocol "
                f"{task.protocol!r} do not: see python evaluate.py "
                f"study=identifiability protocol={task.protocol}"
            )
    return estimates, deviations


def residual_scales(
    method: FittedMethod, inputs: FloatArray, estimates: FloatArray, refined: Refined | None
) -> FloatArray:
    """Return the residual scale of curves for a calibrated method, (n_curves, n_outputs), [-].

    NaN where a peak is missing and the method cannot do without.
    """
    intervals = method.intervals
    assert intervals is not None
    if intervals.residual_scale is None:
        assert refined is not None
        return refined.of(method.task.outputs)[1]
    known = method.with_estimates(inputs, estimates)
    complete = np.isfinite(known).all(axis=1)
    values = np.full((len(inputs), len(method.task.outputs)), np.nan)
    if complete.any():
        values[complete] = intervals.residual_scale.predict(known[complete])
    return values


def missing_words(extractor: FeatureSet, reasons: IntArray) -> list[str]:
    """Return what is missing of each curve, in words; empty where nothing is."""
    return [extractor.missing(row) if row.any() else "" for row in reasons]


def curve_model(
    generator: ResponseGenerator, task: Task, frequencies_hz: Tensor
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return curves (n, n_responses, n_freq) as a function of the unknown and the known ratios."""

    def forward(unknown: Tensor, known: Tensor) -> Tensor:
        columns = dict(zip(task.unknown, unknown.unbind(1), strict=True))
        if task.mass_known:
            columns["M_s"] = known[:, 0]
        healthy = torch.ones_like(unknown[:, 0])
        ratios = torch.stack([columns.get(name, healthy) for name in PARAMETERS], dim=1)
        return generator.magnitudes(ratios, frequencies_hz)[:, task.used_responses]

    return forward


def _fit_curves(
    method: FittedMethod, observer: Observer, curves: Tensor, mass: FloatArray | None
) -> FloatArray:
    """Return the outputs whose magnitudes lie nearest to those observed, (n_curves, n_outputs)."""
    task = method.task
    if curves.is_complex():
        raise ValueError(
            f"model={method.name} fits magnitudes with white noise; it cannot be used with "
            "data=trips"
        )
    known = torch.empty(len(curves), 0) if mass is None else torch.as_tensor(mass)[:, None]
    solution = method.estimator.fit_curves(
        curve_model(observer.generator, task, observer.frequencies_hz),
        curves[:, task.used_responses],
        known.to(curves),
        task.lower,
        task.upper,
        len(task.unknown),
    )
    found = solution.parameters.cpu().numpy()
    return np.asarray(found[:, [task.unknown.index(name) for name in task.outputs]])
