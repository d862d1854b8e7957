"""Refinement of estimates: maximum-likelihood fit of the curve, started from a regression.

All parameters that vary and are not measured are fitted jointly, so the result reaches the
Cramer-Rao bound if the generator is the true model. The information matrix gives the deviations,
and the misfit shows whether the model can explain the curve at all.

A generator's uncertain numbers are fitted as well, with their distribution as prior: the sum of
squares is that of the curve's residuals and of their coordinates z
(`suspnet.curves.curves`), so the result has the largest posterior density.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from suspnet.bounds.information import cramer_rao
from suspnet.curves.curves import Directions
from suspnet.curves.estimates import Misfit
from suspnet.curves.protocols import BODY_MASS_COLUMN, Task, columns_of
from suspnet.ground.tensors import threads
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.learning.least_squares import BEYOND, LeastSquaresSolution, LevenbergMarquardt
from suspnet.vehicle import PARAMETERS

TOL = 1e-5  # tolerance of the logarithms of the parameters, far below their deviations
FIRST_DAMPING = 1e-6  # first damping of `LevenbergMarquardt`; a good start needs little
N_LEVELS = 9  # number of start values tried for a parameter without an estimate
SCATTER = 1.5  # factor on the parameter range within which the scattered vehicles lie
ROWS = 4  # number of curves whose misfits to all scattered vehicles are computed at a time
FURTHEST = 6.0
"""Bound of the coordinates of the uncertain numbers, in standard deviations of the prior."""
TEMPERATURES = (100.0, 10.0)
"""Factors on the noise of the searches before the last one, used if the effect exceeds ``WIDE``."""
WIDE = 50.0
"""Largest effect of uncertain numbers, in deviations of the noise, for a single search: above it
the search may end in another valley. Commissioned vehicles exceed it (docs/methods.md)."""
ROUGH_ITER, ROUGH_TOL = 12, 1e-2  # iterations and tolerance of the searches before the last one
LEAST_DECREASE = 0.01
"""Decrease of half the sum of squares at which a search with uncertain numbers ends. These numbers
cause narrow, bent valleys, and no parameter is off by more than sqrt(2 * 0.01) = 0.14 deviations.
"""
UNCERTAIN_DAMPING = 1e-2
"""First damping where uncertain numbers are fitted; the search starts from their median."""
UNEXPLAINED = 1.3  # misfit above which a curve is fitted again, from the nearest scattered vehicle


@dataclass(frozen=True)
class Refined:
    """Maximum-likelihood estimates of all unknown parameters, the task's in their order.

    `ratios`, `deviations` and `noise` have the shape (n_curves, n_unknown): the estimates, the
    standard deviations of their logarithms, inf where the curve does not determine them, and those
    that would remain if the uncertain numbers were known. `misfit` (n_curves,) is the rms of the
    curve's residuals over that of the noise, 1 if the model explains it; the coordinates of
    uncertain numbers count as residuals. `converged` (n_curves,).
    """

    names: tuple[str, ...]
    ratios: FloatArray
    deviations: FloatArray
    noise: FloatArray
    misfit: FloatArray
    converged: BoolArray

    def of(self, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
        """Return ratios and deviations of some parameters, each (n_curves, n_names)."""
        columns = [self.names.index(name) for name in names]
        return self.ratios[:, columns], self.deviations[:, columns]

    def noise_of(self, names: tuple[str, ...]) -> FloatArray:
        """Return the deviations due to noise alone of some parameters, (n_curves, n_names)."""
        return self.noise[:, [self.names.index(name) for name in names]]

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the estimates of several batches of curves, concatenated."""
        merged = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ROWS}
        return cls(parts[0].names, **merged)

    def improved(self, rows: IntArray, other: Self) -> Self:
        """Return the estimates with `rows` replaced by those of `other` with a smaller misfit."""
        better = (other.misfit < self.misfit[rows]) | np.isnan(self.misfit[rows])
        chosen = rows[better]
        merged = {}
        for name in _ROWS:
            values = getattr(self, name).copy()
            values[chosen] = getattr(other, name)[better]
            merged[name] = values
        return replace(self, **merged)


_ROWS = ("ratios", "deviations", "noise", "misfit", "converged")
"""Fields of `Refined` with one row for each curve."""


def complete_ratios(
    task: Task, predicted: FloatArray, mass: FloatArray | None = None
) -> FloatArray:
    """Return all ratios (n, 5) for estimates (n, n_outputs), clipped to the training range.

    The ratio is 1 where there is no estimate.
    """
    full = np.ones((len(predicted), len(PARAMETERS)))
    inside = task.bounded(predicted, reach=1.0)
    full[:, task.output_indices] = np.where(np.isfinite(predicted), inside, 1.0)
    if mass is not None:
        full[:, BODY_MASS_COLUMN] = mass
    return full


@threads(1)
def refine(
    task: Task,
    misfit: Misfit,
    estimates: FloatArray,
    mass: FloatArray | None = None,
    *,
    directions: Directions | None = None,
    near: Callable[[Tensor], Misfit] | None = None,
    max_iter: int = 30,
    n_scattered: int = 512,
) -> Refined:
    """Return the parameters whose curves lie nearest to those observed.

    The search starts from `estimates` (n_curves, n_outputs), a row with NaN from the healthy
    vehicle; `mass` (n_curves,) is the measured car-body mass ratio, if the task knows it.
    `directions` are those of the uncertain numbers to fit as well; None takes the numbers as known.
    `near` returns the misfit with the noise of vehicles (n_curves, n_columns), as with uncertain
    numbers the noise at the median may be far off; None retains that of `misfit`. The nearest of
    `n_scattered` vehicles is the second start for an unexplained curve.
    """
    # start from the regression; parameters it does not estimate start from their best level
    device = misfit.observed.device
    usable = np.asarray(np.isfinite(estimates).all(axis=1))
    start = complete_ratios(task, np.where(usable[:, None], estimates, np.nan), mass)
    full = torch.as_tensor(start, device=device)
    for name in set(task.unknown) - set(task.outputs):
        full = _best_level(misfit, full, task, name)
    search = _Search(task, misfit, full, directions, max_iter)
    every = torch.arange(len(full), device=device)
    wide = directions is not None and directions.strongest > WIDE
    search_from = functools.partial(search.tempered, near) if wide else search.run
    refined = search_from(every, search.point(full))
    # a second search for curves that are not explained, as the first may end in another valley
    bad = np.flatnonzero(~refined.converged | ~(refined.misfit < UNEXPLAINED) | ~usable)
    if len(bad):
        rows = torch.as_tensor(bad, device=device)
        again = search_from(rows, search.nearest(bad, n_scattered))
        refined = refined.improved(bad, again)
    return refined


class _Search:
    """Levenberg-Marquardt in the logarithms of the unknown parameters, within bounds.

    The coordinates of uncertain numbers follow the parameters.
    """

    def __init__(
        self, task: Task, misfit: Misfit, full: Tensor, directions: Directions | None, max_iter: int
    ) -> None:
        self._task, self._misfit, self._full, self._max_iter = task, misfit, full, max_iter
        self._directions, self.n_directions = directions, 0 if directions is None else directions.n
        self._columns = torch.tensor(columns_of(task.unknown), device=full.device)
        ranges = [task.range(name) for name in task.unknown]
        self._range = torch.tensor(ranges, dtype=full.dtype, device=full.device).T.log()
        furthest = full.new_full((self.n_directions,), FURTHEST)
        self._bounds = (
            torch.cat([self._range[0] - math.log(BEYOND), -furthest]),
            torch.cat([self._range[1] + math.log(BEYOND), furthest]),
        )

    def point(self, full: Tensor) -> Tensor:
        """Return the start for vehicles (n_rows, 5), with uncertain numbers at the median."""
        median = full.new_zeros(len(full), self.n_directions)
        return torch.cat([full[:, self._columns].log(), median], dim=1)

    def tempered(
        self, near: Callable[[Tensor], Misfit] | None, rows: Tensor, start: Tensor
    ) -> Refined:
        """Return the best fit of the curves `rows`, found with decreasing noise.

        Uncertain numbers may change the curves by thousands of deviations of the noise: a single
        search would end far off.
        """
        points, misfit = self.point(self._full), self._misfit
        points[rows] = start
        for temperature in TEMPERATURES:
            self._misfit = misfit.thinned()
            points[rows] = self._solved(rows, points[rows], temperature).parameters
            if near is not None:
                every = torch.arange(len(points), device=points.device)
                misfit = near(self._vehicles(points, every))
        self._misfit = misfit
        return self.run(rows, points[rows])

    def run(self, rows: Tensor, start: Tensor) -> Refined:
        """Return the best fit of the curves `rows`, each started from its row of `start`."""
        solution = self._solved(rows, start)
        n_unknown = len(self._columns)
        n_residuals = self._residual(solution.parameters[:1], rows[:1] * 0, 1.0).shape[1]
        # each coordinate adds one residual of expected square 1 and one fitted number
        freedom = n_residuals - self.n_directions - n_unknown
        mean_square = 2 * solution.cost / freedom
        theta = solution.parameters[:, :n_unknown]
        information = solution.information.cpu().numpy()
        deviations = cramer_rao(information)[:, :n_unknown]
        noise = cramer_rao(information[:, :n_unknown, :n_unknown])
        # at a bound the information matrix is no measure: assume a uniform distribution
        if self.n_directions:
            low, high = (bound[:n_unknown] for bound in self._bounds)
            pressed = ((theta <= low) | (theta >= high)).cpu().numpy()
            uniform = ((high - low) / math.sqrt(12)).cpu().numpy()
            deviations = np.where(pressed, uniform, deviations)
        return Refined(
            self._task.unknown,
            theta.exp().cpu().numpy(),
            deviations,
            np.where(np.isfinite(deviations), np.minimum(noise, deviations), deviations),
            np.sqrt(mean_square.cpu().numpy() / self._misfit.expected),
            solution.converged.cpu().numpy(),
        )

    def _solved(
        self, rows: Tensor, start: Tensor, temperature: float = 1.0
    ) -> LeastSquaresSolution:
        """Return the search with `temperature` times the noise, a rough one unless that is 1."""
        last = temperature == 1.0
        solver = LevenbergMarquardt(
            max_iter=self._max_iter if last else ROUGH_ITER,
            tol=TOL if last else ROUGH_TOL,
            first_damping=UNCERTAIN_DAMPING if self.n_directions else FIRST_DAMPING,
            bounds=self._bounds,
            one_sided=bool(self.n_directions),
            least_decrease=LEAST_DECREASE if self.n_directions else 0.0,
            accelerated=last and bool(self.n_directions),
        )
        return solver.minimise(
            lambda point, at: self._residual(point, rows[at], temperature), start
        )

    def _residual(self, point: Tensor, rows: Tensor, temperature: float) -> Tensor:
        """Return the residuals of the curves `rows`, followed by the coordinates of the numbers."""
        values = self._misfit(self._vehicles(point, rows), rows)
        if not self.n_directions:
            return values
        return torch.cat([values / temperature, point[:, len(self._columns) :]], dim=1)

    def nearest(self, rows: IntArray, n_scattered: int) -> Tensor:
        """Return the nearest of `n_scattered` vehicles to each curve, as a start of `run`."""
        low, high = self._range[0] - math.log(SCATTER), self._range[1] + math.log(SCATTER)
        points = torch.quasirandom.SobolEngine(len(low)).draw(n_scattered, dtype=low.dtype)
        ratios = torch.exp(low + (high - low) * points.to(low))
        draws = np.random.default_rng(0).standard_normal((n_scattered, self.n_directions))
        scattered = torch.cat([ratios.log(), torch.as_tensor(draws).to(low)], dim=1)
        starts, misfit = [], self._misfit.thinned()
        for part in torch.as_tensor(rows, device=low.device).split(ROWS):
            repeated = part.repeat_interleave(n_scattered)
            tried = self._vehicles(scattered.repeat(len(part), 1), repeated)
            cost = misfit(tried, repeated).square().sum(dim=1).reshape(len(part), -1)
            starts.append(scattered[cost.nan_to_num(torch.inf).argmin(dim=1)])
        return torch.cat(starts)

    def _vehicles(self, point: Tensor, rows: Tensor) -> Tensor:
        """Return complete ratios; parameters that are not fitted are those of the curve."""
        theta, z = point[:, : len(self._columns)], point[:, len(self._columns) :]
        ratios = self._full[rows].index_copy(1, self._columns, theta.exp())
        return ratios if self._directions is None else self._directions.vehicles(ratios, z)


def _best_level(misfit: Misfit, full: Tensor, task: Task, name: str) -> Tensor:
    """Return the ratios with one parameter set to the level that fits each curve best."""
    column = PARAMETERS.index(name)
    rows = torch.arange(len(full), device=full.device)
    best, least = full.clone(), torch.full_like(full[:, 0], torch.inf)
    for level in np.geomspace(*task.range(name), N_LEVELS):
        trial = full.clone()
        trial[:, column] = level
        cost = misfit(trial, rows).square().sum(dim=1)
        best[cost < least] = trial[cost < least]
        least = torch.minimum(least, cost)
    return best
