"""MAPE of every output of experiment=whole_grid, a row for each setting that varies but the group.

python train.py experiment=whole_grid [device=cuda]
python benchmarks/whole_grid.py outputs/whole_grid/RUN

Writes whole_grid.csv, .json and .md into the folder of the multirun.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from readings import summarise
from tabulate import tabulate

from suspnet.ground.storage import read_json
from suspnet.runs.sweeps import with_swept
from suspnet.runs.tables import write_study


def write_whole_grid(runs: Sequence[Any], folder: Path) -> None:
    """Write the table of a multirun."""
    files = sorted(folder.glob("*/metrics.json"))
    scores = {path.parent.name: read_json(path)["scores"] for path in files}
    rows: dict[str, dict[str, Any]] = {}
    for swept in with_swept(folder, [{"job": job} for job in scores]):
        settings = {key: swept[key] for key in swept if key not in ("job", "group")}
        row = rows.setdefault(json.dumps(settings), settings)
        row |= {output: values["mape_percent"] for output, values in scores[swept["job"]].items()}
    records = list(rows.values())
    table = tabulate(records, "keys", "github", floatfmt=".3g", missingval="-")
    write_study(folder, "whole_grid", "MAPE in %", f"{table}\n", records, records)


if __name__ == "__main__":
    summarise(write_whole_grid, "whole_grid")
