"""From a recording to an estimate: segments at one speed -> transfer functions -> k and c."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from suspnet.checks import check_number
from suspnet.dynamics import ResponseGenerator
from suspnet.features.cross_spectra import CrossSpectra
from suspnet.features.transfer_estimate import SegmentSpectra
from suspnet.features.welch import Welch
from suspnet.model.estimate import Estimate
from suspnet.model.fitted import FittedMethod
from suspnet.model.from_spectra import MissingFeaturesError, estimate_spectra, trip_settings
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
        A segment belongs to a model's speed bin if its speed stays within 1 +- this of it.
    min_speed_m_per_s : float, [m/s]
        Least speed for models that do not depend on it.
    min_coherence : float, [-]
        Segments of lower coherence with the trip's response are left out if it is also much lower
        than that of the other segments.
    min_averages : float
        Below this many independent averages in a bin there is no estimate from it.
    max_deviation : float, [-]
        If the log-magnitudes are less certain than this (standard deviation, median over the band)
        there is no estimate.
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


@dataclass(frozen=True)
class SpeedBin:
    """One method's estimate from a recording, with the spectra and segments behind it.

    Attributes
    ----------
    method : FittedMethod
    spectra : CrossSpectra
        Average over the chosen segments on the method's bins, (3, n_freq).
    segments : SegmentSpectra
    chosen : bool tensor of shape (n_segments,)
    speed_m_per_s : float, [m/s]
        Mean over the chosen segments.
    estimate : Estimate
        Of one row.
    doubts : str
        What could not be checked of the channels; empty if all could.
    """

    method: FittedMethod
    spectra: CrossSpectra
    segments: SegmentSpectra
    chosen: Tensor
    speed_m_per_s: float
    estimate: Estimate
    doubts: str


def estimate_recording(
    method: FittedMethod, recording: Recording, settings: TripSettings
) -> Estimate:
    """Return a method's estimate from a recording, of one row; raises what `speed_bin` does."""
    welch = trip_settings(method).welch
    segments = recording_segments(recording, welch)
    if not len(segments.values):
        raise NoEstimateError(no_segment(recording, welch))
    return speed_bin(method, recording, segments, settings).estimate


def speed_bin(
    method: FittedMethod, recording: Recording, segments: SegmentSpectra, settings: TripSettings
) -> SpeedBin:
    """Return a method's estimate from the segments at its speed.

    Parameters
    ----------
    method : FittedMethod
        Trained on estimates from trips.
    recording : Recording
    segments : SegmentSpectra
        Of the recording, from `recording_segments`, cut as the method's training curves.
    settings : TripSettings

    Raises
    ------
    NoEstimateError
        If the recording is sound but nothing can be estimated from it.
    TripError
        If a channel or one sensor of a pair has the wrong unit or sign, two are swapped, or a pair
        meets a model that was trained for a sensor on one side.
    """
    trained = trip_settings(method)
    _check_places(recording, method.generator)
    speeds = segment_speeds(recording, segments)
    within, words = _within(speeds, method, settings)
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
            f"{_advice(segments, within, settings)}"
        )
    spectra = band.average(chosen)
    deviation = float(spectra.deviations(trained.method).median(dim=1).values.amax())
    if deviation > settings.max_deviation:
        raise NoEstimateError(
            f"the responses are uncertain by {100 * deviation:.2g} % (coherence "
            f"{float(spectra.coherences().mean(dim=1).amin()):.2f}, {n_averages:.0f} averages), "
            f"at most {100 * settings.max_deviation:.2g} % are accepted"
        )
    try:
        estimate = estimate_spectra(method, spectra, settings.level)
    except MissingFeaturesError as error:
        raise NoEstimateError(f"features are missing: {error}") from None
    speed = float(speeds[chosen].mean())
    return SpeedBin(method, spectra, band, chosen, speed, estimate, doubts)


def _advice(segments: SegmentSpectra, within: Tensor, settings: TripSettings) -> str:
    """Return what to do where too few segments are at a method's speed."""
    if segments.welch.n_averages(len(within)) < settings.min_averages:
        return ": the recording is too short"
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


def _within(speeds: Tensor, method: FittedMethod, settings: TripSettings) -> tuple[Tensor, str]:
    """Return which segments are a method's, by their speeds, and the rule in words."""
    bin_speed = method.generator.speed_m_per_s
    if bin_speed is None:
        low = settings.min_speed_m_per_s
        return (speeds >= low).all(dim=1), f"at {low:g} m/s or faster throughout"
    low, high = (bin_speed * (1 + sign * settings.speed_tolerance) for sign in (-1, 1))
    within = (speeds.amin(dim=1) >= low) & (speeds.amax(dim=1) <= high)
    return within, f"at {low:.1f} to {high:.1f} m/s throughout"


def no_segment(recording: Recording, welch: Welch) -> str:
    """Return why no segment of a recording is free of faults."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return f"no segment of {welch.segment_s:g} s is free of faults: {'; '.join(faults)}"
