"""Flags of one trip: a constant delay between two channels, and sides that differ.

The delay is found by the phases of their response. With G_f what a trip shows in bin f, H_f what
the model gives at the estimate, u_f the phase factor of G_f / H_f and s_f the standard deviation of
log |G_f|, the second channel comes later by the tau that makes the sum of
Re u_f exp(j omega_f tau) / s_f^2 largest. Estimates rest on magnitudes more than on phases: a delay
of 50 ms moves them by 5 % at most, and is found to 1 ms.

Estimates take left and right as equal: where sensors on both sides show that one is clearly weaker,
they are flagged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from suspnet.dynamics import ResponseGenerator
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.from_spectra import trip_observer
from suspnet.estimation.refine import complete_ratios
from suspnet.estimation.steady_parts import SpeedBin, largest
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.recordings.manifest import CHANNELS, SIDES
from suspnet.recordings.recording import Recording
from suspnet.spectra.cross_spectra import CrossSpectra
from suspnet.spectra.segments import difference_segments, in_band
from suspnet.spectra.side_difference import SIDE_PARAMETERS, Bounce, SideDifference, side_difference
from suspnet.spectra.speeds import Speeds

LONGEST_S, STEP_S = 0.25, 1e-3
"""Longest delay that is looked for, and step of the search before Newton's method, [s]."""
NEWTON_STEPS = 3
REPORTED_S = 0.003
"""Least delay that is reported, [s], as that of clocks that drift."""
EXPLAINED = 0.8
"""Least share of what the model leaves unexplained that a delay must explain to be reported.

A delay of 5 ms and more explains 99 %, the physics that a model lacks looks like a delay of up to
9 ms but explains at most 66 % (trips of richer trains, tests/rich_trips.py)."""
SPOKEN = ("primary spring", "primary damper", "secondary spring", "secondary damper")
"""Parts with a left and a right one, in the order of ``SIDE_PARAMETERS``."""
STEP = 1e-4
"""Half the step of a central difference along the logarithm of a parameter."""
CERTAIN = 4.0
"""A difference is named if it exceeds this multiple of its standard deviation: of four parts, by
chance on one of 4,000 trips."""
UNEXPLAINED = "left and right differ, but which part and side is weaker is unknown"
LEAST = 0.1
"""A difference is named if the weaker side has at least this share less than the other one."""
LARGEST_MISFIT = 2.0
"""Above this misfit the sides differ in a way that the equations do not explain, so that no part is
named."""


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
    late_channels = []
    for i, (delay_s, share) in enumerate(zip(delays_s.tolist(), shares.tolist(), strict=True)):
        if abs(delay_s) >= REPORTED_S and share >= EXPLAINED:
            late = "late" if delay_s > 0 else "early"
            late_channels.append(
                f"{CHANNELS[i + 1]} looks {1e3 * abs(delay_s):.3g} ms {late} relative to {CHANNELS[i]} "
                "throughout: do they share one clock, is `start_s` right?"
            )
    return "; ".join(late_channels)


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


def with_sides(
    estimate: Estimate, bins: Sequence[SpeedBin], recording: Recording
) -> tuple[Estimate, str]:
    """Return a trip's estimate, flagged where its sides differ, and how they differ as text.

    The largest speed bin decides. The text is empty where no difference is clear.

    Parameters
    ----------
    estimate : Estimate
        Of one row, from `bins`.
    """
    words = spoken_sides(weaker_sides(largest(bins), recording, estimate.values[0]))
    if not words:
        return estimate, ""
    text = f"both sides are taken as equal, but {words}"
    return replace(estimate, flags=estimate.flags.with_kind("sides", text)), words


def weaker_sides(
    speed_bin: SpeedBin, recording: Recording, estimates: FloatArray
) -> SideDifference | None:
    """Return how left and right differ in a trip; None unless all three channels are pairs.

    Parameters
    ----------
    estimates : array of shape (n_outputs,), [-]
        The trip's, of the method's outputs.
    """
    if not all(recording.paired):
        return None
    method, segments = speed_bin.method, speed_bin.segments
    chosen = speed_bin.chosen
    differences = in_band(difference_segments(recording, segments.welch), segments.frequencies_hz)
    values = torch.cat([segments.values[chosen, 1:2], differences.values[chosen]], dim=1)
    ratios = complete_ratios(method.task, estimates[None])[0]
    frequencies_hz = segments.frequencies_hz.numpy()
    to_frame, to_body = speed_bin.spectra.responses("IV").numpy()
    generator, speed = method.generator.on("cpu"), speed_bin.speed_m_per_s
    return side_difference(
        frequencies_hz,
        values.numpy(),
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
    """Return the numbers of a bogie side of a vehicle, with measured responses.

    Parameters
    ----------
    ratios : array of shape (5,), [-]
    frequencies_hz : array of shape (n_freq,), [Hz]
    to_frame, to_body : complex arrays of shape (n_freq,), [-]
        Measured G_p and G_s.
    speed_m_per_s : float, [m/s]
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
    """Return which side of which part is weaker, by how much; empty if no difference is clear."""
    if found is None:
        return ""
    if found.misfit > LARGEST_MISFIT:
        return UNEXPLAINED
    clear = np.abs(found.d) >= CERTAIN * found.deviations
    named = clear & (found.weaker_by >= LEAST)
    return "; ".join(
        f"{SPOKEN[i]}: the {SIDES[0] if found.d[i] < 0 else SIDES[1]} side is weaker "
        f"(about {100 * found.weaker_by[i]:.0f} %)"
        for i in np.flatnonzero(named)
    )
