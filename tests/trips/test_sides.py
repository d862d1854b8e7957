"""Trips with sensors left and right: the same estimate, and which side is weaker, in words."""

from dataclasses import replace
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from roll_reference import CHANNELS, sided_responses, track_amplitudes
from scipy.stats import norm
from trip_fixtures import MINUTES, OUTPUTS, SPEED, recalled_trip
from trip_records import trip

from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import ERROR, NO_ESTIMATE, OK
from suspnet.trains.identification import from_recording, trip_flags
from suspnet.trains.identification.bogie_trips import UNEXPLAINED as UNEXPLAINED_PARTS
from suspnet.trains.identification.bogie_trips import UnexplainedError
from suspnet.trains.identification.trip_flags import (
    SIDE_COSTS,
    UNEXPLAINED,
    side_errors,
    spoken_sides,
)
from suspnet.trains.pages.report import sides_finding
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.spectra.side_difference import SideDifference
from suspnet.trains.trips.trip import evaluate_trip

RATE_HZ, TOP_HZ = 250.0, 15.0
WEAK = (-0.111, 0.0, 0.0, 0.0)


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
    assert (plain.status, plain.reason, plain.sides) == (OK, "", "")
    for name in OUTPUTS:
        rms = model.training["test_rms_percent"][name]
        assert abs(100 * (plain.estimates[name] - 1)) < 4 * rms


@pytest.fixture(scope="module")
def weak(tmp_path_factory):
    """The manifest of a trip whose left primary spring is weaker by a fifth."""
    return write_pairs(tmp_path_factory.mktemp("weak"), WEAK)


def test_weaker_side_is_told(weak, model):
    result = evaluate_trip(weak, [model], TripSettings())
    assert result.sides.startswith("primary spring: the left side is weaker (about ")
    assert float(result.sides.split("about ")[1].split(" ")[0]) == pytest.approx(20, abs=4)
    assert result.row(OUTPUTS)["sides"] == result.sides
    assert result.flags == ""
    assert "; " not in result.sides


def test_errors_of_unequal_sides_are_those_of_the_formula():
    d, deviations = (0.3, -0.2, 0.01, 0.0), (0.02, 0.01, 0.05, 0.01)
    sizes = (0.3**2 - 0.02**2, 0.2**2 - 0.01**2)
    wanted = [
        sum(cost * size for cost, size in zip(SIDE_COSTS[name], sizes, strict=False))
        for name in ("c_p", "M_s")
    ]
    np.testing.assert_allclose(
        side_errors(difference(d, deviations), ("c_p", "M_s")), wanted, rtol=1e-12
    )


def test_a_difference_of_the_sides_widens_the_intervals_or_is_a_flag(weak, model, monkeypatch):
    wide = model.estimate(weak, level=0.8)
    monkeypatch.setattr(trip_flags, "SIDE_COSTS", dict.fromkeys(OUTPUTS, (0.0,) * 4))
    monkeypatch.setattr(trip_flags, "LARGEST_MISFIT", 0.0)
    plain = model.estimate(weak, level=0.8)
    np.testing.assert_array_equal(wide.values, plain.values)
    errors = np.sqrt(wide.half_widths**2 - plain.half_widths**2)[0] / norm.ppf(0.9)
    known = [SIDE_COSTS[name][0] * WEAK[0] ** 2 for name in OUTPUTS]
    np.testing.assert_allclose(errors, known, rtol=0.5)
    assert wide.flags.reasons == ("",)
    (reason,) = plain.flags.reasons
    assert (reason.kind, reason.values["words"]) == ("both-sides-assumed-equal", UNEXPLAINED)


# failure


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"body": {"right": lambda v: -v}},
            "body: its left and its right sensor move against each other at low frequency",
        ),
        (
            {"bogie": {"left": lambda v: 9.80665 * v}},
            "bogie: its left sensor shows 9.8",
        ),
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


@pytest.mark.parametrize("error", [TripError, NoEstimateError, UnexplainedError])
def test_what_becomes_of_a_trip_whose_parts_are_not_read(manifests, model, monkeypatch, error):
    equal = recalled_trip(manifests[0], [model], TripSettings())

    def not_read(*_):
        raise error("why")

    monkeypatch.setattr(from_recording, "estimate_parts", not_read)
    with_bogie = replace(model, bogie=object())
    result = evaluate_trip(manifests[0], [with_bogie], TripSettings())
    assert result.quality.n_averages == equal.quality.n_averages * (error is not TripError)
    if error is TripError:  # the sensors are wrong: there is nothing to fall back on
        assert (result.status, result.reason, result.estimates) == (ERROR, "why", {})
        with pytest.raises(TripError, match="why"):
            with_bogie.estimate(manifests[0])
        return
    assert (result.status, result.estimates) == (OK, equal.estimates)
    assert result.quality.no_part == "why"
    flags = UNEXPLAINED_PARTS if error is UnexplainedError else ""
    assert result.flags == flags
    assert with_bogie.estimate(manifests[0]).flags.reasons == (flags,)


# words


def difference(d, deviations=(0.01,) * 4, misfit=1.0):
    return SideDifference(np.array(d), np.array(deviations), misfit)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (None, ""),
        (difference((0, 0, 0, 0)), ""),
        (difference((0.04, 0.039, -0.04, 0)), ""),
        (difference((0.3, 0, 0, 0), (0.1,) * 4), ""),
        (
            difference((0, 0.25, 0, -1 / 9)),
            "primary damper: the right side is weaker (about 40 %); "
            "secondary damper: the left side is weaker (about 20 %)",
        ),
        (difference((-0.3, 0, 0, 0), misfit=2.1), UNEXPLAINED),
    ],
)
def test_words_name_what_is_clear_and_large(found, words):
    assert spoken_sides(found) == words


def test_report_counts_the_last_trips_and_names_the_newest():
    words = "primary spring: the left side is weaker (about 20 %)"
    trips = [trip(i, sides=words if i in (1, 4, 6) else "") for i in range(8)]
    sentence = sides_finding(trips)
    assert sentence.startswith(
        f"Left and right differ on 2 of the last 5 trips; on trip_006: {words}."
    )
    assert "compare several trips" in sentence
    assert sides_finding(trips[:1]) == sides_finding([]) == ""
    assert sides_finding([trip(0, sides=words)]).startswith(
        "Left and right differ on the last trip;"
    )
    assert sides_finding([*trips[:1], replace(trip(9, missing=True), sides="")]) == ""
    assert trip(9, missing=True).status == NO_ESTIMATE
