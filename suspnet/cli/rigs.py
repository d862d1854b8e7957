"""Rigs in the programs: train on healthy records, evaluate later ones."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from suspnet.cli import program
from suspnet.cli.folders import ACT, FINE, NOTICE, SOME_WITHOUT_ESTIMATE, worst
from suspnet.cli.kinds import build, plain
from suspnet.ground.extras import check_extra, optional
from suspnet.ground.parameters import DEFAULT_LIMITS, Severity, read_limits
from suspnet.ground.settings import check_number
from suspnet.ground.wording import command
from suspnet.vehicle.rig import Rig

with optional("trips"):
    from suspnet.estimation.rig_files import load_rig
    from suspnet.trains.jobs.rigs import (
        commission_folder,
        commissioning_lines,
        holds_records,
        read_folder,
        reading_lines,
    )
if TYPE_CHECKING:
    from suspnet.estimation.commissioned_rig import CommissionedRig
    from suspnet.trains.jobs.rigs import RigResult

log = logging.getLogger(__name__)
CODES = {Severity.UNKNOWN: SOME_WITHOUT_ESTIMATE, Severity.NOTICE: NOTICE, Severity.ACT: ACT}


def is_rig(config: DictConfig) -> bool:
    """Return whether the vehicle of a training is a rig.

    ValueError if it is none, but the healthy records are of one.
    """
    if OmegaConf.select(config, "vehicle.kind") == "rig":
        return True
    if config.healthy is not None:
        check_extra("trips")
        if holds_records(Path(config.healthy)):
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
    check_number("n_healthy", config.n_healthy, low=3, whole=True, optional=True)
    commissioned = commission_folder(rig, Path(config.healthy), folder, config.n_healthy)
    program.save_config(config, folder)
    for line in commissioning_lines(commissioned):
        log.info("%s", line)
    log.info("then run: %s", command("evaluate", "trips=DIR", f"run={folder}"))


def is_rig_run(run: object) -> bool:
    """Return whether `run=` names the folder of a commissioned rig."""
    return isinstance(run, str) and (Path(run) / "rig.json").is_file()


def evaluate_rig(config: DictConfig, output: Path) -> int:
    """Read a folder of records with a commissioned rig; return the exit code."""
    if config.trips is None:
        raise ValueError(f"{config.run} holds a rig, which reads records: give trips=DIR")
    if config.store is not None:
        raise ValueError("store= is for trains: the history has mileages, which rigs have not")
    rig = _with_limits(load_rig(config.run), plain(config.monitor.limits) or {})
    program.save_config(config, output)
    level = config.monitor.trips.level
    results = read_folder(rig, Path(config.trips), output, level)
    for line in reading_lines(rig, results, level):
        log.info("%s", line)
    log.info("-> %s", output / "records.csv")
    return worst(_code(result) for result in results)


def _with_limits(rig: CommissionedRig, wanted: dict[str, Any]) -> CommissionedRig:
    """Return the rig with limits that the command line sets for this evaluation."""
    limits = read_limits(wanted, rig.rig.known_limits, "set for this evaluation")
    stated = {name: limits[name].to_dict() if name in limits else None for name in DEFAULT_LIMITS}
    return replace(rig, rig=replace(rig.rig, limits=stated))


def _code(result: RigResult) -> int:
    return CODES.get(result.severity, FINE)
