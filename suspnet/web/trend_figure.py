"""Each parameter of a suspension along the mileage, as a figure of plotly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspnet.ground.limits import Limits, Severity
from suspnet.ground.parameters import PAYLOAD
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.maintenance.life import Life
from suspnet.maintenance.state import State
from suspnet.report.health_figure import on_axis
from suspnet.report.report import NAMES
from suspnet.report.templates import thousands
from suspnet.web.plotly_figure import MARGINS, PLAIN, axis_title, finite, html, symbol

TRIP, FLAGGED = "#3b82c4", "#9467bd"
LIMITS = {"notice": "#d9822b", "act": "#d64545"}
HEALTHY = "#8a8f98"
ROW_PX = 190
"""Height of the part of one parameter."""
GAP = 0.07
"""Share of the figure between two parameters, for the heading of the lower one."""
LEAST_SPAN = 2.0
"""Least span of a parameter's axis, in %, so that spread does not look like change."""
MARGIN = 0.08
"""Share of the span that stays free above and below."""


def trend_figure(state: State, limits: Mapping[str, Limits]) -> dict[str, Any]:
    """Return trips with intervals, limits, maintenance and predicted crossings, ready for JSON.

    Parameters
    ----------
    state : State
    limits : mapping from parameter to Limits
    """
    names = [name for name in state.series.estimates if name != PAYLOAD]
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        **PLAIN,
        "height": ROW_PX * len(names) + MARGINS["t"] + MARGINS["b"],
        "uirevision": str(state.key),
        "xaxis": {
            "title": {"text": "mileage [km]"},
            "anchor": f"y{len(names)}" if len(names) > 1 else "y",
            "separatethousands": True,
            "range": [km for _, *ends in ranges(state)[:1] for km in ends] or None,
            "exponentformat": "none",
        },
        "shapes": [],
        "annotations": [],
    }
    height = (1 - GAP * (len(names) - 1)) / len(names)
    for row, name in enumerate(names):
        axis = "y" if row == 0 else f"y{row + 1}"
        top = 1 - row * (height + GAP)
        traces, span = _parameter(state, name, limits.get(name))
        data += [trace | {"yaxis": axis, "xaxis": "x"} for trace in traces]
        layout[axis.replace("y", "yaxis")] = {
            "domain": [max(top - height, 0.0), top],
            "range": list(span),
            "ticksuffix": " %",
            "nticks": 6,
        }
        layout["annotations"].append(axis_title(f"{symbol(name)}, {NAMES[name]}", axis))
        layout["shapes"] += _levels(limits.get(name), axis)
    for km, words in _events(state):
        layout["shapes"].append(_line(x0=km, x1=km, y0=0, y1=1, yref="paper", dash="dot"))
        note = {"x": km, "xref": "x", "y": 1, "yref": "paper", "text": words, "textangle": -90}
        layout["annotations"].append(
            note | {"showarrow": False, "xanchor": "right", "yanchor": "top", "font": {"size": 11}}
        )
    return {"data": data, "layout": layout}


def ranges(state: State) -> list[tuple[str, float, float]]:
    """Return stretches of the mileage that a reader may want, by name, first and last km."""
    km = state.series.mileage_km[np.isfinite(state.series.mileage_km)]
    if len(km) == 0:
        return []
    ends = [end for life in state.lives.values() for end in [_crossing(life)[2]]]
    last = max([float(km.max()), *(state.last_km + end for end in ends if np.isfinite(end))])
    first, newest = float(km.min()), float(km.max())
    last = min(last, newest + max(newest - first, 100_000.0))
    pad = 0.02 * max(last - first, 1000.0)
    found = [("All", max(first - pad, min(first, 0.0)), last + pad)]
    if newest - first > 100_000:
        found.append(
            ("Last 100\N{NO-BREAK SPACE}000\N{NO-BREAK SPACE}km", newest - 100_000, newest + 2000)
        )
    if len(km) > 20:
        begin = float(np.sort(km)[-20])
        pad = 0.02 * max(newest - begin, 1000.0)
        found.append(("Last 20 trips", begin - pad, newest + pad))
    return found


def _parameter(
    state: State, name: str, limits: Limits | None
) -> tuple[list[dict[str, Any]], tuple[float, float]]:
    """Return the traces of one parameter, and the range of its axis, [%]."""
    series = state.series
    known = np.isfinite(series.estimates[name]) & np.isfinite(series.mileage_km)
    km, values = series.mileage_km[known], 100 * series.estimates[name][known]
    flagged, trips = series.flagged[known], series.trip[known]
    with np.errstate(over="ignore"):
        half = np.exp(series.half_widths[name][known])
    up, down = values * (half - 1), values * (1 - 1 / half)
    level = _level(state, name, limits)
    ends = np.concatenate([values[~flagged] + up[~flagged], values[~flagged] - down[~flagged]])
    low, high = _span(on_axis(values, flagged), ends, level)
    traces = [
        _trips(km, values, trips, ~flagged, (low, high)) | _bars(up[~flagged], down[~flagged]),
        _trips(km, values, trips, flagged, (low, high), is_flagged=True),
    ]
    life = state.lives.get(name)
    if life is not None and level is not None:
        traces += _passing(life, state.last_km, level)
    return [one for one in traces if one["x"]], (low, high)


def _trips(
    km: FloatArray,
    values: FloatArray,
    names: NDArray[np.str_],
    chosen: BoolArray,
    span: tuple[float, float],
    is_flagged: bool = False,
) -> dict[str, Any]:
    """Return the trace of some trips; one beyond the axis is a triangle at its edge."""
    shown = np.clip(values[chosen], *span)
    beyond = np.sign(values[chosen] - shown)
    marks = {
        -1.0: "triangle-down",
        0.0: "circle-open" if is_flagged else "circle",
        1.0: "triangle-up",
    }
    what = "flagged: " if is_flagged else ""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": "flagged trip" if is_flagged else "trip",
        "x": finite(km[chosen]),
        "y": finite(shown),
        "text": [
            f"{html(name)}: {what}{value:.4g} %"
            for name, value in zip(names[chosen], values[chosen], strict=True)
        ],
        "hovertemplate": "%{text}, at %{x:,.0f} km<extra></extra>",
        "marker": {
            "color": FLAGGED if is_flagged else TRIP,
            "size": 6,
            "symbol": [marks[one] for one in beyond.tolist()],
        },
    }


def _bars(up: FloatArray, down: FloatArray) -> dict[str, Any]:
    """Return the intervals of trips."""
    bars = {"type": "data", "symmetric": False, "array": finite(up), "arrayminus": finite(down)}
    return {"error_y": bars | {"thickness": 1, "width": 0, "color": TRIP}}


def _level(state: State, name: str, limits: Limits | None) -> float | None:
    """Return the act limit that a parameter is nearer to, [%]; None if it is not near any."""
    now = state.now(name)
    if limits is None or np.isnan(now):
        return None
    limit = limits.act[0] if now < 1 else limits.act[1]
    life = state.lives.get(name)
    is_passing = life is not None and np.isfinite(_crossing(life)[0])
    is_alarm = any(one.parameter == name and one.severity == Severity.ACT for one in state.alarms)
    return 100 * limit if (is_passing or is_alarm) and 0 < limit < np.inf else None


def _span(values: FloatArray, ends: FloatArray, level: float | None) -> tuple[float, float]:
    """Return the range of an axis, [%]: values of ``on_axis``, 100 % and a limit that is near.

    The ends of intervals widen it by half of that on each side at most.
    """
    base = np.array([100.0, *values] + ([] if level is None else [level]))
    low, high = float(base.min()), float(base.max())
    most = max(high - low, LEAST_SPAN) / 2
    ends = np.clip(ends[np.isfinite(ends)], low - most, high + most)
    low, high = min([low, *ends]), max([high, *ends])
    pad = max(MARGIN * (high - low), (LEAST_SPAN - (high - low)) / 2)
    return float(low - pad), float(high + pad)


def _levels(limits: Limits | None, axis: str) -> list[dict[str, Any]]:
    """Return the lines of health and of the limits."""
    found = [
        _line(y0=100, y1=100, x0=0, x1=1, xref="paper", yref=axis, colour=HEALTHY, dash="solid")
    ]
    for name, colour in LIMITS.items():
        for value in getattr(limits, name, ()):
            if 0 < value < np.inf:
                place = {"y0": 100 * value, "y1": 100 * value, "yref": axis, "xref": "paper"}
                line = _line(
                    x0=0, x1=1, **place, colour=colour, dash="dash" if name == "notice" else "solid"
                )
                words = f"{name} {100 * value:g} %"
                line["label"] = {
                    "text": words,
                    "textposition": "start",
                    "font": {"size": 11, "color": colour},
                }
                found.append(line)
    return found


def _line(*, colour: str = HEALTHY, dash: str, **place: Any) -> dict[str, Any]:
    """Return a straight line behind the trips."""
    line = {"color": colour, "width": 1.2, "dash": dash}
    return {"type": "line", "layer": "between", "line": line, "xref": "x", "yref": "y"} | place


def _events(state: State) -> list[tuple[float, str]]:
    """Return maintenance, and where a suspension was commissioned anew: mileage and words."""
    found = [(one.mileage_km, html(one.words or one.kind)) for one in state.series.events]
    since = state.series.healthy_since_km
    begins = np.unique(since[np.isfinite(since)])[1:].tolist()
    return found + [(km, "commissioned anew") for km in begins]


def _crossing(life: Life) -> tuple[float, float, float]:
    """Return lower end, median and upper end of the mileage to go, [km]."""
    low, high = life.interval_km()
    return low, life.quantile_km(0.5), high


def _passing(life: Life, last_km: float, level: float) -> list[dict[str, Any]]:
    """Return where the act limit will be passed: the median, and the interval of 80 %."""
    low, median, high = (last_km + km for km in _crossing(life))
    if not np.isfinite(low) or high <= last_km:
        return []
    ends = [thousands(one) if np.isfinite(one) else "no end" for one in (low, median, high)]
    words = f"passes the act limit at about {ends[1]} km (80 %: {ends[0]} to {ends[2]})"
    far = high if np.isfinite(high) else low + 1e6
    bar = {"x": [low, far], "y": [level, level], "mode": "lines", "line": {"width": 7}}
    dot = {"x": [median] if np.isfinite(median) else [], "y": [level], "mode": "markers"}
    marker = {"size": 12, "symbol": "diamond", "color": LIMITS["act"]}
    shared = {"type": "scatter", "name": "predicted crossing", "hoverinfo": "text", "text": words}
    bar["line"] = {"width": 7, "color": LIMITS["act"]}
    return [shared | bar | {"opacity": 0.45}, shared | dot | {"marker": marker}]
