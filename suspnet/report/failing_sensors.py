"""Dead and failing sensors of a suspension, from its trips."""

from __future__ import annotations

import re
from collections.abc import Sequence

from suspnet.ground.parameters import Cause
from suspnet.ground.records import TripResult, sensors_from_text
from suspnet.ground.wording import count
from suspnet.maintenance.judge import N_LAST
from suspnet.maintenance.state import State

LISTED = 5
"""Largest number of trips that are listed for a failing sensor."""
FAILING = re.compile(
    r"(?:^|; )([\w ]+: (?:dead and left out|loose from).*?)(?=; [a-z_]+(?: [\w ]+)?: |$)"
)
"""A dead or loose sensor with what is known of it, among the faults of a trip."""
DEAD = ": dead and left out"
LOST = re.compile(r"parts are read without the sensors of ([^;]+)")
"""The sensors without which the parts of a trip are read, among its warnings."""


def failing_sensors(results: Sequence[TripResult]) -> dict[str, list[str]]:
    """Return what is known of each sensor that is dead, loose or left out of a trip's parts.

    With it are the names of its trips.

    Examples
    --------
    >>> from suspnet.ground.records import Quality
    >>> quality = Quality(faults="body right: dead and left out (constant); speed: 2 spikes")
    >>> failing_sensors([TripResult("trip_1", "trip_1.yaml", quality=quality)])
    {'body right: dead and left out (constant)': ['trip_1']}
    """
    trips: dict[str, list[str]] = {}
    for result in results:
        own = FAILING.findall(result.quality.faults)
        for words in own:
            whole = words if words.count("(") == words.count(")") else words.rpartition(" (")[0]
            trips.setdefault(whole, []).append(result.trip)
        # a sensor whose faults would break a trip up is left out of its parts alone
        for words in LOST.findall(result.quality.warnings):
            for name in words.split(", "):
                if not any(one.startswith(f"{name}: ") for one in own):
                    trips.setdefault(f"{name}: not used for the parts", []).append(result.trip)
    return trips


def dead_words(results: Sequence[TripResult]) -> str:
    """Return the sensors that are dead on the newest trip that has any, as text; empty if none.

    `results` are in the order of the mileage. A sensor that was replaced since is not named.
    """
    newest = [one for one in results if one.quality.faults or one.estimates][-1:]
    names = [words.partition(":")[0] for words in failing_sensors(newest) if DEAD in words]
    return _left_out(names, sum(DEAD in r.quality.faults for r in results), len(results))


def failing_words(results: Sequence[TripResult]) -> str:
    """Return ``dead_words``, or the sensors that failed on one of the last trips, as text."""
    if words := dead_words(results):
        return words
    last = results[-N_LAST:]
    names = dict.fromkeys(words.partition(":")[0] for words in failing_sensors(last))
    n = sum(bool(failing_sensors([one])) for one in last)
    of = f" (on {n} of the last {len(last)} trips)" if len(last) > 1 else ""
    return f"dead, loose or not used: {', '.join(names)}{of}" if n else ""


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
    return "; ".join(filter(None, [_left_out(dead, n_dead, len(texts)), *alarms]))


def _dead_in(text: str) -> list[str]:
    """Return the dead sensors of a trip from ``Quality.sensors``."""
    return [name for name, one in sensors_from_text(text).items() if one.faulty >= 1]


def _left_out(names: Sequence[str], n_dead: int, n_trips: int) -> str:
    """Return the names of dead sensors as text, with the number of trips that have any."""
    of = f"{n_dead} of {count(n_trips, 'trip')}"
    return f"dead and left out: {', '.join(names)} (on {of})" if names else ""
