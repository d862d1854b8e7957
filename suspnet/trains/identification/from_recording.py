"""From a recording to an estimate: segments at one speed -> transfer functions -> k and c."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from torch import Tensor

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError, Speeds
from suspnet.curves.welch import SegmentSpectra
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod, Model
from suspnet.estimation.from_spectra import MissingFeaturesError, estimate_with_noise, trip_settings
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import Direction
from suspnet.trains.identification.bogie_trips import estimate_parts
from suspnet.trains.identification.delays import delay_words
from suspnet.trains.identification.direction import direction_of, of_direction
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import Recording, load_recording
from suspnet.trains.sensors.plausibility import check_channels, check_pairs
from suspnet.trains.spectra.segments import difference_segments, recording_segments, segment_speeds
from suspnet.trains.spectra.steady_parts import (
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

ROLL_AS_NOISE = 1.2
"""Factor on half widths where one sensor of a side stands for both: its roll acts
as noise that the deviations do not include (docs/methods.md)."""


def estimate_trip(model: Model, trip: Recording | Path | str, settings: TripSettings) -> Estimate:
    """Return a model's estimate from a trip, its recording or its manifest's path, as one row.

    Raises NoEstimateError if there is none, TripError as `read_trip` does.
    """
    recording = trip
    if not isinstance(recording, Recording):
        recording = load_recording(read_manifest(Path(recording)), settings.rate_hz)
    segments = recording_segments(recording, trip_settings(model).welch)
    estimate = read_trip([(model, segments)], recording, settings).estimate
    if isinstance(estimate, NoEstimateError):
        raise estimate
    return estimate


@dataclass(frozen=True)
class TripReading:
    """What a trip shows: the estimate, one row, or why there is none, and what it rests on.

    `bins` are the groups of segments at one speed with the responses of both sides' mean; of a
    bogie whose parts are read, they are only shown. `doubts` are about the channels.
    """

    estimate: Estimate | NoEstimateError
    bins: Sequence[SeenBin] = ()
    doubts: Sequence[str] = ()


Pairs: TypeAlias = Sequence[tuple[Model, SegmentSpectra]]
"""Models with a recording's segments, cut as for the training of each."""


def read_trip(pairs: Pairs, recording: Recording, settings: TripSettings) -> TripReading:
    """Return what a recording shows to the models of a suspension.

    A bogie's model reads each part. Others take both sides and axles as equal: each group of
    segments at one speed is read by the method of its speed, and the estimates are combined. The
    bins of lines of out-of-round wheels are left out, unless responses do not depend on the speed:
    these hold for one wheelset alone.

    Raises TripError if a channel or one sensor of a pair has the wrong unit or sign, two are
    swapped, a pair meets a model that was trained for a sensor on one side, no method is for the
    direction of travel, or it is neither given nor shown by the phases.
    """
    model, segments = pairs[0]
    if isinstance(model, BogieModel):
        return _of_parts(model, segments, recording, settings)
    methods = [(m, segments) for m, segments in pairs if isinstance(m, FittedMethod)]
    return _of_equal_sides(methods, recording, settings)


def _of_parts(
    model: BogieModel, segments: SegmentSpectra, recording: Recording, settings: TripSettings
) -> TripReading:
    seen: list[SeenBin] = []
    try:
        direction = direction_of(recording, segments, model.generator, settings)
        with suppress(NoEstimateError):  # the parts may be read where these responses are not
            seen = _shown(model, segments, recording, settings, direction)
        estimate = estimate_parts(model.bogie, recording, settings, direction)
    except NoEstimateError as reason:
        return TripReading(reason, seen)
    return TripReading(estimate, seen, _doubts(seen))


def _shown(
    model: BogieModel,
    segments: SegmentSpectra,
    recording: Recording,
    settings: TripSettings,
    direction: Direction,
) -> list[SeenBin]:
    """Return the groups of segments at one speed as a bogie moves with both sides as equal."""
    if recording.absent or not len(segments.values):
        return []
    speeds, tolerance = segment_speeds(recording, segments), settings.speed_tolerance
    groups = groups_to_read(speeds, tolerance, settings.min_speed_m_per_s)
    seen = []
    for part in steady(segments, speeds, groups, model.settings, settings, wheel_lines(recording)):
        speed = group_speed(speeds, part.group)
        generator = replace(model.generator, speed_m_per_s=speed).running(direction)
        doubts = _checked(generator, recording, part, segments, settings)
        if part.spectra is not None and part.has_enough and part.is_certain:
            seen.append(_seen(model.settings, direction, part, doubts))
    return seen


def _of_equal_sides(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> TripReading:
    if not any(len(segments.values) for _, segments in pairs):
        segment_s, words = pairs[0][1].welch.segment_s, unrepaired_words(recording)
        reason = Finding("no-segment", segment_s=segment_s, unrepaired_words=words)
        return TripReading(NoEstimateError(reason))
    if recording.absent:
        return TripReading(NoEstimateError(no_channel(recording)))
    try:
        pairs = of_direction(pairs, recording, settings)
        methods = [method for method, _ in pairs]
        readings = [_groups_read(*pair, recording, settings, methods) for pair in pairs]
    except NoEstimateError as reason:
        return TripReading(reason)
    bins = [reading for groups in readings for reading in groups if isinstance(reading, SpeedBin)]
    if not bins:  # the first reason of each method
        reasons = dict.fromkeys(str(groups[0]) for groups in readings if groups)
        return TripReading(NoEstimateError(together(reasons)))
    estimate = combined(bins)
    doubts = _doubts(bins)
    places = zip(CHANNELS, recording.sides, bins[0].method.generator.sensor_lateral_m, strict=True)
    # single sensors on one side that a model takes as in the middle
    if lone := [f"{name} {side}" for name, side, lateral_m in places if side and not lateral_m]:
        estimate = estimate.scaled(ROLL_AS_NOISE)
        doubts.append(Finding("one-sensor-alone-unchecked", names=together(lone, ", ")))
    elif all(recording.paired):
        doubts.append(Finding("sides-not-compared"))
    return TripReading(estimate, bins, doubts)


def _doubts(bins: Sequence[SeenBin]) -> list[str]:
    return list(dict.fromkeys(speed_bin.doubts for speed_bin in bins if speed_bin.doubts))


def _groups_read(
    method: FittedMethod,
    segments: SegmentSpectra,
    recording: Recording,
    settings: TripSettings,
    models: Sequence[FittedMethod],
) -> list[SpeedBin | NoEstimateError]:
    """Return the estimate of each group of segments at one speed, or why there is none."""
    # which groups of segments at one speed are this method's
    _check_places(recording, method.generator)
    speeds = segment_speeds(recording, segments)
    tolerance, any_speed = settings.speed_tolerance, reads_at_any_speed(method)
    least = settings.min_speed_m_per_s if any_speed else 0.0
    groups = groups_to_read(speeds, tolerance, least, at_any_speed=any_speed)
    if not any(groups_of(model, models, speeds, groups) for model in models):
        if segments.welch.n_averages(len(speeds)) < settings.min_averages:
            return [NoEstimateError(_too_short(recording, segments, settings))]
        return [NoEstimateError(no_group_words(speeds, groups, models, tolerance, least))]
    trained = trip_settings(method)
    groups_of_method = groups_of(method, models, speeds, groups)
    lines = () if any_speed else wheel_lines(recording)
    readings: list[SpeedBin | NoEstimateError] = []
    for part in steady(segments, speeds, groups_of_method, trained, settings, lines):
        try:
            doubts = _checked(method.generator, recording, part, segments, settings)
            if part.spectra is None or not part.has_enough:
                reason = _too_few(part, models, recording, speeds, segments, settings)
                raise NoEstimateError(reason)
            if not part.is_certain:
                raise NoEstimateError(_uncertain(part, settings))
            seen = _seen(trained, method.generator.direction, part, doubts)
            readings.append(_read(method, seen, settings.level))
        except NoEstimateError as reason:
            readings.append(reason)
    return readings


def _checked(
    generator: ResponseGenerator,
    recording: Recording,
    part: Steady,
    segments: SegmentSpectra,
    settings: TripSettings,
) -> str:
    """Return doubts about the channels of a group of segments; TripError if one is wrong.

    A wrong channel is a better reason for no estimate than low coherence: it is looked for first.
    """
    n_candidates = int(part.candidates.sum())
    if not settings.check_channels or (
        segments.welch.n_averages(n_candidates) < settings.min_averages
    ):
        return ""
    looked_at = part.candidates if part.spectra is None else part.chosen
    if any(recording.paired):
        differences = difference_segments(recording, segments.welch)
        check_pairs(segments, differences, looked_at, recording.paired, generator.vehicle)
    average, bins = segments.average(looked_at), segments.frequencies_hz
    return check_channels(average, bins, generator, generator.vehicle)


def _uncertain(part: Steady, settings: TripSettings) -> str:
    return Finding(
        "responses-uncertain",
        deviation=100 * part.deviation,
        coherences=min(part.coherences),
        n_averages=part.n_averages,
        max_deviation=100 * settings.max_deviation,
    )


def _seen(
    settings: EstimateSettings, direction: Direction | None, part: Steady, doubts: str
) -> SeenBin:
    assert part.spectra is not None
    speeds = Speeds.of(*part.speed)
    return SeenBin(
        settings,
        direction,
        part.spectra,
        part.band,
        part.chosen,
        part.speed[0],
        speeds,
        doubts,
        part.left_out,
    )


def _read(method: FittedMethod, seen: SeenBin, level: float) -> SpeedBin:
    """Return the estimate from a group of segments, or raise NoEstimateError."""
    method_and_spectra = method, seen.spectra
    try:
        estimate, noise_share = estimate_with_noise(
            *method_and_spectra, level, seen.speeds, seen.left_out
        )
    except MissingFeaturesError as error:
        raise NoEstimateError(Finding("features-missing", error=error)) from None
    late = delay_words(*method_and_spectra, estimate, seen.speeds, seen.left_out)
    if estimate.flags.has("misfit").any() and not late:
        raise NoEstimateError(_unexplained_words(estimate))
    if late:
        estimate = replace(estimate, flags=estimate.flags.with_kind("misfit", late))
    of_seen = {field.name: getattr(seen, field.name) for field in fields(SeenBin)}
    of_seen["doubts"] = together((seen.doubts, estimate.found))
    return SpeedBin(**of_seen, method=method, estimate=estimate, noise_share=noise_share)


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


def no_channel(recording: Recording) -> str:
    """Return why a recording without a sensor of some channel shows no mean of both sides."""
    return Finding("no-sensor-at-axle-1", absent=together(recording.absent, " and "))


def unrepaired_words(recording: Recording) -> str:
    """Return the faults that make parts of a recording unusable; empty if there are none."""
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return together(faults)
