"""Commissioning of several suspensions: one run each, several at a time, in one folder."""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from logging.handlers import BufferingHandler
from pathlib import Path
from shlex import quote
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tabulate import tabulate

from suspnet.cli import folders, program
from suspnet.cli.config_files import as_written
from suspnet.estimation.trip_settings import LEAST_TRIPS
from suspnet.ground import own_files
from suspnet.ground.extras import check_extra, optional
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.settings import Checked, setting
from suspnet.ground.storage import read_json, write_atomically, write_json
from suspnet.ground.workers import LostWorkerError, each
from suspnet.runs.sweeps import run_errors

with optional("trips"):
    from suspnet.trains.recordings.manifest_files import ManifestFile
    from suspnet.trains.trips.grouping import Group, find_groups

log = logging.getLogger(__name__)
LOG = "train.log"  # name of the log in each run's folder
TrainOne = Callable[[DictConfig, Path, "Sequence[ManifestFile]"], None]
"""Commissions a configuration's vehicle on some manifests, trains its model and fills a folder."""


@dataclass(frozen=True)
class HealthySettings(Checked):
    """Numbers of a training on healthy trips; TypeError or ValueError if one is wrong."""

    n_healthy: int | None = setting(
        5,
        "Number of the first trips of each suspension by mileage that are taken as healthy, or "
        "{NAME: number} of several; null is all",
        low=LEAST_TRIPS,
    )
    workers: int = setting(
        2,
        "Number of suspensions that are commissioned at the same time, where healthy holds several",
        low=1,
        most=1024,
    )


@dataclass(frozen=True)
class Run:
    """The run of one suspension; `config` holds unresolved interpolations."""

    group: Group
    config: dict[str, Any]
    folder: Path


def suspensions(config: DictConfig) -> list[Group]:
    """Return the suspensions of ``healthy=``; [] if it is null.

    FileNotFoundError if the folder is missing or holds no manifest.
    """
    if config.healthy is None:
        return []
    check_extra("trips")
    return find_groups(Path(config.healthy))


def train_fleet(
    config: DictConfig, folder: Path, groups: Sequence[Group], train_one: TrainOne
) -> None:
    """Commission each suspension and train its model, in a subfolder with its name.

    A run that is already finished is not repeated. If none failed, fleet.json is written last, with
    folder, place, misfit and rms errors of each suspension; otherwise the remaining suspensions are
    trained first, then a ValueError is raised. `train_one` must be picklable.
    """
    HealthySettings(workers=config.workers)  # raises if it is wrong
    # finished runs stay; a resumed run trains only the missing ones
    failed = {group.name: group.error for group in groups if group.error}
    numbers = first_trips(config.n_healthy, [group.name for group in groups])
    runs = [_run(config, group, folder, numbers[group.name]) for group in groups if not group.error]
    unfinished = [r for r in runs if not folders.is_finished(OmegaConf.create(r.config), r.folder)]
    # no fleet.json of an earlier attempt may remain if this one fails
    folders.start_again(folder)
    program.save_config(config, folder)
    n_finished = len(runs) - len(unfinished)
    already = f", {n_finished} are finished already" if n_finished else ""
    where = folder / "NAME" / LOG
    # minutes pass before the first one is finished
    words = "%d suspensions in %s%s; each writes what it has done to %s"
    log.info(words, len(groups), config.healthy, already, where)
    for name, message in failed.items():
        log.warning("%s is not trained: %s", name, message)
    work = functools.partial(_trained, train_one=train_one)
    bar = progress_bar("suspensions", len(unfinished), unit="suspension", shown=config.progress)
    with bar:
        for run, ended in each(work, unfinished, config.workers):
            warnings, error = ([], str(ended)) if isinstance(ended, LostWorkerError) else ended
            for message in warnings:
                log.warning("%s: %s", run.group.name, message)
            if error:
                failed[run.group.name] = error
                log.warning("%s is not trained: %s", run.group.name, error)
            bar.update()
    rows = [_row(run) for run in runs if run.group.name not in failed]
    if rows:
        log.info(
            "misfit, and rms error in %% on test curves\n\n%s\n-> %s", fleet_table(rows), folder
        )
    if failed:
        names = ", ".join(sorted(failed))
        raise ValueError(
            f"{len(failed)} of {len(groups)} suspensions are not trained ({names}); the same "
            f"command with {quote(f'resume={folder}')} tries these again"
        )
    write_json(folder / folders.FLEET, rows)


def first_trips(wanted: Any, names: Sequence[str]) -> dict[str, int | None]:
    """Return the number of healthy trips of each suspension, from one of all or one of each.

    TypeError or ValueError if a number is not at least three, or of another suspension or missing.
    """
    of_each = isinstance(wanted, DictConfig)
    numbers: dict[Any, int | None] = dict(wanted) if of_each else dict.fromkeys(names, wanted)
    if numbers.keys() != set(names):
        raise ValueError(
            f"n_healthy must be a number, or name each suspension of the folder ({', '.join(names)}"
            f"), as n_healthy={{{names[0]}:5,...}}; it names {', '.join(map(str, numbers))}"
        )
    for number in numbers.values():
        HealthySettings(number)  # raises if it is wrong
    return numbers


def of_group(config: DictConfig, group: Group) -> DictConfig:
    """Return a configuration with the bogie and axle that a suspension's manifests state.

    A value that differs from the default stays.
    """
    of_bogie = config.copy()
    for key, stated in (("bogie", group.place.bogie), ("axle", group.axle)):
        if stated and of_bogie.generator.get(key) == "leading":
            of_bogie.generator[key] = stated
    return of_bogie


def _run(config: DictConfig, group: Group, folder: Path, n_healthy: int | None) -> Run:
    """Return the run of a suspension, with its own trips, bogie and axle."""
    settings = of_group(config, group)
    settings.n_healthy = n_healthy
    settings.reading_name = config.reading_name  # resolved here, as workers run without Hydra
    settings.healthy = str(group.folder)
    settings.progress = False
    return Run(group, as_written(settings), folder / group.name)


def _trained(run: Run, train_one: TrainOne) -> tuple[list[str], str]:
    """Train the model of one suspension with its own log; return its warnings and its error."""
    folders.start_again(run.folder)
    with own_log(run.folder / LOG) as warnings:
        try:
            train_one(OmegaConf.create(run.config), run.folder, run.group.manifests)
        except Exception as error:
            if isinstance(error, program.MISTAKES):
                message = program.one_line(error).removeprefix("error: ")
                write_atomically(run.folder / folders.ERROR, f"{message}\n")
            else:
                message = program.note_bug(error, run.folder)
        else:
            message = ""
        return [record.getMessage() for record in warnings.buffer], message


@contextmanager
def own_log(file: Path) -> Iterator[BufferingHandler]:
    """Send this package's log to a file only, and yield the handler that collects its warnings."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file = own_files.free_name(file)  # the log of an earlier attempt stays
    logger, warnings = logging.getLogger("suspnet"), BufferingHandler(sys.maxsize)
    warnings.setLevel(logging.WARNING)
    before = logger.level, logger.propagate
    handlers = [logging.FileHandler(file, mode="x", encoding="utf-8"), warnings]
    logger.setLevel(logging.INFO)
    logger.propagate = False
    for handler in handlers:
        logger.addHandler(handler)
    try:
        yield warnings
    finally:
        logger.level, logger.propagate = before
        for handler in handlers:
            logger.removeHandler(handler)
            handler.close()


def _row(run: Run) -> dict[str, Any]:
    healthy = read_json(run.folder / "commissioning.json")
    return {
        "suspension": run.group.name,
        "place": asdict(run.group.place),
        "n_trips": healthy["n_trips"],
        "misfit": healthy["misfit"],
        "explained": healthy["explained"],
        "rms_percent": run_errors(run.folder),
    }


def fleet_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return misfit and rms errors of each suspension as Markdown."""
    outputs = dict.fromkeys(name for row in rows for name in row["rms_percent"])
    head = ["suspension", "trips", "misfit", *outputs]
    body = [
        [row["suspension"], row["n_trips"], row["misfit"], *map(row["rms_percent"].get, outputs)]
        for row in rows
    ]
    formats = ("", "", ".2f", *[".2g"] * len(outputs))
    return tabulate(body, head, tablefmt="github", floatfmt=formats)
