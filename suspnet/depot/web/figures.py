"""Plotly figures of a suspension: the trend along the mileage, and its responses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import escape
from numpy.typing import ArrayLike

from suspnet.ground.parameters import NAMES
from suspnet.ground.wording import unbroken
from suspnet.runs.language import decimal, gettext, spoken
from suspnet.trains.pages import trend as shown
from suspnet.trains.pages.tables import SUSPENSION_NAMES, ResponseCurves
from suspnet.trains.pages.templates import symbol
from suspnet.trains.pages.trend import LIMIT_COLOURS, MileageTrend, Panel, Points

HEALTHY, BETWEEN = "#8a8f98", "#9cc3e6"
MARGINS = {"l": 62, "r": 12, "t": 50, "b": 48}  # [pixel]
PANEL_PX, RESPONSES_PX = 190, 520  # height of the panel of one parameter, and of the responses
GAP = 0.07
"""Fraction of the figure's height between two parameters, for the heading of the lower one."""
TICKS = [digit * power for power in (0.001, 0.01, 0.1, 1, 10, 100) for digit in (1, 2, 5)]
"""Ticks of the amplification axes, [-]."""


def _plain() -> dict[str, Any]:
    """Return the layout of every figure; plots.js gives it the colours of the page."""
    return {
        "margin": MARGINS,
        "showlegend": False,
        "hovermode": "closest",
        "font": {"family": "system-ui, sans-serif", "size": 13},
        "dragmode": "zoom",
        "separators": decimal(".") + "\N{NO-BREAK SPACE}",
    }


def trend_figure(trend: MileageTrend, name: str, of: str = "") -> dict[str, Any]:
    """Return a suspension along its mileage, ready for JSON.

    A figure of the same suspension `name` keeps its zoom. A figure `of` one parameter has no
    heading, as it stands among those of the others, and their range of mileages.
    """
    panels = [panel for panel in trend.panels if of in ("", panel.name)]
    # the panels share the height, with gaps for their headings
    n = len(panels)
    margins = MARGINS | ({"t": 12} if of else {})
    height = (1 - GAP * (n - 1)) / n
    layout: dict[str, Any] = {
        **_plain(),
        "margin": margins,
        "height": PANEL_PX * n + margins["t"] + margins["b"],
        "uirevision": name,
        "xaxis": {
            "title": {"text": spoken("mileage [km]")},
            "anchor": f"y{n}" if n > 1 else "y",
            "separatethousands": True,
            "range": [km for _, *ends in shown.ranges(trend)[:1] for km in ends] or None,
            "exponentformat": "none",
        },
        "shapes": [],
        "annotations": [],
    }
    data: list[dict[str, Any]] = []
    for row, panel in enumerate(panels):
        axis = f"y{row + 1}" if row else "y"
        data += [trace | {"yaxis": axis, "xaxis": "x"} for trace in _traces(panel)]
        top = 1 - row * (height + GAP)
        layout[axis.replace("y", "yaxis")] = {
            "domain": [max(top - height, 0.0), top],
            "range": list(panel.axis),
            "ticksuffix": " %",
            "nticks": 6,
        }
        if not of:
            heading = f"{symbol(panel.name)}, {spoken(NAMES[panel.name])}"
            layout["annotations"].append(_axis_title(heading, axis))
        layout["shapes"] += _levels(panel, axis)
    # maintenance and commissionings are vertical lines through all panels
    for km, words in (*trend.events, *((km, trend.again) for km in trend.again_km)):
        layout["shapes"].append(_line(x0=km, x1=km, y0=0, y1=1, yref="paper", dash="dot"))
        note = {"x": km, "xref": "x", "y": 1, "yref": "paper", "text": html(spoken(words))}
        style = {"textangle": -90, "showarrow": False, "font": {"size": 11}}
        layout["annotations"].append(note | style | {"xanchor": "right", "yanchor": "top"})
    return {"data": data, "layout": layout}


def response_figure(responses: Sequence[ResponseCurves], name: str) -> dict[str, Any]:
    """Return the amplification over frequency, a line for each trip, ready for JSON.

    `responses`, at least one, are by mileage: the first is dashed, the newest emphasised. A figure
    of the same suspension `name` keeps its zoom.
    """
    data = []
    # an axis for each suspension; one legend entry switches both lines of a trip
    for link, axis in enumerate(("y", "y2")):
        for place, curves in enumerate(responses):
            is_last, is_first = place == len(responses) - 1, place == 0
            colour = shown.TRIP_COLOUR if is_last else HEALTHY if is_first else BETWEEN
            dash = "dash" if is_first and not is_last else "solid"
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": html(unbroken(spoken(str(curves)))),
                    "legendgroup": str(place),
                    "showlegend": link == 0,
                    "x": finite(curves.frequencies_hz),
                    "y": finite(curves.magnitudes[link]),
                    "yaxis": axis,
                    "hovertemplate": "%{y:.3g}, %{x:.2f} Hz",
                    "line": {"color": colour, "width": 2.2 if is_last else 1.5, "dash": dash},
                }
            )
    axis_of = {"type": "log", "tickvals": TICKS, "ticktext": [f"{tick:g}" for tick in TICKS]}
    return {
        "data": data,
        "layout": {
            **_plain(),
            "margin": MARGINS | {"t": 90},
            "height": RESPONSES_PX,
            "uirevision": name,
            "showlegend": True,
            "legend": {"orientation": "h", "x": 0, "y": 1.06, "yanchor": "bottom"},
            "xaxis": {"title": {"text": spoken("frequency [Hz]")}, "anchor": "y2"},
            "yaxis": axis_of | {"domain": [0.55, 1]},
            "yaxis2": axis_of | {"domain": [0, 0.45]},
            "annotations": [
                _axis_title(spoken(title), axis)
                for title, axis in zip(SUSPENSION_NAMES, ("y", "y2"), strict=True)
            ],
        },
    }


def finite(values: ArrayLike) -> list[float | None]:
    """Return numbers with six digits for JSON; None where one is not finite."""
    numbers = np.asarray(values, dtype=float).tolist()
    return [float(f"{number:.6g}") if np.isfinite(number) else None for number in numbers]


def html(text: str) -> str:
    """Return a user's text escaped for plotly."""
    return str(escape(text)).replace("%{", "%\N{ZERO WIDTH SPACE}{")


def _traces(panel: Panel) -> list[dict[str, Any]]:
    """Return the traces of one parameter, without empty ones."""
    points, (low, high) = panel.points, panel.axis
    clear = points.chosen(~points.flagged)
    bars = {
        "type": "data",
        "symmetric": False,
        "array": finite(clear.intervals[:, 1] - clear.values),
        "arrayminus": finite(clear.values - clear.intervals[:, 0]),
    }
    # in the order in which they are drawn: what must stay visible comes last
    traces = [
        {
            "mode": "lines",
            "name": spoken(shown.MEDIAN),
            "x": finite(points.km if len(points.km) > 2 else []),
            "y": finite(shown.running_median(points.values)),
            "hoverinfo": "skip",
            "opacity": 0.5,
            "line": {"color": shown.TRIP_COLOUR, "width": 1.5},
        },
        _trips(clear, panel.axis)
        | {"error_y": bars | {"thickness": 1, "width": 0, "color": shown.TRIP_COLOUR}},
        _trips(points.chosen(points.flagged), panel.axis),
        _at_edge(
            panel.missing_km,
            low,
            [spoken(shown.MISSING)] * len(panel.missing_km),
            {"symbol": "line-ns", "size": 10, "line": {"width": 2, "color": shown.MISSING_COLOUR}},
        ),
        _at_edge(
            [alarm.begin_km for alarm in panel.alarms],
            high,
            [spoken(shown.alarm_label(alarm)) for alarm in panel.alarms],
            {
                "symbol": "triangle-down",
                "size": 10,
                "color": [LIMIT_COLOURS[str(alarm.severity)] for alarm in panel.alarms],
            },
        ),
        *_passing(panel),
    ]
    return [{"type": "scatter"} | trace for trace in traces if trace["x"]]


def _trips(points: Points, span: tuple[float, float]) -> dict[str, Any]:
    """Return the trace of clear or flagged trips; one beyond the axis is a triangle at its edge."""
    inside = np.clip(points.values, *span)
    is_flagged = bool(points.flagged.any())
    circle = "circle-open" if is_flagged else "circle"
    marks = {-1.0: "triangle-down", 0.0: circle, 1.0: "triangle-up"}
    what = f"{gettext('flagged')}: " if is_flagged else ""
    return {
        "mode": "markers",
        "name": spoken(shown.FLAGGED if is_flagged else shown.TRIP),
        "x": finite(points.km),
        "y": finite(inside),
        "text": [
            f"{html(trip)}: {what}{spoken(shown.percent_words(value, '.4g'))}"
            for trip, value in zip(points.trips, points.values, strict=True)
        ],
        "hovertemplate": "%{text}, %{x:,.0f} km<extra></extra>",
        "marker": {
            "color": shown.FLAGGED_COLOUR if is_flagged else shown.TRIP_COLOUR,
            "size": 6,
            "symbol": [marks[side] for side in np.sign(points.values - inside).tolist()],
        },
    }


def _at_edge(
    km: ArrayLike, edge: float, words: list[str], marker: dict[str, Any]
) -> dict[str, Any]:
    return {
        "mode": "markers",
        "name": words[0] if words else "",
        "x": finite(km),
        "y": [edge] * len(words),
        "text": words,
        "hovertemplate": "%{text}, %{x:,.0f} km<extra></extra>",
        "cliponaxis": False,
        "marker": marker,
    }


def _passing(panel: Panel) -> list[dict[str, Any]]:
    """Return where the act limit will be passed: the interval as a bar, the median as a diamond."""
    passing, act = panel.passing, panel.act
    if passing is None or act is None:
        return []
    red = LIMIT_COLOURS["act"]
    low, median, high = passing.low_km, passing.median_km, passing.high_km
    common = {"name": spoken(shown.PASSING), "hoverinfo": "text", "text": spoken(str(passing))}
    return [
        common
        | {
            "mode": "lines",
            "x": [low, high if np.isfinite(high) else low + 1e6],
            "y": [act, act],
            "line": {"width": 7, "color": red},
            "opacity": 0.45,
        },
        common
        | {
            "mode": "markers",
            "x": [median] if np.isfinite(median) else [],
            "y": [act],
            "marker": {"size": 12, "symbol": "diamond", "color": red},
        },
    ]


def _levels(panel: Panel, axis: str) -> list[dict[str, Any]]:
    place: dict[str, Any] = {"x0": 0, "x1": 1, "xref": "paper", "yref": axis}
    lines = [_line(y0=100, y1=100, **place, dash="solid")]
    for kind, value in panel.limits:
        colour, dash = LIMIT_COLOURS[kind], "dash" if kind == "notice" else "solid"
        label = {
            "text": f"{spoken(kind)} {decimal(f'{value:g}')} %",
            "textposition": "start",
            "font": {"size": 11, "color": colour},
        }
        line = _line(y0=value, y1=value, **place, colour=colour, dash=dash)
        lines.append(line | {"label": label})
    return lines


def _line(*, colour: str = HEALTHY, dash: str, **place: Any) -> dict[str, Any]:
    line = {"color": colour, "width": 1.2, "dash": dash}
    return {"type": "line", "layer": "between", "line": line, "xref": "x", "yref": "y"} | place


def _axis_title(text: str, axis: str) -> dict[str, Any]:
    """Return a heading above an axis, which saves the width of a title next to it."""
    place = {"x": 0, "xref": "paper", "xanchor": "left", "y": 1, "yref": f"{axis} domain"}
    return {"text": text, **place, "yanchor": "bottom", "showarrow": False, "font": {"size": 13}}
