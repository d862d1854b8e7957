"""Checks of settings: one error that names the setting, the rule and what came instead."""

from __future__ import annotations

import math
from collections.abc import Collection
from numbers import Integral, Real
from typing import Any


def check_number(
    name: str,
    value: Any,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    open_low: bool = False,
    open_high: bool = False,
    whole: bool = False,
    optional: bool = False,
) -> None:
    """Raise unless `value` is a finite number between `low` and `high`.

    Parameters
    ----------
    name : str
        What the message calls it.
    value : object
    low, high : float
        Bounds; they are allowed themselves unless `open_low` or `open_high`.
    whole : bool
        Only whole numbers.
    optional : bool
        Allow None too.

    Raises
    ------
    TypeError
        If it is not a number, or not a whole one where it must be.
    ValueError
        If it is out of range.
    """
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, Integral if whole else Real):
        kind = "a whole number" if whole else "a number"
        raise TypeError(f"`{name}` must be {kind}{' or null' * optional}, got {value!r}")
    number = float(value)
    below = number < low or (open_low and number == low)
    above = number > high or (open_high and number == high)
    if not math.isfinite(number) or below or above:
        raise ValueError(f"`{name}` must {_rule(low, high, open_low, open_high)}, got {value}")


def check_choice(name: str, value: object, allowed: Collection[object]) -> None:
    """Raise ValueError unless a setting is one of those allowed."""
    if value not in allowed:
        raise ValueError(f"`{name}` must be one of {tuple(allowed)}, got {value!r}")


def _rule(low: float, high: float, open_low: bool, open_high: bool) -> str:
    """Return the rule in words."""
    if high == math.inf:
        return f"be finite and in ({low:g}, inf)" if open_low else f"be finite and >= {low:g}"
    if low == -math.inf:
        return f"be finite and {'<' if open_high else '<='} {high:g}"
    return f"lie between {low:g} and {high:g}"
