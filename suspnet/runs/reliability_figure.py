"""The figure of the reliability study."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.report.figures import SYMBOLS
from suspnet.runs.plots import BOUND_COLOUR, OUR_COLOUR
from suspnet.runs.reliability_findings import Reliability

NOMINAL, TOLERANCE = 90.0, 1.5
"""Nominal coverage and the tolerance of a slice's coverage, both in %."""


def reliability_figure(found: Sequence[Reliability]) -> Figure:
    """Draw the coverage of each parameter's slices and the share of flagged curves of each set."""
    height = max(3.2, 0.9 + 0.2 * len(found[0].flags))
    figure = Figure(figsize=(10.0, height * len(found)), layout="constrained")
    axes = figure.subplots(len(found), 2, squeeze=False, width_ratios=(1.3, 1))
    for one, (left, right) in zip(found, axes, strict=True):
        _draw_slices(left, one)
        left.set_title(one.name, fontsize="medium")
        _draw_flags(right, one)
    return figure


def _draw_slices(axis: Axes, one: Reliability) -> None:
    """Draw a line for each output over the fifths of each parameter; dashed is a GP's own."""
    axis.axhspan(NOMINAL - TOLERANCE, NOMINAL + TOLERANCE, color="0.9")
    axis.axhline(NOMINAL, color=BOUND_COLOUR, lw=0.8)
    for style, scores in zip(("o-", "s--"), one.intervals.values(), strict=False):
        for place, by_output in enumerate(scores["slices"].values()):
            for j, (output, values) in enumerate(by_output.items()):
                x = [place + (k - 2) * 0.17 for k in range(len(values))]
                named = SYMBOLS[output] if place == 0 and style == "o-" else None
                axis.plot(x, values, style, color=f"C{j}", ms=3, lw=1, label=named)
    names = list(next(iter(one.intervals.values()))["slices"])
    axis.set_xticks(range(len(names)), [f"fifths of {SYMBOLS[name]}" for name in names])
    axis.set_ylabel(f"coverage of {NOMINAL:g} % intervals [%]")
    axis.margins(y=0.25)
    axis.legend(ncols=4, fontsize="small", loc="lower center")


def _draw_flags(axis: Axes, one: Reliability) -> None:
    """Draw a bar for the share of flagged curves of each set."""
    names = list(one.flags)[::-1]
    values = [one.flags[name]["any"] for name in names]
    axis.barh(names, values, color=[OUR_COLOUR if v > 1 else "0.6" for v in values])
    for place, value in enumerate(values):
        axis.text(min(value, 100) + 1, place, f"{value:.3g}", va="center", fontsize="x-small")
    axis.tick_params(axis="y", labelsize="x-small")
    axis.set(xlabel="flagged [%]", xlim=(0, 112))
