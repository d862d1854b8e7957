"""Interval and flags of one trip's estimate.

Intervals are calibrated on curves with the averages and the noise that a model was trained for,
while a trip has its own. The noise part of the residual scale in training is therefore replaced by
that of the trip::

    s^2 = l^2 + n^2,    l^2 = max(s_0^2 - n_0^2, 0)
    half width = s q(level) / q(ONE_SIGMA)

with s_0 the standard deviation from the calibration and q its quantiles, n_0 the noise part
expected of such a vehicle in training, n that of the trip. l^2 is the variance due to the
regression's own error and the generator's uncertain quantities. For refined estimates n is the
Gauss-Newton deviation with all uncertain numbers known, and the rest of that deviation adds to
l^2; for others n is the spread of estimates from drawn spectra. n is multiplied by the misfit of
the trip if that is above 1.

The refined estimate replaces the regression's where the regression was not trained, and for every
vehicle with uncertain numbers: the regression takes them at their median, the fit of the curve
fits them along. s_0 is then the Gauss-Newton deviation, and q the normal distribution's unless the
model was calibrated for refined estimates.
"""

from dataclasses import replace

import numpy as np
import torch
from scipy.stats import norm
from torch import Tensor

from suspnet.bounds.information import output_bounds
from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.estimate_observer import EstimateObserver
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError, Speeds
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.fitted import FittedMethod, Model, ModelFileError
from suspnet.estimation.from_curves import ONE_SIGMA, corrected, residual_scales
from suspnet.estimation.intervals import LARGEST_MISFIT
from suspnet.estimation.refine import Refined, complete_ratios, refine
from suspnet.ground.findings import Finding
from suspnet.ground.records import interval_ends
from suspnet.ground.types import FloatArray
from suspnet.vehicle.quantities import FAILED_DEVIATION, FAILED_OTHER, OF_THE_TRIP
from suspnet.vehicle.vertical_vehicle import VerticalVehicle


class MissingFeaturesError(ValueError):
    """A trip lacks features that the regression needs; the message names them and the reasons."""


N_DRAWS = 64
"""Number of draws of a trip's noise. It gives n and n_0 to 0.96 / sqrt(64) = 12 %, but both use the
same random numbers, so their errors cancel: with a quarter of the averages half widths err by 4 %.
"""
CORRECTIONS = 3
"""Number of steps that correct a trip's estimate; a fourth changes nothing where the speed is
within a tenth of the training speed (measured)."""
OF_THE_TRAINING = ("cloud", "range")
"""Kinds of flags that concern the regression alone, not an estimate from the curve itself."""
FAILED_FROM, FAILED_GAIN = 1.3, 1.1
"""Misfit of a trip from which failures of the other bogie are tried, and how much smaller a failure
has to make it."""
CONFIRMED = 1.05
"""A calibration confirms the deviations of refined estimates up to this factor on them."""


def estimate_with_noise(
    method: FittedMethod,
    spectra: CrossSpectra,
    level: float,
    speeds: Speeds | None = None,
    left_out: Tensor | None = None,
) -> tuple[Estimate, FloatArray]:
    """Return one trip's estimate from its spectra, and the share of noise in its variance.

    `spectra` are those of the trip on the method's bins, (3, n_freq), `speeds` those of the
    segments behind them; None is the training speed. `left_out` are bins (n_freq,) that are not
    used. The estimate has one row; the share n^2 / s^2
    (n_outputs,) is 1 without an interval. Raises MissingFeaturesError if the regression lacks a
    feature, NoEstimateError if the sensors are not coherent in any bin.
    """
    task, outputs = method.task, method.task.outputs
    observer = trip_observer(method) if speeds is None else trip_observer(method).at(speeds)
    observer = observer.without(left_out)
    responses = spectra.responses(observer.settings.method)[None]
    inputs, reasons = method.features(observer.for_features(responses), observer.frequencies_hz)
    if not np.isfinite(inputs).all():
        raise MissingFeaturesError(task.extractor.missing(reasons[0]))
    # correct the estimate for the trip's speed and noise, which differ from the training's
    predicted = corrected(method, observer, method.predict(inputs), CORRECTIONS)
    unknown = np.full(len(outputs), np.nan)
    if method.intervals is None and not method.refined:
        return _estimate(method, predicted[0], unknown, level), np.ones(len(outputs))
    # also where the regression's estimate stays, as its misfit flags the trip
    refined, failure = _refined(method, observer, spectra, predicted)
    if method.intervals is None or method.ood is None:
        values = refined.of(outputs)[0][0]
        return _estimate(method, values, unknown, level), np.ones(len(outputs))
    # the thresholds of the flags are for the number of averages of the training
    seen = _as_in_training(refined, observer.settings.n_averages / spectra.n_averages)
    flags = method.flags(inputs, reasons, seen)
    # a vehicle with uncertain numbers is read by the curve, as the regression takes them at their
    # median; so is any trip outside the range of the training
    outside = bool(flags.has(*OF_THE_TRAINING))
    by_curve = method.refined or outside or observer.directions.n > 0
    if by_curve:
        flags = flags.without(*OF_THE_TRAINING)
    if seen.misfit[0] <= LARGEST_MISFIT:
        flags = flags.without("misfit")
    factor, usual = (method.intervals.conformal.factors(p) for p in (level, ONE_SIGMA))
    if by_curve and not method.refined:
        factor, usual = np.full(len(outputs), norm.ppf((1 + level) / 2)), np.ones(len(outputs))
    ratios = torch.as_tensor(complete_ratios(task, predicted))
    # split the variance: noise of this trip, a deviation, and the lasting variance of calibration
    if by_curve:
        values, deviation = (part[0] for part in refined.of(outputs))
        noise = refined.noise_of(outputs)[0]
        lasting = _lasting(deviation, noise)
        # what calibration finds beyond the deviations of the fit lasts, too
        if method.refined and not (usual < CONFIRMED).all():
            bounds = output_bounds(task, observer, ratios.numpy())
            bounds = bounds[0] / ratios.numpy()[0, task.output_indices]
            lasting = lasting + _lasting(usual * bounds, bounds)
    else:
        values = predicted[0]
        expected = observer.expected(ratios)
        mean = CrossSpectra(expected.auto[0], expected.cross[0], expected.n_averages)
        noise_0, noise = (_noise(method, observer, source) for source in (mean, spectra))
        lasting = _lasting(usual * _residual_scale(method, inputs, predicted), noise_0)
    noise = noise * max(1.0, float(refined.misfit[0]))
    spread = np.sqrt(lasting + noise**2)
    estimate = _estimate(method, values, factor / usual * spread, level, flags)
    estimate = replace(estimate, found=failure, misfit=float(refined.misfit[0]))
    return estimate, 1 - np.divide(lasting, spread**2, out=np.zeros_like(lasting), where=spread > 0)


def trip_settings(model: Model) -> EstimateSettings:
    """Return the estimate settings of a model of trips; ModelFileError otherwise."""
    if not isinstance(model.settings, EstimateSettings):
        assert isinstance(model, FittedMethod)
        raise ModelFileError(Finding("model-of-other-protocol", protocol=repr(model.task.protocol)))
    return model.settings


def trip_observer(method: FittedMethod) -> EstimateObserver:
    """Return the observer of a method trained on trips; raises as `trip_settings` does."""
    trip_settings(method)
    observer = method.observer
    assert isinstance(observer, EstimateObserver)
    return observer


def _estimate(
    method: FittedMethod,
    values: FloatArray,
    half_widths: FloatArray,
    level: float,
    flags: Flags | None = None,
) -> Estimate:
    low, high = interval_ends(values, half_widths)
    rows = values[None], low[None], high[None]
    return Estimate(method.task.outputs, *rows, level, flags or Flags.none(1), method.healthy)


def _lasting(usual: FloatArray, noise_0: FloatArray) -> FloatArray:
    """Return max(s_0^2 - n_0^2, 0), the variance without noise; 0 where both are infinite."""
    s_0, n_0 = (np.nan_to_num(part, posinf=0.0) for part in (usual, noise_0))
    return np.asarray(np.maximum(s_0**2 - n_0**2, 0))


def _refined(
    method: FittedMethod, observer: EstimateObserver, spectra: CrossSpectra, predicted: FloatArray
) -> tuple[Refined, str]:
    """Return the fit of a trip's curve, and which failure of the other bogie it assumes, if any.

    A failure is far outside what the other bogie's springs and dampers usually vary by: each of
    ``FAILED_OTHER`` is tried where the usual state does not explain the curve.
    """
    misfit = observer.measured_misfit(spectra)
    if not misfit.covariance.diagonal(dim1=1, dim2=2).real.isfinite().any():
        raise NoEstimateError(Finding("incoherent"))
    best, failure = refine(method.task, misfit, predicted, directions=observer.directions), ""
    usual = observer.generator
    if not isinstance(usual, VerticalVehicle) or usual.distribution is None:
        return best, failure
    if float(best.misfit[0]) < FAILED_FROM:
        return best, failure
    if not set(OF_THE_TRIP) <= set(usual.distribution.names):
        return best, failure
    for words, changes in FAILED_OTHER.items():
        failed = usual.distribution.renewed(OF_THE_TRIP, changes, FAILED_DEVIATION)
        other = observer.of(replace(usual, distribution=failed))
        fit = refine(
            method.task, other.measured_misfit(spectra), predicted, directions=other.directions
        )
        if float(fit.misfit[0]) < float(best.misfit[0]) / FAILED_GAIN:
            best, failure = fit, Finding("other-bogie-failed", words=words)
    return best, failure


def _residual_scale(method: FittedMethod, inputs: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the residual scale of one curve's logarithms, (n_outputs,)."""
    assert method.intervals is not None
    scale = residual_scales(method, inputs, predicted, None)[0]
    return np.asarray(scale if method.intervals.log else scale / predicted[0])


def _as_in_training(refined: Refined, share: float) -> Refined:
    """Return estimates with the misfit scaled to the number of averages of the training.

    The mean square above 1 is the ratio of the generator's own errors to the noise. It grows with
    the averages, while the misfit threshold is for those of the training. Shorter trips retain
    their misfit, as it is noise.
    """
    beyond = (refined.misfit**2 - 1) * min(share, 1.0)
    return replace(refined, misfit=np.sqrt(1 + beyond))


def _noise(method: FittedMethod, observer: EstimateObserver, spectra: CrossSpectra) -> FloatArray:
    """Return the spread of the estimates' logarithms over draws of some spectra, (n_outputs,)."""
    responses = observer.observe_again(spectra, N_DRAWS, seed=0)
    inputs = method.features(observer.for_features(responses), observer.frequencies_hz)[0]
    inputs = inputs[np.isfinite(inputs).all(axis=1)]
    if len(inputs) < N_DRAWS // 2:
        return np.full(len(method.task.outputs), np.inf)
    estimates = corrected(method, observer, method.predict(inputs), CORRECTIONS)
    low, high = np.quantile(estimates, [0.1587, 0.8413], axis=0)
    return np.asarray(np.log(high / low) / 2)
