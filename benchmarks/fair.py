"""Methods that were tuned alike: errors over seeds, and paired differences to MSVR.

python train.py experiment=fair
python benchmarks/fair.py outputs/fair/RUN

Writes fair.csv, .json, .md and .png into the folder of the multirun.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from matplotlib.figure import Figure
from readings import METHODS, legend_above, summarise

from suspnet.runs.figures import SYMBOLS
from suspnet.runs.plots import grid
from suspnet.runs.tables import (
    MODEL_TITLES,
    PUBLISHED,
    Record,
    grouped,
    in_digits,
    markdown,
    models_of,
    write_study,
)

REFERENCE = "msvr"
"""Method that the others are compared with."""
TITLES = {
    "stored": "settings of experiment=table6",
    "fair": "Table V's ranges",
    "fair_widened": "beyond Table V",
}
"""Title of each option of the group `search`."""


def write_fair(runs: Sequence[Mapping[str, Any]], folder: Path) -> list[Record]:
    """Compare the MAPE of runs (metrics.json) that differ in search, seed, group and method.

    Writes fair.json, .csv, .md and .png; returns a record for each search, output and method.
    """
    scores = _scores(runs)
    records = fair_records(runs)
    text = "\n\n".join(
        [
            "MAPE in %: mean and standard deviation over seeds",
            errors_markdown(records),
            f"MAPE less that of {MODEL_TITLES[REFERENCE]} on the same curves: mean and its "
            "standard error, and the seeds on which it is smaller",
            differences_markdown(records),
            "Seeds on which the methods of Table VI are in the paper's order",
            _orders_markdown(scores),
            *edge_lines(runs),
        ]
    )
    figures = {"fair": _figure(records)}
    write_study(folder, "fair", "Methods tuned alike", f"{text}\n", records, records, figures)
    return records


def _scores(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return the MAPE of each run and output, and its bound."""
    return [
        {
            "search": run.get("search_name", "stored"),
            "output": output,
            "model": run["model"],
            "seed": run["seed"],
            "mape_percent": values["mape_percent"],
            "bound": run["bound"][output]["mape_percent"],
        }
        for run in runs
        for output, values in run["scores"].items()
    ]


def fair_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return mean MAPE over seeds, and the paired difference to MSVR's, for each method.

    `difference` is the mean over the `n_pairs` seeds of both, `error` its standard error and
    `n_better` the number of these on which the method's MAPE is smaller; None where MSVR or a
    second seed is missing.
    """
    scores = _scores(runs)
    by_seed = {
        key: {score["seed"]: score["mape_percent"] for score in same}
        for key, same in grouped(scores, "search", "output", "model").items()
    }
    of_output = grouped(scores, "search", "output")
    records = []
    for (name, output, model), errors in by_seed.items():
        bounds = [s["bound"] for s in of_output[name, output] if s["bound"] is not None]
        reference = by_seed.get((name, output, REFERENCE), {})
        pairs = [errors[seed] - reference[seed] for seed in errors if seed in reference]
        records.append(
            {
                "search": name,
                "output": output,
                "model": model,
                "n_seeds": len(errors),
                "mape_percent": fmean(errors.values()),
                "deviation": stdev(errors.values()) if len(errors) > 1 else None,
                "difference": fmean(pairs) if pairs else None,
                "error": stdev(pairs) / math.sqrt(len(pairs)) if len(pairs) > 1 else None,
                "n_pairs": len(pairs),
                "n_better": sum(pair < 0 for pair in pairs),
                "bound": fmean(bounds) if bounds else None,
            }
        )
    return records


def errors_markdown(records: Sequence[Record]) -> str:
    """Return mean and deviation of each method's MAPE, the least of the trained ones in bold."""
    models = models_of(records)
    rows = []
    for (name, output), same in grouped(records, "search", "output").items():
        least = min(r["mape_percent"] for r in same if r["model"] != "curve_fit")
        by_model = {r["model"]: r for r in same}
        row = [TITLES.get(name, name), output]
        for model in models:
            record = by_model.get(model, {"mape_percent": None, "deviation": None})
            words = with_deviation(record["mape_percent"], record["deviation"])
            row.append(f"**{words}**" if record["mape_percent"] == least else words)
        rows.append([*row, in_digits(same[0]["bound"])])
    return markdown(rows, ["tuned in", "output", *(MODEL_TITLES[m] for m in models), "bound"])


def differences_markdown(records: Sequence[Record]) -> str:
    """Return the paired differences to MSVR's MAPE of the other methods."""
    models = [model for model in models_of(records) if model != REFERENCE]
    rows = []
    for (name, output), same in grouped(records, "search", "output").items():
        by_model = {r["model"]: r for r in same if r["n_pairs"]}
        row = [TITLES.get(name, name), output]
        for model in models:
            record = by_model.get(model)
            if record is None:
                row.append("-")
                continue
            words = with_deviation(record["difference"], record["error"])
            row.append(f"{words} ({record['n_better']} of {record['n_pairs']})")
        rows.append(row)
    return markdown(rows, ["tuned in", "output", *(MODEL_TITLES[m] for m in models)])


def edge_lines(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return which optima lie on the edge of their grid, and on how many seeds and groups."""
    counts = Counter(
        (run["search_name"], run["model"], key, run["search"]["best"][key])
        for run in runs
        for key in run.get("search", {}).get("edges", {})
    )
    lines = [
        f"- {TITLES.get(name, name)}: {MODEL_TITLES[model]}, {key} = {value:g} in {n} searches"
        for (name, model, key, value), n in sorted(counts.items())
    ]
    return ["Optima on the edge of their grid:\n\n" + "\n".join(lines)] if lines else []


def _orders_markdown(scores: Sequence[Record]) -> str:
    """Return on how many seeds the errors of the paper's methods ascend as in its Table VI."""
    rows = []
    for (name, output), same in grouped(scores, "search", "output").items():
        by_seed = [
            {score["model"]: score["mape_percent"] for score in of_seed}
            for of_seed in grouped(same, "seed").values()
        ]
        errors = [[mape[m] for m in METHODS] for mape in by_seed if set(METHODS) <= set(mape)]
        if errors:
            n_ordered = sum(row == sorted(row) for row in errors)
            n_linear_last = sum(row[METHODS.index("linear")] == max(row) for row in errors)
            counts = [f"{n} of {len(errors)}" for n in (n_ordered, n_linear_last)]
            rows.append([TITLES.get(name, name), output, *counts])
    return markdown(rows, ["tuned in", "output", "the paper's order", "linear regression last"])


def _figure(records: Sequence[Record]) -> Figure:
    """Draw the MAPE of each method and search, with its deviation, next to the paper's."""
    by_output = grouped(records, "output")
    models = [model for model in models_of(records) if model != "curve_fit"]
    figure, (axes,) = grid(1, len(by_output), size=(3.2, 4), sharey=True)
    for axis, ((output,), same) in zip(axes, by_output.items(), strict=True):
        by_search = grouped([r for r in same if r["model"] in models], "search")
        for k, ((name,), shown) in enumerate(by_search.items()):
            # searches stand next to each other about the tick of their method
            shift = 0.15 * (k - (len(by_search) - 1) / 2)
            axis.errorbar(
                [models.index(r["model"]) + shift for r in shown],
                [r["mape_percent"] for r in shown],
                [r["deviation"] or 0.0 for r in shown],
                fmt="o",
                capsize=3,
                label=TITLES.get(name, name),
            )
        published = PUBLISHED.get((output, "mape_percent"), {})
        places = [models.index(m) for m in published if m in models]
        values = [published[m] for m in published if m in models]
        axis.plot(places, values, "k_", markersize=18, label="the paper")
        axis.set_xticks(range(len(models)), [MODEL_TITLES[m] for m in models], rotation=60)
        axis.set_title(SYMBOLS[output])
    axes[0].set_yscale("log")
    axes[0].set_ylabel("MAPE, %")
    legend_above(figure)
    return figure


def with_deviation(mean: float | None, deviation: float | None) -> str:
    """Return a mean and its standard deviation as text; a dash for no mean."""
    if mean is None:
        return "-"
    return f"{mean:.3g}" if deviation is None else f"{mean:.3g} ± {deviation:.2g}"


if __name__ == "__main__":
    summarise(write_fair, "fair")
