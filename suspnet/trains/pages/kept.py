"""Overviews of suspensions as text in a store: JSON of numbers and findings."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from datetime import UTC, datetime
from functools import cache
from typing import Any, TypeVar

import numpy as np

from suspnet.ground.findings import restored, stored
from suspnet.ground.parameters import BOGIE_PARTS, ESTIMATED, Severity
from suspnet.ground.records import PLACE_FROM_TRAIN, Key
from suspnet.trains.history import History
from suspnet.trains.history.overviews import StoredOverview
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.series import Event, make_series
from suspnet.trains.maintenance.state import KeptState, State
from suspnet.trains.pages.bogie import Bogie, DrawnPart, bogie_of
from suspnet.trains.pages.overview import overview_row

DAMAGES = AttributeError, LookupError, OverflowError, RecursionError, TypeError, ValueError
"""Errors that a text raises that is not one of ``kept_text``."""
OF_KEY = {"vehicle", "where", *PLACE_FROM_TRAIN}
"""Columns of a row that are those of its suspension, and not kept."""
Item = TypeVar("Item", Alarm, Event, DrawnPart)


def keep_overviews(
    history: History,
    states: Iterable[State],
    revisions: Mapping[Key, int],
    fingerprint: Callable[[str], str],
) -> None:
    """Store the overviews of states of some revisions, with the fingerprint of each vehicle."""
    now, fingerprint = datetime.now(UTC), cache(fingerprint)
    history.keep_overviews(
        {
            (key := state.key): StoredOverview(
                revisions[key], fingerprint(key[0]), kept_text(state, now)
            )
            for state in states
        }
    )


def kept_text(state: State, at: datetime) -> str:
    """Return what overview and plan show of a state, computed at a time, as text."""
    bogie, (starts, mileages_km) = bogie_of(state), state.newest_trips
    return json.dumps(
        {
            "at": at.isoformat(),
            "row": _plain({k: v for k, v in overview_row(state).items() if k not in OF_KEY}),
            "bogie": bogie
            and {
                "parts": [_plain(vars(part)) for part in bogie.parts.values()],
                "groups": _plain(bogie.groups),
            },
            "outputs": state.outputs,
            "severities": state.severities,
            "unknown": _plain(state.unknown),
            "last_km": state.last_km,
            "all_alarms": [_plain(vars(alarm)) for alarm in state.all_alarms],
            "events": [_plain(vars(event)) for event in state.events],
            # the order of samples has no meaning, and most of them may be infinite
            "lives": {
                name: (life.model, life.samples_km.size, life.finite_km.tolist())
                for name, life in state.lives.items()
            },
            "shortest": state.shortest and state.shortest[0],
            "starts_s": starts.astype("datetime64[s]").astype(np.int64).tolist(),
            "mileages_km": mileages_km.tolist(),
        }
    )


def kept_state(key: Key, text: str) -> KeptState:
    """Return the state of ``kept_text``; ValueError if it is damaged, or of another version."""
    try:
        return _kept_state(key, json.loads(text))
    except DAMAGES as error:
        raise ValueError(f"this is not an overview of a suspension: {error!r}") from None


def _kept_state(key: Key, content: dict[str, Any]) -> KeptState:
    vehicle, place = key
    row, bogie = _texts(content["row"]), content["bogie"]
    # others may write to the store: a page must not meet a type that it does not expect
    is_text = dict.fromkeys(row, False) | _is_text()  # the columns of parts are numbers
    if any(isinstance(row[name], str) != is_text[name] for name in is_text):
        raise TypeError("a text is a number, or a number a text")
    where = {"vehicle": vehicle, "where": str(place)}
    row = where | {name: getattr(place, name) for name in PLACE_FROM_TRAIN} | row
    if bogie is not None:
        parts = {part.name: part for part in _items(DrawnPart, bogie["parts"])}
        if [*parts] != [*BOGIE_PARTS]:
            raise ValueError("parts of a bogie")
        bogie = Bogie(parts, _texts(bogie["groups"]))
    lives = {}
    # only finite samples are kept: most lives have no end in sight
    for name, (model, size, finite_km) in content["lives"].items():
        samples_km = np.full(int(size), np.inf)
        samples_km[: len(finite_km)] = np.array(finite_km, dtype=float)
        lives[name] = Life(str(model), samples_km)
    starts = np.array(content["starts_s"], dtype=np.int64).astype("datetime64[s]")
    mileages_km = np.array(content["mileages_km"], dtype=float)
    shortest = content["shortest"]
    names = {*content["outputs"], *content["severities"], *content["unknown"], *lives}
    if starts.shape != mileages_km.shape or not names <= {*ESTIMATED}:
        raise ValueError("names or trips")
    return KeptState(
        at=datetime.fromisoformat(content["at"]).astimezone(),
        row=row,
        bogie=bogie,
        key=key,
        outputs=tuple(content["outputs"]),
        severities={name: Severity(level) for name, level in content["severities"].items()},
        unknown=_texts(content["unknown"]),
        last_km=float(content["last_km"]),
        all_alarms=_items(Alarm, content["all_alarms"]),
        events=tuple(_items(Event, content["events"])),
        lives=lives,
        shortest=None if shortest is None else (shortest, lives[shortest]),
        newest_trips=(starts, mileages_km),
    )


@cache
def _is_text() -> dict[str, bool]:
    """Return the columns of each overview, and which of them are texts."""
    row = overview_row(State(make_series([], {})))
    return {name: isinstance(row[name], str) for name in row.keys() - OF_KEY}


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: stored(value) if isinstance(value, str) else value for name, value in values.items()
    }


def _texts(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the findings of ``_plain``; TypeError if a value is neither a text nor a number."""
    if not all(isinstance(value, str | int | float) for value in values.values()):
        raise TypeError("a value is neither a text nor a number")
    return {
        name: restored(value) if isinstance(value, str) else value for name, value in values.items()
    }


def _items(kind: type[Item], several: list[dict[str, Any]]) -> list[Item]:
    types = {field.name: field.type for field in fields(kind)}
    items = [kind(**_texts(values)) for values in several]
    for item in items:
        if not all(isinstance(getattr(item, n), str) for n, t in types.items() if t == "str"):
            raise TypeError(f"texts of {kind.__name__}")
    return items
