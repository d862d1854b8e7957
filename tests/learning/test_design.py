"""The design matrix in blocks, its products and its Gram matrix, against the whole matrix."""

import numpy as np
import pytest
import torch
from learning_reference import Mapped

from suspnet.learning.design import Coefficients, DenseDesign, Gradient
from suspnet.learning.feature_maps import random_fourier

SIGMA = 1.3


def samples(n_samples=60, n_inputs=3, seed=0):
    return torch.tensor(np.random.default_rng(seed).standard_normal((n_samples, n_inputs)))


def normal(*shape, seed=9):
    return torch.tensor(np.random.default_rng(seed).standard_normal(shape))


def linear(n_features):
    """A map to any number of features, odd ones too."""
    weights = normal(3, n_features, seed=5)
    return Mapped(lambda X: (X @ weights).sin())


@pytest.mark.parametrize("cache_bytes", [0, 400_000_000])
@pytest.mark.parametrize("block_rows", [1, 7, 60, 1000])
def test_blocks_make_up_the_whole_matrix(cache_bytes, block_rows):
    X = samples()
    phi = random_fourier(X, SIGMA, 20, seed=0)
    blocks = DenseDesign(phi, X, block_rows=block_rows, cache_bytes=cache_bytes)
    found = torch.full((len(X), blocks.n_features), torch.nan, dtype=X.dtype)
    for rows, block in blocks:
        assert len(block) <= block_rows
        found[rows] = block
    # Matrix products of other heights may round differently.
    np.testing.assert_allclose(found, phi(X), atol=1e-14, rtol=0)


@pytest.mark.parametrize("cache_bytes", [0, 400_000_000])
@pytest.mark.parametrize("block_rows", [7, 60])
def test_products_are_those_of_the_whole_matrix(block_rows, cache_bytes):
    X, change, V = samples(), Coefficients(normal(21, 2), normal(2)), normal(60, 4)
    feature_map = linear(21)
    design = DenseDesign(feature_map, X, block_rows=block_rows, cache_bytes=cache_bytes)
    Phi = feature_map(X)
    seen = []

    def columns(rows, moved):
        seen.append(rows)
        return torch.cat([V[rows], moved.square()], dim=1)

    fitted = Phi @ change.coef + change.intercept
    moved, products = design.matvec_rmatvec(change, columns)
    atol = 1e-12
    assert [rows.start for rows in seen] == list(range(0, 60, block_rows))
    np.testing.assert_allclose(moved, fitted, atol=atol, rtol=0)
    expected = Phi.T @ torch.cat([V, fitted.square()], dim=1)
    np.testing.assert_allclose(products, expected, atol=20 * atol, rtol=0)
    np.testing.assert_allclose(design.rmatvec(V), Phi.T @ V, atol=atol, rtol=0)


WEIGHTS = {
    "none": None,
    "some": normal(60).abs(),
    "a third": normal(60).clamp(min=0.4) - 0.4,
    "whole blocks": torch.cat([torch.zeros(20), torch.ones(20), torch.zeros(20)]).double(),
    "all zero": torch.zeros(60).double(),
}


@pytest.mark.parametrize("weights", sorted(WEIGHTS))
@pytest.mark.parametrize(("n_features", "stripe"), [(21, 256), (21, 5), (21, 7), (1, 1), (8, 3)])
def test_weighted_gram_is_that_of_the_whole_matrix(weights, n_features, stripe):
    X, feature_map, w = samples(), linear(n_features), WEIGHTS[weights]
    found = DenseDesign(feature_map, X, block_rows=11, gram_columns=stripe).weighted_gram(w)
    Phi, w = feature_map(X), torch.ones(60).double() if w is None else w
    np.testing.assert_allclose(found.products, Phi.T @ (w[:, None] * Phi), atol=1e-12, rtol=0)
    np.testing.assert_allclose(found.sums, Phi.T @ w, atol=1e-12, rtol=0)
    assert found.weight_sum == pytest.approx(float(w.sum()), rel=1e-14, abs=0)
    assert torch.equal(found.products, found.products.T)


def test_samples_of_weight_zero_cost_no_product():
    X, feature_map, heights = samples(), linear(5), []

    class Watched(torch.Tensor):
        def __matmul__(self, other):
            heights.append(self.shape[1])
            return super().__matmul__(other)

    watched = Mapped(lambda rows: feature_map(rows).as_subclass(Watched))
    design = DenseDesign(watched, X, block_rows=30)
    design.weighted_gram(torch.cat([torch.ones(4), torch.zeros(56)]).double())
    assert sum(heights) == 4


@pytest.mark.parametrize("weights", ["fixed", "some", "a third", "all zero"])
@pytest.mark.parametrize("fit_intercept", [False, True])
def test_directions_solve_the_dense_normal_equations(weights, fit_intercept):
    X, feature_map, C = samples(), linear(9), 7.0
    design, Phi = DenseDesign(feature_map, X), feature_map(X).numpy()
    w = torch.full((60,), 2 * C).double() if weights == "fixed" else WEIGHTS[weights]
    offset = normal(2) * (fit_intercept and weights != "all zero")
    gradient = Gradient(normal(9, 2), offset, w, normal(60, 2))
    kind = "fixed" if weights == "fixed" else "reweighted"
    equations = design.equations(kind, C, fit_intercept)
    found = equations.direction(gradient, 0.0)
    extended = np.column_stack([Phi, np.ones(60)]) if fit_intercept else Phi
    hessian = extended.T @ (w.numpy()[:, None] * extended)
    hessian[:9, :9] += np.eye(9)
    right = -np.vstack([gradient.coef, gradient.intercept])[: len(hessian)]
    expected = np.linalg.lstsq(hessian, right, rcond=1e-13)[0]
    np.testing.assert_allclose(found.coef, expected[:9], atol=1e-10, rtol=0)
    assert fit_intercept or found.intercept.count_nonzero() == 0
    if fit_intercept:
        np.testing.assert_allclose(found.intercept, expected[9], atol=1e-10, rtol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_features_that_are_no_numbers_are_an_error(bad):
    design = DenseDesign(Mapped(lambda X: torch.full((len(X), 4), bad, dtype=X.dtype)), samples())
    with pytest.raises(ValueError, match=r"4 x 4 system .* singular to working precision"):
        design.equations("fixed", 1.0, True)
