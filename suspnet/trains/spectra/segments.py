"""Segments of a recording that are used for an estimate."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CHAIN
from suspnet.curves.speeds import NoEstimateError
from suspnet.curves.welch import SegmentSpectra, Welch, segment_spectra
from suspnet.ground.findings import Finding
from suspnet.ground.tensors import as_tensor
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.dead_sensors import check_copies
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.spectra.evened_level import log_levels

LOUD = 30.0
"""Segments with more than this multiple of the median power are excluded before averaging."""
ROUNDS = 3
"""Number of rounds in which segments of low coherence are excluded and the average is updated."""
ODD = 3.0
"""A segment is an outlier if its unexplained fraction of power exceeds this multiple of the median.
"""


def recording_segments(recording: Recording, welch: Welch) -> SegmentSpectra:
    """Return the segments without faults, up to a quarter of the sampling rate.

    TripError if two of the recording's sensors hold the same samples.
    """
    check_copies(recording.sensors(), recording.usable, recording.manifest.path)
    return _faultless(recording, recording.signals, welch)


def difference_segments(recording: Recording, welch: Welch) -> SegmentSpectra:
    """Return the same segments of the half differences (left - right) / 2 of pairs of sensors."""
    return _faultless(recording, recording.differences, welch)


def sensor_segments(recording: Recording, welch: Welch) -> tuple[list[str], SegmentSpectra]:
    """Return the names of all sensors and the same segments of their signals.

    TripError if two of them hold the same samples.
    """
    names, signals = _all_signals(recording)
    return names, _faultless(recording, signals, welch)


def evened_segments(recording: Recording, welch: Welch) -> tuple[list[str], SegmentSpectra, Tensor]:
    """Return the same with the level of the signals evened out, and the log level of each segment.

    The latter are means of `log_levels`, (n_segments,).
    """
    names, signals = _all_signals(recording)
    levels = log_levels(signals, recording.usable, recording.rate_hz)
    segments = _faultless(recording, signals / np.exp(levels), welch)
    length, _ = welch.sizes(recording.rate_hz)
    of_segments = as_tensor(levels).unfold(0, length, 1)[segments.first].mean(dim=1)
    return names, segments, of_segments


def _all_signals(recording: Recording) -> tuple[list[str], FloatArray]:
    sensors = recording.sensors()
    check_copies(sensors, recording.usable, recording.manifest.path)
    return list(sensors), np.stack(list(sensors.values()))


def _faultless(recording: Recording, signals: FloatArray, welch: Welch) -> SegmentSpectra:
    return segment_spectra(
        as_tensor(signals, copy=False),
        recording.rate_hz,
        welch,
        high_hz=recording.rate_hz / 4,
        usable=as_tensor(recording.usable, np.bool_, copy=False),
    )


def segment_speeds(recording: Recording, segments: SegmentSpectra) -> Tensor:
    """Return the speed in each segment, shape (n_segments, n_samples of a segment), [m/s]."""
    length, _ = segments.welch.sizes(recording.rate_hz)
    return as_tensor(recording.speed_m_per_s).unfold(0, length, 1)[segments.first]


def without_loud(segments: SegmentSpectra, chosen: Tensor) -> Tensor:
    """Return the chosen segments without those far above their median power."""
    if not bool(chosen.any()):
        return chosen
    power = segments.values.abs().square().mean(dim=2)
    return chosen & (power <= LOUD * power[chosen].median(dim=0).values).all(dim=1)


def in_band(segments: SegmentSpectra, frequencies_hz: Tensor) -> SegmentSpectra:
    """Return the segments on the bins of a model.

    Raises NoEstimateError if the recording does not reach the highest bin.
    """
    if float(frequencies_hz[-1]) > float(segments.frequencies_hz[-1]) + 1e-9:
        raise NoEstimateError(
            Finding(
                "band-beyond-recording",
                frequencies_hz=float(frequencies_hz[-1]),
                frequencies_hz2=float(segments.frequencies_hz[-1]),
            )
        )
    inside = (segments.frequencies_hz >= frequencies_hz[0] - 1e-6) & (
        segments.frequencies_hz <= frequencies_hz[-1] + 1e-6
    )
    return replace(
        segments,
        frequencies_hz=segments.frequencies_hz[inside],
        values=segments.values[..., inside],
    )


def without_incoherent(band: SegmentSpectra, chosen: Tensor, least: float) -> tuple[Tensor, int]:
    """Return the chosen segments that the average explains, and the number excluded.

    A segment's coherence is 1 - u, u = mean over bins of abs(Y - H1 X)^2 / S_yy, for the worse
    link. A segment is excluded if it is below `least` and u exceeds `ODD` times the trip's median:
    a noisy sensor lowers all segments alike, which IV tolerates.
    """
    n_before = int(chosen.sum())
    for _ in range(ROUNDS):
        if not bool(chosen.any()):
            break
        spectra = band.average(chosen)
        links = []
        for x, y, _ in CHAIN:
            residual = band.values[:, y] - spectra.transfer(x, y, "H1") * band.values[:, x]
            links.append((residual.abs().square() / spectra.auto[y]).mean(dim=1))
        unexplained = torch.stack(links)
        threshold = (ODD * unexplained[:, chosen].median(dim=1).values).clamp(min=1 - least)
        chosen = chosen & (unexplained <= threshold[:, None]).all(dim=0)
    return chosen, n_before - int(chosen.sum())
