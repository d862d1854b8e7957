"""Results of trips relative to the first trips, or to the first commissioning."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.ground.records import OK, Commissioning, TripResult, by_mileage
from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance.series import Event, series_of


def first_trips(results: Iterable[TripResult], n_first: int) -> list[TripResult]:
    """Return the `n_first` trips of least mileage with an estimate, or as many as there are.

    Flagged trips are included: a vehicle unlike the model's is so from the first trip on.
    """
    return by_mileage(r for r in results if r.status == OK)[:n_first]


def relative_results(
    results: Sequence[TripResult], events: Sequence[Event], n_first: int | None
) -> list[TripResult]:
    """Return results as ``Series.relative_to_first`` does, with ``Series.widened`` intervals.

    The truth of simulated trips is treated like the estimates.
    """
    if not results:
        return []
    if n_first is not None:
        results = [replace(result, estimates=result.raw) for result in results]
    # nothing depends on starts, and those of a store may be unreadable
    series = series_of([replace(result, start="") for result in results], events)
    order = np.lexsort(([r.trip for r in results], [r.mileage_km for r in results]))
    truths = {
        name: np.array([results[i].truth.get(name, np.nan) for i in order])
        for name in series.estimates
    }
    relative = series.relative_to_first(n_first)
    truth = replace(series, estimates=truths).relative_to_first(n_first).estimates

    def of_trip(
        row: int, values: Mapping[str, float], columns: Mapping[str, FloatArray]
    ) -> dict[str, float]:
        own = {name: float(columns[name][row]) for name in values if name in columns}
        return {**values, **own}

    return [
        replace(
            result,
            estimates=of_trip(row, result.estimates, relative.estimates),
            half_widths=of_trip(row, result.half_widths, relative.half_widths),
            truth=of_trip(row, result.truth, truth),
        )
        for row, result in zip(np.argsort(order), results, strict=True)
    ]


def medians(values: Sequence[Mapping[str, float]], names: Iterable[str]) -> dict[str, float]:
    """Return the median of each name over several mappings; empty if there are none."""
    return {name: float(np.median([v[name] for v in values])) for name in names if values}


def divided(values: Mapping[str, float], by: Mapping[str, float]) -> dict[str, float]:
    """Return values divided by those of another mapping, by 1 where it has none."""
    return {name: value / by.get(name, 1.0) for name, value in values.items()}


def relative_to_first_healthy(
    results: Sequence[TripResult], commissionings: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results with estimates and truth relative to those of the first commissioning."""
    factors = {state.since_km: state.relative for state in commissionings}

    def times(values: Mapping[str, float], since_km: float) -> dict[str, float]:
        own = factors.get(since_km, {})
        return {name: value * own.get(name, 1.0) for name, value in values.items()}

    return [
        replace(
            r,
            estimates=times(r.estimates, r.healthy_since_km),
            truth=times(r.truth, r.healthy_since_km),
        )
        for r in results
    ]
