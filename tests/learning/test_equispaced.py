"""Fourier modes on a regular grid, against the kernel, dense matrices and other solvers."""

import functools
import importlib
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from learning_reference import naive_rbf, smooth_data

from suspnet.learning import MSVR
from suspnet.learning.design import Coefficients, Gradient
from suspnet.learning.equispaced import MAX_BOX, EquispacedFeatures, equispaced_fourier
from suspnet.learning.toeplitz import ConjugateGradients, EquispacedDesign

needs_finufft = pytest.mark.skipif(
    importlib.util.find_spec("finufft") is None, reason="pip install suspnet[nufft]"
)
SHAPES = {  # n_inputs: (sigma, kernel_tol) with at most a few hundred features
    1: (0.5, 1e-9),
    2: (1.2, 1e-6),
    3: (2.5, 1e-4),
}
dimensions = pytest.mark.parametrize("n_inputs", sorted(SHAPES))


def samples(n_samples, n_inputs, seed=0):
    return torch.tensor(np.random.default_rng(seed).uniform(-2, 1, (n_samples, n_inputs)))


def normal(*shape, seed=9):
    return torch.tensor(np.random.default_rng(seed).standard_normal(shape))


def modes_of(n_inputs, kernel_tol=None):
    sigma, tol = SHAPES[n_inputs]
    return equispaced_fourier(samples(60, n_inputs), sigma, 1, 0, kernel_tol or tol)


@functools.cache
def problem(n_inputs):
    """A design, its features as a matrix, and half the accuracy of its transforms."""
    modes, X = modes_of(n_inputs), samples(40, n_inputs, seed=1)
    return EquispacedDesign(modes, X), modes(X).numpy()


def kernel_error(modes, X, Z, sigma):
    return np.abs((modes(X) @ modes(Z).T).numpy() - naive_rbf(X.numpy(), Z.numpy(), sigma)).max()


@given(
    extents=st.lists(st.one_of(st.just(0.0), st.floats(0.0, 5.0)), min_size=1, max_size=3),
    log_sigma=st.floats(-1, 1),
    log_tol=st.floats(-9, -2),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=100)
def test_kernel_is_right_to_its_tolerance(extents, log_sigma, log_tol, seed):
    sigma, kernel_tol, n_inputs = 10**log_sigma, 10**log_tol, len(extents)
    rng, extents = np.random.default_rng(seed), sigma * np.array(extents)
    corners = np.stack([np.zeros(n_inputs), extents])
    X = torch.tensor(np.vstack([corners, rng.uniform(size=(8, n_inputs)) * extents]) - 3 * sigma)
    modes = equispaced_fourier(X, sigma, 1, 0, kernel_tol)
    assume(modes.n_features < 20_000)
    # Anywhere within sigma outside the box of the data, its corners included.
    outside = np.vstack([corners, rng.uniform(size=(6, n_inputs)) * extents]) - 3 * sigma
    outside[:2] += sigma * np.array([[-1], [1]])
    outside[2:] += rng.uniform(-sigma, sigma, (6, n_inputs))
    assert kernel_error(modes, X, X, sigma) <= kernel_tol
    assert kernel_error(modes, torch.tensor(outside), X, sigma) <= kernel_tol


@dimensions
def test_tolerance_is_used_up_and_decides_the_number_of_modes(n_inputs):
    X, (sigma, _) = samples(60, n_inputs), SHAPES[n_inputs]
    found = [modes_of(n_inputs, tol) for tol in (1e-2, 1e-4)]
    assert found[0].n_features < found[1].n_features
    errors = [kernel_error(modes, X, X, sigma) for modes in found]
    # More modes than needed would cost time for nothing.
    assert 1e-3 * 1e-2 < errors[0] < 1e-2
    assert 1e-3 * 1e-4 < errors[1] < 1e-4


@dimensions
def test_modes_are_those_of_the_docstring(n_inputs):
    sigma, _ = SHAPES[n_inputs]
    modes = modes_of(n_inputs)
    waves, x = modes.wave_numbers.numpy(), samples(1, n_inputs, seed=2)
    theta, z = waves * modes.spacing.numpy(), (x - modes.centre).numpy()[0]
    # The trapezoidal rule on the kernel's spectral density, normal with variance 2 / sigma^2.
    density = np.exp(-(sigma**2) * (theta**2).sum(axis=1) / 4) * (
        sigma**n_inputs / (2 * math.sqrt(math.pi)) ** n_inputs
    )
    strengths = density * np.prod(modes.spacing.numpy())
    np.testing.assert_allclose(modes.strengths, strengths, rtol=1e-12)
    cosines = [math.sqrt(2 * s) * math.cos(t @ z) for s, t in zip(strengths, theta, strict=True)]
    sines = [math.sqrt(2 * s) * math.sin(t @ z) for s, t in zip(strengths, theta, strict=True)]
    cosines[0] /= math.sqrt(2)
    np.testing.assert_allclose(modes(x)[0], cosines + sines[1:], atol=1e-12, rtol=0)
    # One of each pair k and -k, the constant first, and no other left out within the radius.
    both = {tuple(k) for k in waves} | {tuple(-k) for k in waves}
    assert len(both) == modes.n_features == 2 * len(waves) - 1
    assert not waves[0].any()
    assert (np.diff(np.linalg.norm(theta, axis=1)) >= 0).all()
    radius = np.linalg.norm(theta[-1])
    axes = [np.arange(-c - 1, c + 2) for c in np.abs(waves).max(axis=0)]
    box = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n_inputs)
    within = np.linalg.norm(box * modes.spacing.numpy(), axis=1) <= radius * (1 - 1e-12)
    assert {tuple(k) for k in box[within]} <= both


@dimensions
def test_points_farther_out_are_moved_to_the_border(n_inputs):
    modes, sigma = modes_of(n_inputs), SHAPES[n_inputs][0]
    X = samples(60, n_inputs)
    low, high = X.min(dim=0).values, X.max(dim=0).values
    far = 100 * normal(20, n_inputs)
    border = torch.maximum(torch.minimum(far, high + sigma), low - sigma)
    np.testing.assert_allclose(modes(far), modes(border), atol=1e-11, rtol=0)
    just_inside = low - 0.999 * sigma
    assert float((modes(just_inside[None]) - modes(low[None] - sigma)).abs().max()) > 1e-6


@needs_finufft
@dimensions
@pytest.mark.parametrize("n_outputs", [1, 2, 3])
def test_transforms_are_products_with_the_features(n_inputs, n_outputs):
    design, Phi = problem(n_inputs)
    W, V = normal(Phi.shape[1], n_outputs), normal(40, n_outputs)
    b, kernel_tol = normal(n_outputs), SHAPES[n_inputs][1]
    atol = kernel_tol * max(1, np.abs(Phi @ W.numpy()).max())
    np.testing.assert_allclose(design.matvec(W), Phi @ W.numpy(), atol=atol, rtol=0)
    X = samples(40, n_inputs, seed=1)
    np.testing.assert_allclose(design.modes.apply(X, W), Phi @ W.numpy(), atol=atol, rtol=0)
    np.testing.assert_allclose(design.rmatvec(V), Phi.T @ V.numpy(), atol=10 * atol, rtol=0)
    moved, products = design.matvec_rmatvec(
        Coefficients(W, b), lambda rows, change: V[rows] * change
    )
    fitted = Phi @ W.numpy() + b.numpy()
    np.testing.assert_allclose(moved, fitted, atol=atol, rtol=0)
    np.testing.assert_allclose(products, Phi.T @ (V.numpy() * fitted), atol=100 * atol, rtol=0)


@needs_finufft
@dimensions
def test_toeplitz_sums_are_those_of_the_docstring(n_inputs):
    design, _ = problem(n_inputs)
    w, angles = normal(40).abs(), design.modes.angles(samples(40, n_inputs, seed=1)).numpy()
    found = design.toeplitz(w).numpy()
    assert found.shape == tuple(4 * count + 1 for count in design.counts)
    rng = np.random.default_rng(0)
    doubled = 2 * np.array(design.counts)
    for k in [0 * doubled, doubled, -doubled, *rng.integers(-doubled, doubled, (30, n_inputs))]:
        naive = sum(w[i] * np.exp(-1j * (k @ angles[i])) for i in range(40))
        assert abs(found[tuple(k + doubled)] - naive) < SHAPES[n_inputs][1] * float(w.sum())


@needs_finufft
@dimensions
def test_spectrum_is_a_unitary_change_of_basis(n_inputs):
    design, Phi = problem(n_inputs)
    vector, other = normal(Phi.shape[1], 3), normal(Phi.shape[1], 3, seed=2)
    scale = design.modes.strengths.sqrt()
    f, g = design.spectrum(vector) / scale, design.spectrum(other) / scale
    # f_-k is the conjugate of f_k: k and -k count alike, the constant once.
    inner = (f.conj() * g).real
    inner = 2 * inner.sum(dim=1) - inner[:, 0]
    np.testing.assert_allclose(inner, (vector * other).sum(dim=0), atol=1e-11, rtol=0)
    back = design.real(design.spectrum(vector) / design.modes.strengths)
    np.testing.assert_allclose(back, vector, atol=1e-12, rtol=0)
    waves, angles = design.waves.numpy(), design.modes.angles(samples(40, n_inputs, seed=1))
    phases = np.exp(1j * angles.numpy() @ waves.T)
    spectra = design.spectrum(vector).numpy()
    fitted = 2 * (phases @ spectra.T).real - spectra[:, 0].real
    np.testing.assert_allclose(fitted, Phi @ vector.numpy(), atol=1e-10, rtol=0)


WEIGHTS = {
    "fixed": np.full(40, 2 * 3.0),
    "some": np.maximum(normal(40).numpy(), 0),
    "all zero": np.zeros(40),
}
weighted = pytest.mark.parametrize("weights", sorted(WEIGHTS))
intercepts = pytest.mark.parametrize("fit_intercept", [False, True])


def equations_at(design, weights, fit_intercept):
    """Equations that hold the given weights, and their gradient."""
    w = torch.tensor(WEIGHTS[weights])
    n_features = design.n_features
    offset = normal(2) * (fit_intercept and weights != "all zero")
    gradient = Gradient(normal(n_features, 2), offset, w, normal(len(w), 2))
    kind = "fixed" if weights == "fixed" else "reweighted"
    return design.equations(kind, 3.0, fit_intercept), gradient


SOLVERS = {
    "whole": ConjugateGradients(800, 2000, 100, forcing=1e-15),
    "part": ConjugateGradients(10, 10, 100, forcing=1e-15),
    "growing": ConjugateGradients(3, 25, 2, forcing=1e-15),
}


@needs_finufft
@dimensions
@weighted
@intercepts
@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_direction_solves_the_dense_normal_equations(n_inputs, weights, fit_intercept, solver):
    modes = modes_of(n_inputs, {1: 1e-10, 2: 1e-6, 3: 1e-3}[n_inputs])
    X = samples(40, n_inputs, seed=1)
    Phi = modes(X).numpy()
    design = EquispacedDesign(modes, X, solver=SOLVERS[solver])
    equations, gradient = equations_at(design, weights, fit_intercept)
    found = equations.direction(gradient, 1e-14)
    w = WEIGHTS[weights]
    extended = np.column_stack([Phi, np.ones(40)]) if fit_intercept else Phi
    hessian = extended.T @ (w[:, None] * extended)
    hessian[: Phi.shape[1], : Phi.shape[1]] += np.eye(Phi.shape[1])
    right = -np.vstack([gradient.coef, gradient.intercept])[: len(hessian)]
    expected = np.linalg.lstsq(hessian, right, rcond=1e-13)[0]
    # The transforms are right to a hundredth of the tolerance, the condition is 1e3 or less.
    atol = 1e-6 if n_inputs == 1 else 20 * float(modes.kernel_tol)
    np.testing.assert_allclose(found.coef, expected[: Phi.shape[1]], atol=atol, rtol=0)
    if fit_intercept:
        np.testing.assert_allclose(found.intercept, expected[-1], atol=atol, rtol=0)
    else:
        assert found.intercept.count_nonzero() == 0


def data(n_inputs, n_outputs=2, n_samples=120):
    X, Y = smooth_data(n_inputs, n_samples, n_inputs)
    return X, np.column_stack([Y, Y[:, 0] * Y[:, 1]])[:, :n_outputs]


ALL = list(itertools.product((1, 2), (0.0, 1e-3, 0.1), (1, 2, 3)))
DEFAULT = [(1, 0.1, 3), (2, 1e-3, 1), (2, 0.1, 2)]
CASES = [
    *(pytest.param(*case, marks=() if case in DEFAULT else pytest.mark.slow) for case in ALL),
    *(pytest.param(3, epsilon, 2, marks=pytest.mark.slow) for epsilon in (0.0, 0.1)),
]


def fitted(feature_map, n_inputs, epsilon, n_outputs, fit_intercept=True, **setting):
    X, Y = data(n_inputs, n_outputs, 60 if n_inputs == 3 else 120)
    sigma = 2.5 if n_inputs == 3 else 1.5
    setting = {"tol": 1e-10, "max_iter": 3000} | setting
    model = MSVR(10.0, sigma, epsilon, feature_map, fit_intercept=fit_intercept, **setting)
    # Up to 0.2 outside the box of the data.
    return model.fit(X, Y).predict(X[:50] * 1.1)


@pytest.mark.every_value
@needs_finufft
@intercepts
@pytest.mark.parametrize(("n_inputs", "epsilon", "n_outputs"), CASES)
def test_predictions_are_those_of_the_exact_kernel(n_inputs, epsilon, n_outputs, fit_intercept):
    expected = fitted("exact", n_inputs, epsilon, n_outputs, fit_intercept)
    found = fitted("equispaced", n_inputs, epsilon, n_outputs, fit_intercept)
    assert np.abs(expected).max() > 0.5
    np.testing.assert_allclose(found, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("at", ["fit", "predict"])
def test_missing_finufft_is_named(monkeypatch, at):
    X, Y = data(1)
    model = MSVR(feature_map="equispaced", sigma=1.0)
    if at == "predict":
        pytest.importorskip("finufft")
        model.fit(X, Y)
    plain = importlib.import_module

    def without(name, *args):
        if name == "finufft":
            raise ImportError(name)
        return plain(name, *args)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(ValueError, match=r"pip install finufft.*, or use feature_map='rff'"):
        model.fit(X, Y) if at == "fit" else model.predict(X)


def state_of_a_model():
    modes = equispaced_fourier(samples(60, 2), 1.0, 1, 0)
    arrays = {f"map.{name}": tensor.numpy().copy() for name, tensor in modes.tensors().items()}
    n_features = modes.n_features
    return arrays | {"coef": np.ones((n_features, 1)), "intercept": np.zeros(1)}


BROKEN = {
    "missing column": ("wave_numbers", lambda k: k[:, :1]),
    "flat": ("wave_numbers", lambda k: k[:, 0]),
    "no whole numbers": ("wave_numbers", lambda k: k + 0.5),
    "enormous": ("wave_numbers", lambda k: k * 1e6),
    "infinite": ("wave_numbers", lambda k: np.where(k > 0, np.inf, k)),
    "constant not first": ("wave_numbers", lambda k: k[::-1]),
    "negative": ("strengths", lambda s: -s),
    "too few": ("strengths", lambda s: s[:-1]),
    "one spacing": ("spacing", lambda s: s[:1]),
    "scalar centre": ("centre", lambda c: c[0]),
    "three reaches": ("reach", lambda r: np.ones(3)),
    "no rows": ("wave_numbers", lambda k: k[:0]),
    "negative reach": ("reach", lambda r: -r),
    "NaN tolerance": ("kernel_tol", lambda t: t * np.nan),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_tampered_arrays_are_refused(broken):
    name, change = BROKEN[broken]
    state = state_of_a_model()
    state[f"map.{name}"] = np.ascontiguousarray(change(state[f"map.{name}"]))
    model = MSVR(feature_map="equispaced", sigma=1.0)
    assert model.restore(state_of_a_model()).n_features_in_ == 2
    with pytest.raises(ValueError, match="not those of an equispaced"):
        model.restore(state)


@pytest.mark.parametrize("count", [MAX_BOX // 2, 2**40, 1e300])
def test_enormous_grids_are_refused_before_anything_is_made(count):
    one = torch.ones(1).double()
    waves = torch.tensor([[0.0], [float(count)]], dtype=torch.float64)
    arrays = {"spacing": one, "centre": one, "reach": one, "kernel_tol": one[0] * 1e-6}
    with pytest.raises(ValueError, match="not those of an equispaced feature map"):
        EquispacedFeatures(waves, torch.ones(2).double(), **arrays)


@needs_finufft
@pytest.mark.parametrize(
    ("n_inputs", "settings", "message"),
    [
        (4, {}, r"at most 3 inputs, got 4: .*feature_map='rff'"),
        (3, {"sigma": 1e-6}, r"sigma=1e-06.* raise sigma or kernel_tol, or .*'rff'"),
        (1, {"sigma": 1e-308}, "raise sigma"),
        (1, {"kernel_tol": 2.5}, "`kernel_tol`"),
        (1, {"device": "cuda"}, "runs on the CPU: set device='cpu'"),
        (2, {"C": 1e17, "sigma": 1.0}, "singular to working precision"),
    ],
)
def test_what_it_cannot_fit_is_refused(n_inputs, settings, message):
    X, Y = data(n_inputs)
    with pytest.raises(ValueError, match=message):
        MSVR(feature_map="equispaced", **settings).fit(X, Y)
