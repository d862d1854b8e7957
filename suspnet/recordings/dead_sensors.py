"""Dead sensors of pairs: they are left out, and their place is read by the other sensor alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from suspnet.recordings.cleaning import Fault
from suspnet.recordings.errors import DeadSensorError, TripError, all_of
from suspnet.recordings.manifest import TripManifest, partner_of
from suspnet.recordings.sensor import SensorSignal

DEAD = "dead"
"""Kind of the fault of a dead sensor."""
FEW_S, FEW_SHARE = 240.0, 0.1
"""A sensor is left out if less than this duration [s] of it is usable, or than this share of what
is usable of the other one, whichever is longer. Five minutes of both sensors gave estimates as
accurate as twenty minutes of one."""
LEAST_S = 1.0
NOTHING = "shows nothing of the motion that the others show; check its cable and connector"
"""Less than this duration [s] is nothing, and how that is reported."""
LARGEST_SHARE = 0.5
"""It is not left out if more than this share of what is usable of the other one is usable."""


def living(
    manifest: TripManifest,
    read: Mapping[str, Callable[[], SensorSignal]],
    problems: Iterable[str] = (),
) -> tuple[list[SensorSignal], dict[str, str]]:
    """Return the signals of sensors, and why others of pairs have none, by name.

    `read` returns the signal of each sensor. Raises one TripError with `problems` and those of all
    sensors if any has another problem, is single, or is dead as its partner is.
    """
    dead: dict[str, DeadSensorError] = {}

    def signal(name: str) -> SensorSignal | None:
        try:
            return read[name]()
        except DeadSensorError as error:
            partner = partner_of(name)
            if not partner:
                raise
            if partner in dead:
                raise TripError(*dead[partner].problems, *error.problems) from None
            dead[name] = error
            return None

    found = all_of((partial(signal, name) for name in read), problems)
    words = {name: str(one).removeprefix(f"{manifest.where(name)} ") for name, one in dead.items()}
    return [one for one in found if one is not None], words


def nearly_dead(
    streams: Sequence[SensorSignal], rate_hz: float, loose: Sequence[Fault] = ()
) -> dict[str, str]:
    """Return why sensors of pairs are to be left out, by name: too little of them is usable."""
    usable_s = {one.name: np.count_nonzero(~one.touched) / rate_hz for one in streams}
    faults = {one.name: [*one.faults] for one in streams}
    for fault in loose:
        usable_s[fault.channel] -= fault.seconds
        faults[fault.channel].append(fault)
    found = {}
    for name, own_s in usable_s.items():
        other_s = usable_s.get(partner_of(name), 0.0)
        if own_s < min(max(FEW_S, FEW_SHARE * other_s), LARGEST_SHARE * other_s):
            listed = "; ".join(str(one) for one in faults[name] if not one.repaired)
            if own_s < LEAST_S:
                found[name] = NOTHING
                continue
            words = f"is usable for {own_s:.0f} s only, the other one for {other_s:.0f} s"
            found[name] = words + (f" ({listed})" if listed else "")
    return found


def dead_faults(dead: Mapping[str, str], seconds: float, rate_hz: float) -> tuple[Fault, ...]:
    """Return the faults of sensors that are left out, for these reasons, from so long a trip."""
    found = []
    for name, reason in dead.items():
        place, side = partner_of(name).split()
        words = f"and left out, {place} is read by its {side} sensor alone: it {reason}"
        n = round(seconds * rate_hz)
        found.append(Fault(name, DEAD, n, seconds, 0.0, True, None, words))
    return tuple(found)
