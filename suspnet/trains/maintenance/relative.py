"""Results of trips with wider intervals, or relative to the first commissioning."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from suspnet.ground.records import Commissioning, TripResult
from suspnet.trains.maintenance.series import Event, series_of


def with_widened(results: Sequence[TripResult], events: Sequence[Event]) -> list[TripResult]:
    """Return results with the intervals of ``Series.widened``."""
    if not results:
        return []
    # nothing depends on starts, and those of a store may be unreadable
    series = series_of([replace(result, start="") for result in results], events)
    order = np.lexsort(([r.trip for r in results], [r.mileage_km for r in results]))
    widths = series.half_widths
    return [
        replace(
            result,
            half_widths={
                name: float(widths[name][row]) if name in widths else width
                for name, width in result.half_widths.items()
            },
        )
        for row, result in zip(np.argsort(order), results, strict=True)
    ]


def relative_to_first_healthy(
    results: Sequence[TripResult], commissionings: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results with estimates and truth relative to those of the first commissioning."""
    factors = {state.since_km: state.relative for state in commissionings}

    def times(values: Mapping[str, float], since_km: float) -> dict[str, float]:
        of_healthy = factors.get(since_km, {})
        return {name: value * of_healthy.get(name, 1.0) for name, value in values.items()}

    return [
        replace(
            r,
            estimates=times(r.estimates, r.healthy_since_km),
            truth=times(r.truth, r.healthy_since_km),
        )
        for r in results
    ]
