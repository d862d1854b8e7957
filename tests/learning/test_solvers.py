"""Each solver on a table of problems whose answers are known from other codes or closed forms."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from learning_reference import lbfgs_msvr, naive_msvr_objective, smooth_data
from scipy import optimize
from sklearn.linear_model import Ridge
from sklearn.svm import LinearSVR

from suspnet.learning import MSVR
from suspnet.learning.design import DenseDesign
from suspnet.learning.equispaced import equispaced_fourier
from suspnet.learning.irwls import IRWLS, Status
from suspnet.learning.least_squares import LevenbergMarquardt, RowStatus
from suspnet.learning.toeplitz import EquispacedDesign

TOL = 1e-10
"""Gap at which solvers of Eq. (7) stop."""
TRANSFORMS = 1e-8
"""Relative error of F by the transforms on a grid."""


# the functional of Eq. (7)


@dataclass(frozen=True)
class Penalised:
    """Eq. (7) for 60 samples; `reference` returns W, b of its minimum for a matrix of features."""

    reference: Callable
    n_outputs: int
    C: float
    epsilon: float
    fit_intercept: bool
    sigma: float = 1.5

    def data(self):
        X, Y = smooth_data(1, 60)
        return X, np.column_stack([Y, Y[:, 0] * Y[:, 1]])[:, : self.n_outputs]

    def setting(self, **changes):
        """Return what solvers take."""
        names = ("C", "epsilon", "fit_intercept")
        given = {name: getattr(self, name) for name in names}
        return given | {"max_iter": 3000, "tol": TOL} | changes


def ridge(Phi, Y, problem):
    model = Ridge(alpha=1 / (2 * problem.C), fit_intercept=problem.fit_intercept, solver="cholesky")
    model.fit(Phi, Y)
    return model.coef_.T, np.broadcast_to(model.intercept_, Y.shape[1])


def linear_svr(Phi, Y, problem):
    loss = {"loss": "squared_epsilon_insensitive", "dual": False, "fit_intercept": False}
    options = {"C": problem.C, "epsilon": problem.epsilon, "tol": 1e-12, "max_iter": 100_000}
    return LinearSVR(**loss, **options).fit(Phi, Y[:, 0]).coef_[:, None], np.zeros(1)


def lbfgs(Phi, Y, problem):
    return lbfgs_msvr(Phi, Y, problem.C, problem.epsilon, problem.fit_intercept)[:2]


def mean_alone(Phi, Y, problem):
    return np.zeros((Phi.shape[1], Y.shape[1])), np.zeros(Y.shape[1])


PENALISED = {
    "ridge": Penalised(ridge, 2, 0.5, 0.0, False),
    "ridge with intercept": Penalised(ridge, 3, 10.0, 0.0, True),
    "one output": Penalised(linear_svr, 1, 10.0, 0.2, False),
    "one output, small tube": Penalised(linear_svr, 1, 1.0, 1e-3, False),
    "small tube": Penalised(lbfgs, 2, 1e3, 1e-3, False),
    "tube with intercept": Penalised(lbfgs, 2, 10.0, 0.05, True),
    "wide tube": Penalised(lbfgs, 3, 10.0, 0.3, True),
    "small penalty": Penalised(lbfgs, 3, 0.5, 0.1, True, sigma=3.0),
    "narrow kernel": Penalised(lbfgs, 2, 100.0, 1e-6, False, sigma=0.7),
    "wide kernel": Penalised(lbfgs, 2, 100.0, 0.05, True, sigma=3.0),
    "all within the tube": Penalised(mean_alone, 2, 10.0, 1e3, True),
}


SHARED = ("objective", "objectives", "gap", "n_iter", "support_fraction")
"""What solvers and estimators report alike."""


def by_irwls(problem, design, **changes):
    """Return what the solver finds on a design of equispaced modes."""
    X, Y = map(torch.tensor, problem.data())
    modes = equispaced_fourier(X, problem.sigma, 1, 0)
    found = IRWLS(**problem.setting(**changes)).minimise(design(modes, X), Y)
    Phi = modes(X).numpy()
    return SimpleNamespace(
        features=Phi,
        fitted=Phi @ found.coef.numpy() + found.intercept.numpy(),
        intercept=found.intercept.numpy(),
        converged=found.status == Status.CONVERGED,
        **{name: getattr(found, name) for name in SHARED},
    )


def by_estimator(problem, feature_map):
    """Return what the estimator finds, with the features of its map."""
    X, Y = problem.data()
    model = MSVR(
        feature_map=feature_map, sigma=problem.sigma, n_components=40, **problem.setting()
    ).fit(X, Y)
    unit = {"coef": np.eye(len(model.coef_)), "intercept": np.zeros(len(model.coef_))}
    features = MSVR(**model.get_params()).restore(model.state() | unit).predict(X)
    if feature_map == "exact":  # its columns are the kernel's; a root of it are features
        values, vectors = np.linalg.eigh(features)
        features = vectors * np.sqrt(values.clip(min=0))
    return SimpleNamespace(
        features=features,
        fitted=model.predict(X),
        intercept=model.intercept_,
        converged=model.converged_,
        **{name: getattr(model, f"{name}_") for name in SHARED},
    )


PENALISED_SOLVERS = {
    "alternating": (by_irwls, {"design": DenseDesign}),
    "fixed": (by_irwls, {"design": DenseDesign, "slow_decrease": math.inf, "max_iter": 100}),
    "newton": (by_irwls, {"design": DenseDesign, "slow_decrease": -1.0}),
    "as printed": (by_irwls, {"design": DenseDesign, "solver": "irwls"}),
    "Toeplitz": (by_irwls, {"design": EquispacedDesign}),
    **{
        f"MSVR {name}": (by_estimator, {"feature_map": name})
        for name in ("rff", "orf", "nystroem", "exact", "equispaced")
    },
}


GRID = ("Toeplitz", "MSVR equispaced")
"""Solvers on a grid, which need finufft."""
QUICK = ("ridge with intercept", "wide kernel", "all within the tube")
"""Problems that every solver solves by default; the usual one and each path solve all."""
ALL_BY_DEFAULT = ("alternating", "as printed")
STEP_BY_STEP = ("fixed", "one output"), ("fixed", "wide tube")
"""Where the equations of a fixed Gram matrix alone take thousands of iterations."""


@functools.cache
def known(name, shape, content):
    """Return fitted values, intercept and minimum for features, once for all solvers."""
    problem = PENALISED[name]
    Phi, (_, Y) = np.frombuffer(content).reshape(shape), problem.data()
    W, b = problem.reference(Phi, Y, problem)
    minimum = naive_msvr_objective(Phi, Y, W, b, problem.C, problem.epsilon)
    return Phi @ W + b, b, minimum


@pytest.mark.parametrize(
    ("solver", "name"),
    [
        pytest.param(
            solver,
            name,
            marks=() if solver in ALL_BY_DEFAULT or name in QUICK else pytest.mark.slow,
        )
        for solver in PENALISED_SOLVERS
        for name in PENALISED
    ],
)
def test_minimum_of_the_functional_is_found(solver, name):
    if solver in GRID:
        pytest.importorskip("finufft")
    problem, (solve, options) = PENALISED[name], PENALISED_SOLVERS[solver]
    found = solve(problem, **options)
    Phi = np.ascontiguousarray(found.features)
    fitted, b, minimum = known(name, Phi.shape, Phi.tobytes())
    assert minimum > 0.1 or problem.reference is mean_alone
    assert found.converged == (found.gap <= TOL)
    assert found.converged or (solver, name) in STEP_BY_STEP
    # L-BFGS ends within 1e-11 of the minimum; the gap is a bound, not only an estimate
    rounding = 1e-10 + TRANSFORMS * (solver in GRID)
    assert -rounding * minimum <= found.objective - minimum <= (found.gap + rounding) * minimum
    if problem.reference is ridge:
        atol = 1e-8 if solver in GRID else 1e-10
    elif found.converged:
        atol = 1e-5
    else:  # |W - W*|^2 <= 2 (F - F*), and rows of features have norm 1
        atol = 2 * math.sqrt(2 * found.gap * minimum)
    np.testing.assert_allclose(found.fitted, fitted, atol=atol, rtol=0)
    np.testing.assert_allclose(found.intercept, b, atol=atol, rtol=0)
    # one linear system, or none
    if problem.epsilon == 0:
        assert found.n_iter == 1
    assert len(found.objectives) == found.n_iter + 1
    assert (np.diff(found.objectives) <= 0).all()
    u = np.linalg.norm(problem.data()[1] - found.fitted, axis=1)
    assert found.support_fraction == pytest.approx(np.mean(u > problem.epsilon), abs=1e-12)


# nonlinear least squares, many rows at once


@dataclass(frozen=True)
class Squares:
    """Residuals of rows of parameters, their start, and the known ends (n_rows, n_parameters)."""

    residual: Callable
    start: torch.Tensor
    known: np.ndarray
    bounds: tuple | None = None
    atol: float = 1e-7


TIMES = torch.linspace(0, 4, 40, dtype=torch.float64)


def decay(theta):
    """Return a exp(-b t) + c."""
    return theta[:, :1] * torch.exp(-theta[:, 1:2] * TIMES) + theta[:, 2:3]


def decays(seed, lower=(-np.inf,) * 3, upper=(np.inf,) * 3):
    """Return noisy decays with other numbers in each row, each fitted by scipy."""
    rng = np.random.default_rng(seed)
    truth = torch.tensor(rng.uniform([0.5, 0.5, -1], [2, 2, 1], (6, 3)))
    data = decay(truth) + 0.02 * torch.tensor(rng.standard_normal((6, len(TIMES))))
    options = {"bounds": (lower, upper), "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-12}
    start = np.clip(np.ones(3), np.add(lower, 1e-3), np.subtract(upper, 1e-3))
    found = [
        optimize.least_squares(
            lambda theta, y=y: (y - decay(torch.tensor(theta)[None])[0]).numpy(), start, **options
        )
        for y in data
    ]
    assert min(one.cost for one in found) > 1e-4
    bounds = tuple(map(torch.tensor, (lower, upper))) if np.isfinite(lower).all() else None
    ends = np.array([one.x for one in found])
    return Squares(
        lambda theta, rows: data[rows] - decay(theta), torch.ones(6, 3).double(), ends, bounds
    )


def rosenbrock(start, bounds=None):
    def residual(theta, rows):
        x, y = theta[:, 0], theta[:, 1]
        return torch.stack([10 * (y - x**2), 1 - x], dim=1)

    start = torch.tensor(start).double()
    bounds = bounds and tuple(torch.tensor(one).double() for one in bounds)
    return Squares(residual, start, np.ones((len(start), 2)), bounds)


def linear():
    rng = np.random.default_rng(1)
    A, y = (torch.tensor(rng.standard_normal(shape)) for shape in ((20, 3), (4, 20)))
    known = np.linalg.lstsq(A.numpy(), y.numpy().T, rcond=None)[0].T
    return Squares(
        lambda theta, rows: y[rows] - theta @ A.T, torch.zeros(4, 3).double(), known, atol=1e-9
    )


def ridge_of_the_functional():
    """Return Eq. (7) without tube as least squares, an output a row, with ridge's coefficients."""
    problem = PENALISED["ridge"]
    X, Y = map(torch.tensor, problem.data())
    Phi = equispaced_fourier(X, problem.sigma, 1, 0, 1e-2)(X)
    known = ridge(Phi.numpy(), Y.numpy(), problem)[0].T

    def residual(theta, rows):
        return torch.cat([theta, math.sqrt(2 * problem.C) * (Y.T[rows] - theta @ Phi.T)], dim=1)

    return Squares(residual, torch.zeros(known.shape).double(), known, atol=1e-9)


def cosines():
    """Return curved residuals, along which Gauss-Newton's steps are four times too long."""
    start = torch.tensor([[0.1], [-0.15]]).double()
    return Squares(
        lambda theta, rows: torch.cat([theta, 1 - 0.05 * torch.cos(8 * theta)], dim=1),
        start,
        np.zeros((2, 1)),
        atol=1e-9,
    )


SQUARES = {
    "decays": lambda: decays(0),
    "decays within bounds": lambda: decays(4, (0.8, 0.7, -0.5), (1.6, 1.5, 0.5)),
    # the classical start, one on the other side, and the minimum itself
    "Rosenbrock": lambda: rosenbrock([[-1.2, 1.0], [3.0, -2.0], [1.0, 1.0]]),
    "Rosenbrock from bounds": lambda: rosenbrock(
        [[-1.5, 3.0], [2.0, -0.5], [1.9, 3.0]], ([-1.5, -0.5], [2.0, 3.0])
    ),
    "linear": linear,
    "ridge": ridge_of_the_functional,
    "curved": cosines,
}
SQUARES_SOLVERS = {
    "central": {},
    "one-sided": {"one_sided": True},
    "little damping": {"first_damping": 1e-9},
    "much damping": {"first_damping": 10.0},
    "accelerated": {"accelerated": True},
}


@functools.cache
def squares(name):
    return SQUARES[name]()


@pytest.mark.parametrize("solver", SQUARES_SOLVERS)
@pytest.mark.parametrize("name", SQUARES)
def test_least_sum_of_squares_is_found(name, solver):
    problem = squares(name)
    options = {"max_iter": 200, "bounds": problem.bounds} | SQUARES_SOLVERS[solver]
    found = LevenbergMarquardt(**options).minimise(problem.residual, problem.start)
    assert set(found.status.tolist()) == {RowStatus.SMALL_STEP}
    assert bool(found.converged.all())
    # one-sided differences are accurate to 1e-5, scipy's interior search ends 1e-7 short of a bound
    atol = 1e-5 if solver == "one-sided" else problem.atol
    np.testing.assert_allclose(found.parameters, problem.known, atol=atol, rtol=0)
    every = torch.arange(len(problem.start))
    costs = 0.5 * problem.residual(torch.tensor(problem.known), every).square().sum(dim=1)
    rtol = 1e-6 if problem.bounds else 1e-9
    np.testing.assert_allclose(found.cost, costs, rtol=rtol, atol=1e-12)
    if name == "curved" and solver == "central":
        assert found.n_iter <= 6
    if name == "decays within bounds":
        held = (found.parameters == problem.bounds[0]) | (found.parameters == problem.bounds[1])
        assert held.sum() > 4
        # what is pressed against a bound counts as without effect
        none = found.information.diagonal(dim1=1, dim2=2) == 0
        np.testing.assert_array_equal(none, held)
