"""Tables of scores as records, Markdown and CSV, Table VI first, and the files of a study."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib.figure import Figure
from tabulate import tabulate

from suspnet.ground.storage import write_atomically, write_json
from suspnet.learning.metrics import METRICS
from suspnet.report.tensorboard import RunLog

REFINED = "+refine"
"""Suffix of a method's name if its estimates were refined on the curve."""
MODEL_TITLES = {
    "msvr": "MSVR",
    "svr": "SVR",
    "mvgpr": "MV-GPR",
    "linear": "MV-LR",
    "ridge": "ridge",
    "curve_fit": "curve fit",
}
MODEL_TITLES |= {f"{name}{REFINED}": f"{title} refined" for name, title in MODEL_TITLES.items()}
GROUP_OF_OUTPUT = {
    "k_p": "primary",
    "c_p": "primary",
    "k_s": "secondary",
    "c_s": "secondary",
    "M_s": "mass",
}
PUBLISHED = {
    ("k_p", "mape_percent"): {"msvr": 5.89, "svr": 7.34, "mvgpr": 14.76, "linear": 19.69},
    ("k_p", "rmse"): {"msvr": 0.0579, "svr": 0.0721, "mvgpr": 0.1438, "linear": 0.1953},
    ("c_p", "mape_percent"): {"msvr": 8.97, "svr": 10.29, "mvgpr": 17.26, "linear": 21.71},
    ("c_p", "rmse"): {"msvr": 0.0871, "svr": 0.1013, "mvgpr": 0.1703, "linear": 0.2151},
    ("k_s", "mape_percent"): {"msvr": 4.37, "svr": 6.96, "mvgpr": 13.27, "linear": 18.06},
    ("k_s", "rmse"): {"msvr": 0.0426, "svr": 0.0673, "mvgpr": 0.1311, "linear": 0.1791},
    ("c_s", "mape_percent"): {"msvr": 7.53, "svr": 9.92, "mvgpr": 16.43, "linear": 20.84},
    ("c_s", "rmse"): {"msvr": 0.0739, "svr": 0.0972, "mvgpr": 0.1632, "linear": 0.2073},
}
"""The figures of the paper's Table VI, for comparison only."""

Record = dict[str, Any]


def table6_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return records of each output and metric of runs (metrics.json), as in Table VI."""
    records = [
        {
            "protocol": run["protocol"],
            "group": GROUP_OF_OUTPUT[output],
            "output": output,
            "metric": metric,
            "model": run["model"],
            "published": PUBLISHED.get((output, metric), {}).get(run["model"]),
            "measured": scores[metric],
            "bound": run["bound"][output][metric],
            "n_train": run["n_train"],
            "snr_db": run["snr_db"],
            "seed": run["seed"],
            "seconds": run["seconds"],
        }
        for run in runs
        for output, scores in run["scores"].items()
        for metric in METRICS
    ]
    outputs, models = list(GROUP_OF_OUTPUT), list(MODEL_TITLES)
    return sorted(
        records,
        key=lambda r: (
            r["protocol"],
            outputs.index(r["output"]),
            METRICS.index(r["metric"]),
            models.index(r["model"]),
        ),
    )


def table6_markdown(records: Sequence[Record]) -> str:
    """Return Table VI of one protocol as Markdown: each model's published and measured figure.

    Records that differ in their seed only are averaged.
    """
    models = [name for name in MODEL_TITLES if any(r["model"] == name for r in records)]
    header = ["group", "output", "metric"]
    header += [f"{MODEL_TITLES[m]} {what}" for m in models for what in ("paper", "ours")]
    rows = []
    for key in dict.fromkeys((r["group"], r["output"], r["metric"]) for r in records):
        same = [r for r in records if (r["group"], r["output"], r["metric"]) == key]
        row: list[str] = [*key[:2], "MAPE %" if key[2] == "mape_percent" else "RMSE"]
        for model in models:
            chosen = [r for r in same if r["model"] == model]
            published = chosen[0].get("published") if chosen else None
            row += [in_digits(published), in_digits(mean_known(r["measured"] for r in chosen))]
        rows.append([*row, in_digits(mean_known(r["bound"] for r in same))])
    return tabulate(rows, [*header, "bound"], tablefmt="github", disable_numparse=True)


def table6_caption(records: Sequence[Mapping[str, Any]]) -> str:
    """Return one line on how the measured figures were obtained."""
    first = records[0]
    seeds = ", ".join(str(seed) for seed in sorted({r["seed"] for r in records}))
    seconds: dict[str, float] = {}
    for run in {(r["model"], r["seconds"]) for r in records}:
        seconds[run[0]] = seconds.get(run[0], 0.0) + run[1]
    times = ", ".join(f"{MODEL_TITLES[m]} {seconds[m]:.1f} s" for m in MODEL_TITLES if m in seconds)
    return (
        f"protocol {first['protocol']}, {first['n_train']} training curves, "
        f"{first['snr_db']:g} dB, seed {seeds}; time taken: {times}"
    )


def sensitivity_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return one record for each output of each run: MAPE, and its bound, against the noise.

    The sensor precision is the noise's rms relative to the signal's, 100 * 10^(-SNR/20) percent.
    """
    records = [
        {
            "protocol": run["protocol"],
            "model": run["model"],
            "output": output,
            "snr_db": run["snr_db"],
            "precision_percent": 100 * 10 ** (-run["snr_db"] / 20),
            "mape_percent": scores["mape_percent"],
            "bound": run["bound"][output]["mape_percent"],
            "n_train": run["n_train"],
            "seed": run["seed"],
        }
        for run in runs
        for output, scores in run["scores"].items()
    ]
    outputs = list(GROUP_OF_OUTPUT)
    return sorted(records, key=lambda r: (r["model"], outputs.index(r["output"]), r["snr_db"]))


def sensitivity_markdown(records: Sequence[Record]) -> str:
    """Return MAPE [%] and its bound for each model, noise and output, as Markdown."""
    outputs = list(dict.fromkeys(r["output"] for r in records))
    rows = []
    for model, snr_db in dict.fromkeys((r["model"], r["snr_db"]) for r in records):
        same = [r for r in records if (r["model"], r["snr_db"]) == (model, snr_db)]
        row = [MODEL_TITLES[model], f"{snr_db:g}", f"{same[0]['precision_percent']:.2g}"]
        for output in outputs:
            chosen = [r for r in same if r["output"] == output]
            row += [
                in_digits(mean_known(r[key] for r in chosen)) for key in ("mape_percent", "bound")
            ]
        rows.append(row)
    header = ["model", "SNR dB", "precision %"]
    header += [title for output in outputs for title in (f"{output} MAPE %", "bound")]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def records_csv(records: Sequence[Mapping[str, Any]]) -> str:
    """Return records as CSV with a header line."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, fieldnames=list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return stream.getvalue()


def scores_table(metrics: Mapping[str, Any]) -> str:
    """Return the scores of a run (its metrics.json) next to the best possible ones, as Markdown."""
    rows = []
    for output, values in metrics["scores"].items():
        bound = metrics["bound"][output]
        row = [values["mape_percent"], bound["mape_percent"], values["rmse"], bound["rmse"]]
        row += [metrics["cramer_rao_percent"][output], metrics["rms_ratio"][output]]
        if "intervals" in metrics:
            interval = metrics["intervals"]["outputs"][output]
            row += [interval["half_width_percent"], interval["coverage_percent"]]
        rows.append([output, *map(in_digits, row)])
    header = ["output", "MAPE %", "bound", "RMSE", "bound", "Cramer-Rao sd %", "rms / bound"]
    if "intervals" in metrics:
        level = 100 * metrics["intervals"]["level"]
        header += [f"{level:g} % interval +- %", "covers %"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def mean_known(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def in_digits(value: float | None) -> str:
    """Return a number with three digits for tables; a dash for None, NaN and infinity."""
    if value is None or not math.isfinite(value):
        return "-"
    if value >= 100:
        return f"{value:.0f}"
    return f"{value:.2f}" if value >= 1 else f"{value:.3g}"


def write_study(
    folder: Path,
    name: str,
    text: str,
    content: Any,
    records: Sequence[Mapping[str, Any]],
    figures: Mapping[str, Figure],
) -> None:
    """Write content as JSON, records as CSV, text as Markdown, and figures; show these two."""
    write_json(folder / f"{name}.json", content)
    write_atomically(folder / f"{name}.csv", records_csv(records))
    write_atomically(folder / f"{name}.md", text)
    with RunLog(folder) as run_log:
        run_log.text(name, text)
        for key, figure in figures.items():
            run_log.figure(key, figure, folder)
