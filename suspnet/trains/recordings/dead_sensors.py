"""Sensors without signals of their own: dead, copied or loose.

Dead ones are left out, copies of another one refused. The place of a dead one of a pair is read by
the other one alone. A single one is left out if enough others remain to read each part.

Loose sensors show noise or hum instead of the train's motion. All sensors of a suspension are
excited by the same track, so an intact one is coherent with at least one other while the train
moves, and a loose one with none, nor one whose clock has jumped by a second or more. Lack of
coherence alone is no evidence: at low speed or on smooth track all signals vanish in noise. A
sensor therefore counts as loose only where the others are as loud as usual, or it is far quieter
than they are.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.fft import rfft
from scipy.ndimage import binary_propagation, correlate1d
from scipy.signal import get_window

from suspnet.ground.findings import Finding, at, together
from suspnet.ground.types import BoolArray, ComplexArray, FloatArray
from suspnet.trains.recordings.cleaning import Fault, paint, runs
from suspnet.trains.recordings.errors import DeadSensorError, TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import partner_of
from suspnet.trains.recordings.sensor import SensorSignal
from suspnet.vehicle.quantities import LEAST_SENSORS

DEAD = "dead"  # kind of the fault of a dead sensor
FEW_S, FEW_SHARE = 240.0, 0.1
"""A sensor is left out if less than this duration [s] of it is usable, or than this share of what
is usable of the other one, whichever is longer: that much of both sensors is as good as far more of
one."""
LEAST_S = 1.0
NOTHING = Finding("shows-nothing")
"""Less than this duration [s] is nothing, and how that is reported."""
LARGEST_SHARE = 0.5
"""It is not left out if more than this share of what is usable of the other one is usable."""
SAME, STRETCHES = 1e-5, 16
"""A channel is a copy of another one if a multiple of that one explains all of its variance but
this share, in half of the stretches of a trip. Rounding to 16 bits leaves 1e-7; noise and axes of
two sensors 1e-4 and more."""


def living(
    manifest: TripManifest,
    readers: Mapping[str, Callable[[], SensorSignal]],
    problems: Iterable[str] = (),
) -> tuple[list[SensorSignal], dict[str, str]]:
    """Return the signals of sensors, and why others have none, by name.

    `readers` return the signal of each sensor. Raises one TripError with `problems` and those of
    all sensors if any has another problem, or if less than ``LEAST_SENSORS`` are alive and one is
    dead that is single or whose partner is dead, too.
    """
    signals: list[SensorSignal] = []
    refused: dict[str, TripError] = {}
    for name, signal in readers.items():
        try:
            signals.append(signal())
        except TripError as error:
            refused[name] = error
    # a dead sensor is spared if its partner is alive, or enough others are
    dead = {name: error for name, error in refused.items() if isinstance(error, DeadSensorError)}
    enough = len(readers) - len(dead) >= LEAST_SENSORS
    spared = [name for name in dead if enough or partner_of(name) not in ("", *dead)]
    faults = [error.problems for name, error in refused.items() if name not in spared]
    if every := dict.fromkeys(itertools.chain(problems, *faults)):
        raise TripError(*every)
    return signals, {name: error.reason for name, error in dead.items()}


def nearly_dead(
    streams: Sequence[SensorSignal], rate_hz: float, loose: Sequence[Fault] = ()
) -> dict[str, str]:
    """Return why sensors are to be left out, by name: too little of them is usable.

    One without a partner is left out only if nothing of it is usable, and enough others are there.
    """
    usable_s = {stream.name: np.count_nonzero(~stream.touched) / rate_hz for stream in streams}
    faults = {stream.name: [*stream.faults] for stream in streams}
    for fault in loose:
        usable_s[fault.channel] -= fault.seconds
        faults[fault.channel].append(fault)
    reasons: dict[str, str] = {}
    for name, own_s in usable_s.items():
        other_s = usable_s.get(partner_of(name), 0.0)
        can_spare = len(usable_s) - len(reasons) > LEAST_SENSORS
        if partner_of(name) not in usable_s and can_spare and own_s < LEAST_S:
            other_s = max(usable_s.values())
        if own_s >= min(max(FEW_S, FEW_SHARE * other_s), LARGEST_SHARE * other_s):
            continue
        if own_s < LEAST_S:
            reasons[name] = NOTHING
            continue
        listed = together(str(fault) for fault in faults[name] if not fault.repaired)
        kind = "usable-too-short-for" if listed else "usable-too-short"
        reasons[name] = Finding(kind, own_s=own_s, other_s=other_s, faults=listed)
    return reasons


def dead_faults(dead: Mapping[str, str], seconds: float, rate_hz: float) -> tuple[Fault, ...]:
    """Return the faults of sensors that are left out from a trip, by their reasons."""
    faults = []
    for name, reason in dead.items():
        place, _, side = partner_of(name).rpartition(" ")
        is_alone = place and partner_of(name) not in dead
        kind = "dead-read-alone" if is_alone else "dead-left-out"
        words = Finding(kind, place=place, side=side, reason=reason)
        n = round(seconds * rate_hz)
        faults.append(Fault(name, DEAD, n, seconds, 0.0, True, None, words))
    return tuple(faults)


def check_copies(values: Mapping[str, FloatArray], usable: BoolArray, where: object) -> None:
    """Raise TripError, which names them, if two channels hold the same samples.

    A copy may have another gain, sign or offset. `values` (n,) are the signals by name, of which
    those at `usable` (n,) count; `where` is the manifest.
    """
    stretches = np.array_split(np.flatnonzero(usable), STRETCHES)
    centred = {
        name: [
            stretch - stretch.mean() for stretch in map(signal.__getitem__, filter(len, stretches))
        ]
        for name, signal in values.items()
    }
    problems = []
    for first, second in itertools.combinations(centred, 2):
        products = np.array(
            [(x @ x, y @ y, x @ y) for x, y in zip(centred[first], centred[second], strict=True)]
        ).reshape(-1, 3)
        power, other_power, shared = products[(products[:, :2] > 0).all(axis=1)].T
        if len(power) and np.median(1 - shared**2 / (power * other_power)) < SAME:
            gain = float(np.median(shared / power))
            kind = "hold-same-samples" if abs(gain - 1) < SAME else "hold-same-times"
            problems.append(at(where, kind, one=first, other=second, gain=gain))
    if problems:
        raise TripError(*problems)


FRAME_S, STEP_S = 2.0, 1.0
"""Length of the frames whose spectra are averaged, and step from one to the next, [s]."""
N_AVERAGED = 16
"""Number of frames in an average; independent signals then have a coherence of about 0.1."""
BAND_HZ = (1.0, 15.0)  # band over which the coherence is averaged, up to a quarter of the rate [Hz]
ALONE, SHARED = 0.2, 0.3
"""Mean coherences below which two sensors share no motion, and above which they do. Intact sensors
of simulated trips were below the first at low speeds only."""
MOVING_M_PER_S = 2.0  # speed above which the sensors respond to the track, [m/s]
USUAL = -0.2
"""Least power of another sensor, relative to its median while sharing motion, that counts as usual
[powers of ten]. Where intact sensors of simulated trips were alone it was at most -0.28."""
COLLAPSED = 1.5
"""Least drop of a collapsed sensor's power below that of the quietest other [powers of ten]. Intact
sensors that were alone reached 1.1."""
SLOW_SHARE, SLOW_QUANTILE = 0.7, 0.1
"""A sensor is judged only above SLOW_SHARE times this quantile of the speeds at which it shared the
others' motion: its signal at far lower speeds is unknown."""
MOSTLY = 0.9
"""A sensor of a pair is loose all along if it shares no motion in at least this fraction of the
frames, while the other one does in more than half of them."""
LEAST_FRAMES = 5  # least number of frames with evidence in a loose stretch
EDGE_S = 10.0  # uncertainty of the ends of a loose stretch: half an average plus a frame, [s]


@dataclass(frozen=True)
class _Frames:
    """Averages around each frame of a recording.

    `coherences`: (n_sensors, n_frames), mean over the band, with the most similar sensor. `levels`:
    (n_sensors, n_frames), [powers of ten], median over the band of the power relative to the usual
    one; NaN for sensors that never share motion. `speeds`: (n_frames,), [m/s]. `judged`:
    (n_frames,), whether the train moves and more than half of the averaged frames are usable.
    """

    coherences: FloatArray
    levels: FloatArray
    speeds: FloatArray
    judged: BoolArray


def find_loose(
    values: Mapping[str, FloatArray],
    usable: BoolArray,
    speed_m_per_s: FloatArray,
    rate_hz: float,
    start_s: float = 0.0,
) -> tuple[tuple[Fault, ...], BoolArray, BoolArray]:
    """Return a fault for each loose sensor, where each is loose, and where motion is too weak.

    All arrays are on the common clock, of shape (n,), the second result (n_sensors, n); its first
    sample is at `start_s` on the trip's clock. Where motion is too weak, an intact sensor shares
    none with the others.
    """
    signals = np.stack(list(values.values()))
    frames = _frames(signals, usable, speed_m_per_s, rate_hz)
    # a sensor without shared motion is loose, or there is little motion
    alone = (frames.coherences < ALONE) & frames.judged
    loose = _loose(frames, alone)
    loose |= alone & _never_shared(list(values), frames)[:, None]  # loose all along
    n = len(usable)
    faults, masks = [], np.zeros((len(values), n), dtype=np.bool_)
    for name, its, its_alone, mask in zip(values, loose, alone & loose, masks, strict=True):
        if its.any():
            mask[:] = _painted(its, n, rate_hz)
            kind = "loose-of-pair" if partner_of(name) in values else "loose"
            seen_s = start_s + STEP_S * np.flatnonzero(its_alone)[[0, -1]]
            words = Finding(kind, first=seen_s[0], last=seen_s[1] + FRAME_S)
            n_loose, first_s = int(np.count_nonzero(mask)), start_s + mask.argmax() / rate_hz
            seconds = n_loose / rate_hz
            faults.append(Fault(name, "loose", n_loose, seconds, first_s, False, None, words))
    silent = np.asarray((alone & ~loose).any(axis=0))
    return tuple(faults), masks, _painted(silent, n, rate_hz)


def _frames(
    signals: FloatArray, usable: BoolArray, speed_m_per_s: FloatArray, rate_hz: float
) -> _Frames:
    size, step = round(FRAME_S * rate_hz), round(STEP_S * rate_hz)
    inside = _in_frames(usable, size, step).all(axis=1)
    speeds = _in_frames(np.nan_to_num(speed_m_per_s), size, step).mean(axis=1)
    window, band = get_window("hann", size), _band(size, rate_hz)
    spectra = np.stack(
        [rfft(window * _in_frames(signal, size, step), axis=1)[:, band] for signal in signals]
    )
    spectra *= inside[:, None]
    power = np.maximum(_averaged(np.abs(spectra) ** 2), np.finfo(np.float64).tiny)
    coherences = np.zeros(spectra.shape[:2])
    for i, j in itertools.combinations(range(len(signals)), 2):
        cross = np.abs(_averaged(spectra[i].conj() * spectra[j])) ** 2
        shared = (cross / power[i] / power[j]).mean(axis=1)
        coherences[[i, j]] = np.maximum(coherences[[i, j]], shared)
    n_inside = _averaged(inside[:, None].astype(np.float64))[:, 0]
    judged = (speeds > MOVING_M_PER_S) & (n_inside > 0.5 - 0.5 / N_AVERAGED)
    shares = (coherences >= SHARED) & judged
    levels = _levels(power / np.maximum(n_inside, 1 / N_AVERAGED)[:, None], shares)
    return _Frames(coherences, levels, speeds, judged)


def _levels(power: FloatArray, shares: BoolArray) -> FloatArray:
    """Return the levels (n_sensors, n_frames) of a power, with its usual one where `shares`."""
    logs = np.log10(np.maximum(power, np.finfo(np.float64).tiny))
    levels = np.full(shares.shape, np.nan)
    for level, log, its in zip(levels, logs, shares, strict=True):
        if np.count_nonzero(its) >= N_AVERAGED:
            level[:] = np.median(log - np.median(log[its], axis=0), axis=1)
    return levels


def _in_frames(values: Any, size: int, step: int) -> Any:
    return np.lib.stride_tricks.sliding_window_view(values, size)[::step]


def _band(size: int, rate_hz: float) -> slice:
    low, high = BAND_HZ[0], min(BAND_HZ[1], rate_hz / 4)
    return slice(math.ceil(low * size / rate_hz), math.floor(high * size / rate_hz) + 1)


def _averaged(spectra: FloatArray | ComplexArray) -> Any:
    # not a running sum: its rounding error would persist after a loud signal
    return correlate1d(spectra, np.full(N_AVERAGED, 1 / N_AVERAGED), axis=-2, mode="constant")


def _loose(frames: _Frames, alone: BoolArray) -> BoolArray:
    """Return the frames in which each sensor is loose.

    Only sensors that are not loose serve as reference, hence two rounds.
    """
    loose = np.zeros_like(alone)
    for _ in range(2):
        sound, loose = np.where(loose, np.nan, frames.levels), np.zeros_like(alone)
        for i in np.flatnonzero(alone.any(axis=1)).tolist():
            # frames with evidence grow into the stretch of frames without shared motion
            seeds = alone[i] & _evidence(frames, sound, i)
            grown = binary_propagation(seeds, mask=alone[i] | ~frames.judged)
            for part in map(slice, *(edges.tolist() for edges in runs(grown))):
                loose[i, part] = np.count_nonzero(seeds[part]) >= LEAST_FRAMES
    return loose


def _never_shared(names: Sequence[str], frames: _Frames) -> BoolArray:
    shares = np.count_nonzero((frames.coherences >= SHARED) & frames.judged, axis=1)
    is_alone = (frames.coherences < ALONE) & frames.judged
    n_judged, n_alone = np.count_nonzero(frames.judged), np.count_nonzero(is_alone, axis=1)
    never = np.zeros(len(names), dtype=np.bool_)
    for i, name in enumerate(names):
        if (partner := partner_of(name)) in names:
            is_partner_sound = shares[names.index(partner)] > n_judged / 2
            never[i] = n_alone[i] >= MOSTLY * n_judged and is_partner_sound
    return never


def _evidence(frames: _Frames, levels: FloatArray, i: int) -> BoolArray:
    """Return the frames in which sensor `i`, if intact, would share the others' motion.

    `levels` are NaN where a sensor is no reference.
    """
    level, others = frames.levels[i], np.delete(levels, i, axis=0)
    loudest = np.where(np.isnan(others), -np.inf, others).max(axis=0)
    quietest = np.where(np.isnan(others), np.inf, others).min(axis=0)
    has_collapsed = np.isfinite(quietest) & (level <= quietest - COLLAPSED)  # False for NaN
    # its signal at speeds far below those at which it shared motion is unknown
    shares = (frames.coherences[i] >= SHARED) & frames.judged
    if np.isnan(level).all():
        return np.zeros_like(frames.judged)
    slowest = SLOW_SHARE * np.quantile(frames.speeds[shares], SLOW_QUANTILE)
    return np.asarray(((loudest >= USUAL) | has_collapsed) & (frames.speeds >= slowest))


def _painted(frames: BoolArray, n_samples: int, rate_hz: float) -> BoolArray:
    """Return the samples of some frames, (n_samples,), extended by half an average."""
    starts, stops = runs(frames)
    first = (starts + 1) * STEP_S - EDGE_S
    last = stops * STEP_S + EDGE_S
    # the first and last frames have incomplete averages: extend to the ends of the recording
    first[starts <= EDGE_S / STEP_S] = 0.0
    last[stops >= len(frames) - EDGE_S / STEP_S] = n_samples / rate_hz
    begin, end = (np.rint(s * rate_hz).astype(np.intp).clip(0, n_samples) for s in (first, last))
    return paint(n_samples, begin, end)
