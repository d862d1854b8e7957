"""Batched Levenberg-Marquardt against scipy, row by row, and the fit of curves."""

import numpy as np
import pytest
import torch
from scipy import optimize

from suspnet.learning import CurveFit, levenberg_marquardt

TIMES = torch.linspace(0, 4, 40, dtype=torch.float64)


def decays(n_rows=6, seed=0, noise=0.02):
    """Noisy a exp(-b t) + c with other numbers in each row."""
    rng = np.random.default_rng(seed)
    truth = torch.tensor(rng.uniform([0.5, 0.5, -1], [2, 2, 1], (n_rows, 3)))
    data = _decay(truth) + noise * torch.tensor(rng.standard_normal((n_rows, len(TIMES))))
    return truth, data


def _decay(theta):
    return theta[:, :1] * torch.exp(-theta[:, 1:2] * TIMES) + theta[:, 2:3]


def _rosenbrock(theta, rows):
    x, y = theta[:, 0], theta[:, 1]
    return torch.stack([10 * (y - x**2), 1 - x], dim=1)


def _oscillator(parameters, known):
    """Two magnitude curves of one oscillator: stiffness, damping; known mass."""
    k, c = parameters[:, :1], parameters[:, 1:2]
    m, w = known[:, :1], torch.linspace(0.2, 3, 60, dtype=torch.float64)
    denominator = (k - m * w**2) ** 2 + (c * w) ** 2
    return torch.stack([((k**2 + (c * w) ** 2) / denominator).sqrt(), k / denominator.sqrt()], 1)


def test_each_row_is_the_fit_of_scipy():
    truth, data = decays()
    start = torch.ones_like(truth)
    found = levenberg_marquardt(lambda theta, rows: data[rows] - _decay(theta), start)
    assert bool(found.converged.all())
    for row, observed in enumerate(data):
        other = optimize.least_squares(
            lambda theta, y=observed: (y - _decay(torch.tensor(theta)[None])[0]).numpy(),
            np.ones(3),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-12,
        )
        assert other.cost > 1e-4
        # Steps below 1e-8 end the fit; Gauss-Newton's last error is then smaller still.
        np.testing.assert_allclose(found.parameters[row], other.x, rtol=1e-6)
        assert float(found.cost[row]) == pytest.approx(other.cost, rel=1e-10)


def test_rows_do_not_see_each_other():
    truth, data = decays()
    start = torch.ones_like(truth)
    together = levenberg_marquardt(lambda theta, rows: data[rows] - _decay(theta), start)
    for row in range(len(data)):
        alone = levenberg_marquardt(
            lambda theta, rows, row=row: data[row : row + 1] - _decay(theta), start[row : row + 1]
        )
        np.testing.assert_allclose(alone.parameters[0], together.parameters[row], rtol=1e-9)


def test_rosenbrock_ends_in_its_valley():
    # The classical start, one on the other side, and the minimum itself.
    start = torch.tensor([[-1.2, 1.0], [3.0, -2.0], [1.0, 1.0]], dtype=torch.float64)
    found = levenberg_marquardt(_rosenbrock, start, max_iter=200)
    assert bool(found.converged.all())
    np.testing.assert_allclose(found.parameters, np.ones((3, 2)), atol=1e-7, rtol=0)
    np.testing.assert_allclose(found.cost, np.zeros(3), atol=1e-14)


def test_linear_problem_is_least_squares():
    rng = np.random.default_rng(1)
    A, y = rng.standard_normal((20, 3)), rng.standard_normal((4, 20))
    found = levenberg_marquardt(
        lambda theta, rows: torch.tensor(y)[rows] - theta @ torch.tensor(A).T,
        torch.zeros(4, 3, dtype=torch.float64),
    )
    expected = np.linalg.lstsq(A, y.T, rcond=None)[0].T
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found.parameters, expected, atol=1e-8, rtol=0)


def test_parameter_without_effect_stays():
    start = torch.tensor([[3.0, 7.0]], dtype=torch.float64)
    found = levenberg_marquardt(lambda theta, rows: theta[:, :1] - 2 + 0 * theta[:, 1:], start)
    assert bool(found.converged[0])
    np.testing.assert_allclose(found.parameters, [[2.0, 7.0]], rtol=1e-8)


def test_cost_is_half_the_sum_of_squares_and_never_above_the_start():
    start = torch.tensor([[-1.2, 1.0], [5.0, 5.0]], dtype=torch.float64)
    before = 0.5 * _rosenbrock(start, None).square().sum(dim=1)
    found = levenberg_marquardt(_rosenbrock, start, max_iter=3)
    after = 0.5 * _rosenbrock(found.parameters, None).square().sum(dim=1)
    np.testing.assert_allclose(found.cost, after, rtol=1e-14)
    assert bool((found.cost < before).all())


def test_start_stays_untouched():
    start = torch.tensor([[-1.2, 1.0]], dtype=torch.float64)
    before = start.clone()
    levenberg_marquardt(_rosenbrock, start)
    assert torch.equal(start, before)


def test_one_iteration_is_reported_as_not_converged():
    start = torch.tensor([[-1.2, 1.0], [3.0, -2.0]], dtype=torch.float64)
    found = levenberg_marquardt(_rosenbrock, start, max_iter=1)
    assert found.n_iter == 1
    assert not bool(found.converged.any())


def test_residual_that_is_not_finite_is_not_called_converged():
    start = torch.tensor([[1.0]], dtype=torch.float64)
    found = levenberg_marquardt(lambda theta, rows: theta * torch.nan, start)
    assert not bool(found.converged.any())


def test_curve_fit_recovers_noise_free_parameters():
    rng = np.random.default_rng(2)
    truth = torch.tensor(rng.uniform([0.5, 0.1], [2.0, 0.8], (8, 2)))
    known = torch.tensor(rng.uniform(0.8, 1.2, (8, 1)))
    observed = _oscillator(truth, known)
    found = CurveFit(n_starts=64).fit_curves(_oscillator, observed, known, 0.05, 4.0, 2)
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
    plain = CurveFit(64).fit_curves(_oscillator, observed, known, 0.05, 4.0, 2)
    scaled = CurveFit(64).fit_curves(
        lambda theta, mass: factor * _oscillator(theta, mass), factor * observed, known, 0.05, 4, 2
    )
    np.testing.assert_allclose(scaled.parameters, plain.parameters, rtol=1e-7)
    scale = observed.square().mean(dim=2, keepdim=True).sqrt()
    misfit = (observed - _oscillator(plain.parameters, known)) / scale
    assert float(plain.cost[0]) == pytest.approx(0.5 * float(misfit.square().sum()), rel=1e-10)


def test_curve_fit_is_the_same_each_time():
    truth = torch.tensor([[1.4, 0.2]], dtype=torch.float64)
    known = torch.ones(1, 1, dtype=torch.float64)
    observed = _oscillator(truth, known) + 0.01
    first, again = (
        CurveFit(64).fit_curves(_oscillator, observed, known, 0.05, 4.0, 2) for _ in range(2)
    )
    assert torch.equal(first.parameters, again.parameters)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"n_starts": 0}, ValueError, "`n_starts` must be finite and >= 1"),
        ({"n_starts": 1.5}, TypeError, "`n_starts` must be a whole number"),
        ({"max_iter": True}, TypeError, "`max_iter` must be a whole number, got True"),
        ({"tol": 0.0}, ValueError, r"`tol` must be finite and in \(0, inf\)"),
    ],
)
def test_curve_fit_refuses_wrong_settings(settings, error, message):
    with pytest.raises(error, match=message):
        CurveFit(**settings)
