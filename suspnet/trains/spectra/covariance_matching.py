"""Fitting of the spectral matrix of sensors that do not outnumber the inputs.

A track has no side: what lifts both rails alike is incoherent with what differs between them, cross
level and alignment, which may be coherent with each other. With A the responses of m sensors to the
inputs, D any Hermitian matrix with zeros between these two groups, N the noise and S = L L^* the
spectral matrix, averaged from n ::

    S = A D A^* + N,    r = sqrt(n) (1 - V V^+) vec(1 - L^-1 N L^-*)

are the residuals of a bin, which least squares in D leave: with B_k a basis of the D and vec the
m^2 real numbers of a Hermitian matrix, with its norm, V has the columns vec(L^-1 A B_k A^* L^-*).
Where the model is right, residuals are standard normal in the directions that V leaves, four of
three sensors (covariance matching: Ottersten, Stoica and Roy, Digital Signal Processing 8, 185,
1998).

Model errors of a fraction e_i of the signal of sensor i, with n E|e_i|^2 = spread_i^2, add
(e_i u_i u_i^T S + its conjugate transpose) to S. With W_ij the columns that this has in vec for
e_i = 1 and the imaginary unit, V and vec(...) are multiplied by C^-1/2 ::

    C = 1 + sum_i spread_i^2 sum_j W_ij W_ij^T / 2
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from scipy.optimize import nnls
from torch import Tensor

from suspnet.trains.spectra.noise_subspace import LEAST_NOISE, TripNoise
from suspnet.trains.spectra.subspace import (
    SpectralMatrix,
    SpectralMisfit,
    SubspaceMisfit,
    equations_of,
)

GROUPS = ((0,), (1, 2))
"""Numbers of the inputs that may be coherent: elevation alone, cross level and alignment."""


def misfit_of(
    spectra: SpectralMatrix, noise: Tensor, n_inputs: int, spread: float | Tensor = 0.0
) -> SubspaceMisfit | CovarianceMisfit:
    """Return the residuals of a trip: by its subspace where sensors outnumber the inputs."""
    few = spectra.values.shape[-1] <= n_inputs
    return (CovarianceMisfit if few else SubspaceMisfit)(spectra, noise, n_inputs, spread)


def vec(matrices: Tensor) -> Tensor:
    """Return the numbers (..., m^2) of Hermitian matrices (..., m, m), with the norm of these."""
    m = matrices.shape[-1]
    rows, columns = torch.triu_indices(m, m, 1)
    off = math.sqrt(2) * matrices[..., rows, columns]
    return torch.cat([matrices.diagonal(dim1=-2, dim2=-1).real, off.real, off.imag], dim=-1)


def mat(numbers: Tensor) -> Tensor:
    """Return the Hermitian matrices (..., m, m) of their numbers (..., m^2)."""
    m = math.isqrt(numbers.shape[-1])
    diagonal, real, imaginary = numbers.split([m, m * (m - 1) // 2, m * (m - 1) // 2], dim=-1)
    rows, columns = torch.triu_indices(m, m, 1)
    matrices = torch.diag_embed(diagonal).to(torch.complex128)
    matrices[..., rows, columns] = torch.complex(real, imaginary) / math.sqrt(2)
    matrices[..., columns, rows] = torch.complex(real, -imaginary) / math.sqrt(2)
    return matrices


@dataclass(frozen=True)
class CovarianceMisfit(SpectralMisfit):
    """These residuals by the covariances of the sensors; methods are as of `SubspaceMisfit`."""

    def __post_init__(self) -> None:
        m = self.spectra.values.shape[-1]
        if m * m <= len(self._basis):
            raise ValueError(
                f"{m} sensors do not tell {self.n_inputs} inputs apart; at least three are needed"
            )

    @property
    def n_of_bin(self) -> int:
        """Number of residuals of a bin."""
        return self.spectra.values.shape[-1] ** 2

    @property
    def expected(self) -> float:
        """Mean square of a residual where the model is right."""
        return 1 - len(self._basis) / self.n_of_bin

    @cached_property
    def _basis(self) -> Tensor:
        """The B_k, (n, p, p)."""
        within = torch.zeros(self.n_inputs, self.n_inputs)
        for group in GROUPS:
            within[group[0] : group[-1] + 1, group[0] : group[-1] + 1] = 1
        used = vec(within + 1j * within.triu(1) - 1j * within.tril(-1)) != 0
        return mat(torch.eye(self.n_inputs**2, dtype=torch.float64)[used])

    @cached_property
    def _inverse(self) -> Tensor:
        """L^-1, (n_freq, m, m)."""
        inverse: Tensor = torch.linalg.inv(torch.linalg.cholesky(self.spectra.values))
        return inverse

    @cached_property
    def _by_errors(self) -> Tensor:
        """W_ij, (n_freq, m^2, m, 2)."""
        factor = self.spectra.values @ self._inverse.mH
        of_sensor = self._inverse.mT[:, :, :, None] * factor[:, :, None, :]
        both = torch.stack([of_sensor, 1j * of_sensor], dim=2)
        return vec(both + both.mH).permute(0, 3, 1, 2)

    @cached_property
    def _root(self) -> Tensor:
        """C^-1/2, (n_freq, m^2, m^2)."""
        spread = torch.as_tensor(self.spread, dtype=torch.float64)
        n_freq, n_numbers, m, _ = self._by_errors.shape
        sizes = spread.expand(n_freq, m)[:, None, :, None] / math.sqrt(2)
        columns = (sizes * self._by_errors).flatten(2)
        unit = torch.eye(n_numbers, dtype=torch.float64)
        factor = torch.linalg.cholesky(unit + columns @ columns.mT)
        root: Tensor = torch.linalg.solve_triangular(factor, unit, upper=False)
        return root

    def _numbers(self, white: Tensor) -> Tensor:
        """Return C^-1/2 vec(white) of matrices (..., n_freq, m, m), (..., n_freq, m^2)."""
        return torch.einsum("fij,...fj->...fi", self._root, vec(white))

    def _seen(self, matrices: Tensor) -> Tensor:
        """Return C^-1/2 vec(L^-1 matrices L^-*), (..., n_freq, m^2)."""
        return self._numbers(self._inverse @ matrices @ self._inverse.mH)

    @cached_property
    def _target(self) -> Tensor:
        rest = self.spectra.values - self._noise
        return math.sqrt(self.spectra.n_averages) * self._seen(rest)

    def _columns(self, white: Tensor) -> Tensor:
        """Return C^-1/2 V, (..., n_freq, m^2, n), of L^-1 A (..., n_freq, m, p)."""
        each = white @ self._basis[(..., *[None] * (white.ndim - 2), slice(None), slice(None))]
        return self._numbers(each @ white.mH).movedim(0, -1)

    def free(self, responses: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (n_freq, n) in directions (n_freq, m^2, n) that responses leave."""
        columns = self._columns(self._white(responses))
        basis = torch.linalg.qr(columns, mode="complete")[0][:, :, columns.shape[-1] :]
        return (basis.mT @ self._target[..., None])[..., 0], basis

    def inputs(self, responses: Tensor) -> Tensor:
        """Return D, (n_freq, p, p), of responses (p, m, n_freq)."""
        columns = self._columns(self._white(responses))
        numbers = torch.linalg.lstsq(columns, self._target[..., None]).solution[..., 0]
        numbers = numbers / math.sqrt(self.spectra.n_averages)
        return torch.einsum("fk,kij->fij", numbers.to(torch.complex128), self._basis)

    def seen(self, responses: Tensor, matrices: Tensor) -> Tensor:
        """Return what is left of matrices (k, n_freq, m, m) in free directions, (k, n_freq, n)."""
        return torch.einsum("fij,kfi->kfj", self.free(responses)[1], self._seen(matrices))

    def error_shares(self, responses: Tensor) -> Tensor:
        """Return the fraction of the variance of residuals that is due to errors, (n_freq,)."""
        rows = self.free(responses)[1].mT @ self._root
        return 1 - rows.square().sum(dim=(1, 2)) / rows.shape[1]

    def error_equations(self, responses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what errors must explain, as of `SubspaceMisfit.error_equations`."""
        residuals, basis = self.free(responses)
        rows = basis.mT @ self._root
        noise, of_errors = rows @ rows.mT, torch.einsum("fai,fimj->famj", rows, self._by_errors)
        target = residuals[:, :, None] * residuals[:, None] - noise
        patterns = torch.einsum("famj,fbmj->fmab", of_errors, of_errors)
        patterns = self.spectra.n_averages / 2 * patterns
        # a product of real numbers scatters as much as the sum of two complex ones
        target, noise, patterns = (of.to(torch.complex128) for of in (target, noise, patterns))
        return equations_of(target, noise, patterns, p=2)

    def __call__(self, responses: Tensor) -> Tensor:
        """Return the residuals (n_rows, n_points) of responses (n_rows, p, m, n_freq)."""
        return self._left(torch.linalg.qr(self._columns(self._white(responses)))[0]).flatten(1)

    def derivative(self, responses: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (n_points,) and their derivatives (n_directions, n_points).

        As of `SubspaceMisfit`; with V now C^-1/2 V, and t what it is to explain ::

            dr = -(1 - V V^+) dV V^+ t - (V^+)^T dV^T r
        """
        white, moved = self._white(responses), self._white(changes)
        basis, triangle = torch.linalg.qr(self._columns(white))
        left = self._left(basis)
        inverse = torch.linalg.solve_triangular(triangle, basis.mT, upper=True)
        numbers = (inverse @ self._target[..., None])[..., 0].to(torch.complex128)
        half = moved @ torch.einsum("fk,kij->fij", numbers, self._basis) @ white.mH
        first = self._left(basis, self._numbers(half + half.mH))
        # dV^T r = 2 Re tr(L^-1 dA B_k A^* L^-* mat(C^-1/2 r))
        rest = mat((self._root.mT @ left[..., None])[..., 0])
        onto = self._basis[:, None] @ (white.mH @ rest)
        back = 2 * torch.einsum("nfmp,kfpm->nfk", moved, onto).real
        second = torch.einsum("nfk,fki->nfi", back, inverse)
        return left.flatten(), -(first + second).flatten(1)

    def _white(self, responses: Tensor) -> Tensor:
        """Return L^-1 A (..., n_freq, m, p) of responses (..., p, m, n_freq)."""
        return self._inverse @ responses.movedim(-1, -3).mT

    def _left(self, basis: Tensor, numbers: Tensor | None = None) -> Tensor:
        """Return what a basis (..., n_freq, m^2, n) leaves of numbers, None: of the target."""
        whole = (self._target if numbers is None else numbers)[..., None]
        return (whole - basis @ (basis.mT @ whole))[..., 0]


def matched_noise(spectra: SpectralMatrix, responses: Tensor, start: Tensor) -> TripNoise:
    """Return the white noise of each sensor by non-negative least squares of the residuals.

    `responses` (p, m, n_freq) are those of a vehicle that is about right; a sensor has at least
    ``LEAST_NOISE`` of `start` (m,). What excites wheelsets alone, dampers' forces and leakage are
    left out: they would explain errors of the vehicle as well.
    """
    misfit = CovarianceMisfit(spectra, torch.zeros_like(start), len(responses))
    units = torch.diag_embed(torch.eye(len(start), dtype=torch.complex128))[:, None]
    matrices = torch.cat([spectra.values[None], units.expand(-1, *spectra.values.shape)])
    target, *seen = misfit.seen(responses, matrices)
    columns = torch.stack(seen).flatten(1)
    sizes = columns.norm(dim=1)
    found = nnls((columns / sizes[:, None]).T.numpy(), target.flatten().numpy())[0]
    densities = (torch.as_tensor(found) / sizes).maximum(LEAST_NOISE * start)
    matrix = torch.diag(densities).to(torch.complex128).expand(spectra.values.shape)
    return TripNoise(densities, densities[:0], densities.new_zeros(1, 0), matrix)
