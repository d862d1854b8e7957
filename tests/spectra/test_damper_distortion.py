"""Incoherent forces of dampers: the formula, and dampers of known laws driven by noise."""

import numpy as np
import pytest
import torch
from reference import complex_normal
from scipy.signal import csd

from suspnet.trains.spectra.damper_distortion import ORDERS, distortions

N_FREQ, M, N_DAMPERS, P = 60, 4, 3, 2
BINS_HZ = torch.arange(5, 5 + N_FREQ, dtype=torch.float64) / 10
KINDS = [[0, 1], [2]]


def dampers(seed=0):
    """Return velocities V, inputs D, the sensors' responses to forces g, and the changes H."""
    rng = np.random.default_rng(seed)
    smooth = np.ones(9) / 9
    velocities = complex_normal(rng, N_DAMPERS, P, N_FREQ)
    velocities = np.apply_along_axis(np.convolve, 2, velocities, smooth, "same")
    # the second damper follows the first one, as the next axle does
    velocities[1] = velocities[0] * np.exp(-2j * np.pi * BINS_HZ.numpy() * 0.1)
    roots = complex_normal(rng, P, P)
    inputs = np.tile(roots @ roots.conj().T, (N_FREQ, 1, 1))
    pulls = complex_normal(rng, N_DAMPERS, M, N_FREQ)
    return (
        velocities.transpose(2, 0, 1),
        inputs,
        pulls,
        np.einsum("dmf,dpf->dpmf", pulls, velocities),
    )


def spectrum_of(covariance, lags_s, f_hz):
    """Return the one-sided spectrum at a frequency of a covariance over lags."""
    step = lags_s[1] - lags_s[0]
    return 2 * step * np.sum(covariance * np.exp(-2j * np.pi * f_hz * lags_s), axis=-1)


def test_forces_are_those_of_the_formula():
    """Every covariance as a sum over bins, every spectrum as a sum over lags of one period."""
    velocities, inputs, pulls, changes = dampers()
    used = torch.tensor([0, 17, N_FREQ - 1])
    arrays = map(torch.as_tensor, (velocities, inputs, changes[..., used]))
    found = distortions(BINS_HZ, *arrays, used, KINDS).unflatten(0, (len(KINDS), -1)).numpy()
    spectra = velocities @ inputs @ velocities.conj().swapaxes(1, 2)
    lags_s = np.arange(-500, 501) * 10 / 1001  # one over the distance of the bins
    waves = np.exp(2j * np.pi * np.outer(BINS_HZ, lags_s))
    covariance = np.einsum("fij,ft->ijt", spectra, waves).real * 0.1
    size = np.sqrt(np.array([covariance[i, i, 500] for i in range(N_DAMPERS)]))
    for kind, numbers in enumerate(KINDS):
        for o, order in enumerate(ORDERS):
            for k, bin_ in enumerate(used.tolist()):
                expected = np.zeros((M, M), complex)
                for i in numbers:
                    for j in numbers:
                        rho = covariance[i, j] / size[i] / size[j]
                        density = spectrum_of(rho**order, lags_s, float(BINS_HZ[bin_]))
                        pair = np.outer(pulls[i, :, bin_], pulls[j, :, bin_].conj())
                        expected += size[i] * size[j] * density * pair
                np.testing.assert_allclose(found[kind, o, k], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("order", "variance"), [(2, 2.0), (3, 6.0)])
def test_they_are_those_of_dampers_driven_by_noise(order, variance):
    """Forces v^2 and v^3, the second damper driven by another input, too; He_o has variance o!."""
    rate_hz, n_samples = 40.0, 1 << 20
    rng, grid_hz = np.random.default_rng(1), np.fft.rfftfreq(n_samples, 1 / rate_hz)
    white = np.fft.rfft(rng.standard_normal((2, n_samples)))
    inside = (grid_hz > 0.45) & (grid_hz < 6.45)
    responses = np.zeros((2, 2, len(grid_hz)), complex)
    responses[0, 0] = responses[1, 0] = inside / (1 - (grid_hz / 3) ** 2 + 0.3j * grid_hz / 3)
    responses[1] *= np.exp(-2j * np.pi * grid_hz * 0.15)
    responses[1, 1] = 0.7 * inside
    v = np.fft.irfft(np.einsum("dpf,pf->df", responses, white), n_samples)
    size = v.std(axis=1, keepdims=True)
    # the part of v^3 that is coherent with v, and the mean of v^2, are not incoherent forces
    forces = v**order - (size**2 if order == 2 else 3 * size**2 * v)
    velocities = np.array([[np.interp(BINS_HZ, grid_hz, r) for r in one] for one in responses])
    inputs = np.tile(2 / rate_hz * np.eye(2), (N_FREQ, 1, 1)).astype(complex)
    changes = np.einsum("dm,dpf->dpmf", np.eye(2), velocities)
    arrays = map(torch.as_tensor, (velocities.transpose(2, 0, 1), inputs, changes))
    found = distortions(BINS_HZ, *arrays, torch.arange(N_FREQ), [[0, 1]])[ORDERS.index(order)]
    scale = variance * np.outer(size, size) ** (order - 1)
    for i in range(2):
        for j in range(2):
            f, measured = csd(forces[j], forces[i], rate_hz, nperseg=400)
            bins = np.isin(np.round(f, 6), np.round(BINS_HZ.numpy(), 6))
            off = scale[i, j] * found[:, i, j].numpy() - measured[bins]
            assert np.abs(off).mean() < 0.06 * scale[i, j] * found[:, 0, 0].abs().mean()
