"""Write an example fleet whose truth is known: suspnet-simulate [KEY=VALUE ...]."""

from __future__ import annotations

import logging
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from suspnet.checks import check_number
from suspnet.cli import program
from suspnet.simulation.folders import FolderTakenError
from suspnet.simulation.writing import write_fleet

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=program.CONFIGS, config_name="simulate")
@program.task
def compose(config: DictConfig) -> None:
    """Compose the fleet, simulate it and write it."""
    check_number("workers", config.workers, low=1, most=1024, whole=True)
    try:
        manifests = write_fleet(
            Path(config.out),
            program.build(config, "fleet"),
            program.build(config, "scenario"),
            program.build(config, "generator"),
            seed=config.seed,
            scatter=config.scatter,
            n_jobs=config.workers,
            progress=config.progress,
        )
    except FolderTakenError as error:
        raise ValueError(f"out={error}") from error
    folder = manifests[0].parent
    log.info(
        "%d trips of scenario %s in %s\nlearn the vehicle from the first of them: "
        "python train.py experiment=trips vehicle=%s healthy=%s n_healthy=5 data.minutes=%g\n"
        "then read all of them: python evaluate.py trips=%s run=RUN",
        len(manifests),
        config.scenario.name,
        folder,
        HydraConfig.get().runtime.choices["vehicle"],
        folder,
        config.fleet.minutes,
        folder,
    )


def main() -> None:
    """Run the program."""
    program.run(compose)
