"""One trip: recording -> segments -> stiffness and damping, with the quality of the recording."""

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

from suspnet.curves.speeds import NoEstimateError
from suspnet.curves.welch import Welch
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import Model
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground import records
from suspnet.ground.findings import WITHOUT_SENSORS, Finding, together, with_values, without
from suspnet.ground.parameters import REVERSE
from suspnet.ground.storage import one_line
from suspnet.ground.tensors import threads
from suspnet.ground.types import FloatArray
from suspnet.trains.identification.from_recording import read_trip
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.recordings.recording import Recording, load_recording, overview
from suspnet.trains.sensors.sensor_health import sensor_health
from suspnet.trains.spectra.segments import recording_segments
from suspnet.trains.spectra.steady_parts import SeenBin, largest
from suspnet.trains.spectra.wheel_lines import wheel_lines, wheel_words
from suspnet.trains.trips.commissionings import models_at, since_km

log = logging.getLogger(__name__)


def evaluate_trip(
    trip: Path | ManifestFile, models: Sequence[Model], settings: TripSettings
) -> records.TripResult:
    """Return a trip's estimate, or the reason why there is none; it never fails.

    `trip` is its manifest; `models` has one for each speed bin and commissioning, all with the same
    outputs.
    """
    file = trip if isinstance(trip, ManifestFile) else ManifestFile(trip)
    try:
        manifest = file.trip
    except Exception as error:
        return lost_trip(file.path, _reason(error, file.path))
    read = functools.partial(load_recording, manifest, settings.rate_hz)
    return evaluate_recording(manifest, read, models, settings)


@threads(1)
def evaluate_recording(
    manifest: TripManifest,
    read: Callable[[], Recording],
    models: Sequence[Model],
    settings: TripSettings,
) -> records.TripResult:
    """Return the estimate from a trip's recording, or why there is none; it never fails.

    `read` returns the recording; an exception that it raises is the reason.
    """
    start = time.perf_counter()
    about: dict[str, Any] = {
        "trip": manifest.name,
        "manifest": str(manifest.path),
        "vehicle": manifest.vehicle,
        "place": manifest.place,
        "mileage_km": manifest.mileage_km,
        "truth": dict(manifest.truth),
        "temperature_c": np.nan if manifest.temperature_c is None else manifest.temperature_c,
    }
    if manifest.start:
        about["start"] = manifest.start.isoformat()
    try:
        models = models_at(models, manifest.mileage_km)
        about["healthy_since_km"] = since_km(models[0])
        _check_measured(manifest, models)
        outcome = outcome_of(read(), models, settings)
    except Exception as error:  # a fault in one trip must not end the run of a fleet
        outcome = {"status": records.ERROR, "reason": _reason(error, manifest.path)}
    seconds = time.perf_counter() - start
    return _in_lines(records.TripResult(**(outcome | about), seconds=seconds))


def lost_trip(path: Path, reason: str) -> records.TripResult:
    """Return the result of a trip of which nothing but its manifest's path is known."""
    return _in_lines(records.TripResult(path.stem, str(path), status=records.ERROR, reason=reason))


def _reason(error: Exception, manifest: Path) -> str:
    if isinstance(error, TripError):
        return without(manifest, str(error))
    log.debug("trip %s failed", manifest, exc_info=error)
    return f"{type(error).__name__}: {error}"


def _in_lines(result: records.TripResult) -> records.TripResult:
    place = records.Place(*map(one_line, astuple(result.place)))
    values = {f.name: getattr(result, f.name) for f in fields(result)}
    texts: dict[str, Any] = {
        name: with_values(value, one_line)
        for name, value in values.items()
        if isinstance(value, str)
    }
    return replace(result, place=place, **texts)


def _check_measured(manifest: TripManifest, models: Sequence[Model]) -> None:
    """Raise TripError if the models were not trained for the trip's vehicle and axle."""
    for name in sorted({model.vehicle.name for model in models} - {manifest.vehicle}):
        raise TripError(
            Finding("model-of-other-vehicle", vehicle=repr(manifest.vehicle), name=repr(name))
        )
    axle = getattr(models[0].generator, "axle", None)  # those of users need not name one
    if axle and manifest.axle and manifest.axle != axle:
        raise TripError(Finding("model-of-other-axle", axle=manifest.axle, axle2=manifest.axle))


def outcome_of(
    recording: Recording, models: Sequence[Model], settings: TripSettings
) -> dict[str, Any]:
    """Return the fields of a result that the recording decides."""
    segments = {welch: recording_segments(recording, welch) for welch in map(_welch, models)}
    start = "" if recording.started is None else recording.started.isoformat()
    quality: dict[str, Any] = {
        "duration_s": recording.duration_s,
        "usable_percent": 100 * float(recording.usable.mean()),
        "faults": together(map(str, recording.faults)),
        "read_as": recording.words,
        "wheels": wheel_words(recording, wheel_lines(recording)),
        "sensors": records.sensors_text(
            sensor_health(recording, models[0].generator, _welch(models[0]))
        ),
        "segments_total": max(len(several.values) for several in segments.values()),
    }
    pairs = [(model, segments[_welch(model)]) for model in models]
    try:
        shown = read_trip(pairs, recording, settings)
    except TripError as error:  # with the quality, which may show why
        refused = {"status": records.ERROR, "reason": str(error)}
        return refused | {"start": start, "quality": records.Quality(**quality)}
    if shown.bins:
        quality |= _of_bins(shown.bins, recording)
    estimate, misfit, lost = shown.estimate, np.nan, ""
    if isinstance(estimate, NoEstimateError):
        outcome = {"status": records.NO_ESTIMATE, "reason": str(estimate)}
    else:
        outcome, misfit = _of_estimate(estimate), estimate.misfit
        if names := estimate.lost:
            lost = Finding(WITHOUT_SENSORS, names=names, listed=together(names, ", "))
    warnings = together((*shown.doubts, lost))
    return outcome | {
        "start": start,
        "quality": records.Quality(**quality, misfit=misfit, warnings=warnings),
        "curves": _curves(largest(shown.bins), recording) if shown.bins else None,
    }


def _of_estimate(estimate: Estimate) -> dict[str, Any]:
    """Return the fields of a result that its estimate decides."""
    healthy = estimate.healthy
    assert healthy is not None

    def by_name(values: FloatArray) -> dict[str, float]:
        return dict(zip(estimate.names, values.tolist(), strict=True))

    return {
        "status": records.OK,
        "estimates": by_name(estimate.values[0]),
        "half_widths": by_name(estimate.half_widths[0]),
        "healthy_si": by_name(healthy.values),
        "healthy_half_widths": by_name(healthy.half_widths(estimate.level)),
        "flags": estimate.flags.reasons[0],
        "worn": estimate.found,
    }


def _welch(model: Model) -> Welch:
    return trip_settings(model).welch


def _of_bins(bins: Sequence[SeenBin], recording: Recording) -> dict[str, Any]:
    """Return what bins of speed add to the quality: averages over them, by their averages.

    Bins may overlap: a segment that two models read counts once.
    """
    weights = np.array([speed_bin.spectra.n_averages for speed_bin in bins])
    weights = weights / weights.sum()
    coherence = sum(
        weight * speed_bin.spectra.coherences().mean(dim=1).numpy()
        for weight, speed_bin in zip(weights, bins, strict=True)
    )
    used = _used(bins)
    return {
        "coherence_p": float(coherence[0]),
        "coherence_s": float(coherence[1]),
        "n_averages": sum(welch.n_averages(count) for welch, count in used.items()),
        "segments_used": sum(used.values()),
        "speed_m_per_s": float(weights @ [speed_bin.speed_m_per_s for speed_bin in bins]),
        "speed_bins": together(
            f"{speed_bin.speed_m_per_s:.1f} m/s"
            f"{' in reverse' if speed_bin.direction == REVERSE else ''}: "
            f"{speed_bin.spectra.n_averages:.0f} averages"
            for speed_bin in bins
        ),
        "direction": largest(bins).direction or recording.manifest.direction or "",
    }


def _used(bins: Sequence[SeenBin]) -> dict[Welch, int]:
    chosen: dict[Welch, Tensor] = {}
    for speed_bin in bins:
        welch = speed_bin.segments.welch
        chosen[welch] = chosen.get(welch, torch.zeros_like(speed_bin.chosen)) | speed_bin.chosen
    return {welch: int(segments.sum()) for welch, segments in chosen.items()}


def _curves(best: SeenBin, recording: Recording) -> records.TripCurves:
    method = best.settings.method
    seen = overview(recording)
    return records.TripCurves(
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
