"""Flags of one trip: a constant delay between two channels, and sides that differ.

The delay is found from the phases of a response. With G_f the measured response in bin f, H_f the
model's response at the estimate, u_f the phase factor of G_f / H_f and s_f the standard deviation
of log |G_f|, the delay of the second channel is the tau that maximises the sum of
Re u_f exp(j omega_f tau) / s_f^2. Estimates depend on magnitudes more than on phases: a delay of
50 ms changes them by 5 % at most, and is found to 1 ms.

Estimates assume equal sides. A difference that sensors on both sides show widens their intervals;
they are flagged if it cannot be explained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.speeds import Speeds
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import trip_observer
from suspnet.estimation.refine import complete_ratios
from suspnet.ground.findings import Finding, together
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.spectra.segments import difference_segments, in_band
from suspnet.trains.spectra.side_difference import (
    SIDE_PARAMETERS,
    Bounce,
    SideDifference,
    side_difference,
)
from suspnet.trains.spectra.steady_parts import SpeedBin, largest
from suspnet.vehicle import ResponseGenerator

LONGEST_S, STEP_S = 0.25, 1e-3
"""Longest delay that is searched, and step of the search before Newton's method, [s]."""
NEWTON_STEPS = 3
REPORTED_S = 0.003
"""Smallest delay that is reported, [s], the same as for clock drift."""
EXPLAINED = 0.8
"""Smallest fraction of the model's unexplained residual that a reported delay must explain.

A delay of 5 ms and more explains 99 %. Physics that a model lacks looks like a delay of up to
9 ms but explains at most 66 % (trips of richer trains, tests/rich_trips.py).
"""
SPOKEN = ("primary spring", "primary damper", "secondary spring", "secondary damper")
"""Names of the parts with a left and a right side, in the order of ``SIDE_PARAMETERS``."""
STEP = 1e-4
"""Half the step of a central difference along the logarithm of a parameter."""
CERTAIN = 4.0
"""A difference is reported if it exceeds this multiple of its standard deviation: by chance, one of
the four parts does on one of 4,000 trips."""
UNEXPLAINED = "left and right differ, but which part and side is weaker is unknown"
LEAST = 0.1
"""Smallest relative deficit of the weaker side that is reported."""
SIDE_COSTS = {
    "k_p": (0.6, 0.0, 0.1, 0.1),
    "c_p": (1.0, 0.1, 0.4, 1.2),
    "k_s": (0.2, 0.02, 0.35, 0.3),
    "c_s": (0.35, 0.02, 0.5, 0.4),
    "M_s": (0.2, 0.0, 0.12, 0.1),
}
"""Standard deviation of the error of an estimate's logarithm per d^2 of each part.

From four trains of the tests with all effects of the family (tests/rich_train.py, seeds 0 to 3; 30
trips each with wear of the left side, 20 minutes, drawn as spectra), commissioned on 5 trips. Most
likely values are 0.4, 0.9, 0.3, 0.4 and 0.15 where an output's own part differs most; these are
1.4 times as large, as trains differ: fitted to three of the trains, intervals of the fourth held 61
to 100 %. With these, intervals of the 104 explained trips hold 93 to 98 % of each output (21 to 84
% without), at least 89 % on each train. Rank correlations of errors with these costs are 0.4 to 0.7
(seed 0), with the difference between estimates from the left and from the right sensors alone 0.1
to 0.5.
"""
LARGEST_MISFIT = 2.0
"""Above this misfit the equations do not explain how the sides differ, and no part is named."""


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


def with_sides(
    estimate: Estimate, bins: Sequence[SpeedBin], recording: Recording
) -> tuple[Estimate, str]:
    """Return a trip's estimate with the ``side_errors`` in its interval, and the difference.

    The largest speed bin decides. The difference, as text, is empty if it is not clear. The
    estimate is flagged if the equations do not explain how the sides differ.
    """
    found = weaker_sides(largest(bins), recording, estimate.values[0])
    if found is not None:
        estimate = estimate.widened(side_errors(found, estimate.names))
    words = spoken_sides(found)
    if words != UNEXPLAINED:
        return estimate, words
    text = Finding("both-sides-assumed-equal", words=words)
    return replace(estimate, flags=estimate.flags.with_kind("sides", text)), words


def side_errors(found: SideDifference, names: Sequence[str]) -> FloatArray:
    """Return the standard deviations of the errors of log estimates of unequal sides, (n_names,).

    Bounce makes a bogie with unequal sides roll, and roll changes its bounce: an effect of second
    order in the differences d_i of the four parts, whose deviations are s_i::

        e_j = sum_i c_ji max(d_i^2 - s_i^2, 0),    c_ji of ``SIDE_COSTS``.
    """
    clear = np.maximum(found.d**2 - found.deviations**2, 0.0)
    return np.asarray(np.array([SIDE_COSTS[name] for name in names]) @ clear)


def weaker_sides(
    speed_bin: SpeedBin, recording: Recording, estimates: FloatArray
) -> SideDifference | None:
    """Return how left and right differ in a trip; None unless all three channels are pairs.

    `estimates` (n_outputs,) are those of the trip, for the method's outputs.
    """
    if not all(recording.paired):
        return None
    method, segments = speed_bin.method, speed_bin.segments
    chosen = speed_bin.chosen
    differences = in_band(difference_segments(recording, segments.welch), segments.frequencies_hz)
    values = torch.cat([segments.values[chosen, 1:2], differences.values[chosen]], dim=1)
    ratios = complete_ratios(method.task, estimates[None])[0]
    used = slice(None) if speed_bin.left_out is None else ~speed_bin.left_out
    frequencies_hz = segments.frequencies_hz[used].numpy()
    to_frame, to_body = speed_bin.spectra.responses("IV")[:, used].numpy()
    generator, speed = method.generator.on("cpu"), speed_bin.speed_m_per_s
    return side_difference(
        frequencies_hz,
        values[..., used].numpy(),
        bounce_of(generator, ratios, frequencies_hz, to_frame, to_body, speed),
        speed_bin.spectra.n_averages,
        segments.welch.correlated_bins,
    )


def bounce_of(
    generator: ResponseGenerator,
    ratios: FloatArray,
    frequencies_hz: FloatArray,
    to_frame: ComplexArray,
    to_body: ComplexArray,
    speed_m_per_s: float,
) -> Bounce:
    """Return the parameters of one side of a vehicle's bogie, with measured responses.

    `ratios`: (5,); `to_frame`, `to_body`: measured G_p and G_s, (n_freq,).
    """
    one = torch.as_tensor(ratios, dtype=torch.float64)
    system = generator.motion_system(one)
    bounce = int(np.flatnonzero(system.sensors[0])[0])  # the first coordinate under the sensor
    wheels = system.input_stiffness[bounce] / system.input_stiffness[bounce].sum()
    late_s = np.array(system.behind_m) / speed_m_per_s
    # central differences along the logarithms of k_p, c_p, k_s and c_s
    steps = torch.eye(5, dtype=torch.float64)[: len(SIDE_PARAMETERS)] * STEP
    rows = one * torch.cat([torch.zeros_like(one)[None], steps, -steps]).exp()
    kappas = generator.dynamic_stiffness(rows, torch.as_tensor(frequencies_hz)).numpy()
    own = [0, 0, 1, 1]  # kappa_p or kappa_s
    above, below = (kappas[part][range(4), own] for part in (slice(1, 5), slice(5, 9)))
    return Bounce(
        k_p=float(kappas[0, 0].real.mean()),
        k_s=float(kappas[0, 1].real.mean()),
        bogie_mass=float(system.mass[bounce, bounce]),
        kappas=kappas[0],
        slopes=(above - below) / (2 * STEP),
        box=1 / to_frame,
        body=to_body,
        wheelsets=wheels @ np.exp(-2j * np.pi * late_s[:, None] * frequencies_hz),
    )


def spoken_sides(found: SideDifference | None) -> str:
    """Return which side of which part is weaker, and by how much; empty if not clear."""
    if found is None:
        return ""
    if found.misfit > LARGEST_MISFIT:
        return UNEXPLAINED
    clear = np.abs(found.d) >= CERTAIN * found.deviations
    named = clear & (found.weaker_by >= LEAST)
    return together(
        Finding(
            "left-weaker" if found.d[i] < 0 else "right-weaker",
            part=SPOKEN[i],
            percent=100 * found.weaker_by[i],
        )
        for i in np.flatnonzero(named)
    )
