"""Rigs in the programs: train on healthy records, evaluate later ones."""

import logging
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from suspnet.cli import folders, program
from suspnet.cli.commission_fleet import HealthySettings
from suspnet.cli.kinds import build, plain
from suspnet.ground.extras import check_extra, optional
from suspnet.ground.parameters import DEFAULT_LIMITS, Severity, read_limits
from suspnet.ground.settings import check_number
from suspnet.ground.wording import command
from suspnet.vehicle.rig import Rig

with optional("trips"):
    from suspnet.estimation.rig_files import RIG_FILE, load_rig
    from suspnet.trains.jobs import rigs

log = logging.getLogger(__name__)
OF_ANY = ("job", "seed", "threads", "progress", "figures", "language")
OF_TRAINING = ("vehicle", "healthy", "n_healthy", "experiment", *OF_ANY)
OF_READING = ("run", "trips", "monitor.limits", "monitor.trips.level", *OF_ANY)
"""Keys that may be typed for a rig, those of training and those of later records."""


def is_rig(config: DictConfig) -> bool:
    """Return whether the vehicle of a training is a rig.

    ValueError if it is none, but the healthy records are of one.
    """
    if OmegaConf.select(config, "vehicle.kind") is not None:
        return True
    if config.healthy is not None:
        check_extra("trips")
        if rigs.holds_records(Path(config.healthy)):
            raise ValueError(
                f"{config.healthy} holds records of a rig, but vehicle={config.vehicle.name} is "
                "none: give --config-dir DIR, the folder with its file vehicle/NAME.yaml, in which "
                "`kind: rig` stands"
            )
    return False


def train_rig(config: DictConfig, folder: Path) -> None:
    """Commission the rig on its healthy records and fill a folder."""
    rig: Rig = build(config, "vehicle")
    if config.healthy is None:
        raise ValueError(f"{rig.name} is a rig, which is learnt on records: give healthy=DIR")
    check_extra("trips")
    _check_typed(OF_TRAINING)
    HealthySettings(config.n_healthy)  # raises if it is wrong
    commissioned = rigs.commission_folder(rig, Path(config.healthy), folder, config.n_healthy)
    program.save_config(config, folder)
    for line in rigs.commissioning_lines(commissioned):
        log.info("%s", line)
    log.info("then run: %s", command("evaluate", "trips=DIR", f"run={folder}"))


def is_rig_run(run: object) -> bool:
    """Return whether `run=` names the folder of a commissioned rig."""
    return isinstance(run, str) and (Path(run) / RIG_FILE).is_file()


def evaluate_rig(config: DictConfig, output: Path) -> list[Severity]:
    """Read a folder of records with a commissioned rig; return how urgent each is."""
    if config.trips is None:
        raise ValueError(f"{config.run} holds a rig, which reads records: give trips=DIR")
    _check_typed(OF_READING)
    rig, level = load_rig(config.run), config.monitor.trips.level
    check_number("monitor.trips.level", level, above=0, below=1)
    # limits that the command line sets hold for this evaluation
    wanted = plain(config.monitor.limits) or {}
    limits = read_limits(wanted, rig.rig.known_limits, "set for this evaluation")
    stated = {name: limits[name].to_dict() if name in limits else None for name in DEFAULT_LIMITS}
    rig = replace(rig, rig=replace(rig.rig, limits=stated))
    program.save_config(config, output)
    results = rigs.read_folder(rig, Path(config.trips), output, level)
    for line in rigs.reading_lines(rig, results, level):
        log.info("%s", line)
    log.info("-> %s", output / "records.csv")
    return [result.severity for result in results]


def _check_typed(allowed: tuple[str, ...]) -> None:
    """Raise ValueError if a setting is typed that changes nothing for a rig."""
    for key in folders.typed_settings():
        if not any(f"{key}.".startswith(f"{name}.") for name in allowed):
            raise ValueError(f"`{key}` is not for rigs: leave it out; allowed are {allowed}")
