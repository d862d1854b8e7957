"""A delay between two channels that is the same all along, by the phases of their response.

With G_f what a trip shows in bin f, H_f what the model gives at the estimate, u_f the phase factor
of G_f / H_f and s_f the standard deviation of log |G_f|, the second channel comes later by the tau
that makes the sum of Re u_f exp(j omega_f tau) / s_f^2 largest. Estimates rest on magnitudes more
than on phases: a delay of 50 ms moves them by 5 % at most, and is found to 1 ms.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import trip_observer
from suspnet.estimation.refine import complete_ratios
from suspnet.recordings.manifest import CHANNELS
from suspnet.spectra.cross_spectra import CrossSpectra
from suspnet.spectra.speeds import Speeds

LONGEST_S, STEP_S = 0.25, 1e-3
"""Longest delay that is looked for, and step of the search before Newton's method, [s]."""
NEWTON_STEPS = 3
TOLD_S = 0.003
"""Delay from which on it is told, [s], as that of clocks that run apart."""
EXPLAINED = 0.8
"""Least share of what the model leaves unexplained that a delay must explain to be told.

A delay of 5 ms and more explains 99 %, the physics that a model lacks looks like a delay of up to
9 ms but explains at most 66 % (trips of richer trains, tests/rich_trips.py)."""


def delay_words(
    method: FittedMethod, spectra: CrossSpectra, estimate: Estimate, speeds: Speeds
) -> str:
    """Return which channels are late against the one before, and by how much; empty if none is.

    Parameters
    ----------
    method : FittedMethod
        Trained on estimates from trips.
    spectra : CrossSpectra
        Of a trip on the method's bins, (3, n_freq).
    estimate : Estimate
        Of one row, from the spectra.
    speeds : Speeds
    """
    observer = trip_observer(method).at(speeds)
    ratios = torch.as_tensor(complete_ratios(method.task, estimate.values))
    expected = observer.expected(ratios)
    fitted = CrossSpectra(expected.auto[0], expected.cross[0], expected.n_averages)
    kind = observer.settings.method
    deviations = spectra.deviations(kind).masked_fill(
        observer.settings.beyond(observer.frequencies_hz), math.inf
    )
    delays_s, shares = find_delays(
        spectra.responses(kind), fitted.responses(kind), deviations, observer.frequencies_hz
    )
    told = []
    for i, (delay_s, share) in enumerate(zip(delays_s.tolist(), shares.tolist(), strict=True)):
        if abs(delay_s) >= TOLD_S and share >= EXPLAINED:
            late = "late" if delay_s > 0 else "early"
            told.append(
                f"{CHANNELS[i + 1]} looks {1e3 * abs(delay_s):.3g} ms {late} against {CHANNELS[i]} "
                "all along: do they share one clock, is `start_s` right?"
            )
    return "; ".join(told)


def find_delays(
    observed: Tensor, fitted: Tensor, deviations: Tensor, frequencies_hz: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the delay of each response against the fitted one, and what it explains.

    Parameters
    ----------
    observed, fitted : complex tensors of shape (n_links, n_freq), [-]
    deviations : tensor of shape (n_links, n_freq), [-]
        Of the observed log-magnitudes; infinite where a bin is not to be used.
    frequencies_hz : tensor of shape (n_freq,), [Hz]

    Returns
    -------
    delays : tensor of shape (n_links,), [s]
    shares : tensor of shape (n_links,), [-]
        Of the squares of what is unexplained, in log-magnitude and phase factor.
    """
    omega = 2 * math.pi * frequencies_hz
    ratio = observed / fitted
    weights = torch.where(torch.isfinite(ratio.abs().log()), 1 / deviations**2, 0.0)
    weights = torch.nan_to_num(weights, nan=0.0, posinf=0.0)
    turned = torch.sgn(torch.where(weights > 0, ratio, 0.0))
    tried = torch.arange(-LONGEST_S, LONGEST_S, STEP_S, dtype=torch.float64)
    match = torch.einsum("lf,fd->ld", weights * turned, torch.exp(1j * torch.outer(omega, tried)))
    delays = tried[match.real.argmax(dim=1)]
    for _ in range(NEWTON_STEPS):
        at_peak = weights * turned * torch.exp(1j * delays[:, None] * omega)
        slope, bend = -(at_peak.imag @ omega), at_peak.real @ omega**2
        step = torch.where(bend > 0, slope / bend, 0.0)
        delays = delays + step.clamp(-STEP_S, STEP_S)
    logs = torch.where(weights > 0, ratio.abs().log() ** 2, 0.0)
    straight = turned * torch.exp(1j * delays[:, None] * omega)
    before, after = (
        (weights * (logs + (1 - phases).abs() ** 2)).sum(dim=1) for phases in (turned, straight)
    )
    return delays, torch.where(before > 0, 1 - after / before, 0.0)
