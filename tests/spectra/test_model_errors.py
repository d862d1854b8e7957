"""Errors of a vehicle's responses: the formula evaluated naively, known answers."""

import numpy as np
import pytest
import torch

from suspnet.trains.spectra.model_errors import Explained, model_errors
from suspnet.trains.spectra.subspace import SpectralMatrix, SubspaceMisfit

BINS = torch.arange(1.0, 9.01, 0.1, dtype=torch.float64)
N_AVERAGES, N_INPUTS, N_SENSORS = 200, 2, 5
NOISE = 1e-3


def normal(rng, *shape):
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def trips(errors, n_trips=4, seed=0):
    """Return trips of a vehicle whose responses differ by `errors` (n_freq, n_sensors)"""
    rng = np.random.default_rng(seed)
    responses = normal(rng, N_INPUTS, N_SENSORS, len(BINS))
    true = responses * (1 + errors.T * normal(rng, *responses.shape))
    explained = []
    for _ in range(n_trips):
        columns = true.transpose(2, 1, 0)
        spectra = columns @ columns.conj().swapaxes(1, 2) + NOISE * np.eye(N_SENSORS)
        signals = np.linalg.cholesky(spectra) @ normal(rng, len(BINS), N_SENSORS, N_AVERAGES)
        sample = signals @ signals.conj().swapaxes(1, 2) / N_AVERAGES
        noise = NOISE * torch.eye(N_SENSORS, dtype=torch.complex128).repeat(len(BINS), 1, 1)
        explained.append(
            Explained(
                SpectralMatrix(torch.as_tensor(sample), N_AVERAGES),
                noise,
                torch.as_tensor(responses),
                torch.arange(len(BINS)),
                range(N_SENSORS),
            )
        )
    return explained


# reference


def test_the_rest_is_what_the_formula_says():
    """Residuals and rows by an SVD, in a frame that any unitary matrix may turn."""
    (trip,) = trips(np.zeros((len(BINS), N_SENSORS)), 1)
    squares = torch.full((len(BINS), N_SENSORS), 1e-5, dtype=torch.float64)
    target, _, patterns = trip.rest(squares)
    m, n = N_SENSORS - N_INPUTS, N_AVERAGES
    for f in (0, 40):
        spectra, h = trip.spectra.values[f].numpy(), trip.responses[:, :, f].numpy().T
        noise, densities = NOISE * np.eye(N_SENSORS), spectra.diagonal().real
        root = np.linalg.inv(np.linalg.cholesky(noise + n * np.diag(1e-5 * densities)))
        power, vectors = np.linalg.eigh(root @ spectra @ root.conj().T)
        directions = np.linalg.svd((root @ h).conj().T)[2][N_INPUTS:]  # no motion
        y = [
            np.sqrt(2 * n) * (power[k] - 1) / np.sqrt(power[k]) * directions @ vectors[:, k]
            for k in range(m, N_SENSORS)
        ]
        w = directions @ root
        rest = sum(np.outer(one, one.conj()) for one in y) / 2 - N_INPUTS * w @ noise @ w.conj().T
        found = torch.view_as_complex(target[f].reshape(m, m, 2)).numpy()
        np.testing.assert_allclose(
            np.linalg.eigvalsh(found), np.linalg.eigvalsh(rest), rtol=1e-6, atol=1e-8
        )
        for i in range(N_SENSORS):
            size = N_INPUTS * n * densities[i] * np.linalg.norm(w[:, i]) ** 2
            pattern = torch.view_as_complex(patterns[f, i].reshape(m, m, 2)).numpy()
            assert np.trace(pattern).real == pytest.approx(size, rel=1e-6)


def test_what_noise_alone_leaves_scatters_as_stated():
    none = torch.zeros(len(BINS), N_SENSORS, dtype=torch.float64)
    rests = [trip.rest(none) for trip in trips(np.zeros((len(BINS), N_SENSORS)), 50)]
    m = N_SENSORS - N_INPUTS
    parts = [
        element for element in range(2 * m * m) if element not in range(1, 2 * m * m, 2 * m + 2)
    ]
    z = torch.stack([(target / deviations)[:, parts] for target, deviations, _ in rests])
    assert z.square().mean() == pytest.approx(1, abs=0.1)


def test_shares_of_errors_are_those_of_the_variance():
    (trip,) = trips(np.zeros((len(BINS), N_SENSORS)), 1)
    spread = 0.02
    misfit = SubspaceMisfit(trip.spectra, trip.noise, N_INPUTS, spread)
    found = misfit.error_shares(trip.responses)
    for f in (0, 40):
        errors = spread**2 * np.diag(trip.spectra.densities[f].numpy())
        total = NOISE * np.eye(N_SENSORS) + errors
        root = np.linalg.inv(np.linalg.cholesky(total))
        a = root @ trip.responses[:, :, f].numpy().T
        free = (np.eye(N_SENSORS) - a @ np.linalg.pinv(a)) @ root
        share = np.trace(free @ errors @ free.conj().T).real / (N_SENSORS - N_INPUTS)
        assert float(found[f]) == pytest.approx(share, rel=1e-6)


# property


def test_a_vehicle_that_explains_its_trips_has_hardly_any_error():
    found = model_errors(BINS, trips(np.zeros((len(BINS), N_SENSORS))), None, N_SENSORS)
    assert found.shape == (len(BINS), N_SENSORS)
    assert (found > 0).double().mean() < 0.1
    assert found.max() < 0.005


def test_errors_of_one_sensor_in_a_band_are_found():
    errors = np.zeros((len(BINS), N_SENSORS))
    inside = (BINS.numpy() > 4) & (BINS.numpy() < 6)
    errors[inside, 2] = 0.1
    found = model_errors(BINS, trips(errors), None, N_SENSORS).numpy()
    at = np.sqrt(np.square(found[inside]).mean(axis=0))
    assert at[2] == pytest.approx(0.1, rel=0.35)
    assert np.delete(at, 2).max() < 0.05
    assert found[(BINS.numpy() < 2.5) | (BINS.numpy() > 7.5)].max() < 0.01


def test_a_sensor_that_is_missing_on_a_trip_is_judged_by_the_others():
    errors = np.zeros((len(BINS), N_SENSORS))
    errors[:, 2] = 0.1
    whole = trips(errors)
    kept = [0, 1, 2, 3]
    fewer = Explained(
        whole[0].spectra.of_sensors(kept),
        whole[0].noise[:, :4, :4],
        whole[0].responses[:, kept],
        whole[0].bins,
        kept,
    )
    found = model_errors(BINS, [fewer, *whole[1:]], None, N_SENSORS)
    assert float(found[:, 2].square().mean().sqrt()) == pytest.approx(0.1, rel=0.35)
