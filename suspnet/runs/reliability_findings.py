"""The reliability measured of a model, as Markdown and as records."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tabulate import tabulate

from suspnet.runs.scores import LEVEL

Record = dict[str, Any]


@dataclass(frozen=True)
class Reliability:
    """Coverage and flags measured of one model.

    Attributes
    ----------
    name : str
        Method, protocol and group.
    intervals : dict
        As ``interval_scores`` for each kind of interval, with `slices`: the coverage of each
        output in each fifth of each parameter, {parameter: {output: [..]}}.
    flags : dict
        {set of curves: {kind of flag: share [%]}}, with `any`.
    """

    name: str
    intervals: dict[str, dict[str, Any]]
    flags: dict[str, dict[str, float]]


def records(found: list[Reliability]) -> Iterator[Record]:
    """Yield one record for each number measured: model, what, of, value [%]."""
    for one in found:
        for kind, scores in one.intervals.items():
            for output, values in scores["outputs"].items():
                for what, value in values.items():
                    yield _record(one, f"{kind} {what}", output, value)
            joint = scores["joint_coverage_percent"]
            yield _record(one, f"{kind} coverage_percent", "all at once", joint)
            for name, by_output in scores["slices"].items():
                for output, values in by_output.items():
                    for k, value in enumerate(values):
                        of = f"{output}, {name} in fifth {k + 1}"
                        yield _record(one, f"{kind} coverage_percent", of, value)
        for name, shares in one.flags.items():
            for kind, value in shares.items():
                yield _record(one, f"flagged_percent {kind}", name, value)


def _record(one: Reliability, what: str, of: str, value: float) -> Record:
    """Return one number as a record."""
    return {"model": one.name, "what": what, "of": of, "percent": value}


def markdown(one: Reliability) -> str:
    """Return one model's coverage and flags as Markdown."""
    rows = []
    for kind, scores in one.intervals.items():
        for output, values in scores["outputs"].items():
            sliced = [v for by in scores["slices"].values() for v in by[output] if math.isfinite(v)]
            row = [values["half_width_percent"], values["coverage_percent"]]
            rows.append([kind, output, *row, min(sliced), max(sliced)])
        rows.append([kind, "all at once", None, scores["joint_coverage_percent"], None, None])
    title = f"{100 * LEVEL:g} % interval"
    header = [title, "output", "+- %", "covers %", "least slice %", "largest slice %"]
    formats = ("", "", ".3g", ".2f", ".1f", ".1f")
    first = tabulate(rows, header, tablefmt="github", floatfmt=formats, missingval="-")
    flags = [[name, *shares.values()] for name, shares in one.flags.items()]
    header = ["curves", "flagged %", "peak missing", "beyond cloud", "out of range", "misfit"]
    second = tabulate(flags, header, tablefmt="github", floatfmt=".2f")
    return f"## {one.name}\n\n{first}\n\n{second}\n"
