"""Batched Levenberg-Marquardt against scipy, row by row, and the fit of curves."""

import numpy as np
import pytest
import torch

from suspnet.learning import CurveFit
from suspnet.learning.least_squares import Descent, LevenbergMarquardt, RowStatus, derivatives

TIMES = torch.linspace(0, 4, 40, dtype=torch.float64)


def decays(n_rows=6, seed=0, noise=0.02):
    """Noisy a exp(-b t) + c with other numbers in each row."""
    rng = np.random.default_rng(seed)
    truth = torch.tensor(rng.uniform([0.5, 0.5, -1], [2, 2, 1], (n_rows, 3)))
    data = _decay(truth) + noise * torch.tensor(rng.standard_normal((n_rows, len(TIMES))))
    return truth, data


def _decay(theta):
    return theta[:, :1] * torch.exp(-theta[:, 1:2] * TIMES) + theta[:, 2:3]


def _oscillator(parameters, known):
    """Two magnitude curves of one oscillator: stiffness, damping; known mass."""
    k, c = parameters[:, :1], parameters[:, 1:2]
    m, w = known[:, :1], torch.linspace(0.2, 3, 60, dtype=torch.float64)
    denominator = (k - m * w**2) ** 2 + (c * w) ** 2
    return torch.stack([((k**2 + (c * w) ** 2) / denominator).sqrt(), k / denominator.sqrt()], 1)


def test_search_ends_where_little_is_left_to_gain():
    truth, data = decays()
    start, sigma = torch.ones_like(truth), 0.02

    def residual(theta, rows):
        return (data[rows] - _decay(theta)) / sigma

    exact = LevenbergMarquardt().minimise(residual, start)
    found = LevenbergMarquardt(least_decrease=0.01).minimise(residual, start)
    assert bool(found.converged.all())
    assert found.n_iter < exact.n_iter
    assert float((found.cost - exact.cost).max()) < 0.02
    wrong = found.parameters - exact.parameters
    deviations = torch.linalg.inv(exact.information).diagonal(dim1=1, dim2=2).sqrt()
    assert float((wrong / deviations).abs().max()) < 0.2


@pytest.mark.parametrize("one_sided", [False, True])
def test_derivatives_are_those_of_the_formula(one_sided):
    _, data = decays()
    theta = torch.tensor(np.random.default_rng(1).uniform(0.5, 2, (len(data), 3)))

    def residual(theta, rows):
        return data[rows] - _decay(theta)

    rows = torch.tensor([3, 0, 5, 1, 2, 4])

    values = residual(theta, rows)
    jacobian, second = derivatives(residual, theta, rows, values, one_sided)
    level, rate, one = theta[:, :1], theta[:, 1:2], torch.ones_like(values)
    decay = torch.exp(-rate * TIMES)
    expected = -torch.stack([decay, -level * TIMES * decay, one], dim=2)
    assert expected.abs().min(dim=0).values.max() > 0.9
    # h / 2 of second derivatives up to 4.4 with h = 1e-5, h^2 / 6 of third ones to 17 with 1e-4
    atol = 2.2e-5 if one_sided else 3e-8
    np.testing.assert_allclose(jacobian, expected.transpose(1, 2), rtol=0, atol=atol)
    bent = -level * TIMES**2 * decay
    twice = torch.stack([torch.zeros_like(bent), bent, torch.zeros_like(bent)], dim=2)
    curved = (twice * values[:, :, None]).sum(dim=1)
    assert curved.abs().max() > 1
    np.testing.assert_allclose(second, 0 if one_sided else curved, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("settings", [{}, {"tol": 1e-3}, {"max_iter": 2}])
def test_information_is_the_product_of_derivatives_at_the_parameters(settings):
    truth, data = decays()
    found = LevenbergMarquardt(**settings).minimise(
        lambda theta, rows: data[rows] - _decay(theta), torch.ones_like(truth)
    )
    for theta, information in zip(found.parameters.numpy(), found.information, strict=True):
        a, b, _ = theta
        t = TIMES.numpy()
        jacobian = np.stack([np.exp(-b * t), -a * t * np.exp(-b * t), np.ones_like(t)])
        # central differences with a step of 1e-4: at most 3e-8, as above
        np.testing.assert_allclose(information, jacobian @ jacobian.T, rtol=1e-7)


def test_rows_do_not_see_each_other():
    truth, data = decays()
    start = torch.ones_like(truth)
    together = LevenbergMarquardt().minimise(lambda theta, rows: data[rows] - _decay(theta), start)
    for row in range(len(data)):
        alone = LevenbergMarquardt().minimise(
            lambda theta, rows, row=row: data[row : row + 1] - _decay(theta), start[row : row + 1]
        )
        np.testing.assert_allclose(alone.parameters[0], together.parameters[row], rtol=1e-9)


def test_accelerated_steps_are_never_tried_beyond_the_bounds():
    """A step far too long overflowed: "`ratios` must be positive and finite"."""
    bounds = torch.full((2,), -3.0).double(), torch.full((2,), 3.0).double()
    tried = []

    def residual(theta, rows):
        tried.append(theta.abs().max())
        return torch.stack([1e-4 * theta[:, 0] ** 3 - 1, theta[:, 1] - 1], dim=1)

    solver = LevenbergMarquardt(accelerated=True, first_damping=1e-9, bounds=bounds)
    found = solver.minimise(residual, torch.tensor([[0.01, 0.5]], dtype=torch.float64))
    assert max(tried) <= 3.0 + 1e-3  # the step of differences
    assert found.parameters[0, 0] == 3.0 or found.converged[0]


def test_acceleration_is_half_the_second_derivative_along_a_step():
    _, data = decays(1)

    def residual(theta, rows):
        return data[rows] - _decay(theta)

    def of_row(theta):
        return residual(theta[None], [0])[0]

    theta, damping = torch.tensor([1.2, 0.9, 0.1], dtype=torch.float64), 0.3
    step = torch.tensor([0.05, -0.1, 0.02], dtype=torch.float64)
    bounds = (torch.full((3,), -9.0).double(), torch.full((3,), 9.0).double())
    descent = Descent(residual, theta[None], bounds, one_sided=False, accelerated=True)
    descent.linearise()
    bend, is_slight = descent.bend(
        torch.tensor([0]), step[None], descent.information, torch.tensor([damping]).double()
    )
    J = torch.autograd.functional.jacobian(of_row, theta).numpy()
    h = 1e-3
    along = (of_row(theta + h * step) - 2 * of_row(theta) + of_row(theta - h * step)) / h**2
    H = J.T @ J
    expected = -0.5 * np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ along.numpy())
    # the second derivative is from one side: third derivatives remain, a tenth of a step long
    np.testing.assert_allclose(bend[0], expected, rtol=0.05, atol=1e-6)
    assert np.abs(expected).max() > 1e-3
    assert bool(is_slight.all())


def test_accelerated_steps_follow_a_bent_valley_in_fewer_iterations():
    start = torch.tensor([[-1.2, 1.0], [-3.0, 8.0]], dtype=torch.float64)

    def residual(theta, rows):
        x, y = theta[:, 0], theta[:, 1]
        return torch.stack([100 * (y - x**2), 1 - x], dim=1)

    n_iter = {}
    for accelerated in (False, True):
        solver = LevenbergMarquardt(max_iter=1000, accelerated=accelerated)
        found = solver.minimise(residual, start)
        assert bool(found.converged.all())
        np.testing.assert_allclose(found.parameters, 1.0, rtol=1e-6)
        n_iter[accelerated] = found.n_iter
    assert n_iter[True] < 0.5 * n_iter[False]


def test_search_does_not_end_by_short_steps_in_a_bent_valley():
    start = torch.tensor([[-3.0, 9.0]], dtype=torch.float64)

    def residual(theta, rows):
        x, y = theta[:, 0], theta[:, 1]
        return torch.stack([1e4 * (y - x**2), 10 * (1 - x)], dim=1)

    options = {"max_iter": 1000, "tol": 0.1, "least_decrease": 1e-4}
    ends = [
        LevenbergMarquardt(**options, accelerated=accelerated).minimise(residual, start)
        for accelerated in (False, True)
    ]
    assert all(bool(end.converged.all()) for end in ends)
    assert float(ends[0].cost) > 100
    assert float(ends[1].cost) < 1e-2


@pytest.mark.parametrize("first_damping", [1e-3, 1e-6, 1e-12])
def test_parameter_without_effect_stays_and_does_not_hold_the_others(first_damping):
    start = torch.tensor([[3.0, 7.0]], dtype=torch.float64)
    found = LevenbergMarquardt(first_damping=first_damping).minimise(
        lambda theta, rows: theta[:, :1] - 2 + 0 * theta[:, 1:], start
    )
    assert bool(found.converged[0])
    np.testing.assert_allclose(found.parameters, [[2.0, 7.0]], rtol=1e-8)
    np.testing.assert_allclose(found.information[0], [[1.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_start_beyond_the_bounds_is_brought_inside():
    bounds = torch.tensor([0.0]), torch.tensor([5.0])
    start = torch.tensor([[-9.0], [99.0], [3.0]], dtype=torch.float64)
    found = LevenbergMarquardt(bounds=bounds).minimise(lambda theta, rows: theta - 2, start)
    np.testing.assert_allclose(found.parameters, np.full((3, 1), 2.0), rtol=1e-8)
    assert start.tolist() == [[-9.0], [99.0], [3.0]]
    held = LevenbergMarquardt(bounds=bounds).minimise(lambda theta, rows: theta - 7, start)
    assert held.parameters.tolist() == [[5.0]] * 3
    assert bool(held.converged.all())


def _ending_in_each_way(theta, rows):
    """A linear row, a flat one, one at the least point of its kink, and one that is not finite."""
    each = torch.cat([theta - 2, theta**8, 1 + theta.abs(), theta * torch.nan], dim=1)
    return each.gather(1, rows[:, None])


@pytest.mark.parametrize(
    ("max_iter", "expected"),
    [
        (0, ["MAX_ITER", "MAX_ITER", "MAX_ITER", "NOT_FINITE"]),
        (30, ["SMALL_STEP", "MAX_ITER", "NO_DECREASE", "NOT_FINITE"]),
        (300, ["SMALL_STEP", "SMALL_STEP", "NO_DECREASE", "NOT_FINITE"]),
    ],
)
def test_status_is_why_each_row_ended(max_iter, expected):
    start = torch.tensor([[0.0], [1.0], [0.0], [1.0]], dtype=torch.float64)
    solver = LevenbergMarquardt(max_iter=max_iter, one_sided=True)
    found = solver.minimise(_ending_in_each_way, start)
    assert [RowStatus(int(one)).name for one in found.status] == expected
    assert found.converged.tolist() == [name == "SMALL_STEP" for name in expected]


def test_small_decrease_ends_a_row_whose_steps_are_large():
    start = torch.tensor([[1.0]], dtype=torch.float64)
    solver = LevenbergMarquardt(least_decrease=1e-6)
    found = solver.minimise(lambda theta, rows: theta**8, start)
    assert found.status.tolist() == [RowStatus.SMALL_DECREASE]
    assert found.converged.tolist() == [True]
    assert found.parameters[0, 0] > 0.1


def test_curve_fit_recovers_noise_free_parameters():
    rng = np.random.default_rng(2)
    truth = torch.tensor(rng.uniform([0.5, 0.1], [2.0, 0.8], (8, 2)))
    known = torch.tensor(rng.uniform(0.8, 1.2, (8, 1)))
    observed = _oscillator(truth, known)
    (found,) = CurveFit(64).fit_curves([(_oscillator, 2)], observed, known, 0.05, 4.0)
    assert bool(found.converged.all())
    # Zero residual: convergence is quadratic, rounding alone is left.
    np.testing.assert_allclose(found.parameters, truth, rtol=1e-9)
    np.testing.assert_allclose(found.cost, np.zeros(8), atol=1e-18)


def test_curve_fit_weighs_each_curve_by_its_rms():
    rng = np.random.default_rng(3)
    truth = torch.tensor([[1.0, 0.3]], dtype=torch.float64)
    known = torch.ones(1, 1, dtype=torch.float64)
    observed = _oscillator(truth, known)
    observed = observed + 0.02 * torch.tensor(rng.standard_normal(observed.shape))
    factor = torch.tensor([1.0, 1e4], dtype=torch.float64)[None, :, None]
    (plain,) = CurveFit(64).fit_curves([(_oscillator, 2)], observed, known, 0.05, 4.0)

    def larger(theta, mass):
        return factor * _oscillator(theta, mass)

    (scaled,) = CurveFit(64).fit_curves([(larger, 2)], factor * observed, known, 0.05, 4)
    np.testing.assert_allclose(scaled.parameters, plain.parameters, rtol=1e-7)
    scale = observed.square().mean(dim=2, keepdim=True).sqrt()
    misfit = (observed - _oscillator(plain.parameters, known)) / scale
    assert float(plain.cost[0]) == pytest.approx(0.5 * float(misfit.square().sum()), rel=1e-10)


def test_curve_fit_rules_out_models_that_are_far_behind_the_nearest():
    truth = torch.tensor([[1.4, 0.2], [0.7, 0.3]], dtype=torch.float64)
    known = torch.ones(2, 1, dtype=torch.float64)

    def damped(theta, mass):
        return _oscillator(torch.cat([torch.full_like(theta, 1.4), theta], dim=1), mass)

    observed = _oscillator(truth, known) + 1e-3
    alone, both = CurveFit(64).fit_curves(
        [(damped, 1), (_oscillator, 2)], observed, known, 0.05, 4.0
    )
    assert torch.isfinite(alone.cost).tolist() == [True, False]  # the first stiffness is 1.4
    assert bool(torch.isfinite(both.cost).all())
    np.testing.assert_allclose(both.parameters, truth, rtol=0.05)
