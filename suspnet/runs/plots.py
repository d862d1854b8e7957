"""Figures of curves, features, predictions and comparisons; each function returns a new Figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.ground.types import FloatArray
from suspnet.runs.figures import SUSPENSIONS, SYMBOLS
from suspnet.runs.tables import (
    MODEL_TITLES,
    grouped,
    models_of,
    table6_caption,
)

PAPER_COLOUR, OUR_COLOUR, BOUND_COLOUR = "0.75", "tab:blue", "black"


def peak_fits(
    frequencies_hz: FloatArray, curves: FloatArray, features: Mapping[str, float]
) -> Figure:
    """Draw noisy curves with their peaks: position, height and half-power width.

    `frequencies_hz`: (n_freq,); `curves`: (2, n_freq); `features`: values by name, peak_measure.
    """
    figure, axes = grid(1, 2)
    for axis, title, curve in zip(axes[0], SUSPENSIONS, curves, strict=True):
        axis.plot(frequencies_hz, curve, color="0.6", lw=0.8)
        axis.set(title=title, xlabel="frequency [Hz]", ylabel="magnitude", xlim=(0, 15))
    peaks = sorted({name.rsplit("_", 1)[0] for name in features})
    for peak in peaks:
        axis = axes[0][1] if peak == "secondary" else axes[0][0]
        position, height = features[f"{peak}_position"], features[f"{peak}_height"]
        half = features[f"{peak}_width"] / 2
        level = height / math.sqrt(2)
        axis.plot([position], [height], "o", label=peak.replace("_", " "))
        axis.plot([position - half, position + half], [level, level], "|-", color="tab:red", lw=1)
        axis.legend()
    return figure


def parity(actual: FloatArray, predicted: FloatArray, names: Sequence[str]) -> Figure:
    """Draw predicted against actual ratios to healthy."""
    figure, axes = grid(1, len(names))
    for j, (axis, name) in enumerate(zip(axes[0], names, strict=True)):
        axis.plot(actual[:, j], predicted[:, j], ".", ms=4, alpha=0.4)
        span = [actual[:, j].min(), actual[:, j].max()]
        axis.plot(span, span, color="black", lw=0.8)
        axis.set(title=SYMBOLS[name], xlabel="actual / healthy", ylabel="estimated / healthy")
    return figure


def table6(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw published and measured MAPE of each model and output, with the Cramer-Rao bound."""
    shown = [r for r in records if r["metric"] == "mape_percent"]
    by_output, models = grouped(shown, "output"), models_of(shown)
    figure, axes = grid(1, len(by_output), size=(3.2, 3.4), sharey=True)
    for axis, ((output,), same) in zip(axes[0], by_output.items(), strict=True):
        by_model = {r["model"]: r for r in same}
        for x, model in enumerate(models):
            record = by_model.get(model)
            if record is None:
                continue
            # the paper's figure and ours side by side
            for shift, key, colour in (
                (-0.2, "published", PAPER_COLOUR),
                (0.2, "measured", OUR_COLOUR),
            ):
                if record[key] is not None:
                    bar = axis.bar(x + shift, record[key], 0.4, color=colour)
                    axis.bar_label(bar, [f"{record[key]:.2g}"], fontsize=7)
        bound = next(iter(by_model.values()))["bound"]
        if bound is not None:  # an output that the curves do not identify has none
            axis.axhline(bound, color=BOUND_COLOUR, ls="--", lw=1)
        axis.set(title=SYMBOLS[output], yscale="log")
        axis.margins(y=0.15)
        axis.set_xticks(range(len(models)), [MODEL_TITLES[m] for m in models], rotation=30)
    axes[0][0].set_ylabel("MAPE [%]")
    # bars of height 0 stand for the two kinds in the legend
    handles: list[Any] = [
        axes[0][0].bar(0, 0, color=PAPER_COLOUR),
        axes[0][0].bar(0, 0, color=OUR_COLOUR),
        axes[0][0].plot([], [], color=BOUND_COLOUR, ls="--")[0],
    ]
    figure.suptitle(table6_caption(records), fontsize="small")
    labels = ["paper's Table VI", "measured", "Cramer-Rao bound"]
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def grid(
    n_rows: int, n_columns: int, size: tuple[float, float] = (4.2, 3.2), **options: Any
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure with axes in rows and columns, each of a size [inch] and with grid lines."""
    figure = Figure(figsize=(size[0] * n_columns, size[1] * n_rows), layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(True, which="both", alpha=0.3)
        axis.set_axisbelow(True)
    return figure, [list(row) for row in axes]
