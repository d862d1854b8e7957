"""Estimates for the curves of a problem: predicted, refined, with residual scales and flags."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from torch import Tensor

from suspnet.estimation.estimate import Flags
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_curves import (
    identified,
    refine_curves,
    regress,
    residual_scales,
)
from suspnet.estimation.problem import BATCH, BLOCK, STREAM_NAMES, FeatureData, Problem, pool_of
from suspnet.estimation.protocols import MASS
from suspnet.estimation.refine import Refined
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.types import FloatArray

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
    """Return a model's estimates for the curves of a stream of a problem.

    With `flags` each curve is fitted as well, which the flags need. ValueError if no curve has all
    of its peaks, or the model cannot use such curves.
    """
    data = problem.features(stream)
    kept = data.complete()
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
    found = None
    if flags and model.ood is not None and refined is not None:
        found = model.flags(data.inputs, data.reasons, refined)
    return Outcome(kept, predicted[data.valid], seconds, len(data.inputs), scales, found)


def regress_stream(
    problem: Problem, model: FittedMethod, data: FeatureData, stream: int
) -> FloatArray:
    """Return the regression's estimates, (n_curves, n_outputs); NaN where a feature is missing."""
    if not model.estimator.works_on_curves:
        batches = range(problem.n_batches(len(data.inputs)))

        def batch(i: int) -> FloatArray:
            inputs = data.inputs[i * BATCH : (i + 1) * BATCH]
            return regress(model, problem.observer, inputs, Tensor())

        with pool_of(problem.threads if model.corrected else 1) as pool:
            return np.concatenate(list(pool.map(batch, batches)))

    def fit(curves: Tensor, rows: slice, mass: FloatArray | None) -> FloatArray:
        return regress(model, problem.observer, data.inputs[rows], curves, mass)

    return np.concatenate(_over_blocks(problem, data, stream, fit, threads=1))


def refine_stream(
    problem: Problem, data: FeatureData, predicted: FloatArray, stream: int
) -> Refined:
    """Return refined estimates for the curves of a stream, block by block."""

    def fit(curves: Tensor, rows: slice, mass: FloatArray | None) -> Refined:
        return refine_curves(problem.task, problem.observer, curves, predicted[rows], mass)

    return Refined.joined(_over_blocks(problem, data, stream, fit, threads=problem.threads))


def _over_blocks(
    problem: Problem,
    data: FeatureData,
    stream: int,
    fit: Callable[[Tensor, slice, FloatArray | None], Part],
    threads: int,
) -> list[Part]:
    """Return the results of `fit` for each block's curves, rows and known masses."""
    mass = data.ratios[:, MASS] if problem.task.mass_known else None
    n_curves = len(data.ratios)
    title = f"fits of {STREAM_NAMES[stream]} curves"
    with progress_bar(title, n_curves, unit="curve", shown=problem.progress) as bar:

        def one(block: int) -> Part:
            rows = slice(block * BLOCK, (block + 1) * BLOCK)
            curves = problem.curves(data.ratios, stream, block)
            found = fit(curves, rows, None if mass is None else mass[rows])
            bar.update(len(curves))
            return found

        with pool_of(threads) as pool:
            return list(pool.map(one, range(problem.n_blocks(n_curves))))
