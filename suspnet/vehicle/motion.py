"""Motion in time of linear systems driven at the wheels, exact for input linear between samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from suspnet.ground.types import ComplexArray, FloatArray

LARGEST_CONDITION = 1e10
"""Condition number of the eigenvectors above which two modes coincide."""
BLOCK = 1 << 14
"""Number of samples per block, for which all modes stay in the CPU cache."""


@dataclass(frozen=True)
class Branch:
    """A Maxwell branch: a spring b in series with a damper b / r, along u = g z - h w.

    Its force is b (u - xi), where the damper's part xi of the stretch obeys xi' = r (u - xi).
    `stiffness`: b [N/m], `rate`: r [1/s], `stretch`: g (n_dof,), `input`: h (n_inputs,).
    """

    stiffness: float
    rate: float
    stretch: FloatArray
    input: FloatArray


@dataclass(frozen=True)
class LinearSystem:
    """A vehicle as M z'' + D z' + K z = D_w w' + K_w w, with sensors and Maxwell branches.

    `mass`, `damping`, `stiffness` (n_dof, n_dof) are M, D and K in SI units, `input_damping` and
    `input_stiffness` (n_dof, n_inputs) D_w and K_w. The inputs are the track's height under each
    wheelset and, with roll, then its angle there, and with lateral motion then its lateral place.
    `sensors` (2 or 4, n_dof) map z to the displacement under the sensors on frame and body; with
    roll the last two are at the mirrored lateral place. Each side of a vehicle of separate parts
    has one more, first of all, on the axle box. `feedthrough` (n_sensors, n_inputs) is what they
    measure of the inputs directly, None if nothing. `behind_m`: distance of each wheelset behind
    the one whose axle box is measured, negative is ahead; `roll_per_m`: the track's angle over a
    profile of `cross_level_spectrum` [rad/m], 0 without roll; `alignment`: the track's lateral
    place over a profile of the mean's spectrum [-], 0 without lateral motion; `lateral_m`: lateral
    place of the first sensors on axle box, frame and body.
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    input_damping: FloatArray
    input_stiffness: FloatArray
    sensors: FloatArray
    behind_m: tuple[float, ...]
    branches: tuple[Branch, ...] = ()
    roll_per_m: float = 0.0
    lateral_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    feedthrough: FloatArray | None = None
    alignment: float = 0.0

    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, C, D with inputs w and the displacements under the sensors as outputs.

        The state x = (z, z' - M^-1 D_w w, xi) absorbs the derivative of the input. The same system
        maps accelerations of the wheels to accelerations of the sensors.
        """
        n, m = len(self.mass), len(self.branches)
        inverse = np.linalg.inv(self.mass)
        b, r = (
            np.array([[branch.stiffness, branch.rate] for branch in self.branches]).reshape(m, 2).T
        )
        g = np.array([branch.stretch for branch in self.branches]).reshape(m, n)
        h = np.array([branch.input for branch in self.branches]).reshape(
            m, self.input_damping.shape[1]
        )
        pull = g.T * b
        a = np.zeros((2 * n + m, 2 * n + m))
        a[:n, n : 2 * n] = np.eye(n)
        a[n : 2 * n] = inverse @ np.hstack([-self.stiffness - pull @ g, -self.damping, pull])
        a[2 * n :, :n], a[2 * n :, 2 * n :] = r[:, None] * g, -np.diag(r)
        jump = inverse @ self.input_damping
        force = inverse @ (self.input_stiffness + pull @ h)
        inputs = np.vstack([jump, force - inverse @ self.damping @ jump, -r[:, None] * h])
        c = np.hstack([self.sensors, np.zeros((len(self.sensors), n + m))])
        d = self.feedthrough
        return a, inputs, c, np.zeros((len(c), inputs.shape[1])) if d is None else d


class SampledMotion:
    """A linear system stepped in time, block by block, exact for input linear between samples.

    With A = V diag(lambda) V^-1 and g = V^-1 B u each mode obeys q' = lambda q + g, hence::

        q[k+1] = exp(lambda h) q[k] + h (phi_1 - phi_2) g[k] + h phi_2 g[k+1],
        phi_1 = (exp(z) - 1) / z,  phi_2 = (exp(z) - 1 - z) / z^2,  z = lambda h.

    This recursion for each mode neither drifts nor loses digits at any sampling rate 1 / h
    (Hochbruck and Ostermann, Exponential integrators, 2010, section 2). `direct` (n_outputs,
    n_inputs) is the feedthrough D of the state space. Raises ValueError if two modes coincide
    (critical damping), so that the eigenvectors are not independent.
    """

    def __init__(self, system: LinearSystem, rate_hz: float) -> None:
        a, b, c, self.direct = system.state_space()
        eigenvalues, vectors = np.linalg.eig(a)
        condition = np.linalg.cond(vectors / np.linalg.norm(vectors, axis=0))
        if condition > LARGEST_CONDITION:
            raise ValueError(
                "two modes of the vehicle coincide (critical damping): change one of its "
                "parameters by a millionth"
            )
        # Real modes first, then one of each conjugate pair: the outputs of the other one are the
        # conjugates, so that the weights of these modes are doubled.
        modes = np.concatenate(
            [np.flatnonzero(eigenvalues.imag == 0), *np.nonzero(eigenvalues.imag > 0)]
        )
        self._n_real = int(np.count_nonzero(eigenvalues.imag == 0))
        self._decays: ComplexArray = np.exp(eigenvalues[modes] / rate_hz)
        before, after = (w[:, None] for w in foh_weights(eigenvalues[modes], 1 / rate_hz))
        drives: ComplexArray = np.linalg.solve(vectors, b.astype(np.complex128))[modes]
        self._forcing = self._split(np.hstack([before * drives, after * drives]))
        weights = (c @ vectors)[:, modes]
        weights[:, self._n_real :] *= 2.0
        self._outputs = self._split(weights.conj().T).T  # Re(w q) = Re w Re q - Im w Im q
        self._state: list[Any] = [0.0] * len(modes)
        self._last: FloatArray | None = None

    def _split(self, rows: ComplexArray) -> FloatArray:
        """Return rows of real modes, then real and then imaginary parts of the complex modes."""
        n = self._n_real
        return np.concatenate([rows.real, rows[n:].imag])

    def advance(self, inputs: Sequence[FloatArray]) -> FloatArray:
        """Return the outputs (n_sensors, n_samples) at the next samples, in the unit of the inputs.

        `inputs`: one array (n_samples,) per input. The system is at rest before the first sample.
        """
        outputs = np.empty((len(self._outputs), len(inputs[0])))
        for first in range(0, outputs.shape[1], BLOCK):
            block = slice(first, first + BLOCK)
            outputs[:, block] = self._advance(np.stack([signal[block] for signal in inputs]))
        return outputs

    def _advance(self, block: FloatArray) -> FloatArray:
        """Return the outputs for a block of inputs of shape (n_inputs, n_samples)."""
        last = block[:, :1] if self._last is None else self._last
        shifted = np.concatenate([last, block[:, :-1]], axis=1)
        modes: FloatArray = self._forcing @ np.concatenate([shifted, block])
        if self._last is None:
            modes[:, 0] = 0.0
        n_modes = len(self._decays)
        for j, decay in enumerate(self._decays):
            if j < self._n_real:
                modes[j] = self._filter(j, decay.real, modes[j])
            else:
                imaginary = modes[j + n_modes - self._n_real]
                mode = self._filter(j, decay, modes[j] + 1j * imaginary)
                modes[j], imaginary[:] = mode.real, mode.imag
        self._last = block[:, -1:].copy()
        outputs = self._outputs @ modes
        if self.direct.any():
            outputs += self.direct @ block
        return np.asarray(outputs)

    def _filter(self, j: int, decay: complex, forcing: Any) -> Any:
        """Return mode j, q[k+1] = decay q[k] + forcing[k+1], and store its last value."""
        mode, _ = lfilter([1.0], [1.0, -decay], forcing, zi=[decay * self._state[j]])
        self._state[j] = mode[-1]
        return mode


def foh_weights(eigenvalues: ComplexArray, step_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the weights of the input before and after a step: h (phi_1 - phi_2), h phi_2.

    The first row of exp([[z, 1, 0], [0, 0, 1], [0, 0, 0]]) is exp(z), phi_1 and phi_2 (Van Loan,
    Computing integrals involving the matrix exponential, 1978), without cancellation at small z.
    """
    blocks = np.zeros((len(eigenvalues), 3, 3), dtype=np.complex128)
    blocks[:, 0, 0], blocks[:, 0, 1], blocks[:, 1, 2] = eigenvalues * step_s, 1.0, 1.0
    _, phi_1, phi_2 = expm(blocks)[:, 0].T
    return step_s * (phi_1 - phi_2), step_s * phi_2
