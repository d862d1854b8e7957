"""The files of a study: numbers as JSON and CSV, text as Markdown, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from suspnet.ground.storage import write_atomically, write_json
from suspnet.report.tensorboard import RunLog
from suspnet.runs.table6 import records_csv


def write_study(
    folder: Path,
    name: str,
    text: str,
    content: Any,
    records: Sequence[Mapping[str, Any]],
    figures: Mapping[str, Figure],
) -> None:
    """Write NAME.json, NAME.csv, NAME.md and figures, and show text and figures in TensorBoard.

    `content` goes to the JSON file, `records` are the rows of the CSV file, `text` is Markdown, and
    `figures` are by file name.
    """
    write_json(folder / f"{name}.json", content)
    write_atomically(folder / f"{name}.csv", records_csv(records))
    write_atomically(folder / f"{name}.md", text)
    with RunLog(folder) as run_log:
        run_log.text(name, text)
        for key, figure in figures.items():
            run_log.figure(key, figure, folder)
