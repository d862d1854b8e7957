"""The residuals of the sum of squares of some trips, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.types import FloatArray
from suspnet.trains.spectra.covariance_matching import CovarianceMisfit
from suspnet.trains.spectra.subspace import SubspaceMisfit

if TYPE_CHECKING:
    from suspnet.trains.fits.bogie_misfit import BogieMisfit


@dataclass(frozen=True)
class Residuals:
    """The residuals of a `BogieMisfit` at some bins, as a function of its coordinates x.

    `subspaces` are those of each trip.
    """

    fit: BogieMisfit
    bins: Tensor
    subspaces: Sequence[SubspaceMisfit | CovarianceMisfit]

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return those of all trips, then those of the priors, (n_points,)."""
        return np.concatenate([*self.of_trips(x), self.fit.prior(x)])

    def of_trips(self, x: FloatArray) -> list[FloatArray]:
        """Return those of each trip."""
        return [
            subspace(self.fit.responses(x, i, self.bins)[None])[0].numpy()
            for i, subspace in enumerate(self.subspaces)
        ]

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return their derivatives, (n_points, n_coordinates)."""
        n_shared, n_own = self.fit.n_shared, self.fit.n_own
        blocks = []
        for i, subspace in enumerate(self.subspaces):
            slopes = subspace.derivative(*self.fit.responses_along(x, i, self.bins))[1].numpy().T
            block = np.zeros((len(slopes), len(x)))
            block[:, :n_shared] = slopes[:, :n_shared]
            # the numbers of other trips do not affect this one
            first = n_shared + n_own * i
            block[:, first : first + n_own] = slopes[:, n_shared:]
            blocks.append(block)
        return np.concatenate([*blocks, np.diag(1 / self.fit.prior_deviations)])

    def error_shares(self, x: FloatArray) -> FloatArray:
        """Return the fraction of each residual's variance that is due to errors, (n_points,).

        Those of priors are left out.
        """
        shares = []
        for i, subspace in enumerate(self.subspaces):
            of_bins = subspace.error_shares(self.fit.responses(x, i, self.bins))
            shares.append(of_bins.repeat_interleave(subspace.n_of_bin).numpy())
        return np.concatenate(shares)

    def in_orders(self, x: FloatArray, orders: Sequence[Sequence[int]]) -> FloatArray:
        """Return the rms residual of the first trip with its sensors in other orders.

        `orders` (n_orders, n_sensors) are numbers of its sensors.
        """
        responses = self.fit.responses(x, 0, self.bins)
        rows = torch.stack([responses[:, list(order)] for order in orders])
        return self.subspaces[0](rows).square().mean(dim=1).sqrt().numpy()
