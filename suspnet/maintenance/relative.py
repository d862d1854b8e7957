"""Results of trips relative to the first trips, or to the first commissioning."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.ground.parameters import BODY_MASS
from suspnet.ground.records import OK, SENSOR, Commissioning, TripResult, by_mileage
from suspnet.maintenance.series import Event, half_width_of_median, series_of


def between(events: Sequence[Event], results: Sequence[TripResult]) -> list[list[TripResult]]:
    """Return the trips before, between and after maintenance; those without a mileage are after.

    The n_events + 1 lists are in the order of the mileage; some may be empty.
    """
    ends = sorted(event.mileage_km for event in events if event.kind != SENSOR)
    found: list[list[TripResult]] = [[] for _ in range(len(ends) + 1)]
    for result in results:
        unknown = np.isnan(result.mileage_km)
        found[len(ends) if unknown else bisect_right(ends, result.mileage_km)].append(result)
    return found


def first_trips(results: Iterable[TripResult], n_first: int) -> list[TripResult]:
    """Return the `n_first` trips of least mileage with an estimate, or as many as there are.

    Flagged trips are included: a vehicle unlike the model's is so from the first trip on.
    """
    return by_mileage(r for r in results if r.status == OK)[:n_first]


def relative_to_first(results: list[TripResult], n_first: int) -> list[TripResult]:
    """Return results whose k and c are relative to the median of the vehicle's first trips.

    The truth, where known, is treated alike. The interval widens by the uncertainty of the median,
    whose variance is pi / 2 times that of a mean of `n_first` trips. This is right for noise;
    systematic errors (of a regression without refinement) cancel only while the vehicle does not
    change. The car-body mass stays relative to nominal, as it varies by nature.
    If fewer trips have an estimate, all of these are used.
    """
    done = first_trips(results, len(results))
    names = dict.fromkeys(name for r in done for name in r.raw if name != BODY_MASS)
    # not every trip has all parts of a bogie
    first = {name: [r for r in done if name in r.raw][:n_first] for name in names}
    estimated = {name: _median(r.raw[name] for r in own) for name, own in first.items()}
    known = {name: [r for r in own if name in r.truth] for name, own in first.items()}
    true = {name: _median(r.truth[name] for r in own) for name, own in known.items() if own}
    reference = {
        name: half_width_of_median([r.half_widths.get(name, np.nan) for r in own])
        for name, own in first.items()
    }
    return [
        replace(
            r,
            estimates=divided(r.raw, estimated),
            truth=divided(r.truth, true),
            half_widths={
                k: float(np.hypot(h, reference.get(k, 0.0))) for k, h in r.half_widths.items()
            },
        )
        for r in results
    ]


def relative_results(
    results: list[TripResult], events: Sequence[Event], n_first: int | None
) -> list[TripResult]:
    """Return results relative to the first trips after each maintenance; None: to the model.

    Their intervals are ``Series.widened``.
    """
    if not results:
        return results
    # intervals do not depend on starts, and those of a store may be unreadable
    columns = series_of([replace(one, start="") for one in results], events).half_widths
    rows = np.argsort(np.lexsort(([r.trip for r in results], [r.mileage_km for r in results])))
    results = [
        replace(one, half_widths={name: float(columns[name][row]) for name in one.half_widths})
        for row, one in zip(rows, results, strict=True)
    ]
    if n_first is None:
        return results
    return [one for part in between(events, results) for one in relative_to_first(part, n_first)]


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))


def medians(values: Sequence[Mapping[str, float]], names: Iterable[str]) -> dict[str, float]:
    """Return the median of each name over several mappings; empty if there are none."""
    return {name: float(np.median([v[name] for v in values])) for name in names if values}


def divided(values: Mapping[str, float], by: Mapping[str, float]) -> dict[str, float]:
    """Return values divided by those of another mapping, by 1 where it has none."""
    return {name: value / by.get(name, 1.0) for name, value in values.items()}


def relative_to_first_healthy(
    results: Sequence[TripResult], found: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results relative to the healthy values of the first commissioning."""
    factors = {one.since_km: one.relative for one in found}
    return [_times(r, factors.get(r.healthy_since_km, {})) for r in results]


def _times(result: TripResult, factors: dict[str, float]) -> TripResult:
    """Return a result with estimates and truth multiplied by factors; a missing factor is 1."""
    estimates, truth = (
        {name: value * factors.get(name, 1.0) for name, value in part.items()}
        for part in (result.estimates, result.truth)
    )
    return replace(result, estimates=estimates, truth=truth)
