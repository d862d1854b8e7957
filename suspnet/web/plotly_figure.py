"""What the figures share: numbers as JSON holds them, titles, margins."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import escape
from numpy.typing import ArrayLike

MARGINS = {"l": 62, "r": 12, "t": 50, "b": 48}
"""Margins of a figure, [pixel]."""
PLAIN: dict[str, Any] = {
    "margin": MARGINS,
    "showlegend": False,
    "hovermode": "closest",
    "separators": ".\N{NO-BREAK SPACE}",
    "font": {"family": "system-ui, sans-serif", "size": 13},
    "dragmode": "zoom",
}
"""Layout of every figure; plots.js gives it the colours of the page."""


def finite(values: ArrayLike) -> list[float | None]:
    """Return numbers with six digits as JSON holds them; None where there is none."""
    found = np.asarray(values, dtype=float)
    return [float(f"{one:.6g}") if np.isfinite(one) else None for one in found.tolist()]


def html(text: str) -> str:
    """Return a text of a user's as plotly shows it: without a meaning of its signs."""
    return str(escape(text)).replace("%{", "%\N{ZERO WIDTH SPACE}{")


def symbol(name: str) -> str:
    """Return a parameter's symbol with its index, for plotly."""
    letter, _, index = name.partition("_")
    return f"<i>{letter}</i><sub>{index}</sub>"


def axis_title(text: str, axis: str) -> dict[str, Any]:
    """Return a heading above an axis, which takes no width as a title beside it would."""
    place = {"x": 0, "xref": "paper", "xanchor": "left", "y": 1, "yref": f"{axis} domain"}
    return {"text": text, **place, "yanchor": "bottom", "showarrow": False, "font": {"size": 13}}
