"""Limits of a vehicle's parameters by the rules of its maintenance, and how urgent a finding is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from suspnet.ground.checks import check_number
from suspnet.ground.parameters import PARAMETERS


class Severity(IntEnum):
    """Urgency of a finding; the larger, the worse."""

    NONE = 0
    UNKNOWN = 1
    """Nothing is known: no estimate, or one that is too uncertain."""
    NOTICE = 2
    """Look at the suspension when it is next at hand."""
    ACT = 3
    """The suspension needs work."""

    def __str__(self) -> str:
        """Return the name in small letters, as it is written in tables."""
        return self.name.lower()


@dataclass(frozen=True)
class Limits:
    """Values between which a parameter raises no alarm.

    Parameters
    ----------
    notice, act : (lower, upper), [-]
        Relative to healthy; 1 lies between, and `notice` lies within `act`. Lower 0, or upper
        infinity or None, is no limit on that side.
    why : str
        The reason, in words.

    Raises
    ------
    TypeError, ValueError
        If they are not such pairs of numbers.
    """

    notice: tuple[float, float]
    act: tuple[float, float]
    why: str = ""

    def __post_init__(self) -> None:
        for name in ("notice", "act"):
            given = getattr(self, name)
            pair = () if isinstance(given, str | float | int) else tuple(given)
            if len(pair) != 2:
                raise TypeError(f"`{name}` must be two numbers, lower and upper, got {given}")
            pair = (pair[0], np.inf if pair[1] is None else pair[1])
            check_number(f"{name}[0]", pair[0], low=0, below=1)
            if pair[1] != np.inf:
                check_number(f"{name}[1]", pair[1], above=1)
            object.__setattr__(self, name, pair)
        if not (self.act[0] <= self.notice[0] and self.notice[1] <= self.act[1]):
            raise ValueError(f"limits `notice` {self.notice} must lie within `act` {self.act}")
        if not isinstance(self.why, str):
            raise TypeError(f"`why` must be text, got {self.why!r}")

    def __str__(self) -> str:
        """Return both in % of healthy."""
        notice, act = (
            " to ".join(f"{100 * one:g}" for one in pair) for pair in (self.notice, self.act)
        )
        return f"notice beyond {notice} %, act beyond {act} %"

    def to_dict(self) -> dict[str, Any]:
        """Return the limits as JSON-able values, None for infinity."""
        pairs = {"notice": self.notice, "act": self.act}
        plain = {k: [low, None if high == np.inf else high] for k, (low, high) in pairs.items()}
        return plain | {"why": self.why}


SPRING = Limits(
    notice=(0.9, 1.1),
    act=(0.8, 1.25),
    why="assumed: a spring does not wear, so that 10 % off asks for a look (a wrong part, a "
    "cracked coil, a wrong pressure of an air spring); 20 % less or a quarter more is what a "
    "broken coil or an emergency spring gives",
)


DAMPER = Limits(
    notice=(0.8, 1.25),
    act=(0.7, 1.4),
    why="assumed: a damper wears and is made to wider tolerances than a spring; below 70 % it no "
    "longer does its work",
)


DEFAULT_LIMITS = {"k_p": SPRING, "c_p": DAMPER, "k_s": SPRING, "c_s": DAMPER}
"""Limits of a vehicle whose file says none. The car body's mass is payload and has none."""


TIGHTEST = Limits((np.nextafter(1.0, 0.0), np.nextafter(1.0, 2.0)), (0.0, np.inf))
"""Limits with either of which any other goes together."""


def read_limits(
    given: Mapping[str, Any], default: Mapping[str, Limits] | None = None, why: str = ""
) -> dict[str, Limits]:
    """Return the limits of each parameter of a configuration; null means that it has none.

    Parameters
    ----------
    given : mapping
        From a parameter to its `notice`, `act` and `why`, or to null.
    default : mapping of Limits
        What holds of parameters that are not there, and where one of the three is null or missing.
    why : str
        Reason of limits that are given without one.

    Raises
    ------
    TypeError, ValueError
        If a name is unknown or an entry is not a pair of limits; the message names the parameter.
    """
    if not isinstance(given, Mapping):
        raise TypeError(f"`limits` must map parameters to their limits, got {given!r}")
    limits = dict(default or {})
    for name, entry in given.items():
        if name not in PARAMETERS:
            raise ValueError(f"`limits` must be named as in {PARAMETERS}, got {name!r}")
        if entry is None:
            limits.pop(name, None)
            continue
        if isinstance(entry, Limits):
            limits[name] = entry
            continue
        own = limits.get(name)
        if not isinstance(entry, Mapping) or not set(entry) <= {"notice", "act", "why"}:
            raise ValueError(f"`limits.{name}` must have `notice` and `act`, or be null: {entry}")
        known = {key: value for key, value in entry.items() if value is not None}
        if not known:
            continue
        if own is None and not {"notice", "act"} <= set(known):
            raise ValueError(f"`limits.{name}` must have `notice` and `act`, or be null: {entry}")
        try:
            base = {} if own is None else {"notice": own.notice, "act": own.act}
            limits[name] = Limits(**base | {"why": why} | known)
        except (TypeError, ValueError) as error:
            raise type(error)(f"`limits.{name}`: {error}") from None
    return limits


def limits_words(limits: Mapping[str, Limits]) -> str:
    """Return limits and their reasons in words, those that are alike together."""
    alike: dict[Limits, list[str]] = {}
    for name, one in limits.items():
        alike.setdefault(one, []).append(name)
    told = [
        f"{', '.join(names)}: {one}{f' ({one.why})' * bool(one.why)}"
        for one, names in alike.items()
    ]
    return "; ".join(told) or "none"
