"""The paper's noisy curves (section III-B): magnitudes on a grid of bins, with white noise.

The rms of the noise is the curve's own rms times 10^(-SNR/20), so 34 dB is the 2 % sensor precision
of section III-E, 26 dB 5 % and 54 dB 0.2 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import torch
from torch import Tensor

from suspnet.curves.observation import (
    CACHE_FOLDER,
    MOST_BINS,
    CacheFolder,
    Counts,
    Directions,
    directions,
)
from suspnet.ground.settings import setting
from suspnet.vehicle import ResponseGenerator, Vehicle


@dataclass(frozen=True)
class CurveSettings(Counts):
    """Frequency bins, noise and numbers of curves."""

    kind: ClassVar[str] = "curves"

    snr_db: float = setting(
        34.0,
        "Signal-to-noise ratio of each curve; 34 dB is noise of 2 % of its rms",
        "dB",
        low=-20,
        high=200,
    )
    noise_on: Literal["magnitude", "decibel"] = setting(
        "magnitude",
        "What the noise is added to: the magnitudes, or their decibels, of which it is a share "
        "then",
    )
    low_hz: float = setting(0.1, "First frequency bin, at least step_hz", "Hz", above=0, most=10000)
    high_hz: float = setting(20.0, "Upper end of the bins, above low_hz", "Hz", above=0, most=10000)
    step_hz: float = setting(
        0.02,
        "Distance of the bins; at most 100,000 of them up to high_hz",
        "Hz",
        above=0,
        most=10000,
    )
    cache_dir: CacheFolder = CACHE_FOLDER

    def __post_init__(self) -> None:
        self.check()
        if not self.step_hz <= self.low_hz < self.high_hz:
            raise ValueError(
                "need data.step_hz <= data.low_hz < data.high_hz, got "
                f"{self.step_hz}, {self.low_hz}, {self.high_hz}"
            )
        if self.high_hz > MOST_BINS * self.step_hz:
            raise ValueError(
                f"data.step_hz={self.step_hz} makes more than {MOST_BINS} bins up to "
                f"data.high_hz={self.high_hz}; take wider ones"
            )

    def bound(self, vehicle: Vehicle) -> CurveSettings:
        """Return the same settings: none of them depends on the vehicle."""
        return self

    def observer(self, generator: ResponseGenerator) -> CurveObserver:
        """Return the observer that draws noisy magnitudes of a generator's vehicles."""
        return CurveObserver(self, generator)

    def frequencies_hz(self) -> Tensor:
        """Return the frequency bins, shape (n_freq,), [Hz]."""
        n_bins = math.floor((self.high_hz - self.low_hz) / self.step_hz + 1e-9) + 1
        return self.low_hz + self.step_hz * torch.arange(n_bins, dtype=torch.float64)

    @property
    def in_decibels(self) -> bool:
        """Whether the noise is added to the decibels of the magnitudes."""
        return self.noise_on == "decibel"


@dataclass(frozen=True)
class CurveObserver:
    """The observation of section III-B of the paper: magnitudes with white noise."""

    settings: CurveSettings
    generator: ResponseGenerator

    @property
    def frequencies_hz(self) -> Tensor:
        """Bins, shape (n_freq,), [Hz]."""
        return self.settings.frequencies_hz()

    @cached_property
    def directions(self) -> Directions:
        """Directions of the generator's uncertain numbers that affect its curves."""
        return directions(self)

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return abs(G_p) and abs(G_s), shape (n_vehicles, 2, n_freq), [-]."""
        return self.generator.magnitudes(ratios, self.frequencies_hz)

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return noisy magnitudes, with the generator's uncertain quantities drawn as well."""
        rows = self.generator.sample_unmeasured(ratios, seed)
        clean, snr_db = self.noise_free(rows), self.settings.snr_db
        if self.settings.in_decibels:
            return from_decibels(add_noise(decibels(clean), snr_db, seed))
        return add_noise(clean, snr_db, seed)

    def for_features(self, curves: Tensor) -> Tensor:
        """Return magnitudes unchanged."""
        return curves

    def thinned(self) -> CurveObserver:
        """Return the observer itself: there is no quicker one."""
        return self

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> CurveMisfit:
        """Return the misfit of observed magnitudes; the noise follows from their own rms."""
        return CurveMisfit(self, curves, tuple(used))


@dataclass(frozen=True)
class CurveMisfit:
    """Misfit of magnitudes with white noise, its rms relative to that of each observed curve.

    `observed`: (n_rows, 2, n_freq); `used` lists which of G_p (0) and G_s (1) enter.
    """

    observer: CurveObserver
    observed: Tensor
    used: Sequence[int] = (0, 1)
    expected: float = 1.0
    """Mean square of a residual if the model is true."""

    def thinned(self) -> CurveMisfit:
        """Return the misfit itself: there is no quicker one."""
        return self

    def __call__(self, ratios: Tensor, rows: Tensor) -> Tensor:
        """Return residuals (n, n_points) of the vehicles `ratios` (n, 5) to the curves `rows`."""
        observed = self.observed[rows][:, list(self.used)]
        expected = self.observer.noise_free(ratios)[:, list(self.used)]
        if self.observer.settings.in_decibels:
            observed, expected = decibels(observed), decibels(expected)
        rms = noise_rms(observed, self.observer.settings.snr_db)
        return ((observed - expected) / rms).flatten(1)


def decibels(magnitudes: Tensor) -> Tensor:
    """Return 20 log10 of magnitudes, [dB]."""
    return 20 * magnitudes.log10()


def from_decibels(levels: Tensor) -> Tensor:
    """Return the magnitudes of levels [dB], 10^(level / 20)."""
    return 10 ** (levels / 20)


def add_noise(magnitudes: Tensor, snr_db: float, seed: int) -> Tensor:
    """Return curves (..., n_freq) plus white Gaussian noise of rms = rms(curve) 10^(-SNR/20).

    The same seed on the same kind of device gives the same noise.
    """
    source = torch.Generator(magnitudes.device).manual_seed(seed)
    noise = torch.empty_like(magnitudes).normal_(generator=source)
    return noise.mul_(noise_rms(magnitudes, snr_db)).add_(magnitudes)


def noise_rms(magnitudes: Tensor, snr_db: float) -> Tensor:
    """Return the rms of the noise of each curve, shape (..., 1)."""
    return magnitudes.square().mean(dim=-1, keepdim=True).sqrt() * 10 ** (-snr_db / 20)
