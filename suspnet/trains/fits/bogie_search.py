"""The search for a bogie's numbers and parts that explain the spectral matrices of some trips.

The sum of squares is a `BogieMisfit`. Starting from the healthy vehicle, model errors as large as
each signal are allowed first, in bands that widen: the direct search ends in another valley. Then
the errors shrink: those of healthy trips to what the trips show of them, in rounds of search and
`BogieMisfit.with_errors_at`; those of a later trip in steps, to what the healthy trips showed.

A vehicle that does not explain its healthy trips is given further parts, with the errors that it
had without them. Where it nearly does, each of them has to prove its worth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import leastsq
from torch import Tensor

from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_misfit import BogieMisfit
from suspnet.trains.fits.posterior import step_left, with_chance_at

ROUGH, SPREADS = (1.0, 0.3), (0.3, 0.1, 0.03)
"""Model errors as fractions of each signal: those of a first search, another where it fails, and
those of the searches after it, of later trips. Four sensors without axle boxes need the first, as
30 % ended in another valley on two of three trains of tests/blind_train.py; 3 did so on pairs."""
LEARNT_ROUNDS, ENRICHED_ROUNDS = 3, 5
"""Rounds in which the errors of a vehicle are learnt, and of one that was given further parts: they
change by less than a tenth in the last one (flexible modes of tests/rich_train.py, seed 0)."""
ENRICHED_FROM, MATCHED_FROM = 1.3, 1.1
"""Misfits without errors above which all further parts are given at once, the latter where
covariances are matched: each alone is hidden by the errors for the others."""
MUCH_BETTER = 0.8
"""Misfit without errors, over that of the searches that learn errors, from which an end counts as
another valley. The scenario flexible_train with seed 2 has 1.0 in place of 2.4; the misfit of
trains that no vehicle explains hardly changes (tests/rich_train.py, all, both ways, seed 2)."""
WORTH = 20.0
"""Least decrease of the cost, 2 log P, for which a vehicle is given one of them: parts that a train
has not brought 6 at most, a track on ballast 150 (tests/rich_train.py, seed 0)."""
MATCHED_STARTS = 3
"""First searches, on two other trips each, of which the best end is taken where covariances are
matched: with flexible modes of tests/rich_train.py, seed 0, one of nine ended in another valley, at
a misfit of 1.14 on its trips and 1.3 on all, the others at 0.95."""
WIDENING = 1.45
"""Ratio of the upper ends of the bands of the first searches."""
LOWEST_BANDS = 6
"""Number of bands of the first searches."""
ROUGH_SPACING_HZ, MATCHED_SPACING_HZ = 0.5, 0.15
"""Distance of the bins of searches that allow for errors, and of the first ones where covariances
are matched: a bin tells little there."""
STEPS, ROUNDS = 64, 4
"""Most evaluations of one search, and how often the last one is continued. Trips of two payloads at
four speeds took up to 33 on 36 bins, healthy trips on soft ballast 70 on all."""
NEARLY_EXPLAINED = 1.5
"""Misfit over that of an explained trip up to which the last search is continued."""
SETTLED = 0.5
"""Step still to go, in deviations of the posterior, up to which a search counts as ended."""
WIDENING_TOL, WORN_TOLS, HEALTHY_TOLS = 1e-2, (1e-2, 1e-3), (1e-3, 1e-4)
"""Relative decreases of the cost that end a search: of the first bands, then of trips that may be
worn and of healthy trips, while model errors are allowed and at last. An end of healthy trips that
is not that of the valley shifts the parts of all later trips: with those of worn trips, c_p of 18
later trips was 1.02 to 2.8 times as far off on five trains of tests/blind_train.py, .95 on one."""
THINNED_TOL = 1e-6
"""The same of the last search of healthy trips on some of the bins. It costs a fifth of one on all,
which then starts near its end: with flexible modes of tests/rich_train.py, seed 0, both take as
long as the one on all bins alone, and end 0.16 deviations of a part from the minimum, not 0.44."""
XTOL = 1e-8
"""Relative step, and cosine between residuals and their derivative, that end it too."""
CONVERGED = (1, 2, 3, 4)
"""Results of MINPACK's lmder where a search has ended by one of these."""


@dataclass(frozen=True)
class SearchEnd:
    """Where a search ended: the sum with the noise of its last step, x, whether this converged."""

    fit: BogieMisfit
    x: FloatArray
    converged: bool

    @cached_property
    def misfit(self) -> float:
        """The rms residual over that of the noise."""
        return self.fit.rms(self.x)

    @cached_property
    def bare_misfit(self) -> float:
        """The misfit if the vehicle had no errors."""
        return replace(self.fit, errors=None).rms(self.x)

    @cached_property
    def cost(self) -> float:
        """The sum of squares at the bins of searches that allow for errors."""
        return float(np.square(self.fit.at(0.0, _thinned(self.fit))(self.x)).sum())

    def finished(self, explained: float) -> SearchEnd:
        """Return where the search from here ends without model errors, on all bins.

        Where it has at most that misfit it is continued while it does not end, as it creeps along a
        bent valley, and counts as ended if the parts have hardly any way to go.
        """
        fit, end = self.fit, self
        for _ in range(ROUNDS):
            end = SearchEnd(fit, *search(fit, end.x, 0.0, fit.all_bins, tolerances(fit)[1]))
            if end.converged or not end.misfit <= explained:
                return end
        return replace(end, converged=step_left(fit, end.x) <= SETTLED * max(1.0, end.misfit))


def healthy_end(fit: BogieMisfit, further_parts: Sequence[str], explained: float) -> SearchEnd:
    """Return the end of the search for a vehicle that explains healthy trips, near the minimum.

    It has those of the further parts that it needs, and its errors. If its misfit is at most
    `explained` without them, it has none, for the last search: learnt before the minimum, 1 % of
    errors hid that c_p and its bushing were 3 and 13 % off (scenario flexible_train). The last
    search also knows the speed of each damper, and how little dampers differ by chance.
    """
    near = freed(enriched(better_end(fit), further_parts))
    fit = with_chance_at(near.fit.with_own_speeds(near.x), near.x, at_end=True)
    # a third of all bins where covariances are matched: there is little to gain
    tol = HEALTHY_TOLS[1] if fit.is_matched else THINNED_TOL
    x, converged = search(fit, near.x, 0.0, _thinned(fit), tol)
    end = SearchEnd(fit.with_errors_at(x), x, converged)
    return replace(end, fit=replace(end.fit, errors=None)) if end.bare_misfit <= explained else end


def freed(end: SearchEnd) -> SearchEnd:
    """Return the end, or another one if errors learnt on the way had hidden a much better one."""
    if end.bare_misfit <= ENRICHED_FROM or end.fit.is_matched:
        return end
    near = narrowed(replace(end.fit, errors=None), end.x)
    bare = SearchEnd(near.fit, *search(near.fit, near.x, 0.0, _thinned(near.fit), HEALTHY_TOLS[1]))
    is_better = bare.misfit < MUCH_BETTER * end.bare_misfit
    return _learnt(bare, LEARNT_ROUNDS) if is_better else end


def learnt_end(fit: BogieMisfit, rounds: int = LEARNT_ROUNDS, first: int = 0) -> SearchEnd:
    """Return the end of searches of healthy trips that learn the errors of the vehicle.

    The trips that choose its valley are the slowest and the fastest one but `first`.
    """
    return _learnt(SearchEnd(fit, _first_step(fit, first=first), False), rounds)


def better_end(fit: BogieMisfit) -> SearchEnd:
    """Return the same, from two other trips if these are explained badly and those much better.

    Of a linear train with four trips (scenario corner_damper_fade, seed 2) the misfit was 2.2 at
    the first end, 1.0 at the other.
    """
    end = learnt_end(fit)
    if end.bare_misfit <= ENRICHED_FROM or fit.is_matched or len(fit.trips) < 3:
        return end
    other = learnt_end(fit, first=1)
    return other if other.bare_misfit < MUCH_BETTER * end.bare_misfit else end


def enriched(end: SearchEnd, parts: Sequence[str]) -> SearchEnd:
    """Return the end with all further parts if they are needed, or those that are worth it."""
    if not parts:
        return end
    if end.bare_misfit > (MATCHED_FROM if end.fit.is_matched else ENRICHED_FROM):
        # from the start: what the poorer vehicle made of these trips is another valley
        richer_fit, _ = replace(end.fit, errors=None).with_parts(parts, end.x)
        return learnt_end(richer_fit, ENRICHED_ROUNDS)
    poorer = end
    for part in parts:
        fit, x = end.fit.with_parts([part], end.x)  # noise and errors as before
        richer = SearchEnd(fit, *search(fit, x, 0.0, _thinned(fit), HEALTHY_TOLS[0]))
        if end.cost - richer.cost > WORTH:
            end = richer
    return end if end is poorer else _learnt(end, LEARNT_ROUNDS)


def _learnt(end: SearchEnd, rounds: int) -> SearchEnd:
    for _ in range(rounds):
        # a few residuals a bin are easily explained by errors: they are learnt at the end
        at = end.fit.with_noise_at if end.fit.is_matched else end.fit.with_errors_at
        fit = with_chance_at(at(end.x), end.x)
        end = SearchEnd(fit, *search(fit, end.x, 0.0, _thinned(fit), HEALTHY_TOLS[0]))
    return end


def best_end(fit: BogieMisfit, explained: float) -> SearchEnd:
    """Return the first end that converged with at most that misfit, or that of the least."""
    ends: list[SearchEnd] = []
    for near in _ends_near(fit, explained):
        ends.append(near.finished(NEARLY_EXPLAINED * explained))
        if ends[-1].converged and ends[-1].misfit <= explained:
            return ends[-1]
    return min(ends, key=lambda end: end.misfit)


def _ends_near(fit: BogieMisfit, explained: float) -> Iterator[SearchEnd]:
    """Yield the ends of all starts: what has at most that misfit at once, the others by misfit.

    The last search takes as long as all before it, or ten times as long in another valley.
    """
    worse: list[SearchEnd] = []
    for rough in ROUGH:
        end = end_near(fit, rough)
        if end.misfit <= explained:
            yield end
        else:
            worse.append(end)
    yield from sorted(worse, key=lambda end: end.misfit)


def end_near(fit: BogieMisfit, rough: float = ROUGH[0]) -> SearchEnd:
    """Return the end, near the minimum, of the searches from the healthy vehicle.

    They allow for model errors, of the fraction `rough` first.
    """
    return narrowed(fit, _first_step(fit, rough))


def _first_step(fit: BogieMisfit, rough: float = ROUGH[0], first: int = 0) -> FloatArray:
    """Return where the searches in bands that widen end."""
    # the slowest and the fastest trip choose the valley: the others only take time
    by_speed = sorted(range(len(fit.trips)), key=lambda i: fit.trips[i].speed_m_per_s)
    n_starts = min(MATCHED_STARTS, (len(by_speed) + 1) // 2) if fit.is_matched else 1
    ends = []
    for start in range(first, first + n_starts):
        unlike = sorted({by_speed[start], by_speed[-1 - start]})
        few = fit.of_trips(unlike)
        x = few.start()
        # without axle boxes, the search in the whole band ends in another valley
        for bins in _widening_bands(fit):
            x, _ = search(few, x, 0.0 if fit.is_matched else rough, bins, WIDENING_TOL)
        # the other trips start from the mean of those
        own = x[fit.n_shared :].reshape(len(unlike), -1)
        every = np.tile(own.mean(axis=0), (len(fit.trips), 1))
        every[unlike] = own
        whole = np.concatenate([x[: fit.n_shared], every.ravel()])
        ends.append((few.rms(x) if n_starts > 1 else 0.0, whole))
    return min(ends, key=lambda end: end[0])[1]


def narrowed(fit: BogieMisfit, x: FloatArray, first: int = 0) -> SearchEnd:
    """Return the end of the searches with smaller errors, from the first of ``SPREADS``."""
    fit, converged = fit.with_noise_at(x), False
    for spread in (0.0,) if fit.is_matched else SPREADS[first:]:
        x, converged = search(fit, x, spread, _thinned(fit), tolerances(fit)[0])
        fit = fit.with_noise_at(x)
    return SearchEnd(fit, x, converged)


def search(
    fit: BogieMisfit, x: FloatArray, spread: float, bins: Tensor, tol: float
) -> tuple[FloatArray, bool]:
    """Return the end of one search from x, and whether it converged."""
    residuals = fit.at(spread, bins)
    # Not least_squares: it evaluates the derivative, most of the time, once more at the end.
    # Both evaluate it twice at the start, where the second is that of the first.
    values = lru_cache(1)(lambda y: residuals(np.frombuffer(y)))
    slopes = lru_cache(1)(lambda y: residuals.jacobian(np.frombuffer(y)))
    end, *_, status = leastsq(
        lambda y: values(y.tobytes()),
        x,
        Dfun=lambda y: slopes(y.tobytes()),
        full_output=True,
        ftol=tol,
        xtol=XTOL,
        gtol=XTOL,
        maxfev=STEPS,
    )
    return end, status in CONVERGED


def nearer_start(fit: BogieMisfit, ratios: FloatArray) -> FloatArray:
    """Return the start of lower cost: with the trip's own ratios, or with nothing worn."""
    residuals = fit.at(SPREADS[1], _thinned(fit))
    return min((fit.start(ratios), fit.start()), key=lambda x: np.square(residuals(x)).sum())


def misfits_in(fit: BogieMisfit, orders: Sequence[Sequence[int]]) -> FloatArray:
    """Return the rms residual of the first trip at the start, its sensors in other orders.

    Model errors are allowed for as in `nearer_start`; `orders` (n_orders, n_sensors) are numbers.
    """
    return fit.at(SPREADS[1], _thinned(fit)).in_orders(fit.start(), orders)


def tolerances(fit: BogieMisfit) -> tuple[float, float]:
    """Return the decreases that end a search while model errors are allowed, and the last one."""
    return HEALTHY_TOLS if fit.are_healthy else WORN_TOLS


def _thinned(fit: BogieMisfit) -> Tensor:
    """Return the numbers of the bins of searches that allow for errors."""
    spacing_hz = MATCHED_SPACING_HZ if fit.is_matched else ROUGH_SPACING_HZ
    every = max(1, round(spacing_hz / float(fit.frequencies_hz[:2].diff())))
    bins: Tensor = fit.all_bins[::every]
    return bins


def _widening_bands(fit: BogieMisfit) -> Iterator[Tensor]:
    """Yield the bins of the first searches, from low frequencies to all."""
    bins = _thinned(fit)
    for i in reversed(range(LOWEST_BANDS)):
        end_hz = float(fit.frequencies_hz[-1]) / WIDENING**i
        yield bins[fit.frequencies_hz[bins] <= end_hz + 1e-9]
