"""The identifiability report: what sensors and noise allow, before any sensor is bought."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet.bounds.identifiability import (
    UNIDENTIFIED,
    VERDICTS,
    Bound,
    Option,
    bounds,
    directions,
    options,
    with_healthy,
)
from suspnet.bounds.information import scale_ambiguity_bound
from suspnet.curves.curves import CurveSettings
from suspnet.curves.estimates import Observation
from suspnet.curves.problem import TEST
from suspnet.curves.protocols import Protocol, Task
from suspnet.ground.parameters import BODY_MASS
from suspnet.ground.settings import check_number
from suspnet.runs.figures import SYMBOLS
from suspnet.runs.findings import Findings, group_markdown, plain, records
from suspnet.runs.plots import OUR_COLOUR
from suspnet.runs.tables import write_study
from suspnet.vehicle import PARAMETERS, ResponseGenerator


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
