"""Check manifests and recordings, with a model or without: suspnet check DIR ..."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from suspnet.cli.init import command_line
from suspnet.cli.kinds import named_runs, vehicles_with
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground import ledger, progress
from suspnet.ground.settings import check_number
from suspnet.ground.storage import distinct, new_folder
from suspnet.ground.workers import LostWorkerError, each
from suspnet.recordings.manifest_files import find_trips
from suspnet.report.language import speaking
from suspnet.trips.check import CheckSettings, Opened, check_trip
from suspnet.trips.check_page import (
    PROBLEM,
    READY,
    TripCheck,
    summary,
    suspensions,
    with_shared_data,
    write_checks,
)

MANY_TRIPS = 5
"""Number of healthy trips from which on more of them change little."""
PARTS_MINUTES = 15
"""Least length of trips that show each part of a bogie, [min]."""


def check(arguments: Namespace) -> int:
    """Check what the command line names and return the exit code."""
    check_number("--workers", arguments.workers, low=1, whole=True)
    known = {vehicle.name: vehicle for vehicle in vehicles_with(arguments.config_dir).values()}
    models = [load_model(run) for run in named_runs(arguments.run or [])]
    output = _folder(arguments.output)
    pictures = None if arguments.no_pictures else output
    settings = CheckSettings(known, pictures=pictures, models=models)
    paths, elsewhere = find_trips(arguments.trips)
    with progress.on_stderr():
        checks = with_shared_data(_checked(paths, settings, arguments.workers, arguments.language))
    with speaking(arguments.language):
        page = write_checks(checks, elsewhere, output)
    print(f"{summary(checks, elsewhere)}\n-> {page}")
    if step := _next_step(arguments, checks, elsewhere):
        print(step)
    return exit_code(checks, elsewhere)


def _next_step(
    arguments: Namespace, checks: Sequence[TripCheck], elsewhere: Sequence[str]
) -> str | None:
    """Return what to run after a folder of ready trips of one vehicle; None after any other."""
    (folder, *others), config_dir = arguments.trips, arguments.config_dir
    own = [] if config_dir is None else ["--config-dir", config_dir]
    vehicles = {check.vehicle for check in checks}
    if others or not Path(folder).is_dir() or arguments.run or exit_code(checks, elsewhere):
        return None
    named = {
        one.name: key for key, one in vehicles_with(config_dir).items() if one.name in vehicles
    }
    if named.keys() != vehicles:
        again = command_line("check", folder, "--config-dir", "FOLDER")
        return f"with the folder of the vehicle's file all is checked: {again}"
    ready = [[one for one in group.checks if one.state == READY] for group in suspensions(checks)]
    n_healthy = min([MANY_TRIPS, *map(len, ready)])
    if len(vehicles) > 1 or n_healthy < LEAST_TRIPS:
        return None
    minutes = int(min(one.duration_s for group in ready for one in group) / 60)
    all_pairs = all(one.sensors.split(";")[0] == "pairs" for group in ready for one in group)
    parts = ["protocol=components"] if all_pairs and minutes >= PARTS_MINUTES else []
    settings = [f"vehicle={named.popitem()[1]}", "experiment=trips", *parts]
    trips = [f"healthy={folder}", f"n_healthy={n_healthy}", f"data.minutes={minutes}"]
    then = command_line("train", *own, *settings, *trips)
    return f"then run, with n_healthy as many of the first trips as were healthy: {then}"


def _checked(
    paths: Sequence[Path], settings: CheckSettings, n_workers: int, language: str
) -> list[TripCheck]:
    opened = Opened() if n_workers == 1 else None  # processes share nothing
    names = picture_names(paths)
    one = partial(_check_one, settings=settings, opened=opened, language=language)
    done = each(one, names.items(), n_workers)
    found = {}
    for (path, _), result in progress.bar("trips", len(paths), items=done, unit="trip"):
        if isinstance(result, LostWorkerError):
            result = TripCheck(path, problems=(str(result),))
        found[path] = result
    return [found[path] for path in paths]


def _check_one(
    item: tuple[Path, str], settings: CheckSettings, opened: Opened | None, language: str
) -> TripCheck:
    with speaking(language):
        return check_trip(item[0], settings, item[1], opened)


def exit_code(checks: Sequence[TripCheck], elsewhere: Sequence[str]) -> int:
    """Return 0 if every trip could be read, 1 otherwise."""
    return int(bool(elsewhere) or any(check.state == PROBLEM for check in checks))


def picture_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return a unique picture name for each manifest."""
    names = distinct(path.stem for path in paths)
    return {path: f"{name}.png" for path, name in zip(paths, names, strict=True)}


def _folder(wanted: Path | None) -> Path:
    """Make and return the output folder: the one given, or a new one named by the time."""
    if wanted is None:
        wanted = new_folder(Path(f"outputs/check/{datetime.now():%Y-%m-%d_%H-%M-%S}"))
    ledger.begin(wanted)
    return wanted
