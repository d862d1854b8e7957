"""Values for the page templates: trains with their cars, alarms, one suspension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from suspnet.ground.findings import of
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, PARAMETERS, Severity
from suspnet.ground.records import INTERVAL_LEVEL, TripResult, outputs_of
from suspnet.ground.wording import natural
from suspnet.history.arrays import TripResponses
from suspnet.maintenance.alarms import Acknowledgement, Alarm, newest_of
from suspnet.maintenance.plan import place_of
from suspnet.maintenance.schedule import joined
from suspnet.maintenance.state import State
from suspnet.report.bogie import bogie_of, bogies_shown, small_figures, why_no_part
from suspnet.report.language import spoken
from suspnet.report.overview import FleetView, finding
from suspnet.report.tables import files_read_as, response, response_table, sensor_rows, trip_table
from suspnet.report.trend import ranges, trend_of_state

MOST_ROWS = 50
"""Largest number of rows of a table of the fleet, unless all are requested."""
MOST_JOBS = 10
"""Largest number of jobs on the page of the fleet; the page of the plan has all."""
OUTPUTS = tuple(name for name in PARAMETERS if name != BODY_MASS)
SHORT = {"leading": "lead.", "trailing": "trail."}
"""Short words of a place, for a tile."""


@dataclass(frozen=True)
class Choice:
    """Which suspensions are shown; an empty `train` or `severity` chooses all."""

    train: str = ""
    severity: str = ""

    def holds(self, state: State) -> bool:
        """Return whether a suspension is chosen."""
        is_there = not self.train or state.series.place.train == self.train
        return is_there and (not self.severity or str(state.severity) == self.severity)

    @property
    def arguments(self) -> dict[str, str]:
        """The choice as arguments of a URL."""
        given = {"train": self.train, "severity": self.severity}
        return {name: value for name, value in given.items() if value}


@dataclass(frozen=True)
class Tile:
    """One suspension on the page: its name in URLs, severity, short text and reason."""

    name: str
    severity: str
    words: str
    reason: str


@dataclass(frozen=True)
class Train:
    """A train with the tiles of each of its cars."""

    name: str
    cars: dict[str, list[Tile]] = field(default_factory=dict)


@dataclass(frozen=True)
class Raised:
    """An active alarm, its suspension, and who acknowledged it."""

    name: str
    state: State
    alarm: Alarm
    seen: Acknowledgement | None


def trains_of_view(view: FleetView, choice: Choice) -> list[Train]:
    """Return the trains with the chosen suspensions, in natural order of their names."""
    of_fleet = {state.series.place.suspension for state in view.states}
    found: dict[str, Train] = {}
    several = zip(view.names, view.states, view.rows, strict=True)
    for name, state, row in sorted(several, key=lambda one: _place_order(one[1])):
        if choice.holds(state):
            place = state.series.place
            train = found.setdefault(place.train, Train(place.train))
            train.cars.setdefault(place.car, []).append(_tile(name, state, row, len(of_fleet) > 1))
    return list(found.values())


def train_names(view: FleetView) -> list[str]:
    """Return the trains of the fleet that have a name."""
    return sorted({s.series.place.train for s in view.states} - {""}, key=natural)


def counts(view: FleetView, train: str) -> dict[str, int]:
    """Return how many suspensions of a train, or of all, have each severity, worst first."""
    chosen = Choice(train)
    severities = [state.severity for state in view.states if chosen.holds(state)]
    return {str(one): severities.count(one) for one in sorted(Severity, reverse=True)}


def raised(view: FleetView, choice: Choice) -> list[Raised]:
    """Return the active alarms, the worst first, those not yet acknowledged before others."""
    found = [
        Raised(name, state, alarm, newest_of(alarm, view.acknowledged.get(state.key, ())))
        for name, state in zip(view.names, view.states, strict=True)
        if choice.holds(state)
        for alarm in state.alarms
    ]
    return sorted(found, key=lambda one: (-one.alarm.severity, one.seen is not None))


def rows_of(view: FleetView, indices: Sequence[int], address: Any) -> list[dict[str, Any]]:
    """Return rows of the overview with the address of each suspension's page."""
    return [view.rows[i] | {"address": address(view.names[i])} for i in indices]


def jobs_of(view: FleetView, choice: Choice, address: Any) -> list[dict[str, Any]]:
    """Return the jobs of the plan for the chosen suspensions, with their addresses."""
    if view.plan is None:
        return []
    known = {
        place_of(state): name
        for name, state in zip(view.names, view.states, strict=True)
        if choice.holds(state)
    }
    jobs = [
        (known.get((job["train"], job["car"], job["suspension"])), job)
        for job in joined(view.plan.rows())
    ]
    return [job | {"address": address(name)} for name, job in jobs if name]


def _place_order(state: State) -> tuple[Any, ...]:
    place = state.series.place
    parts = (place.train, place.car, place.suspension, place.bogie, place.side)
    return (*map(natural, parts), state.series.vehicle)


def _tile(name: str, state: State, row: dict[str, Any], with_suspension: bool) -> Tile:
    place = state.series.place
    parts = [place.suspension] if with_suspension or not (place.bogie or place.side) else []
    where = " ".join(SHORT.get(p, p) for p in (place.bogie, place.side) if p)
    words = " ".join(filter(None, (*parts, spoken(where))))
    why = of(row["parameter"], row["reason"]) if row["parameter"] else row["reason"]
    return Tile(name, str(state.severity), words or state.series.vehicle, why)


def fleet_values(view: FleetView, choice: Choice, all_rows: bool, address: Any) -> dict[str, Any]:
    """Return the values for the template of the fleet; `address` gives a suspension's URL."""
    chosen = [i for i, state in enumerate(view.states) if choice.holds(state)]
    alarms, jobs = raised(view, choice), jobs_of(view, choice, address)
    most = None if all_rows else MOST_ROWS
    return {
        "finding": finding([view.rows[i] for i in chosen]),
        "choice": choice,
        "train_names": train_names(view),
        "counts": counts(view, choice.train),
        "trains": trains_of_view(view, choice),
        "alarms": alarms[:most],
        "n_alarms": len(alarms),
        "rows": rows_of(view, chosen[:most], address),
        "n_rows": len(chosen),
        "parameters": OUTPUTS,
        "plan": view.plan,
        "jobs": jobs[:MOST_JOBS],
        "n_jobs": len(jobs),
        "address": address,
        **bogies_shown(view, chosen),
    }


N_TRIPS = 20
"""Number of the newest trips in the table."""


def suspension_values(
    view: FleetView,
    index: int,
    results: Sequence[TripResult],
    stored: Sequence[TripResponses],
    seen: Sequence[Acknowledgement],
    address: Callable[[str], str],
) -> dict[str, Any]:
    """Return the values for the template of a suspension.

    `index` is that of its state in the view; `results` (empty if the store cannot be read) and
    `stored` are by mileage; `address` gives the URL of the trend of one parameter.
    """
    state = view.states[index]
    cleared = [one for one in state.watched.alarms if not one.is_open]
    newest = list(reversed(results[-N_TRIPS:]))
    drawn = trend_of_state(state)
    of_parts = [one.name for one in drawn.panels if one.name in BOGIE_PARTS]
    small = {one.name: address(one.name) for one in drawn.panels} if of_parts else {}
    responses = [response(one.trip, one.mileage_km, one) for one in stored]
    return {
        "state": state,
        "parameters": [name for name in state.outputs if name != BODY_MASS],
        "row": view.rows[index],
        "limits": state.limits,
        "bogie": bogie_of(state, view.plan),
        "no_part": why_no_part(results, state.outputs),
        "small": small_figures(state, small),
        "names": NAMES,
        "alarms": [(one, newest_of(one, seen)) for one in state.alarms],
        "cleared": [(one, newest_of(one, seen)) for one in reversed(cleared)],
        "ranges": ranges(drawn),
        "trips": trip_table(newest, outputs_of(newest), INTERVAL_LEVEL),
        "read_as": files_read_as(newest),
        "n_trips": len(state.series.trip),
        "first_km": _end(state.series.mileage_km, np.min),
        "newest_km": _end(state.series.mileage_km, np.max),
        "sensors": sensor_rows(state.series),
        "responses": responses,
        "gains": response_table(responses[0], responses[-1]) if responses else [],
    }


def _end(mileage_km: Any, of: Any) -> float:
    """Return the smallest or largest known mileage, [km]; NaN if none is known."""
    known = mileage_km[np.isfinite(mileage_km)]
    return float(of(known)) if len(known) else np.nan
