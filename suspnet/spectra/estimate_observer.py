"""Estimates as trips of a generator's vehicles would give them: their mean, draws, covariance.

The spectra of the three sensors follow from the track, the speed and the vehicle. Their estimate
from n independent averages is a complex Wishart matrix over n, whose mean is the true matrix
smeared over neighbouring bins by the window. The estimator that the recording goes through is
applied to draws of it: bias (H1 in noise), leakage and the noise of each bin are those of the trip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from suspnet.dynamics import PARAMETERS, ResponseGenerator
from suspnet.dynamics.track import acceleration_density, track_spectrum
from suspnet.ground.tensors import squared_size
from suspnet.ground.types import FloatArray
from suspnet.spectra.cross_spectra import PAIRS, CrossSpectra, moving_average_with, sample_spectra
from suspnet.spectra.expected_spectra import EstimateMisfit
from suspnet.spectra.observation import Directions, directions
from suspnet.spectra.speeds import Speeds

if TYPE_CHECKING:
    from suspnet.spectra.estimates import EstimateSettings

Responses = Callable[[Tensor, Tensor], Tensor]
SPEED = len(PARAMETERS)
"""Column of the speed in ratios that hold it."""
WEAK, WEAK_OF_ONE = 4.0, 0.5
"""A bin is weak if the deviation of the healthy vehicle's log-response exceeds this multiple of the
median over the band and, times the root of the number of averages, this number: its estimate is a
ratio of two nearly vanishing spectra and has the tails of one."""
SMOOTHED_BINS = 5
"""Number of neighbouring bins over which a trip's measured covariance is averaged."""
WIDE_BAND_LOW_HZ, WIDE_BAND_POINTS = 0.1, 4000
"""Lowest frequency [Hz] and number of points of the integral that gives a channel's rms."""


class EstimateObserver:
    """Estimates of G_p and G_s, as trips of a generator's vehicles would give them.

    Parameters
    ----------
    settings : EstimateSettings
        Bound to a vehicle.
    generator : ResponseGenerator
    speeds : Speeds, optional
        Of a trip; None is that of the settings, and of generators that depend on none.
    """

    def __init__(
        self,
        settings: EstimateSettings,
        generator: ResponseGenerator,
        speeds: Speeds | None = None,
    ) -> None:
        self.settings = settings
        self.generator = generator
        nominal = generator.speed_m_per_s
        if nominal is None:
            speeds = None
        elif speeds is not None:
            relative = tuple(speed / nominal for speed in speeds.m_per_s)
            speeds = None if relative == (1.0,) else replace(speeds, m_per_s=relative)
        self._relative = speeds
        welch = settings.welch
        self.frequencies_hz = settings.frequencies_hz()
        self._smear = welch.smear()
        self._correlating = moving_average_with(welch.correlation().numpy())
        more = torch.arange(1, len(self._smear) // 2 + 1, dtype=torch.float64) / welch.segment_s
        bins = self.frequencies_hz
        self._bins = torch.cat([bins[0] - more.flip(0), bins, bins[-1] + more])
        self._spectrum = track_spectrum(settings.track, settings.short_waves)
        self._track = self._density_at(1.0)

    def at(self, speeds: Speeds) -> EstimateObserver:
        """Return the observer of a trip at other speeds.

        Noise densities and directions are those of the nominal speed.
        """
        observer = EstimateObserver(self.settings, self.generator, speeds)
        if observer._relative is None:
            return self._nominal
        observer._nominal = self._nominal
        return observer

    @cached_property
    def _nominal(self) -> EstimateObserver:
        """The observer at the speed of the settings."""
        if self._relative is None:
            return self
        return EstimateObserver(self.settings, self.generator)

    @cached_property
    def _noise(self) -> Tensor:
        """Noise density of each sensor, (3,), [(m/s^2)^2/Hz]."""
        if self._nominal is not self:
            return self._nominal._noise
        return self.noise_densities(self._gains, self.settings.rates_hz)

    @cached_property
    def _healthy(self) -> CrossSpectra:
        """Expected spectra of the healthy vehicle, (1, 3, n_freq)."""
        return self.expected(torch.ones(1, len(PARAMETERS), dtype=torch.float64))

    @cached_property
    def weak(self) -> Tensor:
        """Which bins in use are `WEAK` in the healthy vehicle, bool (2, n_freq).

        At f = v / (2 wheelbase) a bogie's axles move against each other: it does not bounce, and
        the body is an instrument of nothing.
        """
        covariance = self._healthy.covariance(self.settings.method)
        deviations = covariance[0].diagonal().T.real.clamp(min=0).sqrt()
        used = deviations.masked_fill(self.beyond, math.nan)
        weak = deviations > WEAK * used.nanmedian(dim=1, keepdim=True).values
        weak &= deviations * math.sqrt(self.settings.n_averages) > WEAK_OF_ONE
        return weak & ~self.beyond

    @cached_property
    def beyond(self) -> Tensor:
        """Which bins lie beyond `body_high_hz`, where G_s is not used, bool (2, n_freq)."""
        return self.settings.beyond(self.frequencies_hz)

    def for_features(self, curves: Tensor) -> Tensor:
        """Return estimates as the feature set is to see them: of the nominal speed, none weak.

        G is multiplied by G_healthy at the nominal speed over G_healthy at the trip's. Of what is
        left relative to healthy a weak bin gets the straight line between its neighbours. G_s
        beyond `body_high_hz` is that of the healthy vehicle.

        Parameters
        ----------
        curves : complex tensor of shape (n_curves, 2, n_freq), [-]
        """
        if self._relative is None and not bool((self.weak | self.beyond).any()):
            return curves
        method = self.settings.method
        relative = curves / self._healthy.responses(method).to(curves)
        relative = relative.masked_fill(self.beyond.to(curves.device), 1.0)
        parts = [_bridged(relative[:, i], weak) for i, weak in enumerate(self.weak.to("cpu"))]
        return torch.stack(parts, dim=1) * self._nominal._healthy.responses(method).to(curves)

    @cached_property
    def directions(self) -> Directions:
        """The directions of the generator's uncertain numbers that its curves show."""
        return directions(self) if self._nominal is self else self._nominal.directions

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return the limit of the estimate of G_p and G_s for infinitely long trips.

        It includes leakage, and the bias of H1, H2 and Hv by the sensors' noise.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5), [-]

        Returns
        -------
        complex tensor of shape (n_vehicles, 2, n_freq), [-]
        """
        return self.expected(ratios).responses(self.settings.method)

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return estimates of G_p and G_s, one trip of each vehicle.

        The generator's uncertain quantities are drawn too.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5), [-]
        seed : int

        Returns
        -------
        complex tensor of shape (n_vehicles, 2, n_freq), [-]
        """
        unmeasured, noise = np.random.SeedSequence(seed).generate_state(2, np.uint64)
        rows = self.generator.sample_unmeasured(ratios, int(unmeasured >> np.uint64(1)))
        expected = self.expected(rows)
        source = torch.Generator(expected.auto.device).manual_seed(int(noise >> np.uint64(1)))
        return self._drawn(expected, source)

    def observe_again(self, spectra: CrossSpectra, n_draws: int, seed: int) -> Tensor:
        """Return estimates of further trips with the same spectra and as many averages.

        Parameters
        ----------
        spectra : CrossSpectra
            Of shape (3, n_freq) on the observer's bins.
        n_draws : int
        seed : int

        Returns
        -------
        complex tensor of shape (n_draws, 2, n_freq), [-]
        """
        auto, cross = (part.expand(n_draws, -1, -1) for part in (spectra.auto, spectra.cross))
        source = torch.Generator(auto.device).manual_seed(seed)
        return self._drawn(CrossSpectra(auto, cross, spectra.n_averages), source)

    def _drawn(self, mean: CrossSpectra, source: torch.Generator) -> Tensor:
        """Return the estimates of G_p and G_s from a draw of averaged spectra about their mean."""
        return sample_spectra(mean, self._correlating, source).responses(self.settings.method)

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> EstimateMisfit:
        """Return the misfit of estimates (n, 2, n_freq), their covariance that of vehicles `near`.

        Both responses are used, whatever `used` says.
        """
        covariance = self.without_unused(self.covariance(near.to(curves.device)))
        return EstimateMisfit(self, curves, covariance)

    def measured_misfit(self, spectra: CrossSpectra) -> EstimateMisfit:
        """Return the misfit of one trip's spectra (3, n_freq), with the covariance that they show.

        Its numerators are smoothed over bins.
        """
        method = self.settings.method
        residual, scale = spectra.covariance_parts(method)
        covariance = _smoothed(residual) / scale
        # the inverse of a measured covariance, 2 x 2 from n averages, is too large by n / (n - 2)
        n = spectra.n_averages * _independent(self.settings.welch.correlation())
        covariance = self.without_unused((covariance * n / (n - 2))[None])
        return EstimateMisfit(self, spectra.responses(method)[None], covariance)

    def without_unused(self, covariance: Tensor) -> Tensor:
        """Return a covariance of log-responses in which bins `weak` or `beyond` count for nothing.

        Parameters
        ----------
        covariance : complex tensor of shape (n_vehicles, 2, 2, n_freq)

        Returns
        -------
        complex tensor of shape (n_vehicles, 2, 2, n_freq)
            With infinite variance and no covariance where an estimate is not to be used.
        """
        unused = (self.weak | self.beyond).to(covariance.device)
        covariance = covariance.masked_fill(unused[:, None] | unused[None], 0.0)
        return covariance.masked_fill(torch.diag_embed(unused.T).permute(1, 2, 0), math.inf)

    def covariance(self, ratios: Tensor) -> Tensor:
        """Return the covariance of one trip's (log G_p, log G_s), (n_vehicles, 2, 2, n_freq)."""
        return self.expected(ratios).covariance(self.settings.method)

    def track_density(self, frequencies_hz: FloatArray) -> FloatArray:
        """Return the power density of the axle box's acceleration, [(m/s^2)^2/Hz].

        Parameters
        ----------
        frequencies_hz : array of shape (n_freq,), [Hz]
        """
        return acceleration_density(self._spectrum, frequencies_hz, self.settings.speed_m_per_s)

    def noise_densities(self, responses: Responses, rates_hz: Sequence[float]) -> Tensor:
        """Return the noise density of each of some sensors: see `snr_db`.

        Parameters
        ----------
        responses : function
            Of ratios (1, 5) and frequencies_hz (n,); returns each sensor's response from the axle
            box, (1, n_sensors, n).
        rates_hz : sequence of n_sensors floats, [Hz]

        Returns
        -------
        tensor of shape (n_sensors,), [(m/s^2)^2/Hz]
        """
        densities = []
        healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
        for sensor, rate_hz in enumerate(rates_hz):
            grid = np.geomspace(WIDE_BAND_LOW_HZ, rate_hz / 2, WIDE_BAND_POINTS)
            response = responses(healthy, torch.as_tensor(grid))[0, sensor]
            gain = response.abs().square().cpu().numpy()
            power = np.trapezoid(gain * self.track_density(grid), grid)
            densities.append(10 ** (-self.settings.snr_db / 10) * power / (rate_hz / 2))
        return torch.tensor(densities, dtype=torch.float64)

    def expected(self, ratios: Tensor) -> CrossSpectra:
        """Return the mean of the estimated spectra of each vehicle, (n_vehicles, 3, n_freq)."""
        if self._relative is None:
            auto, cross = self._spectra(ratios, self._track)
        else:
            ratios = torch.as_tensor(ratios)
            pairs = zip(self._relative.m_per_s, self._relative.weights, strict=True)
            found = [self._spectra(*self._at_speed(ratios, v, w)) for v, w in pairs]
            auto, cross = (torch.stack(parts).sum(dim=0) for parts in zip(*found, strict=True))
        noise = self._noise.to(auto)[:, None]
        return CrossSpectra(
            self._smeared(auto) + noise, self._smeared(cross), self.settings.n_averages
        )

    def _at_speed(self, ratios: Tensor, relative: float, weight: float) -> tuple[Tensor, Tensor]:
        """Return ratios with a speed, relative to nominal, and the track's weighted density."""
        speed = ratios.new_full((len(ratios), 1), relative)
        if ratios.shape[1] > SPEED:
            speed = speed * ratios[:, SPEED : SPEED + 1]
        columns = [ratios[:, :SPEED], speed, ratios[:, SPEED + 1 :]]
        return torch.cat(columns, dim=1), weight * self._density_at(relative)

    def _density_at(self, relative: float) -> Tensor:
        """Return the track's density at a speed relative to that of the settings, on all bins."""
        speed = self.settings.speed_m_per_s * relative
        return torch.as_tensor(acceleration_density(self._spectrum, self._bins.numpy(), speed))

    def _spectra(self, ratios: Tensor, density: Tensor) -> tuple[Tensor, Tensor]:
        """Return auto and cross spectra without leakage and noise, on all bins."""
        channels = self.generator.channels(ratios, self._bins)
        track = density.to(channels.device)
        auto = squared_size(channels).sum(dim=1) * track
        pairs = [(channels[:, :, x].conj() * channels[:, :, y]).sum(dim=1) for x, y in PAIRS]
        return auto, torch.stack(pairs, dim=1) * track

    def _smeared(self, spectra: Tensor) -> Tensor:
        """Return spectra on the inner bins, each the weighted sum of its neighbours."""
        n_inner = spectra.shape[-1] - len(self._smear) + 1
        return sum(  # type: ignore[return-value]
            float(w) * spectra[..., k : k + n_inner] for k, w in enumerate(self._smear)
        )

    def _gains(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return the root of each channel's power over that of the mean track, (n, 3, n_freq)."""
        channels = self.generator.channels(ratios, frequencies_hz)
        return channels.abs().square().sum(dim=1).sqrt()


def _bridged(relative: Tensor, weak: Tensor) -> Tensor:
    """Return rows (n, n_freq) with weak bins interpolated; beyond the last good one, its value."""
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


def _smoothed(covariance: Tensor) -> Tensor:
    """Return the moving average over bins of a covariance (2, 2, n_freq)."""
    half = SMOOTHED_BINS // 2
    ends = [covariance[..., :1].expand(2, 2, half), covariance[..., -1:].expand(2, 2, half)]
    return torch.cat([ends[0], covariance, ends[1]], dim=-1).unfold(-1, SMOOTHED_BINS, 1).mean(-1)


def _independent(correlation: Tensor) -> float:
    """Return how many of the smoothed bins are independent, by their correlation from lag 0 on."""
    lags = torch.arange(len(correlation))
    pairs = (SMOOTHED_BINS - lags).clamp(min=0) * torch.where(lags == 0, 1, 2)
    return SMOOTHED_BINS**2 / float(pairs.to(correlation) @ correlation)
