"""The design matrix Phi of a training set, and the normal equations of Eq. (9) on it.

Phi is in memory as a whole only if it is small: products are computed in blocks of its rows.
`DenseDesign` serves every `FeatureMap`; ``equispaced`` has a faster design in ``toeplitz``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from sklearn.utils import gen_batches
from torch import Tensor, cholesky_solve

from suspnet.learning.feature_maps import FeatureMap

CACHE_BYTES = 400_000_000
"""Largest size of a training set's features that stay in memory between passes [bytes]."""
MOST_COUPLED = 4096
"""Largest number of features times outputs for which Newton's equations are factored."""
Kind = Literal["fixed", "reweighted", "newton"]
"""Kind of normal equations, see ``Design.equations``."""
Columns = Callable[[slice, Tensor], Tensor]
"""Function that returns V[rows], (n_rows, n_columns), from `rows` and (Phi W + b)[rows]."""


@dataclass(frozen=True)
class Coefficients:
    """W and b, or a change of them: `coef` (n_features, n_outputs), `intercept` (n_outputs,)."""

    coef: Tensor
    intercept: Tensor


@dataclass(frozen=True)
class Gradient:
    """The gradient of F at a point, and the samples' weights a_i of Eq. (10) there.

    `coef`: (n_features, n_outputs), `intercept`: (n_outputs,), 0 if b is not fitted, `weights`:
    (n_samples,), `residual`: (n_samples, n_outputs).
    """

    coef: Tensor
    intercept: Tensor
    weights: Tensor
    residual: Tensor


class NormalEquations(Protocol):
    """Interface of equations that give a direction, exactly or approximately that of Eq. (9)."""

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return a direction; `accuracy` is the error of F that may remain."""
        ...


class Design(ABC):
    """The interface through which the solver uses Phi.

    Inner products and coefficients are those of vectors that hold the features themselves.
    """

    n_features: int

    def inner(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the sum over outputs of the inner products of two vectors of features."""
        return (first * second).sum()

    def coefficients(self, coef: Tensor) -> Tensor:
        """Return the coefficients with which the feature map predicts."""
        return coef

    @abstractmethod
    def rmatvec(self, columns: Tensor) -> Tensor:
        """Return Phi^T columns, shape (n_features, n_columns)."""

    @abstractmethod
    def matvec_rmatvec(self, change: Coefficients, columns: Columns) -> tuple[Tensor, Tensor]:
        """Return Phi W + b, and Phi^T V with V = columns(rows, (Phi W + b)[rows]), in one pass."""

    @abstractmethod
    def equations(self, kind: Kind, C: float, fit_intercept: bool) -> NormalEquations:
        """Return normal equations of a kind.

        "fixed" are those of all weights 2 C, their largest by Eq. (10), computed once, "reweighted"
        those of Eq. (9), computed for the weights of every iteration, "newton" those of Newton's
        method, or those of Eq. (9) where they cost less.
        """


@dataclass(frozen=True)
class Gram:
    """Sums over the samples of w phi phi^T, w phi and w, in float64.

    `products`: (n_features, n_features), `sums`: (n_features,).
    """

    products: Tensor
    sums: Tensor
    weight_sum: float


class DenseDesign(Design):
    """Phi in blocks of rows.

    If a map ends with a product with a fixed basis, Phi = K V, the blocks are those of K, and V
    multiplies coefficients and sums instead of every block; only the Gram matrix uses Phi itself.

    Phi is stored between passes if it fits into `cache_bytes`, else `block_rows` of it are in
    memory at once. `gram_columns` columns of the Gram matrix are computed at a time, from the
    diagonal on, as it is symmetric. `X`: (n_samples, n_inputs).
    """

    def __init__(
        self,
        feature_map: FeatureMap,
        X: Tensor,
        *,
        block_rows: int = 4096,
        cache_bytes: int = CACHE_BYTES,
        gram_columns: int = 256,
    ) -> None:
        self.X = X
        self._gram_columns = gram_columns
        self._basis, self._make = feature_map.basis, feature_map.raw
        self._slices = list(gen_batches(len(X), block_rows))
        first = self._make(X.new_zeros(1, X.shape[1]))
        self._width = first.shape[1]
        self.n_features = self._width if self._basis is None else self._basis.shape[1]
        whole = len(X) * self._width * first.element_size()
        self._blocks = [self._make(X[s]) for s in self._slices] if whole <= cache_bytes else []

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield (rows, Phi[rows]), or K in place of Phi."""
        if self._blocks:
            yield from zip(self._slices, self._blocks, strict=True)
        else:
            for rows in self._slices:
                yield rows, self._make(self.X[rows])

    def rmatvec(self, columns: Tensor) -> Tensor:
        """Return Phi^T columns, shape (n_features, n_columns)."""
        product = self._zeros(self._width, columns.shape[1])
        for rows, phi in self:
            product += (columns[rows].T @ phi).T
        return self._projected(product)

    def matvec_rmatvec(self, change: Coefficients, columns: Columns) -> tuple[Tensor, Tensor]:
        """Return Phi W + b, and Phi^T V with V = columns(rows, (Phi W + b)[rows]), in one pass."""
        moved = self.X.new_empty(len(self.X), change.coef.shape[1], dtype=torch.float64)
        product = self._zeros(self._width, 0)
        coef = change.coef if self._basis is None else self._basis.to(change.coef) @ change.coef
        for rows, phi in self:
            moved[rows] = (phi @ coef) + change.intercept
            partial = (columns(rows, moved[rows]).T @ phi).T
            product = product.add_(partial) if product.shape[1] else partial
        return moved, self._projected(product)

    def weighted_gram(self, weights: Tensor | None) -> Gram:
        """Return the Gram matrix of the weighted samples; those of weight 0 cost nothing."""
        products = self._zeros(self.n_features, self.n_features)
        sums = self._zeros(self.n_features, 1)[:, 0]
        count = products.new_zeros(1)
        starts = range(0, self.n_features, self._gram_columns)
        for rows, phi in self:
            w = None if weights is None else weights[rows]
            if w is not None and not bool(w.all()):
                support = w.nonzero()[:, 0]
                phi, w = phi[support], w[support]
            if self._basis is not None:
                phi = phi @ self._basis
            scaled = phi if w is None else phi * w[:, None]
            count += len(phi) if w is None else w.sum()
            sums += scaled.sum(dim=0)
            for start in starts:
                stripe = slice(start, start + self._gram_columns)
                products[stripe, start:] += scaled[:, stripe].T @ phi[:, start:]
        return Gram(products.triu() + products.triu(1).T, sums, float(count))

    def equations(self, kind: Kind, C: float, fit_intercept: bool) -> NormalEquations:
        """Return equations of a kind, which are factored."""
        if kind == "fixed":
            return FixedGram(self.weighted_gram(None), C, fit_intercept)
        if kind == "newton":
            return NewtonGram(self, C, fit_intercept)
        return ReweightedGram(self, fit_intercept)

    def _projected(self, product: Tensor) -> Tensor:
        """Return V^T product where the blocks are those of K, else the product."""
        return product if self._basis is None else self._basis.to(product).T @ product

    def _zeros(self, n_rows: int, n_columns: int) -> Tensor:
        return torch.zeros(n_rows, n_columns, dtype=torch.float64, device=self.X.device)


class FixedGram:
    """Directions of I + 2 C Phi^T Phi, b eliminated: one factorisation serves every iteration.

    No weight exceeds 2 C, so this quadratic bounds F from above and a full step never raises F. The
    step projects each residual onto the epsilon-ball and regresses the remainder by ridge
    regression.
    """

    def __init__(self, gram: Gram, C: float, fit_intercept: bool) -> None:
        self._solve = _centred_solver(gram, 2 * C, fit_intercept)

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return -H^-1 g, exactly."""
        return self._solve(gradient)


class ReweightedGram:
    """Directions of Eq. (9), one factorisation per iteration: textbook IRWLS."""

    def __init__(self, design: DenseDesign, fit_intercept: bool) -> None:
        self._design, self._fit_intercept = design, fit_intercept

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return (W^s - W, b^s - b) of Eq. (11), exactly."""
        gram = self._design.weighted_gram(gradient.weights)
        return _centred_solver(gram, 1.0, self._fit_intercept)(gradient)


class NewtonGram:
    """Directions of Newton's method, with the second derivative of L(|r|) of each sample.

    For a sample outside the tube it is, with its largest weight c = 2 C, its weight a of Eq. (10)
    and its residual r::

        H = a 1 + (c - a) r r^T / |r|^2

    which couples the outputs; Eq. (9) has the first term alone. Near the minimum a few of these
    steps do what takes hundreds of those of Eq. (9) where many samples lie within the tube. Above
    ``MOST_COUPLED`` unknowns the directions are those of Eq. (9).
    """

    def __init__(self, design: DenseDesign, C: float, fit_intercept: bool) -> None:
        self._design, self._C, self._fit_intercept = design, C, fit_intercept
        self._reweighted = ReweightedGram(design, fit_intercept)

    def direction(self, gradient: Gradient, accuracy: float) -> Coefficients:
        """Return the Newton direction, exactly."""
        n_features, n_outputs = gradient.coef.shape
        if n_outputs == 1 or n_features * n_outputs > MOST_COUPLED:
            if n_outputs == 1:  # H = c along the only direction there is
                gradient = replace(gradient, weights=2 * self._C * (gradient.weights > 0))
            return self._reweighted.direction(gradient, accuracy)
        # one block for each pair of outputs, with a last row and column for b
        n = n_features + 1
        matrix = gradient.coef.new_zeros(n_outputs, n, n_outputs, n)
        for j, k, gram in self._grams(gradient):
            block = torch.cat([gram.products, gram.sums[None]])
            last = torch.cat([gram.sums, gram.sums.new_tensor([gram.weight_sum])])
            matrix[j, :, k, :] = torch.cat([block, last[:, None]], dim=1)
            matrix[k, :, j, :] = matrix[j, :, k, :]
        right = -torch.cat([gradient.coef, gradient.intercept[None]])
        # without a sample outside the tube b is not determined
        n_free = n if self._fit_intercept and float(matrix[0, -1, 0, -1]) > 0 else n_features
        matrix, right = matrix[:, :n_free, :, :n_free], right[:n_free]
        for j in range(n_outputs):
            matrix[j, :, j, :].diagonal()[:n_features] += 1
        size = n_free * n_outputs
        factor = cholesky(matrix.reshape(size, size), "system of Newton's method")
        flat = cholesky_solve(right.T.reshape(size, 1), factor)
        solution = torch.zeros(n, n_outputs).to(right)
        solution[:n_free] = flat.reshape(n_outputs, n_free).T
        return Coefficients(solution[:n_features], solution[-1])

    def _grams(self, gradient: Gradient) -> Iterator[tuple[int, int, Gram]]:
        """Yield the Gram matrix of each pair of outputs j <= k, weighted by H_jk."""
        unit = torch.nn.functional.normalize(gradient.residual, dim=1)
        across = gradient.weights
        along = (2 * self._C - across) * (across > 0)
        for j in range(unit.shape[1]):
            for k in range(j, unit.shape[1]):
                weights = along * unit[:, j] * unit[:, k] + (across if j == k else 0.0)
                yield j, k, self._design.weighted_gram(weights)


def _centred_solver(
    gram: Gram, scale: float, fit_intercept: bool
) -> Callable[[Gradient], Coefficients]:
    """Return what solves the equations of I plus the scaled Gram matrix, with b eliminated."""
    matrix = scale * gram.products
    sums, weight_sum = torch.zeros_like(gram.sums), 0.0
    if fit_intercept and gram.weight_sum > 0:
        sums, weight_sum = scale * gram.sums, scale * gram.weight_sum
        matrix.addr_(sums, sums, alpha=-1 / weight_sum)
    matrix.diagonal().add_(1.0)
    name = f"system of IRWLS with weights of total {scale * gram.weight_sum:.1e}"
    factor = cholesky(matrix, name)

    def solve(right: Tensor) -> Tensor:
        return cholesky_solve(right, factor)

    return lambda gradient: without_intercept(gradient, sums, weight_sum, solve)


def cholesky(matrix: Tensor, name: str, advice: str = "lower C, or scale the outputs") -> Tensor:
    """Return the Cholesky factor of a matrix; ValueError with advice if it is singular."""
    factor: Tensor
    factor, info = torch.linalg.cholesky_ex(matrix)
    # each row of the factor enters its diagonal
    if int(info) or not bool(torch.isfinite(factor.diagonal()).all()):
        raise ValueError(
            f"the {len(matrix)} x {len(matrix)} {name} is singular to working precision; {advice}"
        )
    return factor


def without_intercept(
    gradient: Gradient, sums: Tensor, weight_sum: float, solve: Callable[[Tensor], Tensor]
) -> Coefficients:
    """Solve for W and b with b eliminated: weight_sum db = -g_b - sums . dW.

    `sums` and `weight_sum` are those of the weighted samples, 0 if b is not fitted; `solve` solves
    the remaining equations for W.
    """
    shift = torch.zeros_like(gradient.intercept)
    if weight_sum > 0:
        shift = -gradient.intercept / weight_sum
    coef = solve(-gradient.coef - torch.outer(sums, shift))
    if weight_sum > 0:
        shift = shift - sums @ coef / weight_sum
    return Coefficients(coef, shift)
