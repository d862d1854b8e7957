"""What the last trips say of the two sides of a suspension, in words."""

from __future__ import annotations

from collections.abc import Sequence

from suspnet.history.records import OK, TripResult
from suspnet.maintenance.limits import N_LAST


def sides_finding(trips: Sequence[TripResult]) -> str:
    """Return a sentence on the sides for the report, from the last trips; empty without finding.

    Parameters
    ----------
    trips : sequence of TripResult
        In the order of the mileage.
    """
    last = [r for r in trips if r.status == OK][-N_LAST:]
    told = [r for r in last if r.sides]
    if not told:
        return ""
    trips_are = f"{len(told)} of the last {len(last)} trips" if len(last) > 1 else "the last trip"
    return (
        f"Left and right differ on {trips_are}; on {told[-1].trip}: {told[-1].sides}. An estimate "
        "is the mean of both sides. Sensors of a pair that differ in place or sensitivity, and a "
        "track with one rail worse than the other, can look alike: compare several trips."
    )
