"""A small fleet on disk and models that read it, made once for all tests that ask for them."""

import hashlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from built_once import built_once
from protocols import shipped_protocol
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import TEST, Problem
from suspnet.estimation.checkpoint import load_model, save_model
from suspnet.learning import MSVR
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated, predict_stream
from suspnet.runs.scores import rms_percent
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.simulation.fleet import Scenario
from suspnet.trains.simulation.writing import Fleet, Simulation, write_fleet
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import VerticalVehicle

OUTPUTS = ("k_p", "c_p", "k_s", "c_s", "M_s")
RATES_HZ = (400.0, 250.0, 250.0)
SENSORS = {name: {"rate_hz": rate} for name, rate in zip(CHANNELS, RATES_HZ, strict=True)}
MINUTES = 5.0
SPEED = 70.0
N_TRIPS = 6
N_CALIBRATE = 200
BAND = {"high_hz": 9.9, "body_high_hz": 9.0}
"""Narrower than usual, which trains a model in a third of the time; [Hz]."""


class NoLog:
    """A log that keeps nothing."""

    def scalars(self, *_):
        pass


@cache
def model_at(
    speed=SPEED, n_train=1000, snr_db=34.0, n_calibrate=N_CALIBRATE, direction="forward", **changes
):
    """Return a model for the small fleet's vehicle, sensors and length of trips."""
    generator = VerticalVehicle(AM96, speed_m_per_s=speed, direction=direction)
    given = repr((speed, n_train, snr_db, n_calibrate, direction, sorted(changes.items())))
    name = f"model_{hashlib.sha256(given.encode()).hexdigest()[:16]}"

    def build(folder):
        save_model(folder, _trained(generator, n_train, snr_db, n_calibrate, changes))

    return load_model(built_once(name, build))


def slow_model():
    """Return a model of 50 m/s."""
    return model_at(50.0, n_train=500, n_calibrate=100)


def _trained(generator, n_train, snr_db, n_calibrate, changes):
    task, speed = shipped_protocol("trips", **changes).task("all"), generator.speed_m_per_s
    options = BAND | {"snr_db": snr_db, "minutes": MINUTES, "rates_hz": RATES_HZ}
    settings = EstimateSettings(n_train, 300, n_calibrate, speed, **options)
    problem = Problem(generator, task, settings, progress=False)
    model = calibrated(problem, fit(problem, MSVR(1e4, 8.0, 1e-3, "nystroem", 512), NoLog()))
    errors = {"test_rms_percent": rms_percent(task, predict_stream(problem, model, TEST))}
    return replace(model, training=model.training | errors)


def write_trips(folder, n_trips=1, scenario=None, seed=0, speed=SPEED, **changes):
    """Write trips over 1000 km each and return their manifests."""
    options = {"n_trips": n_trips, "minutes": MINUTES, "last_mileage_km": 1000.0 * n_trips}
    fleet = Fleet(**(options | {"speed_m_per_s": speed, "sensors": SENSORS} | changes))
    generator = VerticalVehicle(AM96, speed_m_per_s=speed)
    return write_fleet(
        folder, Simulation(fleet, scenario or Scenario("healthy"), generator, seed=seed)
    )


RECALLED = {}
"""Of each content of a manifest, models and settings: the result, and the models, to keep them."""


def recalled_trip(trip, models, settings):
    """Do as `evaluate_trip` does, but read a trip, under whatever name, once in this process."""
    file = trip if isinstance(trip, ManifestFile) else ManifestFile(trip)
    try:
        content = repr(replace(file.trip, path=Path(), name=""))
    except TripError:
        return evaluate_trip(file, models, settings)
    key = content, tuple(map(id, models)), settings
    if key not in RECALLED:
        RECALLED[key] = evaluate_trip(file, models, settings), models
    return replace(RECALLED[key][0], trip=file.path.stem, manifest=str(file.path))


def small_fleet():
    """Return the manifests of six trips, each of another vehicle, written once for all tests."""

    def build(folder):
        write_trips(folder, N_TRIPS, Scenario("random", spread=0.3), seed=1)

    return sorted(built_once("small_fleet", build).glob("*.yaml"))


def signal(manifest, name):
    """Return a channel of a simulated trip, or its speed."""
    return pq.read_table(manifest.with_suffix("") / f"{name}.parquet").column(0).to_numpy()


def changed(manifest, folder, name="changed", signals=None, channels=None, **changes):
    """Write a copy of a trip with other signals or another manifest; return its manifest.

    A None takes the entry away. The files that stay are those of the original.
    """
    content = yaml.safe_load(manifest.read_text()) | changes
    sources = content["channels"] | {"speed": content["speed"]}
    for key, source in sources.items():
        if isinstance(source, dict):
            source["file"] = str(manifest.parent / source["file"])
            source |= (channels or {}).get(key, {})
            sources[key] = {k: value for k, value in source.items() if value is not None}
    for key, values in (signals or {}).items():
        file = folder / name / f"{key}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        columns = values if isinstance(values, dict) else {sources[key]["column"]: values}
        pq.write_table(pa.table(columns), file, use_dictionary=False)  # many times faster
        sources[key]["file"] = str(file)
    content |= {"speed": sources.pop("speed"), "channels": sources}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return path
