"""Score trained models on fresh curves, or read trips with them: suspnet-evaluate run=PATH."""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from suspnet.cli import program
from suspnet.model.checkpoint import load_model
from suspnet.runs.sweeps import write_table6
from suspnet.runs.train import evaluate, find_runs
from suspnet.trips.fleet import evaluate_fleet
from suspnet.trips.records import OK

SOME_WITHOUT_ESTIMATE = 2
"""Exit code if a trip has no estimate."""


@hydra.main(version_base="1.3", config_path=program.CONFIGS, config_name="evaluate")
@program.task
def compose(config: DictConfig) -> None:
    """Run a study, read trips or score the models of a run, whichever the configuration asks."""
    if OmegaConf.is_missing(config, "run"):
        raise ValueError("which run? Give run=PATH, the folder of a run or of a whole multirun")
    if config.study is not None:
        program.n_threads(config.threads)
        program.save_config(config, program.run_folder())
        instantiate(config.study, folder=program.run_folder())
        return
    runs, output = find_runs(Path(config.run)), program.run_folder()
    program.save_config(config, output)
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
            threads=program.n_threads(config.threads),
            device=config.device,
            progress=config.progress,
        )
        for folder in runs
    ]
    if len(results) > 1:
        write_table6(results, output)


def main() -> None:
    """Run the program."""
    program.run(compose)
