"""Motion of a rich train whose elements are all linear: its modes, each recursed on its own.

With the state less B_v r, driven and felt by accelerations, x' = A x + (B_r + A B_v) r''. In the
eigenvectors of A each mode obeys q' = lambda q + g; for g straight between samples

    q[k+1] = exp(z) q[k] + h (phi_1 - phi_2) g[k] + h phi_2 g[k+1],  z = lambda h,
    phi_1 = (exp(z) - 1) / z,  phi_2 = (phi_1 - 1) / z

Straight lines between samples are (w h)^2 / 12 too small on average at frequency w; samples less
a twelfth of their second difference make up for it, and (w h)^4 / 90 is left.
"""

from __future__ import annotations

import math

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
        drive = np.linalg.solve(vectors, (b_r + a @ b_v).astype(complex))
        felt = sensors[:, :n] @ vectors[:n]
        # without modes that are not driven or not felt: the lateral ones on a vertical track
        size = np.abs(felt).max(axis=0) * np.abs(drive).max(axis=1) / np.abs(roots) ** 2
        kept = (roots.imag >= 0) & (size > 1e-12 * size.max())
        kept = np.flatnonzero(kept)[np.argsort(roots.imag[kept] > 0, kind="stable")]
        real = roots.imag[kept] == 0  # first, their forcing has no imaginary part
        self._n_real = int(real.sum())
        z = roots[kept] / rate_hz
        phi_1 = np.expm1(z) / z
        phi_2 = np.where(np.abs(z) < 0.01, 0.5 + z / 6 + z**2 / 24 + z**3 / 120, (phi_1 - 1) / z)
        weights = np.stack([phi_2, phi_1 - phi_2], axis=1) / rate_hz
        self._filters = [
            (w.real, [1.0, -d.real]) if is_real else (w, [1.0, -d])
            for w, d, is_real in zip(weights, np.exp(z), real, strict=True)
        ]
        drive, felt = drive[kept], felt[:, kept] * np.where(real, 1.0, 2.0)
        self._drive = np.vstack([drive.real, drive.imag[~real]])
        self._felt = np.hstack([felt.real, -felt.imag[:, ~real]])
        self._through = sensors[:, n:]
        self._ends = [None] * len(z)

    def advance(self, accelerations):
        """Return the accelerations under the sensors, (n_sensors, n_samples).

        Parameters
        ----------
        accelerations : array of shape (n_r, n_samples + 2)
            r'', from one sample before to one after; blocks overlap by two.
        """
        inner = accelerations[:, 1:-1]
        bend = accelerations[:, :-2] - 2 * inner + accelerations[:, 2:]
        moved = self._drive @ (inner - bend / 12)
        n_modes = len(self._filters)
        for j, (weights, decay) in enumerate(self._filters):
            imag = n_modes + j - self._n_real
            forcing = moved[j] if j < self._n_real else moved[j] + 1j * moved[imag]
            # what the sample before leaves for the first: nothing before the first block
            end = [weights[1] * forcing[0]] if self._ends[j] is None else self._ends[j]
            found, self._ends[j] = lfilter(weights, decay, forcing, zi=end)
            moved[j] = found.real
            if j >= self._n_real:
                moved[imag] = found.imag
        return self._felt @ moved + self._through @ inner


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
    found = np.empty((len(modes._through), n_samples))
    for first in range(-n_lead, n_samples, BLOCK):
        last = min(first + BLOCK, n_samples)
        moved = modes.advance(track(np.arange(first - 1, last + 1) / rate_hz)[2])
        found[:, max(first, 0) : max(last, 0)] = moved[:, max(0, -first) :]
    return found


def tones(train, frequencies_hz, velocity=0.01):
    """Return a track of cosine waves, all processes alike but for their phase, velocity in m/s."""
    omega = 2 * math.pi * np.array(frequencies_hz)
    arrivals = train.phasors(frequencies_hz) @ np.exp(1j * np.arange(train.n_processes))

    def inputs(times):
        wave = velocity / omega[:, None, None] * arrivals[..., None]
        wave = wave * np.exp(1j * omega[:, None, None] * times)
        factors = [np.ones(len(omega)), 1j * omega, -(omega**2)]
        return np.stack([(f[:, None, None] * wave).real.sum(axis=0) for f in factors])

    return inputs
