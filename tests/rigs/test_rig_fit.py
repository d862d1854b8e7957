"""The numbers of a rig from one record."""

from dataclasses import replace

import numpy as np
import pytest
from rig_records import OVERSAMPLING, numbers, record
from scipy.optimize._numdiff import approx_derivative

from suspnet import Rig
from suspnet.estimation.commissioned_rig import BANDS
from suspnet.trains.fits.rig_fit import RigMisfit, better_order, fit_rig
from suspnet.trains.spectra.rig_spectra import RigSpectra

TRUE = numbers(20.0, 25.0, 0.8, 0.01, 0.02)
RATE_HZ, SEGMENT_S, BAND_HZ = 200.0, 3.0, (3.0, 45.0)
RIG = Rig("bench", primary_hz=26.0, secondary_hz=18.0)


def spectra(signals):
    return RigSpectra.of(signals, RATE_HZ, SEGMENT_S, BAND_HZ)


@pytest.fixture(scope="module")
def reading():
    return fit_rig(RIG, spectra(record(TRUE, RATE_HZ, 40.0, 0)))


def test_numbers_are_found_from_afar(reading):
    assert np.exp(reading.logs[[0, 2, 4]]) == pytest.approx(TRUE[[0, 2, 4]], rel=2e-3)
    assert np.exp(reading.logs[[1, 3]]) == pytest.approx(TRUE[[1, 3]], rel=0.03)
    assert reading.converged


def test_a_rig_of_two_masses_has_no_errors(reading):
    assert np.median(reading.errors) == 0
    assert 0.6 < reading.bare_misfit < 1.3


def test_values_are_those_of_the_rig(reading):
    expected = {"primary_hz": 20.0, "secondary_hz": 25.0, "mass_ratio": 0.8}
    found = {name: reading.values[name] for name in expected}
    assert found == pytest.approx(expected, rel=3e-3)
    assert reading.values["secondary_damping"] == pytest.approx(0.02, rel=0.03)


def test_residuals_are_those_of_the_docstring():
    of = spectra(record(TRUE, RATE_HZ, 40.0, 1))
    errors = np.full((len(of.frequencies_hz), 3), 0.1)
    found = RigMisfit(of, errors)(np.log(TRUE)).reshape(-1, 2, 2)
    k_p, c_p, k_s, c_s, m_s = TRUE
    for i in (0, 17, 60):
        rest, variance = 0, 0
        noise = np.diag(of.noise + 0.01 * of.powers[i])
        for m, c in zip((-1, 0, 1), np.array([-1, 2, -1]) / np.sqrt(6), strict=True):
            s = 2j * np.pi * (of.frequencies_hz[i] + m / SEGMENT_S)
            rows = np.array(
                [
                    [-c_p * s - k_p, s**2 + (c_p + c_s) * s + k_p + k_s, -c_s * s - k_s],
                    [0, -c_s * s - k_s, m_s * s**2 + c_s * s + k_s],
                ]
            )
            rest = rest + c * rows @ of.taps[i, m + 1]
            variance = variance + c**2 * rows @ noise @ rows.conj().T
        expected = np.linalg.solve(np.linalg.cholesky(variance), rest) * np.sqrt(2 / (35 / 18))
        assert found[i] == pytest.approx(np.stack([expected.real, expected.imag], 1), rel=2e-3)


@pytest.mark.slow
def test_deviations_are_those_of_many_records():
    readings = [fit_rig(RIG, spectra(record(TRUE, RATE_HZ, 30.0, seed))) for seed in range(10)]
    spread = np.std([reading.logs for reading in readings], axis=0, ddof=1)
    stated = np.sqrt(np.mean([np.diag(reading.covariance) for reading in readings], axis=0))
    by_bands = np.sqrt(np.mean([(r.influences**2).sum(axis=0) for r in readings], axis=0))
    # of ten records a standard deviation is known within a quarter; bands are five
    assert ((0.5 < stated / spread) & (stated / spread < 2)).all()
    assert ((0.4 < by_bands / spread) & (by_bands / spread < 6)).all()
    assert readings[0].influences.shape == (BANDS, 5)


def test_derivatives_are_those_of_differences(reading):
    of = spectra(record(TRUE, RATE_HZ, 40.0, 1))
    fit = RigMisfit(of, np.full((len(of.frequencies_hz), 3), 0.05))
    expected = approx_derivative(fit, reading.logs, method="3-point")
    assert fit.jacobian(reading.logs) == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_what_hangs_on_the_body_counts_as_an_error_where_it_resonates():
    signals = record(TRUE, RATE_HZ, 60.0, 0, hung=(0.04, 30.0, 0.02))
    of = spectra(signals)
    reading = fit_rig(RIG, of)
    near = np.abs(of.frequencies_hz - 30.0) < 2
    assert reading.bare_misfit > 5
    assert np.median(reading.errors[near].max(axis=1)) > 0.05
    assert 0.7 < reading.misfit < 1.2


def test_a_sine_alone_does_not_show_the_suspension():
    times = np.arange(40 * int(RATE_HZ) * OVERSAMPLING) / (OVERSAMPLING * RATE_HZ)
    base = 0.1 * np.sin(2 * np.pi * 4.0 * times)
    signals = record(TRUE, RATE_HZ, 40.0, 0, base=base, start=False, noise=0.3)
    assert fit_rig(RIG, spectra(signals)).hides()


def test_sensors_in_another_order_are_found(reading):
    of = spectra(record(TRUE, RATE_HZ, 40.0, 0))
    assert better_order(RIG, of, reading) == ()
    for order in ((0, 2, 1), (1, 0, 2)):
        i = list(order)
        other = replace(of, taps=of.taps[:, :, i], noise=of.noise[i])
        assert better_order(RIG, other, fit_rig(RIG, other)) == order


@pytest.mark.parametrize("factors", [(1, 9.81, 1), (1, 1, -1)], ids=["unit", "sign"])
def test_wrong_units_and_signs_leave_a_doubt(reading, factors):
    assert reading.doubt == ""
    wrong = fit_rig(RIG, spectra(record(TRUE, RATE_HZ, 40.0, 0) * np.array(factors)[:, None]))
    assert "look at units, signs" in wrong.doubt
