"""The information of features against naive loops and against features with a known answer."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from suspnet.bounds.information import fisher_information
from suspnet.curves.curves import CurveObserver, CurveSettings
from suspnet.curves.extraction import FeatureTable, PeakFeatures
from suspnet.vehicle import PARAMETERS

of_features = pytest.importorskip("feature_information", reason="needs benchmarks")
feature_information, FEATURE_ROWS = of_features.feature_information, of_features.FEATURE_ROWS
SETTINGS = CurveSettings(step_hz=0.05, n_test=48, n_train=600, n_calibrate=None)
MIXING = torch.as_tensor(np.random.default_rng(0).normal(size=(5, 8)))
SCATTER = torch.as_tensor(np.random.default_rng(1).normal(size=(8, 8))) / 10
PROJECTION = torch.as_tensor(np.random.default_rng(2).normal(size=(8, 6)))


class LinearObserver:
    """Curves that are linear in the ratios, with correlated Gaussian noise."""

    frequencies_hz = torch.arange(1.0, 5.0, dtype=torch.float64)

    def noise_free(self, ratios):
        return (ratios @ MIXING).unflatten(1, (2, 4))

    def observe(self, ratios, seed):
        source = torch.Generator().manual_seed(seed)
        noise = torch.randn(len(ratios), 8, generator=source, dtype=torch.float64) @ SCATTER
        return self.noise_free(ratios) + noise.unflatten(1, (2, 4))


class LinearFeatures:
    """Six linear features of these curves; those above `limit` are missing."""

    names = tuple("abcdef")

    def __init__(self, limit=math.inf):
        self.limit = limit

    def extract(self, curves, frequencies_hz):
        values = curves.flatten(1) @ PROJECTION
        return FeatureTable(torch.where(values > self.limit, torch.nan, values), values.long())


class EveryBin:
    """The curves themselves as features."""

    def __init__(self, n_freq):
        self.names = tuple(f"bin_{k}" for k in range(2 * n_freq))

    def extract(self, curves, frequencies_hz):
        return FeatureTable(curves.flatten(1), torch.zeros(len(curves), 1, dtype=torch.int64))


def linear_information(parameters=PARAMETERS):
    jacobian = (MIXING @ PROJECTION).T[:, [PARAMETERS.index(name) for name in parameters]]
    covariance = PROJECTION.T @ SCATTER.T @ SCATTER @ PROJECTION
    return (jacobian.T @ torch.linalg.solve(covariance, jacobian)).numpy()


@pytest.fixture(scope="module")
def observer(quarter_car):
    return CurveObserver(SETTINGS, quarter_car)


# reference


@pytest.mark.parametrize("parameters", [PARAMETERS, ("c_p", "M_s")])
def test_linear_gaussian_features_have_the_known_information(parameters):
    ratios = np.random.default_rng(3).uniform(0.5, 2.0, (3000, 5))
    found = feature_information(LinearObserver(), LinearFeatures(), ratios, parameters, n_draws=16)
    expected = np.linalg.inv(linear_information(parameters))
    covariances = np.linalg.inv(found).mean(axis=0)
    # 16 draws of 6 features would give covariances 7 or 27 % too small on average, were nothing
    # taken out; the mean of 3000 Wishart matrices with 11 or 14 degrees of freedom is good to 1 %
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariances / scale, expected / scale, atol=0.03)


def test_information_of_peaks_is_that_of_naive_loops(observer):
    extractor = PeakFeatures(peaks=("secondary", "primary_upper"))
    ratios = np.random.default_rng(4).uniform(0.7, 1.4, (2, 5))
    names, n_draws = ("k_p", "c_s", "M_s"), FEATURE_ROWS
    found = feature_information(observer, extractor, ratios, names, n_draws=n_draws, seed=5)
    seeds = np.random.SeedSequence(5).generate_state(2)
    bins = observer.frequencies_hz
    for row, seed, matrix in zip(ratios, seeds, found, strict=True):
        copies = torch.as_tensor(row).expand(n_draws, 5)
        draws = extractor.extract(observer.observe(copies, int(seed)), bins).values.numpy()
        covariance = np.cov(draws.T)
        columns = []
        for name in names:
            sides = []
            for sign in (1, -1):
                moved = torch.as_tensor(row.copy())[None]
                moved[0, PARAMETERS.index(name)] *= 1 + sign * 0.01
                sides.append(extractor.extract(observer.noise_free(moved), bins).values[0].numpy())
            columns.append((sides[0] - sides[1]) / (0.02 * row[PARAMETERS.index(name)]))
        jacobian = np.stack(columns, axis=1)
        naive = jacobian.T @ np.linalg.inv(covariance) @ jacobian
        naive *= (n_draws - 1 - 6 + 3) / (n_draws - 1)
        np.testing.assert_allclose(matrix, naive, rtol=1e-6)


def test_every_bin_as_a_feature_has_the_information_of_the_curves(quarter_car):
    coarse = CurveObserver(replace(SETTINGS, step_hz=0.6, low_hz=0.6, high_hz=6.6), quarter_car)
    extractor = EveryBin(len(coarse.frequencies_hz))
    ratios = np.random.default_rng(6).uniform(0.8, 1.25, (60, 5))
    names = ("k_p", "c_p", "k_s")
    found = feature_information(coarse, extractor, ratios, names, n_draws=200)
    expected = fisher_information(coarse, ratios, names)
    # relative to what is right, the mean over vehicles is the unit matrix; 22 of 200 draws
    roots = np.linalg.cholesky(np.linalg.inv(expected))
    shape = roots.transpose(0, 2, 1) @ found @ roots
    np.testing.assert_allclose(shape.mean(axis=0), np.eye(3), atol=0.04)


# property


def test_incomplete_draws_are_left_out():
    ratios = np.ones((400, 5))
    top = ((torch.ones(5, dtype=torch.float64) @ MIXING) @ PROJECTION).max().item()
    spread = (PROJECTION.T @ SCATTER.T @ SCATTER @ PROJECTION).diagonal().max().sqrt().item()
    rare = LinearFeatures(limit=top + 2 * spread)
    found = feature_information(LinearObserver(), rare, ratios, n_draws=32)
    assert np.isfinite(found).all()
    whole = feature_information(LinearObserver(), LinearFeatures(), ratios, n_draws=32)
    assert 0 < np.mean(np.any(found != whole, axis=(1, 2))) < 1
    bounds = [np.sqrt(np.linalg.inv(part).mean(axis=0).diagonal()) for part in (found, whole)]
    np.testing.assert_allclose(bounds[0], bounds[1], rtol=0.1)
    # a vehicle that always or mostly lacks a feature is told
    always = feature_information(LinearObserver(), LinearFeatures(top - spread / 20), ratios[:9])
    assert np.isnan(always).all()
    spreads = (PROJECTION.T @ SCATTER.T @ SCATTER @ PROJECTION).diagonal().sqrt()
    tight = (torch.ones(5, dtype=torch.float64) @ MIXING) @ PROJECTION + spreads
    mostly = feature_information(LinearObserver(), LinearFeatures(tight), ratios[:9], n_draws=500)
    assert np.isnan(mostly).all()


def test_vehicle_without_a_feature_has_no_information(observer):
    ratios = np.array([[1.0] * 5, [1.0, 1.0, 0.5, 2.0, 0.5]])  # two peaks have melted into one
    healthy, damped = feature_information(observer, PeakFeatures(), ratios)
    assert np.isfinite(healthy).all()
    assert np.isnan(damped).all()


# failure


def test_too_few_draws_are_rejected(observer):
    with pytest.raises(ValueError, match="`n_draws` must be >= 22 for 9 features, got 21"):
        feature_information(observer, PeakFeatures(), np.ones((1, 5)), n_draws=21)
