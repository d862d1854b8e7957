"""What a trip with sensors left and right says of the two sides of a suspension.

Estimates take both sides as equal: where one is clearly weaker, they are flagged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from suspnet.dynamics import ResponseGenerator
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.refine import complete_ratios
from suspnet.estimation.steady_parts import SpeedBin, largest
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.recordings.manifest import SIDES
from suspnet.recordings.recording import Recording
from suspnet.spectra.segments import difference_segments, in_band
from suspnet.spectra.side_difference import SIDE_PARAMETERS, Bounce, SideDifference, side_difference

SPOKEN = ("primary spring", "primary damper", "secondary spring", "secondary damper")
"""Parts with a left and a right one, in the order of ``SIDE_PARAMETERS``."""
STEP = 1e-4
"""Half the step of a central difference along the logarithm of a parameter."""
CERTAIN = 4.0
"""A difference is named if it exceeds this multiple of its standard deviation: of four parts, by
chance on one of 4,000 trips."""
UNEXPLAINED = "left and right differ, but which part and side is weaker cannot be told"
LEAST = 0.1
"""A difference is named if the weaker side has at least this share less than the other one."""
LARGEST_MISFIT = 2.0
"""Above this misfit the sides differ in a way that the equations do not explain, so that no part is
named."""


def with_sides(
    estimate: Estimate, bins: Sequence[SpeedBin], recording: Recording
) -> tuple[Estimate, str]:
    """Return a trip's estimate, flagged where its sides differ, and how they differ in words.

    The largest speed bin tells. The words are empty where nothing stands out.

    Parameters
    ----------
    estimate : Estimate
        Of one row, from `bins`.
    bins : sequence of SpeedBin
    recording : Recording
    """
    words = spoken_sides(weaker_sides(largest(bins), recording, estimate.values[0]))
    if not words:
        return estimate, ""
    told = f"both sides are taken as equal, but {words}"
    return replace(estimate, flags=estimate.flags.with_kind("sides", told)), words


def weaker_sides(
    speed_bin: SpeedBin, recording: Recording, estimates: FloatArray
) -> SideDifference | None:
    """Return how left and right differ in a trip; None unless all three channels are pairs.

    Parameters
    ----------
    speed_bin : SpeedBin
    recording : Recording
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
    generator : ResponseGenerator
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
    """Return which side of which part is weaker, by how much; empty if nothing stands out."""
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
