"""Feature maps against the kernel they stand for."""

import numpy as np
import pytest
import torch
from scipy import stats
from sklearn.metrics.pairwise import rbf_kernel

from suspnet.learning.feature_maps import orthogonal_fourier, random_fourier
from suspnet.learning.msvr import MAPS

SIGMA = 1.3
FOURIER = [random_fourier, orthogonal_fourier]


def samples(n_samples=60, n_inputs=3, seed=0):
    return torch.tensor(np.random.default_rng(seed).standard_normal((n_samples, n_inputs)))


def gram(phi):
    return (phi @ phi.T).numpy()


def kernel(X, sigma=SIGMA):
    return rbf_kernel(X.numpy(), gamma=1 / sigma**2)


@pytest.mark.parametrize("make", FOURIER)
def test_fourier_error_is_centred_and_of_the_expected_size(make):
    X, n_components = samples(), 400
    upper = np.triu_indices(len(X), 1)
    draws = [gram(make(X, SIGMA, n_components, seed)(X)) for seed in range(20)]
    errors = np.array([draw - kernel(X) for draw in draws])[:, *upper]
    # A mean of D / 2 cosines, each of variance <= 1/2: standard deviation <= 1 / sqrt(D).
    limit = 1 / np.sqrt(n_components)
    assert np.abs(errors).max() < 5.5 * limit  # 35,400 normal draws stay below this
    assert 0.2 * limit < errors.std() < limit
    # Unbiased: the mean of 20 draws, at every pair of samples, in units of its own deviation.
    assert np.abs(errors.mean(axis=0)).max() < 5.5 * limit / np.sqrt(20)


@pytest.mark.parametrize("make", FOURIER)
def test_fourier_frequencies_are_marginally_normal(make):
    X = samples(1, n_inputs=4)
    draws = make(X, SIGMA, 8000, seed=3).random_weights.numpy() * SIGMA / np.sqrt(2)
    assert draws.shape == (4, 4000)
    # Kolmogorov-Smirnov at a fixed seed; a factor sqrt(2) in the lengths gives p < 1e-30.
    assert stats.kstest(draws[1], "norm").pvalue > 0.01
    lengths = (draws**2).sum(axis=0)
    assert stats.kstest(lengths, stats.chi2(4).cdf).pvalue > 0.01


def test_rff_error_is_smaller_than_that_of_scikit_learns_sampler_on_average():
    from sklearn.kernel_approximation import RBFSampler  # its cosines carry random offsets

    X, n = samples(40), 256

    def rms(phi):
        return np.sqrt(np.mean((phi - kernel(X)) ** 2))

    ours = [rms(gram(random_fourier(X, SIGMA, n, seed)(X))) for seed in range(10)]
    theirs = []
    for seed in range(10):
        sampler = RBFSampler(gamma=1 / SIGMA**2, n_components=n, random_state=seed)
        features = sampler.fit_transform(X.numpy())
        theirs.append(rms(features @ features.T))
    assert np.mean(ours) < np.mean(theirs)


@pytest.mark.parametrize("make", FOURIER)
def test_fourier_features_are_shift_invariant(make):
    X = samples()
    phi = make(X, SIGMA, 64, seed=0)
    shifted = X + torch.tensor([5.0, -3.0, 11.0])
    # Angles of about 100 carry rounding of 1e-14.
    np.testing.assert_allclose(gram(phi(shifted)), gram(phi(X)), atol=1e-12, rtol=0)


def test_orf_blocks_are_orthogonal():
    n_inputs, n_pairs = 3, 8
    frequencies = orthogonal_fourier(samples(), SIGMA, 2 * n_pairs, seed=2).random_weights
    assert frequencies.shape == (n_inputs, n_pairs)
    for start in range(0, n_pairs, n_inputs):
        block = frequencies[:, start : start + n_inputs]
        block = block / block.norm(dim=0)
        np.testing.assert_allclose(block.T @ block, np.eye(block.shape[1]), atol=1e-14)


def test_orf_beats_rff_for_a_wide_kernel():
    X, sigma = samples(60, n_inputs=6), 4.0

    def error(make):
        errors = [gram(make(X, sigma, 60, s)(X)) - kernel(X, sigma) for s in range(20)]
        return np.sqrt(np.mean(np.square(errors)))

    # a factor of 1.5 to 2 from sigma = 3 on.
    assert error(orthogonal_fourier) < 0.8 * error(random_fourier)


@pytest.mark.parametrize("name", sorted(MAPS))
def test_map_is_rebuilt_from_its_tensors(name):
    X = samples()
    phi = MAPS[name].make(X, SIGMA, 20, 0)
    again = MAPS[name].holds(**phi.tensors())
    assert torch.equal(again(X), phi(X))


@pytest.mark.parametrize("name", sorted(MAPS))
@pytest.mark.parametrize("n_outputs", [1, 3])
def test_apply_is_the_product_with_the_features(name, n_outputs):
    if name == "equispaced":
        pytest.importorskip("finufft")
    X = samples()
    phi = MAPS[name].make(X, SIGMA, 20, 0)
    coef = torch.tensor(np.random.default_rng(1).standard_normal((phi(X).shape[1], n_outputs)))
    expected = phi(X) @ coef
    assert float(expected.abs().max()) > 0.5
    # The non-uniform FFT is right to a hundredth of `kernel_tol`, times the coefficients.
    np.testing.assert_allclose(phi.apply(X, coef), expected, atol=1e-6, rtol=0)
