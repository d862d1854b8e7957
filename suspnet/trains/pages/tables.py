"""Tables of a suspension's trips and sensors."""

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, together
from suspnet.ground.records import OK, TripResult
from suspnet.ground.wording import files_of
from suspnet.runs.language import N_
from suspnet.trains.maintenance.series import Series


@dataclass(frozen=True)
class TripTable:
    """Arguments of the macro `trip_table` of macros.html.

    `outputs` are parameters, a column each. `halves` are half widths of the intervals by parameter,
    [% of healthy], NaN for none or a flagged trip; `digits` are decimals by parameter.
    `level` is the probability of the intervals, [%], empty if no trip has one.
    """

    trips: tuple[TripResult, ...]
    outputs: tuple[str, ...]
    halves: dict[str, list[float]]
    digits: dict[str, int]
    level: str
    ok: str = OK


def trip_table(trips: Sequence[TripResult], outputs: Sequence[str], level: float) -> TripTable:
    """Return trips as a table, in the order given; `level` is the probability of the intervals."""
    halves = {name: [_half_width(trip, name) for trip in trips] for name in outputs}
    has_intervals = any(math.isfinite(half) for column in halves.values() for half in column)
    digits = {name: interval_digits(column) for name, column in halves.items()}
    text = f"{100 * level:g}" if has_intervals else ""
    return TripTable(tuple(trips), tuple(outputs), halves, digits, text)


def _half_width(result: TripResult, name: str) -> float:
    """Return half an interval, [% of healthy]; NaN if there is none or the trip is flagged."""
    low, high = result.interval(name)
    return math.nan if result.flags else 100 * (high - low) / 2


def interval_digits(half_widths: Sequence[float]) -> int:
    """Return the number of decimals that half widths of intervals, [%], warrant."""
    finite = [half for half in half_widths if math.isfinite(half) and half > 0]
    if not finite:
        return 1
    further = math.ceil(math.log10(0.095 / statistics.median(finite)))
    return 1 + min(max(further, 0), 2)


def sensor_rows(series: Series) -> list[dict[str, Any]]:
    """Return the sensors on the newest trip that has their health, for the macro `sensor_table`.

    They are a factor on the noise, the relative change of the sensitivity, the delay [s] and the
    share of drop-outs; `beyond` tells which of them count.
    """
    rows = []
    for trend in series.sensor_trends:
        places = np.flatnonzero(np.isfinite(trend.values["faulty"]))
        if not len(places):
            continue
        at = int(places[-1])
        change = {name: float(column[at]) for name, column in trend.changes.items()}
        is_armed = any(map(math.isfinite, change.values()))
        beyond = {name: bool(column[at]) for name, column in trend.beyond.items()}
        rows.append(
            {
                "name": trend.name,
                "active": bool(trend.active[at]),
                "words": trend.words(at),
                "state": "as in its first trips" if is_armed else "too few trips to compare",
                "noise": float(trend.values["noise"][at]),
                "times": math.exp(change["noise"]),
                "gain": math.expm1(change["gain"]),
                "delay_s": change["delay_s"],
                "faulty": float(trend.values["faulty"][at]),
                "beyond": beyond | {"times": beyond["noise"]},
            }
        )
    return rows


def files_read_as(results: Sequence[TripResult]) -> dict[str, str]:
    """Return how the files of trips were read, as a detail; empty if nothing had to be detected.

    Files that were read alike share one remark with their number; another remark has that of its
    trips, if these are not all.
    """
    n_trips, n_files = Counter[str](), Counter[str]()
    for result in results:
        files = files_of(result.quality.read_as)
        n_trips.update(files.keys())
        n_files.update(files)
    remarks = []
    for words, n in n_trips.most_common():
        if n_files[words]:
            words = Finding("read-alike", words=words, n=n_files[words])
        elif n < len(results):
            words = Finding("on-trips", words=words, n=n)
        remarks.append(words)
    return {N_("files read as"): together(remarks, " · ")} if remarks else {}
