"""Trips of the three-dimensional train on disk: the same as suspnet's where they can be."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from rich_spectra import expected_estimates
from rich_train import RichTrain
from rich_train_trips import write_train_trips
from scipy.signal import csd
from vehicles import AM96

from suspnet.curves.cross_spectra import PAIRS
from suspnet.curves.estimates import EstimateSettings
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.simulation import Fleet, Scenario, Simulation, write_fleet
from suspnet.vehicle import PARAMETERS, VerticalVehicle

RATES = dict(zip(CHANNELS, (1000.0, 500.0, 500.0), strict=True))
SILENT = {name: {"rate_hz": rate, "snr_db": None} for name, rate in RATES.items()}
NOISY = {name: {"rate_hz": rate} for name, rate in RATES.items()}
WORN = np.array([0.8, 1.3, 1.2, 0.7, 1.1])


def fleet_of(n_trips=1, **changes):
    return Fleet(**({"n_trips": n_trips, "minutes": 0.2, "sensors": SILENT} | changes))


def columns(manifest, name):
    table = pq.read_table(manifest.with_suffix("") / f"{name}.parquet")
    return {column: table[column].to_numpy().astype(float) for column in table.column_names}


# reference


def test_trips_without_effects_are_those_of_suspnet(tmp_path):
    fleet, scenario = fleet_of(2, speed_m_per_s=55.0), Scenario("random", spread=0.4)
    ratios = scenario.ratios(fleet.mileage_km(), 5)
    found = write_train_trips(tmp_path / "rich", RichTrain(), ratios, fleet, 5, sides="left")
    expected = write_fleet(
        tmp_path / "plain",
        Simulation(fleet, scenario, VerticalVehicle(AM96, speed_m_per_s=55.0), seed=5),
    )
    for mine, theirs in zip(found, expected, strict=True):
        a, b = read_manifest(mine), read_manifest(theirs)
        assert (a.truth, a.mileage_km, a.start, a.vehicle) == (
            b.truth,
            b.mileage_km,
            b.start,
            b.vehicle,
        )
        for channel in CHANNELS:
            left, plain = columns(mine, channel)["left"], columns(theirs, channel)["acceleration"]
            # of straight lines between samples, as suspnet has them, (2 pi 30 / 1000)^2 / 12 = 3e-3
            np.testing.assert_allclose(left, plain, rtol=0, atol=3e-3 * np.abs(plain).max())


@pytest.mark.slow  # test_rich_train.py: expected estimates
def test_spectra_of_a_trip_are_the_expected_ones(tmp_path):
    train = RichTrain.scattered(3).at(60.0)
    fleet = fleet_of(minutes=6.0, speed_m_per_s=60.0, sensors=NOISY)
    (path,) = write_train_trips(tmp_path, train, [WORN], fleet, seed=1, sides="mean")
    settings = EstimateSettings(minutes=6.0, rates_hz=tuple(RATES.values())).bound(AM96)
    expected = expected_estimates(train, WORN[None], settings)
    signals = [columns(path, c)["mean"][:: 2 if c == "axle_box" else 1] for c in CHANNELS]
    # the axle box folds at 250 Hz: its noise above is seen twice
    f, found = csd(
        np.array(signals)[:, None], np.array(signals), 500.0, nperseg=10_000, detrend=False
    )
    bins = np.isin(np.round(f * 20), np.round(settings.frequencies_hz().numpy() * 20))
    for pair, (x, y) in enumerate(PAIRS):
        size = (expected.auto[0, x] * expected.auto[0, y]).sqrt().numpy()
        error = (found[x, y, bins] - expected.cross[0, pair].numpy()) / size
        if x > 0:
            assert np.sqrt(np.mean(np.abs(error) ** 2)) < 0.3  # 34 averages: 0.17
            assert abs(error.mean()) < 0.06
        response = found[x, y, bins] / expected.cross[0, pair].numpy()
        assert np.median(np.abs(response)) == pytest.approx(1, abs=0.1)


# property


def test_a_pair_has_a_list_of_sensors_for_each_channel(tmp_path):
    train, fleet = RichTrain.scattered(1), fleet_of(sensors=NOISY)
    (pair,) = write_train_trips(tmp_path / "pair", train, [WORN], fleet, 2)
    content = yaml.safe_load(pair.read_text())
    assert content["truth"] == dict(zip(PARAMETERS, WORN.tolist(), strict=True))
    for channel in CHANNELS:
        sensors = content["channels"][channel]
        assert [one["column"] for one in sensors] == ["left", "right"]
        assert {one["rate_hz"] for one in sensors} == {RATES[channel]}
        assert all((tmp_path / "pair" / one["file"]).is_file() for one in sensors)
        found = columns(pair, channel)
        assert abs(np.corrcoef(*found.values())[0, 1]) < 0.99
        assert len(found["left"]) == 12 * RATES[channel]
    for sides in ("mean", "left", "right"):
        (one,) = write_train_trips(tmp_path / sides, train, [WORN], fleet, 2, sides=sides)
        assert read_manifest(one).truth == content["truth"]
        for channel, source in read_manifest(one).channels.items():
            assert source.column == sides
            both = columns(pair, channel)
            expected = both.get(sides, (both["left"] + both["right"]) / 2)
            found = columns(one, channel)[sides]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(found).max())
