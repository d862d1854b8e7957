"""Figures of trips: signals, responses and quality of the recordings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from suspnet.ground.types import FloatArray
from suspnet.history.records import OK, TripCurves, TripResult
from suspnet.recordings.recording import Overview
from suspnet.report.plots import SUSPENSIONS

CHANNEL_TITLES = ("axle box", "bogie frame", "car body")
MILEAGE_LABEL = "mileage [1000 km]"
BAND = 1.96
"""Standard deviations on each side that hold 95 % of normally distributed values."""
LARGEST_BAND = 3.0
"""Largest half width of a band in log-magnitude; wider ones would flatten the rest of the axis."""


def trip_signals(result: TripResult) -> Figure:
    """Range and mean of the three accelerations of a trip, and its speed (Fig. 4).

    Parameters
    ----------
    result : TripResult
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
        axes[0].set_title(
            f"trip at {result.mileage_km:,.0f} km".replace(",", " "), fontsize="medium"
        )
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
            axis.fill_between(
                time,
                0,
                1,
                where=seen.faulty,
                step="mid",
                transform=axis.get_xaxis_transform(),
                color="tab:orange",
                alpha=0.4,
                lw=0.8,
                label="not usable",
            )
    axes[3].plot(time, 3.6 * seen.speed_m_per_s, **_lone_point(time))
    axes[3].set_ylim(bottom=0)
    for axis in axes:
        axis.margins(x=0.01)
        axis.grid(True, alpha=0.3)
    _label_signals(axes, f"time [{'min' if minutes else 's'}]")


def _label_signals(axes: Sequence[Axes], time: str) -> None:
    """Name the quantities on the axes of `draw_signals`."""
    for axis, channel in zip(axes, CHANNEL_TITLES, strict=False):
        axis.set_ylabel(f"{channel}\n[m/s²]")
    axes[3].set(ylabel="speed\n[km/h]", xlabel=time)


def trip_responses(results: Sequence[TripResult]) -> Figure:
    """Magnitude and coherence of both responses, one line for each trip (Fig. 9).

    Colours give the mileage; the last trip has its 95 % band, as far as its spread is known.
    """
    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    shown = [(r.mileage_km / 1000, r.curves) for r in by_mileage(results) if r.curves is not None]
    mileage = np.array([km for km, _ in shown])
    distinct = len(np.unique(mileage[np.isfinite(mileage)]))
    scale = Normalize(np.nanmin(mileage), np.nanmax(mileage)) if distinct > 1 else None
    for i, (title, (upper, lower)) in enumerate(zip(SUSPENSIONS, axes.T, strict=True)):
        upper.set(title=title)
        lower.set(xlabel="frequency [Hz]", ylim=(0, 1.05))
        for km, curves in shown:
            colour = colormaps["viridis"](scale(km)) if scale and np.isfinite(km) else "0.4"
            magnitude = np.abs(curves.responses[i])
            upper.semilogy(curves.frequencies_hz, magnitude, color=colour, lw=0.8)
            lower.plot(curves.frequencies_hz, curves.coherences[i], color=colour, lw=0.8)
        if shown:
            _band(upper, shown[-1][1], i)
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
    """Averages, coherence and usable share of each trip along the mileage.

    Trips without an estimate are hollow.
    """
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes: list[Axes] = list(figure.subplots(3, 1, sharex=True))
    placed = by_mileage(r for r in results if np.isfinite(r.mileage_km))
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
    most = np.nan_to_num([r.quality.n_averages for r in placed]).max(initial=0.0)
    axes[0].set_ylim(0, 1.1 * most or 1.0)
    if placed:
        axes[1].legend(loc="lower left", ncols=2, fontsize="small")
    if not done.all():
        figure.suptitle("hollow: trips without an estimate", fontsize="small")
    figure.align_ylabels(axes)
    return figure


def by_mileage(results: Iterable[TripResult]) -> list[TripResult]:
    """Return trips in ascending order; those without a mileage first."""
    return sorted(results, key=lambda r: r.mileage_km if np.isfinite(r.mileage_km) else -np.inf)


def _band(axis: Axes, curves: TripCurves, link: int) -> None:
    """Shade 95 % around a magnitude."""
    magnitude, deviation = np.abs(curves.responses[link]), curves.deviations[link]
    known = np.isfinite(deviation) & np.isfinite(magnitude)
    factor = np.exp(np.minimum(BAND * np.where(known, deviation, 0.0), LARGEST_BAND))
    if known.any():
        axis.fill_between(
            curves.frequencies_hz,
            np.where(known, magnitude / factor, np.nan),
            np.where(known, magnitude * factor, np.nan),
            color="tab:red",
            alpha=0.25,
            lw=0,
            label="95 % band of the last trip",
        )


def _lone_point(time: FloatArray) -> dict[str, Any]:
    """Return the style that makes a line of one point visible."""
    return {"marker": "o"} if len(time) == 1 else {}


def say(axis: Axes, text: str, keep_x: bool = False) -> None:
    """Write the reason on empty axes."""
    axis.text(0.5, 0.5, text, ha="center", va="center", color="0.4", transform=axis.transAxes)
    axis.set_yticks([])
    if not keep_x:
        axis.set_xticks([])
