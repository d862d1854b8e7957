"""The identifiability report: what sensors and noise allow, before any of them is bought."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any

from suspnet.dynamics import ResponseGenerator
from suspnet.estimation.bounds import VERDICTS, bounds, directions, with_healthy
from suspnet.estimation.information import scale_ambiguity_bound
from suspnet.estimation.options import options
from suspnet.estimation.problem import TEST
from suspnet.estimation.protocols import Protocol, Task
from suspnet.ground.checks import check_number
from suspnet.ground.storage import write_atomically, write_json
from suspnet.report.tensorboard import RunLog
from suspnet.runs.findings import Findings, group_markdown, plain, records
from suspnet.runs.identifiability_figure import identifiability_figure
from suspnet.runs.table6 import records_csv
from suspnet.spectra.curves import CurveSettings
from suspnet.spectra.observation import Observation

log = logging.getLogger(__name__)


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
    """Write identifiability.md, .csv, .json and .png and print the tables.

    Parameters
    ----------
    generator : ResponseGenerator
    protocol : Protocol
    settings : Observation
    folder : Path
    group : str or None
        One group of the protocol; None is every group.
    n_vehicles : int
        Vehicles drawn from the protocol's range.
    seed : int
        Of the draw.

    Returns
    -------
    dict
        What the JSON file holds; null there is "cannot be identified".

    Raises
    ------
    TypeError, ValueError
        If there is no such group, or the number of vehicles or the seed is no whole number.
    """
    check_number("n_vehicles", n_vehicles, low=1, most=10_000_000, whole=True)
    check_number("seed", seed, low=0, whole=True)
    bound = settings.bound(generator.vehicle)
    tasks = [protocol.task(name) for name in (protocol.groups if group is None else [group])]
    found = [identify(generator, task, bound, n_vehicles, seed) for task in tasks]
    title = f"What can be identified: {generator.vehicle.name}, protocol {protocol.name}"
    setting = _setting(generator, bound, tasks[0], n_vehicles, seed)
    text = "\n".join([f"# {title}\n\n{setting}\n", *(group_markdown(part) for part in found)])
    report = {
        "vehicle": generator.vehicle.name,
        "generator": type(generator).__name__,
        "protocol": protocol.name,
        "settings": asdict(bound),
        "n_vehicles": n_vehicles,
        "seed": seed,
        "verdict_thresholds_percent": {word: threshold for threshold, word in VERDICTS},
        "groups": {part.task.group: plain(part) for part in found},
    }
    write_json(folder / "identifiability.json", report)
    rows = [record for part in found for record in records(part)]
    write_atomically(folder / "identifiability.csv", records_csv(rows))
    write_atomically(folder / "identifiability.md", text)
    figure = identifiability_figure(found)
    figure.suptitle(title, fontsize="medium")
    with RunLog(folder) as run_log:
        run_log.text("identifiability", text)
        run_log.figure("identifiability", figure, folder)
    log.info("%s\n-> %s/identifiability.*", text, folder)
    return report


def identify(
    generator: ResponseGenerator, task: Task, settings: Observation, n_vehicles: int, seed: int
) -> Findings:
    """Return what can be identified in one group.

    Parameters
    ----------
    generator : ResponseGenerator
    task : Task
    settings : Observation
        Bound to the generator's vehicle.
    n_vehicles : int
    seed : int
    """
    ratios = with_healthy(task.sample(n_vehicles, seed, TEST))
    choices = options(task, settings.observer(generator), ratios)
    now = next((option for option in choices if option.kind == "estimate"), choices[0])
    guess = None
    curves = settings.kind == CurveSettings.kind and task.sampling == "grid"
    if curves and task.responses == ("G_s",) and "M_s" in task.unknown:
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
    """Return in words the setting of the bounds and their assumptions."""
    verdicts = ", ".join(f"{word} up to {x:g} %" for x, word in VERDICTS)
    return (
        f"{settings.words()} {generator.assumptions()} {n_vehicles} vehicles, seed {seed}, "
        f"parameters {_range(task)} of healthy.\n\nCramer-Rao bounds, one standard "
        "deviation: no unbiased estimator has less. "
        f"Identified {verdicts}, by the bound that 19 of 20 vehicles stay below."
    )


def _range(task: Task) -> str:
    """Return the ranges of suspension and mass in words."""
    low, high = (f"{100 * end:g}" for end in task.range("k_p"))
    mass_low, mass_high = (f"{100 * end:g}" for end in task.range("M_s"))
    if (low, high) == (mass_low, mass_high):
        return f"{low} to {high} %"
    return f"{low} to {high} %, mass {mass_low} to {mass_high} %"
