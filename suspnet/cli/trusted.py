"""Limits on configurations: kinds and settings of suspnet, and a few of Hydra's.

A configuration may come from someone else (`--config-dir`), so nothing in it is trusted. Hydra
builds callbacks, launcher and sweeper and sets up logging before it calls a program's function;
`CheckedLoader` therefore checks each configuration as soon as it is composed.
"""

from __future__ import annotations

import functools
import re
from importlib import resources
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from omegaconf.grammar_parser import parse

from suspnet.cli.config_files import CONFIGS, as_written, walk
from suspnet.cli.kinds import KINDS, check_kind, new_name
from suspnet.ground.ledger import HYDRA
from suspnet.ground.settings import check_choice

OWN_FOLDER = "suspnet.cli.folders.OwnFolder"
CALLBACKS = (
    OWN_FOLDER,
    "suspnet.cli.folders.WorstExitCode",
    "suspnet.runs.sweeps.Ablation",
    "suspnet.runs.sweeps.Comparison",
    "suspnet.runs.sweeps.Jobs",
    "suspnet.runs.sweeps.Readings",
    "suspnet.runs.sweeps.Sensitivity",
    "suspnet.runs.sweeps.Table5",
    "suspnet.runs.sweeps.Table6",
)
"""Callbacks that a configuration may name below `hydra.callbacks`."""
SWEEPERS = ("hydra._internal.core_plugins.basic_sweeper.BasicSweeper",)
LAUNCHERS = (
    "hydra._internal.core_plugins.basic_launcher.BasicLauncher",
    "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher",
    "hydra_plugins.hydra_submitit_launcher.submitit_launcher.LocalLauncher",
    "hydra_plugins.hydra_submitit_launcher.submitit_launcher.SlurmLauncher",
)
SLURM_WORDS = (
    *("partition", "qos", "comment", "constraint", "exclude", "gres"),
    *("mem_per_gpu", "mem_per_cpu", "account"),
)
"""Text settings of the Slurm launcher; they become lines of a shell script."""
RESOLVERS = ("changed", "described", "hydra", "now", "swept_by", "unless_healthy")
"""Resolvers that a configuration may use, those of the shipped ones; others could hide a value."""
LOGGING = {
    "job_logging": ("default", "disabled", "none", "stdout"),
    "hydra_logging": ("default", "disabled", "hydra_debug", "none"),
}
"""Options of Hydra's logging groups that may be chosen; a free block could call any function by
`"()"` or a handler class."""
PLAIN_WORD = re.compile(r"[\w.,:=/@+-]*", re.ASCII)
FILE_NAME = re.compile(r"\.?\w[\w.-]*", re.ASCII)
MAX_VALUES, MAX_DEPTH = 5_000, 50
"""Largest number of values and depth of a resolved configuration; beyond these its
interpolations are taken to be endless. A shipped configuration has fewer than 500 values and
depth 10."""
SPECIAL = re.compile(r"_\w*_|\(\)", re.ASCII)
"""Keys that make Hydra or Python's logging call something."""


def check_configuration(config: DictConfig) -> None:
    """Raise ValueError unless a configuration is trusted, as written and as resolved.

    The message names the key. A value that cannot be resolved yet was checked as written.
    """
    written = as_written(config)
    hydra = written.pop("hydra", None)
    _check_values(written, "")
    if hydra is not None:
        _check_hydra(hydra)
    _check_resolved(config)


def _check_values(value: Any, path: str) -> None:
    """Check keys, targets and resolvers at and below a value as written."""
    for key, name, one in walk(value, path):
        _check_key(key, name, one)
        if isinstance(one, str):
            _check_resolvers(name, one)


def _check_key(key: str, name: str, value: Any) -> None:
    """Raise ValueError unless a key is plain: special ones make Hydra call or import something."""
    if key in ("_target_", "_convert_"):
        place = name.split(".")[-2] if "." in name else ""
        way = new_name(place, value) if key == "_target_" else "delete this line"
        raise ValueError(f"`{name}` is not allowed, and {value!r} is not trusted: {way}")
    if SPECIAL.fullmatch(key):
        raise ValueError(f"`{name}` is not allowed in a configuration of suspnet")


def _check_resolvers(name: str, text: str) -> None:
    for resolver in _resolvers(text):
        if resolver not in RESOLVERS:
            raise ValueError(
                f"`{name}` uses the resolver {resolver!r}; only {', '.join(RESOLVERS)} are allowed"
            )


def _resolvers(text: str) -> list[str]:
    """Return the names of the resolvers that a text calls, as OmegaConf parses it."""
    if "${" not in text:
        return []
    stack: list[Any] = [parse(text)]
    found = []
    while stack:  # each node of the tree is taken off once
        node = stack.pop()
        if type(node).__name__ == "ResolverNameContext":
            found.append(str(node.getText()))
        children = getattr(node, "getChildren", tuple)  # terminal nodes have no children
        stack.extend(children())
    return found


def _check_resolved(config: DictConfig) -> None:
    """Check keys and targets after interpolation, except in Hydra's own block."""
    stack: list[tuple[str, Any, int]] = [("", config, 0)]
    n_values = 0
    while stack:  # ends: at most MAX_VALUES values are taken off
        path, node, depth = stack.pop()
        n_values += 1
        if n_values > MAX_VALUES or depth > MAX_DEPTH:
            raise ValueError(f"`{path[:100]}` refers to itself, or to too many other values")
        if isinstance(node, DictConfig) and not node._is_none():
            keys: Any = node.keys()
        elif isinstance(node, ListConfig) and not node._is_none():
            keys = range(len(node))
        else:
            continue
        for key in keys:
            if not path and key == "hydra":
                continue
            try:
                value = node[key]
            except OmegaConfBaseException:
                continue
            name = f"{path}.{key}" if path else str(key)
            _check_key(str(key), name, value)
            if not path and key in KINDS and isinstance(value, DictConfig):
                if "kind" in value or key != "data":  # evaluate.py has `data` of no kind
                    check_kind(key, value)
            stack.append((name, value, depth + 1))


def _check_hydra(hydra: dict[str, Any]) -> None:
    """Check Hydra's own block: as shipped except for folders, numbers, texts and swept keys."""
    rest = dict(hydra)
    _check_callbacks(rest.pop("callbacks", None) or {})
    _check_sweeper(rest.pop("sweeper", None))
    _check_launcher(rest.pop("launcher", None))
    for group in LOGGING:
        _check_logging(group, rest.pop(group, None))
    _check_values(rest, "hydra")
    job = rest.get("job") or {}
    for key in ("env_set", "env_copy"):
        if job.get(key):
            raise ValueError(f"`hydra.job.{key}` cannot be set; set the variables in your shell")
    if not isinstance(rest.get("verbose", False), bool | str | list):
        raise ValueError(f"`hydra.verbose` must be true, false or names, got {rest['verbose']!r}")
    name = job.get("name", "job")
    if not isinstance(name, str) or not FILE_NAME.fullmatch(name):
        raise ValueError(f"`hydra.job.name` must be a plain name, got {name!r}")
    if rest.get("output_subdir") not in (None, HYDRA):
        raise ValueError(
            f"`hydra.output_subdir` must be .hydra or null, got {rest['output_subdir']!r}"
        )


def _check_callbacks(callbacks: Any) -> None:
    """Raise ValueError unless all callbacks are ours and include the one that guards folders."""
    folders = _block("hydra.callbacks", callbacks).get("folders")
    if not isinstance(folders, dict) or folders.get("_target_") != OWN_FOLDER:
        raise ValueError(f"`hydra.callbacks.folders` must be as shipped, got {folders!r}")
    for name, one in _block("hydra.callbacks", callbacks).items():
        if one is None:
            continue
        arguments = _block(f"hydra.callbacks.{name}", one)
        check_choice(f"hydra.callbacks.{name}._target_", arguments.pop("_target_", None), CALLBACKS)
        for key, value in arguments.items():
            _check_plain(f"hydra.callbacks.{name}.{key}", key, value)


def _check_sweeper(sweeper: Any) -> None:
    """Raise ValueError unless the sweeper is Hydra's basic one and sweeps keys of ours."""
    arguments = _block("hydra.sweeper", sweeper)
    check_choice("hydra.sweeper._target_", arguments.pop("_target_", None), SWEEPERS)
    for key, value in _block("hydra.sweeper.params", arguments.pop("params", None) or {}).items():
        if str(key).lstrip("+~").startswith("hydra"):
            raise ValueError(f"`hydra.sweeper.params.{key}`: Hydra's own keys cannot be swept")
        _check_plain(f"hydra.sweeper.params.{key}", str(key), value)
    for key, value in arguments.items():
        _check_number(f"hydra.sweeper.{key}", value)


def _check_launcher(launcher: Any) -> None:
    """Raise ValueError unless only numbers and Slurm texts of a known launcher are changed."""
    arguments = _block("hydra.launcher", launcher)
    target = arguments.pop("_target_", None)
    check_choice("hydra.launcher._target_", target, LAUNCHERS)
    shipped = _shipped_launcher(target)
    for key, value in arguments.items():
        name = f"hydra.launcher.{key}"
        if key in shipped and shipped[key] == value:
            continue
        if key in SLURM_WORDS and isinstance(value, str):
            _check_resolvers(name, value)
            if not PLAIN_WORD.fullmatch(value):
                raise ValueError(f"`{name}` must be a plain word, got {value!r}")
        else:
            _check_number(name, value)


def _shipped_launcher(target: str) -> dict[str, Any]:
    store = ConfigStore.instance()
    for file in store.list("hydra/launcher"):
        content = OmegaConf.to_container(store.load(f"hydra/launcher/{file}").node)
        if isinstance(content, dict) and content.get("_target_") == target:
            return {str(key): value for key, value in content.items()}
    return {}


def _check_logging(group: str, content: Any) -> None:
    """Raise ValueError unless a logging block is one that Hydra ships, with our format."""
    if content is not None and content not in _shipped_logging(group):
        raise ValueError(
            f"`hydra.{group}` must be as shipped; choose one by hydra/{group}="
            f"{'|'.join(LOGGING[group])}, and a level by hydra.verbose"
        )


@functools.cache
def _shipped_logging(group: str) -> list[Any]:
    """Return the options of a logging group, with and without our programs' changes."""
    folder = resources.files("hydra") / "conf" / "hydra" / group
    ours = OmegaConf.load(Path(CONFIGS) / "base" / "program.yaml").hydra.get(group) or {}
    options = [
        OmegaConf.create((folder / f"{name}.yaml").read_text(encoding="utf-8"))
        for name in LOGGING[group]
    ]
    merged = [OmegaConf.merge(option, ours) for option in options]
    return [OmegaConf.to_container(option) for option in (*options, *merged)]


def _block(name: str, value: Any) -> dict[str, Any]:
    """Return a copy of a mapping; raise ValueError for anything else, such as an interpolation."""
    if not isinstance(value, dict):
        raise ValueError(f"`{name}` must be as shipped, got {value!r}")
    return dict(value)


def _check_plain(name: str, key: str, value: Any) -> None:
    """Raise ValueError unless a value is a text, a number or null below a plain key."""
    if SPECIAL.fullmatch(key) or isinstance(value, dict | list):
        raise ValueError(f"`{name}` is not allowed in a configuration of suspnet")
    if isinstance(value, str):
        _check_resolvers(name, value)


def _check_number(name: str, value: Any) -> None:
    if value is not None and not isinstance(value, int | float):
        raise ValueError(f"`{name}` must be as shipped, or a number; got {value!r}")
