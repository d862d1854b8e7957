"""Hat functions: they interpolate, and sum to 1."""

import numpy as np
import torch

from suspnet.trains.spectra.hat_functions import hat_functions


def test_values_at_knots_are_interpolated():
    bins = torch.linspace(1, 9, 33, dtype=torch.float64)
    hats = hat_functions(bins, 2.0)
    values = np.array([1.0, 4.0, 2.0, 0.0, 3.0])
    expected = np.interp(bins.numpy(), [1, 3, 5, 7, 9], values)
    np.testing.assert_allclose(hats.numpy() @ values, expected, rtol=1e-12)
    np.testing.assert_allclose(hats.sum(dim=1).numpy(), 1.0, rtol=1e-12)


def test_a_narrow_band_has_its_ends():
    hats = hat_functions(torch.tensor([1.0, 1.1, 1.2], dtype=torch.float64), 2.0)
    np.testing.assert_allclose(hats.numpy(), [[1, 0], [0.5, 0.5], [0, 1]], atol=1e-12)
