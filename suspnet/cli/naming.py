"""Names of run folders: what differs from the shipped configuration and from run to run."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

UNNAMED = {
    *("experiment", "study", "job", "run", "out", "progress", "figures", "threads", "device"),
    *("workers", "data.cache_dir", "resume"),
}
"""Keys left out of folder names: the path shows them already, or they change no number."""
OF_THE_VEHICLE = ("vehicle", "generator", "speed_m_per_s")
"""Keys that change the vehicle's frequency responses."""
MAX_CHARACTERS = 100
"""Length at which a name is cut; file systems allow 255 for the whole folder name."""


def register() -> None:
    """Register ${changed:...}, ${swept_by:} and ${unless_healthy:...} with OmegaConf."""
    OmegaConf.register_new_resolver("changed", _changed, replace=True)
    OmegaConf.register_new_resolver("swept_by", _swept_by, replace=True)
    OmegaConf.register_new_resolver("unless_healthy", _unless_healthy, replace=True)


def swept() -> list[str]:
    """Return the keys that a multirun varies, in the order of its definition; [] in a single run.

    Works only within a job of the multirun.
    """
    config = HydraConfig.get()
    if config.mode != RunMode.MULTIRUN:
        return []
    file = Path(config.sweep.dir) / "multirun.yaml"
    if not file.is_file():  # composed for one job of a multirun, not by a multirun
        return []
    whole = OmegaConf.load(file).hydra
    typed = OverridesParser.create().parse_overrides(list(whole.overrides.task))
    keys = [str(key) for key in whole.sweeper.get("params") or ()]
    keys += [override.get_key_element() for override in typed if override.is_sweep_override()]
    return list(dict.fromkeys(keys))


def varied(config: DictConfig) -> dict[str, Any]:
    """Return the values in this job of the keys that a multirun varies."""
    choices = HydraConfig.get().runtime.choices
    return {
        key: choices[key] if key in choices else OmegaConf.select(config, key) for key in swept()
    }


def is_first_of_its_vehicle() -> bool:
    """Return whether no earlier job of a multirun has the same vehicle."""
    keys = swept()
    vehicles = any(key.partition(".")[0] in OF_THE_VEHICLE for key in keys)
    return not keys or vehicles or HydraConfig.get().job.num == 0


def _changed(*known: str) -> str:
    """Return the name of a run: what a multirun varies, or else what the command line sets.

    The keys `known` are left out, as the path shows them anyway.
    """
    config = HydraConfig.get()
    varied = swept()
    settings = dict(_split(override) for override in config.overrides.task)
    return _joined(
        _word(key, value, key in config.runtime.choices)
        for key, value in settings.items()
        if key not in known and (key in varied if config.mode == RunMode.MULTIRUN else True)
    )


def _swept_by(_root_: DictConfig) -> str:
    """Return the name of a multirun: the settings of all its runs, and the keys that vary.

    Hydra copies the cache of resolvers to each job of a multirun, so that all use the same folder.
    """
    cache = OmegaConf.get_cache(_root_)["swept_by"]
    if "hydra" not in _root_:
        return ""
    if "name" not in cache:
        config = _root_.hydra
        words = []
        for override in OverridesParser.create().parse_overrides(list(config.overrides.task)):
            key, value = _split(override.input_line or "")
            varies = override.is_sweep_override()
            words.append(_word(key, "" if varies else value, key in config.runtime.choices))
        cache["name"] = _joined(words)
    return str(cache["name"])


def _unless_healthy(usual: float, _root_: DictConfig) -> float | None:
    """Return `usual`, or None where a folder of healthy trips shows a better value."""
    return None if OmegaConf.select(_root_, "healthy") is not None else usual


def _split(override: str) -> tuple[str, str]:
    """Return key and value of an override, without Hydra's marks for additions."""
    key, _, value = override.partition("=")
    return key.lstrip("+~"), value


def _word(key: str, value: str, is_choice: bool) -> str:
    """Return "svr" for model=svr, "snr_db_40" for data.snr_db=40, "" for an unnamed key."""
    if key in UNNAMED or key.startswith("hydra"):
        return ""
    last = value.rstrip("/").rpartition("/")[2]
    return last if is_choice and last else f"{key.rpartition('.')[2]}_{last}"


def _joined(words: Iterable[str]) -> str:
    """Return words joined as the end of a folder name that needs no quotes in a shell."""
    bare = (re.sub(r"[\[\](){}'\"]", "", word) for word in words)
    plain = (re.sub(r"[^\w.+-]+", "-", word).strip("-_") for word in bare)
    return "".join(f"_{word}" for word in plain if word)[:MAX_CHARACTERS]
