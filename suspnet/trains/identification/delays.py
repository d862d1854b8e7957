"""A constant delay between two channels of a trip.

It is found from the phases of a response. With G_f the measured response in bin f, H_f the
model's response at the estimate, u_f the phase factor of G_f / H_f and s_f the standard deviation
of log |G_f|, the delay of the second channel is the tau that maximises the sum of
Re u_f exp(j omega_f tau) / s_f^2. Estimates depend on magnitudes more than on phases: a delay of
50 ms changes them by 5 % at most, and is found to 1 ms.
"""

import math

import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.speeds import Speeds
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import trip_observer
from suspnet.estimation.refine import complete_ratios
from suspnet.ground.findings import Finding, together
from suspnet.trains.recordings.manifest import CHANNELS

LONGEST_S, STEP_S = 0.25, 1e-3
"""Longest delay that is searched, and step of the search before Newton's method, [s]."""
NEWTON_STEPS = 3
REPORTED_S = 0.003
"""Smallest delay that is reported, [s], the same as for clock drift."""
EXPLAINED = 0.8
"""Smallest fraction of the model's unexplained residual that a reported delay must explain.

A real delay explains almost all of it; physics that a model lacks may look like a delay, but
explains far less (docs/methods.md).
"""


def delay_words(
    method: FittedMethod,
    spectra: CrossSpectra,
    estimate: Estimate,
    speeds: Speeds,
    left_out: Tensor | None = None,
) -> str:
    """Return which channels are delayed against the previous one, as text; empty if none is.

    `spectra` (3, n_freq) are those of a trip on the method's bins; `estimate` has one row;
    bins `left_out` (n_freq,) are not used.
    """
    observer = trip_observer(method).at(speeds)
    ratios = torch.as_tensor(complete_ratios(method.task, estimate.values))
    expected = observer.expected(ratios)
    fitted = CrossSpectra(expected.auto[0], expected.cross[0], expected.n_averages)
    kind = observer.settings.method
    deviations = spectra.deviations(kind).masked_fill(
        observer.settings.beyond(observer.frequencies_hz), math.inf
    )
    if left_out is not None:
        deviations = deviations.masked_fill(left_out, math.inf)
    delays_s, shares = find_delays(
        spectra.responses(kind), fitted.responses(kind), deviations, observer.frequencies_hz
    )
    late_channels = []
    for i, (delay_s, share) in enumerate(zip(delays_s.tolist(), shares.tolist(), strict=True)):
        if abs(delay_s) >= REPORTED_S and share >= EXPLAINED:
            late, ms = "late" if delay_s > 0 else "early", 1e3 * abs(delay_s)
            late_channels.append(Finding(late, name=CHANNELS[i + 1], ms=ms, partner=CHANNELS[i]))
    return together(late_channels)


def find_delays(
    observed: Tensor, fitted: Tensor, deviations: Tensor, frequencies_hz: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the delay of each response relative to the fitted one, and what it explains.

    Responses and deviations of log-magnitudes (infinite where a bin is not used): (n_links,
    n_freq). Delays [s] are positive if the output is late. The second result is the explained
    fraction of the squared residual in log-magnitude and phase factor.
    """
    # bins that are unused or have no finite ratio get the weight 0
    omega = 2 * math.pi * frequencies_hz
    ratio = observed / fitted
    weights = torch.where(torch.isfinite(ratio.abs().log()), 1 / deviations**2, 0.0)
    weights = torch.nan_to_num(weights, nan=0.0, posinf=0.0)
    turned = torch.sgn(torch.where(weights > 0, ratio, 0.0))
    # the objective has many maxima: search a grid first, then refine by Newton's method
    tried = torch.arange(-LONGEST_S, LONGEST_S, STEP_S, dtype=torch.float64)
    match = torch.einsum("lf,fd->ld", weights * turned, torch.exp(1j * torch.outer(omega, tried)))
    delays = tried[match.real.argmax(dim=1)]
    for _ in range(NEWTON_STEPS):
        at_peak = weights * turned * torch.exp(1j * delays[:, None] * omega)
        slope, bend = -(at_peak.imag @ omega), at_peak.real @ omega**2
        step = torch.where(bend > 0, slope / bend, 0.0)
        delays = delays + step.clamp(-STEP_S, STEP_S)
    # squared residuals before and after removing the delay
    logs = torch.where(weights > 0, ratio.abs().log() ** 2, 0.0)
    straight = turned * torch.exp(1j * delays[:, None] * omega)
    before, after = (
        (weights * (logs + (1 - phases).abs() ** 2)).sum(dim=1) for phases in (turned, straight)
    )
    return delays, torch.where(before > 0, 1 - after / before, 0.0)
