"""The design of equispaced modes: its Gram matrix is Toeplitz, solved by conjugate gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from suspnet.learning.design import (
    Coefficients,
    Columns,
    Design,
    Gradient,
    Kind,
    cholesky,
    without_intercept,
)
from suspnet.learning.equispaced import EquispacedFeatures, EquispacedTransform, flat_index

TINY = torch.finfo(torch.float64).tiny  # smallest divisor, for columns that are solved exactly


@dataclass(frozen=True)
class ConjugateGradients:
    """Settings of the preconditioned conjugate gradients.

    The preconditioner inverts the block of the `first_block` strongest waves, and divides the other
    rows by the diagonal. Every `iterations_per_block` iterations of one solution the block doubles,
    up to `largest_block`. A solution ends when the error of the Newton decrement is about
    `forcing` times the decrement.
    """

    first_block: int = 1000
    largest_block: int = 2000
    iterations_per_block: int = 100
    forcing: float = 1e-4
    max_iter: int = 1000


class EquispacedDesign(EquispacedTransform, Design):
    """The design matrix Phi of equispaced modes.

    With several outputs Newton's equations are not Toeplitz: those of Eq. (9) take their place.
    """

    def __init__(
        self, modes: EquispacedFeatures, X: Tensor, solver: ConjugateGradients | None = None
    ) -> None:
        super().__init__(modes, X)
        self._solver = solver or ConjugateGradients()

    def matvec_rmatvec(self, change: Coefficients, columns: Columns) -> tuple[Tensor, Tensor]:
        """Return Phi W + b, and Phi^T V with V = columns(rows, (Phi W + b)[rows])."""
        moved = self.matvec(change.coef) + change.intercept
        return moved, self.rmatvec(columns(slice(0, self.n_samples), moved))

    def equations(self, kind: Kind, C: float, fit_intercept: bool) -> ToeplitzEquations:
        """Return equations of a kind, those of Eq. (9) for Newton's method."""
        return ToeplitzEquations(self, C, fit_intercept, kind != "fixed", self._solver)


class ToeplitzEquations:
    """Normal equations with a Toeplitz Gram matrix, by preconditioned conjugate gradients.

    If `reweighted`, the matrix is computed for the weights of each call; else all weights are 2 C.
    """

    def __init__(
        self,
        design: EquispacedTransform,
        C: float,
        fit_intercept: bool,
        reweighted: bool,
        solver: ConjugateGradients,
    ) -> None:
        self._design, self._fit_intercept, self._reweighted = design, fit_intercept, reweighted
        self._solver = solver
        self._shape = tuple(next_fast_len(4 * count + 1, real=True) for count in design.counts)
        # Spectra of real fields are stored as rfftn does: the last axis has half the frequencies,
        # and in its plane 0 both k and -k are needed.
        self._half = (*self._shape[:-1], self._shape[-1] // 2 + 1)
        size = torch.tensor(self._shape)
        self._places = flat_index(design.waves % size, self._half)
        self._plane = design.waves[:, -1] == 0
        self._mirrored = flat_index(-design.waves[self._plane] % size, self._half)
        wide = [4 * count + 1 for count in design.counts]
        self._steps, self._middle = flat_index(design.waves, wide), math.prod(wide) // 2
        # The first preconditioner is that of weights 2 C, also for reweighted equations.
        self._use(design.toeplitz(torch.full((design.n_samples,), 2 * C, dtype=torch.float64)))
        strengths = torch.cat([design.modes.strengths, design.modes.strengths[1:]])
        self._diagonal = 1 + strengths * self._centre
        self._largest = min(len(design.waves), solver.largest_block)
        self._invert_leading(min(self._largest, solver.first_block))

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return an approximate solution of the normal equations."""
        if self._reweighted:
            self._use(self._design.toeplitz(gradient.weights))
        return without_intercept(
            gradient, self._sums, self._weight, lambda right: self._solve(right, accuracy)
        )

    def _use(self, toeplitz: Tensor) -> None:
        """Set the matrix to that of the weights with these Fourier sums."""
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
        # Without b, or without any weight, there is nothing to eliminate.
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
        product = vector + self._design.real(grid.flatten(1)[:, self._places])
        if self._weight > 0:
            product -= torch.outer(self._sums, self._sums @ vector / self._weight)
        return product

    def _solve(self, right: Tensor, accuracy: float) -> Tensor:
        """Return the solution by conjugate gradients, all columns at the same time."""
        solution, residual = torch.zeros_like(right), right.clone()
        search = torch.zeros_like(right)
        before = torch.ones_like(right[0])
        per_block = self._solver.iterations_per_block
        for iteration in range(self._solver.max_iter):
            # Slow convergence: invert a larger block, and restart the search directions with it.
            if iteration % per_block == per_block - 1 and self._n_block < self._largest:
                self._invert_leading(min(2 * self._n_block, self._largest))
                search.zero_()
            preconditioned = self._precondition(residual)
            energy = (residual * preconditioned).sum(dim=0)
            decrement = float((solution * right).sum())
            if float(energy.sum()) <= self._solver.forcing * decrement:
                # A direction that may be the last also needs a small residual r: the bound on the
                # gap subtracts |r|^2 / 2.
                last = 0.5 * decrement <= accuracy
                if not last or float(residual.square().sum()) <= accuracy:
                    break
            search = preconditioned + energy / before * search
            product = self._multiply(search)
            step = energy / (search * product).sum(dim=0).clamp(min=TINY)
            solution += step * search
            residual -= step * product
            before = energy.clamp(min=TINY)
        return solution

    def _precondition(self, vector: Tensor) -> Tensor:
        divided = vector / self._diagonal[:, None]
        divided[self._leading] = self._inverse @ vector[self._leading]
        return divided

    def _invert_leading(self, n_block: int) -> None:
        n_waves = len(self._design.waves)
        self._n_block = n_block
        self._leading = torch.cat([torch.arange(n_block), n_waves + torch.arange(n_block - 1)])
        name = f"system of IRWLS with weights of total {self._centre:.1e}"
        self._inverse = torch.cholesky_inverse(cholesky(self._leading_block(), name))

    def _leading_block(self) -> Tensor:
        """Return the block of the strongest waves from sums and differences of t_k."""
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
