"""Train one method on one problem, or many by a multirun: suspnet-train --help."""

from __future__ import annotations

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig

from suspnet.cli import naming, program
from suspnet.problem import Problem
from suspnet.runs.train import train


@hydra.main(version_base="1.3", config_path=program.CONFIGS, config_name="train")
@program.task
def compose(config: DictConfig) -> None:
    """Build what the configuration names, train it and fill the run folder."""
    program.join_ranks(config.device)
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
    folder = program.run_folder()
    resolved = program.save_config(config, folder)
    train(
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
