"""The identifiability findings of one protocol group, as Markdown and as records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from suspnet.bounds.identifiability import UNIDENTIFIED, Bound, Direction, Option, listed
from suspnet.curves.protocols import Task
from suspnet.ground.parameters import UNITS
from suspnet.runs.tables import markdown
from suspnet.vehicle import PARAMETERS, Vehicle

WORTH_HAVING = 0.9
"""Largest ratio of bounds, after over before, for which an addition counts as helpful."""


@dataclass(frozen=True)
class Findings:
    """What can be identified in one group of a protocol; `vehicle` is the healthy one.

    `table`: measurement options with their bounds, the present one first; `now`: the present
    estimate of trips, else the first option; `directions`: those of `now` at the healthy vehicle,
    weakest first; `guess_percent`: MAPE of the best guess within the range where stiffness cannot
    be separated from mass, else None.
    """

    vehicle: Vehicle
    task: Task
    table: list[tuple[Option, list[Bound]]]
    now: Option
    directions: list[Direction]
    guess_percent: float | None

    @property
    def bounds_now(self) -> list[Bound]:
        """The bounds of `now`."""
        return next(bounds for option, bounds in self.table if option is self.now)

    def healthy(self, parameter: str) -> float:
        """Return a parameter of the healthy vehicle, in SI units."""
        return self.vehicle.healthy_values()[PARAMETERS.index(parameter)]

    def bound_at_healthy(self, bound: Bound) -> float:
        """Return a bound at the healthy vehicle, in SI units."""
        return self.healthy(bound.parameter) * bound.healthy_percent / 100


def group_markdown(findings: Findings) -> str:
    """Return three tables: bounds, jointly uncertain parameters, and helpful additions."""
    task = findings.task
    mass = "known" if task.mass_known else "unknown"
    fixed = [name for name in PARAMETERS if name not in task.varied]
    others = f"; {listed(fixed)} stay healthy" if fixed else ""
    blocks = [
        f"## Group {task.group}: {listed(task.outputs)}",
        f"Measured now: {findings.now.title}; the car-body mass is {mass}{others}.",
        _bounds_table(findings),
        "What is uncertain together at the healthy vehicle, weakest first: changes by one standard "
        "deviation [%]; any: such changes leave the curves unchanged.",
        _directions_table(findings.directions),
        "What would help: median bound over the range [%], in brackets relative to the first row.",
        _options_table(findings),
        best_addition_sentence(findings.table),
    ]
    if findings.guess_percent is not None:
        guess = f"The best guess within the range has a MAPE of {findings.guess_percent:.3g} %."
        blocks.insert(3, guess)
    loss = [r for bound in findings.bounds_now if (r := _ratio(findings, bound)) is not None]
    if findings.now.kind == "estimate" and loss:
        blocks.append(
            f"The estimate has {min(loss):.2f} to {max(loss):.2f} times the bounds of the "
            "recordings; longer segments (data.segment_s) leak less."
        )
    return "\n\n".join(blocks) + "\n"


def records(findings: Findings) -> list[dict[str, Any]]:
    """Return one record for each option and parameter; ratio is None where a bound is infinite."""
    return [
        {
            "group": findings.task.group,
            "option": option.title,
            "kind": option.kind,
            "parameter": bound.parameter,
            "healthy_percent": bound.healthy_percent,
            "median_percent": bound.median_percent,
            "p95_percent": bound.p95_percent,
            "ratio": _ratio(findings, bound),
            "identified": bound.verdict,
        }
        for option, part in findings.table
        for bound in part
    ]


def plain(findings: Findings) -> dict[str, Any]:
    """Return the findings as JSON-able values, absolute bounds in SI units."""
    task = findings.task
    return {
        "outputs": task.outputs,
        "responses": task.responses,
        "mass_known": task.mass_known,
        "measured": findings.now.title,
        "bounds": {
            bound.parameter: {
                "unit": UNITS[bound.parameter],
                "healthy": findings.healthy(bound.parameter),
                "bound_at_healthy": findings.bound_at_healthy(bound),
                "healthy_percent": bound.healthy_percent,
                "median_percent": bound.median_percent,
                "p95_percent": bound.p95_percent,
                "identified": bound.verdict,
            }
            for bound in findings.bounds_now
        },
        "best_guess_mape_percent": findings.guess_percent,
        "directions": [
            {
                "words": direction.words(),
                "components": dict(
                    zip(direction.parameters, direction.components.tolist(), strict=True)
                ),
                "deviation_percent": direction.deviation_percent,
            }
            for direction in findings.directions
        ],
        "options": records(findings),
    }


def _bounds_table(findings: Findings) -> str:
    rows = []
    for bound in findings.bounds_now:
        unit, least = UNITS[bound.parameter], findings.bound_at_healthy(bound)
        percents = (bound.healthy_percent, bound.median_percent, bound.p95_percent)
        rows.append(
            [
                bound.parameter,
                f"{_value(findings.healthy(bound.parameter), 6)} {unit}",
                f"{_value(least, 3)} {unit}" if math.isfinite(least) else "-",
                *(_percent(percent) for percent in percents),
                bound.verdict,
            ]
        )
    header = ["", "healthy", "bound at healthy", "%", "median %", "19 of 20 below %", "identified"]
    return markdown(rows, header)


def _directions_table(findings: Sequence[Direction]) -> str:
    rows = []
    for direction in findings:
        if math.isfinite(direction.deviation_percent):
            changes = [f"{change:+.2g}" for change in direction.changes_percent.values()]
        else:
            moving = direction.taking_part
            changes = ["any" if name in moving else "0" for name in direction.parameters]
        rows.append([direction.words(), *changes])
    return markdown(rows, ["", *findings[0].parameters])


def _options_table(findings: Findings) -> str:
    rows = []
    for option, part in findings.table:
        cells = dict.fromkeys(findings.task.varied, "known")
        for bound in part:
            ratio = None if option.kind == "baseline" else _ratio(findings, bound)
            cells[bound.parameter] = _percent(bound.median_percent)
            cells[bound.parameter] += "" if ratio is None else f" ({ratio:.2g})"
        title = f"{option.title}, as now" if option.kind == "baseline" else option.title
        rows.append([title, *cells.values()])
    return markdown(rows, ["", *findings.task.varied])


def _ratio(findings: Findings, bound: Bound) -> float | None:
    baseline = {now.parameter: now.median_percent for now in findings.table[0][1]}
    before, after = baseline.get(bound.parameter, math.inf), bound.median_percent
    return after / before if math.isfinite(before) and math.isfinite(after) else None


def _value(value: float, digits: int) -> str:
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if rounded >= 100 else f"{rounded:g}"


def _percent(value: float) -> str:
    if math.isinf(value):
        return UNIDENTIFIED
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def best_addition_sentence(table: Sequence[tuple[Option, Sequence[Bound]]]) -> str:
    """Return one sentence that names the addition that lowers each parameter's bound most.

    `table` holds options with their bounds, the baseline first; medians over the range count.
    """
    parts = []
    for now in table[0][1]:
        additions = [
            (bound.median_percent, option.title.removeprefix("+ "))
            for option, bounds in table
            for bound in bounds
            if option.kind == "more" and bound.parameter == now.parameter
        ]
        least, title = min(additions)
        if least <= WORTH_HAVING * now.median_percent and math.isfinite(least):
            before = now.median_percent
            was = f"{before:.2g}" if math.isfinite(before) else "not identified"
            parts.append(f"{now.parameter}, {title} ({was} to {least:.2g} %)")
        else:
            parts.append(f"{now.parameter}, nothing listed")
    return f"What lowers each bound most: {'; '.join(parts)}."
