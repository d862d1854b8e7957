"""Segments of a recording that are used for an estimate, their speeds, and ranges of speeds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import FORWARD, REVERSE, Direction
from suspnet.ground.tensors import as_tensor
from suspnet.ground.types import FloatArray
from suspnet.recordings.dead_sensors import check_copies
from suspnet.recordings.recording import Recording
from suspnet.spectra.cross_spectra import CHAIN
from suspnet.spectra.welch import NEGLIGIBLE, SegmentSpectra, Welch, segment_spectra

LOUD = 30.0
"""Segments with more than this multiple of the median power are excluded before averaging."""
ROUNDS = 3
"""Number of rounds in which segments of low coherence are excluded and the average is updated."""
ODD = 3.0
"""A segment is an outlier if its unexplained fraction of power exceeds this multiple of the median.
"""
MARGIN = 0.02
"""Relative margin added to the speeds of the trips a model is made for; later trips vary by as
much."""
ROUNDING = 1e-9
"""Relative rounding error of a range's ends, which are computed from middle and half width."""


class NoEstimateError(Exception):
    """The trip is valid but gives no estimate; the message states the reason."""


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
    sensors = recording.sensors()
    check_copies(sensors, recording.usable, recording.manifest.path)
    return list(sensors), _faultless(recording, np.stack(list(sensors.values())), welch)


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


@dataclass(frozen=True)
class Speeds:
    """Speeds of the segments that one estimate averages, as a quadrature with weights of sum 1."""

    m_per_s: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean speed, [m/s]."""
        return sum(v * weight for v, weight in zip(self.m_per_s, self.weights, strict=True))

    @classmethod
    def of(cls, mean_m_per_s: float, deviation_m_per_s: float) -> Speeds:
        """Return three-point Gauss-Hermite quadrature, exact to the fifth moment of a normal."""
        if not deviation_m_per_s > NEGLIGIBLE * mean_m_per_s:
            return cls((mean_m_per_s,), (1.0,))
        step = math.sqrt(3) * deviation_m_per_s
        nodes = (mean_m_per_s - step, mean_m_per_s, mean_m_per_s + step)
        return cls(nodes, (1 / 6, 2 / 3, 1 / 6))


@dataclass(frozen=True)
class SpeedRange:
    """Range of speeds, and direction of travel, that one model reads."""

    low_m_per_s: float
    high_m_per_s: float
    direction: Direction = FORWARD

    @classmethod
    def around(cls, trained_m_per_s: float, half_width: float) -> SpeedRange:
        """Return the speeds within 1 +- `half_width` of that of the training curves."""
        return cls(trained_m_per_s * (1 - half_width), trained_m_per_s * (1 + half_width))

    @classmethod
    def read_by(cls, setting: float | Sequence[float], half_width: float) -> SpeedRange:
        """Return the speeds that the models trained with a setting `speed_m_per_s` read."""
        if isinstance(setting, float | int):
            return cls.around(setting, half_width)
        return cls(min(setting), max(setting))

    @property
    def trained_m_per_s(self) -> float:
        """Speed of the training curves, the middle of the range."""
        return (self.low_m_per_s + self.high_m_per_s) / 2

    @property
    def half_width(self) -> float:
        """Half width relative to the middle, [-]."""
        return (self.high_m_per_s - self.low_m_per_s) / (self.high_m_per_s + self.low_m_per_s)

    @property
    def name(self) -> str:
        """Name of the folder of the range's model."""
        end = "_reverse" if self.direction == REVERSE else ""
        return f"{self.low_m_per_s:.1f}_to_{self.high_m_per_s:.1f}_m_per_s{end}"

    def holds(self, speed_m_per_s: float) -> bool:
        """Return whether a speed is in the range, including its ends with rounding."""
        low, high = self.low_m_per_s, self.high_m_per_s
        return low * (1 - ROUNDING) <= speed_m_per_s <= high * (1 + ROUNDING)


def reading_range(speed_m_per_s: float, ranges: Iterable[SpeedRange]) -> SpeedRange | None:
    """Return the range that contains a speed, by the nearest middle; None if there is none."""
    holding = [speeds for speeds in ranges if speeds.holds(speed_m_per_s)]
    return min(
        holding,
        key=lambda speeds: abs(math.log(speed_m_per_s / speeds.trained_m_per_s)),
        default=None,
    )


def range_words(ranges: Iterable[SpeedRange]) -> str:
    """Return the union of some ranges as text.

    >>> range_words([SpeedRange(70, 80), SpeedRange(60, 70), SpeedRange(20, 25)])
    '20.0 to 25.0 and 60.0 to 80.0 m/s'
    """
    joined: list[SpeedRange] = []
    for speeds in sorted(ranges, key=lambda speeds: speeds.low_m_per_s):
        if joined and joined[-1].holds(speeds.low_m_per_s):
            high = max(joined[-1].high_m_per_s, speeds.high_m_per_s)
            joined[-1] = SpeedRange(joined[-1].low_m_per_s, high)
        else:
            joined.append(speeds)
    words = (
        Finding("range", low=speeds.low_m_per_s, high=speeds.high_m_per_s) for speeds in joined
    )
    return Finding("metres-per-second", words=together(words, " and "))


def covering(speeds: Sequence[float], half_width: float) -> float | list[float]:
    """Return the setting `speed_m_per_s` whose models read all speeds, with a ``MARGIN``.

    One speed to a tenth where one model is enough, otherwise lowest and highest as whole numbers.
    `half_width` is that of the range of one model.

    >>> covering([69.8, 70.2], 0.08), covering([61.5, 77.2], 0.08)
    (70.0, [60.0, 79.0])
    """
    low, high = min(speeds) / (1 + MARGIN), max(speeds) * (1 + MARGIN)
    middle = round((low + high) / 2, 1)
    reads = SpeedRange.around(middle, half_width)
    if reads.holds(low) and reads.holds(high):
        return middle
    return [float(math.floor(low)) or low, float(math.ceil(high))]


def setting_words(setting: float | Sequence[float]) -> str:
    """Return a setting of speeds as on the command line.

    >>> setting_words(70.0), setting_words([60.0, 79.0])
    ('speed_m_per_s=70', 'speed_m_per_s=[60,79]')
    """
    if isinstance(setting, float | int):
        return f"speed_m_per_s={setting:g}"
    return f"speed_m_per_s=[{','.join(f'{speed:g}' for speed in setting)}]"
