"""Expected spectra of trips of a generator's vehicles, and the misfit of estimates to them.

The spectra of the three sensors follow from the track, the speed and the vehicle. The mean of their
estimate is the true spectrum, smeared over neighbouring bins by the window.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.cross_spectra import PAIRS
from suspnet.curves.speeds import Speeds
from suspnet.curves.welch import Welch
from suspnet.ground.tensors import as_tensor, complex_log, squared_size, threads
from suspnet.ground.types import FloatArray
from suspnet.vehicle import PARAMETERS, ResponseGenerator
from suspnet.vehicle.track import TrackSpectrum, acceleration_density

if TYPE_CHECKING:  # it makes the misfits
    from suspnet.curves.estimate_observer import EstimateObserver

OfFrequencies = Callable[[FloatArray], FloatArray]
SPEED = len(PARAMETERS)  # column of the relative speed in ratios that include it
WIDE_BAND_LOW_HZ, WIDE_BAND_POINTS = 0.1, 4000
"""Lowest frequency [Hz] and number of points of the integral that gives a channel's rms."""
IN_CACHE, AT_ONCE = 80_000, 4096
"""Complex numbers of each kind that are computed at once on a CPU, and vehicles at once elsewhere.
Fewer cost calls, and temporary arrays of more leave the cache."""
WEAK, WEAK_OF_ONE = 4.0, 0.5
"""A bin is weak if the standard deviation of the healthy vehicle's log-response exceeds 4 times its
median over the band, and 0.5 / sqrt(n_averages): the estimate is then a ratio of two nearly
vanishing spectra, with heavy tails."""


class ExpectedSpectra:
    """Mean of the estimated spectra of axle box, frame and body, without the sensors' noise.

    `relative` are the speeds of the trip over `speed_m_per_s`; None means that speed alone.
    """

    def __init__(
        self,
        generator: ResponseGenerator,
        welch: Welch,
        frequencies_hz: Tensor,
        track: TrackSpectrum,
        speed_m_per_s: float,
        relative: Speeds | None = None,
    ) -> None:
        self._generator, self._track, self._relative = generator, track, relative
        self._speed_m_per_s, self._smear = speed_m_per_s, welch.smear()
        # neighbours on either side leak into the outer bins as well
        more = torch.arange(1, len(self._smear) // 2 + 1, dtype=torch.float64) / welch.segment_s
        bins = frequencies_hz
        self._bins = torch.cat([bins[0] - more.flip(0), bins, bins[-1] + more])
        self._density = self._density_at(1.0)

    def __call__(self, ratios: Tensor) -> tuple[Tensor, Tensor]:
        """Return auto and cross spectra of each vehicle, each (n_vehicles, 3, n_freq)."""
        in_cache = max(1, IN_CACHE // (self._n_inputs * len(self._bins)))
        n_at_once = in_cache if self._generator.device == "cpu" else AT_ONCE
        blocks = [self._of(block) for block in as_tensor(ratios).split(n_at_once)]
        auto, cross = map(torch.cat, zip(*blocks, strict=True))
        return auto, cross

    @cached_property
    def _n_inputs(self) -> int:
        healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
        return self._generator.channels(healthy, self._bins[:1]).shape[1]

    def _of(self, ratios: Tensor) -> tuple[Tensor, Tensor]:
        if self._relative is None:
            auto, cross = self._spectra(ratios, self._density)
        else:
            pairs = zip(self._relative.m_per_s, self._relative.weights, strict=True)
            spectra = [self._spectra(*self._at_speed(ratios, v, w)) for v, w in pairs]
            auto, cross = (torch.stack(parts).sum(dim=0) for parts in zip(*spectra, strict=True))
        return self._smeared(auto), self._smeared(cross)

    def thinned(self, every: int) -> ExpectedSpectra:
        """Return the spectra on every n-th bin, at the mean speed, without leakage."""
        rough, n = copy(self), len(self._smear) // 2
        rough._bins, rough._smear = self._bins[n : len(self._bins) - n : every], torch.ones(1)
        if self._relative is not None:
            rough._relative = Speeds((self._relative.mean,), (1.0,))
        rough._density = rough._density_at(1.0)
        return rough

    @threads(1)
    def noise_densities(self, rates_hz: Sequence[float], snr_db: float) -> Tensor:
        """Return the noise densities of the three sensors, for the healthy vehicle's signals."""
        healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)

        def gains(grid: FloatArray) -> FloatArray:
            channels = self._generator.channels(healthy, torch.as_tensor(grid))[0]
            power: FloatArray = channels.abs().square().sum(dim=0).cpu().numpy()
            return power

        def density(grid: FloatArray) -> FloatArray:
            return acceleration_density(self._track, grid, self._speed_m_per_s)

        return noise_densities(gains, density, rates_hz, snr_db)

    def _at_speed(self, ratios: Tensor, relative: float, weight: float) -> tuple[Tensor, Tensor]:
        """Return ratios with the relative speed as a column, and the track's weighted density."""
        speed = ratios.new_full((len(ratios), 1), relative)
        if ratios.shape[1] > SPEED:
            speed = speed * ratios[:, SPEED : SPEED + 1]
        columns = [ratios[:, :SPEED], speed, ratios[:, SPEED + 1 :]]
        return torch.cat(columns, dim=1), weight * self._density_at(relative)

    def _density_at(self, relative: float) -> Tensor:
        speed = self._speed_m_per_s * relative
        return torch.as_tensor(acceleration_density(self._track, self._bins.numpy(), speed))

    def _spectra(self, ratios: Tensor, density: Tensor) -> tuple[Tensor, Tensor]:
        """Return auto and cross spectra on all bins, without leakage, summed over the inputs."""
        channels = self._generator.channels(ratios, self._bins)
        track = density.to(channels.device)
        auto = squared_size(channels).sum(dim=1) * track
        pairs = [(channels[:, :, x].conj() * channels[:, :, y]).sum(dim=1) for x, y in PAIRS]
        return auto, torch.stack(pairs, dim=1) * track

    def _smeared(self, spectra: Tensor) -> Tensor:
        """Return spectra on the inner bins, each a weighted sum of its neighbours."""
        n_inner = spectra.shape[-1] - len(self._smear) + 1
        return sum(  # type: ignore[return-value]
            float(w) * spectra[..., k : k + n_inner] for k, w in enumerate(self._smear)
        )


def noise_densities(
    gains: OfFrequencies, density: OfFrequencies, rates_hz: Sequence[float], snr_db: float
) -> Tensor:
    """Return the noise density of sensors, (n_sensors,), [(m/s^2)^2/Hz].

    The noise is white, `snr_db` below the rms of the healthy vehicle's signal over the sensor's
    band. `gains` gives the density of the signals over that of the track, (n_sensors, n_freq).
    """
    noise = np.empty(len(rates_hz))
    for rate_hz in set(rates_hz):
        grid = np.geomspace(WIDE_BAND_LOW_HZ, rate_hz / 2, WIDE_BAND_POINTS)
        power = np.asarray(np.trapezoid(gains(grid) * density(grid), grid, axis=1))
        chosen = np.asarray(rates_hz) == rate_hz
        noise[chosen] = 10 ** (-snr_db / 10) * power[chosen] / (rate_hz / 2)
    return torch.as_tensor(noise)


@dataclass(frozen=True)
class EstimateMisfit:
    """Complex responses estimated from trips, with the covariance of their logarithms.

    With L L^H the covariance of (log G_p, log G_s) in a bin, u the difference of observed and
    expected logarithms and r = ``Welch.correlated_bins``, the residuals are real and imaginary part
    of L^-1 u sqrt(2 / r). `observed`: (n_rows, 2, n_freq); `covariance`: (n_rows, 2, 2, n_freq),
    infinite where an estimate is not used; `weight` is that of a bin.
    """

    observer: EstimateObserver
    observed: Tensor
    covariance: Tensor
    weight: float = 1.0

    @property
    def expected(self) -> float:
        """Mean square of a residual if the model is true: 1 / r times the fraction of used bins."""
        return self.weight * self._share / self.observer.settings.welch.correlated_bins

    def thinned(self) -> EstimateMisfit:
        """Return the misfit on every n-th bin, each with n times its weight."""
        observer = self.observer.thinned()
        steps = [either.frequencies_hz[:2].diff().sum() for either in (observer, self.observer)]
        every = max(1, round(float(steps[0] / steps[1])))
        observed, covariance = self.observed[..., ::every], self.covariance[..., ::every]
        return EstimateMisfit(observer, observed, covariance, self.weight * every)

    def __call__(self, ratios: Tensor, rows: Tensor) -> Tensor:
        """Return residuals (n, n_points) of the vehicles `ratios` (n, 5) to the estimates `rows`.

        The covariance is that of the observation and does not depend on the ratios.
        """
        u = complex_log(self.observed[rows] / self.observer.noise_free(ratios))
        return self.whitened(u, rows)

    def whitened(self, u: Tensor, rows: Tensor, spread: float | Tensor = 0.0) -> Tensor:
        """Return the residuals (n, n_points) of relative differences `u` (n, 2, n_freq).

        `rows` (n,) are the estimates they belong to. `spread`, a number or (n_freq,), is an rms
        model error allowed for in addition to the noise; where it is infinite the bin does not
        count.
        """
        covariance = self.covariance[rows]
        l_pp = (covariance[:, 0, 0].real + spread**2).sqrt()
        l_sp = covariance[:, 1, 0] / l_pp
        l_ss = (covariance[:, 1, 1].real + spread**2 - squared_size(l_sp)).sqrt()
        white_p = u[:, 0] / l_pp
        white_s = (u[:, 1] - l_sp * white_p) / l_ss
        parts = [white_p.real, white_p.imag, white_s.real, white_s.imag]
        scale = math.sqrt(2 * self.weight / self.observer.settings.welch.correlated_bins)
        return torch.stack(parts, dim=1).flatten(1) * scale

    @cached_property
    def _share(self) -> float:
        """Fraction of the estimates that are used, 1 if none is; residuals of others are 0."""
        used = self.covariance.diagonal(dim1=1, dim2=2).real.isfinite()
        return float(used.double().mean()) or 1.0


def weak_bins(covariance: Tensor, beyond: Tensor, n_averages: float) -> Tensor:
    """Return which bins are weak (see `WEAK`), bool (2, n_freq), from a log-response's covariance.

    `covariance`: (2, 2, n_freq) of the healthy vehicle; `beyond` (2, n_freq): bins not in use.
    """
    deviations = covariance.diagonal().T.real.clamp(min=0).sqrt()
    used = deviations.masked_fill(beyond, math.nan)
    weak = deviations > WEAK * used.nanmedian(dim=1, keepdim=True).values
    weak &= deviations * math.sqrt(n_averages) > WEAK_OF_ONE
    return weak & ~beyond


def bridged(relative: Tensor, weak: Tensor) -> Tensor:
    """Return rows (n, n_freq) with weak bins interpolated linearly, held constant at the ends."""
    good = torch.nonzero(~weak)[:, 0]
    if not bool(weak.any()) or not len(good):
        return relative
    bins = torch.arange(len(weak))
    after = torch.searchsorted(good, bins).clamp(max=len(good) - 1)
    right = good[after]
    left = torch.where(right > bins, good[(after - 1).clamp(min=0)], right)
    gap = (right - left).clamp(min=1)
    share = ((bins - left) / gap).clamp(0, 1).to(relative.device)
    return relative[:, left] + share * (relative[:, right] - relative[:, left])
