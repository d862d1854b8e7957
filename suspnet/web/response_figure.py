"""Frequency responses of a suspension, the newest against the first, as a figure of plotly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from suspnet.history.arrays import TripResponses
from suspnet.report.templates import thousands
from suspnet.web.plotly_figure import MARGINS, PLAIN, axis_title, finite, html

FIRST, NEWEST, BETWEEN = "#8a8f98", "#3b82c4", "#9cc3e6"
PARTS = ("primary suspension: axle box to bogie frame", "secondary suspension: frame to car body")
HEIGHT_PX = 520
TICKS = [one * ten for ten in (0.001, 0.01, 0.1, 1, 10, 100) for one in (1, 2, 5)]
"""Marks of the axes of amplification, [-]."""
MOST_ROWS = 12
"""Number of frequencies in the table below the figure."""


def response_figure(kept: Sequence[TripResponses], name: str) -> dict[str, Any]:
    """Return the amplification along the frequency, a line for each trip, ready for JSON.

    Parameters
    ----------
    kept : sequence of TripResponses
        By mileage, at least one.
    name : str
        Of the suspension: a figure of the same name keeps its zoom.
    """
    data = []
    for row in range(len(PARTS)):
        for place, one in enumerate(kept):
            magnitudes = np.abs(one.responses[row])
            is_last, is_first = place == len(kept) - 1, place == 0
            colour = NEWEST if is_last else FIRST if is_first else BETWEEN
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": legend(one),
                    "legendgroup": str(place),
                    "showlegend": row == 0,
                    "x": finite(one.frequencies_hz),
                    "y": finite(magnitudes),
                    "yaxis": "y" if row == 0 else "y2",
                    "hovertemplate": "%{y:.3g} at %{x:.2f} Hz",
                    "line": {
                        "color": colour,
                        "width": 2.2 if is_last else 1.5,
                        "dash": "dash" if is_first and not is_last else "solid",
                    },
                }
            )
    axis = {"type": "log", "tickvals": TICKS, "ticktext": [f"{one:g}" for one in TICKS]}
    legends = {"orientation": "h", "x": 0, "y": 1.06, "yanchor": "bottom"}
    return {
        "data": data,
        "layout": {
            **PLAIN,
            "margin": MARGINS | {"t": 90},
            "height": HEIGHT_PX,
            "uirevision": name,
            "showlegend": True,
            "legend": legends,
            "xaxis": {"title": {"text": "frequency [Hz]"}, "anchor": "y2"},
            "yaxis": axis | {"domain": [0.55, 1]},
            "yaxis2": axis | {"domain": [0, 0.45]},
            "annotations": [
                axis_title(words, "y" if row == 0 else "y2") for row, words in enumerate(PARTS)
            ],
        },
    }


def legend(one: TripResponses) -> str:
    """Return what a trip is called in figure and table."""
    return f"{html(one.trip)}, {thousands(one.mileage_km)} km"


def response_table(kept: Sequence[TripResponses]) -> list[list[Any]]:
    """Return amplifications as rows: frequency, then both of the first and of the newest trip."""
    first, newest = kept[0], kept[-1]
    ends = (
        max(first.frequencies_hz[0], newest.frequencies_hz[0]),
        min(first.frequencies_hz[-1], newest.frequencies_hz[-1]),
    )
    if not ends[0] < ends[1]:
        return []
    chosen = np.geomspace(*ends, MOST_ROWS)
    columns = [
        np.interp(chosen, one.frequencies_hz, np.abs(one.responses[row]))
        for row in range(len(PARTS))
        for one in (first, newest)
    ]
    return [[float(f), *(float(c[i]) for c in columns)] for i, f in enumerate(chosen)]
