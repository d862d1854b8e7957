"""Figures of trips: signals and responses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from suspnet.ground.findings import Finding, together
from suspnet.ground.records import Overview, TripCurves, TripResult, interval_ends
from suspnet.ground.types import FloatArray
from suspnet.runs.figures import MILEAGE_LABEL, SUSPENSIONS, say

if TYPE_CHECKING:  # the history imports SQLAlchemy, 0.4 s
    from suspnet.trains.history.arrays import TripResponses

CHANNEL_TITLES = ("axle box", "bogie frame", "car body")
BAND = 1.96  # standard deviations on each side that hold 95 % of normally distributed values
LARGEST_BAND = 3.0  # half width of a drawn band in log-magnitude; wider would flatten the axis


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
    lone: dict[str, Any] = {"marker": "o"} if len(time) == 1 else {}
    for axis, low, high, mean in zip(axes, seen.low, seen.high, seen.mean, strict=False):
        axis.fill_between(
            time, low, high, step="mid", color="0.6", lw=0.8, label="least to largest value"
        )
        axis.plot(time, mean, color="tab:red", lw=1, label="mean", **lone)
        if seen.faulty is not None and seen.faulty.any():
            style: dict[str, Any] = {"color": "tab:orange", "alpha": 0.4, "lw": 0.8}
            style |= {"step": "mid", "transform": axis.get_xaxis_transform()}
            axis.fill_between(time, 0, 1, where=seen.faulty, label="not usable", **style)
    axes[3].plot(time, 3.6 * seen.speed_m_per_s, **lone)
    fastest = 3.6 * np.nan_to_num(seen.speed_m_per_s).max(initial=0.0)
    axes[3].set_ylim(0, 1.1 * fastest or None)  # a constant speed lies below the frame
    for axis in axes:
        axis.margins(x=0.01)
        axis.grid(True, alpha=0.3)
    for axis, channel in zip(axes, CHANNEL_TITLES, strict=False):
        axis.set_ylabel(together((channel, "[m/s²]"), "\n"))
    axes[3].set(ylabel="speed\n[km/h]", xlabel=f"time [{'min' if minutes else 's'}]")


def response_figure(trips: Sequence[tuple[float, TripCurves | TripResponses | None]]) -> Figure:
    """Draw magnitude and coherence of both responses, one line for each trip (Fig. 9).

    `trips` are mileages and curves; those without are left out. Colours show the mileage; the last
    trip has its 95 % band where its spread is known.
    """
    # not "constrained", which takes half of the time of drawing
    figure = Figure(figsize=(8.4, 5.6))
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    figure.subplots_adjust(left=0.09, right=0.98, bottom=0.09, top=0.88, hspace=0.1, wspace=0.05)
    measured = [(km, curves) for km, curves in trips if curves is not None]
    shown = sorted(measured, key=lambda trip: np.nan_to_num(trip[0], nan=-np.inf))
    # colours only if mileages differ: a scale of one value would have no range
    mileage = np.array([km / 1000 for km, _ in shown])
    n_distinct = len(np.unique(mileage[np.isfinite(mileage)]))
    scale = Normalize(np.nanmin(mileage), np.nanmax(mileage)) if n_distinct > 1 else None
    for i, (title, (upper, lower)) in enumerate(zip(SUSPENSIONS, axes.T, strict=True)):
        upper.set(title=title)
        lower.set(xlabel="frequency [Hz]", ylim=(0, 1.05))
        for km, (_, curves) in zip(mileage, shown, strict=True):
            colour = colormaps["viridis"](scale(km)) if scale and np.isfinite(km) else "0.4"
            magnitudes = np.abs(curves.responses[i])
            upper.semilogy(curves.frequencies_hz, magnitudes, color=colour, lw=0.8)
            lower.plot(curves.frequencies_hz, curves.coherences[i], color=colour, lw=0.8)
        for _, curves in shown[-1:]:
            low, high = band(np.abs(curves.responses[i]), curves.deviations[i])
            if np.isfinite(low).any():
                label = "95 % band of the last trip"
                style = {"color": "tab:red", "alpha": 0.25, "lw": 0, "label": label}
                upper.fill_between(curves.frequencies_hz, low, high, **style)
        for axis in (upper, lower):
            axis.margins(x=0)
            axis.grid(True, which="both", alpha=0.3)
            if not shown:
                say(axis, "no trip has curves")
    axes[0][0].set_ylabel("magnitude")
    axes[1][0].set_ylabel("coherence")
    handles, labels = axes[0][0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="upper center", fontsize="small")
    if scale is not None:
        figure.colorbar(ScalarMappable(scale, "viridis"), ax=axes, label=MILEAGE_LABEL, pad=0.02)
    return figure


def band(magnitudes: FloatArray, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the 95 % band around magnitudes; NaN where a deviation is not finite.

    Deviations are standard deviations of the log-magnitude.
    """
    finite = np.where(np.isfinite(deviations), deviations, np.nan)
    half = np.minimum(BAND * finite, LARGEST_BAND)
    low, high = interval_ends(magnitudes, half)
    return low, high
