"""Figures of trips: signals, responses and quality of the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from suspnet.ground.findings import Finding
from suspnet.ground.records import OK, TripResult, by_mileage
from suspnet.ground.types import FloatArray
from suspnet.runs.figures import MILEAGE_LABEL, SUSPENSIONS, say
from suspnet.trains.pages.tables import response
from suspnet.trains.recordings.recording import Overview

CHANNEL_TITLES = ("axle box", "bogie frame", "car body")


def trip_signals(result: TripResult) -> Figure:
    """Draw range and mean of the three accelerations of a trip, and its speed (Fig. 4).

    Without curves, the axes are empty.
    """
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    axes: list[Axes] = list(figure.subplots(4, 1, sharex=True))
    curves = result.curves
    if curves is None or not np.isfinite(curves.overview_mean).any():
        for axis in axes:
            say(axis, "no signals")
        _label_signals(axes, "time")
        return figure
    parts = curves.overview_low, curves.overview_high, curves.overview_mean
    draw_signals(axes, Overview(curves.overview_s, *parts, curves.overview_speed))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    if np.isfinite(result.mileage_km):
        axes[0].set_title(Finding("trip-at", km=result.mileage_km), fontsize="medium")
    figure.align_ylabels(axes)
    return figure


def draw_signals(axes: Sequence[Axes], seen: Overview) -> None:
    """Draw range and mean of three accelerations, and the speed, on four axes.

    Windows with samples that cannot be used are shaded.
    """
    minutes = seen.times_s.max() > 300
    time = seen.times_s / (60 if minutes else 1)
    for axis, low, high, mean in zip(axes, seen.low, seen.high, seen.mean, strict=False):
        axis.fill_between(
            time, low, high, step="mid", color="0.6", lw=0.8, label="least to largest value"
        )
        axis.plot(time, mean, color="tab:red", lw=1, label="mean", **_lone_point(time))
        if seen.faulty is not None and seen.faulty.any():
            style: dict[str, Any] = {"color": "tab:orange", "alpha": 0.4, "lw": 0.8}
            style |= {"step": "mid", "transform": axis.get_xaxis_transform()}
            axis.fill_between(time, 0, 1, where=seen.faulty, label="not usable", **style)
    axes[3].plot(time, 3.6 * seen.speed_m_per_s, **_lone_point(time))
    fastest = 3.6 * np.nan_to_num(seen.speed_m_per_s).max(initial=0.0)
    axes[3].set_ylim(0, 1.1 * fastest or None)  # a constant speed lies below the frame
    for axis in axes:
        axis.margins(x=0.01)
        axis.grid(True, alpha=0.3)
    _label_signals(axes, f"time [{'min' if minutes else 's'}]")


def _label_signals(axes: Sequence[Axes], time: str) -> None:
    for axis, channel in zip(axes, CHANNEL_TITLES, strict=False):
        axis.set_ylabel(f"{channel}\n[m/s²]")
    axes[3].set(ylabel="speed\n[km/h]", xlabel=time)


def trip_responses(results: Sequence[TripResult]) -> Figure:
    """Draw magnitude and coherence of both responses, one line for each trip (Fig. 9).

    Colours show the mileage; the last trip has its 95 % band where its spread is known.
    """
    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    shown = [
        response(r.trip, r.mileage_km, r.curves)
        for r in sorted(results, key=lambda r: np.nan_to_num(r.mileage_km, nan=-np.inf))
        if r.curves is not None
    ]
    # colours only if mileages differ: a scale of one value would have no range
    mileage = np.array([curves.mileage_km / 1000 for curves in shown])
    n_distinct = len(np.unique(mileage[np.isfinite(mileage)]))
    scale = Normalize(np.nanmin(mileage), np.nanmax(mileage)) if n_distinct > 1 else None
    for i, (title, (upper, lower)) in enumerate(zip(SUSPENSIONS, axes.T, strict=True)):
        upper.set(title=title)
        lower.set(xlabel="frequency [Hz]", ylim=(0, 1.05))
        for km, curves in zip(mileage, shown, strict=True):
            colour = colormaps["viridis"](scale(km)) if scale and np.isfinite(km) else "0.4"
            upper.semilogy(curves.frequencies_hz, curves.magnitudes[i], color=colour, lw=0.8)
            lower.plot(curves.frequencies_hz, curves.coherences[i], color=colour, lw=0.8)
        for curves in shown[-1:]:
            if np.isfinite(curves.low[i]).any():
                label = "95 % band of the last trip"
                style = {"color": "tab:red", "alpha": 0.25, "lw": 0, "label": label}
                upper.fill_between(curves.frequencies_hz, curves.low[i], curves.high[i], **style)
        for axis in (upper, lower):
            axis.margins(x=0)
            axis.grid(True, which="both", alpha=0.3)
            if not shown:
                say(axis, "no trip has curves")
    axes[0][0].set_ylabel("magnitude")
    axes[1][0].set_ylabel("coherence")
    handles, labels = axes[0][0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper center", fontsize="small")
    if scale is not None:
        figure.colorbar(ScalarMappable(scale, "viridis"), ax=axes, label=MILEAGE_LABEL)
    return figure


def quality(results: Sequence[TripResult]) -> Figure:
    """Draw averages, coherence and usable share of each trip along the mileage.

    Trips without an estimate are hollow.
    """
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes: list[Axes] = list(figure.subplots(3, 1, sharex=True))
    # trips without a mileage have no place along the axis
    placed = [r for r in by_mileage(results) if np.isfinite(r.mileage_km)]
    mileage = np.array([r.mileage_km / 1000 for r in placed])
    done = np.array([r.status == OK for r in placed], dtype=bool)
    panels = (
        (axes[0], "n_averages", "", "o", "tab:blue"),
        (axes[1], "coherence_p", "primary suspension", "o", "tab:blue"),
        (axes[1], "coherence_s", "secondary suspension", "s", "tab:orange"),
        (axes[2], "usable_percent", "", "o", "tab:blue"),
    )
    for axis, field, label, marker, colour in panels:
        values = np.array([getattr(r.quality, field) for r in placed], dtype=float)
        style: dict[str, Any] = {"color": colour, "marker": marker, "ls": "", "ms": 4}
        axis.plot(mileage[done], values[done], label=label or None, **style)
        axis.plot(mileage[~done], values[~done], mfc="none", **style)
    axes[0].set(ylabel="independent\naverages")
    axes[1].set(ylabel="mean\ncoherence", ylim=(0, 1.05))
    axes[2].set(ylabel="usable share\n[%]", ylim=(0, 105), xlabel=MILEAGE_LABEL)
    for axis in axes:
        axis.grid(True, alpha=0.3)
        if not placed:
            say(axis, "no trip with a mileage")
    # from zero, so that a small spread does not look like a change
    most = np.nan_to_num([r.quality.n_averages for r in placed]).max(initial=0.0)
    axes[0].set_ylim(0, 1.1 * most or 1.0)
    if placed:
        axes[1].legend(loc="lower left", ncols=2, fontsize="small")
    if not done.all():
        axes[0].set_title("hollow: trips without an estimate", fontsize="small")
    figure.align_ylabels(axes)
    return figure


def _lone_point(time: FloatArray) -> dict[str, Any]:
    return {"marker": "o"} if len(time) == 1 else {}
