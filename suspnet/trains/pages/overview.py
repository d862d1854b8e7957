"""The suspensions of a fleet or folder: their rows, the worst first, and sentences on all."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any

import numpy as np
from tabulate import tabulate

from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import Severity, part_words
from suspnet.ground.records import OK, PLACE_FROM_TRAIN, Key, Place, TripResult
from suspnet.ground.storage import content_hash
from suspnet.trains.history.schema import BadRow
from suspnet.trains.maintenance.alarms import Acknowledgement, newest_of
from suspnet.trains.maintenance.plan import Plan
from suspnet.trains.maintenance.series import make_series
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.failing_sensors import dead_words, sensor_words

REPORT = "report.html"
N_SHOWN = 30  # suspensions in the table on a terminal
ID_DIGITS = 12  # hexadecimal digits of a suspension's name in a URL
CALM = "within its limits"  # reason of a suspension without a finding


@dataclass(frozen=True)
class Evaluated:
    """One suspension of a folder: its trips and its state, or why it could not be read.

    `name` is its subfolder of the output, if there are several. `results` are in the order of the
    mileage. If it was not read, `state` is None and `error` the reason.
    """

    name: str
    place: Place
    results: list[TripResult] = field(default_factory=list)
    state: State | None = None
    error: str = ""

    @property
    def severity(self) -> Severity:
        """The largest severity of its parameters; unknown if it was not read."""
        return Severity.UNKNOWN if self.state is None else self.state.severity

    @property
    def is_complete(self) -> bool:
        """Whether each of its trips has an estimate."""
        return not self.error and all(result.status == OK for result in self.results)

    def row(self) -> dict[str, Any]:
        """Return the suspension as one flat row of the overview."""
        state = self.state or State(make_series([], {}, place=self.place))
        row = overview_row(state)
        row["where"] = row["where"] or self.name
        row["suspension"] = self.place.suspension or self.name
        if self.error:
            row |= {"severity": str(self.severity), "reason": Finding("not-read", error=self.error)}
        row["sensors"] = dead_words(self.results)
        report = "" if self.error else f"{self.name}/{REPORT}"
        return row | {"folder": self.name, "report": report}


@dataclass(frozen=True, eq=False)
class FleetView:
    """An immutable snapshot of the fleet.

    `version` increases with each view of a board, from 0 before anything was read; `at` is in UTC.
    `states` are sorted by severity, then by life, and `rows` are their ``overview_row``. `plan` is
    None until remaining lives are computed. `names` are the ``address`` of each suspension, and
    `keys` its index by this name. `is_complete` is whether alarms, lives and plan cover all trips;
    those of `n_waiting` suspensions are still to be evaluated. `trouble` states why the store could
    not be read the last time; `bad_rows` cannot be read and are left out.
    """

    version: int = 0
    at: datetime = field(default_factory=lambda: datetime.now(UTC))
    states: tuple[State, ...] = ()
    plan: Plan | None = None
    acknowledged: Mapping[Key, Sequence[Acknowledgement]] = field(default_factory=dict)
    is_complete: bool = False
    n_waiting: int = 0
    trouble: str = ""
    bad_rows: tuple[BadRow, ...] = ()
    rows: list[dict[str, Any]] = field(init=False)
    names: tuple[str, ...] = field(init=False)
    keys: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        rows = [overview_row(state, self.acknowledged) for state in self.states]
        names = tuple(address(state.key) for state in self.states)
        keys = {name: i for i, name in enumerate(names)}
        self.__dict__.update(rows=rows, names=names, keys=keys)  # as frozen fields

    def state(self, name: str) -> State | None:
        """Return the state of a suspension by its name in URLs; None if there is none."""
        return self.states[self.keys[name]] if name in self.keys else None

    @property
    def entries(self) -> list[tuple[str, str, State]]:
        """Place, name in URLs and state of each suspension."""
        return [
            (row["where"], name, state)
            for row, name, state in zip(self.rows, self.names, self.states, strict=True)
        ]


def address(key: Key) -> str:
    """Return the name of a suspension in a URL: a part of a hash of vehicle and place."""
    vehicle, place = key
    return content_hash([vehicle, *astuple(place)])[:ID_DIGITS]


def overview_row(
    state: State, acknowledged: Mapping[Key, Sequence[Acknowledgement]] = MappingProxyType({})
) -> dict[str, Any]:
    """Return the row of a suspension."""
    worst = next(iter(state.alarms), None)
    seen = worst and newest_of(worst, acknowledged.get(state.key, ()))
    series, shortest = state.series, state.shortest
    has_finding = state.severity > Severity.NONE  # the reasons of the others are not shown
    life = shortest and (*shortest[1].interval_km(), shortest[1].quantile_km(0.5))
    low, high, median = life or (np.nan, np.nan, np.nan)
    why = state.watched.changes.why_not
    calm = Finding("calm-unarmed", calm=CALM, why=why) if why else CALM
    return {
        "vehicle": series.vehicle,
        "where": str(series.place),
        **{name: getattr(series.place, name) for name in PLACE_FROM_TRAIN},
        "severity": str(state.severity),
        "parameter": state.parameters if has_finding else "",
        "reason": state.reason if has_finding else calm,
        "sensors": sensor_words(state),
        "since_km": worst.begin_km if worst else np.nan,
        "n_alarms": len(state.alarms),
        "acknowledged": f"{seen.by}, {seen.at[:10]}" if seen else "",
        "life_parameter": shortest[0] if shortest else "",
        "life_low_km": low,
        "life_median_km": median,
        "life_high_km": high,
        "life_unknown": together(state.unknown, ", "),
        "life_unknown_why": together(dict.fromkeys(state.unknown.values())),
        **{f"{name}_last": state.furthest(name) for name in series.estimates},
        "last_mileage_km": state.last_km,
        "n_trips": len(series.trip),
        "n_estimated": int(series.done.sum()),
        "n_flagged": int(series.flagged.sum()),
    }


def overview_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the worst suspensions of a fleet as a table, after a sentence on all of them."""
    shown = (*PLACE_FROM_TRAIN, "severity", "parameter", "reason", "sensors")
    columns = [key for key in shown if any(row[key] for row in rows)]
    head = [[row[key] for key in columns] for row in rows[:N_SHOWN]]
    more = f"\n... and {len(rows) - N_SHOWN} more" if len(rows) > N_SHOWN else ""
    first = together((finding(rows), most_severe(rows)), " ")
    return f"{first}\n{tabulate(head, columns, tablefmt='github')}{more}"


def finding(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how many suspensions are of each severity."""
    counts = {level: sum(row["severity"] == str(level) for row in rows) for level in Severity}
    words = {
        Severity.ACT: "count-act",
        Severity.NOTICE: "count-notice",
        Severity.UNKNOWN: "count-unknown",
        Severity.NONE: "count-none",
    }
    texts = [Finding(kind, n=counts[level]) for level, kind in words.items() if counts[level]]
    return Finding("suspensions", n=len(rows), words=together(texts, ", "))


def most_severe(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence that names the part of the worst suspension; empty without a finding.

    `rows` come with the most severe first.
    """
    worst = rows[0] if rows else {}
    is_severe = worst.get("severity") in (str(Severity.ACT), str(Severity.NOTICE))
    if not is_severe or not worst.get("parameter"):
        return ""
    first = part_words(worst["parameter"].partition(", ")[0])
    place = Place(**{name: worst[name] for name in PLACE_FROM_TRAIN})
    return Finding("most-severe", part=first, place=str(place))
