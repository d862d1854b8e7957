"""The identifiability report: what sensors and noise allow, before any of them is bought."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any

from suspnet.data import TEST, CurveSettings, EstimateSettings, Protocol, Task
from suspnet.dynamics import QuarterCar, VerticalVehicle
from suspnet.runs.tables import records_csv
from suspnet.runs.tensorboard import RunLog
from suspnet.storage import write_atomically, write_json
from suspnet.studies import figures
from suspnet.studies.findings import Findings, group_markdown, plain, records
from suspnet.theory.bounds import VERDICTS, bounds, directions, with_healthy
from suspnet.theory.information import scale_ambiguity_limit
from suspnet.theory.options import options

log = logging.getLogger(__name__)
Generator = QuarterCar | VerticalVehicle
Settings = CurveSettings | EstimateSettings


def write_identifiability(
    generator: Generator,
    protocol: Protocol,
    settings: Settings,
    folder: Path,
    *,
    group: str | None,
    n_vehicles: int,
    seed: int,
) -> dict[str, Any]:
    """Write identifiability.md, .csv, .json and .png and print the tables.

    Parameters
    ----------
    generator : QuarterCar or VerticalVehicle
    protocol : Protocol
    settings : CurveSettings or EstimateSettings
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
    ValueError
        If there is no such group, or the number of vehicles or the seed is no whole number.
    """
    for name, value, least in (("n_vehicles", n_vehicles, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"`{name}` must be a whole number >= {least}, got {value!r}")
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
        "verdict_limits_percent": {word: limit for limit, word in VERDICTS},
        "groups": {part.task.group: plain(part) for part in found},
    }
    write_json(folder / "identifiability.json", report)
    rows = [record for part in found for record in records(part)]
    write_atomically(folder / "identifiability.csv", records_csv(rows))
    write_atomically(folder / "identifiability.md", text)
    figure = figures.identifiability(found)
    figure.suptitle(title, fontsize="medium")
    with RunLog(folder) as run_log:
        run_log.text("identifiability", text)
        run_log.figure("identifiability", figure, folder)
    log.info("%s\n-> %s/identifiability.*", text, folder)
    return report


def identify(
    generator: Generator, task: Task, settings: Settings, n_vehicles: int, seed: int
) -> Findings:
    """Return what can be identified in one group.

    Parameters
    ----------
    generator : QuarterCar or VerticalVehicle
    task : Task
    settings : CurveSettings or EstimateSettings
        Bound to the generator's vehicle.
    n_vehicles : int
    seed : int
    """
    ratios = with_healthy(task.sample(n_vehicles, seed, TEST))
    choices = options(task, settings.observer(generator), ratios)
    now = next((option for option in choices if option.kind == "estimate"), choices[0])
    guess = None
    curves = isinstance(settings, CurveSettings) and task.sampling == "grid"
    if curves and task.responses == ("G_s",) and "M_s" in task.unknown:
        guess = scale_ambiguity_limit(task, ratios[1:])["k_s"]["mape_percent"]
    return Findings(
        vehicle=generator.vehicle,
        task=task,
        table=[(option, bounds(option, ratios)) for option in choices],
        now=now,
        directions=directions(now.information[0], now.unknown),
        guess_percent=guess,
    )


def _setting(
    generator: Generator, settings: Settings, task: Task, n_vehicles: int, seed: int
) -> str:
    """Return in words what the bounds are of and what they take for granted."""
    band = f"{settings.low_hz:.3g} to {settings.high_hz:.3g} Hz"
    if isinstance(settings, CurveSettings):
        precision = 100 * 10 ** (-settings.snr_db / 20)
        measured = (
            f"Magnitudes of the responses, {band}, with white noise of {settings.snr_db:g} dB, "
            f"{precision:.2g} % of each curve's rms."
        )
    else:
        measured = (
            f"Trips of {settings.minutes:g} minutes at {settings.speed_m_per_s:g} m/s, track "
            f"{settings.track}, {band}. White noise of each sensor: {settings.snr_db:g} dB over "
            "its whole band. All three sensors are used, whichever curves the protocol names."
        )
        if settings.method != "IV":
            measured += f" The bias of {settings.method} in noise is taken as known."
    if isinstance(generator, VerticalVehicle):
        model = (
            "The vehicle pitches; speed, geometry, inertias and the other bogie are taken as known "
            "exactly."
        )
    else:
        model = (
            "The quarter car has three places for sensors; generator=vertical_vehicle, where the "
            "geometry is known, has more."
        )
    limits = ", ".join(f"{word} up to {limit:g} %" for limit, word in VERDICTS)
    return (
        f"{measured} {model} {n_vehicles} vehicles, seed {seed}, parameters {_range(task)} of "
        "healthy.\n\nCramer-Rao bounds, one standard deviation: no unbiased estimator has less. "
        f"Identified {limits}, by the bound that 19 of 20 vehicles stay below."
    )


def _range(task: Task) -> str:
    low, high = (f"{100 * limit:g}" for limit in task.limits("k_p"))
    mass_low, mass_high = (f"{100 * limit:g}" for limit in task.limits("M_s"))
    if (low, high) == (mass_low, mass_high):
        return f"{low} to {high} %"
    return f"{low} to {high} %, mass {mass_low} to {mass_high} %"
