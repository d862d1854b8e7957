"""Covariance matching: its formulas evaluated naively, derivatives, noise, known answers."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from suspnet.trains.spectra.covariance_matching import (
    CovarianceMisfit,
    mat,
    matched_noise,
    misfit_of,
    vec,
)
from suspnet.trains.spectra.subspace import SpectralMatrix, SubspaceMisfit

P, M, N_FREQ, N_AVERAGES = 3, 3, 40, 60
NOISE = np.array([0.02, 0.01, 0.005])
PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2))
"""Inputs that may be coherent."""


def normal(rng, *shape):
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def track(rng, n_freq=N_FREQ):
    """Return spectra of inputs of which the first one is incoherent with the others."""
    inputs = np.zeros((n_freq, P, P), complex)
    inputs[:, 0, 0] = rng.uniform(1, 2, n_freq)
    both = normal(rng, n_freq, 2, 4)
    inputs[:, 1:, 1:] = both @ both.conj().swapaxes(1, 2) / 4
    return inputs


def measured(rng, responses, inputs, n_averages=N_AVERAGES, noise=NOISE):
    """Return the spectra of a trip, (n_freq, m, m), averaged from draws."""
    columns = responses.transpose(2, 1, 0)
    true = columns @ inputs @ columns.conj().swapaxes(1, 2) + np.diag(noise)
    signals = np.linalg.cholesky(true) @ normal(rng, len(true), M, n_averages)
    values = signals @ signals.conj().swapaxes(1, 2) / n_averages
    return SpectralMatrix(torch.as_tensor(values), n_averages)


def numbers(matrix):
    """Return the numbers of one Hermitian matrix, in an order of their own."""
    upper = np.triu_indices(len(matrix), 1)
    off = np.sqrt(2) * matrix[upper]
    return np.concatenate([matrix.diagonal().real, off.real, off.imag])


def by_errors(spectra, sensor, size):
    """Return the change of spectra if a sensor's signal errs by a small fraction."""
    change = np.zeros((M, M), complex)
    change[sensor] = size * spectra[sensor]
    return change + change.conj().T


def naive(spectra, responses, spread):
    """Return residuals, free directions and C^-1/2 W of one bin, by an SVD and an eigenvalue root.

    These are (m^2,), (n, m^2) and (m, 2, m^2); directions are those of any unitary frame.
    """
    root = np.linalg.inv(np.linalg.cholesky(spectra))
    white = root @ responses.T
    seen = [
        [numbers(root @ by_errors(spectra, i, size) @ root.conj().T) for size in (1, 1j)]
        for i in range(M)
    ]
    c = np.eye(M * M)
    for size, of_sensor in zip(spread, seen, strict=True):
        c += size**2 / 2 * sum(np.outer(one, one) for one in of_sensor)
    factor = np.linalg.inv(np.linalg.cholesky(c))
    columns = []
    for i, j in PAIRS:
        for size in (1,) if i == j else (1, 1j):
            one = np.zeros((P, P), complex)
            one[i, j] = size
            columns.append(factor @ numbers(white @ (one + one.conj().T) @ white.conj().T))
    target = factor @ numbers(np.eye(M) - root @ np.diag(NOISE) @ root.conj().T)
    free = np.linalg.svd(np.array(columns))[2][len(columns) :]
    rest = np.sqrt(N_AVERAGES) * target
    return free.T @ (free @ rest), free @ factor, np.array(seen) @ factor.T @ free.T


@pytest.fixture
def case():
    rng = np.random.default_rng(3)
    responses = normal(rng, P, M, N_FREQ)
    spectra = measured(rng, normal(rng, P, M, N_FREQ), track(rng))
    spread = torch.as_tensor(rng.uniform(0, 1, (N_FREQ, M)))
    return spectra, torch.as_tensor(responses), spread


# reference


def test_residuals_are_what_least_squares_leave(case):
    spectra, responses, spread = case
    found = CovarianceMisfit(spectra, torch.as_tensor(NOISE), P, spread)(responses[None])
    found = found.reshape(N_FREQ, M * M).numpy()
    for f in (0, 17):
        one = spectra.values[f].numpy(), responses[:, :, f].numpy(), spread[f].numpy()
        np.testing.assert_allclose(found[f], naive(*one)[0], rtol=1e-9, atol=1e-9)


def test_equations_of_errors_are_those_of_the_formula(case):
    spectra, responses, spread = case
    misfit = CovarianceMisfit(spectra, torch.as_tensor(NOISE), P, spread)
    target, _, patterns = misfit.error_equations(responses)
    shares = misfit.error_shares(responses).numpy()
    for f in (0, 17):
        one = spectra.values[f].numpy(), responses[:, :, f].numpy(), spread[f].numpy()
        residuals, rows, seen = naive(*one)
        noise = rows @ rows.T
        assert shares[f] == pytest.approx(1 - np.trace(noise) / len(noise), rel=1e-9)
        matrix = torch.view_as_complex(target[f].reshape(*noise.shape, 2)).real
        assert float(matrix.trace()) == pytest.approx(residuals @ residuals - np.trace(noise))
        for i in range(M):
            pattern = torch.view_as_complex(patterns[f, i].reshape(*noise.shape, 2)).real
            size = N_AVERAGES / 2 * np.square(seen[i]).sum()
            assert float(pattern.trace()) == pytest.approx(size, rel=1e-9)


def test_derivatives_are_those_of_finite_differences(case):
    spectra, responses, spread = case
    changes = torch.as_tensor(normal(np.random.default_rng(4), 5, P, M, N_FREQ))
    misfit, step = CovarianceMisfit(spectra, torch.as_tensor(NOISE), P, spread), 1e-6
    residuals, found = misfit.derivative(responses, changes)
    rows = torch.cat([responses + step * changes, responses - step * changes])
    ahead, back = misfit(rows.unflatten(0, (2, -1)).flatten(0, 1)).chunk(2)
    np.testing.assert_allclose(residuals, misfit(responses[None])[0])
    np.testing.assert_allclose(found, (ahead - back) / (2 * step), rtol=1e-6, atol=1e-7)


# known answers


def test_the_true_vehicle_leaves_what_is_expected():
    rng = np.random.default_rng(0)
    responses = normal(rng, P, M, N_FREQ)
    mean = [
        float(misfit(torch.as_tensor(responses)[None]).square().mean()) / misfit.expected
        for misfit in (
            CovarianceMisfit(measured(rng, responses, track(rng), 500), torch.as_tensor(NOISE), P)
            for _ in range(20)
        )
    ]
    # of 3200 squares
    assert np.mean(mean) == pytest.approx(1, abs=3 * np.sqrt(2 / (20 * N_FREQ * 4)) + 0.02)


def test_inputs_and_noise_are_found():
    rng = np.random.default_rng(1)
    responses, inputs = normal(rng, P, M, N_FREQ), track(rng)

    columns = responses.transpose(2, 1, 0)
    whole = columns @ inputs @ columns.conj().swapaxes(1, 2) + np.diag(NOISE)
    spectra = SpectralMatrix(torch.as_tensor(whole), N_AVERAGES)
    given_responses = torch.as_tensor(responses)
    misfit = CovarianceMisfit(spectra, torch.as_tensor(NOISE), P)
    np.testing.assert_allclose(misfit.inputs(given_responses), inputs, atol=1e-8)
    start = torch.full((M,), 1e-3, dtype=torch.float64)
    found = matched_noise(spectra, given_responses, start)
    np.testing.assert_allclose(found.densities, NOISE, rtol=1e-4)

    np.testing.assert_allclose(found.matrix[5], np.diag(NOISE), atol=1e-4)


def test_more_sensors_than_inputs_are_fitted_by_their_subspace(case):
    spectra, *_ = case
    assert isinstance(misfit_of(spectra, torch.ones(M), 2), SubspaceMisfit)
    assert isinstance(misfit_of(spectra, torch.ones(M), P), CovarianceMisfit)


def test_two_sensors_are_refused():
    values = torch.eye(2, dtype=torch.complex128).repeat(4, 1, 1)
    with pytest.raises(ValueError, match="2 sensors do not tell"):
        CovarianceMisfit(SpectralMatrix(values, 50), torch.ones(2), P)


# property


@given(arrays(float, (4, 9), elements=st.floats(-1e3, 1e3)))
def test_numbers_of_matrices_and_back(values):
    matrices = mat(torch.as_tensor(values))
    np.testing.assert_allclose(vec(matrices), values, atol=1e-9)
    np.testing.assert_allclose(
        torch.linalg.matrix_norm(matrices), np.linalg.norm(values, axis=1), atol=1e-9
    )
