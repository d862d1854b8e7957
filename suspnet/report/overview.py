"""All suspensions of a folder on one page and in one table, the worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from tabulate import tabulate

from suspnet.ground.storage import write_atomically
from suspnet.ground.tables import write_table
from suspnet.ground.wording import count
from suspnet.history.records import OK, TripResult
from suspnet.maintenance.assessment import Assessment, joined, overall, worst_first
from suspnet.maintenance.limits import Severity
from suspnet.recordings.manifest import Place
from suspnet.report.templates import render

REPORT = "report.html"


@dataclass(frozen=True)
class Evaluated:
    """One suspension: its trips and what they mean, or why it could not be read.

    Attributes
    ----------
    name : str
        Its subfolder of the output, where there are several.
    place : Place
    results : list of TripResult
        Ascending mileage.
    assessments : list of Assessment
        One for each parameter.
    error : str
        Empty if it was read.
    """

    name: str
    place: Place
    results: list[TripResult] = field(default_factory=list)
    assessments: list[Assessment] = field(default_factory=list)
    error: str = ""

    @property
    def severity(self) -> Severity:
        """The largest severity of its parameters; unknown if it was not read."""
        return overall(self.assessments)[0]

    @property
    def is_complete(self) -> bool:
        """Whether each of its trips has an estimate."""
        return not self.error and all(result.status == OK for result in self.results)

    def row(self, outputs: Sequence[str]) -> dict[str, Any]:
        """Return the suspension as one flat row of the overview."""
        worst = next(iter(joined(worst_first(self.assessments))), [])
        done = [r for r in self.results if r.status == OK]
        last = {one.parameter: one.now for one in self.assessments}
        reason = worst[0].words if worst else overall(self.assessments)[1]
        return {
            "suspension": self.place.suspension or self.name,
            "bogie": self.place.bogie,
            "side": self.place.side,
            "train": self.place.train,
            "car": self.place.car,
            "severity": str(self.severity),
            "parameter": ", ".join(one.parameter for one in worst),
            **{f"{name}_last": float(last.get(name, np.nan)) for name in outputs},
            "last_mileage_km": float(done[-1].mileage_km if done else np.nan),
            "n_trips": len(self.results),
            "n_estimated": len(done),
            "n_flagged": sum(bool(r.flags) for r in self.results),
            "reason": f"not read: {self.error}" if self.error else reason,
            "folder": self.name,
            "report": "" if self.error else f"{self.name}/{REPORT}",
        }


def write_overview(done: Sequence[Evaluated], outputs: Sequence[str], output: Path) -> str:
    """Write overview.parquet, .csv and .html, and return the overview as text.

    Parameters
    ----------
    done : sequence of Evaluated
        In the order of the rows.
    outputs : sequence of str
        Parameters, whose last estimates are shown.
    output : Path

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    rows = [one.row(outputs) for one in done]
    write_table(pa.Table.from_pylist(rows), output / "overview")
    page = render("overview.html", rows=rows, outputs=outputs, finding=finding(rows))
    write_atomically(output / "overview.html", page)
    shown = ("folder", "suspension", "bogie", "side", "severity", "parameter", "n_trips", "reason")
    table = tabulate([[row[key] for key in shown] for row in rows], shown, tablefmt="github")
    return f"{finding(rows)}\n{table}"


def finding(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how many suspensions are of each severity."""
    counts = {level: sum(row["severity"] == str(level) for row in rows) for level in Severity}
    words = {
        Severity.ACT: "to act on",
        Severity.NOTICE: "to be looked at",
        Severity.UNKNOWN: "not judged",
        Severity.NONE: "without alarm",
    }
    told = ", ".join(f"{counts[level]} {text}" for level, text in words.items() if counts[level])
    return f"{count(len(rows), 'suspension')}: {told}."
