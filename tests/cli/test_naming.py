"""Run folders are named by what differs."""

import re

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig

from suspnet.cli.folders import MAX_BYTES
from suspnet.cli.program import CONFIGS


def folder(program, *overrides, key="run"):
    """Return the folder of a run or multirun without its time."""
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(program, overrides=list(overrides), return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    name = config.hydra[key].dir
    found = re.fullmatch(r"outputs/(\w+)/\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d(.*)", name)
    assert found, name
    return found[1], found[2]


@pytest.mark.representatives(4)
@pytest.mark.parametrize(
    ("program", "overrides", "expected"),
    [
        ("train", [], ("train", "_primary_msvr")),
        ("train", ["model=svr", "group=secondary"], ("train", "_secondary_svr")),
        (
            "train",
            ["model.C=1e3", "vehicle=ice3", "progress=false", "data.rates_hz=[1,2]", "data=trips"],
            ("train", "_primary_msvr_C_1e3_ice3_rates_hz_1-2_trips"),
        ),
        (
            "train",
            ["experiment=trips", "speed_m_per_s=50"],
            ("trips", "_all_msvr_speed_m_per_s_50"),
        ),
        ("evaluate", ["run=outputs/train/x", "trips=trips/worn"], ("evaluate", "_trips_worn")),
        ("evaluate", ["run=x", "seed=3"], ("evaluate", "_seed_3")),
        ("simulate", ["scenario=random", "out=here"], ("simulate", "_random")),
    ],
)
def test_run_is_named_by_what_the_command_line_sets(program, overrides, expected):
    assert folder(program, *overrides) == expected


def test_multirun_is_named_by_what_its_runs_share():
    assert folder("train", "experiment=table6", key="sweep") == ("table6", "")
    shared = ["experiment=table6", "protocol=paper", "data.n_train=300"]
    assert folder("train", *shared, key="sweep") == ("table6", "_paper_n_train_300")


def test_name_is_short_and_needs_no_quotes():
    job, name = folder("train", f"vehicle.name='a b/{'=,c ' * 50}'", "model.epsilon=1e-3")
    assert len(name) < 2 * MAX_BYTES
    assert re.fullmatch(r"[\w.+-]+", job + name)
