"""Tables of scores as records, Markdown and CSV, Table VI first, and the files of a study."""

import csv
import io
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, TypeVar

from matplotlib.figure import Figure
from tabulate import tabulate

from suspnet.ground.storage import write_atomically, write_json
from suspnet.learning.metrics import METRICS
from suspnet.runs.tensorboard import RunLog

log = logging.getLogger(__name__)
REFINED = "+refine"  # suffix of a method's name if its estimates were refined on the curve
MODEL_TITLES = {
    "msvr": "MSVR",
    "svr": "SVR",
    "mvgpr": "MV-GPR",
    "linear": "MV-LR",
    "ridge": "ridge",
    "curve_fit": "curve fit",
}
MODEL_TITLES |= {f"{name}{REFINED}": f"{title} refined" for name, title in MODEL_TITLES.items()}
GROUP_OF_OUTPUT = dict(k_p="primary", c_p="primary", k_s="secondary", c_s="secondary", M_s="mass")
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
Row = TypeVar("Row", bound=Mapping[str, Any])


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
            **{key: run[key] for key in ("n_train", "snr_db", "seed", "seconds")},
        }
        for run in runs
        for output, scores in run["scores"].items()
        for metric in METRICS
    ]
    return in_order(records, "protocol", "output", "metric", "model")


def table6_markdown(records: Sequence[Record]) -> str:
    """Return Table VI of one protocol as Markdown: each model's published and measured figure.

    Records that differ in their seed only are averaged.
    """
    models = models_of(records)
    header = ["group", "output", "metric"]
    header += [f"{MODEL_TITLES[m]} {source}" for m in models for source in ("paper", "ours")]
    rows = []
    for (group, output, metric), same in grouped(records, "group", "output", "metric").items():
        row: list[str] = [group, output, "MAPE %" if metric == "mape_percent" else "RMSE"]
        by_model = grouped(same, "model")
        for model in models:
            chosen = by_model.get((model,), [])
            published = chosen[0].get("published") if chosen else None
            row += [in_digits(published), mean_in_digits(chosen, "measured")]
        rows.append([*row, mean_in_digits(same, "bound")])
    return markdown(rows, [*header, "bound"])


def table6_short(records: Sequence[Record]) -> str:
    """Return Table VI's MAPE of one protocol, a row for each method: ours and (the paper's)."""
    shown = [record for record in records if record["metric"] == "mape_percent"]
    by_output = {output: same for (output,), same in grouped(shown, "output").items()}
    rows = []
    for model in models_of(shown):
        row = [MODEL_TITLES[model]]
        for same in by_output.values():
            own = [record for record in same if record["model"] == model]
            published = own[0]["published"] if own else None
            cell = mean_in_digits(own, "measured")
            row.append(cell if published is None else f"{cell} ({in_digits(published)})")
        rows.append(row)
    rows.append(["bound", *(mean_in_digits(same, "bound") for same in by_output.values())])
    return narrow(rows, ["MAPE %, ours (the paper's)", *by_output])


def table6_caption(records: Sequence[Mapping[str, Any]]) -> str:
    """Return one line on how the measured figures were obtained."""
    first = records[0]
    seeds = ", ".join(str(seed) for seed in sorted({r["seed"] for r in records}))
    seconds: dict[str, float] = {}
    for model, of_run in {(r["model"], r["seconds"]) for r in records}:
        seconds[model] = seconds.get(model, 0.0) + of_run
    times = ", ".join(f"{MODEL_TITLES[m]} {seconds[m]:.1f} s" for m in MODEL_TITLES if m in seconds)
    return (
        f"protocol {first['protocol']}, {first['n_train']} training curves, "
        f"{first['snr_db']:g} dB, seed {seeds}\ntime taken: {times}"
    )


def grouped(records: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Return records by their values of some keys, in the order in which these come."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for record in records:
        groups.setdefault(tuple(record[key] for key in keys), []).append(record)
    return groups


def in_order(records: Sequence[Record], *keys: str) -> list[Record]:
    """Return records sorted by some keys: outputs, metrics and models as in Table VI."""
    orders = {"output": list(GROUP_OF_OUTPUT), "metric": METRICS, "model": list(MODEL_TITLES)}

    def place(record: Record) -> list[Any]:
        return [orders[key].index(record[key]) if key in orders else record[key] for key in keys]

    return sorted(records, key=place)


def models_of(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the methods of records, in the order of ``MODEL_TITLES``."""
    return [name for name in MODEL_TITLES if any(r["model"] == name for r in records)]


def markdown(rows: Sequence[Sequence[Any]], header: Sequence[str]) -> str:
    """Return rows of text as a Markdown table."""
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def narrow(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Return rows of text as a Markdown table without padding, for a terminal of 100 columns."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ["-" * width for width in widths]
    lines = [
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in (header, rule, *rows)
    ]
    return "\n".join(f"| {line} |" for line in lines)


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
    header = ["output", "MAPE %", "bound", "RMSE", "bound", "bound sd %", "rms / bound"]
    if "intervals" in metrics:
        level = 100 * metrics["intervals"]["level"]
        header += [f"{level:g} % +-", "covers %"]
    return narrow(rows, header)


def mean_in_digits(records: Iterable[Record], key: str) -> str:
    """Return the mean of the values of a key that are not None, as ``in_digits`` does."""
    values = [record[key] for record in records if record[key] is not None]
    return in_digits(fmean(values) if values else None)


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
    title: str,
    text: str,
    content: Any,
    records: Sequence[Mapping[str, Any]],
    figures: Mapping[str, Figure] | None = None,
    short: str | None = None,
) -> None:
    """Write content as JSON, records as CSV, text as Markdown, and figures; show text and figures.

    `title` is the first line of what is logged, followed by the text, or by a `short` one.
    """
    write_json(folder / f"{name}.json", content)
    write_atomically(folder / f"{name}.csv", records_csv(records))
    write_atomically(folder / f"{name}.md", text)
    with RunLog(folder) as run_log:
        run_log.text(name, text)
        for key, figure in (figures or {}).items():
            run_log.figure(key, figure, folder)
    log.info("%s\n\n%s\n-> %s/%s.*", title, (short or text).rstrip("\n"), folder, name)
