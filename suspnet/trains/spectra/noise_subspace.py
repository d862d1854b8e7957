"""What the spectral matrix of sensors holds besides the inputs that all wheelsets meet.

Sensors have white noise of densities n_i, wheels out of round or rail joints excite each wheelset
alone, and dampers that blow off, stick or choke pull with forces that are incoherent with the
inputs (`suspnet.trains.spectra.damper_distortion`). With D_k the density of input k (elevation,
cross level, alignment), h_kw the responses of the sensors to that input under wheelset w alone, and
H those to the inputs of all::

    S = H D H^* + N,    N = diag(n) + sum_k a_k D_k sum_w h_kw h_kw^*
                            + sum_c b_c F_c + sum_j s_j G_j D G_j^*

The last term is what a segment of length T leaks into a bin: with s_j the smear of its window
(`Welch.smear`), bin f holds sum_j s_j H(f + j/T) D H(f + j/T)^*, of which G_j = H(f + j/T) - H(f)
is not in the columns of H(f). So are speeds one standard deviation off the trip's mean, with 1/2
each. D is taken as diagonal and smooth, so that the terms of first order in G_j, which j and -j
have with opposite signs, cancel. F_c are those of each kind of dampers and order.

The shares a_k, b_c and n are those for which N is closest to what S has beyond its p strongest
directions: with L the Cholesky factor of N, U the eigenvectors of the m - p smallest eigenvalues
lambda of L^-1 S L^-* and n_a averages, by non-negative least squares over all bins ::

    U^* L^-1 N(n, a, b) L^-* U = diag(lambda) / (1 - sum_k Lambda_k / (Lambda_k - 1) / n_a)

The p largest eigenvalues Lambda_k draw noise into their own directions, the more the closer they
are to 1 (Lawley, Biometrika 43, 128, 1956). With n_a / (n_a - p), which is right for strong inputs,
N would be a fifth too small where the alignment hardly reaches the sensors. Leakage needs no share:
its size is known. N in L and in U is that of the round before. The smallest eigenvalues do not
depend on H, so that errors of the vehicle are not taken for noise.
"""

import math
from dataclasses import dataclass

import torch
from scipy.optimize import nnls
from torch import Tensor
from torch.nn.functional import avg_pool1d

from suspnet.trains.spectra.subspace import SpectralMatrix

ROUNDS = 4
"""Rounds of least squares: after three, shares of 1 % differ from those of six rounds by 2 % of
their standard deviation at most (12 draws of tests/spectra/test_noise_subspace.py)."""
LEAST_NOISE = 1e-3
"""Least noise of a sensor over that of the first round."""
MOST_TAKEN = 0.5
"""Largest fraction of the noise that inputs are taken to have drawn into their own directions."""
SMOOTH_BINS = 9
"""Bins over which the density of an input is averaged."""


@dataclass(frozen=True)
class Leakage:
    """What a bin takes from neighbours whose responses differ from its own.

    `weights` (n_taps,) are s_j, `differences` (n_taps, p, m, n_freq) the G_j.
    """

    weights: Tensor
    differences: Tensor

    def matrix(self, densities: Tensor) -> Tensor:
        """Return its spectral matrix, (n_freq, m, m); `densities` (p, n_freq) are D."""
        weighted = self.weights[:, None, None] * densities
        leaked = self.differences * weighted.sqrt()[:, :, None]
        columns = leaked.flatten(0, 1).permute(2, 1, 0)
        return columns @ columns.mH


@dataclass(frozen=True)
class TripNoise:
    """Noise of the sensors (m,) [(m/s^2)^2/Hz], and the shares of other sources.

    `shares` (k,) are those of what excites wheelsets alone, `of_forces` (n_forces,) those of
    dampers' forces. `matrix` is N, (n_freq, m, m) [(m/s^2)^2/Hz].
    """

    densities: Tensor
    shares: Tensor
    of_forces: Tensor
    matrix: Tensor


def trip_noise(
    spectra: SpectralMatrix,
    responses: Tensor,
    alone: Tensor,
    start: Tensor,
    leakage: Leakage | None = None,
    forces: Tensor | None = None,
) -> TripNoise:
    """Return the noise of a trip, given responses of the vehicle that are about right.

    `responses` (p, m, n_freq) are H, `alone` (k, n_wheelsets, m, n_freq) the h_kw of its first k
    inputs, `start` (m,) the densities n of the first round, `forces` (n_forces, n_freq, m, m) the
    F_c. Without `leakage`, bins hold none; without `forces`, dampers are linear. ValueError if
    there are not more averages than sensors.
    """
    p, m, _ = responses.shape
    if spectra.n_averages <= m:
        raise ValueError(
            f"{spectra.n_averages:.3g} averages do not tell the noise of {m} sensors; take a "
            "longer trip or shorter segments"
        )
    units = torch.diag_embed(torch.eye(m, dtype=torch.complex128))[:, None]
    own = torch.einsum("kwif,kwjf->kfij", alone, alone.conj())
    n_averages = spectra.n_averages
    matrix = torch.diag(start).expand(len(own[0]), m, m)
    for _ in range(ROUNDS):
        factor = torch.linalg.cholesky(matrix.to(torch.complex128))
        root = torch.linalg.inv(factor)
        white = root @ spectra.values @ root.mH
        power, vectors = torch.linalg.eigh(white)
        # the smallest eigenvalues belong to directions without motion, which hold noise alone
        left = root.mH @ vectors[:, :, : m - p]
        left_of_noise = _left_of_noise(power[:, m - p :], n_averages)
        target = torch.diag_embed(power[:, : m - p] / left_of_noise[:, None])
        densities = _densities(white, root @ responses.permute(2, 1, 0))
        leaked = torch.zeros_like(white) if leakage is None else leakage.matrix(densities)
        target = target - left.mH @ leaked @ left
        alone_densities = densities[: len(alone), :, None, None]
        sources = [units.expand(-1, len(own[0]), -1, -1), alone_densities * own]
        if forces is not None:
            sources.append(forces)
        patterns = torch.cat(sources)
        seen = left.mH @ patterns @ left
        sizes = seen.diagonal(dim1=-2, dim2=-1).real.mean(dim=(1, 2)).clamp(min=1e-300)
        columns = torch.view_as_real(seen / sizes[:, None, None, None]).flatten(1).T.numpy()
        # a sum of patterns of noise, each in a positive amount, comes closest to what was measured
        rows = torch.view_as_real(target).flatten().numpy()
        numbers = torch.as_tensor(nnls(columns, rows)[0]) / sizes
        # a sensor whose noise is negligible against that of the others would leave N singular
        noise = numbers[:m].maximum(LEAST_NOISE * start)
        shared = (numbers[m:, None, None, None] * patterns[m:]).sum(dim=0)
        matrix = torch.diag(noise) + shared + leaked
    shares, of_forces = numbers[m:].split([len(alone), len(patterns) - m - len(alone)])
    return TripNoise(noise, shares, of_forces, matrix)


def _left_of_noise(power: Tensor, n_averages: float) -> Tensor:
    """Return the fraction of the noise that the p largest eigenvalues leave, (n_freq,)."""
    above = (power - 1).clamp(min=1 / math.sqrt(n_averages))
    taken = ((1 + above) / above).sum(dim=1) / n_averages
    return 1 - taken.clamp(max=MOST_TAKEN)


def _densities(white: Tensor, responses: Tensor) -> Tensor:
    """Return the smoothed density of each input, (p, n_freq), of whitened matrices."""
    unit = torch.eye(white.shape[-1], dtype=white.dtype)
    inverse = torch.linalg.pinv(responses)
    densities = (inverse @ (white - unit) @ inverse.mH).diagonal(dim1=-2, dim2=-1).real
    half = SMOOTH_BINS // 2
    return avg_pool1d(
        densities.T.clamp(min=0)[None], SMOOTH_BINS, 1, half, count_include_pad=False
    )[0]
