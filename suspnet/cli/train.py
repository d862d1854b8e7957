"""Train one method on one problem, or many in a multirun: suspnet-train --help."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from omegaconf import DictConfig
from sklearn.exceptions import ConvergenceWarning

from suspnet.cli import folders, program
from suspnet.cli.commission_fleet import HealthySettings, of_group, suspensions, train_fleet
from suspnet.cli.kinds import build
from suspnet.cli.rigs import is_rig, train_rig
from suspnet.cli.typed_words import of_each_name
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import Problem
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.extras import optional
from suspnet.ground.wording import command
from suspnet.runs.dataset import write_dataset
from suspnet.runs.fit import check_hyperparameters
from suspnet.runs.language import check_language, speaking
from suspnet.runs.train import RunContext, train

with optional("trips"):  # `suspensions` says what is missing
    from suspnet.trains.fits.commissioning import as_bogie
    from suspnet.trains.identification.healthy_trips import read_healthy
    from suspnet.trains.jobs import commissioning
    from suspnet.trains.pages.commissioning_page import training_notes, write_outcome
    from suspnet.trains.recordings.manifest_files import ManifestFile

log = logging.getLogger(__name__)
NO_HEALTHY = "speed_m_per_s=null is for healthy=DIR, whose trips show the speeds; give a speed"
FIRST_M_PER_S = 70.0
"""Assumed speed until the healthy trips have shown theirs, [m/s]; only leakage depends on it."""
OF_REGRESSIONS = ("speed_m_per_s", "model", "refine", "search", "dataset")
"""Settings that the vehicle of healthy trips does not need."""


@program.task
def main(config: DictConfig) -> None:
    """Build what the configuration names, train it and fill the run folder.

    Healthy trips of several suspensions give several models, each in its own folder.
    """
    warnings.simplefilter("always", ConvergenceWarning)
    check_language(config.language)
    program.n_threads(config.threads)  # healthy trips are fitted before the models are
    if isinstance(config.n_healthy, str):
        config.n_healthy = of_each_name(config.n_healthy)
    if is_rig(config):
        train_rig(config, program.run_folder())
        return
    folder, groups = program.run_folder(), suspensions(config)
    if len(groups) == 1:
        config = of_group(config, groups[0])
    finished = folders.finished_run(config, folder)
    may_have_grown = (folder / folders.FLEET).is_file()  # by another suspension
    if finished is not None and not (finished == folder and may_have_grown):
        log.info("finished before: %s", finished)
        return
    if config.healthy is not None:
        typed = folders.typed_settings()
        if unused := [key for key in typed if key.partition(".")[0] in OF_REGRESSIONS]:
            words = "without effect, as the vehicle of healthy trips reads trips itself: %s"
            log.warning(words, ", ".join(unused))
    # `healthy` holds several suspensions, or subfolders of trips
    if len(groups) > 1 or (groups and groups[0].folder != Path(config.healthy)):
        at_a_speed = _at_a_speed(config)
        _check_healthy(at_a_speed)
        commissioning.check_generator(build(at_a_speed, "generator"))
        train_fleet(config, folder, groups, _run)
    else:
        folders.start_again(folder)
        _run(config, folder)
    if groups:
        evaluation = command("evaluate", f"trips={config.healthy}", f"run={folder}")
        log.info("then run: %s", evaluation)
    elif not folders.is_job():
        log.info("then run: %s", command("evaluate", f"run={folder}"))


def _run(config: DictConfig, folder: Path, paths: Sequence[ManifestFile] | None = None) -> None:
    """Train the models of one suspension and fill a folder.

    `paths`: manifests of its healthy trips, None is all of the folder.
    """
    # refuse wrong settings before minutes of healthy trips and curves
    build(config, "protocol").task(config.group)
    check_hyperparameters(build(config, "model"))
    if config.healthy is not None:
        model = _commissioned(_at_a_speed(config), folder, paths)
        program.save_config(config, folder)
        commissioning.write_bogie_model(folder, model)
        return
    if config.speed_m_per_s is None:
        raise ValueError(NO_HEALTHY)
    _train(config, folder)


def _at_a_speed(config: DictConfig) -> DictConfig:
    """Return a configuration with one speed and length, before healthy trips have shown theirs."""
    at_speed = config.copy()
    if "minutes" in at_speed.data and at_speed.data.minutes is None:
        at_speed.data.minutes = EstimateSettings.minutes
    if at_speed.speed_m_per_s is None:
        at_speed.speed_m_per_s = FIRST_M_PER_S
    return at_speed


def _check_healthy(config: DictConfig) -> EstimateSettings:
    """Return the settings of estimates from healthy trips; ValueError if `data` reads no trips."""
    settings = build(config, "data")
    if not isinstance(settings, EstimateSettings):
        raise ValueError("healthy= is for models that read trips: leave experiment= out")
    return settings


def _commissioned(
    config: DictConfig, folder: Path, paths: Sequence[ManifestFile] | None
) -> BogieModel:
    """Return the model of the vehicle that healthy trips show."""
    # wrong settings are refused before minutes of reading
    settings, trips = _check_healthy(config), TripSettings()
    HealthySettings(config.n_healthy)  # raises if it is wrong
    generator = commissioning.check_generator(build(config, "generator"))
    settings = settings.bound(generator.vehicle)
    chosen = {"paths": paths, "n_first": config.n_healthy, "progress": config.progress}
    healthy = read_healthy(Path(config.healthy), generator, settings, trips, **chosen)
    if generator.parts and healthy.vehicle.shows_parts:
        log.warning(
            "without effect, as the sensors show each part: generator.parts=[%s]",
            ",".join(generator.parts),
        )
    bogie = commissioning.commission_parts(healthy, trips)
    outcome = as_bogie(commissioning.prior_of(generator, healthy), bogie)
    with speaking(config.language):
        write_outcome(folder, healthy, outcome)
    usual = replace(outcome.generator, speed_m_per_s=median(healthy.speeds_m_per_s))
    return BogieModel(bogie, usual, settings, {"commissioned": training_notes(healthy, outcome)})


def _train(config: DictConfig, folder: Path) -> None:
    """Train one model and fill a folder."""
    problem = Problem(
        generator=build(config, "generator"),
        task=build(config, "protocol").task(config.group),
        settings=build(config, "data"),
        seed=config.seed,
        threads=program.n_threads(config.threads),
        progress=config.progress,
    )
    if config.dataset is not None and not (path := folder / f"dataset.{config.dataset}").exists():
        write_dataset(problem, path)
    model = build(config, "model")
    search = build(config, "search") if config.get("search") else None
    resolved = program.save_config(config, folder)
    options = {"search": search, "refine": config.refine, "figures": config.figures}
    train(problem, model, folder, **options, context=RunContext(resolved, folders.swept()))
