"""The most probable vehicle behind healthy trips, and what they leave uncertain.

With z the standard normal coordinates of the prior (logarithms of numbers = mean + F z), m_i the
logarithm of the car-body mass on trip i and u_g(z, m_i) the whitened misfit of group g, one trip at
one speed (`EstimateMisfit`), the most probable vehicle has the least::

    sum_g |u_g|^2 + |z|^2 + sum_i ((m_i - mean) / deviation)^2

A Gauss-Newton search from the nominal vehicle would end in a valley far off: noise may be a
thousandth of the curves. So the model is first allowed errors of 30 %, then of ever less, and the
first of these searches, which chooses the valley, is made several times:

- from the median of the prior, in the whole band and in bands that widen from low frequencies,
  where the responses have no notches yet and delays are short against a period (frequency
  continuation: Bunks et al., Multiscale seismic waveform inversion, 1995);
- from the best vehicle found with some of its numbers redrawn from the prior, those that a search
  is known to leave in a wrong valley (``REDRAWN``), again as long as this finds a better one.

The best of these go on. The inverse of J^T J at the end, without the rows of the masses, is the
posterior covariance of z. Where a misfit is left beyond the noise, the noise is taken to be as much
larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import OptimizeResult, least_squares

from suspnet.dynamics import VerticalVehicle
from suspnet.dynamics.quantities import LogNormal
from suspnet.estimation.healthy_misfit import MASS_MEAN, HealthyMisfit, row_of
from suspnet.estimation.healthy_trips import HealthySpectra
from suspnet.estimation.physics import Residual
from suspnet.ground.progress import bar
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.spectra.estimates import EstimateSettings

SPREADS = (0.3, 0.1, 0.03, 0.01, 0.0)
"""Rms errors of the model allowed for in addition to the noise, one search after the other."""
FEW, MANY = 12, 100
"""Evaluations of a search with allowed errors, and of the last search, which may follow a curved
valley: a damper and its bushing can stand in for each other."""
ROUGH_TOL, TOL = 1e-3, 1e-6
"""Relative change of the sum of squares that ends a search with allowed errors, and the last."""
BAND_RATIOS = (math.inf, 2.0, math.sqrt(2.0))
"""Ratio of the upper ends of neighbouring bands, for each search from the median of the prior;
infinity is the whole band at once. One ratio may lead past a valley that another leads into."""
LOWEST_BAND = 4.0
"""The first band ends at this multiple of the lowest frequency or above: two octaves hold the modes
of the body on its springs."""
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
"""Numbers that are redrawn together.

The wheelbase moves notches along frequency. The pivot distance makes a delay that a wrong valley
has off by a period; the body pitches as before if its radius of gyration goes with the distance. A
damper in series with a bushing dissipates at one frequency as much as a weaker one whose bushing is
stiff. Of a bending mode at the wrong frequency a search takes the amplitude away, and then no
curve determines the frequency any more."""
N_DRAWS, SEED = 200, 12
"""Number of draws of each of ``REDRAWN``, and their seed."""
FAR = 2.0
"""Least distance of a redrawn number from its former value, in deviations of the prior. The best of
these draws starts the next search: the best of all would lie in the valley that is to be left."""
MAX_ROUNDS, LEAST_GAIN = 4, 0.02
"""Most rounds of redrawing, and the share of the cost that a round must save to be followed by
another one."""
N_STARTS = 4
AGREEMENT = 0.25
"""Two searches found the same vehicle if no number differs by more than this many deviations of the
posterior; before the last search, while the model is allowed errors, of the prior."""
Z_BOUND = 8.0
"""Standard deviations of the prior within which coordinates stay."""


@dataclass(frozen=True)
class Commissioned:
    """The vehicle that healthy trips show.

    Attributes
    ----------
    generator : VerticalVehicle
        With the posterior as its distribution.
    prior, posterior : LogNormal
        Of the same names.
    masses : array of shape (n_trips,), [-]
        Car-body mass over nominal on each trip.
    misfit : float
        Rms of the residuals over that of the noise: 1 if all is explained.
    misfits : tuple of float
        That of each group.
    frequencies_hz : array of shape (n_freq,), [Hz]
    observed, nominal, fitted : complex arrays of shape (n_groups, 2, n_freq), [-]
        G_p and G_s as measured, of the nominal and of the commissioned vehicle.
    deviations : array of shape (n_groups, 2, n_freq), [-]
        Of the measured log-magnitudes; infinite where a bin is not used.
    n_agree, n_starts : int
        Searches that found this vehicle, of how many that were finished.
    converged : bool
    """

    generator: VerticalVehicle
    prior: LogNormal
    posterior: LogNormal
    masses: FloatArray
    misfit: float
    misfits: tuple[float, ...]
    frequencies_hz: FloatArray
    observed: ComplexArray
    nominal: ComplexArray
    fitted: ComplexArray
    deviations: FloatArray
    n_agree: int
    n_starts: int
    converged: bool

    @property
    def residual(self) -> Residual:
        """What the vehicle leaves unexplained, averaged over the groups."""
        return Residual.of(self.misfit, self.observed, self.fitted, self.deviations)


def commission(
    generator: VerticalVehicle,
    settings: EstimateSettings,
    groups: Sequence[HealthySpectra],
    *,
    n_starts: int = N_STARTS,
    progress: bool = False,
) -> Commissioned:
    """Return the most probable vehicle behind healthy trips.

    Parameters
    ----------
    generator : VerticalVehicle
        With the prior as its distribution.
    settings : EstimateSettings
        Bound to the vehicle: bins, window and estimator.
    n_starts : int
        Most searches that are finished, of those at the first spread.

    Raises
    ------
    ValueError
        If nothing is uncertain.
    """
    if generator.distribution is None or not generator.distribution.names:
        raise ValueError("nothing of the vehicle is uncertain: there is nothing to commission")
    with bar("search of the vehicle", unit="step", shown=progress) as steps:
        target = _Search(generator, settings, groups)
        target.on_step = steps.update
        # the model is allowed errors first: searches at once end in valleys far off
        first = target.first_searches(n_starts)
        rough = [target.search(found.x, SPREADS[1:-1]) for found in first]
        order = np.argsort([found.cost for found in rough], kind="stable")
        best = target.search(rough[order[0]].x, SPREADS[-1:])
        # the others show whether the best vehicle is the only one
        posterior, mean_square = target.posterior(best)
        others = [target.search(rough[i].x, SPREADS[-1:]) for i in order[1:]]
    agree = [target.distance(best.x, other.x, posterior) < AGREEMENT for other in others]
    n = len(target.prior.names)
    theta = torch.as_tensor(best.x)[None]
    observed, fitted, deviations = target.curves(theta)
    plain = replace(generator, distribution=None)
    nominal = HealthyMisfit(plain, settings, groups).curves(theta[:, n:])[1]
    return Commissioned(
        generator=replace(generator, distribution=posterior),
        prior=target.prior,
        posterior=posterior,
        masses=np.exp(best.x[n:]),
        misfit=math.sqrt(mean_square),
        misfits=tuple(target.misfits(theta)),
        frequencies_hz=settings.frequencies_hz().numpy(),
        observed=observed,
        nominal=nominal,
        fitted=fitted,
        deviations=deviations,
        n_agree=1 + sum(agree),
        n_starts=len(first),
        converged=bool(best.status > 0),
    )


class _Search(HealthyMisfit):
    """Searches for the least sum of squares; `on_step` is called after each."""

    on_step: Callable[[], object] = staticmethod(lambda: None)

    def first_searches(self, n_starts: int) -> list[OptimizeResult]:
        """Return the results of those searches at the first spread that are to be finished.

        They are the best that differ by more than ``AGREEMENT`` from all better ones, so that
        several valleys are followed where there are some; the last place is for the best of the
        others, which says that more than one search came into a valley.
        """
        rng = np.random.default_rng(SEED)
        found = [self.search(self.widened(ratio), SPREADS[:1]) for ratio in BAND_RATIOS]
        for _ in range(MAX_ROUNDS):
            best = min(found, key=_cost)
            more = [self.search(x, SPREADS[:1]) for x in self.redrawn(best.x, rng)]
            found += more
            if min(map(_cost, more), default=math.inf) >= (1 - LEAST_GAIN) * best.cost:
                break
        separate: list[OptimizeResult] = []
        again: list[OptimizeResult] = []
        for one in sorted(found, key=_cost):
            near = any(np.abs(one.x - other.x).max() < AGREEMENT for other in separate)
            (again if near else separate).append(one)
        n_separate = max(1, n_starts - 1)
        return [*separate[:n_separate], *again, *separate[n_separate:]][:n_starts]

    def widened(self, ratio: float) -> FloatArray:
        """Return where searches in ever wider bands lead from the median of the prior.

        Each band ends at `ratio` times the end of the one before; the whole band is not among them.
        """
        x = np.append(np.zeros(len(self.prior.names)), np.full(self.n_trips, MASS_MEAN))
        low_hz, high_hz = self.frequencies_hz[[0, -1]].tolist()
        n_bands = int(math.log(max(high_hz / (LOWEST_BAND * low_hz), 1.0), ratio))
        for i in range(n_bands, 0, -1):
            x = self.search(x, SPREADS[:1], high_hz / ratio**i).x
        return x

    def redrawn(self, x: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
        """Return, for each of ``REDRAWN``, the best point that differs in these numbers alone."""
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
        """Return the sums of squares of points at the first search's spread, (n_rows,)."""
        blocks = torch.as_tensor(theta).split(64)
        found = [self.residuals(block, SPREADS[0]).square().sum(dim=1) for block in blocks]
        return np.asarray(torch.cat(found).numpy())

    def search(
        self, start: FloatArray, spreads: Sequence[float], high_hz: float = math.inf
    ) -> OptimizeResult:
        """Return the result of the searches with some spreads, one after the other.

        Bins above `high_hz` are not used.
        """
        found = OptimizeResult(x=start)
        for spread in spreads:
            last = spread == 0
            found = least_squares(
                lambda x, spread=spread: self.residuals(row_of(x), spread, high_hz)[0].numpy(),
                np.clip(found.x, -0.99 * Z_BOUND, 0.99 * Z_BOUND),
                jac=lambda x, spread=spread: self.jacobian(x, spread, high_hz),
                bounds=(-Z_BOUND, Z_BOUND),
                ftol=TOL if last else ROUGH_TOL,
                xtol=TOL,
                gtol=None,
                max_nfev=MANY if last else FEW,
            )
            self.on_step()
        return found


def _cost(found: OptimizeResult) -> float:
    """Return half the sum of squares where a search ended."""
    return float(found.cost)
