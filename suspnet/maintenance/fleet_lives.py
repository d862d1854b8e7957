"""Present values and remaining lives of a suspension, the same ones for report, overview and plan.

All of them take the trips as a ``Series``, whether these were just read or come from a history.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from suspnet.dynamics import PARAMETERS
from suspnet.ground.types import FloatArray
from suspnet.history import Event, Series
from suspnet.history.records import TripResult
from suspnet.history.series import utc
from suspnet.maintenance.degradation import FleetPrior
from suspnet.maintenance.forecast import remaining_lives, trips_of_life, why_unknown
from suspnet.maintenance.life import Life, learn_fleet
from suspnet.maintenance.limits import N_LAST, Limits

MOST_LEARNT = 200
"""Largest number of suspensions from which a fleet's rates of wear are learnt, evenly chosen."""
ALONE = "by this suspension alone, as no other of its vehicle shows how fast its kind wears"
NO_STORE = "; with those of a history (store=) the plan of a fleet may give other ones"
ONE_FLAGGED = "the only trip is flagged"


def series_of(results: Sequence[TripResult], events: Sequence[Event] = ()) -> Series:
    """Return the trips of one suspension, at least one, as arrays by mileage."""
    trips = sorted(results, key=lambda r: (np.isnan(r.mileage_km), r.mileage_km, r.trip))
    first = trips[0]

    def column(values: Iterable[float]) -> FloatArray:
        return np.array(list(values), dtype=float)

    return Series(
        first.vehicle,
        first.place,
        np.array([r.trip for r in trips], dtype=str),
        np.array([utc(r.start) for r in trips], dtype="datetime64[s]"),
        np.array([bool(r.flags) for r in trips]),
        column(r.mileage_km for r in trips),
        column(r.healthy_since_km for r in trips),
        column(r.quality.speed_m_per_s for r in trips),
        column(r.temperature_c for r in trips),
        {name: column(r.estimates.get(name, np.nan) for r in trips) for name in PARAMETERS},
        {name: column(r.half_widths.get(name, np.nan) for r in trips) for name in PARAMETERS},
        tuple(events),
    )


def present(series: Series, name: str) -> float:
    """Return a parameter now, [-]: the median of the last ``N_LAST`` trips with an estimate.

    These are trips since the last commissioning and maintenance, flagged ones too; NaN: none.
    """
    values = series.estimates[name][series.recent & np.isfinite(series.mileage_km)]
    known = values[np.isfinite(values)][-N_LAST:]
    return float(np.median(known)) if len(known) else np.nan


def unjudged(series: Series) -> str:
    """Return why a suspension cannot be judged by its last trips; empty if it can be."""
    flagged = series.flagged[series.recent & series.done][-N_LAST:]
    if not len(flagged):
        return "no trip with an estimate"
    if not flagged.all():
        return ""
    return f"all of the last {len(flagged)} trips are flagged" if len(flagged) > 1 else ONE_FLAGGED


def unknown_lives(series: Series, names: Iterable[str]) -> dict[str, str]:
    """Return the parameters whose remaining life is unknown, or not to be relied on, and why.

    That is so if there are too few trips, or if the suspension cannot be judged now.
    """
    used, whole = series.recent, unjudged(series)
    reasons = {
        name: whole
        or why_unknown(
            series.mileage_km[used],
            series.estimates[name][used],
            series.half_widths[name][used],
            series.flagged[used],
        )
        for name in names
    }
    return {name: why for name, why in reasons.items() if why}


def learn_priors(fleet: Sequence[Series], limits: Iterable[str]) -> dict[str, FleetPrior]:
    """Return what the suspensions of one vehicle show together of each parameter with limits."""
    found = {}
    for name in limits:
        trips = [
            trips_of_life(
                one.mileage_km[one.recent],
                one.estimates[name][one.recent],
                one.half_widths[name][one.recent],
                one.flagged[one.recent],
            )
            for one in fleet
        ]
        known = [one for one in trips if one is not None]
        if len(known) > 1:
            every = -(-len(known) // MOST_LEARNT)
            found[name] = learn_fleet(known[::every])
    return found


@dataclass(frozen=True, eq=False)
class Wear:
    """Rates of wear that suspensions of a vehicle show together, and which suspensions these are.

    Attributes
    ----------
    priors : mapping of FleetPrior
        Of each parameter; empty if fewer than two suspensions show any.
    words : str
    """

    priors: Mapping[str, FleetPrior] = field(default_factory=dict)
    words: str = ALONE


def learn_wear(fleet: Sequence[Series], limits: Iterable[str], is_history: bool) -> Wear:
    """Return how fast the suspensions of one vehicle wear, those of a history or those at hand."""
    priors = learn_priors(fleet, limits)
    of_fleet = f"with the rates of wear of {len(fleet)} suspensions"
    words = f"{of_fleet} of {'the history' if is_history else 'this folder'}" if priors else ALONE
    return Wear(priors, words if is_history else words + NO_STORE)


def lives_of(
    series: Series,
    limits: Mapping[str, Limits],
    passed: Iterable[str],
    fleet: Mapping[str, FleetPrior],
    seed: int,
) -> dict[str, Life]:
    """Return the remaining life of each parameter with limits; `passed` are beyond theirs."""
    used = series.recent
    return remaining_lives(
        series.mileage_km[used],
        {name: column[used] for name, column in series.estimates.items()},
        {name: column[used] for name, column in series.half_widths.items()},
        series.flagged[used],
        limits,
        set(passed),
        fleet,
        seed,
    )
