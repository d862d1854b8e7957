"""A parabola fitted to each curve of a batch within a soft window of its own."""

from __future__ import annotations

import math

import torch
from torch import Tensor

EDGE = 3.5
"""Distance in half widths at which a window ends; its weight is exp(-EDGE^4 / 2) = 3e-33 there."""


def windowed_parabola(
    frequencies_hz: Tensor,
    target: Tensor,
    weight: Tensor,
    centre: Tensor,
    below: Tensor,
    above: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit target = constant + curvature (u - vertex)^2, u = f / centre - 1, curve by curve.

    Weighted least squares, the weight of a bin being `weight` times the window
    exp(-(log(f / centre) / half width)^4 / 2).

    Parameters
    ----------
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    target, weight : tensors of shape (n_curves, n_freq)
    centre : tensor of shape (n_curves,), [Hz]
    below, above : tensors of shape (n_curves,)
        Half widths of the window on either side, in log-frequency.

    Returns
    -------
    constant, vertex, curvature : tensors of shape (n_curves,)
        NaN where the bins do not determine them.
    """
    bins = _bins_within(frequencies_hz, centre, below, above)
    near = frequencies_hz[bins]
    windowed = _window(near, centre, below, above) * weight[:, bins]
    u = (near - centre[:, None]).mul_(1 / centre[:, None])
    right = _moments(windowed * target[:, bins], u, 3)
    normal = _moments(windowed, u, 5).unfold(1, 3, 1)  # (n_curves, 3, 3): row i, column j is i + j
    solution, info = torch.linalg.solve_ex(normal, right[:, :, None])
    c0, c1, c2 = solution[:, :, 0].unbind(1)
    c2 = torch.where(info == 0, c2, math.nan)
    vertex = -c1 / (2 * c2)
    return c0 - c1 * c1 / (4 * c2), vertex, c2


def _moments(weight: Tensor, u: Tensor, n_moments: int) -> Tensor:
    """Return the sums of weight u^k over the bins, k < n_moments; `weight` is used up."""
    sums = [weight.sum(dim=1)] + [weight.mul_(u).sum(dim=1) for _ in range(n_moments - 1)]
    return torch.stack(sums, dim=1)


def _bins_within(frequencies_hz: Tensor, centre: Tensor, below: Tensor, above: Tensor) -> slice:
    """Return the bins that lie within the window of at least one curve."""
    if len(centre) == 0:
        return slice(0)
    lowest, highest = centre * (-EDGE * below).exp(), centre * (EDGE * above).exp()
    ends = torch.stack([lowest.amin(), highest.amax()]).to(frequencies_hz)
    return slice(*torch.searchsorted(frequencies_hz, ends).tolist())


def _window(frequencies_hz: Tensor, centre: Tensor, below: Tensor, above: Tensor) -> Tensor:
    """Return exp(-distance^4 / 2), the distance in half widths and never more than EDGE.

    Beyond EDGE torch's exp would underflow, where it is several times slower.
    """
    distance = frequencies_hz.log() - centre.log()[:, None]
    ahead, behind = distance * (1 / above[:, None]), distance.mul_(-1 / below[:, None])
    distance = torch.maximum(ahead, behind, out=ahead).clamp_(max=EDGE)
    return distance.square_().square_().mul_(-0.5).exp_()
