"""Score trained models on freshly generated curves: python evaluate.py run=PATH."""

from pathlib import Path

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from suspnet import command_line
from suspnet.experiment import evaluate, find_runs
from suspnet.multirun import write_table6


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
@command_line.task
def main(config: DictConfig) -> None:
    if OmegaConf.is_missing(config, "run"):
        raise ValueError("which run? Give run=PATH, the folder of a run or of a whole multirun")
    runs, output = find_runs(Path(config.run)), command_line.run_folder()
    command_line.save_config(config, output)
    results = [
        evaluate(
            folder,
            output / folder.name if len(runs) > 1 else output,
            seed=config.seed,
            n_test=config.data.n_test,
            snr_db=config.data.snr_db,
            protocol=instantiate(config.protocol) if config.get("protocol") else None,
            threads=command_line.n_threads(config.threads),
            device=config.device,
            progress=config.progress,
        )
        for folder in runs
    ]
    if len(results) > 1:
        write_table6(results, output)


if __name__ == "__main__":
    command_line.run(main)
