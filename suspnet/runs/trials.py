"""The trials of a search, each as a run of its own for TensorBoard."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from suspnet.runs.tensorboard import RunLog

TRIALS = "trials"
"""Folder of a multirun with a run of TensorBoard for each trial of its searches."""
LETTERS = {
    **{"C": "C", "sigma": "s", "epsilon": "e"},
    **{"length_scale": "l", "signal_variance": "v", "noise_variance": "n"},
}
"""Letter of each hyperparameter in the names of trials."""


def write_trials(runs: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write each trial of the searches of runs as a run of its own for TensorBoard.

    It is a row of the HPARAMS tab, ``msvr primary/C100 s3 e1e-3``, where `best` is 1 for the best
    trial of its search, and has the RMSE of each fold as a curve.
    """
    titles = [f"{run['model']} {run['group']}" for run in runs]
    columns = {"model": "", "group": "", **dict.fromkeys(LETTERS, 0.0)}
    for k, (run, title) in enumerate(zip(runs, titles, strict=True)):
        if "search" not in run:
            continue
        if titles.count(title) > 1:
            title = f"{title} {k}"
        search = run["search"]
        least = least_rmse(search)
        for setting, rmse, folds in zip(
            search["settings"], search["rmse"], search["fold_rmse"], strict=True
        ):
            if not isinstance(rmse, float) or not math.isfinite(rmse):
                continue
            is_best = setting == search["best"]
            name = trial_name(setting) + (" best" if is_best else "")
            metrics = {"cv_rmse": rmse, "over_best": rmse / least, "best": float(is_best)}
            with RunLog(folder / title / name, is_new=True) as run_log:
                run_log.hyperparameters(
                    {"model": run["model"], "group": run["group"], **setting},
                    metrics,
                    columns=columns,
                    metric_columns=tuple(metrics),
                    first=("model", "group", "C", "sigma", "epsilon"),  # as many as are shown
                )
                for fold, value in enumerate(folds, start=1):
                    run_log.scalars("cv", {"rmse_of_fold": value}, fold)


def least_rmse(search: Mapping[str, Any]) -> float:
    """Return the least RMSE of a search; None, in a file, stands for a trial that failed."""
    return float(min(rmse for rmse in search["rmse"] if rmse is not None))


def trial_name(setting: Mapping[str, Any]) -> str:
    """Return the name of a trial.

    >>> trial_name({"C": 100.0, "epsilon": 1e-6, "sigma": 3.0, "optimizer": None})
    'C100 s3 e1e-6'
    """
    ordered = sorted(setting, key=lambda key: [*LETTERS, key].index(key))
    numbers = {key: setting[key] for key in ordered if isinstance(setting[key], int | float)}
    texts = [f"{LETTERS.get(key, f'{key} ')}{_short(value)}" for key, value in numbers.items()]
    return " ".join(texts) or "default"


def _short(value: float) -> str:
    """Return a number as text, small ones as 1e-3."""
    if value == 0 or abs(value) >= 0.01:
        return f"{value:g}"
    mantissa, _, exponent = f"{value:e}".partition("e")
    return f"{float(mantissa):g}e{int(exponent)}"
