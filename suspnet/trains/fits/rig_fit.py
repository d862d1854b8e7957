"""The numbers of a rig from one record: k_p, c_p, k_s, c_s and M_s over M_p.

With z_m the signals of a bin (`suspnet.trains.spectra.rig_spectra`), R the equations of the rig
(`suspnet.vehicle.rig`) and N' the noise, the residuals of a bin are ::

    r = sqrt(2 / b) Q^-1/2 sum_m c_m R(f_m) z_m,    Q = sum_m c_m^2 R(f_m) N' R(f_m)^*

of which real and imaginary parts are standard normal; b = 1.94 neighbouring bins have the
information of one. They are those of weighted subspace fitting (`suspnet.trains.spectra.subspace`):
R spans what H leaves. Errors of the physics by frequency (`suspnet.trains.spectra.model_errors`)
are learnt in rounds, as no real rig is two masses on springs, and add eps_i^2 abs(z_i)^2 to N'.

Such errors are not the same throughout the band, and one that is wrong in the same way over many
bins costs more than its size says. So the numbers also have the influence of each of ``BANDS``
equal bands: with J_b and r_b its derivatives and residuals, and A = F F^T the covariance ::

    d_b = F (1 - F^T J_b^T J_b F)^-q F^T J_b^T r_b,    q = 1 - 1 / (2 mu^2)

sum_b d_b d_b^T estimates the covariance whatever the errors within a band have in common. Where the
misfit mu to noise alone is 1, q = 1/2 makes it unbiased (the cluster-robust covariance CR2: Bell
and McCaffrey, Survey Methodology 28, 169, 2002). Where the physics is incomplete, d_b is how far
the numbers move without the band (q = 1, the jackknife): its errors may be larger than the others'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product

import numpy as np
import torch
from scipy.optimize import OptimizeResult, least_squares
from torch import Tensor

from suspnet.curves.welch import Welch
from suspnet.estimation.commissioned_rig import BANDS, RigReading
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.trains.spectra.model_errors import model_errors
from suspnet.trains.spectra.rig_spectra import TAPS, RigSpectra
from suspnet.trains.spectra.subspace import equations_of
from suspnet.vehicle.rig import DEVIATIONS, Rig, equations, patterns

FACTORS = (0.5, 1.0, 2.0)
"""Factors on either frequency of the rig at which searches start: other valleys lie in between."""
ROUGH = 0.3
"""Error of the physics that the first searches allow for, a fraction of each signal."""
FAR_BETTER = 0.5
"""Misfit with such errors of sensors in another order, over that of the stated one, from which they
are exchanged: two masses in the wrong order leave far more."""
ROUGH_TOL, TOL = 1e-4, 1e-8
"""Relative decreases of the cost that end a search, and the last one."""
ROUNDS = 4
"""Rounds in which errors of the physics are learnt."""
KNOTS = 24
"""Number of frequencies between which errors are interpolated."""
SMALLEST = 0.01
"""Least share of the information on a number that other bands are taken to have."""


@dataclass(frozen=True)
class RigMisfit:
    """The residuals of a record, as a function of the logarithms of ``Rig.logs``.

    `errors` (n_freq, 3) are those of the physics, eps [-].
    """

    spectra: RigSpectra
    errors: FloatArray

    @cached_property
    def _patterns(self) -> ComplexArray:
        """Those of the equations times c_m, taps and sensors in a row, (6, n_freq, 2, 9)."""
        steps = np.array([-1, 0, 1]) / self.spectra.segment_s
        of_taps = [patterns(self.spectra.frequencies_hz + step) for step in steps]
        return np.concatenate([c * of for c, of in zip(TAPS, of_taps, strict=True)], axis=3)

    @cached_property
    def _moved(self) -> ComplexArray:
        """What each pattern makes of the signals, (6, n_freq, 2)."""
        taps = self.spectra.taps
        return np.asarray((self._patterns @ taps.reshape(len(taps), 9, 1))[..., 0])

    def white(self, logs: FloatArray, errors: FloatArray) -> tuple[ComplexArray, ...]:
        """Return residuals without their factor, Q^-1/2, R and N' R^*, those of taps in a row.

        Their shapes are (n_freq, 2, 1), (n_freq, 2, 2), (n_freq, 2, 9) and (n_freq, 9, 2).
        """
        rows = equations(logs, self._patterns)
        noise = np.tile(self.spectra.noise + errors**2 * self.spectra.powers, len(TAPS))
        noisy = (rows * noise[:, None]).conj().transpose(0, 2, 1)
        root = np.asarray(np.linalg.inv(np.linalg.cholesky(rows @ noisy)), dtype=complex)
        return root @ equations(logs, self._moved)[:, :, None], root, rows, noisy

    def __call__(self, logs: FloatArray) -> FloatArray:
        """Return the residuals, (n_freq * 4,), those of a bin next to each other."""
        return _real(self.white(logs, self.errors)[0])

    def jacobian(self, logs: FloatArray) -> FloatArray:
        """Return the derivatives of the residuals, (n_freq * 4, 5).

        With Q = L L^*, M_j = L^-1 dQ/dx_j L^-* and Phi(M) its lower triangle, half of the diagonal
        in it, dr/dx_j = L^-1 de/dx_j - Phi(M_j) r.
        """
        residuals, root, _, noisy = self.white(logs, self.errors)
        columns = []
        changes = zip(np.exp(logs), self._patterns[1:], self._moved[1:], strict=True)
        for number, rows, moved in changes:
            half = root @ (number * rows @ noisy) @ root.conj().transpose(0, 2, 1)
            change = half + half.conj().transpose(0, 2, 1)
            lower = np.tril(change) - np.eye(2) * change / 2
            columns.append(_real(root @ (number * moved)[:, :, None] - lower @ residuals))
        return np.stack(columns, axis=1)

    def rms(self, logs: FloatArray) -> float:
        """Return the rms residual over that of noise and errors; 1 without any signal."""
        residuals = self.white(logs, self.errors)[0]
        expected = 2 * float(np.sum(self.spectra.shares**2))
        return float(np.sqrt(np.sum(np.abs(residuals) ** 2) / expected)) if expected else 1.0


@dataclass(frozen=True)
class Explained:
    """A record and what a rig of these numbers leaves of it, as `model_errors` takes it."""

    record: RigMisfit
    logs: FloatArray
    sensors: tuple[int, ...] = (0, 1, 2)

    @property
    def bins(self) -> Tensor:
        """Numbers of all bins."""
        return torch.arange(len(self.record.spectra.frequencies_hz))

    def rest(self, squares: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what errors must explain, its deviation by noise, and their patterns."""
        spectra = self.record.spectra
        residuals, root, rows, _ = self.record.white(self.logs, squares.sqrt().numpy())
        rows = root @ rows
        noise = (rows * np.tile(spectra.noise, len(TAPS))) @ rows.conj().transpose(0, 2, 1)
        rows = rows.reshape(len(rows), 2, len(TAPS), 3)
        squares_of = np.einsum("fems,fdms->fsed", rows, rows.conj())
        return equations_of(
            torch.as_tensor(residuals @ residuals.conj().transpose(0, 2, 1) - noise),
            torch.as_tensor(noise),
            torch.as_tensor(squares_of * spectra.powers[:, :, None, None]),
        )


def _real(residuals: ComplexArray) -> FloatArray:
    """Return residuals (n_freq, 2, 1) with their factor as real numbers, (n_freq * 4,)."""
    factor = np.sqrt(2 / Welch().correlated_bins)
    return np.asarray(factor * np.ascontiguousarray(residuals[..., 0]).view(float).ravel())


def fit_rig(rig: Rig, spectra: RigSpectra) -> RigReading:
    """Return the numbers of a rig that explain a record, with what they do not explain.

    A rig that shows nothing of a suspension has the prior of its numbers as the result.
    """
    nothing = np.zeros((len(spectra.frequencies_hz), len(TAPS)))
    rough = _rough(spectra)
    # while large errors are allowed valleys are few and wide; the deepest is kept
    logs = product(np.log(FACTORS), repeat=2)
    starts = [rig.logs + np.array([2 * a, a, 2 * b, b, 0.0]) for a, b in logs]
    ends = [_search(rough, rig, start) for start in starts]
    x, fit = min(ends, key=lambda end: end.cost).x, rough
    knots_hz = float(np.ptp(spectra.frequencies_hz)) / KNOTS
    hz, errors = torch.as_tensor(spectra.frequencies_hz), None
    for _ in range(ROUNDS):
        errors = model_errors(hz, [Explained(fit, x)], errors, len(TAPS), knots_hz)
        fit = RigMisfit(spectra, errors.numpy())
        x = _search(fit, rig, x).x
    end = _search(fit, rig, x, TOL)
    x = end.x
    jacobian, residuals = end.jac[: -len(x)], end.fun[: -len(x)]
    misfit, bare_misfit = fit.rms(x), RigMisfit(spectra, nothing).rms(x)
    # noise that is estimated too large has a misfit below 1
    prior = np.diag(1 / np.square(DEVIATIONS))
    information = jacobian.T @ jacobian
    covariance = np.linalg.inv(information / misfit**2 + prior)
    q = 1 - 0.5 / max(1.0, bare_misfit) ** 2
    influences = _influences(np.linalg.inv(information + prior), jacobian, residuals, q)
    misfits = misfit, bare_misfit, rough.rms(x)
    return RigReading(x, covariance, influences, fit.errors, *misfits, bool(end.success))


def better_order(rig: Rig, spectra: RigSpectra, reading: RigReading) -> tuple[int, ...]:
    """Return the order of a record's sensors that explains it far better than it is, if any."""
    if not reading.doubt:
        return ()
    misfits = {}
    for order in permutations(range(3)):
        i = list(order)
        other = _rough(replace(spectra, taps=spectra.taps[:, :, i], noise=spectra.noise[i]))
        misfits[order] = other.rms(_search(other, rig, rig.logs).x)
    best = min(misfits, key=lambda order: misfits[order])
    return best if misfits[best] < FAR_BETTER * reading.rough_misfit else ()


def _rough(spectra: RigSpectra) -> RigMisfit:
    return RigMisfit(spectra, np.full((len(spectra.frequencies_hz), len(TAPS)), ROUGH))


def _search(fit: RigMisfit, rig: Rig, start: FloatArray, tol: float = ROUGH_TOL) -> OptimizeResult:
    """Return the minimum of the residuals and those of the prior near a start."""
    prior = rig.logs
    return least_squares(
        lambda logs: np.concatenate([fit(logs), (logs - prior) / DEVIATIONS]),
        start,
        lambda logs: np.concatenate([fit.jacobian(logs), np.diag(1 / np.array(DEVIATIONS))]),
        ftol=tol,
    )


def _influences(
    covariance: FloatArray, jacobian: FloatArray, residuals: FloatArray, q: float
) -> FloatArray:
    """Return the d_b of the module's docstring, (BANDS, 5)."""
    factor = np.linalg.cholesky(covariance)
    rows = []
    for band in np.array_split(np.arange(len(residuals) // 4), BANDS):
        of_band = (4 * band[:, None] + np.arange(4)).ravel()
        slopes = jacobian[of_band] @ factor
        shares, axes = np.linalg.eigh(np.eye(len(factor)) - slopes.T @ slopes)
        root = axes / np.maximum(shares, SMALLEST) ** q @ axes.T
        rows.append(factor @ root @ slopes.T @ residuals[of_band])
    return np.array(rows)
