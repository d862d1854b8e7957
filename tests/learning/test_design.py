"""The design matrix in blocks, its products and its Gram matrix, against the whole matrix."""

import numpy as np
import pytest
import torch
from learning_reference import Mapped

from suspnet.learning.design import Coefficients, DenseDesign, Gradient
from suspnet.learning.feature_maps import orthogonal_fourier, random_fourier

SIGMA = 1.3


def samples(n_samples=60, n_inputs=3, seed=0):
    return torch.tensor(np.random.default_rng(seed).standard_normal((n_samples, n_inputs)))


def normal(*shape, seed=9):
    return torch.tensor(np.random.default_rng(seed).standard_normal(shape))


def linear(n_features):
    """A map to any number of features, odd ones too."""
    weights = normal(3, n_features, seed=5)
    return Mapped(lambda X: (X @ weights).sin())


def total_of_two(values):
    """The sum over two ranks that hold the same samples."""
    return values.mul_(2)


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


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("cache_bytes", [0, 400_000_000])
@pytest.mark.parametrize("block_rows", [7, 60])
def test_products_are_those_of_the_whole_matrix(block_rows, cache_bytes, dtype):
    X, change, V = samples().to(dtype), Coefficients(normal(21, 2), normal(2)), normal(60, 4)
    feature_map = linear(21)
    design = DenseDesign(
        Mapped(lambda rows: feature_map(rows.double()).to(dtype)),
        X,
        block_rows=block_rows,
        cache_bytes=cache_bytes,
    )
    Phi = feature_map(X.double()).to(dtype).double()
    seen = []

    def columns(rows, moved):
        seen.append(rows)
        return torch.cat([V[rows], moved.square()], dim=1)

    fitted = Phi @ change.coef + change.intercept
    moved, products = design.matvec_rmatvec(change, columns)
    atol = 1e-12 if dtype == torch.float64 else 1e-4
    assert moved.dtype == products.dtype == torch.float64
    assert [rows.start for rows in seen] == list(range(0, 60, block_rows))
    np.testing.assert_allclose(moved, fitted, atol=atol, rtol=0)
    expected = Phi.T @ torch.cat([V, fitted.square()], dim=1)
    np.testing.assert_allclose(products, expected, atol=20 * atol, rtol=0)
    np.testing.assert_allclose(design.rmatvec(V), Phi.T @ V, atol=atol, rtol=0)
    np.testing.assert_allclose(design.predict(change), fitted, atol=atol, rtol=0)


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


def test_gram_is_made_once_and_float32_is_summed_in_float64():
    calls, feature_map = [], linear(6)

    def counting(rows):
        calls.append(len(rows))
        return feature_map(rows.double()).float()

    X = samples(3000).float()
    design = DenseDesign(Mapped(counting), X, block_rows=100, cache_bytes=0)
    calls.clear()
    assert design.gram() is design.gram()
    assert sum(calls) == 3000
    Phi = feature_map(X.double()).float().double()
    # Blocks of 100 rows in float32 are right to about 1e-7 of 100, sums over 30 blocks no worse.
    np.testing.assert_allclose(design.gram().products, Phi.T @ Phi, atol=2e-4, rtol=0)


def test_gram_of_the_rest_is_the_difference():
    X, feature_map = samples(), orthogonal_fourier(samples(), SIGMA, 20, seed=0)
    whole, part, rest = (DenseDesign(feature_map, x).gram() for x in (X, X[:23], X[23:]))
    for gram in (whole - part, rest + part - part):
        np.testing.assert_allclose(gram.products, rest.products, atol=1e-12, rtol=0)
        np.testing.assert_allclose(gram.sums, rest.sums, atol=1e-12, rtol=0)
        assert gram.weight_sum == rest.weight_sum == 37
    assert (rest + part).weight_sum == whole.weight_sum == 60


@pytest.mark.parametrize("cache_bytes", [0, 400_000_000])
@pytest.mark.parametrize("sizes", [(20, 33, 7), (60,), (0, 60), (31, 0, 29)])
def test_joined_designs_are_one(sizes, cache_bytes):
    X, feature_map = samples(), linear(21)
    parts = [
        DenseDesign(feature_map, x, block_rows=8, cache_bytes=cache_bytes) for x in X.split(sizes)
    ]
    one = DenseDesign(feature_map, X)
    joined = DenseDesign.joined(parts, one.gram())
    V, change = normal(60, 2), Coefficients(normal(21, 2), normal(2))
    assert joined.n_features == 21
    assert joined.gram() is one.gram()
    np.testing.assert_allclose(joined.rmatvec(V), one.rmatvec(V), atol=1e-12, rtol=0)
    pairs = zip(
        joined.matvec_rmatvec(change, lambda rows, moved: V[rows] * moved),
        one.matvec_rmatvec(change, lambda rows, moved: V[rows] * moved),
        strict=True,
    )
    for found, expected in pairs:
        np.testing.assert_allclose(found, expected, atol=1e-11, rtol=0)
    w = WEIGHTS["a third"]
    found, expected = joined.weighted_gram(w), one.weighted_gram(w)
    np.testing.assert_allclose(found.products, expected.products, atol=1e-12, rtol=0)


def test_joined_designs_hold_no_second_copy_of_the_features():
    X, feature_map = samples(), linear(21)
    parts = [DenseDesign(feature_map, x) for x in X.split(20)]
    joined = DenseDesign.joined(parts, parts[0].gram())
    kept = [phi.data_ptr() for part in parts for _, phi in part]
    assert [phi.data_ptr() for _, phi in joined] == kept


def test_design_without_samples_sums_to_nothing():
    design = DenseDesign(linear(21), samples(0))
    change = Coefficients(normal(21, 2), normal(2))
    assert torch.equal(design.rmatvec(normal(0, 3)), torch.zeros(21, 3).double())
    moved, products = design.matvec_rmatvec(
        change, lambda rows, moved: torch.cat([moved, moved], dim=1)
    )
    assert moved.shape == (0, 2)
    assert torch.equal(products, torch.zeros(21, 4).double())
    for gram in (design.gram(), design.weighted_gram(normal(0))):
        assert gram.weight_sum == 0
        assert float(gram.products.abs().max()) == float(gram.sums.abs().max()) == 0
    assert design.predict(change).shape == (0, 2)


def test_products_are_summed_over_ranks():
    X, feature_map = samples(), linear(21)
    rank = DenseDesign(feature_map, X, total_of_two, block_rows=11)
    both = DenseDesign(feature_map, X.repeat(2, 1))
    V, change, w = normal(60, 2), Coefficients(normal(21, 2), normal(2)), WEIGHTS["a third"]
    np.testing.assert_allclose(rank.rmatvec(V), both.rmatvec(V.repeat(2, 1)), atol=1e-12, rtol=0)
    moved, products = rank.matvec_rmatvec(change, lambda rows, moved: moved)
    np.testing.assert_allclose(
        products, both.matvec_rmatvec(change, lambda rows, moved: moved)[1], atol=1e-12, rtol=0
    )
    assert moved.shape == (60, 2)
    found, expected = rank.weighted_gram(w), both.weighted_gram(w.repeat(2))
    np.testing.assert_allclose(found.products, expected.products, atol=1e-12, rtol=0)
    np.testing.assert_allclose(found.sums, expected.sums, atol=1e-12, rtol=0)
    assert found.weight_sum == pytest.approx(expected.weight_sum, rel=1e-14)


@pytest.mark.parametrize("weights", ["fixed", "some", "a third", "all zero"])
@pytest.mark.parametrize("fit_intercept", [False, True])
def test_directions_solve_the_dense_normal_equations(weights, fit_intercept):
    X, feature_map, C = samples(), linear(9), 7.0
    design, Phi = DenseDesign(feature_map, X), feature_map(X).numpy()
    w = torch.full((60,), 2 * C).double() if weights == "fixed" else WEIGHTS[weights]
    offset = normal(2) * (fit_intercept and weights != "all zero")
    gradient = Gradient(normal(9, 2), offset, w, normal(60, 2))
    equations = getattr(design, "fixed" if weights == "fixed" else "reweighted")(C, fit_intercept)
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
        design.fixed(1.0, True)
