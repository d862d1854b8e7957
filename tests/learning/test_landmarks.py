"""Maps from landmarks: Nystroem by randomly pivoted Cholesky, and the exact kernel."""

import numpy as np
import pytest
import torch
from learning_reference import naive_rbf
from scipy import stats

from suspnet.learning import feature_maps
from suspnet.learning.feature_maps import exact, nystroem, partial_cholesky

SIGMA = 1.3


def samples(n_samples=60, n_inputs=3, seed=0):
    return torch.tensor(np.random.default_rng(seed).standard_normal((n_samples, n_inputs)))


def gram(phi):
    return (phi @ phi.T).numpy()


def kernel(X, sigma=SIGMA):
    return naive_rbf(X.numpy(), X.numpy(), sigma)


def test_exact_map_is_the_kernel_between_training_samples_and_new_points():
    X, Z = samples(), samples(9, seed=5)
    expected = naive_rbf(Z.numpy(), X.numpy(), SIGMA)
    np.testing.assert_allclose(exact(X, SIGMA, 1, 0)(Z).numpy(), expected, rtol=1e-12)


def test_nystroem_with_all_points_is_exact():
    X, sigma = samples(), 0.7
    phi = nystroem(X, sigma, len(X), seed=0)
    assert len(phi.landmarks) == len(X)
    np.testing.assert_allclose(gram(phi(X)), exact(X, sigma, 1, 0)(X), atol=1e-8, rtol=0)


def test_nystroem_never_exceeds_the_kernel_and_improves():
    X = samples(100)
    gaps = [kernel(X) - gram(nystroem(X, SIGMA, n, seed=1)(X)) for n in (10, 30, 60)]
    for gap in gaps:  # the Schur complement is positive semidefinite
        assert np.linalg.eigvalsh(gap).min() > -1e-10
    traces = [np.trace(gap) for gap in gaps]
    assert traces[0] > 2 * traces[1] > 4 * traces[2] > 0


def naive_residual(X, pivots, sigma):
    """What is left of the kernel's diagonal: the Schur complement, from a dense solve."""
    K = kernel(X, sigma)
    known = K[:, pivots]
    return 1 - np.einsum("ij,ji->i", known, np.linalg.solve(K[np.ix_(pivots, pivots)], known.T))


@pytest.mark.every_value
@pytest.mark.parametrize("kernel_tol", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("sigma", [0.7, 3.0])
def test_landmarks_are_as_many_as_the_tolerance_needs(sigma, kernel_tol):
    X = samples(200, n_inputs=2)
    pivots = partial_cholesky(X, sigma, 200, 0, kernel_tol)[0].tolist()
    assert 3 < len(pivots) < 200
    assert naive_residual(X, pivots, sigma).mean() <= kernel_tol
    # Up to 64 are taken at a time, so the last step may go too far, by one batch.
    assert naive_residual(X, pivots[:-64], sigma).mean() > kernel_tol if len(pivots) > 64 else True
    assert len(pivots) <= len(partial_cholesky(X, sigma, 200, 0, kernel_tol / 10)[0])
    phi = nystroem(X, sigma, 200, 0, kernel_tol)
    assert len(phi.landmarks) == len(pivots)
    error = kernel(X, sigma) - gram(phi(X))
    assert -1e-9 < np.trace(error) / 200 <= kernel_tol * (1 + 1e-6) + 1e-9


def test_number_of_components_caps_the_landmarks():
    X = samples(200)
    for n in (1, 5, 63, 64, 65, 130):
        pivots = partial_cholesky(X, 0.3, n, 0, 1e-6)[0].tolist()
        assert len(set(pivots)) == len(pivots) == n
    assert nystroem(X, 0.3, 7, 0).landmarks.shape == (7, 3)
    assert len(nystroem(X, 0.3, 1000, 0).landmarks) == 200


@pytest.mark.parametrize(
    "n_proposals", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2)), 64]
)
def test_pivots_are_drawn_like_one_at_a_time(n_proposals):
    # Two close to each other, two clusters farther off: the residual differs much between samples.
    X, n_draws = torch.tensor([[0.0], [0.3], [1.0], [1.2], [2.5]]).double(), 400
    draws = [
        tuple(partial_cholesky(X, 1.0, 3, seed, n_proposals=n_proposals)[0].tolist())
        for seed in range(n_draws)
    ]
    # Every ordered triple: each pivot in proportion to what the Schur complement leaves.
    expected = {}
    for i in range(5):
        second = naive_residual(X, [i], 1.0).clip(0)
        for j in set(range(5)) - {i}:
            third = naive_residual(X, [i, j], 1.0).clip(0)
            for k in set(range(5)) - {i, j}:
                expected[i, j, k] = second[j] / second.sum() * third[k] / third.sum() / 5
    assert sum(expected.values()) == pytest.approx(1)
    counts = {triple: 0 for triple in expected}
    for triple in draws:
        counts[triple] += 1
    found, probable = np.array(list(counts.values())), np.array(list(expected.values())) * n_draws
    common = probable > 5  # the rest together, as chi-square needs
    found = np.append(found[common], found[~common].sum())
    probable = np.append(probable[common], probable[~common].sum())
    # At fixed seeds; uniform second pivots give p < 1e-12.
    assert stats.chisquare(found, probable).pvalue > 0.005
    assert probable.max() > 3 * probable.min()


def test_candidates_are_a_random_part_of_many_samples():
    X = samples(400, n_inputs=2)
    first, again, other = (
        nystroem(X, 0.2, 300, seed, n_candidates=50).landmarks for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    places = [int((X == landmark).all(dim=1).nonzero()) for landmark in first]
    assert len(set(places)) == len(places) <= 50
    assert max(places) > 300  # from everywhere
    assert min(places) < 100
    assert len(nystroem(X[:50], 0.2, 50, 0).landmarks) > 40  # as many as there are: all


@pytest.mark.parametrize("kernel_tol", [1e-30, 5e-324])
def test_tiny_tolerance_ends_at_rounding(kernel_tol):
    X = samples(40, n_inputs=1)
    pivots = partial_cholesky(X, 3.0, 40, 0, kernel_tol)[0].tolist()
    assert 8 < len(pivots) < 40
    assert len(set(pivots)) == len(pivots)
    phi = nystroem(X, 3.0, 40, 0, kernel_tol)
    np.testing.assert_allclose(gram(phi(X)), kernel(X, 3.0), atol=1e-7, rtol=0)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("error", [-1e-3, 1e-3, 0.5])
@pytest.mark.parametrize("everywhere", [True, False])
def test_search_ends_whatever_the_rounding_of_the_kernel(monkeypatch, error, everywhere):
    """Errors of the proposals' block beyond all residuals once let no proposal be accepted."""
    source = torch.Generator().manual_seed(0)

    def inexact(X, Z, sigma):
        found = torch.exp((X[:, None] - Z).square().sum(dim=2) / -(sigma**2))
        if len(X) == len(Z):
            found.diagonal().add_(error)
        if everywhere:
            found += error * torch.rand(found.shape, generator=source, dtype=found.dtype)
        return found

    monkeypatch.setattr(feature_maps, "rbf_kernel", inexact)
    pivots = partial_cholesky(samples(100, n_inputs=2), 1.5, 100, 0, 1e-9)[0].tolist()
    assert 3 < len(pivots) <= 100
    assert len(set(pivots)) == len(pivots)
