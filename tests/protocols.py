"""The protocols as shipped, and one that sees the least."""

from dataclasses import replace
from functools import cache

from hydra import compose, initialize_config_dir

from suspnet.cli.kinds import build
from suspnet.cli.program import CONFIGS

OWN_CURVE = {
    "primary": {"outputs": ["k_p", "c_p"], "responses": ["G_p"], "peaks": ["primary_largest"]},
    "secondary": {"outputs": ["k_s", "c_s"], "responses": ["G_s"], "peaks": ["secondary"]},
}
"""Groups that see the largest peak of their own curve alone, protocol "own_curve" of tests."""


def shipped_protocol(name, **changes):
    """Return configs/protocol/`name`.yaml, or "own_curve", with changes."""
    return replace(_shipped(name), **changes)


@cache
def _shipped(name):
    if name == "own_curve":
        shipped = _shipped("multi_location")
        return replace(shipped, name=name, groups=OWN_CURVE, log_ratios=False)
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        return build(compose("train", overrides=[f"protocol={name}"]), "protocol")
