"""The search for a bogie's numbers and parts that explain the spectral matrices of some trips.

The sum of squares is that of `suspnet.trains.fits.bogie_fit`. Starting from the healthy vehicle,
model errors as large as each signal are allowed first, in bands that widen, then less and less: the
direct search ends in another valley. Where this one does not explain the trips either, a start with
errors of 30 % is tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from scipy.optimize import leastsq
from torch import Tensor

from suspnet.estimation.temperature import DAMPINGS, SLOPE_DEVIATION, USUAL_SLOPE
from suspnet.ground.parameters import COMPONENTS, PARAMETERS, Direction, kind_of
from suspnet.ground.types import FloatArray
from suspnet.trains.spectra.bogie_trip import BogieTrip, smallest_noise
from suspnet.trains.spectra.noise_subspace import TripNoise, trip_noise
from suspnet.trains.spectra.subspace import SubspaceMisfit
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import MASS_DEVIATION, MASS_MEAN, LogNormal

ROUGH, SPREADS = (1.0, 0.3), (0.3, 0.1, 0.03, 0.01, 0.003)
"""Model errors as fractions of each signal: those of a first search, another where it fails, and
those of the searches after it. Four sensors without axle boxes need the first, as 30 % ended in
another valley on two of three trains of tests/blind_train.py; 3 did so on pairs."""
WIDENING = 1.45
"""Ratio of the upper ends of the bands of the first searches."""
LOWEST_BANDS = 6
"""Number of bands of the first searches."""
ROUGH_SPACING_HZ = 0.5
"""Distance of the bins of searches that allow for errors."""
STEPS, ROUNDS = 64, 4
"""Most evaluations of one search, and how often the last one is continued. Trips of two payloads at
four speeds took up to 33 on 36 bins, healthy trips on soft ballast 70 on all."""
NEARLY_EXPLAINED = 1.5
"""Misfit over that of an explained trip up to which the last search is continued, and healthy trips
are not searched from another start: what is left is the physics, not another valley."""
SETTLED = 0.5
"""Step still to go, in deviations of the posterior, up to which a search counts as ended."""
WIDENING_TOL, WORN_TOLS, HEALTHY_TOLS = 1e-2, (1e-2, 1e-3), (1e-3, 1e-5)
"""Relative decreases of the cost that end a search: of the first bands, then of trips that may be
worn and of healthy trips, while model errors are allowed and at last. An end of healthy trips that
is not that of the valley shifts the parts of all later trips: with those of worn trips, c_p of 18
later trips was 1.02 to 2.8 times as far off on five trains of tests/blind_train.py, .95 on one."""
XTOL = 1e-8
"""Relative step, and cosine between residuals and their derivative, that end it too."""
CONVERGED = (1, 2, 3, 4)
"""Results of MINPACK's lmder where a search has ended by one of these."""
WEAR = 0.5
"""Standard deviation of the logarithm of a part's ratio before the trip: wide, as wear is."""
FURTHEST = 20.0
"""Largest coordinate of vehicles that are tried: logarithms of ratios, and deviations of priors."""
SEPARATE = np.eye(len(COMPONENTS))
EQUAL = np.array([[name.startswith(kind) for kind in PARAMETERS] for name in COMPONENTS], float)
"""Changes of the logarithms of ``COMPONENTS`` with each coordinate of a later trip: each part has a
coordinate, or all parts of a kind share one."""


def _are_same(frequencies_hz: Tensor, other_hz: Tensor) -> bool:
    """Return whether bins are the same but for rounding, as of segments of other lengths."""
    is_alike = frequencies_hz.shape == other_hz.shape
    return is_alike and torch.allclose(frequencies_hz, other_hz, rtol=0, atol=1e-9)


@dataclass(frozen=True)
class BogieSearch:
    """The sum of squares of some trips: coordinates of z, then each trip's own numbers.

    `noises` are those of the trips' sensors as `SubspaceMisfit` takes them. Healthy trips have the
    logarithm of their mass as their own number, others those that `ties` (13, n_own) makes the
    logarithms of all parts and the mass from, the mass last. `mass` is what the masses of the trips
    are expected about, the median of their prior. `warmer` [K] is each trip's temperature above
    their mean, empty where they do not differ; else the slopes of damping over temperature
    (`suspnet.estimation.temperature`) follow z, in deviations from their prior.
    """

    generator: SpatialVehicle
    noises: Sequence[Tensor]
    trips: Sequence[BogieTrip]
    are_healthy: bool
    mass: float = math.exp(MASS_MEAN)
    ties: FloatArray = field(default_factory=SEPARATE.copy)
    warmer: Sequence[float] = ()

    def __post_init__(self) -> None:
        for trip in self.trips:
            n = len(self.sensors_of(trip))
            if not _are_same(trip.frequencies_hz, self.frequencies_hz):
                raise ValueError("the trips must have the same bins")
            if trip.spectra.values.shape != (len(self.frequencies_hz), n, n):
                raise ValueError(
                    f"the spectra must be {n} x {n} on {len(self.frequencies_hz)} bins for the "
                    f"sensors {', '.join(self._sensors[i] for i in self.sensors_of(trip))}, got "
                    f"{tuple(trip.spectra.values.shape)}"
                )

    @property
    def _sensors(self) -> tuple[str, ...]:
        assert self.generator.sensors is not None
        return self.generator.sensors

    def sensors_of(self, trip: BogieTrip) -> list[int]:
        """Return the numbers of the vehicle's sensors that a trip has."""
        return trip.kept(self._sensors)

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
        """Number of slopes of damping over temperature that the trips tell."""
        return len(DAMPINGS) if self.warmer else 0

    @property
    def n_shared(self) -> int:
        """Number of coordinates that all trips share."""
        return self.n_numbers + self.n_slopes

    @cached_property
    def _warming(self) -> FloatArray:
        """Whether a damper's column follows the temperature by each slope, (n_slopes, n_columns).

        Those of the other bogie warm as those of the measured one do.
        """
        columns = self.generator.columns
        return np.array(
            [
                [kind_of(name) == damping or name == f"other_{damping}" for name in columns]
                for damping in DAMPINGS
            ],
            float,
        )

    @property
    def _own_ties(self) -> FloatArray:
        return self.ties[:, -1:] if self.are_healthy else self.ties

    @property
    def _n_own(self) -> int:
        return len(self._own_ties.T)

    @property
    def tols(self) -> tuple[float, float]:
        """Decreases that end a search while model errors are allowed, and the last one."""
        return HEALTHY_TOLS if self.are_healthy else WORN_TOLS

    @cached_property
    def all_bins(self) -> Tensor:
        """Numbers of all bins."""
        return torch.arange(len(self.frequencies_hz))

    @cached_property
    def thinned(self) -> Tensor:
        """Numbers of the bins of searches that allow for errors."""
        every = max(1, round(ROUGH_SPACING_HZ / float(self.frequencies_hz[:2].diff())))
        found: Tensor = self.all_bins[::every]
        return found

    @property
    def widening(self) -> Iterator[Tensor]:
        """Bins of the first searches, from low frequencies to all."""
        for i in reversed(range(LOWEST_BANDS)):
            end = float(self.frequencies_hz[-1]) / WIDENING**i
            yield self.thinned[self.frequencies_hz[self.thinned] <= end + 1e-9]

    @cached_property
    def _own(self) -> tuple[FloatArray, FloatArray]:
        """Prior mean and standard deviation of each trip's own numbers, (n_own,) each."""
        mean = np.zeros(self._n_own)
        mean[-1] = math.log(self.mass)
        deviation = np.full(self._n_own, WEAR)
        deviation[-1] = MASS_DEVIATION
        return mean, deviation

    def start(self, ratios: FloatArray | None = None) -> FloatArray:
        """Return the median vehicle with the trips' own numbers; None: nothing worn."""
        if ratios is None:
            own = np.tile(self._own[0], len(self.trips))
        else:
            nearest = np.linalg.lstsq(self._own_ties, np.log(ratios), rcond=None)[0]
            own = nearest.astype(np.float64)
        return np.concatenate([np.zeros(self.n_shared), own])

    def nearer(self, ratios: FloatArray) -> FloatArray:
        """Return the start of lower cost: with the trip's own ratios, or with nothing worn."""
        misfits = self._misfits(SPREADS[1], self.thinned)
        starts = self.start(ratios), self.start()
        costs = [np.square(self._residuals(x, misfits, self.thinned)).sum() for x in starts]
        return starts[int(np.argmin(costs))]

    def misfits_in(self, orders: Sequence[Sequence[int]]) -> FloatArray:
        """Return the rms residual of the first trip at the start, its sensors in other orders.

        Model errors are allowed for as in `nearer`; `orders` (n_orders, n_sensors) are numbers.
        """
        responses = self._responses(self.start(), 0, self.thinned)
        rows = torch.stack([responses[:, list(order)] for order in orders])
        values = self._misfits(SPREADS[1], self.thinned)[0](rows)
        return values.square().mean(dim=1).sqrt().numpy()

    def found(self, explained: float) -> Found:
        """Return the first end that converged with at most that misfit, or that of the least."""
        ends: list[Found] = []
        for near in self._near(explained):
            if self.are_healthy and ends and ends[-1].explains(NEARLY_EXPLAINED * explained):
                break  # the same valley, or a worse one
            ends.append(near.finished(NEARLY_EXPLAINED * explained))
            if ends[-1].explains(explained):
                return ends[-1]
        return min(ends, key=lambda one: one.misfit)

    def _near(self, explained: float) -> Iterator[Found]:
        """Yield the ends of all starts: what has at most that misfit at once, the others by misfit.

        The last search takes as long as all before it, or ten times as long in another valley.
        """
        left: list[Found] = []
        for rough in ROUGH:
            one = self.widened(rough)
            if one.misfit <= explained:
                yield one
            else:
                left.append(one)
        yield from sorted(left, key=lambda one: one.misfit)

    def widened(self, rough: float) -> Found:
        """Return the end, near the minimum, of the searches from the healthy vehicle."""
        few = self.of_trips(self.unlike)
        x = few.start()
        # without axle boxes, the search in the whole band ends in another valley
        for bins in few.widening:
            x, _ = few.search(x, rough, bins, WIDENING_TOL)
        return self.narrowed(self.start_at(x, self.unlike))

    def of_trips(self, numbers: Sequence[int]) -> BogieSearch:
        """Return the sum of squares of some of the trips."""
        noises = [self.noises[i] for i in numbers]
        warmer = [self.warmer[i] for i in numbers] if self.warmer else ()
        return replace(self, noises=noises, trips=[self.trips[i] for i in numbers], warmer=warmer)

    @cached_property
    def unlike(self) -> list[int]:
        """Numbers of the trips that choose the valley: of the lowest and of the highest speed."""
        order = sorted(range(len(self.trips)), key=lambda i: self.trips[i].speed_m_per_s)
        return sorted({order[0], order[-1]})

    def start_at(self, x: FloatArray, numbers: Sequence[int]) -> FloatArray:
        """Return the coordinates of all trips from those of some, the others' as their mean."""
        own = x[self.n_shared :].reshape(len(numbers), -1)
        every = np.tile(own.mean(axis=0), (len(self.trips), 1))
        every[list(numbers)] = own
        return np.concatenate([x[: self.n_shared], every.ravel()])

    def narrowed(self, x: FloatArray, first: int = 0) -> Found:
        """Return the end of the searches with smaller errors, from the first of ``SPREADS``."""
        fit, converged = self.with_noise_at(x), False
        for spread in SPREADS[: None if self.are_healthy else 3][first:]:
            x, converged = fit.search(x, spread, fit.thinned, fit.tols[0])
            fit = fit.with_noise_at(x)
        return Found(fit, x, converged)

    def search(
        self, x: FloatArray, spread: float, bins: Tensor, tol: float
    ) -> tuple[FloatArray, bool]:
        """Return the end of a search from x, and whether it converged."""
        misfits = self._misfits(spread, bins)
        # Not least_squares: it evaluates the derivative, most of the time, once more at the end.
        # Both evaluate it twice at the start, where the second is that of the first.
        residuals = lru_cache(1)(lambda y: self._residuals(np.frombuffer(y), misfits, bins))
        slopes = lru_cache(1)(lambda y: self._jacobian(np.frombuffer(y), misfits, bins))
        found, *_, status = leastsq(
            lambda y: residuals(y.tobytes()),
            x,
            Dfun=lambda y: slopes(y.tobytes()),
            full_output=True,
            ftol=tol,
            xtol=XTOL,
            gtol=XTOL,
            maxfev=STEPS,
        )
        return found, status in CONVERGED

    def misfit(self, x: FloatArray) -> float:
        """Return the rms residual over that of the noise."""
        squares = []
        for i, one in enumerate(self._misfits(0.0, self.all_bins)):
            values = one(self._responses(x, i, self.all_bins)[None])
            squares.append(float(values.square().mean()) / one.expected)
        return math.sqrt(math.fsum(squares) / len(squares))

    def noise_at(self, x: FloatArray) -> list[TripNoise]:
        """Return the noise of each trip for the vehicle at x."""
        found = []
        for i, (trip, noise) in enumerate(zip(self.trips, self.noises, strict=True)):
            start = noise if noise.ndim == 1 else smallest_noise(trip.spectra)
            bins = trip.of(self.all_bins)
            responses = self._responses(x, i, bins)
            alone = self._of(trip).channels_alone(self._rows(x, i), self.frequencies_hz[bins])[0]
            alone = alone[self._inputs][:, :, self.sensors_of(trip)]
            one = trip_noise(trip.spectra.at(bins), responses, alone, start)
            # bins that are left out have any noise
            matrix = torch.diag(one.densities).to(one.matrix).repeat(len(self.all_bins), 1, 1)
            found.append(replace(one, matrix=matrix.index_copy(0, bins, one.matrix)))
        return found

    def with_noise_at(self, x: FloatArray) -> BogieSearch:
        """Return the fit with the noise of each trip for the vehicle at x."""
        return replace(self, noises=[one.matrix for one in self.noise_at(x)])

    @property
    def n_residuals(self) -> float:
        """Number of independent residuals of all trips."""
        misfits = self._misfits(0.0, self.all_bins)
        shapes = [one.spectra.values.shape for one in misfits]
        n_points = sum(2 * n_bins * n * len(self._inputs) for n_bins, n, _ in shapes)
        return n_points * misfits[0].expected

    def covariance(self, x: FloatArray, excess: float) -> FloatArray:
        """Return the posterior covariance of all coordinates, residuals `excess` times as large.

        `excess` is that of their squares.
        """
        misfits = self._misfits(0.0, self.all_bins)
        jacobian = self._jacobian(x, misfits, self.all_bins)
        n_prior = len(self._prior(x))
        data, prior = jacobian[:-n_prior], jacobian[-n_prior:]
        information = data.T @ data / excess + prior.T @ prior
        return np.asarray(np.linalg.inv(information))

    def step_left(self, x: FloatArray) -> float:
        """Return the largest Newton step of a part from x, in deviations of the posterior."""
        misfits = self._misfits(0.0, self.all_bins)
        slopes = self._jacobian(x, misfits, self.all_bins)
        spread = np.linalg.inv(slopes.T @ slopes)
        step = -spread @ (slopes.T @ self._residuals(x, misfits, self.all_bins))
        rows = np.eye(len(x))[self.n_shared :]  # the trips' own numbers
        if self.are_healthy:
            names = [name.startswith("healthy_") for name in self.numbers.names]
            factor = self.numbers.factor[np.flatnonzero(names)]
            rows = np.pad(factor, ((0, 0), (0, len(x) - self.n_numbers)))
        deviations = np.sqrt(np.einsum("ij,jk,ik->i", rows, spread, rows))
        return float(np.abs(rows @ step / deviations).max())

    def _misfits(self, spread: float, bins: Tensor) -> list[SubspaceMisfit]:
        return [
            SubspaceMisfit(
                trip.spectra.at(trip.of(bins)),
                noise if noise.ndim == 1 else noise[trip.of(bins)],
                len(self._inputs),
                spread,
            )
            for trip, noise in zip(self.trips, self.noises, strict=True)
        ]

    @cached_property
    def _inputs(self) -> list[int]:
        """Numbers of the inputs that drive all wheelsets and reach the sensors.

        Sensors in the middle of a vehicle of equal sides measure the mean of both rails alone.
        """
        in_middle = all(place.endswith("_middle") for place in self._sensors)
        alone = ("wheelset", "cross_level", "alignment") if in_middle else ("wheelset",)
        return [i for i, name in enumerate(self.generator.inputs) if not name.startswith(alone)]

    @cached_property
    def _vehicles(self) -> dict[tuple[float, Direction], SpatialVehicle]:
        """Vehicles at the trips' speeds: making one takes as long as a tenth of an evaluation."""
        conditions = {(trip.speed_m_per_s, trip.direction) for trip in self.trips}
        return {
            (speed, direction): replace(self.generator, speed_m_per_s=speed).running(direction)
            for speed, direction in conditions
        }

    def _of(self, trip: BogieTrip) -> SpatialVehicle:
        return self._vehicles[trip.speed_m_per_s, trip.direction]

    def _rows(self, x: FloatArray, i: int) -> Tensor:
        """Return all columns of ratios of trip i, (1, n_columns)."""
        x = np.clip(x, -FURTHEST, FURTHEST)  # a step from afar may overflow
        own = self._own_ties @ x[self.n_shared :].reshape(len(self.trips), -1)[i]
        numbers = self.numbers.ratios(x[None, : self.n_numbers])
        parts = torch.as_tensor(np.exp(own))[None]
        rows = self.generator.with_uncertain(parts, torch.as_tensor(numbers))
        if not self.warmer:
            return rows
        slopes = USUAL_SLOPE + SLOPE_DEVIATION * x[self.n_numbers : self.n_shared]
        return rows * torch.as_tensor(np.exp(self.warmer[i] * slopes @ self._warming))

    def _responses(self, x: FloatArray, i: int, bins: Tensor) -> Tensor:
        trip = self.trips[i]
        bins_hz = self.frequencies_hz[trip.of(bins)]
        every = self._of(trip).channels(self._rows(x, i), bins_hz)[0, self._inputs]
        return every[:, self.sensors_of(trip)]

    @cached_property
    def _directions(self) -> Tensor:
        """Changes of the logarithms of the columns with each coordinate, (n, n_columns).

        Those with a slope are of a trip 1 K warmer.
        """
        n, shared, columns = self.n_numbers, self.n_shared, self.generator.uncertain_columns
        found = torch.zeros(shared + self._n_own, len(self.generator.columns), dtype=torch.float64)
        found[:n, columns] = torch.tensor(self.numbers.factor.T.copy())
        found[n:shared] = SLOPE_DEVIATION * torch.as_tensor(self._warming[: self.n_slopes])
        found[shared:, : len(COMPONENTS)] = torch.as_tensor(self._own_ties.T)
        return found

    def _directions_of(self, i: int) -> Tensor:
        """Return the directions on a trip, whose damping follows its own temperature."""
        if not self.warmer:
            return self._directions
        scale = torch.ones(len(self._directions), 1, dtype=torch.float64)
        scale[self.n_numbers : self.n_shared] = self.warmer[i]
        return scale * self._directions

    def _residuals(
        self, x: FloatArray, misfits: Sequence[SubspaceMisfit], bins: Tensor
    ) -> FloatArray:
        found = [one(self._responses(x, i, bins)[None])[0].numpy() for i, one in enumerate(misfits)]
        return np.concatenate([*found, self._prior(x)])

    def _prior(self, x: FloatArray) -> FloatArray:
        mean, deviation = self._own
        own = x[self.n_shared :].reshape(len(self.trips), -1)
        return np.concatenate([x[: self.n_shared], ((own - mean) / deviation).ravel()])

    def _jacobian(
        self, x: FloatArray, misfits: Sequence[SubspaceMisfit], bins: Tensor
    ) -> FloatArray:
        n, n_own, found = self.n_shared, self._n_own, []
        for i, (trip, misfit) in enumerate(zip(self.trips, misfits, strict=True)):
            responses, changes = self._of(trip).channels_along(
                self._rows(x, i), self.frequencies_hz[trip.of(bins)], self._directions_of(i)
            )
            inputs, sensors = self._inputs, self.sensors_of(trip)
            seen = responses[0, inputs][:, sensors], changes[0][:, inputs][:, :, sensors]
            slopes = misfit.derivative(*seen)[1].numpy().T
            block = np.zeros((len(slopes), len(x)))
            block[:, :n] = slopes[:, :n]
            block[:, n + n_own * i : n + n_own * (i + 1)] = slopes[:, n:]
            found.append(block)
        deviations = np.concatenate([np.ones(n), np.tile(self._own[1], len(self.trips))])
        return np.concatenate([*found, np.diag(1 / deviations)])


@dataclass(frozen=True)
class Found:
    """Where a search ended: the fit with the noise of its last step, x, whether this converged."""

    fit: BogieSearch
    x: FloatArray
    converged: bool

    def explains(self, explained: float) -> bool:
        """Return whether the search converged, with at most that misfit."""
        return self.converged and self.misfit <= explained

    def finished(self, explained: float) -> Found:
        """Return where the search from here ends without model errors, on all bins.

        Where it has at most that misfit it is continued while it does not end, as it creeps along a
        bent valley, and counts as ended if the parts have hardly any way to go.
        """
        fit, found = self.fit, self
        for _ in range(ROUNDS):
            found = Found(fit, *fit.search(found.x, 0.0, fit.all_bins, fit.tols[1]))
            if found.converged or not found.misfit <= explained:
                return found
        return replace(found, converged=fit.step_left(found.x) <= SETTLED * max(1.0, found.misfit))

    @cached_property
    def misfit(self) -> float:
        """The rms residual over that of the noise."""
        return self.fit.misfit(self.x)
