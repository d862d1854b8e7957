"""What is written at the end of a multirun: tables, figures, override files."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from shlex import quote
from statistics import fmean
from textwrap import fill
from typing import Any

import yaml
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from tabulate import tabulate
from torch.utils.tensorboard import SummaryWriter

from suspnet.ground.core_yaml import read_yaml
from suspnet.ground.storage import read_json, write_atomically, write_json
from suspnet.runs import plots, tables
from suspnet.runs.tensorboard import RunLog

log = logging.getLogger(__name__)
TRIALS = "trials"  # folder of a multirun with a run of TensorBoard for each trial of its searches
MOST_COLUMNS = 100  # width of the terminal that texts are wrapped for
Run = Mapping[str, Any]


class Summary(Callback):
    """Passes metrics.json of all jobs of a multirun to one of ``SUMMARIES``, and a note to it."""

    def __init__(self, of: str, note: str = "") -> None:
        self._write, self._note = SUMMARIES[of], note

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Summarise the jobs of the multirun that has just ended."""
        folder = Path(config.hydra.sweep.dir)
        runs = [read_json(path) for path in sorted(folder.glob("*/metrics.json"))]
        if runs:
            self._write(runs, folder, self._note)


class Jobs(Callback):
    """A table of all jobs of a multirun, least error first, failed ones last."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write jobs.csv and jobs.md, and print the table."""
        folder = Path(config.hydra.sweep.dir)
        rows = job_rows(folder)
        if not rows:
            return
        write_atomically(folder / "jobs.csv", tables.records_csv(with_swept(folder, rows)))
        table = tabulate(rows, "keys", "github", floatfmt=".4g", missingval="-")
        write_atomically(folder / "jobs.md", f"{table}\n")
        with RunLog(folder) as run_log:
            run_log.text("jobs", table)
        # the terminal shows the errors alone, and the state where it says something
        says = {"finished"} != {row["state"] for row in rows}
        left_out = {key for key in rows[0] if "/" in key} | (set() if says else {"state"})
        short = [{k: v for k, v in row.items() if k not in left_out} for row in rows]
        log.info(
            "rms error in %%, least mean first among jobs with the same outputs\n\n%s\n"
            "-> %s/jobs.*, with the errors over the Cramer-Rao bound\n"
            "compare the jobs with: tensorboard --logdir %s",
            tabulate(short, "keys", "github", floatfmt=".4g", missingval="-"),
            folder,
            quote(str(folder)),
        )


def job_rows(folder: Path) -> list[dict[str, Any]]:
    """Return a row for each job of a multirun: rms error of each output [%], their mean, state.

    Jobs are ranked among those with the same outputs, and those that did not finish come last. With
    several suspensions an error is their mean. ``NAME/bound`` is the rms error over the
    bound, None where it is infinite.
    """
    files = [path for name in ("config.yaml", "error.txt") for path in folder.glob(f"*/{name}")]
    jobs = sorted({path.parent for path in files})
    errors = {
        job: {name: error for name, error in run_errors(job).items() if error is not None}
        for job in jobs
    }
    ratios = {
        job: {f"{name}/bound": ratio for name, ratio in run_errors(job, "rms_ratio").items()}
        for job in jobs
    }
    # every row has the columns of all jobs, whose groups have different outputs
    columns = dict.fromkeys(key for of in (errors, ratios) for row in of.values() for key in row)
    sets = list(dict.fromkeys(map(tuple, errors.values())))
    rows = []
    for job in jobs:
        of_job = errors[job]
        mean = fmean(of_job.values()) if of_job else None
        failed = "failed" if (job / "error.txt").exists() else "unfinished"
        state = {"state": "finished" if of_job else failed}
        rows.append({"job": job.name, "mean": mean} | columns | of_job | ratios[job] | state)
    place = {job.name: sets.index(tuple(errors[job])) for job in jobs}

    def rank(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["mean"] is None, place[row["job"]], row["mean"] or 0.0, row["job"]

    return sorted(rows, key=rank)


def with_swept(folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with a column for each override in which the jobs of a multirun differ.

    `job` is the column with the job's name.
    """
    settings: dict[str, dict[str, str]] = {}
    for path in sorted(folder.glob("*/.hydra/overrides.yaml")):
        pairs = (str(override).lstrip("+").partition("=") for override in read_yaml(path))
        settings[path.parents[1].name] = {key: value for key, _, value in pairs}
    keys = dict.fromkeys(key for values in settings.values() for key in values)
    swept = [key for key in keys if len({values.get(key) for values in settings.values()}) > 1]
    return [
        {**row, **{key: settings.get(row["job"], {}).get(key, "") for key in swept}} for row in rows
    ]


def run_errors(job: Path, entry: str = "rms_percent") -> dict[str, float | None]:
    """Return the rms error of each output of a run, [%]; {} if it did not finish.

    `entry` is that of its metrics.json. An output without a number there has None.
    """
    for name in ("metrics.json", "fleet.json"):
        if (job / name).is_file():
            content = read_json(job / name)
            several = content if isinstance(content, list) else [content]
            entries = [part.get(entry) or {} for part in several]
            numbers: dict[str, list[Any]]
            numbers = {key: [part.get(key) for part in entries] for key in entries[0]}
            return {key: None if None in some else fmean(some) for key, some in numbers.items()}
    return {}


def write_table6(runs: Sequence[Run], folder: Path, note: str = "") -> None:
    """Write and print the comparison of runs with Table VI of the paper, and a note below it."""
    records = tables.table6_records(runs)
    by_protocol = {
        name: [r for r in records if r["protocol"] == name]
        for name in dict.fromkeys(r["protocol"] for r in records)
    }
    parts = by_protocol.values()
    text, short = (
        "\n".join(f"{table(part)}\n\n{tables.table6_caption(part)}\n" for part in parts)
        for table in (tables.table6_markdown, tables.table6_short)
    )
    text += f"{note}\n" if note else ""
    short += fill(note, MOST_COLUMNS)
    several = len(by_protocol) > 1
    figures = {
        f"table6_{name}" if several else "table6": plots.table6(part)
        for name, part in by_protocol.items()
    }
    title = "Table VI, published and measured"
    tables.write_study(folder, "table6", title, text, records, records, figures, short)


def _write_comparison(runs: Sequence[Run], folder: Path, note: str) -> None:
    """Write Table VI of any multirun, unless two of its runs share a place in the table."""
    places = {(r["protocol"], r["group"], r["model"], r["seed"]) for r in runs}
    if 1 < len(places) == len(runs):
        write_table6(runs, folder, note)


def _write_table5(runs: Sequence[Run], folder: Path, note: str) -> None:
    """Write Table V: the best hyperparameters of each method and group, as an override file."""
    tuned: dict[str, dict[str, Any]] = {}
    edges = []
    searched = [run for run in runs if "search" in run]
    for run in searched:
        edge_texts = run["search"]["edges"].values()
        edges += [f"{run['group']}, {run['model']}: {text}" for text in edge_texts]
        best = run["search"]["best"].items()
        numbers = {key: value for key, value in best if isinstance(value, int | float)}
        tuned.setdefault(run["group"], {})[run["model"]] = numbers
    content = yaml.safe_dump({"tuned": tuned}, sort_keys=True)
    content += "".join(f"# {text}\n" for text in edges)
    use = f"python train.py --config-dir {quote(str(folder))} experiment=best"
    path = write_atomically(
        folder / "experiment" / "best.yaml",
        f"# @package _global_\n# {use}\n"
        f"# or copy `tuned` into configs/protocol/{runs[0]['protocol']}.yaml\n{content}",
    )
    write_json(folder / "table5.json", [_search_record(run) for run in searched])
    table = _table5_markdown(searched, n_jobs=len(list(folder.glob("*/config.yaml"))))
    write_atomically(folder / "table5.md", f"{table}\n")
    _write_trials(searched, folder / TRIALS)
    log.info(
        "best hyperparameters (least cross-validated RMSE):\n\n%s\n\n%s-> %s\n"
        "use them with: %s\nsee every trial of a method with: tensorboard --logdir %s/METHOD",
        table,
        content,
        path,
        use,
        quote(str(folder / TRIALS)),
    )


def _write_trials(searched: Sequence[Run], folder: Path) -> None:
    """Write each trial as a row of TensorBoard's HPARAMS tab, in the folder of its method."""
    for k, run in enumerate(searched):
        search = run["search"]
        with SummaryWriter(str(folder / run["model"])) as writer:
            trials = zip(search["settings"], search["rmse"], strict=True)
            for i, (setting, rmse) in enumerate(trials):
                # null, in a file, stands for a trial that failed
                if isinstance(rmse, float) and math.isfinite(rmse):
                    numbers = {key: v for key, v in setting.items() if isinstance(v, int | float)}
                    finals = {"cv_rmse": rmse, "best": float(setting == search["best"])}
                    row = {"group": run["group"], **numbers}
                    writer.add_hparams(row, finals, run_name=f"{run['group']}_{k}/{i}")


def _table5_markdown(searched: Sequence[Run], n_jobs: int) -> str:
    """Return best values, their error and the time of each search, after how many have ended."""
    rows = []
    for run in searched:
        record = _search_record(run)
        best = ", ".join(
            f"{key} {value:g}" if isinstance(value, int | float) else f"{key} {value}"
            for key, value in record["best"].items()
        )
        seconds = record["search_seconds"]
        time = "-" if seconds is None else f"{seconds:.1f}"
        edges = ", ".join(run["search"]["edges"]) or "-"
        error = f"{record['cv_rmse']:.4g}"
        row = [run["group"], run["model"], best, edges, error, record["n_settings"], time]
        rows.append(row)
    header = ["group", "method", "best values", "on the edge", "cross-validated RMSE", "settings"]
    table = tables.markdown(rows, [*header, "search s"])
    return f"{len(searched)} of {n_jobs} searches finished\n\n{table}"


def _search_record(run: Run) -> dict[str, Any]:
    search = run["search"]
    keys = ("protocol", "group", "model", "n_train", "snr_db", "seed")
    return {key: run[key] for key in keys} | {
        "best": search["best"],
        "cv_rmse": min(rmse for rmse in search["rmse"] if rmse is not None),
        "n_settings": len(search["rmse"]),
        "search_seconds": run.get("training", {}).get("search_seconds"),
        "edges": list(search["edges"].values()),
    }


SUMMARIES: Mapping[str, Callable[[Sequence[Run], Path, str], Any]] = {
    "comparison": _write_comparison,
    "table6": write_table6,
    "table5": _write_table5,
}
"""What a multirun may be summarised by, from metrics.json of its runs, its folder and a note."""
