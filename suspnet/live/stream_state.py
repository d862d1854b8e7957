"""States of a stream as bytes: JSON-able values with arrays among them, as one safetensors file."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.storage import DamagedFileError, dump_arrays, load_arrays

FORMAT = "suspnet-stream-1"


class StateError(ValueError):
    """A saved state is damaged, or of another stream."""


def dump_state(identity: Any, state: dict[str, Any]) -> bytes:
    """Return a state as bytes.

    Parameters
    ----------
    identity : JSON-able
        What the stream that goes on from the state must have in common with this one.
    state : dict
        Numbers, text, lists of these, arrays, and dicts of all; keys are text.
    """
    arrays: dict[str, NDArray[Any]] = {}
    plain = _without_arrays(state, arrays, "")
    described = json.dumps({"format": FORMAT, "identity": identity, "state": plain})
    arrays["json"] = np.frombuffer(described.encode(), dtype=np.uint8)
    return dump_arrays(arrays)


def load_state(content: bytes, identity: Any) -> dict[str, Any]:
    """Return the state that `dump_state` wrote.

    Raises
    ------
    StateError
        If it is damaged, or of another identity.
    """
    try:
        arrays = load_arrays(content, "the state")
        described = json.loads(arrays["json"].tobytes())
        found = described["format"], described["identity"]
        state: dict[str, Any] = _with_arrays(described["state"], arrays)
    except (DamagedFileError, KeyError, TypeError, ValueError) as error:
        raise StateError(f"this is no state of a stream: {error}") from None
    if found != (FORMAT, json.loads(json.dumps(identity))):
        raise StateError("this is the state of another stream: other sensors, settings or times")
    return state


def _without_arrays(value: Any, arrays: dict[str, NDArray[Any]], name: str) -> Any:
    """Return JSON-able values in which each array is the name of one in `arrays`, which grows."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {"array": name}
    if isinstance(value, dict):
        return {key: _without_arrays(one, arrays, f"{name}/{key}") for key, one in value.items()}
    return value


def _with_arrays(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return what `_without_arrays` was given."""
    if isinstance(value, dict):
        if set(value) == {"array"}:
            return arrays[value["array"]]
        return {key: _with_arrays(one, arrays) for key, one in value.items()}
    return value
