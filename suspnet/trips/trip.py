"""One trip: recording -> segments -> transfer functions in speed bins -> stiffness and damping."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from suspnet.estimation.bogie_trips import UNEXPLAINED, UnexplainedError
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.estimate import Estimate, HealthyValues
from suspnet.estimation.from_recording import at_healthy_temperature, both_ways
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.steady_parts import SeenBin, SpeedBin, combined, largest
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.trip_flags import with_sides
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import (
    NO_PART,
    WITHOUT_SENSORS,
    Finding,
    parts_of,
    together,
    with_values,
    without,
)
from suspnet.ground.records import (
    ERROR,
    NO_ESTIMATE,
    OK,
    Place,
    Quality,
    TripCurves,
    TripResult,
    sensors_text,
)
from suspnet.ground.storage import one_line
from suspnet.ground.tensors import threads
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import TripManifest
from suspnet.recordings.manifest_files import ManifestFile
from suspnet.recordings.recording import Recording, load_recording, overview
from suspnet.spectra.segments import recording_segments
from suspnet.spectra.sensor_health import sensor_health
from suspnet.spectra.speeds import NoEstimateError
from suspnet.spectra.welch import Welch
from suspnet.spectra.wheel_lines import wheel_lines, wheel_words
from suspnet.trips.commissionings import models_at, since_km

log = logging.getLogger(__name__)


def evaluate_trip(
    trip: Path | ManifestFile, models: Sequence[TrainedModel], settings: TripSettings
) -> TripResult:
    """Return a trip's estimate, or the reason why there is none; it never fails.

    `trip` is its manifest; `models` has one for each speed bin and commissioning, all with the same
    outputs.
    """
    start = time.perf_counter()
    file = trip if isinstance(trip, ManifestFile) else ManifestFile(trip)
    result = TripResult(trip=file.path.stem, manifest=str(file.path), status=ERROR)
    try:
        manifest = file.trip
    except Exception as error:
        result = _failed(result, error)
    else:
        read = functools.partial(load_recording, manifest, settings.rate_hz)
        result = evaluate_recording(manifest, read, models, settings)
    return replace(result, seconds=time.perf_counter() - start)


@threads(1)
def evaluate_recording(
    manifest: TripManifest,
    read: Callable[[], Recording],
    models: Sequence[TrainedModel],
    settings: TripSettings,
) -> TripResult:
    """Return the estimate from a trip's recording, or why there is none; it never fails.

    `read` returns the recording; an exception that it raises is the reason.
    """
    start = time.perf_counter()
    result = TripResult(trip=manifest.name, manifest=str(manifest.path), status=ERROR)
    result = _described(result, manifest)
    try:
        models = models_at(models, manifest.mileage_km)
        result = replace(result, healthy_since_km=since_km(models[0]))
        result = _estimated(result, manifest, read, models, settings)
    except Exception as error:  # a fault in one trip must not end the run of a fleet
        result = _failed(result, error)
    return _in_lines(replace(result, seconds=time.perf_counter() - start))


def _failed(result: TripResult, error: Exception) -> TripResult:
    words = without(result.manifest, str(error))
    if not isinstance(error, TripError):
        log.debug("trip %s failed", result.manifest, exc_info=error)
        words = f"{type(error).__name__}: {error}"
    return _in_lines(replace(result, reason=words))


def lost_trip(path: Path, reason: str) -> TripResult:
    """Return the result of a trip whose evaluation was interrupted."""
    return _in_lines(TripResult(path.stem, str(path), status=ERROR, reason=reason))


def _in_lines(result: TripResult) -> TripResult:
    place = Place(*map(one_line, astuple(result.place)))
    values = {f.name: getattr(result, f.name) for f in fields(result)}
    changes: dict[str, Any] = {
        k: with_values(v, one_line) for k, v in values.items() if isinstance(v, str)
    }
    return replace(result, place=place, **changes)


def _described(result: TripResult, manifest: TripManifest) -> TripResult:
    return replace(
        result,
        vehicle=manifest.vehicle,
        place=manifest.place,
        mileage_km=manifest.mileage_km,
        start=manifest.start.isoformat() if manifest.start else "",
        truth=dict(manifest.truth),
        temperature_c=np.nan if manifest.temperature_c is None else manifest.temperature_c,
    )


def _estimated(
    result: TripResult,
    manifest: TripManifest,
    read: Callable[[], Recording],
    models: Sequence[TrainedModel],
    settings: TripSettings,
) -> TripResult:
    for name in sorted({model.vehicle.name for model in models}):
        if name != manifest.vehicle:
            raise TripError(
                Finding("model-of-other-vehicle", vehicle=repr(manifest.vehicle), name=repr(name))
            )
    axle = getattr(models[0].generator, "axle", None)  # those of users need not name one
    if axle and manifest.axle and manifest.axle != axle:
        raise TripError(Finding("model-of-other-axle", axle=manifest.axle, axle2=manifest.axle))
    recording = read()
    quality = Quality(
        duration_s=recording.duration_s,
        usable_percent=100 * float(recording.usable.mean()),
        faults=together(map(str, recording.faults)),
        read_as=recording.words,
    )
    if not result.start and recording.started is not None:
        result = replace(result, start=recording.started.isoformat())
    wheels = wheel_words(recording, wheel_lines(recording))
    sensors = sensor_health(recording, models[0].generator, _welch(models[0]))
    quality = replace(quality, wheels=wheels, sensors=sensors_text(sensors))
    segments = {one: recording_segments(recording, one) for one in map(_welch, models)}
    n_total = max(len(found.values) for found in segments.values())
    result = replace(result, quality=replace(quality, segments_total=n_total))
    pairs = [(model, segments[_welch(model)]) for model in models]
    try:
        found = both_ways(pairs, recording, settings)
    except TripError as error:  # reported only now, as the quality is known
        return replace(result, reason=str(error))
    if isinstance(found.bins, NoEstimateError):
        result = replace(result, status=NO_ESTIMATE, reason=str(found.bins))
    else:
        result = _with_quality(result, recording, found.bins)
    if found.equal:
        result = _with_equal(result, recording, found.equal)
    return _with_parts(result, models[0].bogie, found.parts)


def _with_equal(result: TripResult, recording: Recording, bins: Sequence[SpeedBin]) -> TripResult:
    """Return a result with the combined estimate of both sides as equal."""
    estimate, sides = with_sides(combined(bins), bins, recording)
    estimate = at_healthy_temperature(bins[0].method, estimate, recording)
    return _with_values(replace(result, sides=sides), estimate, largest(bins).method.healthy)


def _with_parts(
    result: TripResult,
    bogie: CommissionedBogie | None,
    parts: Estimate | NoEstimateError | None,
) -> TripResult:
    """Return a result with the estimate of each part in place of that of both sides as equal.

    If the trip does not show the parts, it stays as it is, and a warning says why; it is flagged
    if no change of the parts explains it.
    """
    if bogie is None or parts is None:
        return result
    if isinstance(parts, NoEstimateError):
        if isinstance(parts, UnexplainedError):
            result = replace(result, flags=together((result.flags, UNEXPLAINED)))
        return _warned(result, Finding(NO_PART, words=str(parts)))
    result = replace(result, reason="", worn=parts.found)
    if parts.lost:
        result = _warned(
            result, Finding(WITHOUT_SENSORS, names=parts.lost, listed=together(parts.lost, ", "))
        )
    return _with_values(result, parts, bogie.healthy)


def _warned(result: TripResult, words: str) -> TripResult:
    warnings = together((*parts_of(result.quality.warnings), words))
    return replace(result, quality=replace(result.quality, warnings=warnings))


def _with_values(result: TripResult, estimate: Estimate, healthy: HealthyValues) -> TripResult:
    """Return a result with an estimate of one row."""
    names = estimate.names
    values = dict(zip(names, estimate.values[0].tolist(), strict=True))
    return replace(
        result,
        status=OK,
        estimates=values,
        raw=dict(values),
        half_widths=dict(zip(names, estimate.half_widths[0].tolist(), strict=True)),
        healthy_si=dict(zip(names, healthy.values.tolist(), strict=True)),
        healthy_half_widths=dict(
            zip(names, healthy.half_widths(estimate.level).tolist(), strict=True)
        ),
        flags=estimate.flags.reasons[0],
        quality=replace(result.quality, misfit=estimate.misfit),
    )


def _welch(model: TrainedModel) -> Welch:
    return trip_settings(model).welch


def _with_quality(result: TripResult, recording: Recording, bins: Sequence[SeenBin]) -> TripResult:
    """Return a result with the quality and curves of its bins.

    Bins may overlap: a segment that two models read counts once in the quality.
    """
    # quality: averages over the bins, weighted by their numbers of averages
    weights = np.array([b.spectra.n_averages for b in bins])
    weights = weights / weights.sum()
    coherence = sum(
        w * b.spectra.coherences().mean(dim=1).numpy() for w, b in zip(weights, bins, strict=True)
    )
    names = bins[0].method.task.extractor.names
    # direction and curves are those of the bin with the most averages
    best = largest(bins)
    used = _used(bins)
    quality = replace(
        result.quality,
        coherence_p=float(coherence[0]),
        coherence_s=float(coherence[1]),
        n_averages=sum(welch.n_averages(count) for welch, count in used.items()),
        segments_used=sum(used.values()),
        speed_m_per_s=float(weights @ [b.speed_m_per_s for b in bins]),
        speed_bins=together(
            f"{b.speed_m_per_s:.1f} m/s{' in reverse' * b.is_reverse}: "
            f"{b.spectra.n_averages:.0f} averages"
            for b in bins
        ),
        direction=best.method.generator.direction or recording.manifest.direction or "",
        features_found=f"{len(names)} of {len(names)}",
        warnings=together(dict.fromkeys(b.doubts for b in bins)),
    )
    return replace(result, quality=quality, curves=_curves(best, recording))


def _used(bins: Sequence[SeenBin]) -> dict[Welch, int]:
    chosen: dict[Welch, Tensor] = {}
    for one in bins:
        welch = one.segments.welch
        chosen[welch] = chosen.get(welch, torch.zeros_like(one.chosen)) | one.chosen
    return {welch: int(segments.sum()) for welch, segments in chosen.items()}


def _curves(best: SeenBin, recording: Recording) -> TripCurves:
    method = trip_settings(best.method).method
    seen = overview(recording)
    return TripCurves(
        frequencies_hz=best.segments.frequencies_hz.numpy(),
        responses=best.spectra.responses(method).numpy(),
        coherences=best.spectra.coherences().numpy(),
        deviations=best.spectra.deviations(method).numpy(),
        overview_s=seen.times_s,
        overview_low=seen.low,
        overview_high=seen.high,
        overview_mean=seen.mean,
        overview_speed=seen.speed_m_per_s,
    )
