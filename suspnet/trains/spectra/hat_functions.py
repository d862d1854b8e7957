"""Hat functions, whose sums interpolate between frequencies."""

import numpy as np
import torch
from torch import Tensor


def hat_functions(frequencies_hz: Tensor, spacing_hz: float) -> Tensor:
    """Return hat functions that sum to 1, (n_freq, n_knots), about `spacing_hz` apart.

    `frequencies_hz` (n_freq,) ascend; the first and the last knot are at their ends.
    """
    bins = frequencies_hz.numpy()
    low, high = bins[0], bins[-1]
    knots = np.linspace(low, high, max(2, round((high - low) / spacing_hz) + 1))
    columns = [np.interp(bins, knots, row) for row in np.eye(len(knots))]
    return torch.as_tensor(np.stack(columns, axis=1))
