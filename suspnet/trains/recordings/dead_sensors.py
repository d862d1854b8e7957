"""Sensors without signals of their own: dead ones are left out, copies of another one refused.

The place of a dead one of a pair is read by the other one alone. A single one is left out if enough
others remain to read each part.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from suspnet.ground.findings import Finding, at, together
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.trains.recordings.cleaning import Fault
from suspnet.trains.recordings.errors import DeadSensorError, TripError
from suspnet.trains.recordings.manifest import LEAST_SENSORS, TripManifest
from suspnet.trains.recordings.manifest_sources import partner_of
from suspnet.trains.recordings.sensor import SensorSignal

DEAD = "dead"
"""Kind of the fault of a dead sensor."""
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
    read: Mapping[str, Callable[[], SensorSignal]],
    problems: Iterable[str] = (),
) -> tuple[list[SensorSignal], dict[str, str]]:
    """Return the signals of sensors, and why others have none, by name.

    `read` returns the signal of each sensor. Raises one TripError with `problems` and those of all
    sensors if any has another problem, or if less than ``LEAST_SENSORS`` are alive and one is dead
    that is single or whose partner is dead, too.
    """
    signals: list[SensorSignal] = []
    refused: dict[str, TripError] = {}
    for name, signal in read.items():
        try:
            signals.append(signal())
        except TripError as error:
            refused[name] = error
    # a dead sensor is spared if its partner is alive, or enough others are
    dead = {name: error for name, error in refused.items() if isinstance(error, DeadSensorError)}
    enough = len(read) - len(dead) >= LEAST_SENSORS
    spared = [name for name in dead if enough or partner_of(name) not in ("", *dead)]
    faults = [
        words for name, error in refused.items() if name not in spared for words in error.problems
    ]
    if every := dict.fromkeys([*problems, *faults]):
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
        name: [own - own.mean() for own in map(signal.__getitem__, filter(len, stretches))]
        for name, signal in values.items()
    }
    problems = []
    for first, second in itertools.combinations(centred, 2):
        products = np.array(
            [(x @ x, y @ y, x @ y) for x, y in zip(centred[first], centred[second], strict=True)]
        ).reshape(-1, 3)
        own, its, shared = products[(products[:, :2] > 0).all(axis=1)].T
        if len(own) and np.median(1 - shared**2 / (own * its)) < SAME:
            gain = float(np.median(shared / own))
            kind = "hold-same-samples" if abs(gain - 1) < SAME else "hold-same-times"
            problems.append(at(where, kind, one=first, other=second, gain=gain))
    if problems:
        raise TripError(*problems)
