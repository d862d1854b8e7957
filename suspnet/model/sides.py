"""What a trip with sensors left and right says of the two sides of a suspension.

Estimates take both sides as equal: where one is clearly weaker, they are flagged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from suspnet.dynamics.motion import LinearSystem
from suspnet.features.side_difference import Bounce, SideDifference, side_difference
from suspnet.model.estimate import Estimate
from suspnet.model.speed_bin import SpeedBin
from suspnet.recordings.manifest import SIDES
from suspnet.recordings.recording import Recording
from suspnet.recordings.segments import difference_segments, in_band
from suspnet.types import ComplexArray, FloatArray
from suspnet.uncertainty.refine import complete_ratios

SPOKEN = ("primary spring", "primary damper", "secondary spring", "secondary damper")
"""Parts with a left and a right one, in the order of ``SIDE_PARAMETERS``."""
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
    largest = max(bins, key=lambda b: b.spectra.n_averages)
    words = spoken_sides(weaker_sides(largest, recording, estimate.values[0]))
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
    system = method.generator.on("cpu").motion_system(torch.as_tensor(ratios))
    frequencies_hz = segments.frequencies_hz.numpy()
    to_frame, to_body = speed_bin.spectra.responses("IV").numpy()
    return side_difference(
        frequencies_hz,
        values.numpy(),
        bounce_of(system, frequencies_hz, to_frame, to_body, speed_bin.speed_m_per_s),
        speed_bin.spectra.n_averages,
        segments.welch.correlated_bins,
    )


def bounce_of(
    system: LinearSystem,
    frequencies_hz: FloatArray,
    to_frame: ComplexArray,
    to_body: ComplexArray,
    speed_m_per_s: float,
) -> Bounce:
    """Return the numbers of a bogie side out of a vehicle's equations, with measured responses.

    Parameters
    ----------
    system : LinearSystem
        The frame's bounce is the first coordinate under the frame's sensor.
    frequencies_hz : array of shape (n_freq,), [Hz]
    to_frame, to_body : complex arrays of shape (n_freq,), [-]
        Measured G_p and G_s.
    speed_m_per_s : float, [m/s]
    """
    bounce = int(np.flatnonzero(system.sensors[0])[0])
    wheels, dampers = system.input_stiffness[bounce], system.input_damping[bounce]
    k_p, c_p = float(wheels.sum()), float(dampers.sum())
    late_s = np.array(system.behind_m) / speed_m_per_s
    phases = np.exp(-2j * np.pi * late_s[:, None] * frequencies_hz)
    return Bounce(
        k_p=k_p,
        c_p=c_p,
        k_s=float(system.stiffness[bounce, bounce]) - k_p,
        c_s=float(system.damping[bounce, bounce]) - c_p,
        bogie_mass=float(system.mass[bounce, bounce]),
        box=1 / to_frame,
        body=to_body,
        wheelsets=wheels @ phases / k_p,
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
