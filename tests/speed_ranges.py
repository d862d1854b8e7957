"""Ranges of speeds of several models that together read a wider one."""

import math
from itertools import pairwise

from suspnet.curves.speeds import SpeedRange


def speed_ranges(low, high, half_width):
    """Return the fewest bins, equal in logarithm, each with its middle and relative half width."""
    widest = math.log((1 + half_width) / (1 - half_width))
    n_bins = math.ceil(math.log(high / low) / widest - 1e-9)
    edges = [low * (high / low) ** (i / n_bins) for i in range(n_bins)] + [high]
    return [
        (SpeedRange(*pair), sum(pair) / 2, (pair[1] - pair[0]) / sum(pair))
        for pair in pairwise(edges)
    ]
