"""Dead sensors of a suspension, from the faults of its trips."""

from __future__ import annotations

import re
from collections.abc import Sequence

from suspnet.ground.records import TripResult
from suspnet.ground.wording import count

LISTED = 5
"""Largest number of trips that are listed for a dead sensor."""
DEAD = re.compile(r"(?:^|; )([\w ]+: dead and left out.*?)(?=; [a-z_]+(?: [\w ]+)?: |$)")
"""A dead sensor with what is known of it, among the faults of a trip."""


def dead_sensors(results: Sequence[TripResult]) -> dict[str, list[str]]:
    """Return what is known of each dead sensor, with the names of its trips.

    Examples
    --------
    >>> from suspnet.ground.records import Quality
    >>> quality = Quality(faults="body right: dead and left out (constant); speed: 2 spikes")
    >>> dead_sensors([TripResult("trip_1", "trip_1.yaml", quality=quality)])
    {'body right: dead and left out (constant)': ['trip_1']}
    """
    trips: dict[str, list[str]] = {}
    for result in results:
        for words in DEAD.findall(result.quality.faults):
            whole = words if words.count("(") == words.count(")") else words.rpartition(" (")[0]
            trips.setdefault(whole, []).append(result.trip)
    return trips


def dead_words(results: Sequence[TripResult]) -> str:
    """Return the sensors that are dead on the newest trip that has any, as text; empty if none.

    `results` are in the order of the mileage. A sensor that was replaced since is not named.
    """
    newest = [one for one in results if one.quality.faults or one.estimates][-1:]
    found = dead_sensors(newest)
    names = [words.partition(": ")[0] for words in found]
    if not names:
        return ""
    n_trips = sum(bool(DEAD.search(one.quality.faults)) for one in results)
    of = f"{n_trips} of {count(len(results), 'trip')}"
    return f"dead and left out: {', '.join(names)} (on {of})"
