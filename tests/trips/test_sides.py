"""Trips with sensors left and right: the mean of a pair, wrong sensors, parts that are not read."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from roll_reference import CHANNELS, sided_responses, track_amplitudes
from trip_fixtures import MINUTES, OUTPUTS, SPEED, recalled_trip

from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import kind_is
from suspnet.ground.records import ERROR, NO_ESTIMATE, OK
from suspnet.trains.identification import from_recording
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.trips.trip import evaluate_trip

RATE_HZ, TOP_HZ = 250.0, 15.0


@cache
def pairs(d):
    """Return the signals of the vehicle written out corner by corner."""
    rng = np.random.default_rng(4)
    n = int(60 * MINUTES * RATE_HZ)
    frequencies_hz = np.arange(1, int(TOP_HZ * 60 * MINUTES)) / (60 * MINUTES)
    track = rng.normal(size=(2, len(frequencies_hz))) + 1j * rng.normal(
        size=(2, len(frequencies_hz))
    )
    track *= track_amplitudes(frequencies_hz, SPEED)
    spectra = np.zeros((3, 2, n // 2 + 1), dtype=complex)
    spectra[..., 1 : len(frequencies_hz) + 1] = np.einsum(
        "psif,if->psf", sided_responses(frequencies_hz, SPEED, d), track
    )
    signals = np.fft.irfft(spectra, n)
    signals *= 5 / signals[0].std()
    return signals + 0.02 * signals.std(axis=2, keepdims=True) * rng.normal(size=signals.shape)


def write_pairs(folder, d, change=None):
    """Write a trip of pairs of sensors; `change` alters a sensor."""
    channels = {}
    for name, pair in zip(CHANNELS, pairs(d), strict=True):
        columns = dict(zip(("left", "right"), pair, strict=True))
        for side, values in (change or {}).get(name, {}).items():
            columns[side] = values(columns[side])
        pq.write_table(pa.table(columns), folder / f"{name}.parquet", use_dictionary=False)
        source = {"file": f"{name}.parquet", "unit": "m/s2", "rate_hz": RATE_HZ}
        channels[name] = [source | {"column": side} for side in columns]
    content = {"format": "suspnet-trip-1", "vehicle": "am96", "suspension": "car 7"}
    content |= {"mileage_km": 1.0, "speed": SPEED, "channels": channels}
    path = folder / "trip.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory, model):
    return evaluate_trip(
        write_pairs(tmp_path_factory.mktemp("plain"), (0,) * 4), [model], TripSettings()
    )


# reference


@pytest.mark.slow
def test_average_of_a_pair_has_no_roll(plain, model):
    """Cross level is half of the track's motion at the sensors, and the estimate is healthy."""
    assert (plain.status, plain.reason) == (OK, "")
    assert kind_is(plain.quality.warnings, "sides-not-compared")  # though sensors could show it
    for name in OUTPUTS:
        rms = model.training["test_rms_percent"][name]
        assert abs(100 * (plain.estimates[name] - 1)) < 4 * rms


# failure


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"body": {"right": lambda v: -v}},
            "body: its left and its right sensor move against each other at low frequency",
        ),
        ({"bogie": {"left": lambda v: 9.80665 * v}}, "bogie: its left sensor shows 9.8"),
    ],
)
def test_wrong_sign_or_unit_of_one_sensor_is_named(tmp_path, model, change, reason):
    path = write_pairs(tmp_path, (0,) * 4, change)
    result = evaluate_trip(path, [model], TripSettings())
    assert result.status == ERROR
    assert result.reason.startswith(reason)
    assert "manifest" in result.reason


@pytest.mark.parametrize("side", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_sensors_swapped_on_one_side_are_named(tmp_path, model, side):
    name, (box, frame, _) = ("left", "right")[side], pairs((0,) * 4)
    change = {"axle_box": {name: lambda _: frame[side]}, "bogie": {name: lambda _: box[side]}}
    result = evaluate_trip(write_pairs(tmp_path, (0,) * 4, change), [model], TripSettings())
    assert result.status == ERROR
    assert result.reason.startswith(
        f"axle_box and bogie: their {name} sensors look swapped: with them"
    )


@pytest.mark.parametrize("error", [TripError, NoEstimateError])
def test_a_trip_whose_parts_are_not_read_has_no_estimate(manifests, model, monkeypatch, error):
    equal = recalled_trip(manifests[0], [model], TripSettings())

    def not_read(*_):
        raise error("why")

    monkeypatch.setattr(from_recording, "estimate_parts", not_read)
    of_parts = BogieModel(SimpleNamespace(law=None), model.generator, model.settings)
    result = evaluate_trip(manifests[0], [of_parts], TripSettings())
    # the quality of the recording is told, unless a sensor is wrong
    assert result.quality.n_averages == equal.quality.n_averages * (error is NoEstimateError)
    status = ERROR if error is TripError else NO_ESTIMATE
    assert (result.status, result.reason, result.estimates) == (status, "why", {})
    with pytest.raises(error, match="why"):
        of_parts.estimate(manifests[0])
