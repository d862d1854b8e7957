"""The sum of squares of some trips, as a function of a bogie's numbers and parts.

It is that of `suspnet.trains.fits.bogie_fit`; `suspnet.trains.fits.bogie_search` finds its minimum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from suspnet.estimation.suspension_law import (
    DEVIATIONS,
    N_OF_TEMPERATURE,
    SLOPES,
    USUAL,
    beyond_pairs,
    by_dampers,
    follows,
)
from suspnet.ground.parameters import COMPONENTS, DAMPERS, PARAMETERS, Direction
from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_residuals import Residuals
from suspnet.trains.spectra.bogie_trip import BogieTrip, smallest_noise
from suspnet.trains.spectra.covariance_matching import matched_noise, misfit_of
from suspnet.trains.spectra.damper_distortion import distortions
from suspnet.trains.spectra.model_errors import Explained, model_errors
from suspnet.trains.spectra.noise_subspace import Leakage, TripNoise, trip_noise
from suspnet.trains.spectra.subspace import SpectralMatrix
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import LOAD_DEVIATIONS, MASS_DEVIATION, MASS_MEAN, LogNormal

WEAR = 0.5
"""Standard deviation of the logarithm of a part's ratio before the trip: wide, as wear is."""
DAMPING_OF_TRIP = (0.02, 0.02)
"""Standard deviations of the logarithms that all c_p and all c_s differ by from trip to trip beyond
what temperature and speed do, where they are nonlinear and healthy trips show no other. Without it
the slope of c_s over the speed was -0.95 in place of -0.2 on healthy trips whose speeds differ by
2.5 % (tests/rich_train.py, all, seed 7), and c_s was read 14 % too small where a spring had
worn."""
UNEVEN = 0.3
"""Standard deviation, before a trip, of the cross level that comes with the mean of both rails: it
is 0 if both are as rough. Where sensors do not outnumber the inputs, c_p would err by 20 % if the
left rail had 1.5 times the density of the right one."""
FURTHEST = 20.0
"""Largest coordinate of vehicles that are tried: logarithms of ratios, and deviations of priors."""
SEPARATE = np.eye(len(COMPONENTS))
EQUAL = np.array([[name.startswith(kind) for kind in PARAMETERS] for name in COMPONENTS], float)
"""Changes of the logarithms of ``COMPONENTS`` with each coordinate of a later trip: each part has a
coordinate, or all parts of a kind share one."""


def _input_spectra(spectra: SpectralMatrix, noise: Tensor, responses: Tensor) -> Tensor:
    """Return the spectra of the inputs, (n_freq, p, p), that explain a trip's spectra best.

    `noise` (n_freq, m, m) or (m,), `responses` (p, m, n_freq).
    """
    inputs = misfit_of(spectra, noise, len(responses)).inputs(responses)
    power, vectors = torch.linalg.eigh(inputs)
    positive: Tensor = vectors * power.clamp(min=0)[:, None] @ vectors.mH
    return positive


@dataclass(frozen=True)
class BogieMisfit:
    """The sum of squares of some trips: coordinates of z, then each trip's own numbers.

    `noises` are those of the trips' sensors as `misfit_of` takes them. Healthy trips have the
    logarithm of their mass as their own number, after those by which c_p and c_s of both bogies
    differ by chance if the vehicle has the part nonlinear_dampers, and one that says how uneven the
    rails are where sensors do not outnumber the inputs; others those that `ties` (13,
    n_tied) makes the logarithms of all parts and the mass from, the mass last. Where the vehicle
    has the part load, log(1 + where its centre is [m]) follows, of each direction of
    ``LOAD_DEVIATIONS``. `mass` is what the masses of the trips are expected about, the median of
    their prior. `conditions` (n_trips, 7) are those of the trips that their suspension depends on,
    None if it is that of the vehicle; its slopes (`suspnet.estimation.suspension_law`) are `slopes`
    (7,), or, None, follow z, in deviations from their prior. `errors` are those of the vehicle's
    responses (n_freq, n_sensors) [-], see `suspnet.trains.spectra.model_errors`. `chance` are the
    standard deviations by which c_p and c_s differ by chance. `faster` (n_trips, 12) are the
    logarithms of how much faster each of ``DAMPERS`` is than `conditions` say, None: not at all.
    """

    generator: SpatialVehicle
    noises: Sequence[Tensor]
    trips: Sequence[BogieTrip]
    are_healthy: bool
    mass: float = math.exp(MASS_MEAN)
    ties: FloatArray = field(default_factory=SEPARATE.copy)
    conditions: FloatArray | None = None
    slopes: FloatArray | None = None
    errors: Tensor | None = None
    chance: tuple[float, float] = DAMPING_OF_TRIP
    faster: FloatArray | None = None

    def __post_init__(self) -> None:
        for trip in self.trips:
            n = len(self.sensors_of(trip))
            # the same but for rounding, as of segments of other lengths
            bins = trip.frequencies_hz, self.frequencies_hz
            if len(bins[0]) != len(bins[1]) or not torch.allclose(*bins, rtol=0, atol=1e-9):
                raise ValueError("the trips must have the same bins")
            if trip.spectra.values.shape != (len(self.frequencies_hz), n, n):
                names = ", ".join(self.generator.places[i] for i in self.sensors_of(trip))
                raise ValueError(
                    f"the spectra must be {n} x {n} on {len(self.frequencies_hz)} bins for the "
                    f"sensors {names}, got {tuple(trip.spectra.values.shape)}"
                )

        shape = (len(self.frequencies_hz), len(self.generator.places))
        if self.errors is not None and self.errors.shape != shape:
            raise ValueError(
                f"the vehicle's errors are of {len(self.errors)} bins, the trips have {shape[0]}"
            )

    def sensors_of(self, trip: BogieTrip) -> list[int]:
        """Return the numbers of the vehicle's sensors that a trip has."""
        return trip.kept(self.generator.places)

    @property
    def frequencies_hz(self) -> Tensor:
        """Bins of all trips, (n_freq,)."""
        return self.trips[0].frequencies_hz

    @cached_property
    def numbers(self) -> LogNormal:
        """Distribution of the vehicle's uncertain numbers."""
        assert self.generator.distribution is not None
        return self.generator.distribution

    @property
    def n_numbers(self) -> int:
        """Number of the vehicle's uncertain numbers."""
        return len(self.numbers.names)

    @property
    def n_slopes(self) -> int:
        """Number of slopes of the suspension's law that the trips tell."""
        if self.conditions is None or self.slopes is not None:
            return 0
        return len(SLOPES) if self.has_speeds else N_OF_TEMPERATURE

    @property
    def n_shared(self) -> int:
        """Number of coordinates that all trips share."""
        return self.n_numbers + self.n_slopes

    @cached_property
    def _follows(self) -> FloatArray:
        """Whether a column follows each slope, (7, n_columns)."""
        return follows(self.generator.columns)

    @cached_property
    def _by_dampers(self) -> FloatArray:
        """By how much a column follows each slope by each damper's speed, (7, 12, n_columns)."""
        return by_dampers(self.generator.columns)

    def _slopes_at(self, x: FloatArray) -> FloatArray:
        """Return the slopes of the suspension's law, (7,), 0 where the trips do not tell them."""
        if self.slopes is not None:
            return self.slopes
        slopes, n = np.zeros(len(SLOPES)), self.n_slopes
        slopes[:n] = USUAL[:n] + DEVIATIONS[:n] * x[self.n_numbers : self.n_shared]
        return slopes

    @property
    def _own_ties(self) -> FloatArray:
        return self.ties[:, -1:] if self.are_healthy else self.ties

    @property
    def n_chance(self) -> int:
        """Number of coordinates of each trip that say how its dampers differ by chance."""
        return N_OF_TEMPERATURE if self.has_speeds else 0

    @cached_property
    def is_matched(self) -> bool:
        """Whether sensors are too few for inputs of any coherence: covariances are matched."""
        n_sensors = min(len(self.sensors_of(trip)) for trip in self.trips)
        return n_sensors <= len(self._inputs)

    @property
    def n_free(self) -> int:
        """Number of coordinates of each trip before those of its parts, uneven rails the last."""
        return self.n_chance + int(self.is_matched)

    @cached_property
    def _by_chance(self) -> FloatArray:
        """Changes of the columns' logarithms with dampers by chance, (n_chance, n_columns)."""
        changes = self._follows[: self.n_chance].copy()
        if not self.are_healthy:  # those of the measured bogie have coordinates of their own
            changes[:, : len(COMPONENTS)] = 0.0
        return changes

    @property
    def has_speeds(self) -> bool:
        """Whether the suspension depends on the speeds of the dampers."""
        return self.conditions is not None and "nonlinear_dampers" in self.generator.parts

    @property
    def _loads(self) -> list[int]:
        """Columns of where a trip's load is."""
        has_load = "load" in self.generator.parts
        return [self.generator.columns.index(name) for name in LOAD_DEVIATIONS if has_load]

    @property
    def n_load(self) -> int:
        """Number of coordinates of each trip that say what it carries: its mass and where."""
        return 1 + len(self._loads)

    @property
    def n_parts(self) -> int:
        """Number of coordinates of each trip that say what its springs and dampers are."""
        return self.n_free + len(self._own_ties.T) - 1

    @property
    def n_own(self) -> int:
        """Number of coordinates of each trip alone."""
        return self.n_parts + self.n_load

    @cached_property
    def all_bins(self) -> Tensor:
        """Numbers of all bins."""
        return torch.arange(len(self.frequencies_hz))

    @cached_property
    def _own(self) -> tuple[FloatArray, FloatArray]:
        """Prior mean and standard deviation of each trip's own numbers, (n_own,) each."""
        mean, deviation = np.zeros(self.n_own), np.full(self.n_own, WEAR)
        deviation[: self.n_chance] = self.chance[: self.n_chance]
        deviation[self.n_chance : self.n_free] = UNEVEN
        mean[self.n_parts] = math.log(self.mass)
        deviation[self.n_parts :] = (MASS_DEVIATION, *LOAD_DEVIATIONS.values())[: self.n_load]
        return mean, deviation

    def start(self, ratios: FloatArray | None = None) -> FloatArray:
        """Return the median vehicle with the trips' own numbers; None: nothing worn."""
        if ratios is None:
            own = np.tile(self._own[0], len(self.trips))
        else:
            nearest = np.linalg.lstsq(self._own_ties, np.log(ratios), rcond=None)[0]
            own = np.pad(nearest.astype(np.float64), (self.n_free, self.n_load - 1))
        return np.concatenate([np.zeros(self.n_shared), own])

    def with_parts(self, parts: Sequence[str], x: FloatArray) -> tuple[BogieMisfit, FloatArray]:
        """Return the sum for a vehicle with further parts, and x with these at their medians."""
        fit = replace(self, generator=self.generator.with_parts(parts))
        logs = np.zeros(fit.n_numbers)
        names = [fit.numbers.names.index(name) for name in self.numbers.names]
        logs[names] = self.numbers.factor @ x[: self.n_numbers]
        standard = np.linalg.lstsq(fit.numbers.factor, logs, rcond=None)[0]
        own = x[self.n_shared :].reshape(len(self.trips), -1)
        before, after = fit.n_parts - self.n_parts, fit.n_load - self.n_load
        own = np.pad(own, ((0, 0), (before, after)))
        slopes = np.pad(x[self.n_numbers : self.n_shared], (0, fit.n_slopes - self.n_slopes))
        return fit, np.concatenate([standard, slopes, own.ravel()])

    def of_trips(self, numbers: Sequence[int]) -> BogieMisfit:
        """Return the sum of squares of some of the trips."""
        noises = [self.noises[i] for i in numbers]
        conditions = None if self.conditions is None else self.conditions[list(numbers)]
        faster = None if self.faster is None else self.faster[list(numbers)]
        trips = [self.trips[i] for i in numbers]
        return replace(self, noises=noises, trips=trips, conditions=conditions, faster=faster)

    def at(self, spread: float, bins: Tensor) -> Residuals:
        """Return the residuals at chosen bins, where the model may err by that share of a signal.

        `bins` are numbers of ``frequencies_hz``.
        """
        subspaces = [
            misfit_of(
                trip.spectra.at(trip.of(bins)),
                noise if noise.ndim == 1 else noise[trip.of(bins)],
                len(self._inputs),
                self._spread_of(trip, spread, bins),
            )
            for trip, noise in zip(self.trips, self.noises, strict=True)
        ]
        return Residuals(self, bins, subspaces)

    def _spread_of(self, trip: BogieTrip, spread: float, bins: Tensor) -> float | Tensor:
        if self.errors is None:
            return spread
        learnt = self.errors[trip.of(bins)][:, self.sensors_of(trip)]
        return (spread**2 + trip.spectra.n_averages * learnt**2).sqrt()

    @cached_property
    def exact(self) -> Residuals:
        """Residuals at all bins, without errors of the model."""
        return self.at(0.0, self.all_bins)

    def rms(self, x: FloatArray) -> float:
        """Return the rms residual over that of the noise."""
        squares = [float(np.square(residuals).mean()) for residuals in self.exact.of_trips(x)]
        expected = [subspace.expected for subspace in self.exact.subspaces]
        return math.sqrt(float(np.mean(np.divide(squares, expected))))

    def prior(self, x: FloatArray) -> FloatArray:
        """Return the residuals of the priors, (n_coordinates,)."""
        mean = np.concatenate([np.zeros(self.n_shared), np.tile(self._own[0], len(self.trips))])
        residuals: FloatArray = (x - mean) / self.prior_deviations
        return residuals

    @cached_property
    def prior_deviations(self) -> FloatArray:
        """Standard deviations of the coordinates before any trip, (n_coordinates,)."""
        return np.concatenate([np.ones(self.n_shared), np.tile(self._own[1], len(self.trips))])

    def noise_at(self, x: FloatArray) -> list[TripNoise]:
        """Return the noise of each trip for the vehicle at x."""
        noises = []
        for i, (trip, noise) in enumerate(zip(self.trips, self.noises, strict=True)):
            start = noise if noise.ndim == 1 else smallest_noise(trip.spectra)
            bins = trip.of(self.all_bins)
            responses = self.responses(x, i, bins)
            spectra = trip.spectra.at(bins)
            if self.is_matched:
                at_bins = matched_noise(spectra, responses, start)
            else:
                bins_hz, rows = self.frequencies_hz[bins], self._rows(x, i)
                alone = self._of(trip).channels_alone(rows, bins_hz)[0]
                alone = alone[self._inputs][:, :, self.sensors_of(trip)]
                further = self._leakage(x, i, responses), self._forces(x, i)
                at_bins = trip_noise(spectra, responses, alone, start, *further)
            # bins that are left out have any noise
            matrix = torch.diag(at_bins.densities).to(at_bins.matrix)
            matrix = matrix.repeat(len(self.all_bins), 1, 1).index_copy(0, bins, at_bins.matrix)
            noises.append(replace(at_bins, matrix=matrix))
        return noises

    def _forces(self, x: FloatArray, i: int) -> Tensor:
        """Return what incoherent forces of both bogies' dampers do to the sensors of trip i.

        One for each kind of dampers and order, (n_forces, n_freq, m, m).
        """
        trip, used = self.trips[i], self.trips[i].of(self.all_bins)
        each = torch.eye(len(self.generator.columns), dtype=torch.float64)
        each = each[[self.generator.columns.index(name) for name in DAMPERS]]
        bins_hz = self.frequencies_hz[used]
        _, (changes,) = self._of(trip).channels_along(self._rows(x, i), bins_hz, each)
        changes = changes[:, self._inputs][:, :, self.sensors_of(trip)]
        kinds = [[j for j, name in enumerate(DAMPERS) if kind in name] for kind in ("c_p", "c_s")]
        motion = self._damper_motion(x, i)
        return distortions(self.frequencies_hz, *motion, changes, used, kinds)

    def _damper_motion(self, x: FloatArray, i: int) -> tuple[Tensor, Tensor]:
        """Return the responses of the dampers' velocities on trip i, and the spectra of its inputs.

        Shapes (n_freq, 12, p) and (n_freq, p, p). The inputs are those that the vehicle at x
        explains the trip best with.
        """
        trip, bins_hz = self.trips[i], self.frequencies_hz
        responses = self._responses_at(x, i, bins_hz)
        inputs = _input_spectra(trip.spectra, self.noises[i], responses)
        used = trip.of(self.all_bins)  # what is left out is like the nearest bin
        inputs = inputs[used[(self.all_bins[:, None] - used).abs().argmin(dim=1)]]
        strokes = self._of(trip).strokes(self._rows(x, i), bins_hz)[0, self._inputs]
        strokes = self._on_rails(x, i, strokes).permute(2, 1, 0)
        return strokes / (2j * torch.pi * bins_hz[:, None, None]), inputs

    def _leakage(self, x: FloatArray, i: int, responses: Tensor) -> Leakage | None:
        """Return what the bins of trip i, whose responses those are, take from others.

        These are their neighbours, and speeds one standard deviation off the trip's mean.
        """
        trip, weights, beside = self.trips[i], [], []
        bins_hz = self.frequencies_hz[trip.of(self.all_bins)]
        if trip.welch is not None:
            smear = trip.welch.smear(trip.n_bins)
            taps = torch.arange(len(smear)) - len(smear) // 2
            away = taps[taps != 0]
            weights.append(smear[taps != 0])
            # all neighbours of all bins at once: a call has its price
            beside_hz = bins_hz + away[:, None] / trip.welch.segment_s
            every = self._responses_at(x, i, beside_hz.flatten()).unflatten(-1, beside_hz.shape)
            beside.append(every.movedim(2, 0))
        if trip.speed_scatter:
            weights.append(torch.full((2,), 0.5, dtype=torch.float64))
            for off in (-trip.speed_scatter, trip.speed_scatter):
                speed = trip.speed_m_per_s * (1 + off)
                vehicle = replace(self._of(trip), speed_m_per_s=speed, speed_scatter=0.0)
                beside.append(self._responses_at(x, i, bins_hz, vehicle)[None])
        return Leakage(torch.cat(weights), torch.cat(beside) - responses) if beside else None

    def with_noise_at(self, x: FloatArray) -> BogieMisfit:
        """Return the fit with the noise of each trip for the vehicle at x."""
        return replace(self, noises=[noise.matrix for noise in self.noise_at(x)])

    def as_expected(self, x: FloatArray) -> BogieMisfit:
        """Return the fit with the spectra that trips of the vehicle at x have, and their noise.

        The inputs are those that it explains the trips best with.
        """
        fit, trips = self.with_noise_at(x), []
        for i, (trip, noise) in enumerate(zip(self.trips, fit.noises, strict=True)):
            # bins that are left out are as expected, too
            responses = self._responses_at(x, i, self.frequencies_hz)
            inputs = _input_spectra(trip.spectra, noise, responses)
            responses = responses.permute(2, 1, 0)
            values = responses @ inputs @ responses.mH + noise
            trips.append(replace(trip, spectra=replace(trip.spectra, values=values)))
        return replace(fit, trips=trips)

    def own_speeds(self, x: FloatArray) -> FloatArray:
        """Return the logarithm of the speed [m/s] of each of ``DAMPERS``, (n_trips, 12).

        0 if the suspension does not depend on them.
        """
        if not self.has_speeds:
            return np.zeros((len(self.trips), len(DAMPERS)))
        width_hz, every = float(self.frequencies_hz[:2].diff()), []
        for i, trip in enumerate(self.trips):
            velocities, inputs = self._damper_motion(x, i)
            power = (velocities @ inputs * velocities.conj()).real.sum(dim=2)
            every.append(power[trip.of(self.all_bins)].sum(dim=0) * width_hz)
        return np.asarray(np.log(torch.stack(every).numpy()) / 2)

    def with_own_speeds(self, x: FloatArray) -> BogieMisfit:
        """Return the fit of healthy trips with each damper at its own speed, as at x."""
        if self.conditions is None or not self.has_speeds:
            return self
        own = self.own_speeds(x)
        return replace(self, faster=beyond_pairs(own - own.mean(axis=0), self.conditions))

    def with_errors_at(self, x: FloatArray) -> BogieMisfit:
        """Return the fit with noise, and errors of the model that the trips show, at x."""
        fit = self.with_noise_at(x)
        trips = []
        for i, trip in enumerate(self.trips):
            bins = trip.of(self.all_bins)
            spectra, noise = trip.spectra.at(bins), fit.noises[i][bins].to(torch.complex128)
            responses = self.responses(x, i, self.all_bins)
            trips.append(Explained(spectra, noise, responses, bins, self.sensors_of(trip)))
        errors = model_errors(self.frequencies_hz, trips, self.errors, len(self.generator.places))
        return replace(fit, errors=errors)

    def by_slopes(self, i: int) -> FloatArray:
        """Return the changes of the logarithms of the columns on trip i with each slope.

        Shape (n_slopes, n_columns).
        """
        n = self.n_slopes
        if self.conditions is None:
            return self._follows[:n]
        return DEVIATIONS[:n, None] * self._conditions_of(i)[:n]

    def _conditions_of(self, i: int) -> FloatArray:
        """Return what each slope is multiplied by for each column on trip i, (7, n_columns)."""
        assert self.conditions is not None
        factors: FloatArray = self.conditions[i][:, None] * self._follows
        return factors if self.faster is None else factors + self.faster[i] @ self._by_dampers

    @cached_property
    def _inputs(self) -> list[int]:
        """Numbers of the inputs that drive all wheelsets and reach the sensors.

        Sensors in the middle of a vehicle of equal sides measure the mean of both rails alone.
        """
        is_mean = self.generator.in_middle
        alone = ("wheelset", "cross_level", "alignment") if is_mean else ("wheelset",)
        return [i for i, name in enumerate(self.generator.inputs) if not name.startswith(alone)]

    @cached_property
    def _vehicles(self) -> dict[tuple[float, float, Direction], SpatialVehicle]:
        """Vehicles at the trips' speeds: making one takes as long as a tenth of an evaluation."""
        conditions = {(t.speed_m_per_s, t.speed_scatter, t.direction) for t in self.trips}
        return {
            (speed, scatter, direction): replace(
                self.generator, speed_m_per_s=speed, speed_scatter=scatter
            ).running(direction)
            for speed, scatter, direction in conditions
        }

    def _of(self, trip: BogieTrip) -> SpatialVehicle:
        return self._vehicles[trip.speed_m_per_s, trip.speed_scatter, trip.direction]

    def _rows(self, x: FloatArray, i: int) -> Tensor:
        """Return all columns of ratios of trip i, (1, n_columns)."""
        alike, factors = self._alike_rows(x, i)
        return alike * factors

    def _alike_rows(self, x: FloatArray, i: int) -> tuple[Tensor, Tensor]:
        """Return all columns of ratios of trip i, (1, n_columns), as on the healthy trips.

        That is under their conditions; then by what the trip's own ones multiply each column.
        """
        x = np.clip(x, -FURTHEST, FURTHEST)  # a step from afar may overflow
        own = x[self.n_shared :].reshape(len(self.trips), -1)[i]
        free, tied, loads = np.split(own, [self.n_free, self.n_parts + 1])
        numbers = self.numbers.ratios(x[None, : self.n_numbers])
        parts = torch.as_tensor(np.exp(self._own_ties @ tied))[None]
        rows = self.generator.with_uncertain(parts, torch.as_tensor(numbers))
        rows[:, self._loads] = torch.as_tensor(np.expm1(loads))
        if self.conditions is None:
            return rows, torch.ones_like(rows)
        logs = self._slopes_at(x) @ self._conditions_of(i)
        factors = torch.as_tensor(np.exp(logs + free[: self.n_chance] @ self._by_chance))
        # a loss below 0, which is none, does not change
        return rows, torch.where(rows > 0, factors, 1.0)

    def responses(self, x: FloatArray, i: int, bins: Tensor) -> Tensor:
        """Return the responses of trip i's sensors to the inputs, (p, m, n_freq)."""
        return self._responses_at(x, i, self.frequencies_hz[self.trips[i].of(bins)])

    def _responses_at(
        self, x: FloatArray, i: int, frequencies_hz: Tensor, vehicle: SpatialVehicle | None = None
    ) -> Tensor:
        trip = self.trips[i]
        vehicle = vehicle or self._of(trip)
        every = vehicle.channels(self._rows(x, i), frequencies_hz)[0, self._inputs]
        return self._on_rails(x, i, every[:, self.sensors_of(trip)])

    def _on_rails(self, x: FloatArray, i: int, by_input: Tensor) -> Tensor:
        """Return what each input (..., p, m, n_freq) does if one rail is rougher than the other.

        The mean of both brings the cross level that is coherent with it.
        """
        if not self.is_matched:
            return by_input
        share = x[self.n_shared + self.n_own * i + self.n_chance]
        first = by_input[..., :1, :, :] + share * by_input[..., 1:2, :, :]
        return torch.cat([first, by_input[..., 1:, :, :]], dim=-3)

    @cached_property
    def _directions(self) -> Tensor:
        """Changes of the logarithms of the columns with each coordinate, (n, n_columns).

        Those of slopes and of dampers by chance, which depend on the trip, are left 0.
        """
        n, shared, columns = self.n_numbers, self.n_shared, self.generator.uncertain_columns
        directions = torch.zeros(
            shared + self.n_own, len(self.generator.columns), dtype=torch.float64
        )
        directions[:n, columns] = torch.tensor(self.numbers.factor.T.copy())
        n_free, n_tied = shared + self.n_free, shared + self.n_parts + 1
        directions[n_free:n_tied, : len(COMPONENTS)] = torch.as_tensor(self._own_ties.T)
        directions[range(n_tied, len(directions)), self._loads] = 1.0
        return directions

    def _directions_of(self, i: int, alike: Tensor, factors: Tensor) -> Tensor:
        """Return the directions on a trip, whose suspension follows its own conditions.

        `alike` and `factors` are those of `_alike_rows`. With o added to a column r_0 before its
        logarithm is taken, and r = r_0 e^s, log(r + o) changes by e^s (r_0 + o) / (r + o) with
        log(r_0 + o), and by r / (r + o) with s.
        """
        if self.conditions is None:
            return self._directions
        rows, offsets = alike * factors, self.generator.offsets
        inner = torch.where(offsets > 0, factors * (alike + offsets) / (rows + offsets), 1.0)
        directions = self._directions * inner
        sizes = torch.as_tensor(np.concatenate([self.by_slopes(i), self._by_chance]))
        own = slice(self.n_numbers, self.n_shared + self.n_chance)
        directions[own] = sizes * rows.clamp(min=0) / (rows + offsets)
        return directions

    def responses_along(self, x: FloatArray, i: int, bins: Tensor) -> tuple[Tensor, Tensor]:
        """Return these responses, and their changes with each coordinate that affects the trip.

        The changes have shape (n_directions, p, m, n_freq).
        """
        trip, (alike, factors) = self.trips[i], self._alike_rows(x, i)
        directions = self._directions_of(i, alike[0], factors[0])
        bins_hz = self.frequencies_hz[trip.of(bins)]
        responses, changes = self._of(trip).channels_along(alike * factors, bins_hz, directions)
        inputs, sensors = self._inputs, self.sensors_of(trip)
        own, changes = responses[0, inputs][:, sensors], changes[0][:, inputs][:, :, sensors]
        changes = self._on_rails(x, i, changes)
        if self.is_matched:
            changes[self.n_shared + self.n_chance, 0] = own[1]
        return self._on_rails(x, i, own), changes
