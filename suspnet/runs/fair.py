"""Methods that were tuned alike: errors over seeds, and paired differences to MSVR."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from matplotlib.figure import Figure
from tabulate import tabulate

from suspnet.report.figures import SYMBOLS
from suspnet.runs.readings import METHODS
from suspnet.runs.tables import MODEL_TITLES, PUBLISHED, in_digits, write_study

log = logging.getLogger(__name__)
REFERENCE = "msvr"
"""Method that the others are compared with."""
TITLES = {
    "stored": "settings of experiment=table6",
    "fair": "Table V's ranges",
    "fair_widened": "beyond Table V",
}
"""Title of each option of the group `search`."""
Record = dict[str, Any]


def write_fair(runs: Sequence[Mapping[str, Any]], folder: Path) -> list[Record]:
    """Compare the MAPE of runs (metrics.json) that differ in search, seed, group and method.

    Writes fair.json, .csv, .md and .png; returns a record for each search, output and method.
    """
    records = fair_records(runs)
    text = "\n\n".join(
        [
            "MAPE in %: mean and standard deviation over seeds",
            errors_markdown(records),
            f"MAPE less that of {MODEL_TITLES[REFERENCE]} on the same curves: mean and its "
            "standard error, and the seeds on which it is smaller",
            differences_markdown(records),
            "Seeds on which the methods of Table VI are in the paper's order",
            _orders_markdown(runs),
            *edge_lines(runs),
        ]
    )
    write_study(folder, "fair", f"{text}\n", records, records, {"fair": _figure(records)})
    log.info("Methods tuned alike\n\n%s\n-> %s/fair.*", text, folder)
    return records


def fair_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return mean MAPE over seeds, and the paired difference to MSVR's, for each method.

    `difference` is the mean over the `n_pairs` seeds of both, `error` its standard error and
    `n_better` the number of these on which the method's MAPE is smaller; None where MSVR or a
    second seed is missing.
    """
    by_seed: dict[tuple[str, str, str], dict[int, float]] = {}
    bounds: dict[tuple[str, str], list[float | None]] = {}
    for run in runs:
        name = run.get("search_name", "stored")
        for output, values in run["scores"].items():
            key = name, output, run["model"]
            by_seed.setdefault(key, {})[run["seed"]] = values["mape_percent"]
            bounds.setdefault((name, output), []).append(run["bound"][output]["mape_percent"])
    records = []
    for (name, output, model), errors in by_seed.items():
        known = [bound for bound in bounds[name, output] if bound is not None]
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
                "bound": fmean(known) if known else None,
            }
        )
    return records


def errors_markdown(records: Sequence[Record]) -> str:
    """Return mean and deviation of each method's MAPE, the least of the trained ones in bold."""
    models = _models(records)
    rows = []
    for (name, output), cells in _rows(records):
        trained = [r["mape_percent"] for m, r in cells.items() if m != "curve_fit"]
        row = [TITLES.get(name, name), output]
        for model in models:
            words = _with_deviation(cells.get(model), "mape_percent", "deviation")
            is_least = model in cells and cells[model]["mape_percent"] == min(trained)
            row.append(f"**{words}**" if is_least else words)
        rows.append([*row, in_digits(next(iter(cells.values()))["bound"])])
    header = ["tuned in", "output", *(MODEL_TITLES[m] for m in models), "bound"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def differences_markdown(records: Sequence[Record]) -> str:
    """Return the paired differences to MSVR's MAPE of the other methods."""
    models = [model for model in _models(records) if model != REFERENCE]
    rows = []
    for (name, output), cells in _rows(records):
        row = [TITLES.get(name, name), output]
        for model in models:
            record = cells.get(model)
            words = _with_deviation(record, "difference", "error")
            n_pairs = record["n_pairs"] if record else 0
            row.append(
                f"{words} ({record['n_better']} of {n_pairs})" if record and n_pairs else "-"
            )
        rows.append(row)
    header = ["tuned in", "output", *(MODEL_TITLES[m] for m in models)]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


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


def _orders_markdown(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return on how many seeds the errors of the paper's methods ascend as in its Table VI."""
    errors: dict[tuple[str, str], dict[int, dict[str, float]]] = {}
    for run in runs:
        for output, values in run["scores"].items():
            seeds = errors.setdefault((run.get("search_name", "stored"), output), {})
            seeds.setdefault(run["seed"], {})[run["model"]] = values["mape_percent"]
    rows = []
    for (name, output), seeds in errors.items():
        whole = [found for found in seeds.values() if set(METHODS) <= set(found)]
        ordered = sum([f[m] for m in METHODS] == sorted(f[m] for m in METHODS) for f in whole)
        last = sum(f["linear"] == max(f[m] for m in METHODS) for f in whole)
        if whole:
            counts = [f"{count} of {len(whole)}" for count in (ordered, last)]
            rows.append([TITLES.get(name, name), output, *counts])
    header = ["tuned in", "output", "the paper's order", "linear regression last"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def _rows(records: Sequence[Record]) -> Iterable[tuple[tuple[str, str], dict[str, Record]]]:
    """Yield search and output of each row of a table, and its records by method."""
    for key in dict.fromkeys((r["search"], r["output"]) for r in records):
        yield key, {r["model"]: r for r in records if (r["search"], r["output"]) == key}


def _models(records: Sequence[Record]) -> list[str]:
    return [name for name in MODEL_TITLES if any(r["model"] == name for r in records)]


def _with_deviation(record: Mapping[str, Any] | None, key: str, deviation: str) -> str:
    if record is None or record[key] is None:
        return "-"
    if record[deviation] is None:
        return f"{record[key]:.3g}"
    return f"{record[key]:.3g} ± {record[deviation]:.2g}"


def _figure(records: Sequence[Record]) -> Figure:
    """Draw the MAPE of each method and search, with its deviation, next to the paper's."""
    outputs = list(dict.fromkeys(r["output"] for r in records))
    searches = list(dict.fromkeys(r["search"] for r in records))
    models = [model for model in _models(records) if model != "curve_fit"]
    drawn = Figure(figsize=(3.2 * len(outputs), 4), layout="constrained")
    axes = drawn.subplots(1, len(outputs), sharey=True, squeeze=False)[0]
    for axis, output in zip(axes, outputs, strict=True):
        for k, name in enumerate(searches):
            some = [r for r in records if (r["search"], r["output"]) == (name, output)]
            some = [r for r in some if r["model"] in models]
            axis.errorbar(
                [models.index(r["model"]) + 0.15 * (k - (len(searches) - 1) / 2) for r in some],
                [r["mape_percent"] for r in some],
                [r["deviation"] or 0.0 for r in some],
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
        axis.grid(True, axis="y", alpha=0.3)
    axes[0].set_yscale("log")
    axes[0].set_ylabel("MAPE, %")
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return drawn
