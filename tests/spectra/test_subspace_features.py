"""Features of spectral matrices: angles between subspaces, naive formulas, noise, bad input."""

import numpy as np
import pytest
import torch
from reference import complex_normal
from scipy.linalg import subspace_angles

from suspnet.spectra.noise_components import noise_components
from suspnet.spectra.subspace_features import (
    SubspaceCoordinates,
    SubspaceFeatures,
    input_spectra,
)

N_FREQ, M, P = 7, 5, 3


def as_given(responses):
    """Return responses (p, m, n_freq) of (n_freq, m, p)."""
    return torch.as_tensor(np.ascontiguousarray(responses.transpose(2, 1, 0)))


def matrices(responses, inputs, noise):
    """Return H D H^* + N with D = inputs inputs^*, (1, n_freq, m, m)."""
    a = responses @ inputs
    return torch.as_tensor(a @ a.conj().swapaxes(1, 2) + np.diag(noise))[None]


@pytest.fixture
def case():
    """Return healthy and worn responses (n_freq, m, p), inputs (n_freq, p, p) and noise (m,)."""
    rng = np.random.default_rng(0)
    healthy = complex_normal(rng, N_FREQ, M, P)
    worn = healthy + 0.3 * complex_normal(rng, N_FREQ, M, P)
    return healthy, worn, complex_normal(rng, N_FREQ, P, P), rng.uniform(0.5, 2, M)


# reference


def test_coordinates_are_those_of_the_formula(case):
    healthy, worn, inputs, noise = case
    coordinates = SubspaceCoordinates.of(as_given(healthy), torch.as_tensor(noise))
    spectra = matrices(worn, inputs, noise)
    found = coordinates(spectra).reshape(N_FREQ, M - P, P, 2).numpy()
    whole = coordinates.whitener.numpy() * np.sqrt(noise)
    for f in range(N_FREQ):
        q, rest = whole[f, :P].conj().T, whole[f, P:].conj().T
        white = np.diag(noise**-0.5)
        w = white @ spectra[0, f].numpy() @ white
        # Q spans the healthy responses, and both are orthonormal
        a = white @ healthy[f]
        np.testing.assert_allclose(q @ q.conj().T @ a, a, atol=1e-12)
        np.testing.assert_allclose(whole[f] @ whole[f].conj().T, np.eye(M), atol=1e-12)
        expected = rest.conj().T @ w @ q @ np.linalg.inv(q.conj().T @ w @ q)
        np.testing.assert_allclose(found[f, ..., 0] + 1j * found[f, ..., 1], expected, atol=1e-12)


def test_without_noise_they_hold_the_tangents_of_the_angles_between_the_subspaces(case):
    healthy, worn, inputs, noise = case
    coordinates = SubspaceCoordinates.of(as_given(healthy), torch.as_tensor(noise))
    found = coordinates(matrices(worn, inputs, 0 * noise)).reshape(N_FREQ, M - P, P, 2).numpy()
    white = np.diag(noise**-0.5)
    for f in range(N_FREQ):
        tangents = np.tan(subspace_angles(white @ healthy[f], white @ worn[f]))
        values = np.linalg.svd(found[f, ..., 0] + 1j * found[f, ..., 1], compute_uv=False)
        np.testing.assert_allclose(values, tangents[: M - P], rtol=1e-8)


@pytest.mark.parametrize("n_rows", [60, 6])  # more rows than columns, and fewer
def test_components_are_those_of_singular_vectors(n_rows):
    rng = np.random.default_rng(1)
    clean = rng.standard_normal((n_rows, 8)) * np.arange(1, 9)
    noisy = clean + rng.standard_normal((n_rows, 8)) * np.linspace(0.1, 2, 8)
    found = noise_components(torch.as_tensor(clean), torch.as_tensor(noisy), 3)
    noise = np.sqrt(np.mean((noisy - clean) ** 2, axis=0))
    rows = (clean - clean.mean(axis=0)) / noise
    _, sizes, right = np.linalg.svd(rows, full_matrices=False)
    expected = (noisy - clean.mean(axis=0)) / noise @ right[:3].T
    got = found(torch.as_tensor(noisy)).numpy()
    np.testing.assert_allclose(np.abs(got), np.abs(expected), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(found.explained.numpy(), (sizes**2 / np.sum(sizes**2))[:3])


def test_spectra_of_the_inputs_are_found(case):
    healthy, _, inputs, noise = case
    spectra = matrices(healthy, inputs, noise)[0]
    found = input_spectra(spectra, as_given(healthy), torch.as_tensor(noise)).numpy()
    np.testing.assert_allclose(found, inputs @ inputs.conj().swapaxes(1, 2), atol=1e-9)
    none = input_spectra(
        0.5 * torch.as_tensor(np.diag(noise)) + 0 * spectra,
        as_given(healthy),
        torch.as_tensor(noise),
    )
    assert none.abs().max() < 1e-9  # densities are not negative


# limit


def test_they_are_0_for_the_healthy_vehicle_and_any_inputs(case):
    healthy, _, inputs, noise = case
    coordinates = SubspaceCoordinates.of(as_given(healthy), torch.as_tensor(noise))
    assert coordinates(matrices(healthy, inputs, noise)).abs().max() < 1e-9


# property


def test_strong_inputs_of_any_spectra_give_the_same_coordinates(case):
    healthy, worn, inputs, noise = case
    coordinates = SubspaceCoordinates.of(as_given(healthy), torch.as_tensor(noise))
    other = 1e5 * complex_normal(np.random.default_rng(2), N_FREQ, P, P)
    found = coordinates(matrices(worn, 1e5 * inputs, noise))
    torch.testing.assert_close(found, coordinates(matrices(worn, other, noise)), rtol=0, atol=1e-6)
    assert found.abs().max() > 0.1


def test_features_have_noise_of_about_1(case):
    healthy, _, inputs, noise = case
    rng = np.random.default_rng(3)
    coordinates = SubspaceCoordinates.of(as_given(healthy), torch.as_tensor(noise))
    clean, noisy, n = [], [], 40
    for _ in range(200):
        worn = healthy + 0.3 * complex_normal(rng, N_FREQ, M, P)
        exact = matrices(worn, 10 * inputs, noise)
        root = np.linalg.cholesky(exact[0].numpy())
        signals = root @ complex_normal(rng, N_FREQ, M, n)
        clean.append(coordinates(exact))
        noisy.append(
            coordinates(torch.as_tensor(signals @ signals.conj().swapaxes(1, 2) / n)[None])
        )
    clean, noisy = torch.cat(clean), torch.cat(noisy)
    features = SubspaceFeatures.fitted(coordinates, clean, noisy, 4)
    scatter = (features.components(noisy) - features.components(clean)).square().mean(dim=0).sqrt()
    assert ((scatter > 0.7) & (scatter < 1.4)).all()
    torch.testing.assert_close(features(exact), features.components(clean[-1:]))


# error


def test_as_many_inputs_as_sensors_are_refused():
    with pytest.raises(ValueError, match="3 sensors show no change of the responses to 3 inputs"):
        SubspaceCoordinates.of(torch.ones(3, 3, 2, dtype=torch.complex128), torch.ones(3))


def test_more_components_than_rows_are_refused():
    rows = torch.arange(12.0).reshape(3, 4)
    with pytest.raises(ValueError, match="5 components were asked for, 3 curves of 4 numbers"):
        noise_components(rows, rows + 1, 5)
