"""What the page of the fleet shows of suspensions, kept in the store for the next start."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from suspnet.ground.cache import code_hash
from suspnet.ground.findings import restored, stored
from suspnet.ground.parameters import Severity
from suspnet.ground.records import Key
from suspnet.ground.storage import content_hash
from suspnet.trains.history import History
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.series import Event
from suspnet.trains.maintenance.state import KeptState, State
from suspnet.trains.pages.bogie import Bogie, DrawnPart, bogie_of
from suspnet.trains.pages.overview import overview_row

Settings = Callable[[str], Any]
"""JSON-able settings that states of a vehicle depend on, by its name."""


def keep_states(
    history: History, states: Iterable[State], revisions: Mapping[Key, int], settings: Settings
) -> None:
    """Store what is shown of states that are of these revisions and settings."""
    texts = {state.key: _text(state) for state in states}
    history.keep_overviews(
        {
            key: (_fingerprint(revisions[key], settings(key[0]), text), text)
            for key, text in texts.items()
        }
    )


def kept_states(
    history: History, revisions: Mapping[Key, int], settings: Settings
) -> dict[Key, KeptState]:
    """Return the kept states that are of these revisions and settings, intact, and of this code."""
    return {
        key: _state(key, json.loads(text))
        for key, (fingerprint, text) in history.overviews().items()
        if key in revisions and fingerprint == _fingerprint(revisions[key], settings(key[0]), text)
    }


def _fingerprint(revision: int, settings: Any, text: str) -> str:
    return content_hash([code_hash(), revision, settings, text])


def _text(state: State) -> str:
    bogie, (starts, mileages_km) = bogie_of(state), state.newest_trips
    texts = {
        "row": overview_row(state),
        "bogie": bogie and asdict(bogie),
        "unknown": state.unknown,
        "alarms": [asdict(alarm) for alarm in state.all_alarms],
        "events": [asdict(event) for event in state.events],
    }
    numbers = {
        "outputs": state.outputs,
        "severities": state.severities,
        "last_km": state.last_km,
        # the order of samples has no meaning, and most of them may be infinite
        "lives": {
            name: (life.model, life.samples_km.size, life.finite_km.tolist())
            for name, life in state.lives.items()
        },
        "shortest": state.shortest and state.shortest[0],
        "starts_s": starts.astype("datetime64[s]").astype(np.int64).tolist(),
        "mileages_km": mileages_km.tolist(),
    }
    return json.dumps([_each_text(texts, stored), numbers])


def _state(key: Key, content: list[dict[str, Any]]) -> KeptState:
    texts, numbers = _each_text(content[0], restored), content[1]
    bogie, shortest = texts["bogie"], numbers["shortest"]
    if bogie:
        parts = {name: DrawnPart(**part) for name, part in bogie["parts"].items()}
        bogie = Bogie(parts, bogie["groups"])
    lives = {}
    for name, (model, size, finite_km) in numbers["lives"].items():
        lives[name] = Life(model, np.full(size, np.inf))
        lives[name].samples_km[: len(finite_km)] = finite_km
    starts = np.array(numbers["starts_s"], dtype=np.int64).astype("datetime64[s]")
    return KeptState(
        row=texts["row"],
        bogie=bogie,
        key=key,
        outputs=tuple(numbers["outputs"]),
        severities={name: Severity(level) for name, level in numbers["severities"].items()},
        unknown=texts["unknown"],
        last_km=numbers["last_km"],
        all_alarms=[Alarm(**alarm) for alarm in texts["alarms"]],
        events=tuple(Event(**event) for event in texts["events"]),
        lives=lives,
        shortest=shortest and (shortest, lives[shortest]),
        newest_trips=(starts, np.array(numbers["mileages_km"], dtype=float)),
    )


def _each_text(value: Any, change: Any) -> Any:
    """Return nested values with their texts changed, such as findings stored."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {name: _each_text(item, change) for name, item in value.items()}
    return [_each_text(item, change) for item in value] if isinstance(value, list) else value
