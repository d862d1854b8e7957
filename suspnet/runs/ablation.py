"""The ablation study: where accuracy is lost between the curve and the estimate."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.feature_information import feature_loss
from suspnet.estimation.problem import TEST, Problem
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.storage import (
    content_hash,
    dump_arrays,
    read_json,
    read_plain,
    write_atomically,
    write_json,
)
from suspnet.report.plots import BOUND_COLOUR, OUR_COLOUR, SYMBOLS
from suspnet.report.table6 import records_csv
from suspnet.report.tensorboard import RunLog
from suspnet.runs.ablation_tables import (
    BASELINE,
    Record,
    ablation_caption,
    ablation_markdown,
    ablation_records,
)

log = logging.getLogger(__name__)
N_VEHICLES = 256
"""Test vehicles over which the bounds of features are averaged."""
TICKS, WIDE_TICKS = (1, 1.2, 1.5, 2, 3, 4), (1, 2, 3, 5, 10, 20, 50, 100)


def write_ablation(folder: Path) -> list[Record]:
    """Compare the runs of a multirun; write ablation.md, .csv, .json and .png, print the tables.

    Parameters
    ----------
    folder : Path
        Of the multirun: each run's folder lies in it.

    Returns
    -------
    list of dict
        What the JSON file holds, see `ablation_records`; none where no run has ended.
    """
    files = sorted(folder.glob("*/metrics.json"))
    if not files:
        return []
    known: dict[str, dict[str, float]] = {}
    records = ablation_records([_run(file.parent, known) for file in files])
    parts = [
        [r for r in records if (r["protocol"], r["group"]) == key]
        for key in dict.fromkeys((r["protocol"], r["group"]) for r in records)
    ]
    text = "\n".join(f"{ablation_caption(part)}\n\n{ablation_markdown(part)}\n" for part in parts)
    write_json(folder / "ablation.json", records)
    write_atomically(folder / "ablation.csv", records_csv(records))
    write_atomically(folder / "ablation.md", text)
    with RunLog(folder) as run_log:
        run_log.text("ablation", text)
        run_log.figure("ablation", figure(records), folder)
    log.info("Ablation: where accuracy is lost\n\n%s\n-> %s/ablation.*", text, folder)
    return records


def features_ratio(model: TrainedModel, known: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return the information loss of the features of a model, see `feature_loss`.

    `known` caches the loss of each feature set.
    """
    settings = replace(model.settings, n_test=N_VEHICLES)
    problem = Problem(model.generator, model.task, settings, model.training["seed"])
    learnt = hashlib.sha256(dump_arrays(model.task.extractor.state())).hexdigest()
    key = content_hash(problem.describe(TEST) | {"learnt": learnt})
    if key not in known:
        known[key] = feature_loss(model.task, problem.observer, problem.ratios(TEST))
    return known[key]


def figure(records: Sequence[Record]) -> Figure:
    """Draw the rms error over the bound, and the features' bound, of each ablation and output."""
    outputs = list(dict.fromkeys(r["output"] for r in records))
    names = list(dict.fromkeys(r["ablation"] for r in records))
    size = (2.4 + 2.6 * len(outputs), 1.4 + 0.23 * len(names))
    drawn = Figure(figsize=size, layout="constrained")
    axes = drawn.subplots(1, len(outputs), squeeze=False, sharey=True)[0]
    for axis, output in zip(axes, outputs, strict=True):
        _draw_output(axis, [r for r in records if r["output"] == output], names)
        axis.set_title(SYMBOLS[output])
    axes[0].set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes[0].set_ylim(len(names) - 0.4, -0.6)
    protocols = ", ".join(dict.fromkeys(r["protocol"] for r in records))
    drawn.supxlabel(f"rms error over the bound of the curves, protocol {protocols}", fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return drawn


def _draw_output(axis: Axes, records: Sequence[Record], names: Sequence[str]) -> None:
    """Draw the records of one output against the baseline and the bounds."""
    axis.axvline(1, color=BOUND_COLOUR, lw=1, label="bound of the curves")
    for record in records:
        if record["ablation"] == BASELINE:
            axis.axvline(record["rms_ratio"], color=OUR_COLOUR, ls="--", lw=1, label="baseline")
    for key, style, label in (
        ("features_ratio", {"marker": "|", "ms": 10, "color": "tab:red"}, "bound of the features"),
        ("rms_ratio", {"marker": "o", "ms": 5, "color": OUR_COLOUR}, "estimate"),
    ):
        shown = [r for r in records if r[key] is not None and math.isfinite(r[key])]
        places = [names.index(r["ablation"]) for r in shown]
        axis.plot([r[key] for r in shown], places, ls="none", label=label, **style)  # type: ignore[arg-type]
    axis.set_xscale("log")
    low, high = axis.get_xlim()
    ticks = [tick for tick in (TICKS if high < 5 else WIDE_TICKS) if tick < high]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlim(min(low, 0.95), high)
    axis.grid(True, axis="both", alpha=0.3)


def _run(folder: Path, known: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Return the metrics of a run with its configuration and what its features lose."""
    metrics: dict[str, Any] = read_json(folder / "metrics.json")
    lost = features_ratio(load_model(folder), known)
    return metrics | {
        "config": yaml.safe_load(read_plain(folder / "config.yaml")),
        "features_ratio": {name: None if math.isnan(v) else v for name, v in lost.items()},
    }
