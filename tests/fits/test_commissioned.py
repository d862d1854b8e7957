"""A commissioned bogie as a vehicle of equal sides, and the fit of rigid ones: naive sums."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commissioned_example import NO_SCATTER
from vehicles import AM96

from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.trains.fits.commissioning import as_bogie
from suspnet.trains.fits.healthy_misfit import SPREAD, HealthyMisfit, HealthySpectra
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import OF_THE_TRIP, UNMEASURED, LogNormal

SETTINGS = EstimateSettings(
    segment_s=5.0, rates_hz=(1000.0, 500.0, 500.0), high_hz=9.9, body_high_hz=9.0
).bound(AM96)
MASSES = [0.95, 1.15]
GENERATOR = VerticalVehicle(AM96, parts=("bushings",), distribution="prior")


def trips(generator, numbers):
    """Return drawn spectra of healthy trips of a generator's vehicle."""
    source, groups = torch.Generator().manual_seed(4), []
    taps = moving_average_with(SETTINGS.welch.correlation().numpy())
    for mass, speed in zip(MASSES, (70.0, 55.0), strict=True):
        rows = torch.ones(1, 5, dtype=torch.float64)
        rows[0, 4], at = mass, Speeds((speed,), (1.0,))
        rows = generator.with_uncertain(rows, torch.as_tensor(numbers)[None])
        found = sample_spectra(SETTINGS.observer(generator).at(at).expected(rows), taps, source)
        spectra = CrossSpectra(found.auto[0], found.cross[0], found.n_averages)
        groups.append(HealthySpectra(at, spectra))
    return groups


def from_prior(generator, seed):
    """Return numbers drawn from a generator's distribution."""
    prior = generator.distribution
    return prior.ratios(np.random.default_rng(seed).standard_normal(len(prior.names)))


@pytest.fixture(scope="module")
def drawn():
    """Numbers from the prior, and the spectra of two healthy trips of such a vehicle."""
    numbers = from_prior(GENERATOR, 3)
    return numbers, trips(GENERATOR, numbers)


def known_bogie(names, logs, deviation=0.1):
    """Return a bogie with these numbers among others."""
    names, means = (*names, "conicity"), (*logs, 0.5)
    covariance = deviation**2 * np.eye(len(names))
    spatial = SimpleNamespace(distribution=LogNormal(names, means, covariance))
    return CommissionedBogie(spatial, None, np.array(MASSES), 1.2, True, NO_SCATTER)


# reference


def white(group, numbers, mass, spread):
    """Return the whitened misfit of a group bin by bin, from its definition."""
    row = np.ones(5 + len(UNMEASURED))
    row[4] = mass
    row[[5 + UNMEASURED.index(name) for name in GENERATOR.distribution.names]] = numbers
    observer = SETTINGS.observer(GENERATOR).at(group.speeds)
    misfit = observer.measured_misfit(group.spectra)
    if spread:
        misfit = misfit.thinned()
    expected = misfit.observer.noise_free(torch.as_tensor(row)[None])[0].numpy()
    observed, covariance = misfit.observed[0].numpy(), misfit.covariance[0].numpy()
    found, scale = [], np.sqrt(2 * misfit.weight / SETTINGS.welch.correlated_bins)
    for k in range(observed.shape[1]):
        used = np.isfinite(np.diag(covariance[:, :, k].real))
        ratio = (expected / observed)[used, k]
        u = -np.log(ratio) if spread else 1 - ratio
        part = covariance[:, :, k][np.ix_(used, used)] + spread**2 * np.eye(used.sum())
        found.append(scale * np.linalg.solve(np.linalg.cholesky(part), u))
    return np.concatenate(found), misfit.expected, 4 * observed.shape[1]


def test_misfit_and_score_are_those_written_naively(drawn):
    numbers, (group, _) = drawn
    target = HealthyMisfit(GENERATOR, SETTINGS, group)
    z = np.linalg.solve(GENERATOR.distribution.factor, np.log(numbers))
    theta = np.append(z, np.log(MASSES[0]))
    residuals, expected, n_points = white(group, numbers, MASSES[0], 0.0)
    square = np.sum(np.abs(residuals) ** 2)
    assert square > 10
    assert target.misfit(theta) == pytest.approx(np.sqrt(square / n_points / expected), rel=1e-9)
    residuals, _, n_points = white(group, numbers, MASSES[0], SPREAD)
    square = np.sum(np.abs(residuals) ** 2) + z @ z + (np.log(MASSES[0] / 1.05) / 0.15) ** 2
    rms = np.sqrt(square / (n_points + len(theta)))
    assert target.score(theta) == pytest.approx(rms, rel=1e-9)


# property


def test_a_search_explains_the_trip_as_well_as_the_truth():
    generator = VerticalVehicle(AM96, distribution="prior")
    numbers = from_prior(generator, 3)
    target = HealthyMisfit(generator, SETTINGS, trips(generator, numbers)[1])
    z = np.linalg.solve(generator.distribution.factor, np.log(numbers))
    truth, end = target.score(np.append(z, np.log(MASSES[1]))), target.score(target.search())
    assert end < 1.01 * truth < 0.5 * target.score(target.start())


def test_numbers_of_a_bogie_are_those_of_the_vehicle():
    names, logs = GENERATOR.distribution.names, np.log(from_prior(GENERATOR, 3))
    found = as_bogie(GENERATOR, known_bogie(names, logs))
    assert found.posterior.names == names
    np.testing.assert_allclose(found.posterior.mean, logs)
    np.testing.assert_allclose(found.posterior.covariance, 0.01 * np.eye(len(names)))
    assert found.generator.distribution == found.posterior.renewed(OF_THE_TRIP)


def test_numbers_that_a_bogie_lacks_keep_their_prior():
    found = as_bogie(GENERATOR, known_bogie(("healthy_k_p",), (0.2,)))
    prior, row = found.prior, found.prior.names.index("healthy_k_p")
    assert found.posterior.mean[row] == 0.2
    assert found.posterior.deviations[row] == pytest.approx(0.1)
    others = [i for i in range(len(prior.names)) if i != row]
    np.testing.assert_array_equal(found.posterior.deviations[others], prior.deviations[others])
