"""The ablation study: where accuracy is lost between the curve and the estimate."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from tabulate import tabulate

from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.feature_information import feature_loss
from suspnet.estimation.problem import TEST, Problem
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.storage import content_hash, dump_arrays, read_json
from suspnet.recordings.core_yaml import read_yaml
from suspnet.report.figures import SYMBOLS
from suspnet.runs.plots import BOUND_COLOUR, OUR_COLOUR
from suspnet.runs.tables import in_digits, mean_known, write_study

log = logging.getLogger(__name__)
N_VEHICLES = 256
"""Test vehicles over which the bounds of features are averaged."""
TICKS, WIDE_TICKS = (1, 1.2, 1.5, 2, 3, 4), (1, 2, 3, 5, 10, 20, 50, 100)
BASELINE = "baseline"
"""Name of the ablation that changes nothing."""
IGNORED = ("ablation_name",)
PARTS = ("protocol", "data", "model")
"""Order in which settings are listed, by the first part of their key."""
Record = dict[str, Any]


def write_ablation(folder: Path) -> list[Record]:
    """Compare the runs of a multirun; write ablation.md, .csv, .json and .png, print the tables.

    Returns the content of the JSON file, see `ablation_records`; [] if no run has finished.
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
    write_study(folder, "ablation", text, records, records, {"ablation": figure(records)})
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
    """Draw rms error and the features' bound over the bound, for each ablation and output."""
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
    axis.axvline(1, color=BOUND_COLOUR, lw=1, label="bound of the curves")
    for record in records:
        if record["ablation"] == BASELINE and record["rms_ratio"] is not None:
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
    metrics: dict[str, Any] = read_json(folder / "metrics.json")
    lost = features_ratio(load_model(folder), known)
    return metrics | {
        "config": read_yaml(folder / "config.yaml"),
        "features_ratio": {name: None if math.isnan(v) else v for name, v in lost.items()},
    }


def flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested mapping flattened to dotted keys.

    >>> flattened({"model": {"C": 1.0, "callback": None}, "seed": 0})
    {'model.C': 1.0, 'model.callback': None, 'seed': 0}
    """
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def changes(config: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings in which a run differs from the baseline, as overrides; both resolved."""
    before, after = flattened(baseline), flattened(config)
    changed = {
        key: value
        for key, value in after.items()
        if key not in IGNORED and (key not in before or before[key] != value)
    }
    return {key: changed[key] for key in sorted(changed, key=_place)}


def ablation_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return one record for each output of each run: bounds, errors and what they were before.

    `runs` are the metrics.json of each run with `config`, its resolved configuration, and
    `features_ratio`, {output: rms bound of its features over that of its curves}. The baseline
    comes first in its group, then settings in a fixed order; without a baseline of the same
    protocol, group and seed, `change` and `to_baseline` (rms_ratio over the baseline's) are None.
    """
    baselines = {_setting(run): run for run in runs if run["ablation"] == BASELINE}
    ordered = []
    for run in runs:
        baseline = baselines.get(_setting(run))
        changed = None if baseline is None else changes(run["config"], baseline["config"])
        ordered.append((_order(run, changed), _records(run, baseline, changed)))
    ordered.sort(key=lambda pair: pair[0])
    return [record for _, records in ordered for record in records]


def ablation_markdown(records: Sequence[Record]) -> str:
    """Return the records of one protocol and group as Markdown, averaged over seeds."""
    outputs = list(dict.fromkeys(r["output"] for r in records))
    rows = []
    for name in dict.fromkeys(r["ablation"] for r in records):
        same = [r for r in records if r["ablation"] == name]
        row = [name]
        for output in outputs:
            chosen = [r for r in same if r["output"] == output]
            for key in ("rms_ratio", "to_baseline", "features_ratio", "mape_percent"):
                row.append(in_digits(mean_known(r[key] for r in chosen)))
        row += [in_digits(mean_known(r[key] for r in same)) for key in ("lost_percent", "seconds")]
        rows.append([*row, same[0]["change"] or ("" if name == BASELINE else "-")])
    header = ["ablation"]
    for output in outputs:
        header += [output, "x", "features", "MAPE %"]
    header += ["lost %", "seconds", "change"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def ablation_caption(records: Sequence[Record]) -> str:
    """Return the caption of a table of one protocol and group."""
    first = next((r for r in records if r["ablation"] == BASELINE), records[0])
    seeds = ", ".join(str(seed) for seed in sorted({r["seed"] for r in records}))
    return (
        f"protocol {first['protocol']}, group {first['group']}, {first['n_train']} training "
        f"curves, {first['snr_db']:g} dB and seed {seeds} unless the change says otherwise.\n"
        "Below each output: rms error over the Cramer-Rao bound of the curves; x: that over the "
        "baseline's;\nfeatures: the bound of the features over that of the curves, which no "
        "unbiased regression on these features\npasses; MAPE. lost: test curves that lack a "
        "feature; seconds: to fit and predict."
    )


def _records(
    run: Mapping[str, Any], baseline: Mapping[str, Any] | None, changed: Mapping[str, Any] | None
) -> list[Record]:
    change = None
    if changed is not None:
        change = " ".join(f"{key}={_shown(value)}" for key, value in changed.items())
    usual = {} if baseline is None else baseline["rms_ratio"]
    return [
        {
            "protocol": run["protocol"],
            "group": run["group"],
            "ablation": run["ablation"],
            "change": change,
            "output": output,
            "rms_ratio": ratio,
            "to_baseline": _over(ratio, usual.get(output)),
            "features_ratio": run["features_ratio"].get(output),
            "mape_percent": run["scores"][output]["mape_percent"],
            "bound": run["bound"][output]["mape_percent"],
            "lost_percent": 100 * (1 - run["n_test_complete"] / run["n_test"]),
            "n_train": run["n_train"],
            "snr_db": run["snr_db"],
            "seed": run["seed"],
            "seconds": run["seconds"],
        }
        for output, ratio in run["rms_ratio"].items()
    ]


def _setting(run: Mapping[str, Any]) -> tuple[Any, ...]:
    return run["protocol"], run["group"], run["seed"]


def _order(run: Mapping[str, Any], changed: Mapping[str, Any] | None) -> tuple[Any, ...]:
    """Return the sorting key of a run: group, the baseline first, then settings and values."""
    places = [(*_place(key), *_rank(value)) for key, value in (changed or {}).items()]
    is_other = run["ablation"] != BASELINE
    return run["protocol"], run["group"], is_other, places, run["ablation"], run["seed"]


def _place(key: str) -> tuple[int, str]:
    first = key.split(".")[0]
    return (PARTS.index(first) if first in PARTS else len(PARTS), key)


def _rank(value: Any) -> tuple[float, str]:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (float(value) if number else 0.0, str(value))


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other
