"""What a trip with sensors left and right says of the two sides of a suspension, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from suspnet.dynamics import PARAMETERS, ResponseGenerator
from suspnet.features.side_difference import (
    SIDE_PARAMETERS,
    Bounce,
    SideDifference,
    side_difference,
)
from suspnet.model.from_recording import SpeedBin
from suspnet.recordings.manifest import SIDES
from suspnet.recordings.recording import Recording
from suspnet.recordings.segments import difference_segments, in_band
from suspnet.trips.limits import N_LAST
from suspnet.trips.records import OK, TripResult
from suspnet.types import FloatArray
from suspnet.uncertainty.refine import complete_ratios

SPOKEN = ("primary spring", "primary damper", "secondary spring", "secondary damper")
"""Parts with a left and a right one, in the order of ``SIDE_PARAMETERS``."""
CERTAIN = 4.0
"""A difference is named if it exceeds this multiple of its standard deviation: of four parts, by
chance on one of 4,000 trips."""
LEAST = 0.1
"""A difference is named if the weaker side has at least this share less than the other one."""
LARGEST_MISFIT = 3.0
"""Above this misfit the parts are not told apart well, and only the clearest one is named."""


def weaker_sides(
    speed_bin: SpeedBin, recording: Recording, estimates: Sequence[float]
) -> SideDifference | None:
    """Return how left and right differ in a trip; None unless all three channels are pairs.

    Parameters
    ----------
    speed_bin : SpeedBin
    recording : Recording
    estimates : sequence of float, [-]
        The trip's estimates of the method's outputs.
    """
    if not all(recording.paired):
        return None
    method, segments = speed_bin.method, speed_bin.segments
    chosen = speed_bin.chosen
    differences = in_band(difference_segments(recording, segments.welch), segments.frequencies_hz)
    values = torch.cat([segments.values[chosen, 1:2], differences.values[chosen]], dim=1)
    ratios = complete_ratios(method.task, np.asarray([estimates], dtype=float))[0]
    return side_difference(
        segments.frequencies_hz.numpy(),
        values.numpy(),
        bounce_of(method.generator, segments.frequencies_hz.numpy(), ratios),
        speed_bin.spectra.n_averages,
        segments.welch.correlated_bins,
    )


def bounce_of(
    generator: ResponseGenerator, frequencies_hz: FloatArray, ratios: FloatArray
) -> Bounce:
    """Return a vehicle's bounce as its generator has it, at some ratios of ``PARAMETERS``, (5,)."""
    rows, bins = (torch.as_tensor(x, dtype=torch.float64) for x in (ratios[None], frequencies_hz))
    on_cpu = generator.on("cpu")
    frame, to_body = (
        np.asarray(part[0], dtype=np.complex128) for part in on_cpu.responses(rows, bins)
    )
    further = dict(
        zip(on_cpu.further_places, on_cpu.further_responses(rows, bins)[0].numpy(), strict=True)
    )
    healthy = dict(zip(PARAMETERS, generator.vehicle.healthy_values(), strict=True))
    values = {name: healthy[name] * ratios[PARAMETERS.index(name)] for name in SIDE_PARAMETERS}
    return Bounce(
        **values,
        bogie_mass=generator.vehicle.bogie_mass_kg,
        box=1 / frame,
        centre=further.get("frame centre", frame) / frame,
        body=to_body,
        wheelsets=(1 + further.get("second axle box", np.ones_like(frame))) / 2,
    )


def spoken_sides(found: SideDifference | None) -> str:
    """Return which side of which part is weaker, by how much; empty if nothing stands out."""
    if found is None:
        return ""
    clear = np.abs(found.d) / found.deviations
    named = (clear >= CERTAIN) & (found.weaker_by >= LEAST)
    if found.misfit > LARGEST_MISFIT:
        named &= clear == clear[named].max(initial=0.0)
    return "; ".join(
        f"{SPOKEN[i]}: the {SIDES[0] if found.d[i] < 0 else SIDES[1]} side is weaker "
        f"(about {100 * found.weaker_by[i]:.0f} %)"
        for i in np.flatnonzero(named)
    )


def sides_finding(trips: Sequence[TripResult]) -> str:
    """Return a sentence on the sides for the report, from the last trips; empty without finding.

    Parameters
    ----------
    trips : sequence of TripResult
        In the order of the mileage.
    """
    last = [r for r in trips if r.status == OK][-N_LAST:]
    told = [r for r in last if r.sides]
    if not told:
        return ""
    trips_are = f"{len(told)} of the last {len(last)} trips" if len(last) > 1 else "the last trip"
    return (
        f"Left and right differ on {trips_are}; on {told[-1].trip}: {told[-1].sides}. An estimate "
        "is the mean of both sides. Sensors of a pair that differ in place or sensitivity, and a "
        "track with one rail worse than the other, can look alike: compare several trips."
    )
