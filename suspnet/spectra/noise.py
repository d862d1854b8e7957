"""The noise of section III-B: white over the frequency bins of each curve.

Its rms is the curve's own rms times 10^(-SNR/20), so 34 dB is the 2 % sensor precision of section
III-E, 26 dB 5 % and 54 dB 0.2 %.
"""

from __future__ import annotations

import torch
from torch import Tensor


def add_noise(magnitudes: Tensor, snr_db: float, seed: int) -> Tensor:
    """Return curves plus white Gaussian noise of rms = rms(curve) 10^(-SNR/20).

    Parameters
    ----------
    magnitudes : tensor of shape (..., n_freq), [-]
    snr_db : float, [dB]
    seed : int
        The same seed on the same kind of device gives the same noise.
    """
    source = torch.Generator(magnitudes.device).manual_seed(seed)
    noise = torch.empty_like(magnitudes).normal_(generator=source)
    return noise.mul_(noise_rms(magnitudes, snr_db)).add_(magnitudes)


def noise_rms(magnitudes: Tensor, snr_db: float) -> Tensor:
    """Return the rms of the noise of each curve, shape (..., 1)."""
    return magnitudes.square().mean(dim=-1, keepdim=True).sqrt() * 10 ** (-snr_db / 20)
