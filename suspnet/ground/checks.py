"""Checks of settings: one error that names the setting, the rule and what came instead."""

from __future__ import annotations

import math
from collections.abc import Collection
from numbers import Integral, Real
from typing import Any

LARGEST = 1e20
"""Magnitude beyond which no setting in SI units is meant; its square and its cube are finite."""


def check_number(
    name: str,
    value: Any,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
    below: float | None = None,
    whole: bool = False,
    optional: bool = False,
    most: float = LARGEST,
) -> None:
    """Raise unless `value` is a finite number within the bounds given.

    Parameters
    ----------
    name : str
        What the message calls it.
    value : object
    low, above : float, optional
        Lower bound: ``value >= low``, ``value > above``.
    high, below : float, optional
        Upper bound: ``value <= high``, ``value < below``.
    whole : bool
        Only whole numbers.
    optional : bool
        Allow None too.
    most : float
        Magnitude that no sensible value has, which would ask for too much time or memory, or
        overflow.

    Raises
    ------
    TypeError
        If it is not a number, or not a whole one where it must be.
    ValueError
        If it is NaN, infinite, beyond `most` or out of range.
    """
    if optional and value is None:
        return
    bounds = {">=": low, ">": above, "<=": high, "<": below}
    stated = " and ".join(
        f"{sign} {bound:g}" for sign, bound in bounds.items() if bound is not None
    )
    rule = f"{'a whole' if whole else 'a finite'} number {stated}".strip() + " or null" * optional
    if isinstance(value, bool) or not isinstance(value, Integral if whole else Real):
        raise TypeError(f"`{name}` must be {rule}, got {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if most < abs(number) < math.inf:
        raise ValueError(f"`{name}` must be at most {most:g} in magnitude, got {value}")
    inside = (
        math.isfinite(number)
        and (low is None or number >= low)
        and (above is None or number > above)
        and (high is None or number <= high)
        and (below is None or number < below)
    )
    if not inside:
        raise ValueError(f"`{name}` must be {rule}, got {value}")


def check_flag(name: str, value: object) -> None:
    """Raise TypeError unless a setting is True or False; text such as "no" would count as True."""
    if not isinstance(value, bool):
        raise TypeError(f"`{name}` must be True or False, got {value!r}")


def check_choice(name: str, value: object, allowed: Collection[object]) -> None:
    """Raise ValueError unless a setting is one of those allowed."""
    if value not in tuple(allowed):
        raise ValueError(f"`{name}` must be one of {tuple(allowed)}, got {value!r}")
