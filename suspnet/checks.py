"""Checks of an estimator's parameters."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any


def check_number(
    name: str, value: Any, *, low: float, open_low: bool = False, whole: bool = False
) -> None:
    """Raise unless `value` is a finite number >= low (> low if `open_low`).

    Raises
    ------
    TypeError
        If it is not a number, or not a whole one where it must be.
    ValueError
        If it is out of range.
    """
    kind = Integral if whole else Real
    if isinstance(value, bool) or not isinstance(value, kind):
        raise TypeError(f"`{name}` must be a {'whole ' if whole else ''}number, got {value!r}")
    number = float(value)
    if not math.isfinite(number) or number < low or (open_low and number == low):
        bound = f"in ({low}, inf)" if open_low else f">= {low}"
        raise ValueError(f"`{name}` must be finite and {bound}, got {value}")
