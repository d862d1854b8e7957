"""Figures of curves, features, predictions and comparisons; each function returns a new Figure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.ground.types import FloatArray
from suspnet.runs.figures import SUSPENSIONS, SYMBOLS
from suspnet.runs.tables import MODEL_TITLES, grouped, models_of

BOUND_COLOUR = "black"
FONT_POINTS = 12
"""Size of all texts of a figure with one axis, which stays readable in a row of small images."""
PEAKS = dict(zip(("primary", "secondary"), SUSPENSIONS, strict=True))
"""Titles of the suspensions whose peaks are drawn."""


@mpl.rc_context({"font.size": FONT_POINTS})
def peak_fit(
    frequencies_hz: FloatArray, curve: FloatArray, features: Mapping[str, float], suspension: str
) -> Figure:
    """Draw a noisy curve of a suspension with its peaks: position, height and half-power width.

    `frequencies_hz`, `curve`: (n_freq,); `features`: values by name, peak_measure.
    """
    figure, axis = single()
    draw_peaks(axis, frequencies_hz, curve, features, suspension)
    return figure


def draw_peaks(
    axis: Axes,
    frequencies_hz: FloatArray,
    curve: FloatArray,
    features: Mapping[str, float],
    suspension: str,
) -> None:
    """Draw on an axis what ``peak_fit`` draws."""
    axis.plot(frequencies_hz, curve, color="0.6", lw=0.8)
    title = PEAKS[suspension]
    axis.set(title=title, xlabel="frequency [Hz]", ylabel="magnitude", xlim=(0, 15))
    peaks = sorted({name.rsplit("_", 1)[0] for name in features})
    for peak in peaks:
        if (peak == "secondary") != (suspension == "secondary"):
            continue
        position, height = features[f"{peak}_position"], features[f"{peak}_height"]
        half = features[f"{peak}_width"] / 2
        level = height / math.sqrt(2)
        axis.plot([position], [height], "o", label=peak.replace("_", " "))
        axis.plot([position - half, position + half], [level, level], "|-", color="tab:red", lw=1)
        axis.legend()


@mpl.rc_context({"font.size": FONT_POINTS})
def parity(actual: FloatArray, predicted: FloatArray, name: str) -> Figure:
    """Draw predicted against actual ratios to healthy of one output."""
    figure, axis = single()
    axis.plot(actual, predicted, ".", ms=4, alpha=0.4)
    span = [actual.min(), actual.max()]
    axis.plot(span, span, color="black", lw=0.8)
    axis.set(title=SYMBOLS[name], xlabel="actual / healthy", ylabel="estimated / healthy")
    return figure


@mpl.rc_context({"font.size": FONT_POINTS})
def table6(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the measured MAPE of each model and output, the published one and Cramer-Rao's bound."""
    shown = [r for r in records if r["metric"] == "mape_percent"]
    by_output, models = grouped(shown, "output"), models_of(shown)
    width = 0.8 / len(models)
    figure, axis = single((6.4, 4.4))
    for k, same in enumerate(by_output.values()):
        for j, model in enumerate(models):
            record = next((r for r in same if r["model"] == model), None)
            if record is None:
                continue
            x = k + (j + 0.5) * width - 0.4
            axis.bar(x, record["measured"], width, color=f"C{j}")
            if record["published"] is not None:
                axis.plot(x, record["published"], "D", color="black", mfc="white", ms=5)
        bound = same[0]["bound"]
        if bound is not None:  # an output that the curves do not identify has none
            axis.plot([k - 0.45, k + 0.45], [bound, bound], color=BOUND_COLOUR, ls="--", lw=1)
    axis.set(ylabel="MAPE [%]", yscale="log")
    axis.set_xticks(range(len(by_output)), [SYMBOLS[output] for (output,) in by_output])
    # artists without data stand for the kinds in the legend
    handles: list[Any] = [axis.bar(0, 0, color=f"C{j}") for j in range(len(models))]
    handles += axis.plot([], [], "D", color="black", mfc="white", ms=5)
    handles += axis.plot([], [], color=BOUND_COLOUR, ls="--", lw=1)
    labels = [*(MODEL_TITLES[model] for model in models), "paper", "bound"]
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def single(size: tuple[float, float] = (4.8, 3.6)) -> tuple[Figure, Axes]:
    """Return a figure with one axis, whose ticks have the size of its texts."""
    figure, [[axis]] = grid(1, 1, size)
    axis.tick_params(labelsize=FONT_POINTS)
    return figure, axis


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
