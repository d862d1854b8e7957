"""The hyperspherical epsilon-insensitive loss of MSVR (Eq. 8), its derivative and IRWLS weight.

u >= 0 is the norm of a sample's residual over all outputs.
"""

from __future__ import annotations

import torch
from torch import Tensor


def loss(u: Tensor, epsilon: float) -> Tensor:
    """Return L(u) = 0 below epsilon and (u - epsilon)^2 above, Eq. (8); same shape as `u`."""
    return (u - epsilon).clamp(min=0).square()


def derivative(u: Tensor, epsilon: float) -> Tensor:
    """Return L'(u) = 2 (u - epsilon) above epsilon, 0 below; same shape as `u`."""
    return 2 * (u - epsilon).clamp(min=0)


def weight(u: Tensor, epsilon: float) -> Tensor:
    """Return a(u) = L'(u) / u, so a_i of Eq. (10) is C a(u_i); 0 inside the tube and at u = 0.

    For epsilon = 0 the weight is 2 everywhere, also at u = 0 (its limit).
    """
    if epsilon == 0:
        return torch.full_like(u, 2.0)
    outside = u > epsilon
    return torch.where(outside, derivative(u, epsilon) / torch.where(outside, u, 1.0), 0.0)
