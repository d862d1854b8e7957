"""How far one trip's estimate can be trusted: its interval, and what speaks against it.

Intervals are calibrated on curves with the averages and the noise that a model was trained for, and
a trip has its own. So the part of the error that noise makes is taken out and the trip's put in::

    s^2 = max(s_0^2 - n_0^2, 0) + n^2,   half width = s q(level) / q(ONE_SIGMA)

with s_0 the standard deviation that the calibration gives and q its quantiles, n_0 the noise part
expected of such a vehicle in training, n that of the trip. What is left, s_0^2 - n_0^2, is the
error of the regression itself and of what the generator holds uncertain. Of refined estimates n_0
and n are the deviations of Gauss-Newton; of others the spread of estimates from drawn spectra.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from suspnet.model.checkpoint import TrainedModel
from suspnet.data.estimates import EstimateObserver, EstimateSettings
from suspnet.data.misfit import EstimateMisfit
from suspnet.dynamics import PARAMETERS
from suspnet.theory.information import output_bounds
from suspnet.features.cross_spectra import CrossSpectra
from suspnet.uncertainty.refine import Refined, refine

N_DRAWS = 64
"""Draws of a trip's noise. Their spread is known to 0.96 / sqrt(64) = 12 %, but n and n_0 come from
the same random numbers and err alike: half widths are known to 4 % at a quarter of the averages."""
ONE_SIGMA = 0.6827
CONFIRMED = 1.05
"""Calibrations that widen the deviations of refined estimates by less find nothing but noise."""
SMOOTHED_BINS = 5
"""Neighbouring bins over which a trip's measured covariance is averaged."""
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Trusted:
    """A trip's estimate in one speed bin, with its interval.

    Attributes
    ----------
    values, half_widths : arrays of shape (n_outputs,), [-]
        The interval reaches from values * exp(-half_widths) to values * exp(half_widths); NaN if
        the model has no intervals.
    flags : str
        What speaks against the estimate; empty if nothing does.
    """

    values: FloatArray
    half_widths: FloatArray
    flags: str


def trusted(
    model: TrainedModel, spectra: CrossSpectra, inputs: FloatArray, level: float
) -> Trusted:
    """Return a trip's estimate with interval and flags.

    Parameters
    ----------
    model : TrainedModel
        Trained on estimates from trips.
    spectra : CrossSpectra
        Of the trip on the model's bins, (3, n_freq).
    inputs : array of shape (1, n_inputs), [-]
        Features, complete.
    level : float
        Probability of the interval.
    """
    predicted = model.predict(inputs)
    blank = np.full(predicted.shape[1], np.nan)
    if model.intervals is None and not model.refined:
        return Trusted(predicted[0], blank, "")
    assert isinstance(model.settings, EstimateSettings)
    observer = model.settings.observer(replace(model.generator, device="cpu"))  # as the spectra are
    refined = _refined(model, observer, spectra, predicted)
    if model.intervals is None or model.scope is None:
        return Trusted(refined.of(model.task.outputs)[0][0], blank, "")
    seen = _as_in_training(refined, observer.settings.n_averages / spectra.n_averages)
    flags = model.scope.flags(model.task, [""], model.scaled(inputs), seen).reasons[0]
    factor, usual = (model.intervals.conformal.factors(p) for p in (level, ONE_SIGMA))
    ratios = _ratios(model, predicted)
    if model.refined:
        values, noise = (part[0] for part in refined.of(model.task.outputs))
        noise_0 = scale = noise
        if not (usual < CONFIRMED).all():
            bounds = output_bounds(model.task, observer, ratios.numpy())
            noise_0 = scale = bounds[0] / ratios.numpy()[0, model.task.output_indices]
    else:
        values = predicted[0]
        expected = observer.expected(ratios)
        mean = CrossSpectra(expected.auto[0], expected.cross[0], expected.n_averages)
        noise_0, noise = (_noise(model, observer, drawn) for drawn in (mean, spectra))
        scale = _residual_scale(model, inputs, predicted)
    spread = np.sqrt(_lasting(usual * scale, noise_0) + noise**2)
    return Trusted(values, factor / usual * spread, flags)


def _lasting(usual: FloatArray, noise_0: FloatArray) -> FloatArray:
    """Return max(s_0^2 - n_0^2, 0), what no average takes away; 0 where both are infinite."""
    s_0, n_0 = (np.nan_to_num(part, posinf=0.0) for part in (usual, noise_0))
    return np.asarray(np.maximum(s_0**2 - n_0**2, 0))


def _residual_scale(model: TrainedModel, inputs: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the residual scale of one curve's logarithms, (n_outputs,)."""
    intervals = model.intervals
    assert intervals is not None
    assert intervals.residual_scale is not None
    scale = intervals.residual_scale.predict(model.with_estimates(inputs, predicted))[0]
    return np.asarray(scale if intervals.log else scale / predicted[0])


def _refined(
    model: TrainedModel, observer: EstimateObserver, spectra: CrossSpectra, predicted: FloatArray
) -> Refined:
    method = observer.settings.method
    covariance = _smoothed(spectra.covariance(method))
    # the inverse of a measured covariance, 2 x 2 from n averages, is too large by n / (n - 2)
    n = spectra.n_averages * _independent(observer.settings.welch.correlation())
    covariance = covariance * n / (n - 2)
    misfit = EstimateMisfit(observer, spectra.responses(method)[None], covariance[None])
    return refine(model.task, misfit, predicted)


def _as_in_training(refined: Refined, share: float) -> Refined:
    """Return estimates with the misfit that trips with `share` of the averages would have.

    The mean square beyond 1 is that of the generator's own errors over that of the noise. It grows
    with the averages, and its limit is known for those of the training only. Shorter trips keep
    theirs: their misfit is noise.
    """
    beyond = (refined.misfit**2 - 1) * min(share, 1.0)
    return replace(refined, misfit=np.sqrt(1 + beyond))


def _smoothed(covariance: Tensor) -> Tensor:
    """Return the moving average over bins of a covariance (2, 2, n_freq)."""
    half = SMOOTHED_BINS // 2
    ends = [covariance[..., :1].expand(2, 2, half), covariance[..., -1:].expand(2, 2, half)]
    return torch.cat([ends[0], covariance, ends[1]], dim=-1).unfold(-1, SMOOTHED_BINS, 1).mean(-1)


def _independent(correlation: Tensor) -> float:
    """Return how many of the smoothed bins are independent, by their correlation from lag 0 on."""
    lags = torch.arange(len(correlation))
    pairs = (SMOOTHED_BINS - lags).clamp(min=0) * torch.where(lags == 0, 1, 2)
    return SMOOTHED_BINS**2 / float(pairs.to(correlation) @ correlation)


def _ratios(model: TrainedModel, predicted: FloatArray) -> Tensor:
    """Return complete ratios (1, 5) within the range trained for."""
    full = np.ones((1, len(PARAMETERS)))
    limits = np.array([model.task.limits(name) for name in model.task.outputs])
    full[:, model.task.output_indices] = np.clip(predicted, limits[:, 0], limits[:, 1])
    return torch.as_tensor(full)


def _noise(model: TrainedModel, observer: EstimateObserver, spectra: CrossSpectra) -> FloatArray:
    """Return the spread of the estimates' logarithms over draws of some spectra, (n_outputs,)."""
    drawn = observer.observe_again(spectra, N_DRAWS, seed=0)
    inputs = model.relative_features(drawn.numpy(), observer.frequencies_hz.numpy())
    inputs = inputs[np.isfinite(inputs).all(axis=1)]
    if len(inputs) < N_DRAWS // 2:
        return np.full(len(model.task.outputs), np.inf)
    low, high = np.quantile(model.predict(inputs), [0.1587, 0.8413], axis=0)
    return np.asarray(np.log(high / low) / 2)
