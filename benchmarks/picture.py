"""The picture of ``against_n``: three panels for each tube, each line named at its end."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cells import Row

PANELS = (("seconds", "fit time [s]"), ("peak_mib", "peak memory [MiB]"), ("rmse", "test RMSE"))


def draw(rows: Sequence[Row], methods: Mapping[str, Any], path: Path) -> None:
    """Draw seconds, memory and error against n, each tube in a row of panels.

    Methods without a tube are drawn beside every one. Of several numbers of threads the largest is
    drawn.
    """
    from matplotlib.figure import Figure

    threads = max(row["threads"] for row in rows)
    rows = [row for row in rows if row["threads"] == threads]
    tubes = sorted({row["epsilon"] for row in rows if methods[row["method"]].has_tube}) or [0.0]
    figure = Figure(figsize=(17, 6 * len(tubes)), layout="constrained")
    axes = figure.subplots(len(tubes), 3, squeeze=False)
    for tube, line in zip(tubes, axes, strict=True):
        drawn = [r for r in rows if r["epsilon"] == tube or not methods[r["method"]].has_tube]
        for axis, (key, title) in zip(line, PANELS, strict=True):
            panel(axis, drawn, methods, key)
            axis.set_title(f"{title}, epsilon {tube:g}", loc="left", fontweight="bold")
    figure.suptitle(
        f"3 inputs, 2 outputs, C = 10, sigma = 1, {threads} threads; thick: suspnet, grey: others"
    )
    figure.savefig(path, dpi=80)


def panel(axis: Any, rows: Sequence[Row], methods: Mapping[str, Any], key: str) -> None:
    """Draw one number against n; each line is named at its end."""
    from matplotlib.ticker import LogLocator

    ends = []
    for name, method in reversed(methods.items()):  # the first on top
        points = sorted((r["n"], r[key]) for r in rows if r["method"] == name and key in r)
        if not points:
            continue
        ours = method.kind == "suspnet"
        axis.loglog(
            *zip(*points, strict=True),
            color=method.colour,
            marker=method.marker,
            lw=2.4 if ours else 1.0,
            ms=6 if ours else 4,
            zorder=3 if ours else 2,
        )
        ends.append((*points[-1], method))
    sizes = sorted({row["n"] for row in rows})
    axis.set_xlabel("training samples n")
    axis.set_xticks(sizes, [f"{n:,}" for n in sizes], fontsize=8, rotation=45)
    axis.xaxis.minorticks_off()
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.minorticks_off()
    axis.grid(True, alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    if ends:
        label(axis, ends)


def label(axis: Any, ends: Sequence[tuple[float, float, Any]]) -> None:
    """Write names in a column right of the plot, in the order of the ends, none over another."""
    low, high = np.log(axis.get_ylim())
    gap = 0.045
    ordered = sorted(ends, key=lambda end: end[1])
    wanted = [(math.log(y) - low) / (high - low) for _, y, _ in ordered]
    places = spread(wanted, gap)
    for (x, y, method), place in zip(ordered, places, strict=True):
        ours = method.kind == "suspnet"
        axis.annotate(
            method.title,
            xy=(x, y),
            xytext=(1.06, place),
            textcoords="axes fraction",
            color=method.colour if ours else "0.35",
            fontweight="bold" if ours else "normal",
            fontsize=9,
            va="center",
            arrowprops={
                "arrowstyle": "-",
                "color": method.colour,
                "lw": 0.8,
                "ls": ":",
                "relpos": (0, 0.5),
                "shrinkA": 1,
            },
        )


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Return increasing places near the wanted ones, about `gap` apart and within 0 to 1."""
    places = list(wanted)
    for _ in range(1000):
        for i in range(1, len(places)):
            missing = max(gap - (places[i] - places[i - 1]), 0.0)
            places[i - 1] -= missing / 2
            places[i] += missing / 2
        places = [min(max(place, 0.0), 1.0) for place in places]
    return places
