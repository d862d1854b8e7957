"""The protocols as shipped."""

from dataclasses import replace
from functools import cache

from hydra import compose, initialize_config_dir

from suspnet.cli.kinds import build
from suspnet.cli.program import CONFIGS


def shipped_protocol(name, **changes):
    """Return configs/protocol/`name`.yaml, with changes."""
    return replace(_shipped(name), **changes)


@cache
def _shipped(name):
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        return build(compose("train", overrides=[f"protocol={name}"]), "protocol")
