"""The figure of the identifiability study."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.dynamics import PARAMETERS
from suspnet.estimation.bounds import UNIDENTIFIED, VERDICTS, Bound
from suspnet.estimation.options import Option
from suspnet.report.figures import SYMBOLS
from suspnet.runs.findings import Findings
from suspnet.runs.plots import OUR_COLOUR


def identifiability_figure(groups: Sequence[Findings]) -> Figure:
    """Draw how well each parameter is identified, and what measuring less or more would change."""
    height = 1.6 + 0.36 * max(len(found.table) for found in groups)
    figure = Figure(figsize=(11.2, height * len(groups)), layout="constrained")
    axes = figure.subplots(len(groups), 2, squeeze=False, width_ratios=(1, 1.25))
    for (left, right), found in zip(axes, groups, strict=True):
        _draw_bounds(left, found.bounds_now)
        measured = _symbolic(found.now.title)
        left.set_title(f"group {found.task.group}, {measured}:\n5th to 95th percentile, quartiles")
        _draw_options(right, found.table)
        right.set_title("median bound over the range [%],\nblue: less than in the first row")
    return figure


def _draw_bounds(axis: Axes, bounds: Sequence[Bound]) -> None:
    """Draw 5th to 95th percentile, quartiles and median of each bound over the verdicts."""
    finite = [p for bound in bounds for p in bound.percentiles if math.isfinite(p)]
    low, high = min([0.1, *finite]) / 2, max([50.0, *finite]) * 2
    edge = low
    for k, (threshold, word) in enumerate([*VERDICTS, (high, UNIDENTIFIED)]):
        axis.axhspan(edge, threshold, color="black", alpha=0.06 * k, lw=0)
        axis.annotate(
            word, (0.99, threshold / 1.05), xycoords=("axes fraction", "data"), ha="right", va="top"
        )
        edge = threshold
    for x, bound in enumerate(bounds):
        p05, p25, median, p75, p95 = np.minimum(bound.percentiles, high / 1.6)
        if math.isfinite(bound.median_percent):
            axis.plot([x, x], [p05, p95], color=OUR_COLOUR, lw=1.5)
            axis.plot([x, x], [p25, p75], color=OUR_COLOUR, lw=9, alpha=0.6, solid_capstyle="butt")
            axis.text(x + 0.13, median, f"{median:.2g}", va="center", fontsize="small")
        axis.plot([x], [median], "o" if median == bound.median_percent else "^", color="black")
    axis.set(yscale="log", ylim=(low, high), xlim=(-0.6, len(bounds)))
    axis.set_ylabel("standard deviation at best [%]")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_xticks(range(len(bounds)), [SYMBOLS[bound.parameter] for bound in bounds])


def _draw_options(axis: Axes, table: Sequence[tuple[Option, Sequence[Bound]]]) -> None:
    """Draw a table of median bounds, blue where they are less than in the first row."""
    rows = [{bound.parameter: bound.median_percent for bound in found} for _, found in table]
    names = [name for name in PARAMETERS if any(name in row for row in rows)]
    medians = np.array([[row.get(name, np.nan) for name in names] for row in rows])
    finite = np.where(np.isinf(medians), 1e9, medians)  # far beyond the scale of colours
    change = np.log2(finite / finite[0])
    axis.imshow(change, cmap="RdBu_r", vmin=-3, vmax=3, aspect="auto")
    for (i, j), median in np.ndenumerate(medians):
        text = "known" if np.isnan(median) else f"{median:.2g}"
        colour = "white" if abs(change[i, j]) > 2 else "black"
        axis.text(j, i, text.replace("inf", UNIDENTIFIED), ha="center", va="center", color=colour)
    axis.set_xticks(range(len(names)), [SYMBOLS[name] for name in names])
    titles = [_symbolic(option.title) for option, _ in table]
    axis.set_yticks(range(len(table)), [f"{titles[0]}, as now", *titles[1:]])
    axis.tick_params(length=0)


def _symbolic(words: str) -> str:
    """Return words with the two responses set as mathematics."""
    return words.replace("G_p", "$G_p$").replace("G_s", "$G_s$")
