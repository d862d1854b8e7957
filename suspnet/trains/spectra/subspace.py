"""Subspace fitting of the spectral matrix of any sensors; it assumes nothing of the track.

With H(theta) the responses of m sensors to p < m inputs, D the inputs' spectra and N the sensors'
noise, the spectral matrix is S = H D H^* + N. With A = N^-1/2 H, P_A the projector on its columns,
and lambda_k, u_k the largest eigenvalues and the eigenvectors of N^-1/2 S N^-1/2, estimated from n
averages, the residuals of a bin are ::

    r_k(theta) = sqrt(2 n) (I - P_A) u_k (lambda_k - 1) / sqrt(lambda_k),    k = 1 ... p

D may be any Hermitian matrix in every bin. Where the model is right, real and imaginary parts are
standard normal in the m - p directions that P_A leaves, and their minimum is asymptotically as
accurate as maximum likelihood (weighted subspace fitting: Viberg and Ottersten, IEEE Transactions
on Signal Processing 39, 1110, 1991). An input of no power has lambda_k = 1 and no weight.

N^-1/2 is the inverse of the Cholesky factor of N, which need not be diagonal. Model errors of a
fraction eps of each sensor's signal are allowed for by adding eps^2 diag S to N.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from suspnet.curves.welch import SegmentSpectra


@dataclass(frozen=True)
class SpectralMatrix:
    """Averaged spectral matrix E[X X^*] of sensors, complex (n_freq, m, m), [(m/s^2)^2/Hz]."""

    values: Tensor
    n_averages: float

    @classmethod
    def of(cls, segments: SegmentSpectra, chosen: Tensor, n_bins: int = 1) -> Self:
        """Return the average over chosen segments of sensors, a bool tensor (n_segments,).

        It is also that over `n_bins` neighbouring bins, an odd number; at the ends they are fewer.
        ValueError if none is chosen.
        """
        n_segments = int(chosen.sum())
        if n_segments == 0:
            raise ValueError("no segment is chosen: there is nothing to average")
        values = segments.values[chosen].permute(2, 1, 0)
        n_averages = segments.welch.n_averages(n_segments, n_bins)
        matrices = values @ values.mH / n_segments
        rows = torch.view_as_real(matrices).flatten(1).T
        smooth = avg_pool1d(rows[None], n_bins, 1, n_bins // 2, count_include_pad=False)[0]
        parts = smooth.T.reshape(*matrices.shape, 2).contiguous()
        return cls(torch.view_as_complex(parts), n_averages)

    def at(self, bins: Tensor) -> SpectralMatrix:
        """Return the matrices of chosen bins, a bool tensor (n_freq,) or their numbers."""
        return SpectralMatrix(self.values[bins], self.n_averages)

    def of_sensors(self, numbers: Sequence[int]) -> SpectralMatrix:
        """Return the matrices of chosen sensors in the order of their numbers."""
        chosen = list(numbers)
        return SpectralMatrix(self.values[:, chosen][:, :, chosen], self.n_averages)

    @property
    def densities(self) -> Tensor:
        """Spectral density of each sensor, (n_freq, m)."""
        return self.values.diagonal(dim1=-2, dim2=-1).real


@dataclass(frozen=True)
class SpectralMisfit:
    """Residuals of a trip's spectral matrix from responses.

    `noise` is the density of each sensor's noise (m,), or the spectral matrix of all that is not
    the inputs' (n_freq, m, m), [(m/s^2)^2/Hz]; `n_inputs` is p, `spread` the fraction eps of each
    signal that the model may err by. ValueError if the sensors do not tell the inputs apart.
    """

    spectra: SpectralMatrix
    noise: Tensor
    n_inputs: int
    spread: float | Tensor = 0.0

    @property
    def _noise(self) -> Tensor:
        """N, (m, m) or (n_freq, m, m)."""
        return torch.diag(self.noise) if self.noise.ndim == 1 else self.noise


@dataclass(frozen=True)
class SubspaceMisfit(SpectralMisfit):
    """These residuals by the subspace of the inputs, which the sensors must outnumber."""

    def __post_init__(self) -> None:
        m = self.spectra.values.shape[-1]
        if not 0 < self.n_inputs < m:
            raise ValueError(
                f"{m} sensors do not tell the responses to {self.n_inputs} inputs whose spectra "
                "are unknown; at least one sensor more is needed"
            )

    @property
    def n_of_bin(self) -> int:
        """Number of residuals of a bin."""
        return 2 * self.spectra.values.shape[-1] * self.n_inputs

    @property
    def expected(self) -> float:
        """Mean square of a residual where the model is right."""
        m = self.spectra.values.shape[-1]
        return (m - self.n_inputs) / m

    @cached_property
    def _root(self) -> Tensor:
        """N^-1/2, (n_freq, m, m)."""
        errors = torch.diag_embed(self.spread**2 * self.spectra.densities)
        factor = torch.linalg.cholesky(self._noise + errors)
        unit = torch.eye(factor.shape[-1], dtype=factor.dtype)
        root: Tensor = torch.linalg.solve_triangular(factor, unit, upper=False)
        return root.to(torch.complex128)

    @cached_property
    def _signals(self) -> Tensor:
        """u_k (lambda_k - 1) / sqrt(lambda_k) sqrt(2 n), (n_freq, m, p)."""
        white = self._root @ self.spectra.values @ self._root.mH
        power, vectors = torch.linalg.eigh(white)
        power, vectors = power[:, -self.n_inputs :], vectors[:, :, -self.n_inputs :]
        weights = (power - 1).clamp(min=0.0) / power.clamp(min=1.0).sqrt()
        signals: Tensor = math.sqrt(2 * self.spectra.n_averages) * vectors * weights[:, None, :]
        return signals

    def error_shares(self, responses: Tensor) -> Tensor:
        """Return the fraction of the variance of residuals that is due to errors, (n_freq,).

        `responses` (p, m, n_freq) are those of one vehicle.
        """
        rows = self.free(responses)[1]
        power = (rows @ self._noise.to(rows) * rows.conj()).real.sum(dim=(-2, -1))
        shares: Tensor = 1 - power / rows.shape[1]
        return shares

    def error_equations(self, responses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what errors must explain, its standard deviation by noise, and their patterns.

        They are those of `trains.spectra.model_errors` with n eps_i^2 = spread_i^2, real and
        imaginary parts one after the other: (n_freq, k), (n_freq, k), (n_freq, m, k).
        """
        p, (residuals, rows) = self.n_inputs, self.free(responses)
        noise = rows @ self._noise.to(rows) @ rows.mH
        target = residuals @ residuals.mH / 2 - p * noise
        sizes = p * self.spectra.n_averages * self.spectra.densities
        patterns = torch.einsum("fai,fbi,fi->fiab", rows, rows.conj(), sizes.to(rows))
        return equations_of(target, noise, patterns, p)

    def inputs(self, responses: Tensor) -> Tensor:
        """Return D, (n_freq, p, p), of responses (p, m, n_freq)."""
        inverse = torch.linalg.pinv(responses.permute(2, 1, 0))
        inputs: Tensor = inverse @ (self.spectra.values - self._noise) @ inverse.mH
        return inputs

    def free(self, responses: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (n_freq, m - p, p) in directions that responses (p, m, n_freq) leave.

        Also the rows W (n_freq, m - p, m) that make these of sensors: W H = 0, W N W^* = 1.
        """
        basis = torch.linalg.qr(self._white(responses[None])[0], mode="complete")[0]
        directions = basis[:, :, self.n_inputs :].mH
        return directions @ self._signals, directions @ self._root

    def __call__(self, responses: Tensor) -> Tensor:
        """Return the residuals (n_rows, n_points) of responses (n_rows, p, m, n_freq)."""
        return _flat(self._left(torch.linalg.qr(self._white(responses))[0]))

    def derivative(self, responses: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (n_points,) and their derivatives (n_directions, n_points).

        `responses` (p, m, n_freq) are those of one vehicle, `changes` (n_directions, p, m, n_freq)
        their derivatives. With M the signals and A^+ the pseudo-inverse of A::

            dr = -((I - P) dA A^+ + (A^+)^* dA^* (I - P)) M
        """
        basis, triangle = torch.linalg.qr(self._white(responses[None])[0])
        left = self._left(basis)
        inverse = torch.linalg.solve_triangular(triangle, basis.mH, upper=True)
        free = self._root - basis @ (basis.mH @ self._root)  # (I - P) N^-1/2
        # one product a bin for all directions: many small ones take ten times as long
        n_rows, p = len(changes), self.n_inputs
        moved = changes.permute(3, 2, 0, 1).flatten(2)  # (n_freq, m, n_rows p)
        first = (free @ moved).unflatten(2, (n_rows, p)).flatten(1, 2) @ (inverse @ self._signals)
        ahead = (moved.mH @ (self._root.mH @ left)).unflatten(1, (n_rows, p))
        second = inverse.mH @ ahead.transpose(1, 2).flatten(2)
        both = first.view(len(moved), -1, n_rows, p) + second.unflatten(2, (n_rows, p))
        return _flat(left[None])[0], _flat(-both.permute(2, 0, 1, 3))

    def _white(self, responses: Tensor) -> Tensor:
        """Return A, (n_rows, n_freq, m, p)."""
        return self._root @ responses.permute(0, 3, 2, 1)

    def _left(self, basis: Tensor) -> Tensor:
        """Return what the columns of a basis (..., n_freq, m, p) leave of the signals."""
        return self._signals - basis @ (basis.mH @ self._signals)


def _flat(values: Tensor) -> Tensor:
    return torch.view_as_real(values).flatten(1)


def equations_of(
    target: Tensor, noise: Tensor, patterns: Tensor, p: int = 1
) -> tuple[Tensor, Tensor, Tensor]:
    """Return complex matrices as real rows, and by how much noise scatters each.

    `target`, and `noise` of one of p inputs, are (n_freq, n, n), `patterns` (n_freq, m, n, n).
    """
    power = noise.diagonal(dim1=-2, dim2=-1).real
    # a diagonal element is real and scatters as much as both parts of another one
    parts = (1 + torch.eye(power.shape[1], dtype=power.dtype)) / 2
    scatter = (p * parts * power[:, :, None] * power[:, None, :]).sqrt()
    deviations = torch.stack([scatter, scatter], dim=-1)
    rows = [torch.view_as_real(matrices).flatten(-3) for matrices in (target, patterns)]
    return rows[0], deviations.flatten(1), rows[1]
