"""From a recording to an estimate: segments at one speed -> transfer functions -> k and c."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from torch import Tensor

from suspnet.curves.speeds import NoEstimateError, Speeds
from suspnet.curves.welch import SegmentSpectra, Welch
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import MissingFeaturesError, estimate_with_noise, trip_settings
from suspnet.estimation.temperature import DampingByTemperature
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, together
from suspnet.trains.identification.bogie_trips import UNEXPLAINED, UnexplainedError, estimate_parts
from suspnet.trains.identification.direction import direction_of, of_direction
from suspnet.trains.identification.trip_flags import delay_words, with_sides
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import Recording, load_recording
from suspnet.trains.sensors.lone_sensors import placed, with_lone
from suspnet.trains.sensors.plausibility import check_channels, check_pairs
from suspnet.trains.spectra.segments import difference_segments, recording_segments, segment_speeds
from suspnet.trains.spectra.steady_parts import (
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
from suspnet.trains.spectra.wheel_lines import wheel_lines
from suspnet.vehicle import ResponseGenerator


def estimate_trip(
    method: FittedMethod, trip: Recording | Path | str, settings: TripSettings
) -> Estimate:
    """Return a method's estimate from a trip, its recording or its manifest's path, as one row.

    It is that of each part if the method has a bogie and the recording shows its parts. Raises
    NoEstimateError if there is neither, TripError as `both_ways` does.
    """
    recording = trip
    if not isinstance(recording, Recording):
        recording = load_recording(read_manifest(Path(recording)), settings.rate_hz)
    segments = recording_segments(recording, trip_settings(method).welch)
    found = both_ways([(method, segments)], recording, settings)
    if isinstance(found.parts, Estimate):
        return found.parts
    if isinstance(found.bins, NoEstimateError):
        raise (
            found.bins
            if found.parts is None
            else NoEstimateError(together((str(found.bins), str(found.parts))))
        )
    estimate = with_sides(combined(found.equal), found.equal, recording)[0]
    if isinstance(found.parts, UnexplainedError):
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", UNEXPLAINED))
    return at_healthy_temperature(method, estimate, recording)


@dataclass(frozen=True)
class BothWays:
    """What a recording shows of both sides as equal, and of each part.

    `bins` are its groups of segments as far as they are read: without `parts` they are `equal`, the
    estimates of both sides as equal. With them `equal` is empty, as it takes three times as long.
    `parts` is that of each part, with damping as while healthy, or why there is none; None if the
    method has no bogie.
    """

    bins: Sequence[SeenBin] | NoEstimateError
    equal: Sequence[SpeedBin]
    parts: Estimate | NoEstimateError | None


def both_ways(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> BothWays:
    """Return what a recording shows to methods, the parts to the first.

    `pairs` are the methods with the recording's segments, cut as for the method's training; each
    group of segments is read by the method of its speed. The bins of lines of out-of-round wheels
    are left out, unless responses do not depend on the speed: these hold for one wheelset alone.

    The reason in place of the bins is that a valid recording gives no estimate, those of all
    methods, each that of its first group, or that none reads the trip's speeds. Raises TripError as
    `estimate_parts` does, and if a channel or one sensor of a pair has the wrong unit or sign, two
    are swapped, a pair meets a model that was trained for a sensor on one side, no method is for
    the direction of travel, or it is neither given nor shown by the phases.
    """
    seen = _seen_by_method(pairs, recording, settings)
    parts = _parts(*pairs[0], recording, settings)
    if isinstance(parts, Estimate):
        return BothWays(_or_reason(seen), (), parts)
    equal = _or_reason(_read_by_method(seen, recording, settings))
    if isinstance(equal, NoEstimateError):
        return BothWays(equal, (), parts)
    return BothWays(equal, equal, parts)


def _parts(
    method: FittedMethod, segments: SegmentSpectra, recording: Recording, settings: TripSettings
) -> Estimate | NoEstimateError | None:
    if method.bogie is None:
        return None
    try:
        direction = direction_of(recording, segments, method.generator, settings)
        parts = estimate_parts(method.bogie, recording, settings, direction)
    except NoEstimateError as reason:
        return reason
    return at_healthy_temperature(method, parts, recording)


def at_healthy_temperature(
    method: FittedMethod, estimate: Estimate, recording: Recording
) -> Estimate:
    """Return a recording's estimate with damping at the temperature of the healthy trips."""
    law = DampingByTemperature.noted(method.training)
    return law.compared(estimate, recording.manifest.temperature_c) if law else estimate


ByMethod: TypeAlias = list[tuple[FittedMethod, list[Bin | NoEstimateError]]]
"""What each method, as given, makes of its groups of segments, or why it makes nothing of one."""


def _seen_by_method(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> ByMethod[SeenBin]:
    first, segments = pairs[0]
    if not any(len(segments.values) for _, segments in pairs):
        return [(first, [NoEstimateError(no_segment(recording, segments.welch))])]
    if recording.absent:
        return [(first, [NoEstimateError(no_channel(recording))])]
    try:
        pairs = of_direction(pairs, recording, settings)
    except NoEstimateError as reason:
        return [(first, [reason])]
    methods = [method for method, _ in pairs]
    seen: ByMethod[SeenBin] = []
    for method, segments in pairs:
        own = placed(method, recording)
        seen.append((method, _seen_groups(own, recording, segments, settings, methods)))
    return seen


def _read_by_method(
    seen: ByMethod[SeenBin], recording: Recording, settings: TripSettings
) -> ByMethod[SpeedBin]:
    def read(method: FittedMethod, one: SeenBin | NoEstimateError) -> SpeedBin | NoEstimateError:
        if isinstance(one, NoEstimateError):
            return one
        try:
            return with_lone(_read(one, settings.level), method, recording)
        except NoEstimateError as reason:
            return reason

    return [(method, [read(method, one) for one in groups]) for method, groups in seen]


def _or_reason(by_method: ByMethod[Bin]) -> list[Bin] | NoEstimateError:
    """Return the bins of all methods, or the first reasons of each why there is none."""
    groups = [one for _, groups in by_method for one in groups]
    bins = [one for one in groups if not isinstance(one, NoEstimateError)]
    reasons = [str(groups[0]) for _, groups in by_method if groups]
    return bins or NoEstimateError(together(dict.fromkeys(reasons)))


def _seen_groups(
    method: FittedMethod,
    recording: Recording,
    segments: SegmentSpectra,
    settings: TripSettings,
    models: Sequence[FittedMethod],
) -> list[SeenBin | NoEstimateError]:
    """Return each group of segments at one speed as its method sees it, or why it sees nothing."""
    # which groups of segments at one speed are this method's
    _check_places(recording, method.generator)
    speeds = segment_speeds(recording, segments)
    tolerance, any_speed = settings.speed_tolerance, reads_at_any_speed(method)
    least = settings.min_speed_m_per_s if any_speed else 0.0
    groups = groups_to_read(speeds, tolerance, least, at_any_speed=any_speed)
    if not any(groups_of(one, models, speeds, groups) for one in models):
        if segments.welch.n_averages(len(speeds)) < settings.min_averages:
            return [NoEstimateError(_too_short(recording, segments, settings))]
        return [NoEstimateError(no_group_words(speeds, groups, models, tolerance, least))]
    trained = trip_settings(method)
    own = groups_of(method, models, speeds, groups)
    lines = () if any_speed else wheel_lines(recording)
    seen: list[SeenBin | NoEstimateError] = []
    for part in steady(segments, speeds, own, trained, settings, lines):
        try:
            seen.append(_seen(method, recording, part, models, speeds, segments, settings))
        except NoEstimateError as reason:
            seen.append(reason)
    return seen


def _seen(
    method: FittedMethod,
    recording: Recording,
    part: Steady,
    models: Sequence[FittedMethod],
    speeds: Tensor,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> SeenBin:
    """Return a group of segments as a method sees it, or raise NoEstimateError or TripError."""
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
            Finding(
                "responses-uncertain",
                deviation=100 * part.deviation,
                coherences=min(part.coherences),
                n_averages=part.n_averages,
                max_deviation=100 * settings.max_deviation,
            )
        )
    at = Speeds.of(*part.speed)
    return SeenBin(
        method, spectra, part.band, chosen, part.speed[0], at, doubts, left_out=part.left_out
    )


def _read(seen: SeenBin, level: float) -> SpeedBin:
    """Return the estimate from a group of segments, or raise NoEstimateError."""
    known = seen.method, seen.spectra
    try:
        estimate, noise_share = estimate_with_noise(*known, level, seen.speeds, seen.left_out)
    except MissingFeaturesError as error:
        raise NoEstimateError(Finding("features-missing", error=error)) from None
    late = delay_words(*known, estimate, seen.speeds, seen.left_out)
    if estimate.flags.has("misfit").any() and not late:
        raise NoEstimateError(_unexplained_words(estimate))
    if late:
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", late))
    doubts = together((seen.doubts, estimate.found))
    known_of_it = {one.name: getattr(seen, one.name) for one in fields(SeenBin)}
    known_of_it["doubts"] = doubts
    return SpeedBin(**known_of_it, estimate=estimate, noise_share=noise_share)


def _unexplained_words(estimate: Estimate) -> str:
    """Return why an estimate with an unexplained curve is none, and which part is suspected."""
    furthest = int(np.argmax(np.abs(np.log(estimate.values[0]))))
    return Finding(
        "unexplained-nearest",
        reasons=estimate.flags.reasons[0],
        names=estimate.names[furthest],
        values=100 * estimate.values[0, furthest],
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
    where = Finding("steady-at", group_speed=group_speed(speeds, group))
    if reads_at_any_speed(models[0]):
        where = Finding("at-any-speed-above", min_speed_m_per_s=settings.min_speed_m_per_s)
    return Finding(
        "too-few-steady",
        n=int(group.sum()),
        segments=Finding("segments", n=len(group)),
        where=where,
        n_incoherent=part.n_incoherent,
        minutes=minutes_words(segments.welch, int(part.chosen.sum()), settings.min_averages),
        half=float(speeds.mean(dim=1).median()),
        models=readable_words(models),
    )


def _too_short(recording: Recording, segments: SegmentSpectra, settings: TripSettings) -> str:
    n_segments, faults = len(segments.values), unrepaired_words(recording)
    return Finding(
        "too-short",
        segments=Finding("segments", n=n_segments),
        minutes=minutes_words(segments.welch, n_segments, settings.min_averages),
        why=Finding("too-little-free", faults=faults) if faults else Finding("recording-too-short"),
    )


def _check_places(recording: Recording, generator: ResponseGenerator) -> None:
    """Raise TripError if the recording has pairs where the model expects a sensor on one side.

    A single sensor suits both kinds of model: it may be in the middle, or already an average.
    """
    places = zip(CHANNELS, recording.paired, generator.sensor_lateral_m, strict=True)
    wrong = [(name, lateral_m) for name, is_pair, lateral_m in places if is_pair and lateral_m]
    if wrong:
        listed = together((f"{name} ({lateral_m:g} m)" for name, lateral_m in wrong), ", ")
        raise TripError(Finding("pairs-for-one-sided-model", listed=listed))


def no_segment(recording: Recording, welch: Welch) -> str:
    """Return the message that no segment of a recording is free of faults."""
    return Finding(
        "no-segment", segment_s=welch.segment_s, unrepaired_words=unrepaired_words(recording)
    )


def no_channel(recording: Recording) -> str:
    """Return why a recording without a sensor of some channel shows no mean of both sides."""
    return Finding("no-sensor-at-axle-1", absent=together(recording.absent, " and "))


def unrepaired_words(recording: Recording) -> str:
    """Return the faults that make parts of a recording unusable; empty if there are none."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return together(faults)
