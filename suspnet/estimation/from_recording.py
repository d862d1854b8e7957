"""From a recording to an estimate: segments at one speed -> transfer functions -> k and c."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np
from torch import Tensor

from suspnet.dynamics import ResponseGenerator
from suspnet.estimation.bogie_trips import UNEXPLAINED, UnexplainedError, estimate_parts
from suspnet.estimation.direction import direction_of, of_direction
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import MissingFeaturesError, estimate_with_noise, trip_settings
from suspnet.estimation.lone_sensors import placed, with_lone
from suspnet.estimation.steady_parts import (
    Bin,
    SeenBin,
    SpeedBin,
    Steady,
    combined,
    group_speed,
    groups_of,
    groups_to_read,
    minutes_words,
    no_group_words,
    readable_words,
    reads_at_any_speed,
    steady,
)
from suspnet.estimation.temperature import DampingByTemperature
from suspnet.estimation.trip_flags import delay_words, with_sides
from suspnet.estimation.trip_settings import TripSettings
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import CHANNELS
from suspnet.recordings.recording import Recording
from suspnet.spectra.plausibility import check_channels, check_pairs
from suspnet.spectra.segments import (
    NoEstimateError,
    Speeds,
    difference_segments,
    recording_segments,
    segment_speeds,
)
from suspnet.spectra.welch import SegmentSpectra, Welch
from suspnet.spectra.wheel_lines import wheel_lines


def estimate_recording(
    method: FittedMethod, recording: Recording, settings: TripSettings
) -> Estimate:
    """Return a method's estimate from a recording, one row; raises as `speed_bins` does.

    It is that of each part if the method has a bogie and the recording shows its parts.
    """
    segments = recording_segments(recording, trip_settings(method).welch)
    bins, parts = both_ways([(method, segments)], recording, settings)
    if isinstance(parts, Estimate):
        return parts
    if isinstance(bins, NoEstimateError):
        raise bins if parts is None else NoEstimateError(f"{bins}; {parts}")
    read = [one for one in bins if isinstance(one, SpeedBin)]
    estimate = with_sides(combined(read), read, recording)[0]
    if isinstance(parts, UnexplainedError):
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", UNEXPLAINED))
    return at_healthy_temperature(method, estimate, recording)


def both_ways(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> tuple[Sequence[SeenBin] | NoEstimateError, Estimate | NoEstimateError | None]:
    """Return the estimates of both sides as equal, and that of each part, or why there is none.

    The latter, with damping as while healthy, is that of the first of the methods, `pairs` with
    their segments; None if it has no bogie. Where it exists the former are what is seen of the
    recording alone: to read both sides as equal takes three times as long. TripError is raised as
    by `all_bins` and `estimate_parts`.
    """
    method, segments = pairs[0]
    why: NoEstimateError | None = None
    if method.bogie is not None:
        seen = _or_reason(lambda: _of_all(pairs, recording, settings, lambda _, one: one))
        try:
            direction = direction_of(recording, segments, method.generator, settings)
            parts = estimate_parts(method.bogie, recording, settings, direction)
            return seen, at_healthy_temperature(method, parts, recording)
        except NoEstimateError as reason:
            why = reason
    return _or_reason(lambda: all_bins(pairs, recording, settings)), why


def _or_reason(bins: Callable[[], list[Bin]]) -> list[Bin] | NoEstimateError:
    try:
        return bins()
    except NoEstimateError as reason:
        return reason


def at_healthy_temperature(
    method: FittedMethod, estimate: Estimate, recording: Recording
) -> Estimate:
    """Return a recording's estimate with damping at the temperature of the healthy trips."""
    law = DampingByTemperature.noted(method.training)
    return law.compared(estimate, recording.manifest.temperature_c) if law else estimate


def all_bins(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> list[SpeedBin]:
    """Return the estimates of all groups of segments, each by the method that reads its speed.

    `pairs` are the methods with their segments. NoEstimateError is raised with the reasons of all
    methods if none gives an estimate, TripError as by `speed_bins`, or if no method is for the
    direction of travel, or it is neither given nor shown by the phases.
    """

    def read(method: FittedMethod, one: SeenBin) -> SpeedBin:
        return with_lone(_read(one, settings.level), method, recording)

    return _of_all(pairs, recording, settings, read)


def _of_all(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
    finish: Callable[[FittedMethod, SeenBin], Bin],
) -> list[Bin]:
    """Return what `finish` makes of each group of segments and the method that reads its speed."""
    if not any(len(segments.values) for _, segments in pairs):
        raise NoEstimateError(no_segment(recording, pairs[0][1].welch))
    if recording.absent:
        raise NoEstimateError(no_channel(recording))
    pairs = of_direction(pairs, recording, settings)
    bins, reasons = [], []
    methods = [method for method, _ in pairs]
    for method, segments in pairs:
        try:
            own = placed(method, recording)
            bins += _bins(own, recording, segments, settings, methods, partial(finish, method))
        except NoEstimateError as reason:
            reasons.append(str(reason))
    if not bins:
        raise NoEstimateError("; ".join(dict.fromkeys(reasons)))
    return bins


def speed_bins(
    method: FittedMethod,
    recording: Recording,
    segments: SegmentSpectra,
    settings: TripSettings,
    models: Sequence[FittedMethod],
) -> list[SpeedBin]:
    """Return a method's estimate from each group of segments at one of its speeds.

    `segments` are the recording's, cut as for the method's training. `models` are all that read the
    recording, the method included: each group belongs to one of them; empty means the method alone.
    The result is empty if all readable groups belong to other models. The bins of lines of
    out-of-round wheels are left out, unless responses do not depend on the speed: these hold for
    one wheelset alone.

    Raises NoEstimateError if the recording is valid but gives no estimate, with the reason of the
    largest group, or that no model reads the trip's speeds; TripError if a channel or one sensor of
    a pair has the wrong unit or sign, two are swapped, or a pair meets a model that was trained for
    a sensor on one side.
    """
    read = partial(_read, level=settings.level)
    return _bins(method, recording, segments, settings, models, read)


def _bins(
    method: FittedMethod,
    recording: Recording,
    segments: SegmentSpectra,
    settings: TripSettings,
    models: Sequence[FittedMethod],
    finish: Callable[[SeenBin], Bin],
) -> list[Bin]:
    """Return what `finish` makes of each group of segments, as of `speed_bins`."""
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
    lines = () if any_speed else wheel_lines(recording)
    for part in steady(segments, speeds, own, trained, settings, lines):
        try:
            seen = _seen(method, recording, part, models, speeds, segments, settings)
            bins.append(finish(seen))
        except NoEstimateError as reason:
            reasons.append(reason)
    if reasons and not bins:
        raise reasons[0]
    return bins


def _seen(
    method: FittedMethod,
    recording: Recording,
    part: Steady,
    models: Sequence[FittedMethod],
    speeds: Tensor,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> SeenBin:
    """Return a group of segments as a method sees it; raises as `speed_bins` does."""
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
    return SeenBin(
        method, spectra, part.band, chosen, part.speed[0], at, doubts, left_out=part.left_out
    )


def _read(seen: SeenBin, level: float) -> SpeedBin:
    """Return the estimate from a group of segments; raises as `speed_bins` does."""
    known = seen.method, seen.spectra
    try:
        estimate, noise_share = estimate_with_noise(*known, level, seen.speeds, seen.left_out)
    except MissingFeaturesError as error:
        raise NoEstimateError(f"features are missing: {error}") from None
    late = delay_words(*known, estimate, seen.speeds, seen.left_out)
    if estimate.flags.has("misfit").any() and not late:
        raise NoEstimateError(_unexplained_words(estimate))
    if late:
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", late))
    doubts = "; ".join(filter(None, (seen.doubts, estimate.found)))
    known_of_it = {one.name: getattr(seen, one.name) for one in fields(SeenBin)}
    known_of_it["doubts"] = doubts
    return SpeedBin(**known_of_it, estimate=estimate, noise_share=noise_share)


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
        f"{part.n_incoherent} of them of low coherence: "
        f"{minutes_words(segments.welch, int(part.chosen.sum()), settings.min_averages)} "
        f"(half of the trip is run at {float(speeds.mean(dim=1).median()):.1f} m/s or less, "
        f"{readable_words(models)})"
    )


def _too_short(recording: Recording, segments: SegmentSpectra, settings: TripSettings) -> str:
    n_segments, faults = len(segments.values), unrepaired_words(recording)
    return (
        f"{n_segments} segments without faults: "
        f"{minutes_words(segments.welch, n_segments, settings.min_averages)}: "
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


def no_channel(recording: Recording) -> str:
    """Return why a recording without a sensor of some channel shows no mean of both sides."""
    return (
        f"no sensor at axle 1 gives {' and '.join(recording.absent)}; the springs and dampers of "
        "both sides as equal are read from axle_box, bogie and body: give a sensor of each without "
        "`axle`, or read the parts alone"
    )


def unrepaired_words(recording: Recording) -> str:
    """Return the faults that make parts of a recording unusable; empty if there are none."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return "; ".join(faults)
