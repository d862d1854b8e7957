"""Switches and numbers of a configuration: read alike for all keys of all programs."""

import math
from pathlib import Path

import pytest
import value_fuzz
from cli_runner import SMALL, run_main, run_program
from omegaconf import OmegaConf

from suspnet.cli import simulate, train
from suspnet.cli.config_files import SWITCHES, check_values
from suspnet.cli.program import CONFIGS


def leaves(node, key=""):
    """Yield the key and value of each value at or below a node."""
    if isinstance(node, dict):
        for name, value in node.items():
            yield from leaves(value, name)
    elif isinstance(node, list):
        for value in node:
            yield from leaves(value)
    else:
        yield key, node


def test_switches_are_the_keys_that_are_on_or_off_as_shipped():
    shipped = [
        leaf
        for file in Path(CONFIGS).rglob("*.yaml")
        for leaf in leaves(OmegaConf.to_container(OmegaConf.load(file), resolve=False))
    ]
    assert {key for key, value in shipped if isinstance(value, bool)} == SWITCHES
    other = [value for key, value in shipped if key in SWITCHES and not isinstance(value, bool)]
    assert all(str(value).startswith("${") for value in other)


def test_switches_are_booleans_at_any_depth():
    config = {"refine": True, "protocol": {"mass_known": False}, "study": {"progress": "${refine}"}}
    check_values(OmegaConf.create(config))


@pytest.mark.parametrize("value", ["no", 1, None, [True]])
def test_a_switch_that_is_neither_on_nor_off_is_refused(value):
    config = OmegaConf.create({"monitor": {"trips": {"check_channels": value}}})
    with pytest.raises(TypeError, match=r"`monitor\.trips\.check_channels` must be True or False"):
        check_values(config)


@pytest.mark.parametrize("value", [math.nan, -math.inf, 1e30, 10**30])
def test_numbers_that_no_setting_can_have_are_refused_at_any_depth(value):
    config = OmegaConf.create({"fleet": {"sensors": {"bogie": [{"snr_db": value}]}}})
    with pytest.raises(ValueError, match=r"`fleet\.sensors\.bogie\.0\.snr_db` must be"):
        check_values(config)


def test_no_means_no(tmp_path):
    off = ["refine=false", "figures=false", "protocol.mass_known=false", "model=linear"]
    metrics = run_main(train, tmp_path, *[one for one in SMALL if "figures" not in one], *off)
    assert metrics["model"] == "linear"
    assert metrics["mass_known"] is False
    assert not (tmp_path / "figures").exists()


@pytest.mark.parametrize(
    ("module", "overrides", "message"),
    [
        (train, ["figures=perhaps"], "`figures` must be True or False"),
        (train, ["data.n_train=nan"], "`data.n_train` must be a finite number, got nan"),
        (simulate, ["fleet.sensors.bogie.snr_db=nan"], "`fleet.sensors.bogie.snr_db` must be"),
        (simulate, ["fleet.minutes=1e300"], "`fleet.minutes` must be at most"),
        (simulate, ["workers=1e12"], "`workers` must be a whole number"),
    ],
)
def test_wrong_value_gets_one_line_before_anything_is_written(module, overrides, message, tmp_path):
    more = [] if module is train else [f"out={tmp_path / 'trips'}"]
    words = run_program(module, tmp_path / "run", *overrides, *more)
    assert words.startswith("error: ")
    assert message in words
    assert "\n" not in words
    assert not (tmp_path / "trips").exists()
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize(
    ("program", "n_values"), [pytest.param("train", 4, marks=pytest.mark.slow), ("simulate", 12)]
)
def test_some_wrong_values_end_in_one_line(program, n_values, tmp_path):
    counts, failures = value_fuzz.fuzz(program, n_values, 5, tmp_path)
    assert failures == []
    assert counts["refused"] > 0
