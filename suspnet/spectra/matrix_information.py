"""Fisher information of the spectral matrix of sensors, the spectra of the inputs unknown.

With H the responses of the sensors, D the spectral matrix of the inputs and N the sensors' noise,
the spectral matrix is S = H D H^* + N. The information of n averages about numbers theta is that of
Slepian and Bangs::

    I_jk = sum over the bins of n tr(W_j W_k),    W_j = L^-1 (dS / d theta_j) L^-*,    S = L L^*

D is unknown in every bin: W_j is projected off the W of D's own numbers. For D of any coherence
this is J^T J of the residuals of `suspnet.spectra.subspace` at the exact S, so that subspace
fitting reaches it. N is known here: its estimate from all bins costs little.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.types import FloatArray


def spectral_information(
    responses: Tensor,
    changes: Tensor,
    density: Tensor,
    noise: Tensor,
    n_coherent: int,
    alone: Sequence[Sequence[int]] = (),
) -> FloatArray:
    """Return the Fisher information of one average, (n_directions, n_directions).

    Parameters
    ----------
    responses, changes : Tensor of shape (p, m, n_freq), (n_directions, p, m, n_freq)
        H and its derivatives, complex.
    density : Tensor of shape (n_freq,), [(m/s^2)^2/Hz]
        True density of each input, which are independent of each other.
    noise : Tensor of shape (m,), [(m/s^2)^2/Hz]
    n_coherent : int
        Number of first inputs whose spectral matrix may be anything.
    alone : sequence of sequences of int
        Further inputs; those of each sequence are independent, and of one unknown density.
    """
    a = responses.permute(2, 1, 0)
    s = density[:, None, None] * (a @ a.mH) + torch.diag(noise).to(a.dtype)
    root = torch.linalg.cholesky(s)
    a = torch.linalg.solve_triangular(root, a, upper=False)
    n_freq, m, p = a.shape
    moved = changes.permute(3, 2, 0, 1).reshape(n_freq, m, -1)
    moved = torch.linalg.solve_triangular(root, moved, upper=False)
    moved = moved.reshape(n_freq, m, -1, p).transpose(1, 2)  # (n_freq, n_directions, m, p)
    half = density[:, None, None, None] * (moved @ a.mH[:, None])
    own = [a[:, :, list(one)] @ a[:, :, list(one)].mH for one in alone]
    w = torch.cat([half + half.mH, *(one[:, None] for one in own)], dim=1)
    if n_coherent:
        basis = torch.linalg.qr(a[:, :, :n_coherent])[0]
        projector = (basis @ basis.mH)[:, None]
        w = w - projector @ w @ projector
    rows = torch.view_as_real(w).flatten(2)
    n = len(changes)
    rows, nuisances = rows[:, :n], rows[:, n:]
    inverse = torch.linalg.pinv(nuisances @ nuisances.mT, hermitian=True)
    shared = rows @ nuisances.mT
    found = rows @ rows.mT - shared @ inverse @ shared.mT
    return np.asarray(found.sum(dim=0).numpy())
