"""Train one method on one problem, or many by a multirun: suspnet-train --help."""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig

from suspnet.cli import naming, program
from suspnet.problem import Problem
from suspnet.runs.scores import Metrics
from suspnet.runs.speeds import SpeedRange, speed_ranges, train_ranges
from suspnet.runs.train import train

NO_SPEED = (
    "a range of speeds is for models that read trips and depend on the speed: experiment=trips "
    "with a vehicle of known geometry; give one speed_m_per_s"
)


@hydra.main(version_base="1.3", config_path=program.CONFIGS, config_name="train")
@program.task
def compose(config: DictConfig) -> None:
    """Build what the configuration names, train it and fill the run folder.

    A range of speeds is several models, each in a folder of its own.
    """
    program.join_ranks(config.device)
    folder = program.run_folder()
    if not isinstance(config.speed_m_per_s, ListConfig):
        _train(config, folder)
        return
    if "speed_half_width" not in config.data:
        raise ValueError(NO_SPEED)
    ranges = speed_ranges(list(config.speed_m_per_s), config.data.speed_half_width)

    def bound(one: SpeedRange) -> DictConfig:
        found = config.copy()
        found.speed_m_per_s = one.trained_m_per_s
        found.data.speed_half_width = one.half_width
        return found

    if instantiate(bound(ranges[0]).generator).speed_m_per_s is None:
        raise ValueError(NO_SPEED)
    program.save_config(config, folder)
    train_ranges(ranges, lambda one, where: _train(bound(one), where), folder)


def _train(config: DictConfig, folder: Path) -> Metrics:
    """Train what a configuration names and fill a folder."""
    problem = Problem(
        generator=instantiate(config.generator),
        task=instantiate(config.protocol).task(config.group),
        settings=instantiate(config.data),
        seed=config.seed,
        threads=program.n_threads(config.threads),
        progress=config.progress,
    )
    model = instantiate(config.model)
    search = instantiate(config.search) if config.get("search") else None
    resolved = program.save_config(config, folder)
    return train(
        problem,
        model,
        folder,
        search=search,
        refine=config.refine,
        figures=config.figures,
        config=resolved,
        varied=naming.varied(config),
        draw_vehicle=naming.is_first_of_its_vehicle(),
    )


def main() -> None:
    """Run the program."""
    program.run(compose)
