"""Values out of a YAML file, checked one by one, with errors that name file, key and value."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


class TripError(ValueError):
    """Something is wrong with one trip: its manifest, or the files that it names.

    Its arguments are the problems, one sentence each; in words only the first is told.
    """

    @property
    def problems(self) -> tuple[str, ...]:
        """Each thing that is wrong, in the order in which it was found."""
        return tuple(map(str, self.args))

    def __str__(self) -> str:
        more = len(self.args) - 1
        if more < 1:
            return super().__str__()
        return f"{self.args[0]} (and {more} more: suspnet-check tells all)"


def all_of(parts: Iterable[Callable[[], Any]], problems: Iterable[str] = ()) -> list[Any]:
    """Return what each of some functions returns.

    Raises
    ------
    TripError
        With `problems` and those of every function, each once, if there are any.
    """
    found, told = [], list(problems)
    for part in parts:
        try:
            found.append(part())
        except TripError as error:
            told += error.problems
    if told:
        raise TripError(*dict.fromkeys(told))
    return found


class CheckedMapping:
    """One mapping of a YAML file: hands out checked values and knows where they stand.

    Parameters
    ----------
    path : Path
        The file, named in errors.
    where : str
        Keys that lead to the mapping, joined by dots; "" is the whole file.
    content : Any
        What was read there.
    required, optional : sequences of str
        The keys that must and may be there; an optional null counts as missing.

    Attributes
    ----------
    problems : list of str
        A sentence for each unknown and each missing key; `read` tells them.

    Raises
    ------
    TripError
        If it is no mapping. The methods raise it where a value is of the wrong type or out of
        range.
    """

    def __init__(
        self, path: Path, where: str, content: Any, required: Sequence[str], optional: Sequence[str]
    ) -> None:
        self.path, self.where, self.content = path, where, content
        if not isinstance(content, dict):
            raise TripError(f"{path}: {self._name()} must be a mapping, got {_short(content)}")
        allowed = (*required, *optional)
        self.problems = [
            f"{path}: {self._name(key)} is not known; allowed are {allowed}"
            for key in content
            if key not in allowed
        ]
        self.problems += [
            f"{path}: {self._name(key)} is missing" for key in required if not self.has(key)
        ]

    def read(self, parts: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
        """Return what the function of each key that is there returns.

        Raises
        ------
        TripError
            With every problem: unknown and missing keys, and what the functions of the others find.
        """
        there = {key: part for key, part in parts.items() if self.has(key)}
        return dict(zip(there, all_of(there.values(), self.problems), strict=True))

    def has(self, key: str) -> bool:
        """Return whether an optional key has a value."""
        return self.content.get(key) is not None

    def refuse(self, key: str, rule: str) -> TripError:
        """Return the error that names file, key, rule and value."""
        value = _short(self.content[key])
        return TripError(f"{self.path}: {self._name(key)} must be {rule}, got {value}")

    def text(self, key: str) -> str:
        """Return a text that is not blank."""
        value = self.content[key]
        if not isinstance(value, str) or not value.strip():
            raise self.refuse(key, "text (put it in quotes if it looks like anything else)")
        return value

    def choice(self, key: str, allowed: Sequence[str]) -> str:
        """Return one of some texts."""
        if self.content[key] not in list(allowed):
            raise self.refuse(key, f"one of {list(allowed)}")
        return str(self.content[key])

    def number(self, key: str, rule: str = "a finite number", low: float = -math.inf) -> float:
        """Return a finite number above `low`; `rule` is what the message says of it."""
        value = self.content[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(key, f"{rule} (written like 5000.0)")
        if not low < value < math.inf or abs(value) > 1e300:
            raise self.refuse(key, rule)
        return float(value)

    def positive(self, key: str) -> float:
        """Return a number > 0."""
        return self.number(key, "a number > 0", 0.0)

    def _name(self, key: object = "") -> str:
        """Return the name of a key in messages, with the keys that lead to it."""
        name = ".".join(part for part in (self.where, str(key)) if part)
        return f"`{name}`" if name else "the manifest"


def _short(value: Any) -> str:
    """Return a value for a message, abridged and on one line."""
    return " ".join(reprlib.repr(value).split())
