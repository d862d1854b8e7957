"""Write an example fleet whose truth is known: suspnet-simulate [KEY=VALUE ...]."""

from __future__ import annotations

import logging
from pathlib import Path

import hydra
from omegaconf import DictConfig

from suspnet.checks import check_number
from suspnet.cli import program
from suspnet.simulation.writing import write_fleet

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path=program.CONFIGS, config_name="simulate")
@program.task
def compose(config: DictConfig) -> None:
    """Compose the fleet, simulate it and write it."""
    folder = Path(config.out)
    if folder.exists() and any(folder.glob("*.yaml")):
        raise ValueError(f"out={folder} already holds trips; give another folder")
    check_number("workers", config.workers, low=1, most=1024, whole=True)
    manifests = write_fleet(
        folder,
        program.build(config, "fleet"),
        program.build(config, "scenario"),
        program.build(config, "generator"),
        seed=config.seed,
        scatter=config.scatter,
        n_jobs=config.workers,
        progress=config.progress,
    )
    log.info(
        "%d trips of scenario %s in %s\nread them with: python evaluate.py trips=%s run=RUN",
        len(manifests),
        config.scenario.name,
        folder,
        folder,
    )


def main() -> None:
    """Run the program."""
    program.run(compose)
