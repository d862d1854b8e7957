"""Readings of what the paper leaves open, by the distance of their results to its Table VI.

python train.py experiment=readings
python benchmarks/readings.py outputs/readings/RUN

Writes readings.csv, .json, .md and .png into the folder of the multirun.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from cells import Parser
from matplotlib.figure import Figure

from suspnet.ground.storage import read_json
from suspnet.runs.figures import SYMBOLS
from suspnet.runs.tables import (
    MODEL_TITLES,
    PUBLISHED,
    Record,
    in_digits,
    markdown,
    write_study,
)

OUTPUTS = ("k_p", "c_p", "k_s", "c_s")
METHODS = tuple(PUBLISHED["k_p", "mape_percent"])
TEST_SETS = {
    "all": "all test curves",
    "varied": "curves on which the part is not healthy",
    "degraded": "curves on which the part is below healthy",
}
"""Title of each choice of the test curves."""
Cells = Mapping[tuple[str, str, str], float]
"""Value of each output, metric and method."""


def write_readings(runs: Sequence[Mapping[str, Any]], folder: Path) -> list[Record]:
    """Compare the readings behind some runs (metrics.json) with Table VI; write and print a table.

    Returns one record for each reading and choice of test curves, nearest first; readings without a
    run of each method and output are left out.
    """
    records = reading_records(runs)
    complete = len({r["reading"] for r in records})
    parts = [
        f"Test curves: {title}\n\n{readings_markdown([r for r in records if r['test'] == name])}"
        for name, title in TEST_SETS.items()
    ]
    caption = (
        f"MAPE in % of {', '.join(MODEL_TITLES[m] for m in METHODS)}. distance: mean |log(ours / "
        "paper's)| of the 16 MAPE; in order: outputs whose four errors have the paper's order; "
        f"RMSE / MAPE: smallest and largest of 16. {complete} readings were compared, so the "
        "nearest is chosen after the fact."
    )
    text = "\n\n".join([*parts, caption]) + "\n"
    figures = {"readings": figure(records)} if records else {}
    title = "Readings of the paper against its Table VI"
    write_study(folder, "readings", title, text, records, [_flat(r) for r in records], figures)
    return records


def reading_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return distance to Table VI, order of the methods and errors of each reading."""
    records = []
    for test in TEST_SETS:
        for reading in dict.fromkeys(run["reading"] for run in runs):
            cells = _cells([run for run in runs if run["reading"] == reading], test)
            if cells is not None:
                records.append({"reading": reading, "test": test, **compare(cells)})
    return sorted(records, key=lambda r: (list(TEST_SETS).index(r["test"]), r["distance"]))


def _cells(runs: Sequence[Mapping[str, Any]], test: str) -> Cells | None:
    """Return the mean over seeds of each cell of Table VI; None if one is missing."""
    values_of: dict[tuple[str, str, str], list[float]] = {}
    for run in runs:
        scores = run["scores"] if test == "all" else run["scores_where"][test]
        for output, values in scores.items():
            for metric, value in values.items():
                values_of.setdefault((output, metric, run["model"]), []).append(value)
    wanted = [(*key, model) for key, models in PUBLISHED.items() for model in models]
    if any(None in values_of.get(key, [None]) for key in wanted):
        return None
    return {key: fmean(values_of[key]) for key in wanted}


def compare(cells: Cells) -> Record:
    """Return how far results are from Table VI.

    `distance` is the mean of |log(ours / paper's)| over the 16 MAPE; `in_order` counts the outputs
    whose methods' errors ascend as in the paper, `linear_last` those where linear regression is
    last; `rmse_over_mape` are the smallest and the largest ratio of RMSE to MAPE as a fraction.
    """
    mape = {
        output: [cells[output, "mape_percent", model] for model in METHODS] for output in OUTPUTS
    }
    published = {
        output: [PUBLISHED[output, "mape_percent"][model] for model in METHODS]
        for output in OUTPUTS
    }
    pairs = [pair for name in OUTPUTS for pair in zip(mape[name], published[name], strict=True)]
    ratios = [
        100 * cells[output, "rmse", model] / cells[output, "mape_percent", model]
        for output in OUTPUTS
        for model in METHODS
    ]
    return {
        "distance": fmean(abs(math.log(ours / paper)) for ours, paper in pairs),
        "in_order": sum(values == sorted(values) for values in mape.values()),
        "linear_last": sum(values[-1] == max(values) for values in mape.values()),
        "rmse_over_mape": [min(ratios), max(ratios)],
        "mape_percent": mape,
    }


def readings_markdown(records: Sequence[Record]) -> str:
    """Return a table of readings below the paper's own row."""
    published = {
        (*key, model): value for key, models in PUBLISHED.items() for model, value in models.items()
    }
    rows = [_row({"reading": "the paper", **compare(published)}), *map(_row, records)]
    header = ["reading", "distance", "in order", "linear last", "RMSE / MAPE", *OUTPUTS]
    return markdown(rows, header)


def _row(record: Record) -> list[str]:
    low, high = record["rmse_over_mape"]
    return [
        record["reading"].replace("_", " "),
        f"{record['distance']:.2f}",
        f"{record['in_order']} of 4",
        f"{record['linear_last']} of 4",
        f"{low:.2f} to {high:.2f}",
        *(" ".join(map(in_digits, record["mape_percent"][output])) for output in OUTPUTS),
    ]


def _flat(record: Record) -> Record:
    """Return a record with a column for each MAPE."""
    low, high = record["rmse_over_mape"]
    flat = {k: v for k, v in record.items() if k not in ("mape_percent", "rmse_over_mape")}
    flat |= {"rmse_over_mape_low": low, "rmse_over_mape_high": high}
    for output, values in record["mape_percent"].items():
        flat |= {f"{output}_{m}": value for m, value in zip(METHODS, values, strict=True)}
    return flat


def figure(records: Sequence[Record]) -> Figure:
    """Draw the MAPE of each reading's methods next to the paper's, for each output."""
    shown = [r for r in records if r["test"] == "all"]
    drawn = Figure(figsize=(12, 1.8 + 0.28 * len(shown)), layout="constrained")
    axes = drawn.subplots(1, len(OUTPUTS), sharey=True)
    colours = ("tab:blue", "tab:orange", "tab:green", "tab:red")
    for axis, output in zip(axes, OUTPUTS, strict=True):
        for method, colour, published, values in zip(
            METHODS,
            colours,
            PUBLISHED[output, "mape_percent"].values(),
            zip(*(r["mape_percent"][output] for r in shown), strict=True),
            strict=True,
        ):
            axis.axvline(published, color=colour, lw=1, ls="--")
            axis.plot(values, range(len(shown)), "o", color=colour, label=MODEL_TITLES[method])
        axis.set_xscale("log")
        axis.set_title(SYMBOLS[output])
        axis.grid(True, axis="both", alpha=0.3)
    axes[0].set_yticks(range(len(shown)), [r["reading"].replace("_", " ") for r in shown])
    axes[0].set_ylim(len(shown) - 0.4, -0.6)
    legend_above(drawn)
    drawn.supxlabel("MAPE, %; dashed: the paper's Table VI")
    return drawn


def legend_above(figure: Figure) -> None:
    """Add the legend of the first axes above all of them."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def summarise(write: Callable[[Sequence[Mapping[str, Any]], Path], Any], words: str) -> None:
    """Summarise the runs of the multirun that the command line names."""
    parser = Parser(description=words)
    parser.add_argument("folder", type=Path, help="folder of the multirun")
    folder = parser.parse_args().folder
    runs = [read_json(path) for path in sorted(folder.glob("*/metrics.json"))]
    if not runs:
        parser.error(f"{folder} holds no */metrics.json; is it the folder of a multirun?")
    write(runs, folder)
    print((folder / f"{words}.md").read_text())


if __name__ == "__main__":
    summarise(write_readings, "readings")
