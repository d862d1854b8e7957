"""Joint fits of parameters and uncertain numbers: scipy on every number, coverage, bounds."""

import math

import numpy as np
import pytest
import torch
from scipy import optimize
from vehicles import AM96

from suspnet.bounds.information import output_bounds
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.expected_spectra import EstimateMisfit
from suspnet.curves.problem import TEST
from suspnet.estimation.refine import refine
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import QUANTITIES, LogNormal

PARTS = ("bushings", "rubber", "guidance")
SETTINGS = EstimateSettings(snr_db=34.0, minutes=10.0).bound(AM96)


def narrow(scale, correlation=0.5):
    """Return the prior narrowed by a factor, its numbers correlated, some hardly uncertain."""
    prior = LogNormal.prior(PARTS)
    deviations = scale * prior.deviations * np.geomspace(1, 1e-6, len(prior.names))
    matrix = (1 - correlation) * np.eye(len(deviations)) + correlation
    covariance = matrix * np.outer(deviations, deviations)
    return LogNormal(prior.names, tuple(np.array(prior.mean) + 0.02), covariance.tolist())


def observer_of(distribution):
    return SETTINGS.observer(VerticalVehicle(AM96, parts=PARTS, distribution=distribution))


def observed(observer, problem, n, seed=0):
    """Return vehicles, the misfit of a trip of each, and estimates 5 % beside the truth."""
    ratios = problem.sample(n, seed, TEST)
    curves = observer.observe(torch.as_tensor(ratios), seed)
    misfit = observer.misfit(curves, torch.as_tensor(ratios))
    spread = np.random.default_rng(seed).standard_normal(ratios.shape)
    return ratios, misfit, ratios * np.exp(0.05 * spread)


@pytest.fixture(scope="module")
def problem(task):
    return task("trips", "all")


# reference


def test_standard_numbers_that_moved_give_the_distribution_of_their_ratios():
    """Logarithms of draws of the standard numbers have its mean and covariance."""
    prior = narrow(1.0)
    n, rng = len(prior.names), np.random.default_rng(0)
    centre, root = rng.standard_normal(n), rng.standard_normal((n, n)) / n
    moved = prior.moved(centre, root @ root.T)
    draws = centre + rng.standard_normal((20000, n)) @ root.T
    logs = np.log(prior.ratios(draws) + prior.offsets)
    assert moved.names == prior.names
    scatter = moved.deviations / math.sqrt(len(draws))
    assert (np.abs(logs.mean(axis=0) - moved.mean) < 5 * scatter).all()
    limit = 0.06 * np.outer(moved.deviations, moved.deviations)
    assert (np.abs(np.cov(logs.T) - moved.covariance) < limit).all()


def test_fit_is_that_of_scipy_on_every_number(problem):
    distribution = narrow(0.1)
    observer = observer_of(distribution)
    assert 0 < observer.directions.n < len(distribution.names)
    ratios, misfit, start = observed(observer, problem, 2)
    found = refine(problem, misfit, start, directions=observer.directions)
    assert found.converged.all()
    factor = distribution.factor
    may_be_absent = {quantity.name: quantity.may_be_absent for quantity in QUANTITIES}
    for row in range(len(ratios)):

        def residual(point, row=row):
            logs = np.array(distribution.mean) + factor @ point[5:]
            numbers = np.exp(logs) - [may_be_absent[name] for name in distribution.names]
            vehicle = observer.generator.with_uncertain(
                torch.as_tensor(np.exp(point[None, :5])), torch.as_tensor(numbers[None])
            )
            return np.append(misfit(vehicle, torch.tensor([row]))[0].numpy(), point[5:])

        first = np.append(np.log(found.ratios[row]), np.zeros(len(factor)))
        full = optimize.least_squares(residual, first, method="lm", diff_step=1e-6)
        deviations = np.sqrt(np.diag(np.linalg.inv(full.jac.T @ full.jac)))[:5]
        np.testing.assert_allclose(found.deviations[row], deviations, rtol=0.02)
        alone = np.sqrt(np.diag(np.linalg.inv(full.jac[:, :5].T @ full.jac[:, :5])))
        np.testing.assert_allclose(found.noise[row], alone, rtol=0.02)
        assert (alone < 0.99 * deviations).any()
        beside = (np.log(found.ratios[row]) - full.x[:5]) / deviations
        np.testing.assert_allclose(beside, 0.0, atol=0.1)
        points = misfit.observed.shape[2] * 4
        mean_square = 2 * full.cost / (points - 5) / misfit.expected
        assert found.misfit[row] == pytest.approx(math.sqrt(mean_square), rel=1e-3)


def test_bounds_are_those_of_the_whole_information_with_the_prior(problem):
    observer = observer_of(narrow(0.1))
    ratios = problem.sample(2, 0, TEST)
    every = observer.generator.distribution.factor
    rows = torch.as_tensor(ratios)
    misfit = observer.misfit(observer.noise_free(rows), rows)
    mean = np.array(observer.generator.distribution.mean)
    may_be_absent = {quantity.name: quantity.may_be_absent for quantity in QUANTITIES}
    offsets = np.array([may_be_absent[name] for name in observer.generator.distribution.names])
    assert 0 < offsets.sum() < len(offsets)

    def residuals(point):
        numbers = torch.as_tensor(np.exp(mean + every @ point[5:]) - offsets).expand(2, -1)
        vehicles = observer.generator.with_uncertain(rows + torch.as_tensor(point[:5]), numbers)
        return misfit(vehicles, torch.arange(2)).numpy()

    steps = 1e-5 * np.eye(5 + len(every))
    jacobian = np.stack([residuals(s) - residuals(-s) for s in steps], axis=1) / 2e-5
    information = jacobian @ jacobian.transpose(0, 2, 1)
    information[:, range(5, len(steps)), range(5, len(steps))] += 1
    exact = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))[:, :5]
    bounds = output_bounds(problem, observer, ratios)
    np.testing.assert_allclose(bounds, exact, rtol=0.02)
    known = output_bounds(problem, observer_of(None), ratios)
    assert (bounds.max(axis=0) > 1.1 * known.max(axis=0)).any()


# property


# limit


@pytest.mark.parametrize(
    "distribution", [None, pytest.param({}, marks=pytest.mark.slow), {"body_gyration": 1e-9}]
)
def test_nothing_uncertain_is_the_fit_without(problem, distribution):
    generator = VerticalVehicle(AM96, distribution=distribution)
    observer = SETTINGS.observer(generator)
    assert observer.directions.n == 0
    _, misfit, start = observed(SETTINGS.observer(VerticalVehicle(AM96)), problem, 4)
    plain = refine(problem, misfit, start)
    misfit = EstimateMisfit(observer, misfit.observed, misfit.covariance)
    found = refine(problem, misfit, start, directions=observer.directions)
    np.testing.assert_array_equal(found.ratios, plain.ratios)
    np.testing.assert_array_equal(found.deviations, plain.deviations)
