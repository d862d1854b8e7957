"""Observer of simulated trips: draws transfer functions as a trip's estimates would be.

The averaged spectra of n independent averages follow a complex Wishart distribution about their
mean. The observer draws such spectra and applies the same estimator as to recordings, so its curves
have the bias (H1 in noise), the leakage and the noise that a trip gives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.curves import Directions, directions
from suspnet.curves.expected_spectra import EstimateMisfit, ExpectedSpectra, bridged, weak_bins
from suspnet.curves.speeds import Speeds
from suspnet.vehicle import PARAMETERS, ResponseGenerator
from suspnet.vehicle.track import track_spectrum

if TYPE_CHECKING:  # which creates the observer
    from suspnet.curves.estimates import EstimateSettings

LEAST_STRENGTH = 10.0
"""Least F statistic of an instrument on a trip (Staiger and Stock, Instrumental variables
regression with weak instruments, Econometrica, 1997). The vehicle's own wheelbase moves the bins in
which the body is no instrument away from those of the drawing."""
THINNED_HZ = 0.2
"""Distance of the bins of a search far off, to which neither more bins nor their leakage matter."""


class EstimateObserver:
    """Draws estimates of G_p and G_s as trips of a generator's vehicles would give them.

    `settings` must be bound to a vehicle. `speeds` are those of the trip; None means the speed of
    the settings, and is right for generators that do not depend on speed.
    """

    def __init__(
        self, settings: EstimateSettings, generator: ResponseGenerator, speeds: Speeds | None = None
    ) -> None:
        self.settings, self.generator, self._speeds = settings, generator, speeds
        self.frequencies_hz = settings.frequencies_hz()
        nominal = generator.speed_m_per_s
        relative = None
        if nominal is not None and speeds is not None:
            ratios = tuple(speed / nominal for speed in speeds.m_per_s)
            relative = None if ratios == (1.0,) else replace(speeds, m_per_s=ratios)
        self._is_nominal = relative is None
        self._correlating = moving_average_with(settings.welch.correlation().numpy())
        self._left_out = torch.zeros(len(self.frequencies_hz), dtype=torch.bool)
        how = settings.welch, self.frequencies_hz, track_spectrum(settings.track)
        self.mean = ExpectedSpectra(generator, *how, settings.speed_m_per_s, relative)

    def at(self, speeds: Speeds) -> EstimateObserver:
        """Return the observer of a trip at other speeds, with the noise of the nominal one."""
        observer = EstimateObserver(self.settings, self.generator, speeds)
        if observer._is_nominal:
            return self._nominal
        observer._nominal = self._nominal  # share what it has already computed
        return observer

    def of(self, generator: ResponseGenerator) -> EstimateObserver:
        """Return the observer of the same trip for vehicles of a similar generator."""
        return EstimateObserver(self.settings, generator, self._speeds).without(self._left_out)

    def thinned(self) -> EstimateObserver:
        """Return a quicker observer: bins ``THINNED_HZ`` apart, mean speed, no leakage."""
        every = max(1, round(THINNED_HZ * self.settings.segment_s))
        rough = EstimateObserver(self.settings, self.generator)
        rough._nominal = self._nominal  # of the same noise
        rough.mean, rough.frequencies_hz = self.mean.thinned(every), self.frequencies_hz[::every]
        rough._left_out = self._left_out[::every]
        return rough

    def without(self, bins: Tensor | None) -> EstimateObserver:
        """Return the observer of a trip some of whose bins, bool (n_freq,), are not to be used."""
        if bins is None or not bool(bins.any()):
            return self
        observer = copy(self)
        observer.__dict__.pop("weak", None)  # cached of the other
        observer._nominal, observer._is_nominal = self._nominal, False
        observer._left_out = bins
        return observer

    @cached_property
    def _nominal(self) -> EstimateObserver:
        return self if self._is_nominal else EstimateObserver(self.settings, self.generator)

    @cached_property
    def noise(self) -> Tensor:
        """Noise density of each sensor, (3,), [(m/s^2)^2/Hz]."""
        if self._nominal is not self:
            return self._nominal.noise
        return self.mean.noise_densities(self.settings.rates_hz, self.settings.snr_db)

    @cached_property
    def _healthy(self) -> CrossSpectra:
        """Expected spectra of the healthy vehicle, (1, 3, n_freq)."""
        return self.expected(torch.ones(1, len(PARAMETERS), dtype=torch.float64))

    @cached_property
    def weak(self) -> Tensor:
        """Which bins in use are weak (see `WEAK`) or left out, bool (2, n_freq).

        Near f = v / (2 wheelbase) the axles of a bogie move in antiphase: the bogie does not
        bounce, and the body is no useful instrument.
        """
        covariance = self._healthy.covariance(self.settings.method)[0]
        weak = weak_bins(covariance, self.beyond, self.settings.n_averages)
        return weak | (self._left_out & ~self.beyond)

    @cached_property
    def beyond(self) -> Tensor:
        """Which bins lie above `body_high_hz`, where G_s is not used, bool (2, n_freq)."""
        return self.settings.beyond(self.frequencies_hz)

    def for_features(self, curves: Tensor) -> Tensor:
        """Return estimates (n, 2, n_freq) mapped to the nominal speed, with weak bins interpolated.

        G is multiplied by G_healthy at the nominal speed over G_healthy at the trip's speed. The
        ratio to healthy is interpolated linearly over weak bins, and is 1 for G_s above
        `body_high_hz`.
        """
        if self._is_nominal and not bool((self.weak | self.beyond).any()):
            return curves
        method = self.settings.method
        relative = curves / self._healthy.responses(method).to(curves)
        relative = relative.masked_fill(self.beyond.to(curves.device), 1.0)
        parts = [bridged(relative[:, i], weak) for i, weak in enumerate(self.weak.to("cpu"))]
        return torch.stack(parts, dim=1) * self._nominal._healthy.responses(method).to(curves)

    @cached_property
    def directions(self) -> Directions:
        """Directions of the generator's uncertain numbers that affect its curves."""
        return directions(self) if self._is_nominal else self._nominal.directions

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return the limit of estimates for long trips: with leakage, and bias by noise."""
        return self.expected(ratios).responses(self.settings.method)

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return estimates from one trip of each vehicle, uncertain numbers drawn too."""
        unmeasured, noise = np.random.SeedSequence(seed).generate_state(2, np.uint64)
        rows = self.generator.sample_unmeasured(ratios, int(unmeasured >> np.uint64(1)))
        expected = self.expected(rows)
        source = torch.Generator(expected.auto.device).manual_seed(int(noise >> np.uint64(1)))
        return self._drawn(expected, source)

    def observe_again(self, spectra: CrossSpectra, n_draws: int, seed: int) -> Tensor:
        """Return `n_draws` estimates of trips with these mean spectra (3, n_freq)."""
        auto, cross = (part.expand(n_draws, -1, -1) for part in (spectra.auto, spectra.cross))
        source = torch.Generator(auto.device).manual_seed(seed)
        return self._drawn(CrossSpectra(auto, cross, spectra.n_averages), source)

    def _drawn(self, mean: CrossSpectra, source: torch.Generator) -> Tensor:
        return sample_spectra(mean, self._correlating, source).responses(self.settings.method)

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> EstimateMisfit:
        """Return the misfit of estimates (n, 2, n_freq), both responses, weighted as for `near`."""
        covariance = self.without_unused(self.covariance(near.to(curves.device)))
        return EstimateMisfit(self, curves, covariance)

    def measured_misfit(self, spectra: CrossSpectra) -> EstimateMisfit:
        """Return the misfit of one trip's spectra (3, n_freq), with their measured covariance."""
        method, correlation = self.settings.method, self.settings.welch.correlation()
        covariance = spectra.measured_covariance(method, correlation)
        is_weak = spectra.instrument_strength(method) < LEAST_STRENGTH
        responses = spectra.responses(method)[None]
        return EstimateMisfit(self, responses, self.without_unused(covariance[None], is_weak))

    def without_unused(self, covariance: Tensor, is_weak: Tensor | None = None) -> Tensor:
        """Return a covariance, infinite in bins that are `weak` or `beyond`, or weak in a trip."""
        unused = self.weak | self.beyond
        unused = (unused if is_weak is None else unused | is_weak).to(covariance.device)
        covariance = covariance.masked_fill(unused[:, None] | unused[None], 0.0)
        return covariance.masked_fill(torch.diag_embed(unused.T).permute(1, 2, 0), math.inf)

    def covariance(self, ratios: Tensor) -> Tensor:
        """Return the covariance of one trip's (log G_p, log G_s), (n_vehicles, 2, 2, n_freq)."""
        return self.expected(ratios).covariance(self.settings.method)

    def expected(self, ratios: Tensor) -> CrossSpectra:
        """Return the mean of the estimated spectra of each vehicle, (n_vehicles, 3, n_freq)."""
        auto, cross = self.mean(ratios)
        return CrossSpectra(auto + self.noise.to(auto)[:, None], cross, self.settings.n_averages)
