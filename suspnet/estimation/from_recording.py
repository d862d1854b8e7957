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
    SpeedBin,
    combined,
    group_speed,
    groups_of,
    groups_to_read,
    no_group_words,
    readable_words,
    reads_at_any_speed,
    speed_of,
)
from suspnet.estimation.trip_flags import delay_words, with_sides
from suspnet.ground.parameters import FORWARD, Direction, direction_words
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_settings, setting
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import CHANNELS
from suspnet.recordings.recording import Recording
from suspnet.spectra.cross_spectra import CrossSpectra
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.plausibility import (
    DIRECTION_MARGIN,
    check_channels,
    check_pairs,
    shown_direction,
)
from suspnet.spectra.segments import (
    NoEstimateError,
    Speeds,
    difference_segments,
    in_band,
    recording_segments,
    segment_speeds,
    without_incoherent,
    without_loud,
)
from suspnet.spectra.welch import SegmentSpectra, Welch
from suspnet.spectra.wheel_lines import WheelLine, line_bins, wheel_lines


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
    segments = recording_segments(recording, trip_settings(method).welch)
    bins = all_bins([(method, segments)], recording, settings, wheel_lines(recording))
    return with_sides(combined(bins), bins, recording)[0]


def all_bins(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
    lines: Sequence[WheelLine] = (),
) -> list[SpeedBin]:
    """Return the estimates of all groups of segments, each by the method that reads its speed.

    `pairs` are the methods with their segments, `lines` those of out-of-round wheels, whose bins
    are left out. NoEstimateError is raised with the reasons of all
    methods if none gives an estimate, TripError as by `speed_bins`, or if no method is for the
    direction of travel, or it is neither given nor shown by the phases.
    """
    if not any(len(segments.values) for _, segments in pairs):
        raise NoEstimateError(no_segment(recording, pairs[0][1].welch))
    pairs = _of_direction(pairs, recording, settings)
    bins, reasons = [], []
    methods = [method for method, _ in pairs]
    for method, segments in pairs:
        try:
            bins += speed_bins(method, recording, segments, settings, methods, lines)
        except NoEstimateError as reason:
            reasons.append(str(reason))
    if not bins:
        raise NoEstimateError("; ".join(dict.fromkeys(reasons)))
    return bins


def _of_direction(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> list[tuple[FittedMethod, SegmentSpectra]]:
    """Return the methods, with their segments, for the direction in which a trip was run.

    A single direction of all methods is assumed where the manifest gives none; `check_channels`
    compares it with the phases.
    """
    known = {method.generator.direction for method, _ in pairs} - {None}
    direction = recording.manifest.direction
    if direction is None and len(known) > 1:
        method, segments = pairs[0]
        direction = direction_of(recording, segments, method.generator, settings)
    chosen = [
        p for p in pairs if direction is None or p[0].generator.direction in (None, direction)
    ]
    if not chosen:
        raise TripError(
            f"the trip was run {direction_words(direction)}, the models are for trips "
            f"{direction_words(known.pop())}: train with direction=both"
        )
    return chosen


def direction_of(
    recording: Recording,
    segments: SegmentSpectra,
    generator: ResponseGenerator,
    settings: TripSettings,
) -> Direction:
    """Return the direction in which a trip was run: as its manifest says, else by its phases.

    The phases are those of the largest group of segments at one speed. TripError is raised if they
    do not show the direction.
    """
    if recording.manifest.direction or generator.speed_m_per_s is None or not len(segments.values):
        return recording.manifest.direction or FORWARD
    speeds = segment_speeds(recording, segments)
    groups = groups_to_read(speeds, settings.speed_tolerance, settings.min_speed_m_per_s)
    if not groups:
        return FORWARD  # nothing is read of it
    there = replace(generator, speed_m_per_s=float(speeds[groups[0]].mean()))
    spectra = segments.average(groups[0])
    direction, factor = shown_direction(spectra, segments.frequencies_hz, there)
    if factor < DIRECTION_MARGIN:
        raise TripError(
            f"{recording.manifest.path}: the phases do not show whether the trip was run forward "
            f"or in reverse ({direction_words(direction)} fits {factor:.2g} times better): give "
            "`direction: forward` or `direction: reverse`"
        )
    return direction


def speed_bins(
    method: FittedMethod,
    recording: Recording,
    segments: SegmentSpectra,
    settings: TripSettings,
    models: Sequence[FittedMethod],
    lines: Sequence[WheelLine] = (),
) -> list[SpeedBin]:
    """Return a method's estimate from each group of segments at one of its speeds.

    `segments` are the recording's, cut as for the method's training. `models` are all that read the
    recording, the method included: each group belongs to one of them; empty means the method alone.
    The result is empty if all readable groups belong to other models. The bins of `lines` are left
    out, unless responses do not depend on the speed: these hold for one wheelset alone.

    Raises NoEstimateError if the recording is valid but gives no estimate, with the reason of the
    largest group, or that no model reads the trip's speeds; TripError if a channel or one sensor of
    a pair has the wrong unit or sign, two are swapped, or a pair meets a model that was trained for
    a sensor on one side.
    """
    # which groups of segments at one speed are this method's
    _check_places(recording, method.generator)
    speeds = segment_speeds(recording, segments)
    tolerance, any_speed = settings.speed_tolerance, reads_at_any_speed(method)
    least = settings.min_speed_m_per_s if any_speed else 0.0
    groups = groups_to_read(speeds, tolerance, least, at_any_speed=any_speed)
    if not any(groups_of(one, models, speeds, groups) for one in models):
        if segments.welch.n_averages(len(speeds)) < settings.min_averages:
            raise NoEstimateError(_too_short(recording, segments, settings))
        raise NoEstimateError(no_group_words(speeds, groups, models, tolerance, least))
    # one failing group does not prevent the estimates of the others
    bins, reasons = [], []
    trained = trip_settings(method)
    own = groups_of(method, models, speeds, groups)
    lines = () if any_speed else lines
    for part in steady(segments, speeds, own, trained, settings, lines):
        try:
            bins.append(_speed_bin(method, recording, part, models, speeds, segments, settings))
        except NoEstimateError as reason:
            reasons.append(reason)
    if reasons and not bins:
        raise reasons[0]
    return bins


@dataclass(frozen=True)
class Steady:
    """Segments of a recording at one speed, and whether they are enough for an estimate.

    Checking, commissioning, reading and monitoring all use this decision. `band` holds all segments
    on the bins of an estimate; of those of the `group` (n_segments,), `candidates` have no far too
    large power and `chosen` no low coherence. `n_averages` counts independent averages of the
    chosen ones, and `spectra` is their average. `coherences` of G_p and G_s are means over the bins
    in use; `deviation` is the standard deviation of the log-magnitudes, [-]: median over the bins,
    of the less certain response. `speed` is mean and deviation, [m/s]. `left_out` (n_freq,) are
    bins with lines of wheels. `has_enough`: there are enough averages; `is_certain`: the responses
    are certain enough.
    """

    band: SegmentSpectra
    group: Tensor
    candidates: Tensor
    chosen: Tensor
    n_incoherent: int
    n_averages: float = 0.0
    spectra: CrossSpectra | None = None
    coherences: Sequence[float] = (math.nan, math.nan)
    deviation: float = math.nan
    speed: tuple[float, float] = (math.nan, math.nan)
    left_out: Tensor | None = None
    has_enough: bool = False
    is_certain: bool = False


def steady(
    segments: SegmentSpectra,
    speeds: Tensor,
    groups: Sequence[Tensor],
    estimate: EstimateSettings,
    settings: TripSettings,
    lines: Sequence[WheelLine] = (),
) -> list[Steady]:
    """Return each group of segments with its usable spectra.

    `speeds`: (n_segments, n_samples), [m/s]; `groups` from `groups_to_read`; `estimate` bound to a
    vehicle; `lines` are those of wheels. Raises NoEstimateError if the recording does not reach the
    bins of `estimate`.
    """
    parts: list[Steady] = []
    if not groups:
        return parts
    band = in_band(segments, estimate.frequencies_hz())
    beyond = estimate.beyond(band.frequencies_hz)
    for group in groups:
        candidates = without_loud(band, group)
        chosen, n_incoherent = without_incoherent(band, candidates, settings.min_coherence)
        part = Steady(band, group, candidates, chosen, n_incoherent)
        if bool(chosen.any()):
            n_averages, spectra = band.welch.n_averages(int(chosen.sum())), band.average(chosen)
            coherences = spectra.coherences().masked_fill(beyond, math.nan).nanmean(dim=1)
            deviations = spectra.deviations(estimate.method).masked_fill(beyond, math.nan)
            deviation = float(deviations.nanmedian(dim=1).values.amax())
            part = replace(
                part,
                n_averages=n_averages,
                spectra=spectra,
                coherences=coherences.tolist(),
                deviation=deviation,
                speed=speed_of(speeds[chosen], band),
                left_out=line_bins(
                    lines, speeds[chosen], band.frequencies_hz, band.welch.segment_s
                ),
                has_enough=n_averages >= settings.min_averages,
                is_certain=deviation <= settings.max_deviation,
            )
        parts.append(part)
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
    spectra, chosen, doubts = part.spectra, part.chosen, ""
    n_candidates = int(part.candidates.sum())
    if settings.check_channels and segments.welch.n_averages(n_candidates) >= settings.min_averages:
        # check channels first: a wrong one is a better reason than low coherence
        looked_at = chosen if spectra is not None else part.candidates
        if any(recording.paired):
            differences = difference_segments(recording, segments.welch)
            check_pairs(segments, differences, looked_at, recording.paired, method.vehicle)
        average, bins = segments.average(looked_at), segments.frequencies_hz
        doubts = check_channels(average, bins, method.generator, method.vehicle)
    if spectra is None or not part.has_enough:
        raise NoEstimateError(_too_few(part, models, recording, speeds, segments, settings))
    if not part.is_certain:
        raise NoEstimateError(
            f"the responses are uncertain by {100 * part.deviation:.2g} % (coherence "
            f"{min(part.coherences):.2f}, {part.n_averages:.0f} averages), "
            f"at most {100 * settings.max_deviation:.2g} % are accepted"
        )
    at = Speeds.of(*part.speed)
    try:
        estimate, noise_share = estimate_with_noise(
            method, spectra, settings.level, at, part.left_out
        )
    except MissingFeaturesError as error:
        raise NoEstimateError(f"features are missing: {error}") from None
    late = delay_words(method, spectra, estimate, at, part.left_out)
    if estimate.flags.has("misfit").any() and not late:
        raise NoEstimateError(_unexplained_words(estimate))
    if late:
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", late))
    speed = part.speed[0]
    found = SpeedBin(method, spectra, part.band, chosen, speed, estimate, noise_share, doubts)
    return replace(found, left_out=part.left_out)


def _unexplained_words(estimate: Estimate) -> str:
    """Return why an estimate with an unexplained curve is none, and which part is suspected."""
    furthest = int(np.argmax(np.abs(np.log(estimate.values[0]))))
    return (
        f"{estimate.flags.reasons[0]}. Nearest is {estimate.names[furthest]} at "
        f"{100 * estimate.values[0, furthest]:.3g} % of healthy: look there and at the sensors"
    )


def _too_few(
    part: Steady,
    models: Sequence[FittedMethod],
    recording: Recording,
    speeds: Tensor,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> str:
    group = part.group
    if segments.welch.n_averages(len(group)) < settings.min_averages:
        return _too_short(recording, segments, settings)
    where = f"steady at {group_speed(speeds, group):.1f} m/s"
    if reads_at_any_speed(models[0]):
        where = f"at {settings.min_speed_m_per_s:g} m/s or faster throughout"
    return (
        f"{int(group.sum())} of {len(group)} segments without faults are {where}, "
        f"{part.n_incoherent} of them of low coherence: {part.n_averages:.1f} averages, at least "
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


def no_segment(recording: Recording, welch: Welch) -> str:
    """Return the message that no segment of a recording is free of faults."""
    return f"no segment of {welch.segment_s:g} s is free of faults: {unrepaired_words(recording)}"


def unrepaired_words(recording: Recording) -> str:
    """Return the faults that make parts of a recording unusable; empty if there are none."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return "; ".join(faults)
