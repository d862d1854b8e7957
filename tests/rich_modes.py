"""Motion of a rich train whose elements are all linear: its modes, each recursed on its own.

With the state less B_v r, driven and felt by accelerations, x' = A x + (B_r + A B_v) r''. In the
eigenvectors of A each mode obeys q' = lambda q + g; for g straight between samples

    q[k+1] = exp(z) q[k] + h (phi_1 - phi_2) g[k] + h phi_2 g[k+1],  z = lambda h,
    phi_1 = (exp(z) - 1) / z,  phi_2 = (phi_1 - 1) / z
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

BLOCK = 1 << 13
"""Samples moved at once."""


class Modes:
    """Modes of a train, at rest before the first sample.

    Parameters
    ----------
    matrices : Matrices
    rate_hz : float, [Hz]
    sensors : array of shape (n_sensors, n_u), optional
        Combinations of the train's own.
    """

    def __init__(self, matrices, rate_hz, sensors=None):
        sensors = matrices.sensors if sensors is None else sensors
        n = len(matrices.mass)
        a, b_r, b_v = matrices.state_space()
        roots, vectors = np.linalg.eig(a)
        if np.linalg.cond(vectors / np.linalg.norm(vectors, axis=0)) > 1e11:
            raise ValueError("two modes of the train coincide: change one of its numbers")
        kept = roots.imag >= 0
        drive = np.linalg.solve(vectors, (b_r + a @ b_v).astype(complex))[kept]
        felt = sensors[:, :n] @ vectors[:n][:, kept] * np.where(roots.imag[kept] > 0, 2.0, 1.0)
        # modes that are not driven or not felt: the lateral ones of a symmetric train
        size = np.abs(felt).max(axis=0) * np.abs(drive).max(axis=1) / np.abs(roots[kept]) ** 2
        matter = size > 1e-12 * size.max()
        z = roots[kept][matter] / rate_hz
        phi_1 = np.expm1(z) / z
        phi_2 = np.where(np.abs(z) < 0.01, 0.5 + z / 6 + z**2 / 24 + z**3 / 120, (phi_1 - 1) / z)
        self._decay = np.exp(z)
        self._before, self._after = (phi_1 - phi_2) / rate_hz, phi_2 / rate_hz
        self._drive = np.vstack([drive[matter].real, drive[matter].imag])
        self._felt = np.hstack([felt[:, matter].real, -felt[:, matter].imag])
        self._through = sensors[:, n:]
        self._state = np.zeros(len(z), dtype=complex)
        self._last = None

    def advance(self, accelerations):
        """Return the accelerations under the sensors, (n_sensors, n_samples), of r'' (n_r, ...)."""
        n_modes = len(self._decay)
        parts = self._drive @ accelerations
        forcing = parts[:n_modes] + 1j * parts[n_modes:]
        last = forcing[:, 0] if self._last is None else self._last
        self._last = forcing[:, -1].copy()
        modes = np.empty((2 * n_modes, forcing.shape[1]))
        for j, row in enumerate(forcing):
            first = self._before[j] * last[j] + self._decay[j] * self._state[j]
            weights, decay = [self._after[j], self._before[j]], [1.0, -self._decay[j]]
            moved, _ = lfilter(weights, decay, row, zi=[first])
            self._state[j] = moved[-1]
            modes[j], modes[n_modes + j] = moved.real, moved.imag
        return self._felt @ modes + self._through @ accelerations


def simulate_modes(matrices, track, rate_hz, n_samples, n_lead=0, sensors=None):
    """Return the accelerations under the sensors, (n_sensors, n_samples), [m/s^2].

    Parameters
    ----------
    matrices : Matrices
    track : callable
        From times [s] to elevation, velocity and acceleration of all inputs, (3, n_r, n_times).
    rate_hz : float, [Hz]
    n_samples, n_lead : int
        Samples from time 0 and before it.
    sensors : array of shape (n_sensors, n_u), optional
    """
    modes = Modes(matrices, rate_hz, sensors)
    kept = []
    for first in range(-n_lead, n_samples, BLOCK):
        times = np.arange(first, min(first + BLOCK, n_samples)) / rate_hz
        kept.append(modes.advance(track(times)[2])[:, max(0, -first) :])
    return np.concatenate(kept, axis=1)
