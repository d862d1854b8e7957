"""A small fleet on disk and models that read it, made once for all tests that ask for them."""

import shutil
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import yaml

from suspnet.data import TEST, Protocol
from suspnet.data.estimates import EstimateSettings
from suspnet.data.manifest import CHANNELS
from suspnet.data.scenarios import Scenario
from suspnet.data.simulation import Fleet, write_fleet
from suspnet.dynamics import Vehicle, VerticalVehicle
from suspnet.experiment import rms_percent
from suspnet.fitting import Problem, fit, predict_stream
from suspnet.learning import MSVR
from suspnet.tracking import RunLog

OUTPUTS = ("k_p", "c_p", "k_s", "c_s", "M_s")
RATES_HZ = (400.0, 250.0, 250.0)
SENSORS = {name: {"rate_hz": rate} for name, rate in zip(CHANNELS, RATES_HZ, strict=True)}
MINUTES = 5.0
SPEED = 70.0
GROUP = {
    "outputs": list(OUTPUTS[:4]),
    "responses": ["G_p", "G_s"],
    "peaks": ["secondary", "primary_lower", "primary_upper"],
}
AM96 = Vehicle(  # configs/vehicle/am96.yaml
    "am96",
    1725.0,
    6300.0,
    1.30e6,
    3.7e3,
    0.69e6,
    22.6e3,
    half_wheelbase_m=1.35,
    half_pivot_distance_m=9.5,
    bogie_gyration_m=0.8,
    body_gyration_m=7.8,
)


def trips_protocol(**changes):
    """Return configs/protocol/trips.yaml, with changes."""
    options = {"sampling": "sobol", "lower": 0.5, "upper": 1.6, "estimate_mass": True}
    options |= {"mass_lower": 0.8, "mass_upper": 1.3, "feature_set": "curve"}
    options["curve"] = {"n_components": 12}
    return Protocol("trips", {"all": GROUP}, **(options | changes))


@contextmanager
def no_log():
    """Stand in for a RunLog that nobody reads."""
    log = RunLog.__new__(RunLog)
    log.scalars = lambda *_: None
    yield log


@cache
def model_at(speed=SPEED, feature_set="curve", n_train=2000):
    """Return a model of the small fleet's vehicle, sensors and length of trips."""
    settings = EstimateSettings(
        n_train, 300, speed, minutes=MINUTES, rates_hz=RATES_HZ, cache_dir=None
    )
    task = trips_protocol(feature_set=feature_set).task("all")
    problem = Problem(VerticalVehicle(AM96, speed_m_per_s=speed), task, settings, progress=False)
    with no_log() as log:
        model = fit(problem, MSVR(1e4, 8.0, 1e-3, "nystroem", 512), log)
    errors = {"test_rms_percent": rms_percent(task, predict_stream(problem, model, TEST))}
    return replace(model, training=model.training | errors)


def write_trips(folder, n_trips=1, seed=0, speed=SPEED, scenario=None, **changes):
    """Write trips of a healthy vehicle, pay-load apart; return the manifests."""
    options = {"n_trips": n_trips, "minutes": MINUTES, "last_mileage_km": 1000.0 * n_trips}
    fleet = Fleet(**(options | {"speed_m_per_s": speed, "sensors": SENSORS} | changes))
    scenario = Scenario("healthy") if scenario is None else scenario
    return write_fleet(folder, fleet, scenario, VerticalVehicle(AM96, speed_m_per_s=speed), seed=seed)
