"""Sensors without signals of their own: dead ones are left out, copies of another one refused.

The place of a dead one of a pair is read by the other one alone. A single one is left out if enough
others remain to read each part.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from suspnet.ground.findings import Finding, of, together
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.recordings.cleaning import Fault
from suspnet.recordings.errors import DeadSensorError, TripError
from suspnet.recordings.manifest import LEAST_SENSORS, TripManifest
from suspnet.recordings.manifest_sources import partner_of
from suspnet.recordings.sensor import SensorSignal

DEAD = "dead"
"""Kind of the fault of a dead sensor."""
FEW_S, FEW_SHARE = 240.0, 0.1
"""A sensor is left out if less than this duration [s] of it is usable, or than this share of what
is usable of the other one, whichever is longer. Five minutes of both sensors gave estimates as
accurate as twenty minutes of one."""
LEAST_S = 1.0
NOTHING = Finding("shows-nothing")
"""Less than this duration [s] is nothing, and how that is reported."""
LARGEST_SHARE = 0.5
"""It is not left out if more than this share of what is usable of the other one is usable."""
SAME, STRETCHES = 1e-5, 16
"""A channel is a copy of another one if a multiple of that one explains all of its variance but
this share, in half of the stretches of a trip. Rounding to 16 bits leaves 1e-7. Two sensors differ
by their noise (1e-4 at 40 dB), by their axes (1e-4 for half a degree) and by the motion of their
places: 1e-2 and more in measured records, even far below the first resonance."""


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
    found: list[SensorSignal] = []
    refused: dict[str, TripError] = {}
    for name, signal in read.items():
        try:
            found.append(signal())
        except TripError as error:
            refused[name] = error
    dead = {name: one for name, one in refused.items() if isinstance(one, DeadSensorError)}
    enough = len(read) - len(dead) >= LEAST_SENSORS
    spared = [name for name in dead if enough or partner_of(name) not in ("", *dead)]
    faults = [
        words for name, one in refused.items() if name not in spared for words in one.problems
    ]
    if every := dict.fromkeys([*problems, *faults]):
        raise TripError(*every)
    return found, {name: one.reason for name, one in dead.items()}


def nearly_dead(
    streams: Sequence[SensorSignal], rate_hz: float, loose: Sequence[Fault] = ()
) -> dict[str, str]:
    """Return why sensors are to be left out, by name: too little of them is usable.

    One without a partner is left out only if nothing of it is usable, and enough others are there.
    """
    usable_s = {one.name: np.count_nonzero(~one.touched) / rate_hz for one in streams}
    faults = {one.name: [*one.faults] for one in streams}
    for fault in loose:
        usable_s[fault.channel] -= fault.seconds
        faults[fault.channel].append(fault)
    found: dict[str, str] = {}
    for name, own_s in usable_s.items():
        other_s = usable_s.get(partner_of(name), 0.0)
        can_spare = len(usable_s) - len(found) > LEAST_SENSORS
        if partner_of(name) not in usable_s and can_spare and own_s < LEAST_S:
            other_s = max(usable_s.values())
        if own_s < min(max(FEW_S, FEW_SHARE * other_s), LARGEST_SHARE * other_s):
            listed = together(str(one) for one in faults[name] if not one.repaired)
            if own_s < LEAST_S:
                found[name] = NOTHING
                continue
            kind = "usable-too-short-for" if listed else "usable-too-short"
            found[name] = Finding(kind, own_s=own_s, other_s=other_s, faults=listed)
    return found


def dead_faults(dead: Mapping[str, str], seconds: float, rate_hz: float) -> tuple[Fault, ...]:
    """Return the faults of sensors that are left out, for these reasons, from so long a trip."""
    found = []
    for name, reason in dead.items():
        place, _, side = partner_of(name).rpartition(" ")
        is_alone = place and partner_of(name) not in dead
        kind = "dead-read-alone" if is_alone else "dead-left-out"
        words = Finding(kind, place=place, side=side, reason=reason)
        n = round(seconds * rate_hz)
        found.append(Fault(name, DEAD, n, seconds, 0.0, True, None, words))
    return tuple(found)


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
    for one, other in itertools.combinations(centred, 2):
        products = np.array(
            [(x @ x, y @ y, x @ y) for x, y in zip(centred[one], centred[other], strict=True)]
        ).reshape(-1, 3)
        own, its, shared = products[(products[:, :2] > 0).all(axis=1)].T
        if len(own) and np.median(1 - shared**2 / (own * its)) < SAME:
            gain = float(np.median(shared / own))
            kind = "hold-same-samples" if abs(gain - 1) < SAME else "hold-same-times"
            problems.append(of(where, Finding(kind, one=one, other=other, gain=gain)))
    if problems:
        raise TripError(*problems)
