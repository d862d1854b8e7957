"""Residuals of curves and of estimates from trips against loops; their information and size."""

import math
from dataclasses import replace

import numpy as np
import pytest
import reference
import torch
from vehicles import AM96

from suspnet.bounds.information import fisher_information
from suspnet.curves.curves import CurveMisfit, CurveSettings
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.expected_spectra import EstimateMisfit
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle

CURVES = CurveSettings(snr_db=30.0, low_hz=0.3, high_hz=12.0, step_hz=0.1)
TRIPS = EstimateSettings(snr_db=30.0, minutes=10.0, high_hz=9.9).bound(AM96)
QUARTER_CAR, PITCHING = QuarterCar(AM96), VerticalVehicle(AM96)
HANN = 1 + 2 * (4 / 9 + 1 / 36)
"""r of a Hann window: neighbours correlate by 4/9, next ones by 1/36."""
TRUTH = np.array([0.8, 1.4, 1.2, 0.9, 1.1])
OTHERS = np.array([[1.0, 1.0, 1.0, 1.0, 1.0], [0.9, 1.2, 1.3, 0.8, 1.0], [0.7, 0.6, 1.9, 1.5, 1.2]])


def curve_misfit(generator=QUARTER_CAR, used=(0, 1), n=3, seed=1, **changes):
    observer = replace(CURVES, **changes).observer(generator)
    return CurveMisfit(observer, observer.observe(torch.as_tensor(OTHERS[:n]), seed), used)


def estimate_misfit(generator=PITCHING, n=3, seed=1):
    observer = TRIPS.observer(generator)
    vehicles = torch.as_tensor(OTHERS[:n])
    return EstimateMisfit(observer, observer.observe(vehicles, seed), observer.covariance(vehicles))


def information_by_differences(misfit, ratios, columns, step=1e-5):
    """Return J^T J of one row's residuals, J by central differences one parameter at a time."""
    slopes = []
    for column in columns:
        up, down = ratios.copy(), ratios.copy()
        up[column] += step
        down[column] -= step
        pair = misfit(torch.as_tensor(np.array([up, down])), torch.zeros(2, dtype=torch.long))
        slopes.append((pair[0] - pair[1]).numpy() / (2 * step))
    return np.array([[a @ b for b in slopes] for a in slopes])


# reference


@pytest.mark.parametrize("used", [(0, 1), (0,), (1,)])
def test_residuals_of_curves_are_differences_over_the_noise_rms(used):
    misfit = curve_misfit(used=used)
    rows = torch.tensor([2, 0])
    found = misfit(torch.as_tensor(OTHERS[:2]), rows).numpy()
    frequencies = CURVES.frequencies_hz().numpy()
    for i, row in enumerate(rows.tolist()):
        clean = reference.magnitudes(AM96, OTHERS[i], frequencies)
        expected = []
        for curve in used:
            observed = misfit.observed[row, curve].numpy()
            rms = math.sqrt(sum(observed**2) / len(observed)) * 10 ** (-30 / 20)
            expected += [(o - c) / rms for o, c in zip(observed, clean[curve], strict=True)]
        np.testing.assert_allclose(found[i], expected, rtol=1e-9)


def test_residuals_of_estimates_are_whitened_bin_by_bin():
    misfit = estimate_misfit()
    rows = torch.tensor([2, 0])
    found = misfit(torch.as_tensor(OTHERS[:2]), rows).numpy()
    clean = misfit.observer.noise_free(torch.as_tensor(OTHERS[:2])).numpy()
    n_freq = clean.shape[2]
    assert found.shape == (2, 4 * n_freq)
    for i, row in enumerate(rows.tolist()):
        white = np.empty((2, n_freq), complex)
        for k in range(n_freq):
            sigma = misfit.covariance[row, :, :, k].numpy()
            u = np.log(misfit.observed[row, :, k].numpy() / clean[i, :, k])
            white[:, k] = np.linalg.inv(np.linalg.cholesky(sigma)) @ u
        assert np.abs(white).min() > 0
        expected = np.stack([white[0].real, white[0].imag, white[1].real, white[1].imag])
        np.testing.assert_allclose(found[i], math.sqrt(2 / HANN) * expected.ravel(), rtol=1e-9)


@pytest.mark.parametrize("used", [(0, 1), (0,), (1,)])
def test_information_of_curves_is_fishers(used):
    observer = CURVES.observer(QUARTER_CAR)
    misfit = CurveMisfit(observer, observer.noise_free(torch.as_tensor(TRUTH[None])), used)
    found = information_by_differences(misfit, TRUTH, range(5))
    responses = [("G_p", "G_s")[curve] for curve in used]
    expected = fisher_information(observer, TRUTH[None], PARAMETERS, responses)[0]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected))).clip(min=1.0)
    assert np.diag(expected).max() > 1e3
    # central differences with a step of 1e-5 are exact to about 1e-8
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-6)


@pytest.mark.parametrize("generator", [QUARTER_CAR, PITCHING], ids=["quarter_car", "pitching"])
def test_information_of_estimates_is_that_of_the_bound(generator):
    observer = TRIPS.observer(generator)
    truth = torch.as_tensor(TRUTH[None])
    misfit = observer.misfit(observer.observe(truth, 3), truth)
    found = information_by_differences(misfit, TRUTH, range(5))
    expected = fisher_information(observer, TRUTH[None], PARAMETERS)[0]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert size.min() > 1
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-6)


@pytest.mark.parametrize("used", [(0, 1), (0,), (1,)])
def test_mean_square_of_the_true_vehicles_curves_is_as_expected(used):
    observer = CURVES.observer(QUARTER_CAR)
    vehicles = torch.as_tensor(np.repeat(OTHERS, 200, axis=0))
    misfit = CurveMisfit(observer, observer.observe(vehicles, 2), used)
    square = misfit(vehicles, torch.arange(600)).square()
    assert misfit.expected == 1.0
    # the rms is that of the noisy curve, larger by the noise's share of 10^-3; n independent
    # squares have a standard error of sqrt(2 / n), four of these
    n = square.numel()
    assert float(square.mean()) == pytest.approx(1 / 1.001, abs=4 * math.sqrt(2 / n))


@pytest.mark.parametrize("generator", [QUARTER_CAR, PITCHING], ids=["quarter_car", "pitching"])
def test_mean_square_of_estimates_used_in_part_is_as_expected(generator):
    settings = replace(TRIPS, low_hz=1.5, body_high_hz=5.0)
    observer = settings.observer(generator)
    vehicles = torch.as_tensor(np.repeat(OTHERS, 200, axis=0))
    misfit = observer.misfit(observer.observe(vehicles, 2), vehicles)
    square = misfit(vehicles, torch.arange(600)).square()
    unused = settings.frequencies_hz() > 5.0 + 1e-9
    n_freq = len(unused)
    assert 0.3 < float(unused.double().mean()) < 0.7
    assert not bool(observer.weak.any())
    of_both = square.reshape(600, 4, n_freq)
    assert float(of_both[:, 2:, unused].abs().max()) == 0
    assert float(of_both[:, 2:, ~unused].mean(dim=0).min()) > 0
    share = 1 - int(unused.sum()) / (2 * n_freq)
    assert misfit.expected == pytest.approx(share / HANN, rel=1e-6)
    means = square.mean(dim=1) / misfit.expected
    error = 4 * float(means.std()) / math.sqrt(len(means))
    assert error < 0.02
    assert float(means.mean()) == pytest.approx(1 + 1 / TRIPS.n_averages, abs=error)


# property
