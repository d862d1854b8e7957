"""Subspace fitting: naive projectors, the statistics of drawn matrices, noise, bad input."""

import math

import numpy as np
import pytest
import torch
from reference import complex_normal
from scipy.stats import unitary_group

from suspnet.curves.welch import Welch, segment_spectra
from suspnet.trains.spectra.subspace import SpectralMatrix, SubspaceMisfit

N_FREQ, M, P, N_AVERAGES = 300, 6, 3, 200


@pytest.fixture(scope="module")
def case():
    """Return responses (n_freq, m, p), noise (m,) and the matrix estimated from drawn signals."""
    rng = np.random.default_rng(0)
    responses = complex_normal(rng, N_FREQ, M, P)
    root = 10 * complex_normal(rng, N_FREQ, P, P)  # inputs of any coherence
    noise = rng.uniform(0.5, 2, M)
    signals = responses @ root @ complex_normal(rng, N_FREQ, P, N_AVERAGES)
    signals += np.sqrt(noise)[:, None] * complex_normal(rng, N_FREQ, M, N_AVERAGES)
    values = signals @ signals.conj().swapaxes(1, 2) / N_AVERAGES
    return responses, noise, SpectralMatrix(torch.as_tensor(values), N_AVERAGES)


def as_given(responses):
    return torch.as_tensor(np.ascontiguousarray(responses.transpose(2, 1, 0)))


# reference


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_residuals_are_those_of_the_formula(case, spread):
    responses, noise, spectra = case
    misfit = SubspaceMisfit(spectra, torch.as_tensor(noise), P, spread)
    found = misfit(as_given(responses)[None])[0].reshape(N_FREQ, M, P, 2).numpy()
    for f in (0, 17, N_FREQ - 1):
        matrix = spectra.values[f].numpy()
        whole = noise + spread**2 * np.diag(matrix).real
        white = np.diag(whole**-0.5)
        power, vectors = np.linalg.eigh(white @ matrix @ white)
        a = white @ responses[f]
        projector = a @ np.linalg.inv(a.conj().T @ a) @ a.conj().T
        for k in range(P):
            power_k, vector = power[M - P + k], vectors[:, M - P + k]
            expected = (np.eye(M) - projector) @ vector * (power_k - 1) / math.sqrt(power_k)
            expected *= math.sqrt(2 * N_AVERAGES)
            # an eigenvector has any phase
            own = found[f, :, k, 0] + 1j * found[f, :, k, 1]
            assert np.linalg.norm(own) == pytest.approx(np.linalg.norm(expected), rel=1e-9)
            assert abs(np.vdot(own, expected)) == pytest.approx(np.linalg.norm(expected) ** 2)


def test_derivatives_are_those_of_differences(case):
    responses, noise, spectra = case
    misfit = SubspaceMisfit(spectra, torch.as_tensor(noise), P)
    given = as_given(responses)
    rng = np.random.default_rng(1)
    changes = torch.as_tensor(complex_normal(rng, 4, P, M, N_FREQ))
    values, found = misfit.derivative(given, changes)
    torch.testing.assert_close(values, misfit(given[None])[0])
    step = 1e-6
    ends = [misfit(given + sign * step * changes) for sign in (1, -1)]
    torch.testing.assert_close(found, (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-5)


# property


def test_residuals_of_the_right_vehicle_are_standard_normal(case):
    responses, noise, spectra = case
    misfit = SubspaceMisfit(spectra, torch.as_tensor(noise), P)
    square = misfit(as_given(responses)[None]).square().mean() / misfit.expected
    n_free = 2 * N_FREQ * P * (M - P)
    assert float(square) == pytest.approx(1, abs=5 * math.sqrt(2 / n_free) + M / N_AVERAGES)


def test_nothing_is_assumed_of_the_inputs(case):
    responses, noise, spectra = case
    misfit = SubspaceMisfit(spectra, torch.as_tensor(noise), P)
    mixed = responses @ (unitary_group.rvs(P, random_state=2) * np.array([1.0, 3.0, 0.2]))
    torch.testing.assert_close(
        misfit(as_given(mixed)[None]), misfit(as_given(responses)[None]), rtol=1e-7, atol=1e-7
    )


def test_an_input_without_power_has_no_weight():
    rng = np.random.default_rng(3)
    responses = complex_normal(rng, 40, M, P)
    responses[..., 2] *= 1e-9
    values = 100 * responses @ responses.conj().swapaxes(1, 2) + np.eye(M)
    misfit = SubspaceMisfit(SpectralMatrix(torch.as_tensor(values), 50), torch.ones(M), P)
    wrong = responses.copy()
    wrong[..., 2] = complex_normal(rng, 40, M)
    assert misfit(as_given(wrong)[None]).abs().max() < 1e-4


def test_noise_that_sensors_have_in_common_is_whitened(case):
    responses, noise, spectra = case
    mixed = complex_normal(np.random.default_rng(7), N_FREQ, M, M)
    found = SubspaceMisfit(
        SpectralMatrix(
            torch.as_tensor(mixed @ spectra.values.numpy() @ mixed.conj().swapaxes(1, 2)),
            N_AVERAGES,
        ),
        torch.as_tensor(mixed @ np.diag(noise) @ mixed.conj().swapaxes(1, 2)),
        P,
    )(as_given(mixed @ responses)[None])
    plain = SubspaceMisfit(spectra, torch.as_tensor(noise), P)(as_given(responses)[None])
    assert float(found.square().sum()) == pytest.approx(float(plain.square().sum()), rel=1e-6)


def test_matrices_of_segments_hold_what_sensors_have_in_common():
    rng = np.random.default_rng(4)
    first = rng.standard_normal(20_000)
    signals = np.stack([first, np.roll(first, 3)])  # 30 ms later
    segments = segment_spectra(torch.as_tensor(signals), 100.0, Welch(segment_s=2.0))
    matrix = SpectralMatrix.of(segments, torch.ones(len(segments.values), dtype=torch.bool))
    inside = (segments.frequencies_hz > 5) & (segments.frequencies_hz < 40)
    delay = np.exp(2j * np.pi * segments.frequencies_hz.numpy() * 0.03)
    found = (matrix.values[:, 0, 1] / matrix.densities.prod(dim=1).sqrt()).numpy()
    np.testing.assert_allclose(found[inside], delay[inside], atol=0.2)
    assert matrix.at(inside).values.shape == (int(inside.sum()), 2, 2)


def test_bands_are_means_of_neighbouring_bins():
    signals = torch.as_tensor(np.random.default_rng(9).standard_normal((2, 2000)))
    segments = segment_spectra(signals, 100.0, Welch(segment_s=2.0))
    chosen = torch.ones(len(segments.values), dtype=torch.bool)
    bins, bands = (SpectralMatrix.of(segments, chosen, n_bins) for n_bins in (1, 5))
    for i in (0, 1, 7, len(bins.values) - 1):
        expected = bins.values[max(0, i - 2) : i + 3].mean(dim=0)
        torch.testing.assert_close(bands.values[i], expected)
    assert bands.n_averages == segments.welch.n_averages(len(chosen), 5)


# error


def test_as_many_inputs_as_sensors_are_refused(case):
    _, noise, spectra = case
    with pytest.raises(ValueError, match="at least one sensor more"):
        SubspaceMisfit(spectra, torch.as_tensor(noise), M)


def test_no_segment_is_refused():
    segments = segment_spectra(torch.ones(2, 1000), 100.0, Welch(segment_s=2.0))
    with pytest.raises(ValueError, match="nothing to average"):
        SpectralMatrix.of(segments, torch.zeros(len(segments.values), dtype=torch.bool))
