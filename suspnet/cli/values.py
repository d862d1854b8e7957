"""Switches and numbers of a configuration, read in one place for all keys of all programs."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from suspnet.ground.checks import check_number

SWITCHES = frozenset(
    {
        "check_channels",
        "distributed",
        "estimate_mass",
        "figures",
        "fit_intercept",
        "log_ratios",
        "mass_known",
        "once",
        "open_browser",
        "open_to_network",
        "progress",
        "refine",
        "short_waves",
        "tls",
    }
)
"""Keys, wherever they stand, that are either on or off."""
WORDS = {"yes": True, "on": True, "true": True, "no": False, "off": False, "false": False}
"""What a switch may be called; Hydra's command line knows true and false only."""


def read_values(config: DictConfig) -> None:
    """Make each switch of a configuration a boolean; check that each number is a finite one.

    Raises
    ------
    TypeError, ValueError
        If a switch is neither on nor off, or a number NaN, infinite or beyond `LARGEST` of
        ``suspnet.ground.checks``.
    """
    stack: list[tuple[str, Any]] = [("", config)]
    while stack:  # a configuration as written is a tree: each node is taken off once
        path, node = stack.pop()
        keys: Any = node.keys() if isinstance(node, DictConfig) else range(len(node))
        for key in keys if not node._is_none() and not node._is_interpolation() else ():
            if OmegaConf.is_interpolation(node, key) or OmegaConf.is_missing(node, key):
                continue
            name, value = f"{path}.{key}".lstrip("."), node[key]
            if key in SWITCHES:
                node[key] = _switch(name, value)
            elif isinstance(value, DictConfig | ListConfig):
                stack.append((name, value))
            elif isinstance(value, int | float) and not isinstance(value, bool):
                check_number(name, value)


def _switch(name: str, value: Any) -> bool:
    """Return whether a switch is on."""
    if isinstance(value, bool):
        return value
    known = WORDS.get(value.lower()) if isinstance(value, str) else None
    if known is None:
        raise ValueError(f"`{name}` must be one of {', '.join(WORDS)}; got {value!r}")
    return known
