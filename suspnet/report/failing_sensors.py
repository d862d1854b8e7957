"""Dead and failing sensors of a suspension, from its trips."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from suspnet.ground.findings import (
    OF,
    WITHOUT_SENSORS,
    Finding,
    at,
    kind_is,
    parts_of,
    together,
)
from suspnet.ground.parameters import Cause
from suspnet.ground.records import TripResult, sensors_from_text
from suspnet.maintenance.series import N_LAST
from suspnet.maintenance.state import State

LISTED = 5
"""Largest number of trips that are listed for a failing sensor."""
DEAD = "dead-left-out", "dead-read-alone", "dead-before"
"""Kinds of the faults of a sensor that shows nothing."""
FAILING = *DEAD, "loose", "loose-of-pair", "loose-before"


def _failing(result: TripResult, kinds: Collection[str] = FAILING) -> dict[str, Finding]:
    """Return the faults of some kinds of a trip, by the name of the sensor."""
    several = parts_of(result.quality.faults)
    faults = ((one.values["name"], one) for one in several if kind_is(one, OF))
    return {name: one for name, one in faults if getattr(one.values["words"], "kind", "") in kinds}


def failing_sensors(results: Sequence[TripResult]) -> dict[str, list[str]]:
    """Return what is known of each sensor that is dead, loose or left out of a trip's parts.

    With it are the names of its trips.
    """
    trips: dict[str, list[str]] = {}
    for result in results:
        own = _failing(result)
        # a sensor whose faults would break a trip up is left out of its parts alone
        left_out = (
            name
            for one in parts_of(result.quality.warnings)
            if kind_is(one, WITHOUT_SENSORS)
            for name in one.values["names"]
        )
        unused = {name: at(name, "not-used-for-parts") for name in left_out}
        for words in (own | {name: unused[name] for name in unused if name not in own}).values():
            trips.setdefault(words, []).append(result.trip)
    return trips


def dead_words(results: Sequence[TripResult]) -> str:
    """Return the sensors that are dead on the newest trip that has any, as text; empty if none.

    `results` are in the order of the mileage. A sensor that was replaced since is not named.
    """
    newest = [one for one in results if one.quality.faults or one.estimates][-1:]
    names = [name for one in newest for name in _failing(one, DEAD)]
    return _left_out(names, sum(bool(_failing(one, DEAD)) for one in results), len(results))


def failing_words(results: Sequence[TripResult]) -> str:
    """Return ``dead_words``, or the sensors that failed on one of the last trips, as text."""
    if words := dead_words(results):
        return words
    last = results[-N_LAST:]
    found = [one for one in failing_sensors(last) if isinstance(one, Finding)]
    names = dict.fromkeys(one.values["name"] for one in found)
    n = sum(bool(failing_sensors([one])) for one in last)
    kind = "dead-or-loose-on" if len(last) > 1 else "dead-or-loose"
    return Finding(kind, names=_listed(names), n=n, n_last=len(last)) if n else ""


def sensor_words(state: State) -> str:
    """Return the dead sensors of a stored suspension and those with an alarm; empty if none.

    A sensor without a usable sample on the newest trip, by its share of drop-outs, is dead.
    """
    texts = [] if state.series.sensors is None else [*filter(None, state.series.sensors.tolist())]
    dead = [] if not texts else _dead_in(texts[-1])
    n_dead = sum(bool(_dead_in(text)) for text in texts) if dead else 0
    alarms = [
        one.words for one in state.alarms if one.cause == Cause.SENSOR and one.parameter not in dead
    ]
    return together([_left_out(dead, n_dead, len(texts)), *alarms])


def _dead_in(text: str) -> list[str]:
    """Return the dead sensors of a trip from ``Quality.sensors``."""
    return [name for name, one in sensors_from_text(text).items() if one.faulty >= 1]


def _left_out(names: Sequence[str], n_dead: int, n_trips: int) -> str:
    """Return the names of dead sensors as text, with the number of trips that have any."""
    if not names:
        return ""
    trips = Finding("trips", n=n_trips)
    return Finding("dead-on-trips", names=_listed(names), n=n_dead, trips=trips)


def _listed(names: Iterable[str]) -> str:
    return together((Finding("sensor-name", name=name) for name in names), ", ")
