"""Health of each sensor on one trip: noise, sensitivity, delay and drop-outs.

With i a sensor, j and k the means of the two other places, and one track that moves all three, the
sensor's own noise is N = S_ii - abs(S_ij S_ik / S_jk), whatever the suspension (Sleeman and others,
Bulletin of the Seismological Society of America 96, 2006). Its mean over the bins is weighted by
1 / S_ii^2, the inverse of its variance: it is that of the bins in which the sensor is quietest. It
is an upper bound where motion that the others do not share (leakage, roll) is stronger.

The gain of a sensor is its response over what it should be, H_i = S_zi / (S_zm E), z being another
place as the instrument, m a mean of sensors and E the healthy response from m to i. On axle boxes
and frame m is the axle boxes' mean, and on the frame only such bins are used in which no parameter
matters. In the body, where all matter, m is the body's own mean, so that only a pair has a gain.
"""

import math

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.welch import Welch
from suspnet.ground.parameters import FORWARD
from suspnet.ground.records import SensorHealth
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_sources import channel_of
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.spectra.segments import segment_speeds, sensor_segments
from suspnet.vehicle import PARAMETERS, ResponseGenerator

LEAST_SEGMENTS = 10  # smallest number of segments from which a sensor is judged
SLOWEST_M_PER_S, SPEED_TOLERANCE = 5.0, 0.1
"""Lowest speed in use, and deviation of those in use from their median: the bins without influence
depend on the speed."""
BAND_HZ = (0.2, 20.0)  # band of noise and of the gains within a pair, [Hz]
INFLUENCE, STEP = 0.1, 0.01
"""Largest derivative of log abs(G_p) by a parameter's logarithm in the bins of a frame's gain: a
part at half its value changes it by 7 % at most; and the step of the differences."""
LEAST_BINS, COHERENT = 6, 0.5
"""Smallest number of bins of a gain, and their least coherence with the instrument."""
FAULTS = ("gap", "spike", "saturation", "constant", "loose", "dead")
"""Kinds of faults that are drop-outs of a sensor."""


def sensor_health(
    recording: Recording, generator: ResponseGenerator, welch: Welch
) -> dict[str, SensorHealth]:
    """Return the health of each sensor; numbers are NaN where the trip does not show them.

    It does not show those of sensors at the other axle, nor any if a channel has no sensor.
    """
    faulty = dropouts(recording)
    names, segments = sensor_segments(recording, welch)
    speeds = segment_speeds(recording, segments).mean(dim=1)
    speed = float(speeds.median()) if len(speeds) else math.nan
    chosen = (speeds > SLOWEST_M_PER_S) & ((speeds / speed - 1).abs() <= SPEED_TOLERANCE)
    if int(chosen.sum()) < LEAST_SEGMENTS or recording.absent:
        return {name: SensorHealth(faulty=share) for name, share in faulty.items()}
    # means over the two sensors of a place stand for the motion of the place
    low, high = BAND_HZ
    inside = (segments.frequencies_hz >= low) & (segments.frequencies_hz <= high)
    bins, values = segments.frequencies_hz[inside], segments.values[chosen][..., inside]
    places = [
        [i for i, name in enumerate(names) if channel_of(name) == channel] for channel in CHANNELS
    ]
    means = torch.stack([values[:, rows].mean(dim=1) for rows in places], dim=1)
    generator = generator.on("cpu").running(recording.manifest.direction or FORWARD)
    expected, calm = _healthy(generator, speed, bins)
    # a dead sensor and one at the other axle are not compared with the vehicle
    unjudged = [*recording.dead, *recording.elsewhere]
    health = {name: SensorHealth(faulty=faulty[name]) for name in unjudged}
    for place, rows in enumerate(places):
        for i in rows:
            x = values[:, i]
            noise = _noise(x, means, place)
            gain = _gain(x, means, place, len(rows), expected, calm, bins)
            health[names[i]] = SensorHealth(noise, *gain, faulty[names[i]])
    return health


def dropouts(recording: Recording) -> dict[str, float]:
    """Return the share of a trip in which each sensor has faulty samples, repaired ones too."""
    lost = dict.fromkeys([*recording.sensors(), *recording.dead], 0.0)
    for fault in recording.faults:
        if fault.channel in lost and fault.kind in FAULTS:
            lost[fault.channel] += fault.seconds / recording.duration_s
    return {name: min(share, 1.0) for name, share in lost.items()}


def _cross(x: Tensor, y: Tensor) -> Tensor:
    return (x.conj() * y).mean(dim=0)


def coherences(x: Tensor, y: Tensor) -> Tensor:
    """Return the coherence of two signals' segments, each (n_segments, n_freq), in each bin."""
    return _cross(x, y).abs().square() / (_cross(x, x).real * _cross(y, y).real)


def _noise(x: Tensor, means: Tensor, place: int) -> float:
    """Return a sensor's noise, [m/s^2/sqrt(Hz)]: at least the standard error of its square."""
    j, k = (means[:, other] for other in range(len(CHANNELS)) if other != place)
    power = _cross(x, x).real
    # where j and k share nothing the quotient has heavy tails
    shared = (_cross(j, x) * _cross(x, k) / _cross(j, k)).abs().minimum(power)
    weights = 1 / power**2
    density = float(((power - shared) * weights).sum() / weights.sum())
    error = math.sqrt(float((weights**2 * power**2).sum()) / len(x)) / float(weights.sum())
    return math.sqrt(max(density, error))


def _gain(
    x: Tensor, means: Tensor, place: int, n_own: int, expected: Tensor, calm: Tensor, bins: Tensor
) -> tuple[float, float, float]:
    """Return a sensor's log gain, how much it rises over the band, and its delay [s]."""
    is_body = place == 2
    z, m = means[:, 1 if is_body else 2], means[:, 2 if is_body else 0]
    used = calm if place == 1 else torch.ones_like(calm)
    if is_body and n_own == 1:
        return math.nan, math.nan, math.nan
    h = _cross(z, x) / _cross(z, m) / (expected if place == 1 else 1.0)
    coherence = coherences(z, m)
    used = used & (coherence >= COHERENT)
    if int(used.sum()) < LEAST_BINS:
        return math.nan, math.nan, math.nan
    logs, f, share = h[used].abs().log().numpy(), bins[used].numpy(), coherence[used].numpy()
    weights = share / (1.001 - share)
    half = len(f) // 2
    ends = [
        np.average(logs[part], weights=weights[part]) for part in (slice(half), slice(half, None))
    ]
    angles = h[used].angle().numpy()
    delay = -float((weights * f * angles).sum() / (2 * math.pi * (weights * f**2).sum()))
    return float(np.average(logs, weights=weights)), float(ends[1] - ends[0]), delay


def _healthy(generator: ResponseGenerator, speed: float, bins: Tensor) -> tuple[Tensor, Tensor]:
    """Return the healthy G_p, and the bins in which no parameter changes it much, (n_freq,)."""
    rows = torch.ones(1 + len(PARAMETERS), len(PARAMETERS), dtype=torch.float64)
    rows[1:] += STEP * torch.eye(len(PARAMETERS), dtype=torch.float64)
    if generator.speed_m_per_s is not None:
        relative = torch.full((len(rows), 1), speed / generator.speed_m_per_s, dtype=rows.dtype)
        rows = torch.cat([rows, relative], dim=1)
    to_frame = generator.responses(rows, bins)[0]
    influence = (to_frame[1:].abs().log() - to_frame[0].abs().log()).abs() / math.log1p(STEP)
    return to_frame[0], influence.amax(dim=0) <= INFLUENCE
