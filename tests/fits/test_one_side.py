"""Three sensors on one side: every part is read where the track has no side, and rails uneven."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_bogie_fit import MASSES, VEHICLE, drawn, row

from suspnet import COMPONENTS, commission_bogie, fit_parts
from suspnet.trains.fits.bogie_fit import (
    MISFIT_OF_FEW,
    SENSITIVITY_OF_FEW,
    healthy_misfit,
    wear_errors,
)
from suspnet.trains.fits.bogie_misfit import UNEVEN
from suspnet.trains.spectra.bogie_trip import BogieTrip

LEFT = replace(VEHICLE, sensors=VEHICLE.sensors[::2])
BINS = torch.arange(0.7, 16.0, 0.1, dtype=torch.float64)
WORN = {"k_p_axle1_left": 0.6, "c_s_right": 0.5}


def measured(parts, mass, seed, uneven=0.0, **settings):
    spectra = drawn(VEHICLE, row(parts, mass), seed, 100, uneven=uneven, bins=BINS, **settings)
    return BogieTrip(BINS, spectra.of_sensors([0, 2, 4]), 70.0)


@pytest.fixture(scope="module")
def commissioned():
    return commission_bogie(LEFT, [measured({}, mass, i) for i, mass in enumerate(MASSES)])


@pytest.mark.parametrize("uneven", [0.0, 0.3])
def test_each_part_is_read(commissioned, uneven):
    """Also if one rail is rougher, which healthy trips did not show."""
    assert commissioned.outputs == COMPONENTS
    assert commissioned.converged
    assert commissioned.misfit < 1.1
    found = fit_parts(commissioned, measured(WORN, 1.05, 9, uneven))
    assert found.converged
    assert found.misfit < 1.1
    errors = np.log(found.values[:-1]) - np.log([WORN.get(n, 1.0) for n in COMPONENTS[:-1]])
    assert (np.abs(errors) < 4 * found.deviations[:-1]).all()
    assert np.sqrt(np.mean((errors / found.deviations[:-1]) ** 2)) < 2
    named = [COMPONENTS.index(name) for name in WORN]
    assert (np.log(found.values[named]) < -4 * found.deviations[named]).all()


def test_residuals_of_the_true_vehicle_are_standard_normal_and_know_the_rails():
    trips = [measured({}, mass, i, 0.25) for i, mass in enumerate(MASSES)]
    fit = healthy_misfit(LEFT, trips)
    assert fit.n_free == fit.n_chance + 1
    fit = replace(fit, noises=[torch.tensor([4e-3, 5e-6, 2e-7]).double()] * len(trips))
    x = fit.start()
    numbers = fit.generator.distribution
    true = VEHICLE.distribution
    of_true = np.log(row({})[0, VEHICLE.uncertain_columns].numpy())
    logs = dict(zip(true.names, of_true, strict=True))
    x[: fit.n_numbers] = np.linalg.solve(
        numbers.factor, [logs[name] for name in numbers.names] - np.array(numbers.mean)
    )
    own = x[fit.n_shared :].reshape(len(trips), -1)
    own[:, fit.n_parts] = np.log(MASSES)
    assert fit.rms(x) > 1.5  # rails that are taken as alike
    own[:, fit.n_chance : fit.n_free] = 0.25
    assert fit.rms(x) == pytest.approx(1.0, abs=0.05)
    assert fit.prior(x)[fit.n_shared + fit.n_chance] == pytest.approx(0.25 / UNEVEN)


@pytest.mark.parametrize("are_healthy", [True, False])
def test_derivatives_are_those_of_finite_differences(are_healthy):
    fit = healthy_misfit(LEFT, [measured({}, mass, i) for i, mass in enumerate(MASSES)])
    fit = fit if are_healthy else replace(fit.of_trips([0]), are_healthy=False)
    x = fit.start() + 0.1 * np.random.default_rng(0).standard_normal(len(fit.start()))
    residuals, step = fit.at(0.0, fit.all_bins[::20]), 1e-5
    jacobian, uneven = residuals.jacobian(x), fit.n_shared + fit.n_chance
    for i in (0, uneven, len(x) - 1):
        off = step * np.eye(len(x))[i]
        slope = (residuals(x + off) - residuals(x - off)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, i], slope, rtol=1e-4, atol=1e-4)


def test_wear_counts_more_than_with_many_sensors():
    logs = np.append(np.log([0.5] + [1] * 11), 0)
    variances, own = wear_errors(2.0, logs, 3)
    size = 0.75 * (SENSITIVITY_OF_FEW["k_p"] * np.log(2)) ** 2
    assert variances[0] == own[0] == pytest.approx(size)  # no other part has worn
    assert variances[2] == pytest.approx(size)
    kinds = wear_errors(2.0, np.append(np.log([0.5, 1, 1, 1]), 0.0), 3)[0]
    assert kinds[2] / kinds[0] == pytest.approx(
        (SENSITIVITY_OF_FEW["k_s"] / SENSITIVITY_OF_FEW["k_p"] / 2) ** 2
    )
    assert own[1:].max() == 0.0
    assert wear_errors(2.0, logs, 6)[0][0] < size / 100
    explained = wear_errors(1.0, logs, 3)[0]
    assert explained[0] == pytest.approx(size * (1 - 1 / MISFIT_OF_FEW**2) / 0.75)
