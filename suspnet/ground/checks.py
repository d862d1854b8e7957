"""Checks of settings, with errors that name the setting, the rule and the value."""

from __future__ import annotations

import math
from collections.abc import Collection
from numbers import Integral, Real
from typing import Any

LARGEST = 1e20
"""Largest plausible magnitude of a setting in SI units; its square and its cube are finite."""


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
    """Raise TypeError or ValueError unless `value` is a finite number within the bounds given.

    ``low <= value <= high``, ``above < value < below`` and abs(value) <= `most`, beyond which a
    value would overflow or need too much time or memory. `whole` requires an integer, `optional`
    allows None. A value that is not a number, or not whole, is a TypeError.
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
