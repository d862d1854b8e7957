"""Train one method on one problem, or many by a multirun: python train.py --help."""

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig

from suspnet import command_line
from suspnet.experiment import train
from suspnet.fitting import Problem


@hydra.main(version_base="1.3", config_path="configs", config_name="train")
@command_line.task
def main(config: DictConfig) -> None:
    command_line.join_ranks(config.device)
    problem = Problem(
        generator=instantiate(config.generator),
        task=instantiate(config.protocol).task(config.group),
        settings=instantiate(config.data),
        seed=config.seed,
        threads=command_line.n_threads(config.threads),
        progress=config.progress,
    )
    model = instantiate(config.model)
    search = instantiate(config.search) if config.get("search") else None
    folder = command_line.run_folder()
    resolved = command_line.save_config(config, folder)
    train(
        problem,
        model,
        folder,
        search=search,
        refine=config.refine,
        figures=config.figures,
        config=resolved,
    )


if __name__ == "__main__":
    command_line.run(main)
