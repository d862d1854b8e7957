"""Score trained models on fresh curves, or read trips with them: python evaluate.py run=PATH."""

import sys
from pathlib import Path

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from suspnet import command_line
from suspnet.checkpoint import load_model
from suspnet.experiment import evaluate, find_runs
from suspnet.monitoring.fleet import evaluate_fleet
from suspnet.monitoring.records import OK
from suspnet.multirun import write_table6

SOME_WITHOUT_ESTIMATE = 2


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
@command_line.task
def main(config: DictConfig) -> None:
    if config.study is not None:
        command_line.n_threads(config.threads)
        command_line.save_config(config, command_line.run_folder())
        instantiate(config.study, folder=command_line.run_folder())
        return
    if OmegaConf.is_missing(config, "run"):
        raise ValueError("which run? Give run=PATH, the folder of a run or of a whole multirun")
    runs, output = find_runs(Path(config.run)), command_line.run_folder()
    command_line.save_config(config, output)
    if config.trips is not None:
        models = [load_model(folder, config.device) for folder in runs]
        settings = instantiate(config.monitor)
        trips = evaluate_fleet(Path(config.trips), models, output, settings, config.progress)
        sys.exit(0 if all(trip.status == OK for trip in trips) else SOME_WITHOUT_ESTIMATE)
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
