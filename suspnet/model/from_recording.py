"""From a recording to an estimate: segments at one speed -> transfer functions -> k and c."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.signal import get_window
from torch import Tensor

from suspnet.checks import check_flag, check_number
from suspnet.data.estimates import EstimateSettings
from suspnet.data.speeds import Speeds
from suspnet.dynamics import ResponseGenerator
from suspnet.features.cross_spectra import CrossSpectra
from suspnet.features.transfer_estimate import SegmentSpectra
from suspnet.features.welch import Welch
from suspnet.model.delays import delay_words
from suspnet.model.estimate import Estimate
from suspnet.model.fitted import FittedMethod
from suspnet.model.from_spectra import (
    MissingFeaturesError,
    estimate_with_noise,
    trip_settings,
)
from suspnet.model.sides import with_sides
from suspnet.model.speed_bin import SpeedBin, combined
from suspnet.recordings.manifest import CHANNELS, TripError
from suspnet.recordings.plausibility import check_channels, check_pairs
from suspnet.recordings.recording import Recording
from suspnet.recordings.segments import (
    NoEstimateError,
    difference_segments,
    in_band,
    recording_segments,
    segment_speeds,
    without_incoherent,
    without_loud,
)


@dataclass(frozen=True)
class TripSettings:
    """How trips are read, and the conditions for an estimate.

    Parameters
    ----------
    rate_hz : float, [Hz]
        Common rate of the three channels.
    speed_tolerance : float, [-]
        The speeds of a segment stay within 1 +- this of its mean, and segments that are averaged
        within 1 +- this of each other's middle.
    min_speed_m_per_s : float, [m/s]
        Least speed for models that do not depend on it.
    min_coherence : float, [-]
        Segments of lower coherence with the trip's response are left out if it is also much lower
        than that of the other segments.
    min_averages : float
        Below this many independent averages in a bin there is no estimate from it.
    max_deviation : float, [-]
        If the log-magnitudes are less certain than this (standard deviation, median over the bins
        in use) there is no estimate.
    level : float
        Probability that an interval holds the truth.
    check_channels : bool
        Look for wrong units, signs and swapped channels.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    rate_hz: float = 100.0
    speed_tolerance: float = 0.02
    min_speed_m_per_s: float = 10.0
    min_coherence: float = 0.3
    min_averages: float = 10.0
    max_deviation: float = 0.3
    level: float = 0.9
    check_channels: bool = True

    def __post_init__(self) -> None:
        for name, low, high in (
            ("rate_hz", 20, 1000),
            ("speed_tolerance", 0, 0.5),
            ("min_speed_m_per_s", 0, 200),
            ("min_coherence", 0, 1),
            ("min_averages", 3, 1e6),
            ("max_deviation", 0, 10),
            ("level", 0.01, 0.999),
        ):
            check_number(f"trips.{name}", getattr(self, name), low=low, high=high)
        check_flag("trips.check_channels", self.check_channels)


def estimate_recording(
    method: FittedMethod, recording: Recording, settings: TripSettings
) -> Estimate:
    """Return a method's estimate from a recording, of one row; raises what `speed_bins` does."""
    welch = trip_settings(method).welch
    segments = recording_segments(recording, welch)
    if not len(segments.values):
        raise NoEstimateError(no_segment(recording, welch))
    bins = speed_bins(method, recording, segments, settings)
    return with_sides(combined(bins), bins, recording)[0]


def speed_bins(
    method: FittedMethod,
    recording: Recording,
    segments: SegmentSpectra,
    settings: TripSettings,
    speeds_m_per_s: Sequence[float | None] = (),
) -> list[SpeedBin]:
    """Return a method's estimate from each group of segments at one of its speeds.

    Parameters
    ----------
    method : FittedMethod
        Trained on estimates from trips.
    recording : Recording
    segments : SegmentSpectra
        Of the recording, from `recording_segments`, cut as the method's training curves.
    settings : TripSettings
    speeds_m_per_s : sequence of float, [m/s]
        Speeds of all models that read the recording: a segment is for the nearest of them alone.

    Raises
    ------
    NoEstimateError
        If the recording is sound but nothing can be estimated from it; the message is that of the
        largest group.
    TripError
        If a channel or one sensor of a pair has the wrong unit or sign, two are swapped, or a pair
        meets a model that was trained for a sensor on one side.
    """
    _check_places(recording, method.generator)
    speeds = segment_speeds(recording, segments)
    within, words = _readable(speeds, method, settings, speeds_m_per_s)
    groups = [within]
    if method.generator.speed_m_per_s is not None:
        groups = same_speed(speeds, within, settings.speed_tolerance)
    bins, reasons = [], []
    for group in groups or [within]:
        try:
            bins.append(_speed_bin(method, recording, group, words, speeds, segments, settings))
        except NoEstimateError as reason:
            reasons.append(reason)
    if not bins:
        raise reasons[0]
    return bins


def steady_segments(speeds: Tensor, tolerance: float) -> Tensor:
    """Return which segments keep their speed (n_segments, n_samples) within 1 +- tolerance."""
    return (speeds / speeds.mean(dim=1, keepdim=True) - 1).abs().amax(dim=1) <= tolerance


def same_speed(speeds: Tensor, within: Tensor, tolerance: float) -> list[Tensor]:
    """Return groups of segments of like speed, the largest first, each bool (n_segments,).

    A group's mean speeds lie within 1 +- tolerance of its middle. The most segments that one such
    range holds are a group; then the most of the others, until none is left.

    Parameters
    ----------
    speeds : tensor of shape (n_segments, n_samples), [m/s]
    within : bool tensor of shape (n_segments,)
        Segments that are grouped.
    tolerance : float, [-]
    """
    means, left, groups = speeds.mean(dim=1), within.clone(), []
    widest = (1 + tolerance) / (1 - tolerance)
    while bool(left.any()):  # each round takes at least one segment
        lowest = means[left][:, None]
        inside = (means >= lowest) & (means <= lowest * widest * (1 + 1e-9)) & left
        group = inside[int(inside.sum(dim=1).argmax())]
        groups.append(group)
        left = left & ~group
    return groups


def steady_groups(band: SegmentSpectra, speeds: Tensor, settings: TripSettings) -> list[Tensor]:
    """Return what can be used of the segments at each steady speed, the largest group first.

    Parameters
    ----------
    band : SegmentSpectra
        On the bins of an estimate, where loud and incoherent segments are left out.
    speeds : tensor of shape (n_segments, n_samples), [m/s]
    settings : TripSettings

    Returns
    -------
    list of bool tensors of shape (n_segments,)
    """
    steady = steady_segments(speeds, settings.speed_tolerance)
    steady &= speeds.mean(dim=1) >= settings.min_speed_m_per_s
    return [
        without_incoherent(band, without_loud(band, group), settings.min_coherence)[0]
        for group in same_speed(speeds, steady, settings.speed_tolerance)
    ]


def _speed_bin(
    method: FittedMethod,
    recording: Recording,
    within: Tensor,
    words: str,
    speeds: Tensor,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> SpeedBin:
    """Return a method's estimate from the segments `within`, which `words` describe."""
    trained = trip_settings(method)
    band = in_band(segments, trained.frequencies_hz())
    candidates = without_loud(band, within)
    chosen, n_incoherent = without_incoherent(band, candidates, settings.min_coherence)
    doubts = ""
    if settings.check_channels and bool(candidates.any()):
        looked_at = chosen if bool(chosen.any()) else candidates
        if any(recording.paired):
            differences = difference_segments(recording, segments.welch)
            check_pairs(segments, differences, looked_at, recording.paired, method.vehicle)
        doubts = _checked(segments, looked_at, method)
    n_averages = segments.welch.n_averages(int(chosen.sum())) if bool(chosen.any()) else 0.0
    if n_averages < settings.min_averages:
        raise NoEstimateError(
            f"{int(within.sum())} of {len(within)} segments without faults are {words}, "
            f"{n_incoherent} of them of low coherence: {n_averages:.1f} averages, at least "
            f"{settings.min_averages:g} are needed (half of the trip is run at "
            f"{float(speeds.mean(dim=1).median()):.1f} m/s or less)"
            f"{_advice(recording, segments, within, settings)}"
        )
    spectra = band.average(chosen)
    coherences, deviation = certainty_of(spectra, trained, band.frequencies_hz)
    if deviation > settings.max_deviation:
        raise NoEstimateError(
            f"the responses are uncertain by {100 * deviation:.2g} % (coherence "
            f"{min(coherences):.2f}, {n_averages:.0f} averages), "
            f"at most {100 * settings.max_deviation:.2g} % are accepted"
        )
    mean, deviation = speed_of(speeds[chosen], segments)
    at = Speeds.of(mean, deviation)
    try:
        estimate, noise_share = estimate_with_noise(method, spectra, settings.level, at)
    except MissingFeaturesError as error:
        raise NoEstimateError(f"features are missing: {error}") from None
    late = delay_words(method, spectra, estimate, at)
    if late:
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", late))
    return SpeedBin(method, spectra, band, chosen, mean, estimate, noise_share, doubts)


def certainty_of(
    spectra: CrossSpectra, settings: EstimateSettings, frequencies_hz: Tensor
) -> tuple[list[float], float]:
    """Return how certain the responses are on the bins that estimates use.

    Parameters
    ----------
    spectra : CrossSpectra
        Of shape (3, n_freq).
    settings : EstimateSettings
    frequencies_hz : tensor of shape (n_freq,), [Hz]

    Returns
    -------
    coherences : list of 2 floats, [-]
        Means over the bins, of G_p and G_s.
    deviation : float, [-]
        Standard deviation of the log-magnitudes: median over the bins, of the less certain one.
    """
    beyond = settings.beyond(frequencies_hz)
    coherences = spectra.coherences().masked_fill(beyond, math.nan).nanmean(dim=1)
    deviations = spectra.deviations(settings.method).masked_fill(beyond, math.nan)
    return coherences.tolist(), float(deviations.nanmedian(dim=1).values.amax())


def speed_of(speeds: Tensor, segments: SegmentSpectra) -> tuple[float, float]:
    """Return mean and deviation of the speeds in some segments, as the window weighs them."""
    weights = torch.as_tensor(get_window(segments.welch.window, speeds.shape[1])) ** 2
    weights = weights / (weights.sum() * len(speeds))
    mean = float((speeds * weights).sum())
    return mean, math.sqrt(max(0.0, float(((speeds - mean) ** 2 * weights).sum())))


def _advice(
    recording: Recording, segments: SegmentSpectra, within: Tensor, settings: TripSettings
) -> str:
    """Return what to do where too few segments are at a method's speed."""
    if segments.welch.n_averages(len(within)) < settings.min_averages:
        faults = unrepaired_words(recording)
        return (
            f": too little is free of faults: {faults}"
            if faults
            else ": the recording is too short"
        )
    if not bool(within.any()):
        return ": is the speed in m/s? If so, train a model for it, speed_m_per_s=..."
    return ""


def _check_places(recording: Recording, generator: ResponseGenerator) -> None:
    """Raise TripError if a pair of sensors meets a model of a sensor on one side.

    A single sensor suits both kinds of model: it may be at the middle, or an average itself.
    """
    places = zip(CHANNELS, recording.paired, generator.sensor_lateral_m, strict=True)
    wrong = [(name, lateral_m) for name, is_pair, lateral_m in places if is_pair and lateral_m]
    if wrong:
        told = ", ".join(f"{name} ({lateral_m:g} m)" for name, lateral_m in wrong)
        raise TripError(
            "the trip has sensors left and right, the model was trained for one sensor beside the "
            f"middle: {told}; give one sensor in the manifest, or train with "
            "generator.sensor_lateral_m=[0,0,0]"
        )


def _checked(segments: SegmentSpectra, chosen: Tensor, method: FittedMethod) -> str:
    """Return what could not be checked of the channels; TripError if one is wrong."""
    spectra = segments.average(chosen)
    return check_channels(spectra, segments.frequencies_hz, method.generator, method.vehicle)


def _readable(
    speeds: Tensor,
    method: FittedMethod,
    settings: TripSettings,
    speeds_m_per_s: Sequence[float | None],
) -> tuple[Tensor, str]:
    """Return which segments a method can read, by their speeds, and the rule in words."""
    trained = method.generator.speed_m_per_s
    if trained is None:
        low = settings.min_speed_m_per_s
        return (speeds >= low).all(dim=1), f"at {low:g} m/s or faster throughout"
    half_width = trip_settings(method).speed_half_width
    low, high = (trained * (1 + sign * half_width) for sign in (-1, 1))
    means = speeds.mean(dim=1)
    within = (means >= low * (1 - 1e-9)) & (means <= high * (1 + 1e-9))
    for other in speeds_m_per_s:
        if other is not None and other != trained:
            within &= (means - trained).abs() <= (means - other).abs()
    steady = steady_segments(speeds, settings.speed_tolerance)
    percent = 100 * settings.speed_tolerance
    return within & steady, f"at {low:.1f} to {high:.1f} m/s and steady within {percent:g} %"


def no_segment(recording: Recording, welch: Welch) -> str:
    """Return why no segment of a recording is free of faults."""
    return f"no segment of {welch.segment_s:g} s is free of faults: {unrepaired_words(recording)}"


def unrepaired_words(recording: Recording) -> str:
    """Return the faults that make parts of a recording unusable; empty if there are none."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return "; ".join(faults)
