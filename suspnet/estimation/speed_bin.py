"""Estimates from parts of one trip, each at a speed of its own, and what they say together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.fitted import FittedMethod
from suspnet.ground.types import FloatArray
from suspnet.spectra.cross_spectra import CrossSpectra
from suspnet.spectra.welch import SegmentSpectra


@dataclass(frozen=True)
class SpeedBin:
    """One method's estimate from a recording, with the spectra and segments behind it.

    Attributes
    ----------
    method : FittedMethod
    spectra : CrossSpectra
        Average over the chosen segments on the method's bins, (3, n_freq).
    segments : SegmentSpectra
    chosen : bool tensor of shape (n_segments,)
    speed_m_per_s : float, [m/s]
        Mean over the chosen segments.
    estimate : Estimate
        Of one row.
    noise_share : array of shape (n_outputs,), [-]
        Share of the noise of the segments in the square of the intervals.
    doubts : str
        What could not be checked of the channels; empty if all could.
    """

    method: FittedMethod
    spectra: CrossSpectra
    segments: SegmentSpectra
    chosen: Tensor
    speed_m_per_s: float
    estimate: Estimate
    noise_share: FloatArray
    doubts: str


def largest(bins: Sequence[SpeedBin]) -> SpeedBin:
    """Return the group of segments with the most averages."""
    return max(bins, key=lambda b: b.spectra.n_averages)


def combined(bins: Sequence[SpeedBin]) -> Estimate:
    """Return one estimate from several groups of segments: means of the logarithms.

    Weights are the inverse squares of the half widths, or the averages where there are none. The
    noise of groups is independent, as they share no segment; the rest of their errors is taken to
    be one and the same, for models may err alike.
    """
    if len(bins) == 1:
        return bins[0].estimate
    half = np.concatenate([b.estimate.half_widths for b in bins])  # (n_bins, n_outputs)
    weights = np.ones_like(half) * np.array([[b.spectra.n_averages] for b in bins])
    if (np.isfinite(half) & (half > 0)).all():
        weights = 1 / half**2
    weights = weights / weights.sum(axis=0)
    share = np.stack([b.noise_share for b in bins])
    noise = np.sum(weights**2 * share * half**2, axis=0)
    lasting = np.sum(weights * np.sqrt(1 - share) * half, axis=0) ** 2
    values = np.exp(np.sum(weights * np.log([b.estimate.values[0] for b in bins]), axis=0))
    ends = [values * np.exp(sign * np.sqrt(noise + lasting)) for sign in (-1, 1)]
    first = bins[0].estimate
    rows = values[None], ends[0][None], ends[1][None]
    return Estimate(first.names, *rows, first.level, _flags(bins), first.healthy)


def _flags(bins: Sequence[SpeedBin]) -> Flags:
    """Return the flags of a trip's estimate: of several bins, those of the best one flagged.

    Each bin puts the same into other numbers.
    """
    found = [b for b in bins if b.estimate.flags.flagged.any()]
    if not found:
        return Flags.none(1)
    worst = largest(found)
    at = f"in {len(found)} of {len(bins)} speed bins, at {worst.speed_m_per_s:.1f} m/s"
    return Flags(worst.estimate.flags.found, (f"{at}: {worst.estimate.flags.reasons[0]}",))
