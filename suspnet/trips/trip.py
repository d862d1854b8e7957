"""One trip: recording -> segments -> transfer functions in speed bins -> stiffness and damping."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from suspnet.model.checkpoint import ModelFileError, TrainedModel
from suspnet.data.estimates import EstimateSettings
from suspnet.dynamics import VerticalVehicle
from suspnet.features.cross_spectra import CrossSpectra
from suspnet.features.transfer_estimate import SegmentSpectra
from suspnet.features.welch import Welch
from suspnet.trips.plausibility import check_channels
from suspnet.trips.records import ERROR, NO_ESTIMATE, OK, Quality, TripCurves, TripResult
from suspnet.trips.segments import (
    NoEstimateError,
    in_band,
    recording_segments,
    segment_speeds,
    without_incoherent,
    without_loud,
)
from suspnet.trips.trust import Trusted, trusted
from suspnet.recordings.manifest import TripError, TripManifest, read_manifest
from suspnet.recordings.recording import Recording, load_recording

log = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]
WINDOWS = 600
"""Windows of a trip's overview."""


@dataclass(frozen=True)
class TripSettings:
    """How trips are read and what an estimate asks for.

    Parameters
    ----------
    rate_hz : float, [Hz]
        Common rate of the three channels.
    speed_tolerance : float, [-]
        A segment belongs to a model's speed bin if its speed stays within 1 +- this of it.
    min_speed_m_per_s : float, [m/s]
        Least speed for models that do not depend on it.
    min_coherence : float, [-]
        Segments whose coherence with the trip's response is lower, and much lower than that of
        the others, are left out.
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
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise TypeError(f"`trips.{name}` must be a number, got {value!r}")
            if not low <= value <= high:
                raise ValueError(f"`trips.{name}` must lie between {low} and {high}, got {value}")


@dataclass(frozen=True)
class _Bin:
    """One model's view of a trip."""

    model: TrainedModel
    spectra: CrossSpectra
    segments: SegmentSpectra
    chosen: Tensor
    speed_m_per_s: float
    estimate: Trusted
    doubts: str


def evaluate_trip(path: Path, models: Sequence[TrainedModel], settings: TripSettings) -> TripResult:
    """Return a trip's estimate, or the reason why there is none; it never fails.

    Parameters
    ----------
    path : Path
        The manifest.
    models : sequence of TrainedModel
        One for each speed bin, all with the same outputs.
    settings : TripSettings
    """
    start = time.perf_counter()
    result = TripResult(trip=path.stem, manifest=str(path), status=ERROR)
    try:
        manifest = read_manifest(path)
        result = _described(result, manifest)
        result = _estimated(result, manifest, models, settings)
    except TripError as error:
        result = replace(result, reason=str(error).removeprefix(f"{path}: "))
    except Exception as error:  # a fault in one trip must not end the run of a fleet
        log.debug("trip %s failed", path, exc_info=True)
        result = replace(result, reason=f"{type(error).__name__}: {error}")
    return replace(result, seconds=time.perf_counter() - start)


def estimate_settings(model: TrainedModel) -> EstimateSettings:
    """Return how the trips that a model was trained for are estimated.

    Raises
    ------
    ModelFileError
        If it was trained on other curves.
    """
    if not isinstance(model.settings, EstimateSettings):
        raise ModelFileError(
            f"the model of protocol {model.task.protocol!r} was trained on curves of section "
            "III-B; trips need one of: python train.py experiment=trips"
        )
    return model.settings


def _described(result: TripResult, manifest: TripManifest) -> TripResult:
    return replace(
        result,
        vehicle=manifest.vehicle,
        suspension=manifest.suspension,
        mileage_km=manifest.mileage_km,
        start=manifest.start.isoformat() if manifest.start else "",
        truth=dict(manifest.truth),
    )


def _estimated(
    result: TripResult,
    manifest: TripManifest,
    models: Sequence[TrainedModel],
    settings: TripSettings,
) -> TripResult:
    for name in sorted({model.vehicle.name for model in models}):
        if name != manifest.vehicle:
            raise TripError(
                f"the trip is of vehicle {manifest.vehicle!r}, the model was trained for {name!r}"
            )
    recording = load_recording(manifest, settings.rate_hz)
    quality = Quality(
        duration_s=recording.duration_s,
        usable_percent=100 * float(recording.usable.mean()),
        faults="; ".join(str(fault) for fault in recording.faults),
    )
    welches = [estimate_settings(model).welch for model in models]
    segments = {welch: recording_segments(recording, welch) for welch in welches}
    n_total = max(len(found.values) for found in segments.values())
    result = replace(result, quality=replace(quality, segments_total=n_total))
    if n_total == 0:
        return replace(result, status=NO_ESTIMATE, reason=_no_segment(recording, welches[0]))
    pairs = [(model, segments[welch]) for model, welch in zip(models, welches, strict=True)]
    try:
        bins, reasons = _bins(recording, pairs, settings)
    except TripError as error:  # told here: the quality is known by now
        return replace(result, reason=str(error))
    if not bins:
        return replace(result, status=NO_ESTIMATE, reason="; ".join(dict.fromkeys(reasons)))
    return _combined(result, recording, bins)


def _bins(
    recording: Recording,
    pairs: Sequence[tuple[TrainedModel, SegmentSpectra]],
    settings: TripSettings,
) -> tuple[list[_Bin], list[str]]:
    """Return the bins with an estimate, and the reasons of those without."""
    bins, reasons = [], []
    for model, segments in pairs:
        try:
            bins.append(_bin(recording, segments, model, settings))
        except NoEstimateError as reason:
            reasons.append(str(reason))
    return bins, reasons


def _no_segment(recording: Recording, welch: Welch) -> str:
    faults = [str(fault) for fault in recording.faults if not fault.repaired]
    if not np.isfinite(recording.speed_m_per_s).all():
        faults.append("the speed is unknown in part")
    return f"no segment of {welch.segment_s:g} s is free of faults: {'; '.join(faults)}"


def _bin(
    recording: Recording,
    segments: SegmentSpectra,
    model: TrainedModel,
    settings: TripSettings,
) -> _Bin:
    """Return a model's estimate from the segments at its speed."""
    trained = estimate_settings(model)
    speeds = segment_speeds(recording, segments)
    within, words = _within(speeds, model, settings)
    band = in_band(segments, trained.frequencies_hz())
    candidates = without_loud(band, within)
    chosen, n_incoherent = without_incoherent(band, candidates, settings.min_coherence)
    doubts = ""
    if settings.check_channels and bool(candidates.any()):
        doubts = _checked(segments, chosen if bool(chosen.any()) else candidates, model)
    n_averages = segments.welch.n_averages(int(chosen.sum())) if bool(chosen.any()) else 0.0
    if n_averages < settings.min_averages:
        raise NoEstimateError(
            f"{int(within.sum())} of {len(within)} segments without faults are {words}, "
            f"{n_incoherent} of them of low coherence: {n_averages:.1f} averages, at least "
            f"{settings.min_averages:g} are needed (half of the trip is run at "
            f"{float(speeds.mean(dim=1).median()):.1f} m/s or less)"
        )
    spectra = band.average(chosen)
    deviation = float(spectra.deviations(trained.method).median(dim=1).values.amax())
    if deviation > settings.max_deviation:
        raise NoEstimateError(
            f"the responses are uncertain by {100 * deviation:.2g} % (coherence "
            f"{float(spectra.coherences().mean(dim=1).amin()):.2f}, {n_averages:.0f} averages), "
            f"at most {100 * settings.max_deviation:.2g} % are accepted"
        )
    responses = spectra.responses(trained.method)
    inputs = model.relative_features(responses[None].numpy(), band.frequencies_hz.numpy())
    if not np.isfinite(inputs).all():
        raise NoEstimateError(f"features are missing: {_missing(model, responses, band)}")
    speed = float(speeds[chosen].mean())
    estimate = trusted(model, spectra, inputs, settings.level)
    return _Bin(model, spectra, band, chosen, speed, estimate, doubts)


def _checked(segments: SegmentSpectra, chosen: Tensor, model: TrainedModel) -> str:
    """Return what could not be checked of the channels; TripError if one is wrong."""
    spectra = segments.average(chosen)
    return check_channels(spectra, segments.frequencies_hz, model.generator, model.vehicle)


def _within(speeds: Tensor, model: TrainedModel, settings: TripSettings) -> tuple[Tensor, str]:
    """Return which segments are a model's, by their speeds, and the rule in words."""
    bin_speed = model_speed(model)
    if bin_speed is None:
        low = settings.min_speed_m_per_s
        return (speeds >= low).all(dim=1), f"at {low:g} m/s or faster throughout"
    low, high = (bin_speed * (1 + sign * settings.speed_tolerance) for sign in (-1, 1))
    within = (speeds.amin(dim=1) >= low) & (speeds.amax(dim=1) <= high)
    return within, f"at {low:.1f} to {high:.1f} m/s throughout"


def model_speed(model: TrainedModel) -> float | None:
    """Return the speed that a model was trained for, [m/s]; None if any speed suits it."""
    generator = model.generator
    return generator.speed_m_per_s if isinstance(generator, VerticalVehicle) else None


def _missing(model: TrainedModel, responses: Tensor, band: SegmentSpectra) -> str:
    extractor = model.task.extractor
    table = extractor.extract(responses[None], band.frequencies_hz)
    return extractor.missing(table.reasons[0].numpy())


def _combined(result: TripResult, recording: Recording, bins: Sequence[_Bin]) -> TripResult:
    """Average the bins' logarithms, each weighted by its averages.

    So are the half widths of their intervals: models may err alike, so nothing averages out.
    Bins may overlap: a segment that two models read counts once in the quality.
    """
    weights = np.array([b.spectra.n_averages for b in bins])
    weights = weights / weights.sum()
    values = np.exp(weights @ np.log(np.stack([b.estimate.values for b in bins])))
    half_widths = weights @ np.stack([b.estimate.half_widths for b in bins])
    outputs = bins[0].model.task.outputs
    estimates = dict(zip(outputs, values.tolist(), strict=True))
    coherence = sum(
        w * b.spectra.coherences().mean(dim=1).numpy() for w, b in zip(weights, bins, strict=True)
    )
    names = bins[0].model.task.extractor.names
    used = _used(bins)
    quality = replace(
        result.quality,
        coherence_p=float(coherence[0]),
        coherence_s=float(coherence[1]),
        n_averages=sum(welch.n_averages(count) for welch, count in used.items()),
        segments_used=sum(used.values()),
        speed_m_per_s=float(weights @ [b.speed_m_per_s for b in bins]),
        speed_bins="; ".join(
            f"{b.speed_m_per_s:.1f} m/s: {b.spectra.n_averages:.0f} averages" for b in bins
        ),
        features_found=f"{len(names)} of {len(names)}",
        warnings="; ".join(dict.fromkeys(b.doubts for b in bins if b.doubts)),
    )
    best = bins[int(np.argmax(weights))]
    return replace(
        result,
        status=OK,
        estimates=estimates,
        raw=dict(estimates),
        half_widths=dict(zip(outputs, half_widths.tolist(), strict=True)),
        flags=_flags(bins),
        quality=quality,
        curves=_curves(best, recording),
    )


def _flags(bins: Sequence[_Bin]) -> str:
    """Return what speaks against a trip's estimate: of several bins, that of the best one flagged.

    Each bin puts the same into other numbers.
    """
    found = [b for b in bins if b.estimate.flags]
    if not found:
        return ""
    worst = max(found, key=lambda b: b.spectra.n_averages)
    if len(bins) == 1:
        return worst.estimate.flags
    at = f"at {worst.speed_m_per_s:.1f} m/s"
    return f"in {len(found)} of {len(bins)} speed bins, {at}: {worst.estimate.flags}"


def _used(bins: Sequence[_Bin]) -> dict[Welch, int]:
    """Return how many segments of each length at least one bin was made from."""
    chosen: dict[Welch, Tensor] = {}
    for one in bins:
        welch = one.segments.welch
        chosen[welch] = chosen.get(welch, torch.zeros_like(one.chosen)) | one.chosen
    return {welch: int(segments.sum()) for welch, segments in chosen.items()}


def _curves(best: _Bin, recording: Recording) -> TripCurves:
    method = estimate_settings(best.model).method
    n_windows = min(WINDOWS, recording.signals.shape[1])
    size = recording.signals.shape[1] // n_windows
    windows = recording.signals[:, : n_windows * size].reshape(3, n_windows, size)
    speed = recording.speed_m_per_s[: n_windows * size].reshape(n_windows, size)
    return TripCurves(
        frequencies_hz=best.segments.frequencies_hz.numpy(),
        responses=best.spectra.responses(method).numpy(),
        coherences=best.spectra.coherences().numpy(),
        deviations=best.spectra.deviations(method).numpy(),
        overview_s=np.arange(n_windows) * size / recording.rate_hz,
        overview_low=windows.min(axis=2),
        overview_high=windows.max(axis=2),
        overview_mean=windows.mean(axis=2),
        overview_speed=speed.mean(axis=1),
    )
