"""The search for the most probable vehicle, both sides as equal, given healthy trips.

With z the standard normal coordinates of the prior (logarithms of numbers = mean + F z), m_i the
logarithm of the car-body mass on trip i and u_g(z, m_i) the whitened misfit of group g, one trip at
one speed (`EstimateMisfit`), the most probable vehicle minimises::

    sum_g |u_g|^2 + |z|^2 + sum_i ((m_i - mean) / deviation)^2

A single Gauss-Newton search from the nominal vehicle would end far off, as the noise may be a
thousandth of the curves. So the searches first allow a model error of 30 %, then smaller ones.
There are several searches of the first kind, which choose the valley:

- from the median of the prior, in the whole band and in bands that widen from low frequencies,
  where the responses have no notches yet and delays are short compared with a period (frequency
  continuation: Bunks et al., Multiscale seismic waveform inversion, 1995);
- from the best vehicle found, with those numbers redrawn from the prior that searches are known to
  leave in a wrong valley (``REDRAWN``), repeated as long as this finds a better one.

The best of these continue.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.types import FloatArray
from suspnet.learning.least_squares import LevenbergMarquardt
from suspnet.trains.fits.healthy_misfit import HealthyMisfit, row_of
from suspnet.vehicle.quantities import MASS_MEAN, LogNormal

SPREADS = (0.3, 0.1, 0.03, 0.01)
"""Rms model errors allowed in addition to the noise, in successive searches before the last one."""
FEW = 12
"""Largest number of iterations of a search with allowed errors."""
ROUND, N_ROUNDS = 15, 6
"""Number of iterations of the last search after which it may have met another one, and how often:
it may follow a curved valley, as a damper and its bushing can substitute for each other."""
ROUGH_TOL, TOL = 1e-2, 1e-5
ROUGH_DECREASE, LEAST_DECREASE = 1e-3, 1e-2
"""A search with allowed errors, and the last search, end at such a step in standard deviations of
the prior, or at such a further decrease of half the sum of squares: with 1e-2 no number ended more
than 0.11 deviations of the posterior from where 1e-4 ends (three trains), in half the time."""
ROUGH_DAMPING, DAMPING = 1e-2, 1e-3
"""First damping of these searches."""
BAND_RATIOS = (math.inf, 2.0, math.sqrt(2.0))
"""Ratio of the upper ends of successive bands, for each search from the median of the prior;
infinity is the whole band at once. A single ratio may miss a valley that another one finds."""
LOWEST_BAND = 4.0
"""Smallest ratio of upper to lower end of the first band: two octaves contain the modes of the body
on its springs."""
REDRAWN = (
    ("half_wheelbase",),
    ("half_pivot_distance", "body_gyration"),
    ("healthy_c_p", "primary_bushing"),
    (
        "bending_frequency",
        "bending_damping",
        "bending_at_pivot",
        "bending_at_sensor",
        "bending_slope",
    ),
)
"""Groups of numbers that are redrawn together.

The wheelbase shifts notches along frequency. The pivot distance sets a delay, which is wrong by a
period in a wrong valley; the body's pitch is unchanged if its radius of gyration changes with the
distance. A damper in series with a bushing dissipates at one frequency as much as a weaker one with
a stiffer bushing. If a bending mode is at the wrong frequency, a search reduces its amplitude to 0,
and then no curve determines the frequency any more.
"""
N_DRAWS, SEED = 200, 12
"""Number of draws of each group in ``REDRAWN``, and their seed."""
FAR = 2.0
"""Smallest distance of a redrawn number from its former value, in deviations of the prior. Without
it the best draw would lie in the valley that is to be left."""
MAX_ROUNDS, LEAST_GAIN = 4, 0.02
"""Largest number of rounds of redrawing, and the fraction of the cost that a round must save for
another one to follow."""
UNLIKELY = 1.5
"""Mean square of the residuals, over that of the noise, above which a vehicle explains badly."""
AGREEMENT = 0.25
"""Two searches agree if no number differs by more than this many deviations of the posterior, or of
the prior while the model is allowed errors."""
NEAR, NEARLY = 1.5, 3.0
"""A search without allowed errors meets one that has ended where no number differs by more
deviations of the posterior, and half the sum of squares by no more: what is left is the way along a
flat valley, which took most of the time of commissioning."""
SHARE = "wheelset_share"
"""Density of what excites each wheelset alone over the mean track's."""
Z_BOUND = 8.0
"""Bound of the coordinates, in standard deviations of the prior."""


@dataclass(frozen=True)
class End:
    """End of a search: its point theta, half the sum of squares there."""

    x: FloatArray
    cost: float
    converged: bool


class VehicleSearch(HealthyMisfit):
    """Searches for the minimum of the sum of squares; `on_step` is called after each."""

    on_step: Callable[[], object] = staticmethod(lambda: None)

    def first_searches(self, n_starts: int) -> list[End]:
        """Return the results of the first searches that are to be continued, best first.

        They are the best ones that differ by more than ``AGREEMENT`` from all better ones, so that
        several valleys are followed if there are any. The last place is for one of these again, if
        more than one search found it.
        """
        # searches from the median, then from redrawn points as long as these find a better one
        rng = np.random.default_rng(SEED)
        ends = [self.search(self.widened(ratio), SPREADS[:1]) for ratio in BAND_RATIOS]
        for _ in range(MAX_ROUNDS):
            best = min(ends, key=attrgetter("cost"))
            more = [self.search(x, SPREADS[:1]) for x in self.redrawn(best.x, rng)]
            ends += more
            if min((end.cost for end in more), default=math.inf) >= (1 - LEAST_GAIN) * best.cost:
                break
        # group the results by valley
        separate: list[End] = []
        again: list[End] = []
        for end in sorted(ends, key=attrgetter("cost")):
            near = [other for other in separate if np.abs(end.x - other.x).max() < AGREEMENT]
            (again if near else separate).append(near[0] if near else end)
        n_separate = max(1, n_starts - 1)
        return [*separate[:n_separate], *again[:1], *separate[n_separate:]][:n_starts]

    def start(self, z: FloatArray, masses: FloatArray) -> FloatArray:
        """Return theta of a vehicle's coordinates and the logarithms of the trips' masses."""
        return np.concatenate([z, masses, np.zeros(self.n_of_damping)])

    def widened(self, ratio: float) -> FloatArray:
        """Return the end of searches in bands that widen by `ratio`, but for the whole band."""
        x = self.start(np.zeros(len(self.prior.names)), np.full(self.n_trips, MASS_MEAN))
        low_hz, high_hz = self.frequencies_hz[[0, -1]].tolist()
        n_bands = int(math.log(max(high_hz / (LOWEST_BAND * low_hz), 1.0), ratio))
        for i in range(n_bands, 0, -1):
            x = self.search(x, SPREADS[:1], high_hz / ratio**i).x
        return x

    def redrawn(self, x: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
        """Return, for each of ``REDRAWN``, the best point that differs in these numbers only."""
        n, factor, points = len(self.prior.names), self.every.factor.numpy(), []
        for names in REDRAWN:
            rows = [self.prior.names.index(name) for name in names if name in self.prior.names]
            if not rows:
                continue
            here = factor @ x[:n]
            drawn = self.prior.deviations[rows] * rng.standard_normal((N_DRAWS, len(rows)))
            far = np.abs((drawn - here[rows]) / self.prior.deviations[rows]).max(axis=1) > FAR
            if not far.any():
                continue
            logs = np.tile(here, (int(far.sum()), 1))
            logs[:, rows] = drawn[far]
            z = np.linalg.lstsq(factor, logs.T, rcond=None)[0].T
            theta = np.hstack([z, np.tile(x[n:], (len(z), 1))])
            points.append(theta[self.costs(theta).argmin()])
        return points

    def costs(self, theta: FloatArray) -> FloatArray:
        """Return the sums of squares of points with the first spread, (n_rows,)."""
        blocks = torch.as_tensor(theta).split(64)
        found = [self.residuals(block, SPREADS[0]).square().sum(dim=1) for block in blocks]
        return np.asarray(torch.cat(found).numpy())

    def search(self, start: FloatArray, spreads: Sequence[float], high_hz: float = math.inf) -> End:
        """Return the end of successive searches with some spreads, up to `high_hz`."""
        point = row_of(start)
        for spread in spreads:
            solver = LevenbergMarquardt(
                max_iter=FEW,
                tol=ROUGH_TOL,
                first_damping=ROUGH_DAMPING,
                bounds=self._bounds(len(start)),
                least_decrease=ROUGH_DECREASE,
                derivative=partial(self._slopes, spread, high_hz),
            )
            found = solver.minimise(partial(self._residuals, spread, high_hz), point)
            point = found.parameters
            self.on_step()
        return End(point[0].numpy(), float(found.cost[0]), bool(found.converged[0]))

    def finished(
        self, start: FloatArray, meets: Callable[[End], End | None] = lambda _: None
    ) -> End:
        """Return the end of a search without allowed errors, or the other one that it `meets`.

        Steps are accelerated along the valley, not far from it, where they may be led astray. What
        is left to gain counts in units of the noise, which is as large as the residuals. A search
        that explains the trips badly ends with the first round of little gain.
        """
        end = self.search(start, (0.0,))
        level = float(np.mean(np.square(self.misfits(row_of(end.x)))))
        solver = LevenbergMarquardt(
            max_iter=ROUND,
            tol=TOL,
            first_damping=DAMPING,
            bounds=self._bounds(len(start)),
            least_decrease=LEAST_DECREASE * max(1.0, level),
            accelerated=True,
            derivative=partial(self._slopes, 0.0, math.inf),
        )
        for _ in range(N_ROUNDS):
            if (other := meets(end)) is not None:
                end = other
                break
            step = solver.minimise(partial(self._residuals, 0.0, math.inf), row_of(end.x))
            gains_little = end.cost - float(step.cost[0]) < LEAST_GAIN * end.cost
            end = End(step.parameters[0].numpy(), float(step.cost[0]), bool(step.converged[0]))
            if end.converged or (level > UNLIKELY and gains_little):
                break
        self.on_step()
        return end

    def meets(self, end: End, posterior: LogNormal, other: End) -> End | None:
        """Return the first of two searches if the second is on its way there, by its posterior."""
        is_near = self.distance(end.x, other.x, posterior) < NEAR
        return end if is_near and abs(end.cost - other.cost) < NEARLY else None

    def agrees(self, x: FloatArray, posterior: LogNormal, other: FloatArray) -> bool:
        """Return whether two points are one vehicle, by the posterior of one of them."""
        return self.distance(x, other, posterior) < AGREEMENT

    def _bounds(self, n_coordinates: int) -> tuple[Tensor, Tensor]:
        """Return the bounds of theta; a share that counts by its size is not negative.

        At 0 it has an edge: a search that may step to either side finds no decrease any more.
        """
        high = torch.full((n_coordinates,), Z_BOUND, dtype=torch.float64)
        low = -high
        if SHARE in self.prior.names:
            row = self.prior.names.index(SHARE)
            columns = np.flatnonzero(self.every.factor[row].numpy())
            if len(columns) == 1:  # more, of a prior that is correlated, bound no coordinate
                (column,) = columns
                low[column] = -self.prior.mean[row] / self.every.factor[row, column]
        return low, high

    def _residuals(self, spread: float, high_hz: float, theta: Tensor, _: Tensor) -> Tensor:
        return self.residuals(theta, spread, high_hz)

    def _slopes(self, spread: float, high_hz: float, theta: Tensor, _: Tensor) -> Tensor:
        return self.derivative(theta, spread, high_hz)
