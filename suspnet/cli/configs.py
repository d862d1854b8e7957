"""The folder of the configurations, and the options that one file of it holds."""

from __future__ import annotations

from pathlib import Path

from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from suspnet.dynamics import Vehicle


def _configs() -> str:
    """Return the folder of the configurations: in the package if installed, else the checkout's."""
    packaged = Path(__file__).parents[1] / "configs"
    return str(packaged if packaged.is_dir() else packaged.parents[1] / "configs")


CONFIGS = _configs()
"""Absolute path of the folder that Hydra composes from."""
TABLES = {"ablation": ("ablations.yaml", "_global_"), "scenario": ("scenarios.yaml", "scenario")}
"""File and package of each group whose options are the entries of one file."""


def store_tables() -> None:
    """Make each entry of ablations.yaml and scenarios.yaml an option of its group.

    The first entry holds what all share; the others change it. A file GROUP/NAME.yaml in a folder
    of the user's (`--config-dir`) is an option like any other.
    """
    for group, (file, package) in TABLES.items():
        table = OmegaConf.load(Path(CONFIGS) / file)
        first = next(iter(table))
        for name, entry in table.items():
            node = entry if name == first else {"defaults": [first, "_self_"], **entry}
            ConfigStore.instance().store(name=str(name), node=node, group=group, package=package)


def read_vehicles() -> dict[str, Vehicle]:
    """Return the vehicle of every file of the group `vehicle`, by the file's name."""
    vehicles = {}
    for file in sorted((Path(CONFIGS) / "vehicle").glob("*.yaml")):
        content = OmegaConf.load(file)
        assert isinstance(content, DictConfig)
        # a road vehicle's file sets a speed and a track beside the vehicle
        vehicles[file.stem] = instantiate(OmegaConf.select(content, "vehicle", default=content))
    return vehicles
