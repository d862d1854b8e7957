"""From a recording to an estimate: segments at one speed -> transfer functions -> k and c."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from suspnet.dynamics import ResponseGenerator
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import MissingFeaturesError, estimate_with_noise, trip_settings
from suspnet.estimation.steady_parts import (
    GroupSpectra,
    SpeedBin,
    combined,
    group_spectra,
    group_speed,
    groups_of,
    groups_to_read,
    no_group_words,
    readable_words,
    reads_at_any_speed,
    speed_of,
)
from suspnet.estimation.trip_flags import delay_words, with_sides
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_settings, setting
from suspnet.recordings.manifest import CHANNELS
from suspnet.recordings.manifest_keys import TripError
from suspnet.recordings.recording import Recording
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.plausibility import check_channels, check_pairs
from suspnet.spectra.segments import (
    NoEstimateError,
    difference_segments,
    in_band,
    recording_segments,
    segment_speeds,
)
from suspnet.spectra.speeds import Speeds
from suspnet.spectra.welch import SegmentSpectra, Welch


@dataclass(frozen=True)
class TripSettings:
    """How trips are read, and the conditions for an estimate.

    Raises
    ------
    TypeError, ValueError
        If a setting has the wrong type or is out of range.
    """

    rate_hz: float = setting(
        100.0, "Rate to which the three channels are resampled", "Hz", low=20, high=1000
    )
    speed_tolerance: float = setting(
        0.02,
        "Largest deviation of the speed within a segment from its mean, and of segments that are "
        "averaged from their middle, relative to it",
        low=0,
        high=0.5,
    )
    min_speed_m_per_s: float = setting(
        10.0,
        "Lowest speed that is used, for models that do not depend on the speed",
        "m/s",
        low=0,
        high=200,
    )
    min_coherence: float = setting(
        0.3,
        "Coherence with the trip's response below which a segment is left out, if it is also "
        "much lower than that of the others",
        low=0,
        high=1,
    )
    min_averages: float = setting(
        10.0,
        "Number of independent averages of a frequency bin below which it gives no estimate",
        low=3,
        high=1e6,
    )
    max_deviation: float = setting(
        0.3,
        "Standard deviation of the measured log-magnitudes, median over the bins, above which "
        "there is no estimate",
        low=0,
        high=10,
    )
    level: float = setting(
        INTERVAL_LEVEL, "Probability with which an interval holds the truth", low=0.01, high=0.999
    )
    check_channels: bool = setting(
        True, "Whether to look for wrong units (the speed's too), wrong signs and swapped channels"
    )

    def __post_init__(self) -> None:
        check_settings(self, "trips")


def estimate_recording(
    method: FittedMethod, recording: Recording, settings: TripSettings
) -> Estimate:
    """Return a method's estimate from a recording, one row; raises as `speed_bins` does."""
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
    models: Sequence[FittedMethod] = (),
) -> list[SpeedBin]:
    """Return a method's estimate from each group of segments at one of its speeds.

    Parameters
    ----------
    segments : SegmentSpectra
        Of the recording, cut as for the method's training.
    models : sequence of FittedMethod
        All models that read the recording, the method included: each group of segments belongs to
        one of them. Empty means the method alone.

    Returns
    -------
    list of SpeedBin
        Empty if all readable groups belong to other models.

    Raises
    ------
    NoEstimateError
        If the recording is valid but gives no estimate; the reason is that of the largest group, or
        that no model reads the trip's speeds.
    TripError
        If a channel or one sensor of a pair has the wrong unit or sign, two are swapped, or a pair
        meets a model that was trained for a sensor on one side.
    """
    # which groups of segments at one speed are this method's
    _check_places(recording, method.generator)
    together = models or [method]
    speeds = segment_speeds(recording, segments)
    tolerance, any_speed = settings.speed_tolerance, reads_at_any_speed(method)
    least = settings.min_speed_m_per_s if any_speed else 0.0
    groups = groups_to_read(speeds, tolerance, least, at_any_speed=any_speed)
    if not any(groups_of(one, together, speeds, groups) for one in together):
        if segments.welch.n_averages(len(speeds)) < settings.min_averages:
            raise NoEstimateError(_too_short(recording, segments, settings))
        raise NoEstimateError(no_group_words(speeds, groups, together, tolerance, least))
    # one failing group does not prevent the estimates of the others
    bins, reasons = [], []
    trained = trip_settings(method)
    own = groups_of(method, together, speeds, groups)
    for part in steady(segments, speeds, own, trained, settings):
        try:
            bins.append(_speed_bin(method, recording, part, together, speeds, segments, settings))
        except NoEstimateError as reason:
            reasons.append(reason)
    if reasons and not bins:
        raise reasons[0]
    return bins


@dataclass(frozen=True)
class Steady:
    """Segments of a recording at one speed, and whether they are enough for an estimate.

    Checking, commissioning, reading and monitoring all use this decision.

    Attributes
    ----------
    band : SegmentSpectra
        All segments, on the bins of an estimate.
    group : bool tensor of shape (n_segments,)
    found : GroupSpectra
        The usable segments of the group.
    speed : pair of float, [m/s]
        Mean and deviation over the chosen segments; NaN if there are none.
    has_enough : bool
        Whether there are enough averages.
    is_certain : bool
        Whether the responses are certain enough.
    """

    band: SegmentSpectra
    group: Tensor
    found: GroupSpectra
    speed: tuple[float, float]
    has_enough: bool
    is_certain: bool


def steady(
    segments: SegmentSpectra,
    speeds: Tensor,
    groups: Sequence[Tensor],
    estimate: EstimateSettings,
    settings: TripSettings,
) -> list[Steady]:
    """Return each group of segments with its usable spectra.

    `speeds`: (n_segments, n_samples), [m/s]; `groups` from `groups_to_read`; `estimate` bound to a
    vehicle. Raises NoEstimateError if the recording does not reach the bins of `estimate`.
    """
    parts: list[Steady] = []
    if not groups:
        return parts
    band = in_band(segments, estimate.frequencies_hz())
    for group in groups:
        found = group_spectra(band, group, settings.min_coherence, estimate)
        is_any = found.spectra is not None
        speed = speed_of(speeds[found.chosen], band) if is_any else (math.nan, math.nan)
        has_enough = is_any and found.n_averages >= settings.min_averages
        is_certain = found.deviation <= settings.max_deviation
        parts.append(Steady(band, group, found, speed, has_enough, is_certain))
    return parts


def _speed_bin(
    method: FittedMethod,
    recording: Recording,
    part: Steady,
    models: Sequence[FittedMethod],
    speeds: Tensor,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> SpeedBin:
    found, chosen, doubts = part.found, part.found.chosen, ""
    n_candidates = int(found.candidates.sum())
    if settings.check_channels and segments.welch.n_averages(n_candidates) >= settings.min_averages:
        # check channels first: a wrong one is a better reason than low coherence
        looked_at = chosen if found.spectra is not None else found.candidates
        if any(recording.paired):
            differences = difference_segments(recording, segments.welch)
            check_pairs(segments, differences, looked_at, recording.paired, method.vehicle)
        doubts = _checked(segments, looked_at, method)
    if found.spectra is None or not part.has_enough:
        raise NoEstimateError(_too_few(part, models, recording, speeds, segments, settings))
    if not part.is_certain:
        raise NoEstimateError(
            f"the responses are uncertain by {100 * found.deviation:.2g} % (coherence "
            f"{min(found.coherences):.2f}, {found.n_averages:.0f} averages), "
            f"at most {100 * settings.max_deviation:.2g} % are accepted"
        )
    at = Speeds.of(*part.speed)
    try:
        estimate, noise_share = estimate_with_noise(method, found.spectra, settings.level, at)
    except MissingFeaturesError as error:
        raise NoEstimateError(f"features are missing: {error}") from None
    late = delay_words(method, found.spectra, estimate, at)
    if late:
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", late))
    speed = part.speed[0]
    return SpeedBin(method, found.spectra, part.band, chosen, speed, estimate, noise_share, doubts)


def _too_few(
    part: Steady,
    models: Sequence[FittedMethod],
    recording: Recording,
    speeds: Tensor,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> str:
    found, group = part.found, part.group
    if segments.welch.n_averages(len(group)) < settings.min_averages:
        return _too_short(recording, segments, settings)
    where = f"steady at {group_speed(speeds, group):.1f} m/s"
    if reads_at_any_speed(models[0]):
        where = f"at {settings.min_speed_m_per_s:g} m/s or faster throughout"
    return (
        f"{int(group.sum())} of {len(group)} segments without faults are {where}, "
        f"{found.n_incoherent} of them of low coherence: {found.n_averages:.1f} averages, at least "
        f"{settings.min_averages:g} are needed (half of the trip is run at "
        f"{float(speeds.mean(dim=1).median()):.1f} m/s or less, {readable_words(models)})"
    )


def _too_short(recording: Recording, segments: SegmentSpectra, settings: TripSettings) -> str:
    n_segments, faults = len(segments.values), unrepaired_words(recording)
    return (
        f"{n_segments} segments without faults: {segments.welch.n_averages(n_segments):.1f} "
        f"averages, at least {settings.min_averages:g} are needed: "
        + (f"too little is free of faults: {faults}" if faults else "the recording is too short")
    )


def _check_places(recording: Recording, generator: ResponseGenerator) -> None:
    """Raise TripError if the recording has pairs where the model expects a sensor on one side.

    A single sensor suits both kinds of model: it may be in the middle, or already an average.
    """
    places = zip(CHANNELS, recording.paired, generator.sensor_lateral_m, strict=True)
    wrong = [(name, lateral_m) for name, is_pair, lateral_m in places if is_pair and lateral_m]
    if wrong:
        listed = ", ".join(f"{name} ({lateral_m:g} m)" for name, lateral_m in wrong)
        raise TripError(
            "the trip has sensors left and right, the model was trained for one sensor off the "
            f"middle: {listed}; give one sensor in the manifest, or train with "
            "generator.sensor_lateral_m=[0,0,0]"
        )


def _checked(segments: SegmentSpectra, chosen: Tensor, method: FittedMethod) -> str:
    """Return the doubts and impossible checks of the channels; TripError if one is wrong."""
    spectra = segments.average(chosen)
    return check_channels(spectra, segments.frequencies_hz, method.generator, method.vehicle)


def no_segment(recording: Recording, welch: Welch) -> str:
    """Return the message that no segment of a recording is free of faults."""
    return f"no segment of {welch.segment_s:g} s is free of faults: {unrepaired_words(recording)}"


def unrepaired_words(recording: Recording) -> str:
    """Return the faults that make parts of a recording unusable; empty if there are none."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return "; ".join(faults)
