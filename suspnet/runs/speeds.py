"""A range of speeds as bins of one model each, and the run that trains them all."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from tabulate import tabulate

from suspnet.ground.checks import check_number
from suspnet.ground.storage import write_json
from suspnet.runs.scores import Metrics
from suspnet.spectra.speeds import SpeedRange

log = logging.getLogger(__name__)


def speed_ranges(speeds: Sequence[Any], half_width: float) -> list[SpeedRange]:
    """Return the fewest bins that cover a range of speeds, equal in logarithm, edge to edge.

    Parameters
    ----------
    speeds : sequence of 2 floats, [m/s]
        Lowest and highest.
    half_width : float, [-]
        Largest half width of a bin relative to its middle.

    Raises
    ------
    TypeError, ValueError
        If these are not two ascending speeds, or the half width is not above 0.
    """
    if len(speeds) != 2:
        raise ValueError(
            "`speed_m_per_s` must be one speed or the lowest and the highest of a range, "
            f"[45,80], got {list(speeds)}"
        )
    low, high = speeds
    check_number("speed_m_per_s[0]", low, above=0)
    check_number("speed_m_per_s[1]", high, above=low)
    check_number("data.speed_half_width", half_width, above=0, below=1)
    widest = math.log((1 + half_width) / (1 - half_width))
    n_bins = math.ceil(math.log(high / low) / widest - 1e-9)
    edges = [low * (high / low) ** (i / n_bins) for i in range(n_bins)] + [high]
    return [SpeedRange(*pair) for pair in pairwise(edges)]


def train_ranges(
    ranges: Sequence[SpeedRange], train_one: Callable[[SpeedRange, Path], Metrics], folder: Path
) -> None:
    """Train a model for each range of speeds in a folder of its own, and compare them.

    Writes speeds.json: for each range its folder, ends and middle [m/s], and metrics.json's scores.

    Parameters
    ----------
    ranges : sequence of SpeedRange
    train_one : function
        Trains the model of a range into a folder and returns what metrics.json holds; empty in a
        process that neither writes nor tests.
    folder : Path
    """
    rows: list[dict[str, Any]] = []
    for one in ranges:
        metrics = train_one(one, folder / one.name)
        if metrics:
            rows.append(_row(one, metrics))
    if rows:
        write_json(folder / "speeds.json", rows)
        log.info("rms error in %% by speed\n\n%s\n-> %s", _table(rows), folder)


def _row(one: SpeedRange, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a range's model is and how well it does."""
    keys = ("scores", "rms_percent", "intervals", "seconds")
    return {
        "folder": one.name,
        "low_m_per_s": one.low_m_per_s,
        "high_m_per_s": one.high_m_per_s,
        "trained_m_per_s": one.trained_m_per_s,
    } | {key: metrics[key] for key in keys if key in metrics}


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rms errors of each range's model as a table."""
    body = [
        [f"{row['low_m_per_s']:.1f} to {row['high_m_per_s']:.1f} m/s", *row["rms_percent"].values()]
        for row in rows
    ]
    return tabulate(body, ["speed", *rows[0]["rms_percent"]], tablefmt="github", floatfmt=".2g")
