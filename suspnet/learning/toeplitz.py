"""Normal equations with a Toeplitz Gram matrix, by preconditioned conjugate gradients."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from suspnet.learning.design import Direction, Gradient, without_intercept

if TYPE_CHECKING:
    from suspnet.learning.equispaced import EquispacedDesign

FIRST_BLOCK, LARGEST_BLOCK = 1000, 2000
"""Waves that the preconditioner solves exactly, at first and at most; the rest it divides by the
diagonal. The block doubles after ..."""
PATIENCE = 100
"""... so many iterations in a row."""
MAX_CG_ITER = 1000
TINY = torch.finfo(torch.float64).tiny
FORCING = 1e-4
"""Conjugate gradients stop when they have found all but about this part of the decrement."""


class ToeplitzEquations:
    """Normal equations with a Toeplitz Gram matrix, by preconditioned conjugate gradients.

    Parameters
    ----------
    design : EquispacedDesign
    C : float
    fit_intercept : bool
    reweighted : bool
        Make the matrix anew for the weights of each call; else all weights are 2 C.
    """

    def __init__(
        self, design: EquispacedDesign, C: float, fit_intercept: bool, reweighted: bool
    ) -> None:
        self._design, self._fit_intercept, self._reweighted = design, fit_intercept, reweighted
        self._shape = tuple(next_fast_len(4 * count + 1, real=True) for count in design.counts)
        half = (*self._shape[:-1], self._shape[-1] // 2 + 1)
        self._half = half
        size = torch.tensor(self._shape)
        self._places = flat_index(design.waves % size, half)
        plane = design.waves[:, -1] == 0
        self._plane = plane
        self._mirrored = flat_index(-design.waves[plane] % size, half)
        wide = [4 * count + 1 for count in design.counts]
        self._steps, self._middle = flat_index(design.waves, wide), math.prod(wide) // 2
        self._use(design.toeplitz(torch.full((design.n_samples,), 2 * C, dtype=torch.float64)))
        strengths = torch.cat([design.modes.strengths, design.modes.strengths[1:]])
        self._diagonal = 1 + strengths * self._centre
        self._largest = min(len(design.waves), LARGEST_BLOCK)
        self._invert_leading(min(self._largest, FIRST_BLOCK))

    def direction(self, gradient: Gradient, accuracy: float) -> Direction:
        """Return an approximate solution of the normal equations."""
        if self._reweighted:
            self._use(self._design.toeplitz(gradient.weights))
        return without_intercept(
            gradient, self._sums, self._weight, lambda right: self._solve(right, accuracy)
        )

    def _use(self, toeplitz: Tensor) -> None:
        """Take the Fourier sums of the weights as those of the matrix."""
        design = self._design
        self._toeplitz = toeplitz.flatten()
        self._centre = float(self._toeplitz[self._middle].real)
        indices = [
            torch.arange(-2 * count, 2 * count + 1) % size
            for count, size in zip(design.counts, self._shape, strict=True)
        ]
        indices[-1] = indices[-1][2 * design.counts[-1] :]
        spectrum = torch.zeros(self._half, dtype=torch.complex128)
        spectrum[torch.meshgrid(*indices, indexing="ij")] = toeplitz[..., 2 * design.counts[-1] :]
        self._density = torch.fft.irfftn(spectrum, s=self._shape, norm="forward")
        sums = design.real(self._toeplitz[self._middle + self._steps][None])[:, 0]
        # without b, or without any weight, there is nothing to eliminate
        self._weight = self._centre if self._fit_intercept else 0.0
        self._sums = sums if self._weight > 0 else torch.zeros_like(sums)

    def _multiply(self, vector: Tensor) -> Tensor:
        """Return (I + Phi^T D Phi - sums sums^T / weight) vector."""
        spectra = self._design.spectrum(vector)
        grid = torch.zeros(len(spectra), math.prod(self._half), dtype=torch.complex128)
        grid[:, self._places] = spectra
        grid[:, self._mirrored] = spectra[:, self._plane].conj()
        axes = tuple(range(1, len(self._shape) + 1))
        grid = grid.reshape(-1, *self._half)
        field = torch.fft.irfftn(grid, s=self._shape, dim=axes, norm="forward")
        grid = torch.fft.rfftn(field.mul_(self._density), dim=axes, norm="forward")
        found = vector + self._design.real(grid.flatten(1)[:, self._places])
        if self._weight > 0:
            found -= torch.outer(self._sums, self._sums @ vector / self._weight)
        return found

    def _solve(self, right: Tensor, accuracy: float) -> Tensor:
        """Return the solution by conjugate gradients, one for each column at the same time."""
        solution, left = torch.zeros_like(right), right.clone()
        search = torch.zeros_like(right)
        before = torch.ones_like(right[0])
        for iteration in range(MAX_CG_ITER):
            if iteration % PATIENCE == PATIENCE - 1 and self._n_block < self._largest:
                self._invert_leading(min(2 * self._n_block, self._largest))
                search.zero_()
            preconditioned = self._precondition(left)
            energy = (left * preconditioned).sum(dim=0)
            decrement = float((solution * right).sum())
            if float(energy.sum()) <= FORCING * decrement:
                last = 0.5 * decrement <= accuracy
                if not last or float(left.square().sum()) <= accuracy:
                    break
            search = preconditioned + energy / before * search
            pushed = self._multiply(search)
            step = energy / (search * pushed).sum(dim=0).clamp(min=TINY)
            solution += step * search
            left -= step * pushed
            before = energy.clamp(min=TINY)
        return solution

    def _precondition(self, vector: Tensor) -> Tensor:
        found = vector / self._diagonal[:, None]
        found[self._leading] = self._inverse @ vector[self._leading]
        return found

    def _invert_leading(self, n_block: int) -> None:
        """Invert the matrix's block of the strongest waves."""
        n_waves = len(self._design.waves)
        self._n_block = n_block
        self._leading = torch.cat([torch.arange(n_block), n_waves + torch.arange(n_block - 1)])
        factor, info = torch.linalg.cholesky_ex(self._leading_block())
        if int(info):
            raise ValueError(
                f"the system of IRWLS is singular to working precision with weights of "
                f"{self._centre:.1e} in all; lower C, or scale the outputs"
            )
        self._inverse = torch.cholesky_inverse(factor)

    def _leading_block(self) -> Tensor:
        """Return that block, entry by entry: products of cosines and sines are sums of t_k."""
        n = self._n_block
        step = self._steps[:n]
        less = self._toeplitz[self._middle + step[:, None] - step]
        more = self._toeplitz[self._middle + step[:, None] + step]
        scale = self._design.modes.strengths[:n].sqrt()
        scale[0] /= math.sqrt(2)
        scale = torch.outer(scale, scale)
        even = scale * (less.real + more.real)
        odd = (scale * (less.real - more.real))[1:, 1:]
        mixed = (scale * (less.imag - more.imag))[:, 1:]
        block = torch.cat([torch.cat([even, mixed], dim=1), torch.cat([mixed.T, odd], dim=1)])
        if self._weight > 0:
            sums = self._sums[self._leading]
            block.addr_(sums, sums, alpha=-1 / self._weight)
        block.diagonal().add_(1.0)
        return block


def flat_index(index: Tensor, shape: list[int] | tuple[int, ...]) -> Tensor:
    """Return the place of each row (n, n_axes) of indices in a flattened array of that shape."""
    strides = torch.tensor([math.prod(shape[axis + 1 :]) for axis in range(len(shape))])
    return index @ strides
