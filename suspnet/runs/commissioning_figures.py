"""Figures of a commissioned vehicle: its responses, and its numbers before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from suspnet.estimation.commissioning import Commissioned
from suspnet.estimation.commissioning_summary import Number
from suspnet.estimation.healthy_trips import HealthyTrips
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.ground.wording import kilometres
from suspnet.report.figures import SUSPENSIONS, say
from suspnet.report.tables import band

MEASURED, NOMINAL, FITTED = "0.7", "tab:orange", "tab:blue"
ROW_INCH = 0.21
"""Height of a row of the figure of numbers, [inch]."""
LEAST_RATIO = 0.05
"""Smallest ratio to the drawing that is shown: the axis is logarithmic."""


def residuals(outcome: Commissioned) -> FloatArray:
    """Return the rms of real and imaginary part of the residuals, over that of the noise.

    The shape is (n_groups, 2, n_freq); 1 is expected, NaN is a bin that is not used.
    """
    left = np.abs(1 - outcome.fitted / outcome.observed) / (np.sqrt(2) * outcome.deviations)
    return np.where(np.isfinite(outcome.deviations), left, np.nan)


def shown_group(outcome: Commissioned) -> int:
    """Return the index of the group with the least noise, whose curves a figure shows."""
    return int(np.argmin(np.median(outcome.deviations, axis=(1, 2))))


def responses(found: HealthyTrips, outcome: Commissioned) -> Figure:
    """Draw measured, nominal and commissioned responses of a trip, and all residuals."""
    group = shown_group(outcome)
    shown = found.groups[group]
    frequencies_hz, left = outcome.frequencies_hz, residuals(outcome)
    figure = Figure(figsize=(9.0, 8.4), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey="row", height_ratios=(3, 2, 2))
    km = kilometres(found.manifests[shown.trip].mileage_km)
    where = f"{km}, {3.6 * shown.speed_m_per_s:.0f} km/h"
    curves: tuple[tuple[ComplexArray, str, dict[str, Any]], ...] = (
        (outcome.observed, f"measured at {where}", {"color": MEASURED, "lw": 2.8}),
        (outcome.nominal, "vehicle of the drawing", {"color": NOMINAL, "lw": 1.2, "ls": "--"}),
        (outcome.fitted, "commissioned vehicle", {"color": FITTED, "lw": 1.0}),
    )
    for link, (title, column) in enumerate(zip(SUSPENSIONS, axes.T, strict=True)):
        magnitude, phase, below = column
        magnitude.set(title=title)
        ends = band(np.abs(outcome.observed[group, link]), outcome.deviations[group, link])
        style = {"color": MEASURED, "alpha": 0.4, "lw": 0, "label": "95 % band"}
        magnitude.fill_between(frequencies_hz, *ends, **style)
        for values, label, style in curves:
            one = values[group, link]
            magnitude.semilogy(frequencies_hz, np.abs(one), label=label, **style)
            is_smooth = values is not outcome.observed
            like = outcome.fitted[group, link]
            phase.plot(frequencies_hz, _phase(one, like, is_smooth), **style)
        _residuals(below, frequencies_hz, left[:, link])
    for axis in axes.flat:
        axis.margins(x=0)
        axis.grid(True, which="both", alpha=0.3)
    for axis, label in zip(
        axes[:, 0], ("magnitude", "phase [degrees]", "residual\nover the noise"), strict=True
    ):
        axis.set_ylabel(label)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    figure.align_ylabels(axes)
    return figure


def number_ranges(found: Sequence[Number]) -> Figure:
    """Draw the median and one standard deviation of each number, before and after, over nominal."""
    height = 1.2 + ROW_INCH * len(found)
    figure = Figure(figsize=(9.0, height), layout="constrained")
    axis = figure.subplots()
    places = -np.arange(len(found), dtype=float)
    styles: tuple[tuple[str, str, dict[str, Any]], ...] = (
        ("prior", "before", {"color": "0.65", "lw": 5, "solid_capstyle": "butt"}),
        ("posterior", "after the trips", {"color": FITTED, "lw": 2, "marker": "o", "ms": 3}),
    )
    for which, label, style in styles:
        for place, one in zip(places, found, strict=True):
            ends = np.array(getattr(one, which)) / (one.nominal or 1.0)
            axis.plot(np.maximum(ends, LEAST_RATIO), [place] * 3, markevery=[1], **style)
        axis.plot([], [], label=label, **style)
    axis.set(xscale="log", xlabel="over the value of the drawing", ylim=(places[-1] - 1, 1))
    axis.set_yticks(places, [one.quantity.meaning for one in found], fontsize="x-small")
    ticks = (0.2, 0.5, 1, 2, 5)
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.axvline(1, color="0.4", lw=0.8)
    axis.grid(True, axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=2)
    return figure


def _phase(response: ComplexArray, like: ComplexArray, is_smooth: bool) -> FloatArray:
    """Return a phase [degrees] by whole turns next to the continuous one of a smooth response.

    A smooth response is continuous itself, and lies within half a turn of the other in the median;
    each bin of a measured one lies within half a turn.
    """
    base = np.unwrap(np.angle(like))
    if not is_smooth:
        return np.asarray(np.degrees(base + np.angle(response / like)))
    phase = np.unwrap(np.angle(response))
    return np.asarray(np.degrees(phase) - 360 * np.round(np.median(phase - base) / (2 * np.pi)))


def _residuals(axis: Axes, frequencies_hz: FloatArray, left: FloatArray) -> None:
    """Draw the residual of each group as a thin line, and the rms of all groups."""
    known = np.isfinite(left)
    if not known.any():
        say(axis, "no bin can be used", keep_x=True)
        return
    for one in left:
        axis.plot(frequencies_hz, one, color="0.75", lw=0.5)
    count = known.sum(axis=0)
    total = np.where(known, left, 0.0) ** 2
    rms = np.sqrt(total.sum(axis=0) / np.where(count, count, np.nan))
    axis.plot(frequencies_hz, rms, color=FITTED, lw=1.2, label="rms of all")
    axis.axhline(1, color="black", lw=0.8, ls=":")
    axis.set(xlabel="frequency [Hz]")
    axis.set_ylim(0, max(3.0, 1.1 * float(np.nanmax(rms))))
    axis.legend(fontsize="small", loc="upper right")
