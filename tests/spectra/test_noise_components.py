"""Principal components of rows, whitened by their noise."""

import numpy as np
import pytest
import torch

from suspnet.spectra.noise_components import noise_components


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


def test_more_components_than_rows_are_refused():
    rows = torch.arange(12.0).reshape(3, 4)
    with pytest.raises(ValueError, match="5 components were asked for, 3 curves of 4 numbers"):
        noise_components(rows, rows + 1, 5)
