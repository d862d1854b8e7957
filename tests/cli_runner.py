"""Runs the programs: in this process, or as a command in another."""

import json
import subprocess
import sys
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import open_dict

from suspnet.cli.program import CONFIGS

ROOT = Path(__file__).parents[1]
FEW = ["data.n_train=300", "data.n_test=100", "data.n_calibrate=100"]
SMALL = [*FEW, "data.cache_dir=null", "progress=false"]


def run_main(module, folder, *overrides):
    """Compose and run a program in this process; its run folder is `folder`."""
    name = module.__name__.rsplit(".", 1)[1]
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        output = f"hydra.runtime.output_dir={folder}"
        config = compose(name, overrides=[*overrides, output], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    folder.mkdir(parents=True, exist_ok=True)
    module.compose(config)
    return json.loads((folder / "metrics.json").read_text())


def command(program, *overrides, launcher=(), cwd=ROOT, **options):
    return subprocess.run(
        [sys.executable, *launcher, str(ROOT / program), *overrides],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
        **options,
    )
