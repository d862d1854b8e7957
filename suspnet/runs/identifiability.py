"""The identifiability report: what sensors and noise allow, before any sensor is bought."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.bounds.identifiability import (
    UNIDENTIFIED,
    VERDICTS,
    Bound,
    Direction,
    Option,
    bounds,
    directions,
    listed,
    options,
    with_healthy,
)
from suspnet.bounds.information import scale_ambiguity_bound
from suspnet.curves.curves import CurveSettings
from suspnet.curves.estimates import Observation
from suspnet.curves.problem import TEST
from suspnet.curves.protocols import Protocol, Task
from suspnet.ground.parameters import BODY_MASS, UNITS
from suspnet.ground.settings import check_number
from suspnet.runs.figures import SYMBOLS
from suspnet.runs.plots import OUR_COLOUR
from suspnet.runs.tables import markdown, write_study
from suspnet.vehicle import PARAMETERS, ResponseGenerator, Vehicle

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


def write_identifiability(
    generator: ResponseGenerator,
    protocol: Protocol,
    settings: Observation,
    folder: Path,
    *,
    group: str | None,
    n_vehicles: int,
    seed: int,
) -> dict[str, Any]:
    """Write identifiability.md, .csv, .json and .png; print the tables; return the JSON's content.

    `group`: one group of the protocol, None is every group; `n_vehicles` are drawn from its range.
    """
    check_number("n_vehicles", n_vehicles, low=1, most=10_000_000, whole=True)
    check_number("seed", seed, low=0, whole=True)
    bound = settings.bound(generator.vehicle)
    tasks = [protocol.task(name) for name in (protocol.groups if group is None else [group])]
    findings = [identify(generator, task, bound, n_vehicles, seed) for task in tasks]
    title = f"What can be identified: {generator.vehicle.name}, protocol {protocol.name}"
    setting = _setting(generator, bound, tasks[0], n_vehicles, seed)
    tables = "\n".join(group_markdown(part) for part in findings)
    report = {
        "vehicle": generator.vehicle.name,
        "generator": type(generator).__name__,
        "protocol": protocol.name,
        "settings": asdict(bound),
        "n_vehicles": n_vehicles,
        "seed": seed,
        "verdict_thresholds_percent": {word: threshold for threshold, word in VERDICTS},
        "groups": {part.task.group: plain(part) for part in findings},
    }
    rows = [record for part in findings for record in records(part)]
    figure = identifiability_figure(findings)
    figure.suptitle(title, fontsize="medium")
    figures = {"identifiability": figure}
    write_study(folder, "identifiability", title, f"{setting}\n\n{tables}", report, rows, figures)
    return report


def identify(
    generator: ResponseGenerator, task: Task, settings: Observation, n_vehicles: int, seed: int
) -> Findings:
    """Return what can be identified in one group; `settings` are bound to the vehicle."""
    ratios = with_healthy(task.sample(n_vehicles, seed, TEST))
    choices = options(task, settings.observer(generator), ratios)
    now = next((option for option in choices if option.kind == "estimate"), choices[0])
    guess = None
    curves = settings.kind == CurveSettings.kind and task.sampling == "grid"
    if curves and task.responses == ("G_s",) and BODY_MASS in task.unknown:
        guess = scale_ambiguity_bound(task, ratios[1:])["k_s"]["mape_percent"]
    return Findings(
        vehicle=generator.vehicle,
        task=task,
        table=[(option, bounds(option, ratios)) for option in choices],
        now=now,
        directions=directions(now.information[0], now.unknown),
        guess_percent=guess,
    )


def _setting(
    generator: ResponseGenerator, settings: Observation, task: Task, n_vehicles: int, seed: int
) -> str:
    verdicts = ", ".join(f"{word} up to {x:g} %" for x, word in VERDICTS)
    return (
        f"{settings.words()} {generator.assumptions()} {n_vehicles} vehicles, seed {seed}, "
        f"parameters {_range(task)} of healthy.\n\nCramer-Rao bounds, one standard "
        "deviation: no unbiased estimator has less. "
        f"Identified {verdicts}, by the bound that 19 of 20 vehicles stay below."
    )


def _range(task: Task) -> str:
    low, high = (f"{100 * end:g}" for end in task.range("k_p"))
    mass_low, mass_high = (f"{100 * end:g}" for end in task.range(BODY_MASS))
    if (low, high) == (mass_low, mass_high):
        return f"{low} to {high} %"
    return f"{low} to {high} %, mass {mass_low} to {mass_high} %"


def identifiability_figure(groups: Sequence[Findings]) -> Figure:
    """Draw how well each parameter is identified, now and with less or more sensors."""
    height = 1.6 + 0.36 * max(len(findings.table) for findings in groups)
    figure = Figure(figsize=(11.2, height * len(groups)), layout="constrained")
    axes = figure.subplots(len(groups), 2, squeeze=False, width_ratios=(1, 1.25))
    for (left, right), findings in zip(axes, groups, strict=True):
        _draw_bounds(left, findings.bounds_now)
        measured = _symbolic(findings.now.title)
        left.set_title(
            f"group {findings.task.group}, {measured}:\n5th to 95th percentile, quartiles"
        )
        _draw_options(right, findings.table)
        right.set_title("median bound over the range [%],\nblue: less than in the first row")
    return figure


def _draw_bounds(axis: Axes, bounds: Sequence[Bound]) -> None:
    """Draw 5th to 95th percentile, quartiles and median of each bound over the verdicts."""
    finite = [p for bound in bounds for p in bound.percentiles if math.isfinite(p)]
    low, high = min([0.1, *finite]) / 2, max([50.0, *finite]) * 2
    edge = low
    for k, (threshold, word) in enumerate([*VERDICTS, (high, UNIDENTIFIED)]):
        axis.axhspan(edge, threshold, color="black", alpha=0.06 * k, lw=0)
        axis.annotate(
            word, (0.99, threshold / 1.05), xycoords=("axes fraction", "data"), ha="right", va="top"
        )
        edge = threshold
    for x, bound in enumerate(bounds):
        p05, p25, median, p75, p95 = np.minimum(bound.percentiles, high / 1.6)
        if math.isfinite(bound.median_percent):
            axis.plot([x, x], [p05, p95], color=OUR_COLOUR, lw=1.5)
            axis.plot([x, x], [p25, p75], color=OUR_COLOUR, lw=9, alpha=0.6, solid_capstyle="butt")
            axis.text(x + 0.13, median, f"{median:.2g}", va="center", fontsize="small")
        axis.plot([x], [median], "o" if median == bound.median_percent else "^", color="black")
    axis.set(yscale="log", ylim=(low, high), xlim=(-0.6, len(bounds)))
    axis.set_ylabel("standard deviation at best [%]")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_xticks(range(len(bounds)), [SYMBOLS[bound.parameter] for bound in bounds])


def _draw_options(axis: Axes, table: Sequence[tuple[Option, Sequence[Bound]]]) -> None:
    rows = [{bound.parameter: bound.median_percent for bound in bounds} for _, bounds in table]
    names = [name for name in PARAMETERS if any(name in row for row in rows)]
    medians = np.array([[row.get(name, np.nan) for name in names] for row in rows])
    finite = np.where(np.isinf(medians), 1e9, medians)  # far beyond the scale of colours
    change = np.log2(finite / finite[0])
    axis.imshow(change, cmap="RdBu_r", vmin=-3, vmax=3, aspect="auto")
    for (i, j), median in np.ndenumerate(medians):
        text = "known" if np.isnan(median) else f"{median:.2g}"
        colour = "white" if abs(change[i, j]) > 2 else "black"
        axis.text(j, i, text.replace("inf", UNIDENTIFIED), ha="center", va="center", color=colour)
    axis.set_xticks(range(len(names)), [SYMBOLS[name] for name in names])
    titles = [_symbolic(option.title) for option, _ in table]
    axis.set_yticks(range(len(table)), [f"{titles[0]}, as now", *titles[1:]])
    axis.tick_params(length=0)


def _symbolic(words: str) -> str:
    return words.replace("G_p", "$G_p$").replace("G_s", "$G_s$")
