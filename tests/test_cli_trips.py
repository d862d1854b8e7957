"""Fleets simulated, models trained and trips read from the command line, at small size."""

import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import open_dict

import evaluate
import train
from suspnet import simulate

ROOT = Path(__file__).parents[1]


def run_program(module, folder, *overrides):
    """Compose and run a program in this process; return its exit code."""
    name = module.__name__.rpartition(".")[2]
    with initialize_config_dir(version_base="1.3", config_dir=str(ROOT / "configs")):
        output = f"hydra.runtime.output_dir={folder}"
        config = compose(name, overrides=[*overrides, output], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        module.main(config)
    except SystemExit as ended:
        return ended.code
    return 0


QUICK = ["progress=false"]


@pytest.mark.parametrize(
    "vehicle",
    [
        "am96",
        "sedan",
        "truck",
        "ice3",
        "china_star",
        "manchester",
        "chinese_coach",
        "shinkansen_s300",
    ],
)
def test_v(tmp_path, vehicle):
    import time

    sens = [
        f"fleet.sensors.{n}.rate_hz={r}"
        for n, r in zip(("axle_box", "bogie", "body"), (400, 250, 250))
    ]
    snr = (
        [f"fleet.sensors.{n}.snr_db=60" for n in ("axle_box", "bogie", "body")]
        if vehicle in ("sedan", "truck")
        else []
    )
    d = ["data.snr_db=60"] if snr else []
    t = [time.time()]
    assert (
        run_program(
            train,
            tmp_path / "run",
            "experiment=trips",
            f"vehicle={vehicle}",
            "data.n_train=1000",
            "data.n_test=200",
            "data.minutes=6",
            "data.rates_hz=[400,250,250]",
            "data.cache_dir=null",
            "model.feature_map=nystroem",
            "model.n_components=512",
            "progress=false",
            "threads=1",
            *d,
        )
        == 0
    )
    t.append(time.time())
    assert (
        run_program(
            simulate,
            tmp_path / "sim",
            f"vehicle={vehicle}",
            f"out={tmp_path / 'trips'}",
            "fleet.n_trips=2",
            "fleet.minutes=6",
            "workers=1",
            "progress=false",
            *sens,
            *snr,
        )
        == 0
    )
    t.append(time.time())
    assert (
        run_program(
            evaluate,
            tmp_path / "eval",
            f"run={tmp_path / 'run'}",
            f"trips={tmp_path / 'trips'}",
            "monitor.workers=1",
            "progress=false",
        )
        == 0
    )
    t.append(time.time())
    import numpy as np

    print(vehicle, np.diff(t).round(2))
    m = json.loads((tmp_path / "run/model.json").read_text())["training"]["test_rms_percent"]
    e = json.loads((tmp_path / "eval/metrics.json").read_text())["rms_error_percent"]
    print({k: (round(m[k], 2), round(e[k], 2)) for k in e})
