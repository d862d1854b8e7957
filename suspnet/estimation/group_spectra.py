"""The responses of the segments of a recording that are averaged, and how certain they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.signal import get_window
from torch import Tensor

from suspnet.spectra.cross_spectra import CrossSpectra
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.segments import without_incoherent, without_loud
from suspnet.spectra.welch import SegmentSpectra


@dataclass(frozen=True)
class GroupSpectra:
    """What is left of a group of segments, and how certain its responses are.

    Attributes
    ----------
    candidates : bool tensor of shape (n_segments,)
        The group without segments that are far too loud.
    chosen : bool tensor of shape (n_segments,)
        Also without those of low coherence.
    n_incoherent : int
        Number of these.
    n_averages : float
        Independent averages of the chosen segments.
    spectra : CrossSpectra or None
        Average over the chosen segments; None if there are none.
    coherences : list of 2 floats, [-]
    deviation : float, [-]
        As of `certainty_of`; NaN without spectra.
    """

    candidates: Tensor
    chosen: Tensor
    n_incoherent: int
    n_averages: float
    spectra: CrossSpectra | None
    coherences: list[float]
    deviation: float


def group_spectra(
    band: SegmentSpectra, group: Tensor, min_coherence: float, estimate: EstimateSettings
) -> GroupSpectra:
    """Return what can be used of a group of segments.

    Parameters
    ----------
    band : SegmentSpectra
        On the bins of an estimate, where loud and incoherent segments are left out.
    group : bool tensor of shape (n_segments,)
        Segments at one speed.
    min_coherence : float, [-]
        As of ``TripSettings``.
    estimate : EstimateSettings
        Bound to a vehicle.
    """
    candidates = without_loud(band, group)
    chosen, n_incoherent = without_incoherent(band, candidates, min_coherence)
    if not bool(chosen.any()):
        nothing: list[float] = [math.nan, math.nan]
        return GroupSpectra(candidates, chosen, n_incoherent, 0.0, None, nothing, math.nan)
    n_averages = band.welch.n_averages(int(chosen.sum()))
    spectra = band.average(chosen)
    certainty = certainty_of(spectra, estimate, band.frequencies_hz)
    return GroupSpectra(candidates, chosen, n_incoherent, n_averages, spectra, *certainty)


def certainty_of(
    spectra: CrossSpectra, settings: EstimateSettings, frequencies_hz: Tensor
) -> tuple[list[float], float]:
    """Return how certain the responses are on the bins that estimates use.

    Parameters
    ----------
    spectra : CrossSpectra
        Of shape (3, n_freq).
    settings : EstimateSettings
    frequencies_hz : tensor of shape (n_freq,), [Hz]

    Returns
    -------
    coherences : list of 2 floats, [-]
        Means over the bins, of G_p and G_s.
    deviation : float, [-]
        Standard deviation of the log-magnitudes: median over the bins, of the less certain one.
    """
    beyond = settings.beyond(frequencies_hz)
    coherences = spectra.coherences().masked_fill(beyond, math.nan).nanmean(dim=1)
    deviations = spectra.deviations(settings.method).masked_fill(beyond, math.nan)
    return coherences.tolist(), float(deviations.nanmedian(dim=1).values.amax())


def speed_of(speeds: Tensor, segments: SegmentSpectra) -> tuple[float, float]:
    """Return mean and deviation of the speeds in some segments, as the window weighs them."""
    weights = torch.as_tensor(get_window(segments.welch.window, speeds.shape[1])) ** 2
    weights = weights / (weights.sum() * len(speeds))
    mean = float((speeds * weights).sum())
    return mean, math.sqrt(max(0.0, float(((speeds - mean) ** 2 * weights).sum())))
