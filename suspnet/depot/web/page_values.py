"""Values for the page templates: trains with their cars, alarms, one suspension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from suspnet.ground.findings import of
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, PARAMETERS, Severity
from suspnet.ground.records import INTERVAL_LEVEL, TripResult, outputs_of
from suspnet.ground.wording import natural
from suspnet.runs.language import spoken
from suspnet.trains.history.arrays import TripResponses
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, newest_of
from suspnet.trains.maintenance.plan import joined, place_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.bogie import bogie_of, bogies_shown, small_figures, why_no_part
from suspnet.trains.pages.overview import FleetView, finding
from suspnet.trains.pages.tables import files_read_as, sensor_rows, trip_table
from suspnet.trains.pages.trend import ranges, trend_of_state

MAX_ROWS = 50  # largest number of rows of a table of the fleet, unless all are requested
MAX_JOBS = 10  # largest number of jobs on the page of the fleet; the page of the plan has all
N_TRIPS = 20  # number of the newest trips in the table of a suspension
OUTPUTS = tuple(name for name in PARAMETERS if name != BODY_MASS)
SHORT = {"leading": "lead.", "trailing": "trail."}  # short words of a place, for a tile


@dataclass(frozen=True)
class Choice:
    """Which suspensions are shown; an empty `train` or `severity` chooses all."""

    train: str = ""
    severity: str = ""

    def holds(self, state: State) -> bool:
        """Return whether a suspension is chosen."""
        is_of_train = self.train in ("", state.series.place.train)
        return is_of_train and self.severity in ("", str(state.severity))

    @property
    def arguments(self) -> dict[str, str]:
        """The choice as arguments of a URL."""
        return {name: value for name, value in vars(self).items() if value}


class Tile(NamedTuple):
    """One suspension on the page: its name in URLs, severity, short text and reason."""

    name: str
    severity: str
    words: str
    reason: str


class RaisedAlarm(NamedTuple):
    """An active alarm, its suspension, and who acknowledged it."""

    name: str
    state: State
    alarm: Alarm
    seen: Acknowledgement | None


def tiles_of_trains(view: FleetView, choice: Choice) -> dict[str, dict[str, list[Tile]]]:
    """Return the tiles of the chosen suspensions by train and car, in natural order of names."""
    is_named = len({state.series.place.suspension for state in view.states}) > 1
    trains: dict[str, dict[str, list[Tile]]] = {}
    entries = zip(view.names, view.states, view.rows, strict=True)
    for name, state, row in sorted(entries, key=lambda entry: _place_order(entry[1])):
        if choice.holds(state):
            place = state.series.place
            tiles = trains.setdefault(place.train, {}).setdefault(place.car, [])
            tiles.append(_tile(name, state, row, is_named))
    return trains


def train_names(view: FleetView) -> list[str]:
    """Return the trains of the fleet that have a name."""
    return sorted({state.series.place.train for state in view.states} - {""}, key=natural)


def counts(view: FleetView, train: str) -> dict[str, int]:
    """Return how many suspensions of a train, or of all, have each severity, worst first."""
    chosen = Choice(train)
    severities = [state.severity for state in view.states if chosen.holds(state)]
    return {str(level): severities.count(level) for level in sorted(Severity, reverse=True)}


def raised(view: FleetView, choice: Choice) -> list[RaisedAlarm]:
    """Return the active alarms, the worst first, those not yet acknowledged before others."""
    alarms = [
        RaisedAlarm(name, state, alarm, newest_of(alarm, view.acknowledged.get(state.key, ())))
        for name, state in zip(view.names, view.states, strict=True)
        if choice.holds(state)
        for alarm in state.alarms
    ]
    return sorted(alarms, key=lambda entry: (-entry.alarm.severity, entry.seen is not None))


def rows_of(view: FleetView, indices: Sequence[int], address: Any) -> list[dict[str, Any]]:
    """Return rows of the overview with the address of each suspension's page."""
    return [view.rows[i] | {"address": address(view.names[i])} for i in indices]


def jobs_of(view: FleetView, choice: Choice, address: Any) -> list[dict[str, Any]]:
    """Return the jobs of the plan for the chosen suspensions, with their addresses."""
    if view.plan is None:
        return []
    names = {
        place_of(state): name
        for name, state in zip(view.names, view.states, strict=True)
        if choice.holds(state)
    }
    return [
        job | {"address": address(names[place])}
        for job in joined(view.plan.rows())
        if (place := (job["train"], job["car"], job["suspension"])) in names
    ]


def _place_order(state: State) -> tuple[Any, ...]:
    place = state.series.place
    texts = (place.train, place.car, place.suspension, place.bogie, place.side)
    return (*map(natural, texts), state.series.vehicle)


def _tile(name: str, state: State, row: dict[str, Any], is_named: bool) -> Tile:
    place = state.series.place
    texts = [place.suspension] if is_named or not (place.bogie or place.side) else []
    where = " ".join(SHORT.get(text, text) for text in (place.bogie, place.side) if text)
    words = " ".join(filter(None, (*texts, spoken(where))))
    why = of(row["parameter"], row["reason"]) if row["parameter"] else row["reason"]
    return Tile(name, str(state.severity), words or state.series.vehicle, why)


def fleet_values(view: FleetView, choice: Choice, all_rows: bool, address: Any) -> dict[str, Any]:
    """Return the values for the template of the fleet; `address` gives a suspension's URL."""
    chosen = [i for i, state in enumerate(view.states) if choice.holds(state)]
    alarms, jobs = raised(view, choice), jobs_of(view, choice, address)
    most = None if all_rows else MAX_ROWS
    return {
        "finding": finding([view.rows[i] for i in chosen]),
        "choice": choice,
        "train_names": train_names(view),
        "counts": counts(view, choice.train),
        "trains": tiles_of_trains(view, choice),
        "alarms": alarms[:most],
        "n_alarms": len(alarms),
        "rows": rows_of(view, chosen[:most], address),
        "n_rows": len(chosen),
        "parameters": OUTPUTS,
        "plan": view.plan,
        "jobs": jobs[:MAX_JOBS],
        "n_jobs": len(jobs),
        "address": address,
        **bogies_shown(view, chosen),
    }


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
    cleared = [alarm for alarm in reversed(state.watched.alarms) if not alarm.is_open]
    newest = list(reversed(results[-N_TRIPS:]))
    trend = trend_of_state(state)
    # a small figure of each parameter where parts are read; else one figure of all
    names = [panel.name for panel in trend.panels]
    small = {name: address(name) for name in names} if set(names) & set(BOGIE_PARTS) else {}
    mileages = state.series.mileage_km[np.isfinite(state.series.mileage_km)]
    return {
        "state": state,
        "parameters": [name for name in state.outputs if name != BODY_MASS],
        "row": view.rows[index],
        "limits": state.limits,
        "bogie": bogie_of(state, view.plan),
        "no_part": why_no_part(results, state.outputs),
        "small": small_figures(state, small),
        "names": NAMES,
        "alarms": [(alarm, newest_of(alarm, seen)) for alarm in state.alarms],
        "cleared": [(alarm, newest_of(alarm, seen)) for alarm in cleared],
        "ranges": ranges(trend),
        "trips": trip_table(newest, outputs_of(newest), INTERVAL_LEVEL),
        "read_as": files_read_as(newest),
        "n_trips": len(state.series.trip),
        "first_km": float(mileages.min()) if len(mileages) else np.nan,
        "newest_km": float(mileages.max()) if len(mileages) else np.nan,
        "sensors": sensor_rows(state.series),
        "responses": bool(stored),
    }
