"""Features of the spectral matrix of any sensors: where the subspace of their responses has turned.

With Q an orthonormal basis of the subspace that the responses of the healthy vehicle to p inputs
span in a bin, after whitening by the sensors' noise N, Q' one of its complement, and S the spectral
matrix of m sensors, the coordinates of the bin are ::

    T = Q'^* W Q (Q^* W Q)^-1,    W = N^-1/2 S N^-1/2

the transfer from the signals along Q to those along Q', as H_rest H_ref^-1 of chosen sensors but
with the best p mixtures of all of them as the reference. With S = H D H^* + N, A = N^-1/2 H and D
the inputs' spectra it tends to Q'^* A (Q^* A)^-1 as D grows: whatever D is, and 0 for the healthy
vehicle; an input that the sensors barely feel adds little, instead of noise. The features are the
principal components of real and imaginary parts, whitened by the noise of n averages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from suspnet.spectra.noise_components import NoiseComponents, noise_components


@dataclass(frozen=True)
class SubspaceCoordinates:
    """Coordinates of spectral matrices relative to a healthy vehicle.

    `whitener` (n_freq, m, m) is (Q, Q')^* N^-1/2, complex; `n_inputs` is p.
    """

    whitener: Tensor
    n_inputs: int

    @classmethod
    def of(cls, healthy: Tensor, noise: Tensor) -> Self:
        """Return those relative to responses (p, m, n_freq); `noise` (m,) [(m/s^2)^2/Hz].

        ValueError if there are not more sensors than inputs.
        """
        p, m, _ = healthy.shape
        if p >= m:
            raise ValueError(f"{m} sensors show no change of the responses to {p} inputs")
        white = noise.rsqrt()[:, None] * healthy.permute(2, 1, 0)
        basis = torch.linalg.qr(white, mode="complete")[0]
        return cls(basis.mH * noise.rsqrt(), p)

    def __call__(self, spectra: Tensor) -> Tensor:
        """Return real and imaginary parts of T, (n_rows, 2 (m - p) p n_freq).

        `spectra` (n_rows, n_freq, m, m) are complex, [(m/s^2)^2/Hz].
        """
        turned, p = self.whitener @ spectra @ self.whitener.mH, self.n_inputs
        found = torch.linalg.solve(turned[..., :p, :p], turned[..., p:, :p], left=False)
        return torch.view_as_real(found.resolve_conj()).flatten(1)


@dataclass(frozen=True)
class SubspaceFeatures:
    """Principal components of the coordinates of spectral matrices, each with noise of about 1."""

    coordinates: SubspaceCoordinates
    components: NoiseComponents

    @classmethod
    def fitted(
        cls, coordinates: SubspaceCoordinates, clean: Tensor, noisy: Tensor, count: int
    ) -> Self:
        """Return `count` components of coordinates without and with noise, (n_rows, n_columns).

        ValueError if there are fewer rows or columns.
        """
        return cls(coordinates, noise_components(clean, noisy, count))

    def __call__(self, spectra: Tensor) -> Tensor:
        """Return the features of spectral matrices (n_rows, n_freq, m, m), (n_rows, count)."""
        return self.components(self.coordinates(spectra))


def input_spectra(spectra: Tensor, responses: Tensor, noise: Tensor) -> Tensor:
    """Return the spectral matrices D of the inputs that a vehicle's sensors show.

    D = A^+ (W - I) (A^+)^*, without its negative eigenvalues; (n_freq, p, p). `spectra`
    (n_freq, m, m) and `noise` (m,) [(m/s^2)^2/Hz], `responses` (p, m, n_freq).
    """
    white = noise.rsqrt()
    a = white[:, None] * responses.permute(2, 1, 0)
    w = white[:, None] * spectra * white
    inverse = torch.linalg.pinv(a)
    one = torch.eye(len(noise), dtype=w.dtype)
    power, vectors = torch.linalg.eigh(inverse @ (w - one) @ inverse.mH)
    found: Tensor = (vectors * power.clamp(min=0.0)[:, None]) @ vectors.mH
    return found
