"""Trips as a table, and sentences on several of them."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from suspnet.ground.records import OK, TripResult
from suspnet.ground.wording import count


@dataclass(frozen=True)
class TripTable:
    """Arguments of the macro `trip_table` of macros.html.

    `trips` are in the order of the rows; `outputs` are parameters, a column each. `halves` are half
    widths of the intervals by parameter, [% of healthy], NaN for none or a flagged trip; `digits`
    are decimals by parameter. `level` is the probability of the intervals, [%], empty if no trip
    has one.
    """

    trips: tuple[TripResult, ...]
    outputs: tuple[str, ...]
    halves: dict[str, list[float]]
    digits: dict[str, int]
    level: str
    ok: str = OK


def trip_table(trips: Sequence[TripResult], outputs: Sequence[str], level: float) -> TripTable:
    """Return trips as a table, in the order given; `level` is the probability of the intervals."""
    halves = {name: [_half_width(one, name) for one in trips] for name in outputs}
    known = any(math.isfinite(half) for column in halves.values() for half in column)
    digits = {name: _digits(column) for name, column in halves.items()}
    words = f"{100 * level:g}" if known else ""
    return TripTable(tuple(trips), tuple(outputs), halves, digits, words)


def _half_width(result: TripResult, name: str) -> float:
    """Return half an interval, [% of healthy]; NaN if there is none or the trip is flagged."""
    low, high = result.interval(name)
    return math.nan if result.flags else 100 * (high - low) / 2


def _digits(half_widths: Sequence[float]) -> int:
    known = [half for half in half_widths if math.isfinite(half) and half > 0]
    if not known:
        return 1
    further = math.ceil(math.log10(0.095 / statistics.median(known)))
    return 1 + min(max(further, 0), 2)


def files_read_as(results: Sequence[TripResult]) -> dict[str, str]:
    """Return how the files of trips were read, as a detail; empty if nothing had to be detected.

    Trips that were read alike share one remark, with their number if others were not.
    """
    counts = Counter(r.quality.read_as for r in results if r.quality.read_as)
    if not counts:
        return {}
    remarks = [
        words if n == len(results) else f"{words} ({count(n, 'trip')})"
        for words, n in counts.most_common()
    ]
    return {"files read as": " · ".join(remarks)}
