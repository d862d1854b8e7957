"""The speed of the train on the trip's clock, and its faults."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from suspnet.ground.types import BoolArray, FloatArray
from suspnet.trains.recordings import sources
from suspnet.trains.recordings.cleaning import Fault, paint, runs
from suspnet.trains.recordings.clocks import Zero
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import SpeedSource

LARGEST_SPEED_M_PER_S = 150.0  # largest speed of a train [m/s]; a larger value counts as unknown
LONGEST_SPEED_GAP_S = 10.0
"""Longest gap between two speeds that is interpolated, [s]; in longer ones the speed is unknown."""
HIGHEST_RATE_HZ = 20.0
"""Rate [Hz] to which speeds of at least twice this rate are averaged, to save memory."""
LARGEST_ACCELERATION, LARGEST_STEP = 5.0, 2.0
"""Largest change of a train's speed: [m/s2] times the time step, plus [m/s] for resolution."""
STANDING_M_PER_S = 0.5
"""Speed below which a train is at rest, or a receiver has lost its satellites, [m/s]."""
BRAKING, NOISE = 2.5, 0.5
"""Largest change after a run of equal speeds: [m/s2] of an emergency brake times the time step,
plus [m/s] for noise."""
SCATTERING = 0.25
"""Least share of steps with a sign opposite to the step before for a receiver to be noisy. Steady
or accelerating trains have few, white noise two of three."""
COARSE = 5.0
"""Least median difference of successive steps, in units of the receiver's resolution, for noise to
prevent equal speeds: a standard deviation of twice the resolution."""
Timed = tuple[FloatArray, FloatArray]  # times [s] and speeds
LEAST_CHANCE, LEAST_STEPS = 1e-9, 30
"""Probability of a run of equal speeds below which a noisy receiver is stuck, and least number of
other steps from which its noise is estimated."""


@dataclass(frozen=True)
class SpeedTrack:
    """Recorded speeds (n_known,) [m/s] at `seconds` (n_known,) since `zero`.

    `seconds` include the manifest's `start_s`. `step_s` is the usual time step, infinite for a
    single speed without a rate. `words` states how the file is read.
    """

    seconds: FloatArray
    speeds: FloatArray
    step_s: float
    zero: Zero = field(default_factory=Zero)
    words: str = ""


def read_speed(manifest: TripManifest) -> SpeedTrack | None:
    """Return the speeds of a trip; None if the manifest gives a constant.

    Raises TripError if they cannot be read, their times are wrong, or the constant is implausible.
    """
    source = manifest.speed
    if not isinstance(source, SpeedSource):
        if source > LARGEST_SPEED_M_PER_S:
            raise TripError.at(manifest.path, "speed-too-high", source=source, source2=source)
        return None
    where = manifest.where("speed")
    with sources.open_source(manifest, source, where) as file:
        parts = list(_thinned(_timed(file, where)))
        seconds, speeds = (np.concatenate(part) for part in zip(*parts, strict=True))
        track = speed_track(seconds, file.size * speeds, source.start_s, file.rate_hz)
        return replace(track, zero=file.zero, words=file.words)


def speed_track(
    seconds: FloatArray, speeds: FloatArray, start_s: float, rate_hz: float | None
) -> SpeedTrack:
    """Return the track of speeds (n_known,) [m/s] at times (n_known,) [s] since `start_s`."""
    step_s = 1 / (rate_hz or np.inf)
    if len(seconds) > 1:
        step_s = float(np.median(np.diff(seconds)))
    return SpeedTrack(start_s + seconds, speeds, step_s)


def speed_at(
    manifest: TripManifest, track: SpeedTrack | None, offset_s: float, times_s: FloatArray
) -> tuple[FloatArray, tuple[Fault, ...]]:
    """Return the speed (n,) [m/s] at instants of the trip's clock, and its faults in their range.

    The speed is NaN where unknown; TripError if it is unknown throughout. `offset_s` is the zero of
    the track's times on the trip's clock.
    """
    if track is None:
        assert isinstance(manifest.speed, float)  # otherwise there is a track
        return np.full(len(times_s), manifest.speed), ()
    # wrong values first, as a receiver is stuck only among plausible ones
    known_s = track.seconds + offset_s
    missing = ~((track.speeds >= 0) & (track.speeds <= LARGEST_SPEED_M_PER_S))
    zero, jump = find_wrong_speeds(known_s, np.where(missing, np.nan, track.speeds))
    speed = np.where(missing | zero | jump, np.nan, track.speeds)
    stuck = find_stuck(known_s, speed)
    speed[stuck] = np.nan
    # interpolate, but not beyond the ends or across long gaps
    result = np.interp(times_s, known_s, speed)
    result[(times_s < known_s[0] - track.step_s) | (times_s > known_s[-1] + track.step_s)] = np.nan
    if len(known_s) > 1:
        after = np.clip(np.searchsorted(known_s, times_s), 1, len(known_s) - 1)
        result[np.diff(known_s)[after - 1] > LONGEST_SPEED_GAP_S] = np.nan
    if np.isnan(result).all():
        largest = {"largest_speed_m_per_s": LARGEST_SPEED_M_PER_S}
        raise TripError.at(manifest.path, "speed-never-usable", **largest)
    inside = (known_s >= times_s[0]) & (known_s <= times_s[-1])
    faults = [
        Fault("speed", kind, n, n * track.step_s, float(known_s[mask & inside][0]), False)
        for kind, mask in (("gap", missing), ("zero", zero), ("jump", jump), ("stuck", stuck))
        if (n := int(np.count_nonzero(mask & inside)))
    ]
    return result, (*_lost_rows(known_s, inside, track.step_s), *faults)


def find_wrong_speeds(known_s: FloatArray, speeds: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return where a speed of zero means a missing value, and where it jumps; all (n_known,).

    A train cannot stop or start at once, so a run of zeros with an impossible step at one of its
    ends means missing values. Other runs of at most ``LONGEST_SPEED_GAP_S`` between two impossible
    steps are jumps. `speeds` are NaN where missing.
    """
    zero, jump = (np.zeros(len(speeds), dtype=np.bool_) for _ in range(2))
    at = np.flatnonzero(np.isfinite(speeds))
    starts, stops = runs(speeds[at] < STANDING_M_PER_S)
    if len(starts):
        bad = np.concatenate([[False], _impossible(known_s[at], speeds[at]), [False]])
        for start, stop in zip(starts, stops, strict=True):
            zero[at[start:stop]] = bad[start] or bad[stop]
    at = at[~zero[at]]
    borders = np.flatnonzero(_impossible(known_s[at], speeds[at])) + 1
    for start, stop in pairwise(borders):
        part = at[start:stop]
        jump[part] = known_s[part[-1]] - known_s[part[0]] <= LONGEST_SPEED_GAP_S
    return zero, jump


def find_stuck(known_s: FloatArray, speeds: FloatArray) -> BoolArray:
    """Return where a receiver repeats its last speed while the train's changes; all (n_known,).

    Equal speeds of a moving train for more than ``LONGEST_SPEED_GAP_S`` mean that it keeps its
    speed or that the receiver is stuck. It is stuck if the next speed is beyond the reach of an
    emergency brake, or if speeds elsewhere are so noisy that such a run is improbable. The first of
    the equal speeds is valid. `speeds` are NaN where missing or wrong.
    """
    stuck = np.zeros(len(speeds), dtype=np.bool_)
    at = np.flatnonzero(np.isfinite(speeds))
    seconds, steps = np.diff(known_s[at]), np.diff(speeds[at])
    # long runs of equal speeds of a moving train
    starts, stops = runs(steps == 0)
    long = known_s[at[stops]] - known_s[at[starts]] > LONGEST_SPEED_GAP_S
    long &= speeds[at[starts]] >= STANDING_M_PER_S
    starts, stops = starts[long], stops[long]
    # noise and resolution of the receiver, from all other steps
    others = steps[~paint(len(steps), starts, stops)]
    finest = float(np.abs(others[others != 0]).min(initial=np.inf))
    most = BRAKING * seconds + NOISE + 2 * finest  # two steps of resolution are no leap
    scatters = (
        len(others) >= LEAST_STEPS
        and (others[1:] * others[:-1] < 0).mean() > SCATTERING
        and float(np.median(np.abs(np.diff(others)))) > COARSE * finest
    )
    equal = max(float((others == 0).mean()), 1 / len(others)) if len(others) else 1.0
    for start, stop in zip(starts, stops, strict=True):
        leaps = stop < len(steps) and abs(steps[stop]) > most[stop]
        if leaps or (scatters and equal ** (stop - start) < LEAST_CHANCE):
            stuck[at[start + 1 : stop + 1]] = True
    return stuck


def _impossible(known_s: FloatArray, speeds: FloatArray) -> BoolArray:
    """Return which steps between successive speeds are impossible for a train, (n - 1,)."""
    most = LARGEST_STEP + LARGEST_ACCELERATION * np.diff(known_s)
    return np.asarray(np.abs(np.diff(speeds)) > most)


def _lost_rows(known_s: FloatArray, inside: BoolArray, step_s: float) -> Iterator[Fault]:
    """Yield the faults of missing rows: short gaps, which are interpolated, and longer ones."""
    steps = np.diff(known_s)
    lost = (steps > sources.GAP_STEPS * step_s) & inside[:-1] & inside[1:]
    short = steps <= LONGEST_SPEED_GAP_S
    for repaired, mask in ((True, lost & short), (False, lost & ~short)):
        if mask.any():
            n_samples = int(np.round(steps[mask] / step_s - 1).clip(min=1).sum())
            first_s = float(known_s[:-1][mask][0])
            yield Fault("speed", "gap", n_samples, n_samples * step_s, first_s, repaired)


def _timed(file: sources.OpenSource, where: str) -> Iterator[Timed]:
    """Yield times [s] and speeds; TripError if times do not rise or contradict the rate."""
    last_s: float | None = None
    n_before = 0
    for *times, speeds in file.blocks():
        if times:
            (seconds,) = times
            sources.check_rising(where, seconds, last_s)
            if last_s is None and len(seconds) > 1:
                sources.check_rate(where, file.rate_hz, 1 / float(np.median(np.diff(seconds))))
            last_s = float(seconds[-1])
        else:
            assert file.rate_hz is not None  # it has times or a rate
            seconds = (n_before + np.arange(len(speeds))) / file.rate_hz
            n_before += len(speeds)
        yield seconds, speeds


def _thinned(blocks: Iterable[Timed]) -> Iterator[Timed]:
    """Yield blocks of times and speeds, averaged to about ``HIGHEST_RATE_HZ`` if faster."""
    for seconds, speeds in blocks:
        steps = np.diff(seconds)
        size = int(1 / (HIGHEST_RATE_HZ * np.median(steps)) + 1e-6) if len(steps) else 1
        if size < 2:
            yield seconds, speeds
            continue
        starts = np.arange(0, len(seconds), size)
        counts = np.diff(starts, append=len(seconds))
        yield np.add.reduceat(seconds, starts) / counts, np.add.reduceat(speeds, starts) / counts
