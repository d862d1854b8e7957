"""The misfit of observed curves to a generator's, in units of their noise.

The sum of squares of these residuals is -2 log likelihood, and with their derivative J the product
J^T J is the Fisher information of `suspnet.estimation.information`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor, stack

from suspnet.ground.tensors import complex_log, squared_size
from suspnet.spectra.observation import Observer


@dataclass(frozen=True)
class EstimateMisfit:
    """Complex responses estimated from trips, with the covariance of their logarithms.

    With L L^H the covariance of (log G_p, log G_s) in a bin, u the difference of observed and
    expected logarithms and r the correlation of neighbouring bins (see
    ``Welch.correlated_bins``), the residuals are real and imaginary part of L^-1 u sqrt(2 / r).

    Attributes
    ----------
    observer : Observer
        With `settings.welch`.
    observed : complex tensor of shape (n_rows, 2, n_freq), [-]
    covariance : complex tensor of shape (n_rows, 2, 2, n_freq), [-]
        Infinite where an estimate is not to be used.
    """

    observer: Observer
    observed: Tensor
    covariance: Tensor

    @property
    def expected(self) -> float:
        """Mean square of a residual if the model is true: 1 / r, times the share in use."""
        return self._share / self._correlated

    def __call__(self, ratios: Tensor, rows: Tensor) -> Tensor:
        """Return residuals (n, n_points) of the vehicles `ratios` (n, 5) to the estimates `rows`.

        The covariance is that of the observation: it does not move with the ratios.
        """
        u = complex_log(self.observed[rows] / self.observer.noise_free(ratios))
        return self.whitened(u, rows)

    def whitened(self, u: Tensor, rows: Tensor, spread: float | Tensor = 0.0) -> Tensor:
        """Return the residuals (n, n_points) of relative differences.

        Parameters
        ----------
        u : complex tensor of shape (n, 2, n_freq), [-]
        rows : tensor of shape (n,)
            The estimates that they belong to.
        spread : float or tensor of shape (n_freq,), [-]
            Rms error of the model that is allowed for beside the noise; a bin in which it is
            infinite does not count.
        """
        covariance = self.covariance[rows]
        l_pp = (covariance[:, 0, 0].real + spread**2).sqrt()
        l_sp = covariance[:, 1, 0] / l_pp
        l_ss = (covariance[:, 1, 1].real + spread**2 - squared_size(l_sp)).sqrt()
        white_p = u[:, 0] / l_pp
        white_s = (u[:, 1] - l_sp * white_p) / l_ss
        parts = [white_p.real, white_p.imag, white_s.real, white_s.imag]
        return stack(parts, dim=1).flatten(1) * math.sqrt(2 / self._correlated)

    @cached_property
    def _share(self) -> float:
        """Share of the estimates that are used; the residuals of the others are 0."""
        used = self.covariance.diagonal(dim1=1, dim2=2).real.isfinite()
        return float(used.double().mean())

    @cached_property
    def _correlated(self) -> float:
        """Return r, the number of neighbouring bins with the information of one."""
        correlated: float = self.observer.settings.welch.correlated_bins
        return correlated
