"""From observed curves to estimates: regression, refinement on the curve, intervals, flags."""

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.estimates import Misfit, Observer
from suspnet.curves.protocols import Task, columns_of
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.refine import Refined, complete_ratios, refine
from suspnet.ground.parameters import BODY_MASS
from suspnet.ground.tensors import as_tensor
from suspnet.ground.types import FloatArray
from suspnet.vehicle import PARAMETERS

ONE_SIGMA = 0.6827
"""Level of an interval whose half width is one standard deviation of a normal error."""
ROWS = 256  # number of curves generated at once for the correction of estimates


def estimate_curves(
    method: FittedMethod,
    observer: Observer,
    curves: Tensor,
    level: float,
    mass: FloatArray | None = None,
) -> Estimate:
    """Return estimates, intervals and flags of curves (n_curves, 2, n_freq).

    `observer` is that of the curves, with the method's own generator; `mass` (n_curves,) the
    measured car-body mass ratio, if the task knows it. ValueError if the curves do not fit the
    method, or no curve identifies the outputs to be refined.
    """
    task = method.task
    inputs, reasons = method.features(observer.for_features(curves), observer.frequencies_hz)
    if mass is not None:
        inputs = np.column_stack([inputs, mass])
    predicted = regress(method, observer, inputs, curves, mass)
    # the detector needs the misfit of a refined estimate, even if the regression's is returned
    refined = None
    if method.refined or method.ood is not None:
        refined = refine_curves(task, observer, curves, predicted, mass)
    values = predicted
    if method.refined and refined is not None:
        values, deviations = refined.of(task.outputs)
        is_identified = np.asarray(np.isfinite(deviations).all(axis=1))
        if not is_identified.any():
            identified(task, refined)
        values = np.where(is_identified[:, None], values, np.nan)
    low = high = np.full_like(values, np.nan)
    if method.intervals is not None:
        scales = residual_scales(method, inputs, values, refined)
        low, high = method.intervals.ends(values, scales, level)
    flags = Flags.none(len(values))
    if method.ood is not None and refined is not None:
        flags = method.flags(inputs, reasons, refined)
    return Estimate(task.outputs, values, low, high, level, flags, method.healthy)


def regress(
    method: FittedMethod,
    observer: Observer,
    inputs: FloatArray,
    curves: Tensor,
    mass: FloatArray | None = None,
) -> FloatArray:
    """Return the regression's estimates, (n_curves, n_outputs); NaN where a peak is missing.

    `inputs` (n_curves, n_inputs) are features relative to healthy (and the mass); a method that
    works on curves uses `curves` (n_curves, 2, n_freq) and `mass` (n_curves,).
    """
    if getattr(method.estimator, "works_on_curves", False):
        return _fit_curves(method, observer, curves, mass)
    predicted = np.full((len(inputs), len(method.task.outputs)), np.nan)
    complete = np.isfinite(inputs).all(axis=1)
    if complete.any():
        predicted[complete] = corrected(method, observer, method.predict(inputs[complete]))
    return predicted


def corrected(
    method: FittedMethod, observer: Observer, predicted: FloatArray, n_steps: int = 1
) -> FloatArray:
    """Return estimates without the regression's own error at the estimated vehicles.

    With g(p) the regression's estimate from the noise-free curve of vehicle p, and p_0 that from
    the observed curve, each step is p <- p p_0 / g(p), towards the p with g(p) = p_0: indirect
    inference (Gourieroux, Monfort and Renault 1993). It accounts for the speed and the noise of the
    observation, whatever the regression was trained for.

    `predicted` (n_curves, n_outputs) is p_0, of all unknown parameters; it is returned unchanged
    for a method without `corrected`. One step is enough for curves like the training curves.
    """
    columns, estimates = method.task.output_indices, predicted
    for _ in range(n_steps if method.corrected else 0):
        parts = []
        for rows in np.array_split(np.arange(len(predicted)), math.ceil(len(predicted) / ROWS)):
            near = complete_ratios(method.task, estimates[rows])
            curves = observer.for_features(observer.noise_free(torch.as_tensor(near)))
            inputs = method.features(curves, observer.frequencies_hz)[0]
            usable = np.isfinite(inputs).all(axis=1)
            again = near[:, columns]  # no step where the vehicle lacks a feature
            again[usable] = method.predict(inputs[usable])
            parts.append(near[:, columns] * predicted[rows] / again)
        estimates = method.task.bounded(np.concatenate(parts))
    return estimates


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

    Raises ValueError if the curves do not identify an output.
    """
    estimates, deviations = refined.of(task.outputs)
    for name, column in zip(task.outputs, deviations.T, strict=True):
        if not np.isfinite(column).all():
            raise ValueError(
                f"refine=true needs curves that identify {name}, and these of protocol "
                f"{task.protocol!r} do not: take protocol=multi_location or joint, which use both"
            )
    return estimates, deviations


def residual_scales(
    method: FittedMethod, inputs: FloatArray, estimates: FloatArray, refined: Refined | None
) -> FloatArray:
    """Return the residual scale of curves for a calibrated method, (n_curves, n_outputs), [-].

    NaN where a peak is missing that the method needs.
    """
    intervals = method.intervals
    assert intervals is not None
    if intervals.residual_scale is None:
        assert refined is not None
        return refined.of(method.task.outputs)[1]
    predictors = method.with_estimates(inputs, estimates)
    complete = np.isfinite(predictors).all(axis=1)
    values = np.full((len(inputs), len(method.task.outputs)), np.nan)
    if complete.any():
        values[complete] = intervals.residual_scale.predict(predictors[complete])
    return values


def _fit_curves(
    method: FittedMethod, observer: Observer, curves: Tensor, mass: FloatArray | None
) -> FloatArray:
    """Return the outputs with the nearest magnitudes to those observed, (n_curves, n_outputs).

    Of several sets of parameters that vary together, the one whose fit is nearest counts.
    """
    task = method.task
    if curves.is_complex():
        raise ValueError(
            f"model={method.name} fits magnitudes with white noise; it cannot be used with "
            "data=trips"
        )
    measured = torch.empty(len(curves), 0) if mass is None else as_tensor(mass)[:, None]
    solutions = method.estimator.fit_curves(
        [(functools.partial(_magnitudes, observer, task, s), len(s)) for s in task.unknown_sets],
        curves[:, task.used_responses],
        measured.to(curves),
        task.lower,
        task.upper,
    )
    nearest = torch.stack([solution.cost for solution in solutions]).argmin(dim=0).cpu().numpy()
    estimates = np.ones((len(curves), len(PARAMETERS)))
    for k, (unknown, solution) in enumerate(zip(task.unknown_sets, solutions, strict=True)):
        rows = np.flatnonzero(nearest == k)
        parameters = solution.parameters.cpu().numpy()
        estimates[rows[:, None], columns_of(unknown)] = parameters[rows]
    return estimates[:, task.output_indices]


def _magnitudes(
    observer: Observer, task: Task, unknown: Sequence[str], values: Tensor, measured: Tensor
) -> Tensor:
    """Return the responses that a task uses of vehicles with these values of unknown parameters."""
    columns = dict(zip(unknown, values.unbind(1), strict=True))
    if task.mass_known:
        columns[BODY_MASS] = measured[:, 0]
    healthy = torch.ones_like(values[:, 0])
    ratios = torch.stack([columns.get(name, healthy) for name in PARAMETERS], dim=1)
    magnitudes = observer.generator.magnitudes(ratios, observer.frequencies_hz)
    return magnitudes[:, task.used_responses]
