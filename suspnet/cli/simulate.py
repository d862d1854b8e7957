"""Write an example fleet with known parameters: suspnet-simulate [KEY=VALUE ...]."""

import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from suspnet.cli import program
from suspnet.cli.kinds import build
from suspnet.estimation.trip_settings import N_HEALTHY
from suspnet.ground.settings import check_number
from suspnet.ground.wording import command
from suspnet.trains.simulation.fleet import Trains
from suspnet.trains.simulation.folders import FolderTakenError
from suspnet.trains.simulation.writing import Simulation, write_fleet, write_trains

log = logging.getLogger(__name__)


@program.task
def main(config: DictConfig) -> None:
    """Compose the fleet, simulate it and write it."""
    check_number("workers", config.workers, low=1, most=1024, whole=True, optional=True)
    trains = _trains(config)
    parts = [build(config, key) for key in ("fleet", "scenario", "generator")]
    fleet, scenario, generator = parts
    simulation = Simulation(fleet, scenario, generator, config.seed, config.scatter)
    options: dict[str, Any] = {"n_jobs": config.workers, "progress": config.progress}
    try:
        if trains is None:
            manifests = write_fleet(Path(config.out), simulation, **options)
            folder = manifests[0].parent
            log.info("%d trips of scenario %s in %s", len(manifests), config.scenario.name, folder)
        else:
            folder = write_trains(Path(config.out), trains, simulation, **options)[0].parent
            _log_trains(config, trains, folder)
    except FolderTakenError as error:
        raise ValueError(f"out={error}") from error
    n_healthy = min(3 if trains else N_HEALTHY, fleet.n_trips)
    learn = [] if n_healthy == N_HEALTHY else [f"n_healthy={n_healthy}"]
    log.info(
        "learn the vehicle%s: %s\nthen read all of them: %s",
        " of each suspension from its first trips" if trains else " from the first of them",
        command("train", f"healthy={folder}", *learn),
        command("evaluate", f"trips={folder}", "run=RUN"),
    )


def _trains(config: DictConfig) -> Trains | None:
    """Return the trains of the fleet; None for a single suspension."""
    if config.trains is not None:
        return Trains(config.trains, config.cars, config.n_wearing)
    for key in ("cars", "n_wearing"):
        if config[key] is not None:
            raise ValueError(f"{key}={config[key]} is of a fleet of trains: give trains= too")
    return None


def _log_trains(config: DictConfig, trains: Trains, folder: Path) -> None:
    """Log how many suspensions of trains were simulated, and which of them wear."""
    wearing = [own.name for own in trains.suspensions(config.seed) if own.wears]
    log.info(
        "%d suspensions (trains=%d, cars=%d) of %d trips each in %s\n%d wear, scenario %s: %s",
        *(trains.n_all, trains.trains, trains.cars or 1, config.fleet.n_trips, folder),
        *(len(wearing), config.scenario.name, ", ".join(wearing) or "none"),
    )
