"""Trips with a single sensor on one side where the vehicle was commissioned on means of pairs.

Cross level and roll that a single sensor shows are independent of the mean of both rails. Where the
other two places are pairs, they are noise of that sensor: its responses are unbiased, as the third
place is their instrument, and its measured coherence widens the interval. Two single sensors share
them: then roll is fitted along, with its numbers at their prior.

All this holds for equal sides. With unequal ones a pair's difference is coherent with the mean,
which flags the trip.
"""

from __future__ import annotations

from dataclasses import replace

from suspnet.estimation.fitted import FittedMethod
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import SIDES
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.sensors.sensor_health import coherences
from suspnet.trains.spectra.segments import difference_segments, in_band
from suspnet.trains.spectra.steady_parts import SpeedBin
from suspnet.vehicle import ResponseGenerator, VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

SIDE_M = dict(zip(SIDES, (1.0, -1.0), strict=True))
"""Assumed lateral position of a sensor if only its side is known, [m]."""
ROLL_AS_NOISE, ROLL_UNKNOWN = 1.2, 1.6
"""Factors on half widths where roll is the noise of one sensor, and where it is fitted from its
prior alone.

On four trains of the tests (tests/rich_train.py, seeds 0 to 3, all effects of the family, 20 trips
of 20 minutes each) 90 % intervals held 88 to 100 % of each output with one single sensor, and 66 to
100 % with eight combinations of two or three; with these factors 96 % and 92 % at least."""
UNEQUAL = 3.0
"""Coherence of a pair's difference with its mean, over that of unrelated signals, above which the
sides differ. It was at most 1.2 on 40 trips of trains with equal sides, 2.8 with sensitivities that
differ by up to 4 %, and 1.4 to 24 on 30 trips with wear of one side."""


def lone_channels(generator: ResponseGenerator, recording: Recording) -> dict[str, str]:
    """Return the side of each single sensor that the generator takes as in the middle, by place."""
    places = zip(CHANNELS, recording.sides, generator.sensor_lateral_m, strict=True)
    return {name: side for name, side, lateral_m in places if side and not lateral_m}


def placed(method: FittedMethod, recording: Recording) -> FittedMethod:
    """Return the method with a recording's single sensors on their side, and roll at its prior.

    It is unchanged if the method knows of all, or if one alone is single and roll is its noise.
    """
    generator, lone = method.generator, lone_channels(method.generator, recording)
    if not isinstance(generator, VerticalVehicle) or generator.distribution is None:
        return method
    if len(lone) < 2 and not (lone and generator.rolls):
        return method
    box, frame, body = (
        SIDE_M[lone[name]] if name in lone else lateral_m
        for name, lateral_m in zip(CHANNELS, generator.sensor_lateral_m, strict=True)
    )
    prior = LogNormal.prior(("roll",)).without(LogNormal.prior(()).names)
    return replace(
        method,
        generator=replace(
            generator,
            parts=(*generator.parts, "roll"),
            sensor_lateral_m=(box, frame, body),
            distribution=generator.distribution.extended(prior),
        ),
    )


def with_lone(speed_bin: SpeedBin, method: FittedMethod, recording: Recording) -> SpeedBin:
    """Return a speed bin with what single sensors do to its interval, doubts and flags.

    `method` is the one before `placed`.
    """
    lone = lone_channels(method.generator, recording)
    if not lone:
        return speed_bin
    factor = ROLL_AS_NOISE if speed_bin.method is method else ROLL_UNKNOWN
    estimate, noise_share = speed_bin.estimate.scaled(factor), speed_bin.noise_share / factor**2
    listed = together((f"{name} {side}" for name, side in lone.items()), ", ")
    ratio = _unequal(speed_bin, recording)
    kind = "one-sensor-alone-unchecked" if ratio is None else "one-sensor-alone"
    doubts: str = Finding(kind, names=listed)
    if ratio is not None and ratio > UNEQUAL:
        text = Finding("one-sensor-alone-differ", names=listed)
        estimate = replace(estimate, flags=estimate.flags.with_kind("sides", text))
    doubts = together((speed_bin.doubts, doubts))
    return replace(speed_bin, estimate=estimate, noise_share=noise_share, doubts=doubts)


def _unequal(speed_bin: SpeedBin, recording: Recording) -> float | None:
    """Return the largest coherence of a difference with its mean, over that of unrelated signals.

    Of frame and body, as that of the axle boxes shows the track alone; None without such a pair.
    """
    segments, chosen = speed_bin.segments, speed_bin.chosen
    used = slice(None) if speed_bin.left_out is None else ~speed_bin.left_out
    pairs = [place for place, is_pair in enumerate(recording.paired) if is_pair]
    if not any(pairs):  # none, or the axle boxes alone
        return None
    differences = difference_segments(recording, segments.welch)
    halves = in_band(differences, segments.frequencies_hz).values
    found = []
    for x, y in ((segments.values[:, i], halves[:, pairs.index(i)]) for i in pairs if i > 0):
        coherence = coherences(x[chosen][:, used], y[chosen][:, used])
        found.append(speed_bin.spectra.n_averages * float(coherence.mean()))
    return max(found)
