"""Checks of channels and speed against physics: order, speed, gain and sign at low frequency.

At low frequency everything moves with the track: G_p and G_s tend to 1. At high frequency each
suspension isolates: the axle box vibrates more than the bogie, the bogie more than the body, so
swapped channels change the shape of the responses. Both axles of a bogie meet the same track, so
waves of twice the wheelbase pitch the frame and do not move its centre: the shape shows the speed.
Which axle meets the track first shows in the phases: they give the direction of travel.
"""

import itertools
import math
import operator
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.curves.estimates import LOWEST_MODE
from suspnet.curves.welch import SegmentSpectra
from suspnet.ground.findings import Finding, at, together
from suspnet.ground.parameters import DIRECTIONS, FORWARD, Direction, direction_words
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_sources import ACCELERATION_UNITS
from suspnet.trains.recordings.speed import LARGEST_SPEED_M_PER_S
from suspnet.vehicle import PARAMETERS, QuarterCar, ResponseGenerator, Vehicle, VerticalVehicle

SLOW = (0.2, 0.4)  # band in which the gain is checked, in multiples of the first natural frequency
GAIN_TOLERANCE = 2.0
"""Largest plausible factor between a gain and the healthy vehicle's, for any suspension."""
CHANCE = 2.0
"""The order of channels is checked only where the mean coherence exceeds CHANCE / n_averages:
unrelated channels have a coherence of 1 / n_averages."""
SWAPPED = 2.0
"""Mean ratio of the powers of left and right above which sensors of two pairs may be swapped."""
ISOLATED = 2.0
"""Multiple of the second natural frequency above which a lower place moves more than a higher."""
LINKS = ("axle box and bogie frame", "bogie frame and car body")
"""Sensors between which the two coherences are."""
COHERENT = 0.5  # lowest coherence at which gains are checked
IN_ORDER = tuple(range(len(CHANNELS)))
SPEED_BAND_HZ = 20.0
"""The speed is checked below this frequency, which the spectra must reach, [Hz]."""
KM_PER_H = 3.6
DOUBTFUL_ORDER_MARGIN, DOUBTFUL_SPEED_MARGIN = 1.25, 1.5
"""Factors by which another order or speed must fit better to be an error, where the vehicle is
known from its drawing only and sensors are single. The right ones rarely fit worse by as much.
"""
ORDER_MARGIN = 1.1
"""Factor by which another order must fit the healthy vehicle better to be an error. With single
sensors axle box and bogie are hard to distinguish: an order that fits slightly better is a doubt.
"""
SPEED_MARGIN = 1.25
"""Factor by which another speed must fit better than the stated one to be an error. The right one
fits better than the same number in the other unit by 1.69 and more (all shipped vehicles)."""

DIRECTION_MARGIN = 1.3
"""Factor by which the phases must fit one direction of travel better than the other to show it:
worn vehicles fit the wrong one better than their drawing does by at most 1.28."""
DIRECTION_NOISE = 0.1  # noise of a phase below which its bin counts fully, [rad]


def check_channels(
    spectra: CrossSpectra,
    frequencies_hz: Tensor,
    generator: ResponseGenerator,
    vehicle: Vehicle,
    *,
    doubtful: bool = False,
) -> str:
    """Raise TripError where a channel has the wrong unit or sign, or two channels are swapped.

    `spectra` are those of axle box, bogie and body at the speed of `generator`, which gives the
    expected gains. `doubtful`: the generator knows neither the vehicle's true parameters nor the
    roll that single sensors measure; another order or speed is then an error only by a larger
    margin, and else a doubt. Returns the doubts and checks that were not possible; empty if there
    are none.
    """
    modes, _ = QuarterCar(vehicle).natural_modes()
    healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
    expected = torch.stack(generator.responses(healthy, frequencies_hz), dim=1)[0].cpu()
    # the order is checked in the band of estimates; unrelated channels have no shape to compare
    band = frequencies_hz >= LOWEST_MODE * modes[0]
    if bool((spectra.at(band).coherences().mean(dim=1) < CHANCE / spectra.n_averages).any()):
        return "channels not checked: two of them are not coherent"
    # a clearly better speed or order is an error, a slightly better one a doubt
    speed, speed_words = _other_speed(spectra.at(band), frequencies_hz[band], generator)
    order, order_words = _other_order(spectra.at(band), expected[:, band])
    if speed > (DOUBTFUL_SPEED_MARGIN if doubtful else SPEED_MARGIN):
        raise TripError(speed_words)
    if order > (DOUBTFUL_ORDER_MARGIN if doubtful else ORDER_MARGIN):
        raise TripError(Finding("channels-look-swapped", order_words=order_words))
    direction, factor = shown_direction(spectra, frequencies_hz, generator)
    margin = DOUBTFUL_SPEED_MARGIN if doubtful else DIRECTION_MARGIN
    if factor > margin and direction != generator.direction:
        raise TripError(
            Finding("direction-wrong", direction_words=direction_words(direction), factor=factor)
        )
    doubts = []
    if doubtful and speed > SPEED_MARGIN:
        doubts.append(speed_words)
    if order * (DOUBTFUL_ORDER_MARGIN if doubtful else 1.0) > 1:
        doubts.append(Finding("order-unclear", order_words=order_words))
    doubts += [Finding("if-sure")] if doubts else []
    # at low frequency the gains hardly depend on the suspension: check units and signs there
    low_hz, high_hz = (float(factor * modes[0]) for factor in SLOW)
    slow = (frequencies_hz >= low_hz) & (frequencies_hz <= high_hz)
    coherence = spectra.coherences()[:, slow].mean(dim=1)
    if bool(slow.any()) and bool((coherence >= COHERENT).all()):
        gains = (spectra.responses("Hv")[:, slow] / expected[:, slow]).mean(dim=1)
        _check_gains([complex(gain) for gain in gains])
    else:
        doubts.append(_unchecked_gains(coherence, low_hz, high_hz))
    return together(doubts)


def _unchecked_gains(coherence: Tensor, low_hz: float, high_hz: float) -> str:
    """Return why units and signs are not checked; `coherence` (2,) is NaN without a bin there."""
    least, band = float(coherence.min()), {"low_hz": low_hz, "high_hz": high_hz}
    if math.isnan(least):
        return Finding("gains-out-of-reach", **band)
    link = LINKS[int(coherence.argmin())]
    return Finding("gains-incoherent", link=link, **band, least=least, coherent=COHERENT)


def shown_direction(
    spectra: CrossSpectra, frequencies_hz: Tensor, generator: ResponseGenerator
) -> tuple[Direction, float]:
    """Return the direction of travel whose phases fit better, and how many times better.

    The spectra are those of axle box, bogie and body at the speed of `generator`, which is compared
    in both directions. Distances are mean absolute differences of the phases of G_p and G_s in the
    band of estimates, bins weighted by their noise. Without a dependence on the direction, forward
    fits once as well.
    """
    if generator.direction is None:
        return FORWARD, 1.0
    modes, _ = QuarterCar(generator.vehicle).natural_modes()
    band = (frequencies_hz >= LOWEST_MODE * modes[0]) & (frequencies_hz <= SPEED_BAND_HZ)
    slow = frequencies_hz[band] <= modes[0]
    inside, healthy = spectra.at(band), torch.ones(1, len(PARAMETERS), dtype=torch.float64)
    weights = 1 / (inside.deviations("IV").square() + DIRECTION_NOISE**2)
    distances: dict[Direction, float] = {}
    for direction in DIRECTIONS:
        responses = generator.running(direction).responses(healthy, frequencies_hz[band])
        ratios = inside.responses("IV") / torch.stack(responses, dim=1)[0].cpu()
        # a sensor may be upside down, which shows where everything moves with the track
        signs = ratios[:, slow].real.nansum(dim=1, keepdim=True).sign()
        off = (signs * ratios).angle().abs()
        distances[direction] = float((weights * off).nansum() / weights.nansum())
    best = min(DIRECTIONS, key=distances.__getitem__)
    return best, max(distances.values()) / max(distances[best], 1e-12)


def check_pairs(
    segments: SegmentSpectra,
    differences: SegmentSpectra,
    chosen: Tensor,
    paired: Sequence[bool],
    vehicle: Vehicle,
) -> None:
    """Raise TripError where the two sensors of a pair do not agree.

    At low frequency left and right move almost alike, as the mean of both rails is far larger than
    their difference. With average m and half difference h the left sensor is m + h, the right m -
    h. One error lists the problems of all pairs: a wrong sign, or a size ratio above
    ``GAIN_TOLERANCE``. `differences` are half of left minus right for each pair, of the same
    segments as those of the three channels; `chosen`: (n_segments,); `paired` tells which channels
    are pairs.

    Sensors of two pairs that are swapped on one side are found in the whole band, where the axle
    box moves most and the body least.
    """
    modes, _ = QuarterCar(vehicle).natural_modes()
    average = segments.values[chosen][:, [i for i, is_pair in enumerate(paired) if is_pair]]
    half = differences.values[chosen]
    # swapped sensors first, as their signs and sizes mean nothing
    isolated = segments.frequencies_hz >= ISOLATED * modes[1]
    if bool(isolated.any()):
        _check_swapped(torch.stack([average + half, average - half], dim=-1), isolated, paired)
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
        # without coherence neither sign nor size can be read
        if shared**2 < COHERENT:
            continue
        name, size = CHANNELS[i], math.sqrt(power[0] / power[1])
        if shared < 0:
            problems.append(at(name, "sides-opposed"))
        if not 1 / GAIN_TOLERANCE < size < GAIN_TOLERANCE:
            slip = _slip(size)
            kind = "left-sensor-slip" if slip else "left-sensor"
            problems.append(at(name, kind, size=size, slip=slip))
    if problems:
        raise TripError(*problems)


def _check_swapped(sides: Tensor, isolated: Tensor, paired: Sequence[bool]) -> None:
    """Raise TripError if exchanging the sensors of one side makes two pairs agree that do not.

    `sides` (n_segments, n_pairs, n_freq, 2) are the spectra of left and right; `isolated` (n_freq,)
    are bins in which a lower place moves more than the one above it.
    """
    channels = [i for i, is_pair in enumerate(paired) if is_pair]
    power = sides.abs().square().mean(dim=0).clamp(min=1e-30)
    for first, second in itertools.combinations(range(len(channels)), 2):
        left, right = power[[first, second], :, 0], power[[first, second], :, 1]
        differ = float((left / right).log().abs().mean(dim=1).min())
        agree = float((left.flip(0) / right).log().abs().mean(dim=1).max())
        if differ < math.log(SWAPPED) or agree > differ / 2:
            continue
        # the sensor of the lower place moves more where it is not swapped
        lower, upper = left[:, isolated].sum(dim=1)
        side = "left" if lower < upper else "right"
        names = together((CHANNELS[channels[i]] for i in (first, second)), " and ")
        raise TripError.at(names, "sides-swapped", side=side)


def _other_order(spectra: CrossSpectra, expected: Tensor) -> tuple[float, str]:
    fits = _fits(spectra, expected)
    in_order = fits.pop(IN_ORDER)
    other = min(fits, key=fits.__getitem__)
    swaps = (
        Finding("in-place-of", name=name, channels=CHANNELS[place])
        for place, name in zip(other, CHANNELS, strict=True)
        if CHANNELS[place] != name
    )
    return in_order / fits[other], together(swaps, ", ")


def _fits(spectra: CrossSpectra, expected: Tensor) -> dict[tuple[int, ...], float]:
    """Return the distance between measured and expected curves for each order of the channels.

    Only the shape of the log-magnitudes is compared, independent of unit and sign.
    """
    distances = {}
    for order in itertools.permutations(IN_ORDER):
        difference = _log_magnitudes(spectra, order) - expected.abs().log()
        shape = difference - difference.mean(dim=1, keepdim=True)
        distances[order] = float(shape.square().mean().sqrt())
    return distances


def _log_magnitudes(spectra: CrossSpectra, order: Sequence[int]) -> Tensor:
    """Return log-magnitudes of both links, with the channels in the given order, (2, n_freq)."""
    box, bogie, body = order
    links = [(box, bogie, body), (bogie, body, box)]
    return torch.stack([spectra.transfer(x, y, "IV", z).abs().log() for x, y, z in links])


def _other_speed(
    spectra: CrossSpectra, frequencies_hz: Tensor, generator: ResponseGenerator
) -> tuple[float, str]:
    """Return by what factor a speed in the other unit (km/h, m/s) fits better, and the message.

    The factor is 0 if the channels do not fit in order or the check is not possible. Distances are
    mean absolute ones: in the notches of the curves leakage dominates the logarithms.
    """
    if not isinstance(generator, VerticalVehicle) or frequencies_hz[-1] < SPEED_BAND_HZ:
        return 0.0, ""
    measured = _log_magnitudes(spectra, IN_ORDER)
    healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
    stated, inside = generator.speed_m_per_s, frequencies_hz <= SPEED_BAND_HZ
    fits_of_speed = []
    for unit, speed in (("", stated), ("km/h", stated / KM_PER_H), ("m/s", stated * KM_PER_H)):
        if speed > LARGEST_SPEED_M_PER_S and unit:
            continue
        other = replace(generator, speed_m_per_s=speed)
        curves = torch.stack(other.responses(healthy, frequencies_hz), dim=1)[0].cpu()
        difference = (measured - curves.abs().log())[:, inside]
        shape = difference - difference.median(dim=1, keepdim=True).values
        fits_of_speed.append((float(shape.abs().mean()), unit, speed, curves))
    distance, unit, speed, curves = min(fits_of_speed[1:], key=operator.itemgetter(0))
    fits = _fits(spectra, curves)
    if min(fits, key=fits.__getitem__) != IN_ORDER:
        return 0.0, ""
    words = Finding("speed-unit-wrong", speed=speed, given=stated, unit=unit)
    return fits_of_speed[0][0] / distance, words


def _check_gains(gains: list[complex]) -> None:
    """Raise TripError if a link's gain, relative to the expected one, is implausible."""
    links = ("G_p", "bogie", "axle_box"), ("G_s", "body", "bogie")
    for (link, sink, source), gain in zip(links, gains, strict=True):
        size = abs(gain)
        suspect = _suspect(gains, sink, source)
        if not 1 / GAIN_TOLERANCE < size < GAIN_TOLERANCE:
            slip = _slip(size)
            values = {"link": link, "source": source, "sink": sink, "size": size, "slip": slip}
            raise TripError.at(suspect, "gain-slip" if slip else "gain", **values)
        if abs(math.atan2(gain.imag, gain.real)) > math.pi / 2:
            raise TripError.at(suspect, "sign-wrong", source=source, sink=sink, suspect=suspect)


def _suspect(gains: list[complex], sink: str, source: str) -> str:
    """Return the likely wrong channel: the bogie if both links are off, else the outer end."""
    off = [not 1 / GAIN_TOLERANCE < abs(gain) < GAIN_TOLERANCE or gain.real < 0 for gain in gains]
    return "bogie" if all(off) else (source if source == "axle_box" else sink)


def _slip(size: float) -> str:
    """Return the unit error that explains a gain; empty if none does."""
    errors = (ACCELERATION_UNITS["g"], "m/s2 and g are mixed up"), (1000.0, "mm/s2 or mg?")
    for factor, words in errors:
        for candidate in (factor, 1 / factor):
            if 0.5 < size / candidate < 2:
                return words
    return ""
