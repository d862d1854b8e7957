"""Information in estimates from a trip against finite differences and against least squares."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from vehicles import AM96

from suspnet.bounds.information import cramer_rao, fisher_information
from suspnet.curves.estimates import EstimateSettings
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle

SETTINGS = EstimateSettings(snr_db=30.0, minutes=10.0, high_hz=9.9).bound(AM96)
QUARTER_CAR = SETTINGS.observer(QuarterCar(AM96))
PITCHING = SETTINGS.observer(VerticalVehicle(AM96))
BODY_HIGH_HZ = 6.0
IN_PART = replace(SETTINGS, body_high_hz=BODY_HIGH_HZ).observer(VerticalVehicle(AM96))
DEGRADED = np.array([0.8, 1.4, 1.2, 0.9, 1.1])


def by_differences(observer, ratios, parameters, step=1e-5):
    """Return 2 / r sum Re(J^H Sigma^-1 J), one bin after the other, J by central differences.

    Of a bin where one response is weak, or G_s is not used, the other alone is used.
    """
    slopes = []
    for name in parameters:
        up, down = ratios.copy(), ratios.copy()
        up[PARAMETERS.index(name)] += step
        down[PARAMETERS.index(name)] -= step
        pair = observer.noise_free(torch.as_tensor(np.array([up, down])))
        slopes.append((pair[0] / pair[1]).log().numpy() / (2 * step))
    jacobian = np.array(slopes)  # (n_parameters, 2, n_freq)
    sigma = observer.covariance(torch.as_tensor(ratios[None]))[0].numpy()
    total = np.zeros((len(parameters),) * 2)
    for k in range(jacobian.shape[2]):
        used = ~observer.weak[:, k].numpy()
        used[1] &= float(observer.frequencies_hz[k]) <= observer.settings.body_high_hz + 1e-9
        good = np.flatnonzero(used)
        inverse = np.zeros((2, 2), dtype=complex)
        inverse[np.ix_(good, good)] = np.linalg.inv(sigma[np.ix_(good, good, [k])][:, :, 0])
        for i, a in enumerate(jacobian[:, :, k]):
            for j, b in enumerate(jacobian[:, :, k]):
                total[i, j] += (a.conj() @ inverse @ b).real
    # Hann: neighbours correlate by 4/9, next ones by 1/36
    return 2 / (1 + 2 * (4 / 9 + 1 / 36)) * total


# reference


@pytest.mark.parametrize(
    "observer", [QUARTER_CAR, PITCHING, IN_PART], ids=["quarter_car", "pitching", "in_part"]
)
@pytest.mark.parametrize(
    "parameters", [PARAMETERS, ("k_p", "c_p"), ("M_s", "k_s")], ids=lambda names: "-".join(names)
)
def test_information_equals_finite_differences(observer, parameters):
    found = fisher_information(observer, DEGRADED[None], parameters)[0]
    expected = by_differences(observer, DEGRADED, parameters)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert size.min() > 1
    assert observer.weak.sum() == 1  # of 372: G_p at 0.6 Hz drowns in the noise of 30 dB
    # central differences with a step of 1e-5 are exact to about 1e-8
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", [pytest.param("H1", marks=pytest.mark.slow), "IV"])
@pytest.mark.parametrize(
    "parameters", [("k_p", "c_p"), pytest.param(("k_s", "c_s"), marks=pytest.mark.slow)]
)
def test_bound_is_reached_by_least_squares(method, parameters):
    """Gauss-Newton on draws of the estimate, weighted by the inverse covariance of each bin."""
    settings = EstimateSettings(snr_db=30.0, minutes=20.0, method=method, high_hz=9.9).bound(AM96)
    observer = settings.observer(QuarterCar(AM96))
    n_draws, step = 400, 1e-5
    columns = [PARAMETERS.index(name) for name in parameters]
    start = torch.as_tensor(DEGRADED)
    observed = observer.observe(start.expand(n_draws, 5), seed=12)
    weight = torch.linalg.inv(observer.covariance(start[None])[0].movedim(-1, 0))
    estimates = start.repeat(n_draws, 1)
    for _ in range(4):
        curves = observer.noise_free(estimates)
        slopes = []
        for column in columns:
            moved = estimates.clone()
            moved[:, column] += step
            slopes.append((observer.noise_free(moved) / curves).log() / step)
        jacobian = torch.stack(slopes, dim=1)  # (n_draws, 2 parameters, 2, n_freq)
        weighted = torch.einsum("fab,npbf->npaf", weight, jacobian)
        normal = torch.einsum("npaf,nqaf->npq", jacobian.conj(), weighted).real
        error = (observed / curves).log()
        right = torch.einsum("npaf,naf->np", weighted.conj(), error).real
        change = torch.linalg.solve(normal, right[..., None])[..., 0]
        estimates[:, columns] += change
    assert change.abs().max() < 1e-3 * estimates[:, columns].std(dim=0).max()
    found = estimates[:, columns].numpy()
    least = cramer_rao(fisher_information(observer, DEGRADED[None], parameters))[0]
    assert (least > 1e-5).all()
    # 400 draws give a standard deviation to 3.5 %
    np.testing.assert_allclose(found.std(axis=0, ddof=1) / least, 1.0, atol=0.15)
    bias = found.mean(axis=0) - DEGRADED[columns]
    # 0.2 of the deviation: standard error 0.05, and some bias of order 1 / n
    assert (np.abs(bias) < 0.25 * least).all()


# limit


# property


def test_information_grows_with_the_averages():
    found = []
    for minutes in (10.0, 80.0):
        settings = EstimateSettings(snr_db=30.0, minutes=minutes).bound(AM96)
        observer = settings.observer(QuarterCar(AM96))
        found.append(
            fisher_information(observer, DEGRADED[None], ("k_p", "k_s")) / settings.n_averages
        )
    # the covariance is the one of a single average, divided by their number
    np.testing.assert_allclose(found[1], found[0], rtol=1e-10)


# failure


def test_ratios_that_are_not_positive_are_rejected():
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        fisher_information(QUARTER_CAR, -DEGRADED[None], ("k_p",))
