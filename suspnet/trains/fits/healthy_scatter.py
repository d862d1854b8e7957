"""How the parts of healthy trips scatter if they are read as later ones.

At the minimum of the healthy trips' sum of squares, each trip is left out of it and read: with J_j
and r_j derivatives and residuals of trip j, its own numbers eliminated from both, others give ::

    z ~ N(z_0 - L^-1 g, L^-1),    L = 1 + sum_j J_j^T J_j,    g = z_0 + sum_j J_j^T r_j,    j != i

and one Gauss-Newton step with that prior the parts and the mass of trip i, under the law of the
suspension that the others show, whose uncertainty counts as noise. Its parts are healthy,
so that they are the error of a reading, with all that differs from trip to trip. For each kind,
what their mean squares have beyond the covariance C_i of noise is the scatter: with e_ij the
logarithms of its P parts, m_i their mean over j and c_i the mean of C_i ::

    own^2   = mean_i [sum_j (e_ij - m_i)^2 - (tr C_i - P c_i)] / (P - 1)
    alike^2 = mean_i [m_i^2 - c_i] - own^2 / P

each at least 0. Where the sensors do not show each part, all of a kind are read as one and own is
0.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspnet.estimation.commissioned_bogie import HealthyScatter
from suspnet.ground.parameters import BOGIE_PARTS, COMPONENTS, PARAMETERS, kind_of
from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_misfit import DAMPING_OF_TRIP, EQUAL, SEPARATE, BogieMisfit


def healthy_scatter(fit: BogieMisfit, x: FloatArray) -> HealthyScatter:
    """Return the scatter of the healthy trips of a sum of squares at its minimum x."""
    separate = fit.generator.shows_parts
    names = BOGIE_PARTS if separate else PARAMETERS[:-1]
    logs, covariances = read_as_later(fit, x, SEPARATE if separate else EQUAL)
    own, alike = [], []
    for kind in PARAMETERS[:-1]:
        parts = [i for i, name in enumerate(names) if kind_of(name) == kind]
        n, of_kind = len(parts), logs[:, parts]
        noise = covariances[:, parts][:, :, parts]
        trace, common = np.trace(noise, axis1=1, axis2=2), noise.mean(axis=(1, 2))
        squares = n * of_kind.var(axis=1) - (trace - n * common)
        variance = max(0.0, float(squares.mean()) / (n - 1)) if separate else 0.0
        shared = float((of_kind.mean(axis=1) ** 2 - common).mean()) - variance / n
        own.append(float(np.sqrt(variance)))
        alike.append(float(np.sqrt(max(0.0, shared))))
    noise = covariances.mean(axis=0)[: len(names), : len(names)]
    rows = tuple(map(tuple, noise.tolist()))
    return HealthyScatter(tuple(own), tuple(alike), len(fit.trips), rows)


def read_as_later(
    fit: BogieMisfit, x: FloatArray, ties: FloatArray = SEPARATE
) -> tuple[FloatArray, FloatArray]:
    """Return the logarithms of parts and mass of each trip, (n_trips, 13), and their covariances.

    These are of noise, (n_trips, 13, 13). `ties` are as of `BogieMisfit`: with equal parts there
    are 5 logarithms.
    """
    n, numbers, slopes = fit.n_shared, slice(fit.n_numbers), slice(fit.n_numbers, fit.n_shared)
    n_trips, tied = len(fit.trips), np.linalg.pinv(ties)
    healthy = [_told(fit, x, i) for i in range(n_trips)]
    information_of_all = np.eye(n) + sum(of_trip for of_trip, _ in healthy)
    score_of_all = x[:n] + sum(of_trip for _, of_trip in healthy)
    logs, covariances = [], []
    for i, (mine, my_score) in enumerate(healthy):
        at, information, score = _step(fit, x, i, ties)
        of_others = information_of_all - mine
        before = np.linalg.inv(of_others)
        others = -before @ (score_of_all - my_score)
        # a later trip changes the vehicle of the others, but not the law of its suspension
        free = np.r_[numbers, n : len(score)]
        score = score[free] + information[free, slopes] @ others[slopes]
        information = information[np.ix_(free, free)]
        known = of_others[numbers, numbers]
        information[numbers, numbers] += known
        score[numbers] -= known @ others[numbers]
        covariance = np.linalg.inv(information)
        first = fit.n_numbers + fit.n_free
        read = slice(first, first + ties.shape[1])
        logs.append((at[free] - covariance @ score)[read])
        by_law = tied @ fit.by_slopes(i)[:, : len(COMPONENTS)].T
        by_law *= n_trips / (n_trips - 1)  # from the mean of the others
        covariances.append(covariance[read, read] + by_law @ before[slopes, slopes] @ by_law.T)
    return np.array(logs), np.array(covariances)


def expected_noise(fit: BogieMisfit, x: FloatArray, n_healthy: int) -> FloatArray:
    """Return the covariance that noise will give the logarithms of parts and mass, (13, 13).

    It is that of a trip like the first one, read with a vehicle like that at x, which `n_healthy`
    trips like it have shown.
    """
    n = fit.n_shared
    expected = fit.as_expected(x)
    _, information, _ = _step(expected, x, 0, SEPARATE)
    of_healthy, _ = _told(expected, x, 0)
    information[:n, :n] += np.eye(n) + n_healthy * of_healthy
    read = slice(n + fit.n_free, n + fit.n_free + SEPARATE.shape[1])
    return np.asarray(np.linalg.inv(information)[read, read])


def _step(
    fit: BogieMisfit, x: FloatArray, i: int, ties: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return trip i's coordinates as a later one, and its information and score there."""
    later = replace(fit, are_healthy=False, ties=ties, chance=DAMPING_OF_TRIP)
    of_trip = later.of_trips([i])
    # the vehicle and its load as they are, all parts healthy
    own = x[fit.n_shared :].reshape(len(fit.trips), -1)[i, fit.n_parts :]
    at = np.concatenate([x[: fit.n_shared], np.pad(own, (of_trip.n_parts, 0))])
    return at, *_information(of_trip, at)


def _told(fit: BogieMisfit, x: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    """Return what trip i tells of the n shared numbers, whatever its own ones are.

    These are the information (n, n) and the score (n,).
    """
    n = fit.n_shared
    own = x[n:].reshape(len(fit.trips), -1)[i]
    information, score = _information(fit.of_trips([i]), np.concatenate([x[:n], own]))
    share = np.linalg.solve(information[n:, n:], information[n:, :n]).T
    return information[:n, :n] - share @ information[n:, :n], score[:n] - share @ score[n:]


def _information(of_trip: BogieMisfit, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return information and score of one trip with the prior of its own numbers."""
    n, n_prior = of_trip.n_shared, len(of_trip.prior_deviations)
    jacobian, residuals = of_trip.exact.jacobian(at), of_trip.exact(at)
    information = jacobian[:-n_prior].T @ jacobian[:-n_prior]
    score = jacobian[:-n_prior].T @ residuals[:-n_prior]
    precision = 1 / of_trip.prior_deviations[n:] ** 2
    information[n:, n:] += np.diag(precision)
    score[n:] += of_trip.prior(at)[n:] * np.sqrt(precision)
    return information, score
