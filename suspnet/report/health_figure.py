"""The figure that matters most: each parameter along the mileage, with intervals and flags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.ground.limits import Limits
from suspnet.ground.parameters import PAYLOAD
from suspnet.ground.records import Commissioning, TripResult
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.judge import ABSURD
from suspnet.maintenance.life import Life
from suspnet.maintenance.series import Event
from suspnet.report.figures import MILEAGE_LABEL, by_mileage, say
from suspnet.report.plots import SYMBOLS

ESTIMATE_COLOUR, TRUTH_COLOUR, MISSING_COLOUR = "tab:blue", "black", "tab:red"
FLAGGED_COLOUR = "tab:purple"
LIMIT_COLOURS = {"notice": "tab:orange", "act": "tab:red"}
HOLLOW: dict[str, Any] = {"mfc": "none", "color": FLAGGED_COLOUR, "ls": ""}
ANEW = "commissioned anew; % is of the first healthy values"
MAINTENANCE = "maintenance"
LEAST_SPAN_PERCENT = 2.0
"""Least span of a parameter's axis, in %, so that spread does not look like change."""
AHEAD = 0.5
"""Share of the mileage so far that a figure shows of what is to come, at most."""
MARGIN = 0.05
"""Share of the span that stays free above and below."""


def health_trend(
    results: Sequence[TripResult],
    outputs: Sequence[str],
    level: float = 0.9,
    limits: Mapping[str, Limits] | None = None,
    states: Sequence[Commissioning] = (),
    events: Sequence[Event] = (),
    alarms: Sequence[Alarm] = (),
    lives: Mapping[str, Life] | None = None,
) -> Figure:
    """Each parameter in % of healthy along the mileage (Fig. 10).

    Dots are trips with their interval, the line is the running median of all; a flagged trip is
    hollow, and its interval is not drawn. A red tick at the bottom is a trip without an estimate, a
    thin black line the truth of simulated trips. Dashed lines are limits, where they lie on the
    axis. The axis holds the values of ``on_axis``; a trip more than their span beyond is cut off
    and marked at the edge. Trips without a mileage are left out, and counted in the title.

    Parameters
    ----------
    results : sequence of TripResult
        In any order.
    outputs : sequence of str
        From ``SYMBOLS``.
    level : float
        Probability of the intervals, for the legend.
    limits : mapping of Limits, optional
        Of each parameter.
    states : sequence of Commissioning
        Several healthy states: a vertical line where each but the first begins. `results` are then
        relative to the first, and limits are those of the last.
    events : sequence of Event
        Maintenance: a dotted vertical line each.
    alarms : sequence of Alarm
        A triangle at the top where each began, in the colour of its severity's limit.
    lives : mapping of Life, optional
        A bar at the bottom, from where to where the act limit is passed with 80 % probability, as
        far as it reaches into the figure, which grows by half of its mileage at most.
    """
    figure = Figure(figsize=(7.0, 1.0 + 1.7 * len(outputs)), layout="constrained")
    axes: list[Axes] = list(figure.subplots(len(outputs), 1, sharex=True, squeeze=False)[:, 0])
    placed = by_mileage(r for r in results if np.isfinite(r.mileage_km))
    mileage = np.array([r.mileage_km / 1000 for r in placed])
    for axis, name in zip(axes, outputs, strict=True):
        axis.set_ylabel(f"{SYMBOLS[name]} [% of {'nominal' if name == PAYLOAD else 'healthy'}]")
        known = np.isfinite([r.estimates.get(name, np.nan) for r in placed])
        if known.any():
            trips = [r for r, is_known in zip(placed, known, strict=True) if is_known]
            _draw(axis, trips, name, level)
            _draw_truth(axis, placed, name)
            now = states[-1].relative[name] if states else 1.0
            _draw_limits(axis, (limits or {}).get(name), now)
        else:
            say(axis, "no trip with an estimate and a mileage", keep_x=len(mileage) > 0)
        _mark_missing(axis, mileage[~known])
        for state in states[1:]:
            axis.axvline(state.since_km / 1000, color="0.3", lw=0.9, ls="-.", label=ANEW)
        for event in events:
            axis.axvline(event.mileage_km / 1000, color="0.3", lw=0.9, ls=":", label=MAINTENANCE)
        _mark_alarms(axis, [one for one in alarms if one.parameter == name])
    if len(mileage):
        _draw_lives(dict(zip(outputs, axes, strict=True)), mileage, lives or {})
    axes[-1].set_xlabel(MILEAGE_LABEL)
    figure.align_ylabels(axes)
    _legend(figure, axes, len(results) - len(placed))
    return figure


def running_median(values: FloatArray, window: int = 5) -> FloatArray:
    """Return the median of the `window` values around each; the window shrinks at the ends.

    Parameters
    ----------
    values : array of shape (n_trips,)
        In the order of the mileage, without NaN.
    window : int
        Odd.
    """
    half = window // 2
    return np.array(
        [np.median(values[max(i - half, 0) : i + half + 1]) for i in range(len(values))]
    )


def on_axis(values: FloatArray, flagged: BoolArray) -> FloatArray:
    """Return the values that an axis must hold, so that one odd trip does not squeeze all others.

    These are the unflagged trips, or all if all are flagged, and the median of neighbouring trips:
    it follows a lasting change, be it flagged. A level that no suspension has is beyond the axis.

    Parameters
    ----------
    values : array of shape (n_trips,), [%]
        In the order of the mileage, without NaN.
    flagged : bool array of shape (n_trips,)
    """
    shown = np.append(values if flagged.all() else values[~flagged], running_median(values))
    return np.minimum(shown, 100 * ABSURD)


def _draw(axis: Axes, trips: Sequence[TripResult], name: str, level: float) -> None:
    """Draw trips with an estimate, in ascending order, and set the axis to them."""
    mileage = np.array([r.mileage_km / 1000 for r in trips])
    values = _percent([r.estimates[name] for r in trips])
    limits = _percent([r.interval(name) for r in trips])  # (n_trips, 2)
    truth = _percent([r.truth.get(name, np.nan) for r in trips])
    flagged = np.array([bool(r.flags) for r in trips])
    limits[flagged] = np.nan
    barred = np.isfinite(limits).all(axis=1)
    if not flagged.all():
        style: dict[str, Any] = {"ms": 6, "color": ESTIMATE_COLOUR, "label": "trip"}
        axis.plot(mileage[~flagged], values[~flagged], ".", **style)
    if barred.any():
        style = {"color": ESTIMATE_COLOUR, "alpha": 0.5, "lw": 0.9}
        label = f"its {100 * level:g} % interval"
        axis.vlines(mileage[barred], *limits[barred].T, label=label, **style)
    if flagged.any():
        style = {"ms": 4.5, "label": "flagged: see the table", **HOLLOW}
        axis.plot(mileage[flagged], values[flagged], "o", **style)
    if len(values) > 2:
        style = {"color": ESTIMATE_COLOUR, "alpha": 0.6}
        axis.plot(
            mileage, running_median(values), label="median of five neighbouring trips", **style
        )
    true = truth if flagged.all() else truth[~flagged]
    base = np.append(on_axis(values, flagged), true[np.isfinite(true)])
    _limit(axis, values, limits[barred], base)
    _mark_cut_off(axis, mileage, values)


def _limit(axis: Axes, values: FloatArray, limits: FloatArray, base: FloatArray) -> None:
    """Set the axis to the values `base`, of ``on_axis``.

    Other values, and intervals `limits` (n, 2), widen it by up to its span on each side.
    """
    low, high = base.min(), base.max()
    span = max(high - low, LEAST_SPAN_PERCENT)
    near = values[(values >= low - span) & (values <= high + span)]
    wide = np.concatenate([base, near, limits.clip(low - span, high + span).ravel()])
    middle, size = (wide.min() + wide.max()) / 2, wide.max() - wide.min()
    half = max((1 + 2 * MARGIN) * size, LEAST_SPAN_PERCENT) / 2
    axis.set_ylim(middle - half, middle + half)
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.axhline(100, color="0.6", lw=0.8, ls=":", zorder=0)
    axis.grid(True, alpha=0.3)


def _mark_cut_off(axis: Axes, mileage: FloatArray, values: FloatArray) -> None:
    """Put a triangle and the value at the edge beyond which a trip lies."""
    low, high = axis.get_ylim()
    edges = axis.get_xaxis_transform()
    for beyond, marker, edge in ((values < low, "v", 0), (values > high, "^", 1)):
        if not beyond.any():
            continue
        style: dict[str, Any] = {"ms": 6, "clip_on": False, "transform": edges, **HOLLOW}
        heights = np.full(beyond.sum(), edge)
        axis.plot(mileage[beyond], heights, marker, label="beyond the axis", **style)
        for km, value in zip(mileage[beyond], values[beyond], strict=True):
            axis.annotate(
                f"{value:.0f} %" if value <= 100 * ABSURD else f"over {100 * ABSURD:.0f} %",
                (km, edge),
                (6, -2 if edge else 2),
                xycoords=edges,
                textcoords="offset points",
                va="top" if edge else "bottom",
                fontsize="x-small",
                color=FLAGGED_COLOUR,
            )


def _draw_truth(axis: Axes, trips: Sequence[TripResult], name: str) -> None:
    """Draw the truth of simulated trips."""
    mileage = np.array([r.mileage_km / 1000 for r in trips])
    truth = _percent([r.truth.get(name, np.nan) for r in trips])
    known = np.isfinite(truth)
    if known.any():
        style: dict[str, Any] = {"lw": 0.8} if known.sum() > 1 else {"marker": "x", "ls": ""}
        axis.plot(
            mileage[known], truth[known], color=TRUTH_COLOUR, label="truth (simulated)", **style
        )


def _draw_limits(axis: Axes, limits: Limits | None, healthy: float) -> None:
    """Draw the limits about `healthy` that lie on the axis, which stays as it is."""
    low, high = axis.get_ylim()
    for name, colour in LIMIT_COLOURS.items():
        for limit in healthy * _percent(getattr(limits, name, ())):
            if low < limit < high:
                axis.axhline(limit, color=colour, lw=0.9, ls="--", label=f"{name} limit", zorder=0)


def _mark_missing(axis: Axes, mileage: FloatArray) -> None:
    """Mark trips without an estimate at the bottom of the axis."""
    if len(mileage):
        axis.plot(
            mileage,
            np.zeros(len(mileage)),
            "|",
            ms=12,
            mew=2,
            color=MISSING_COLOUR,
            transform=axis.get_xaxis_transform(),
            clip_on=False,
            label="trip without an estimate",
        )


def _mark_alarms(axis: Axes, alarms: Sequence[Alarm]) -> None:
    """Mark the begin of each alarm at the top of the axis."""
    for one in alarms:
        axis.plot(
            one.begin_km / 1000,
            1,
            "v",
            ms=7,
            color=LIMIT_COLOURS[str(one.severity)],
            transform=axis.get_xaxis_transform(),
            clip_on=False,
            label=f"{one.severity}: an alarm begins",
        )


def _draw_lives(axes: Mapping[str, Axes], mileage: FloatArray, lives: Mapping[str, Life]) -> None:
    """Draw when the act limits will be passed, and make room for it."""
    last = float(mileage.max())
    most = last + AHEAD * (last - float(mileage.min()))
    ends = {name: last + np.array(life.interval_km()) / 1000 for name, life in lives.items()}
    shown = {name: end for name, end in ends.items() if last < end[1] and end[0] < most}
    for name, (low, high) in shown.items():
        axes[name].plot(
            [low, min(high, most)],
            [0.06, 0.06],
            color=LIMIT_COLOURS["act"],
            lw=5,
            alpha=0.5,
            solid_capstyle="butt",
            transform=axes[name].get_xaxis_transform(),
            label="act limit will be passed (80 %)",
        )
    if shown:
        for axis in axes.values():
            axis.set_xlim(right=min(most, max(min(end[1], most) for end in shown.values())))


def _percent(ratios: Sequence[Any]) -> FloatArray:
    """Return ratios in %."""
    return 100 * np.array(ratios, dtype=float)


def _legend(figure: Figure, axes: Sequence[Axes], n_unplaced: int) -> None:
    """Name every kind of mark once, above the axes."""
    marks: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            marks.setdefault(label, handle)
    if marks:
        figure.legend(
            list(marks.values()), list(marks), loc="outside upper center", ncols=3, fontsize="small"
        )
    if n_unplaced:
        axes[0].set_title(f"without a mileage, not shown: {n_unplaced}", fontsize="small")
