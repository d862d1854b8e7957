"""Refined estimates against the Cramer-Rao bound and scipy; bad starts, limits, other models."""

import math

import numpy as np
import pytest
import reference
import torch
from scipy import optimize
from vehicles import AM96

from suspnet.bounds.information import output_bounds
from suspnet.curves.curves import CurveMisfit, CurveSettings
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.expected_spectra import EstimateMisfit
from suspnet.curves.problem import TEST
from suspnet.estimation import refine as module
from suspnet.estimation.refine import BEYOND, Refined, refine
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle

SNR_DB = 34.0
SETTINGS = CurveSettings(snr_db=SNR_DB, low_hz=0.3, high_hz=15.0, step_hz=0.05)
OBSERVER = SETTINGS.observer(QuarterCar(AM96))
TRIPS = EstimateSettings(snr_db=34.0, minutes=10.0).bound(AM96)
WITH_MASS = {"estimate_mass": True}


def used(problem):
    return tuple(("G_p", "G_s").index(name) for name in problem.responses)


def observed(problem, n, seed=0):
    """Return vehicles (n, 5) and the misfit of their noisy curves."""
    ratios = problem.sample(n, seed, TEST)
    return ratios, CurveMisfit(
        OBSERVER, OBSERVER.observe(torch.as_tensor(ratios), seed), used(problem)
    )


def starts(problem, ratios, spread=0.1, seed=0):
    """Return estimates as a regression makes them: the truth times exp(spread e)."""
    outputs = ratios[:, problem.output_indices]
    return outputs * np.exp(spread * np.random.default_rng(seed).standard_normal(outputs.shape))


def columns(names):
    return [PARAMETERS.index(name) for name in names]


def left_of(misfit, vehicles, row):
    """Return the sum of squares of one curve for each of some vehicles (n, 5)."""
    rows = torch.full((len(vehicles),), row)
    return misfit(torch.as_tensor(vehicles), rows).square().sum(dim=1).numpy()


@pytest.fixture(scope="module")
def joint(task):
    """The joint protocol with the mass asked for; 256 vehicles, their curves and the refined."""
    problem = task("joint", "all", **WITH_MASS)
    ratios, misfit = observed(problem, 256)
    return problem, ratios, misfit, refine(problem, misfit, starts(problem, ratios))


# reference


def test_error_is_that_of_the_cramer_rao_bound(joint):
    problem, ratios, _, found = joint
    bounds = output_bounds(problem, OBSERVER, ratios) / ratios
    assert found.converged.all()
    assert found.names == problem.unknown == PARAMETERS
    normalised = np.log(found.ratios / ratios) / bounds
    # an rms of 256 numbers is known to 1 / sqrt(512) = 4.4 %, a mean to 6.3 %; four of those
    np.testing.assert_allclose(np.sqrt((normalised**2).mean(axis=0)), 1.0, atol=0.18)
    np.testing.assert_allclose(normalised.mean(axis=0), 0.0, atol=0.25)


def test_deviations_are_the_bounds(joint):
    problem, ratios, _, found = joint
    exact = output_bounds(problem, OBSERVER, found.ratios) / found.ratios
    assert exact.min() > 1e-4
    # the rms of the noisy curve: 1e-4; c_p moves by up to 50 % between the truth and the estimate,
    # so the bound is taken at the estimate
    np.testing.assert_allclose(found.deviations, exact, rtol=0.01)
    truth = output_bounds(problem, OBSERVER, ratios) / ratios
    np.testing.assert_allclose(np.median(found.deviations / truth, axis=0), 1.0, atol=0.02)


def test_misfit_of_the_true_model_is_one(joint):
    _, _, misfit, found = joint
    n_points = 2 * misfit.observed.shape[2]
    # chi-squared over its degrees of freedom: mean 1, deviation of its root 1 / sqrt(2 n)
    assert found.misfit.mean() == pytest.approx(1.0, abs=0.008)
    assert found.misfit.std() == pytest.approx(1 / math.sqrt(2 * n_points), rel=0.2)
    rows = torch.arange(len(found.misfit))
    left = misfit(torch.as_tensor(found.ratios), rows).square().sum(dim=1).numpy()
    np.testing.assert_allclose(found.misfit, np.sqrt(left / (n_points - 5)), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "group", "changes"),
    [("joint", "all", WITH_MASS), ("multi_location", "primary", {}), ("own_curve", "primary", {})],
)
def test_optimum_is_that_of_scipy(task, name, group, changes):
    problem = task(name, group, **changes)
    ratios, misfit = observed(problem, 4, seed=3)
    found = refine(problem, misfit, starts(problem, ratios))
    frequencies = SETTINGS.frequencies_hz().numpy()
    varied = columns(problem.unknown)
    for row, curves in enumerate(misfit.observed.numpy()):
        rms = np.sqrt((curves**2).mean(axis=1, keepdims=True)) * 10 ** (-SNR_DB / 20)

        def residual(log_ratios, curves=curves, rms=rms):
            vehicle = np.ones(5)
            vehicle[varied] = np.exp(log_ratios)
            left = (reference.magnitudes(AM96, vehicle, frequencies) - curves) / rms
            return left[list(used(problem))].ravel()

        other = optimize.least_squares(
            residual, np.log(ratios[row, varied]), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        np.testing.assert_allclose(found.ratios[row], np.exp(other.x), rtol=1e-5)
        mean_square = 2 * other.cost / (len(other.fun) - len(varied))
        assert found.misfit[row] == pytest.approx(math.sqrt(mean_square), rel=1e-8)
        covariance = np.linalg.inv(other.jac.T @ other.jac)
        np.testing.assert_allclose(found.deviations[row], np.sqrt(np.diag(covariance)), rtol=1e-3)


def test_estimates_from_trips_reach_their_bound(task):
    problem = task("joint", "all", **WITH_MASS)
    observer = TRIPS.observer(VerticalVehicle(AM96))
    ratios = np.array([0.9, 1.2, 1.1, 0.8, 1.05]) * np.ones((64, 1))
    vehicles = torch.as_tensor(ratios)
    misfit = EstimateMisfit(observer, observer.observe(vehicles, 1), observer.covariance(vehicles))
    found = refine(problem, misfit, starts(problem, ratios))
    assert found.converged.all()
    bounds = output_bounds(problem, observer, ratios[:1]) / ratios[0]
    normalised = np.log(found.ratios / ratios) / bounds
    # 64 trips: 8.8 %, three of those
    np.testing.assert_allclose(np.sqrt((normalised**2).mean(axis=0)), 1.0, atol=0.26)
    np.testing.assert_allclose(np.median(found.deviations, axis=0), bounds[0], rtol=0.1)
    assert np.median(found.misfit) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("start", ["regression", "missing", "beyond"])
def test_search_starts_from_the_best_level_or_the_nearest_scattered_vehicle(task, start):
    """Without a single step the start itself comes back: the better of two."""
    problem = task("multi_location", "secondary")  # k_s and c_s asked for, the mass unknown
    ratios, misfit = observed(problem, 10)
    first = starts(problem, ratios, spread=0.02)
    if start != "regression":
        first[:] = math.nan if start == "missing" else 1e9
    # so few scattered vehicles that either may be the better
    found = refine(problem, misfit, first, max_iter=0, n_scattered=8)
    points = torch.quasirandom.SobolEngine(3).draw(8, dtype=torch.float64).numpy()
    low, high = math.log(0.5 / module.SCATTER), math.log(2.0 * module.SCATTER)
    scattered = np.ones((len(points), 5))
    scattered[:, 2:] = np.exp(low + (high - low) * points)
    chosen = []
    for row in range(10):
        levels = np.ones((module.N_LEVELS, 5))
        levels[:, 2:4] = {"missing": 1.0, "beyond": 2.0}.get(start, first[row])
        levels[:, 4] = np.geomspace(0.5, 2.0, module.N_LEVELS)
        costs = [left_of(misfit, vehicles, row) for vehicles in (levels, scattered)]
        expected = min(costs[0].min(), costs[1].min())
        vehicle = levels[costs[0].argmin()] if costs[0].min() < costs[1].min() else None
        chosen.append(vehicle is not None)
        vehicle = scattered[costs[1].argmin()] if vehicle is None else vehicle
        np.testing.assert_allclose(found.ratios[row], vehicle[2:], rtol=1e-9)
        n_points = 2 * misfit.observed.shape[2] - 3
        assert found.misfit[row] == pytest.approx(math.sqrt(expected / n_points), rel=1e-9)
    assert any(chosen)
    assert not all(chosen) or start == "regression"
    assert not found.converged.any()


# limit


def test_noise_free_curves_give_the_vehicle(task):
    problem = task("joint", "all", **WITH_MASS)
    ratios = problem.sample(32, 5, TEST)
    misfit = CurveMisfit(OBSERVER, OBSERVER.noise_free(torch.as_tensor(ratios)))
    found = refine(problem, misfit, starts(problem, ratios))
    # steps below 1e-5 end the fit; Gauss-Newton's last error is then its square
    np.testing.assert_allclose(found.ratios, ratios, rtol=1e-8)
    assert found.misfit.max() < 1e-6


def test_curves_that_do_not_tell_give_infinite_deviations(task):
    """abs(G_s) depends on k_s / M_s and c_s / M_s only."""
    problem = task("own_curve", "secondary")
    ratios, misfit = observed(problem, 48)
    found = refine(problem, misfit, starts(problem, ratios))
    assert found.names == ("k_s", "c_s", "M_s")
    assert np.isinf(found.deviations).all()
    assert found.converged.all()
    assert found.misfit.mean() == pytest.approx(1.0, abs=4 / math.sqrt(2 * 295 * 48))
    told = found.ratios[:, :2] / found.ratios[:, 2:]
    truth = ratios[:, 2:4] / ratios[:, 4:]
    assert np.abs(np.log(found.ratios / ratios[:, 2:])).max() > 0.05
    np.testing.assert_allclose(told, truth, rtol=0.02)


def test_parameter_that_ran_against_its_bound_comes_back(joint):
    """A clamp inside the residual would have no slope there: one fit in a hundred ended so."""
    problem, ratios, misfit, found = joint
    start = ratios.copy()
    start[:, 1] = 1e9
    other = refine(problem, misfit, start)
    np.testing.assert_allclose(other.misfit, found.misfit, rtol=1e-8)


# property


def agree(one, other, deviations):
    """Compare two refinements that differ in rounding.

    In units of its noise at 34 dB a curve is about 50, so its rounding is 1e-14, and that of a
    derivative, over the differences' step of 1e-5, 1e-9: 2e-11 of it. Inverting J^T J multiplies
    this by the condition, at most 3e3 among all curves and 8e2 among the first twelve.
    """
    np.testing.assert_allclose(one.ratios, other.ratios, rtol=1e-8)  # deviations of at most 0.1
    np.testing.assert_allclose(one.deviations, other.deviations, rtol=deviations)
    np.testing.assert_allclose(one.misfit, other.misfit, rtol=1e-11)  # has its minimum there


def test_one_curve_gives_the_same_numbers_alone_as_in_a_batch(joint):
    problem, ratios, misfit, _ = joint
    start = starts(problem, ratios)
    start[7] = np.nan
    n = 12
    together = refine(problem, CurveMisfit(OBSERVER, misfit.observed[:n]), start[:n])
    parts = [
        refine(problem, CurveMisfit(OBSERVER, misfit.observed[row : row + 1]), start[row : row + 1])
        for row in range(n)
    ]
    agree(Refined.joined(parts), together, deviations=1e-7)


def test_known_mass_stays_as_measured_and_makes_the_rest_better_known(task):
    known, unknown = (task("own_curve", "primary", mass_known=flag) for flag in (True, False))
    ratios, misfit = observed(known, 128)
    found = refine(known, misfit, starts(known, ratios), ratios[:, 4])
    assert found.names == ("k_p", "c_p")
    bounds = output_bounds(known, OBSERVER, ratios) / ratios[:, :2]
    np.testing.assert_allclose(np.median(found.deviations / bounds, axis=0), 1.0, atol=0.03)
    normalised = np.log(found.ratios / ratios[:, :2]) / bounds
    np.testing.assert_allclose(np.sqrt((normalised**2).mean(axis=0)), 1.0, atol=0.25)
    free = refine(unknown, misfit, starts(unknown, ratios))
    assert (found.deviations <= free.deviations[:, :2] * 1.01).all()
    # a mass that is wrong by a tenth is not the vehicle's
    few = CurveMisfit(OBSERVER, misfit.observed[:16], used(known))
    wrong = refine(known, few, starts(known, ratios[:16]), 1.1 * ratios[:16, 4])
    assert np.median(wrong.misfit) > 1.5


def test_curves_of_another_model_are_not_explained(task):
    problem = task("joint", "all", **WITH_MASS)
    ratios = problem.sample(24, 2, TEST)
    curves = OBSERVER.observe(torch.as_tensor(ratios), 2)
    absorbed = curves * (1 - 0.3 * torch.exp(-((OBSERVER.frequencies_hz - 4.0) ** 2)))
    found = refine(problem, CurveMisfit(OBSERVER, absorbed), starts(problem, ratios))
    assert found.misfit.min() > 2
    limits = np.array([problem.range(name) for name in found.names])
    assert (found.ratios >= limits[:, 0] / BEYOND * (1 - 1e-9)).all()
    assert (found.ratios <= limits[:, 1] * BEYOND * (1 + 1e-9)).all()


def test_vehicles_somewhat_beyond_the_range_are_found(task):
    problem = task("joint", "all", **WITH_MASS)
    ratios = np.array([[2.6, 1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.35, 1.0, 1.0]])
    misfit = CurveMisfit(OBSERVER, OBSERVER.observe(torch.as_tensor(ratios), 4))
    found = refine(problem, misfit, ratios.clip(0.5, 2.0))
    np.testing.assert_allclose(found.ratios[[0, 1], [0, 2]], [2.6, 0.35], rtol=0.05)
    assert found.misfit.max() < 1.2


def test_chosen_columns_and_joined_batches(joint):
    *_, found = joint
    ratios, deviations = found.of(("k_s", "c_p", "M_s"))
    np.testing.assert_array_equal(ratios, found.ratios[:, [2, 1, 4]])
    np.testing.assert_array_equal(deviations, found.deviations[:, [2, 1, 4]])
    parts = [
        Refined(found.names, *(getattr(found, name)[rows] for name in FIELDS))
        for rows in (slice(0, 100), slice(100, 101), slice(101, None))
    ]
    joined = Refined.joined(parts)
    assert joined.names == found.names
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(joined, name), getattr(found, name))


FIELDS = ("ratios", "deviations", "noise", "misfit", "converged")


def refined(misfit, value):
    n = len(misfit)
    column = np.full((n, 1), value)
    return Refined(("k_p",), column, column, column, np.array(misfit), np.ones(n, bool))


def test_only_rows_that_fit_better_are_improved():
    first = refined([1.0, 2.0, math.nan, 3.0, math.nan, 4.0], 1.0)
    rows = np.array([1, 2, 3, 4, 5])
    found = first.improved(rows, refined([1.5, 1.5, 3.5, math.nan, math.nan], 2.0))
    # row 0 was not tried again; what is not a number is never better
    np.testing.assert_array_equal(found.misfit, [1.0, 1.5, 1.5, 3.0, math.nan, 4.0])
    assert found.ratios[[0, 1, 2, 3, 5], 0].tolist() == [1.0, 2.0, 2.0, 1.0, 1.0]
    np.testing.assert_array_equal(found.ratios, found.deviations)
    np.testing.assert_array_equal(first.ratios, np.ones((6, 1)))


# failure


def test_curves_that_are_not_numbers_are_not_explained_and_harm_no_others(joint):
    problem, ratios, misfit, found = joint
    curves = misfit.observed[:6].clone()
    curves[1] = math.nan
    curves[3, 0, 4] = math.nan
    curves[4] = 0.0
    other = refine(problem, CurveMisfit(OBSERVER, curves), starts(problem, ratios)[:6])
    assert not (other.misfit[[1, 3, 4]] < 1.3).any()
    assert not other.converged[[1, 3]].any()
    assert np.isinf(other.deviations[[1, 3]]).all()
    np.testing.assert_allclose(other.ratios[[0, 2, 5]], found.ratios[[0, 2, 5]], rtol=1e-7)
