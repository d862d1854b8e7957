"""Checks of the channels against physics: their order, and gain and sign at low frequency.

Slowly, everything moves with the track: G_p and G_s tend to 1. Fast, each suspension isolates:
the axle box shakes more than the bogie, the bogie more than the body, so that the responses get
another shape when channels are swapped.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from suspnet.dynamics import PARAMETERS, QuarterCar, ResponseGenerator, Vehicle
from suspnet.features.cross_spectra import CrossSpectra
from suspnet.features.transfer_estimate import SegmentSpectra
from suspnet.recordings.manifest import CHANNELS, TripError

SLOW = (0.2, 0.4)
"""Band in which the gain is checked, in multiples of the first natural frequency."""
LOWEST_MODE = 0.45
"""The order of the channels is checked above this multiple of the first natural frequency."""
GAIN_TOLERANCE = 2.0
"""Factor on the healthy vehicle's gain within which a gain is plausible for any suspension."""
GRAVITY = 9.80665
CHANCE = 2.0
"""Channels that have nothing to do with each other have a coherence of 1 / n in n averages; the
order of the channels is checked above this multiple of it."""
COHERENT = 0.5
"""Least coherence at which the gain is checked."""


def check_channels(
    spectra: CrossSpectra, frequencies_hz: Tensor, generator: ResponseGenerator, vehicle: Vehicle
) -> str:
    """Raise TripError where a channel has the wrong unit or sign, or two are swapped.

    Parameters
    ----------
    spectra : CrossSpectra
        Of a trip at the generator's speed, axle box, bogie, body.
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    generator : ResponseGenerator
        Says what gain to expect of the healthy vehicle.
    vehicle : Vehicle

    Returns
    -------
    str
        What could not be checked, and why; empty if all could.

    Raises
    ------
    TripError
        The message names the channel and what seems wrong.
    """
    modes, _ = QuarterCar(vehicle).natural_modes()
    healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
    expected = torch.stack(generator.responses(healthy, frequencies_hz), dim=1)[0].cpu()
    band = frequencies_hz >= LOWEST_MODE * modes[0]
    if bool((spectra.at(band).coherences().mean(dim=1) < CHANCE / spectra.n_averages).any()):
        return "channels not checked: two of them have nothing to do with each other"
    _check_order(spectra.at(band), expected[:, band])
    slow = (frequencies_hz >= SLOW[0] * modes[0]) & (frequencies_hz <= SLOW[1] * modes[0])
    coherence = spectra.coherences()[:, slow].mean(dim=1)
    if not bool(slow.any()) or bool((coherence < COHERENT).any()):
        return "units and signs not checked: too little coherence at low frequency"
    gains = (spectra.responses("Hv")[:, slow] / expected[:, slow]).mean(dim=1)
    _check_gains([complex(gain) for gain in gains])
    return ""


def check_pairs(
    segments: SegmentSpectra,
    differences: SegmentSpectra,
    chosen: Tensor,
    paired: Sequence[bool],
    vehicle: Vehicle,
) -> None:
    """Raise TripError where the two sensors of a pair do not go together.

    Slowly, left and right move almost alike, for the mean of both rails is far larger than their
    difference. With average m and half difference h the left sensor is m + h, the right m - h.

    Parameters
    ----------
    segments : SegmentSpectra
        Of the three channels.
    differences : SegmentSpectra
        Half of left minus right, one for each pair, of the same segments.
    chosen : bool tensor of shape (n_segments,)
    paired : sequence of 3 bool
        Which channels are pairs.
    vehicle : Vehicle

    Raises
    ------
    TripError
        If one is turned, or more than ``GAIN_TOLERANCE`` times as large as the other. Its
        `problems` are those of all pairs.
    """
    modes, _ = QuarterCar(vehicle).natural_modes()
    slow = (segments.frequencies_hz >= SLOW[0] * modes[0]) & (segments.frequencies_hz <= modes[0])
    if not bool(slow.any()):
        return
    problems = []
    for row, i in enumerate(index for index, is_pair in enumerate(paired) if is_pair):
        average = segments.values[chosen, i][:, slow]
        half = differences.values[chosen, row][:, slow]
        left, right = average + half, average - half
        power = [float(side.abs().square().sum()) for side in (left, right)]
        shared = float((left.conj() * right).real.sum()) / math.sqrt(power[0] * power[1])
        if shared**2 < COHERENT:
            continue
        name, size = CHANNELS[i], math.sqrt(power[0] / power[1])
        if shared < 0:
            problems.append(
                f"{name}: its left and its right sensor move against each other at low frequency; "
                "turn the sign of one in the manifest"
            )
        if not 1 / GAIN_TOLERANCE < size < GAIN_TOLERANCE:
            problems.append(
                f"{name}: its left sensor shows {size:.3g} times what the right one does at low "
                f"frequency{_slip(size)}; check unit and sensitivity of both in the manifest"
            )
    if problems:
        raise TripError(*problems)


def _check_order(spectra: CrossSpectra, expected: Tensor) -> None:
    """Raise TripError if another order of the channels fits the healthy vehicle's curves better.

    Only the shape of the log-magnitudes is compared, so that neither unit nor sign matters.
    """
    healthy = expected.abs().log()
    distances = {}
    for order in itertools.permutations(range(len(CHANNELS))):
        box, bogie, body = order
        links = [(box, bogie, body), (bogie, body, box)]
        measured = torch.stack([spectra.transfer(x, y, "IV", z).abs().log() for x, y, z in links])
        difference = measured - healthy
        shape = difference - difference.mean(dim=1, keepdim=True)
        distances[order] = float(shape.square().mean().sqrt())
    best = min(distances, key=distances.__getitem__)
    if best != tuple(range(len(CHANNELS))):
        said = ", ".join(
            f"{name} is in the place of {CHANNELS[place]}"
            for place, name in zip(best, CHANNELS, strict=True)
            if CHANNELS[place] != name
        )
        raise TripError(
            f"channels look swapped: the responses have the shape expected if {said}; check files "
            "and columns in the manifest"
        )


def _check_gains(gains: list[complex]) -> None:
    """Raise TripError if the gain of a link, relative to the expected one, is impossible."""
    for (link, sink, source), gain in zip(
        (("G_p", "bogie", "axle_box"), ("G_s", "body", "bogie")), gains, strict=True
    ):
        size = abs(gain)
        suspect = _suspect(gains, sink, source)
        if not 1 / GAIN_TOLERANCE < size < GAIN_TOLERANCE:
            slip = _slip(size)
            raise TripError(
                f"{suspect}: the gain {link} from {source} to {sink} at low frequency is "
                f"{size:.3g} times that expected{slip}; check unit and sensitivity in the manifest"
            )
        if abs(math.atan2(gain.imag, gain.real)) > math.pi / 2:
            raise TripError(
                f"{suspect}: {source} and {sink} move against each other at low frequency; turn "
                f"the sign of {suspect} in the manifest"
            )


def _suspect(gains: list[complex], sink: str, source: str) -> str:
    """Name the channel: the bogie if both links are off, else the one at the outer end."""
    off = [not 1 / GAIN_TOLERANCE < abs(gain) < GAIN_TOLERANCE or gain.real < 0 for gain in gains]
    return "bogie" if all(off) else (source if source == "axle_box" else sink)


def _slip(size: float) -> str:
    """Return which unit may be wrong by the size of a gain; empty if none fits."""
    for factor, words in ((GRAVITY, "m/s2 and g are mixed up"), (1000.0, "mm/s2 or mg?")):
        for candidate in (factor, 1 / factor):
            if 0.5 < size / candidate < 2:
                return f" ({words})"
    return ""
