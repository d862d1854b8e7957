"""Damping at equal temperature: naive formulas, slopes that healthy trips show, whole trips."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.stats import norm
from trip_fixtures import changed, model_at, write_trips

from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.temperature import (
    DAMPINGS,
    NOTE,
    DampingByTemperature,
    kelvins_warmer,
)
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.pages.details import healthy_words
from suspnet.trains.simulation.fleet import Scenario
from suspnet.trains.trips.trip import evaluate_trip

LAW = DampingByTemperature(15.0, (-0.004, -0.005), (0.002, 0.001))


# reference


@pytest.mark.parametrize("warm_c", [-20.0, 15.0, 41.5])
def test_a_trip_is_compared_as_the_formula_says(warm_c):
    names = ("k_p", "c_p", "k_s", "c_s")
    values = np.array([[1.01, 0.8, 0.97, 1.2], [0.9, 1.1, 1.0, 0.6]])
    low, high = values * [0.98, 0.9, 0.99, 0.95], values * [1.02, 1.1, 1.01, 1.08]
    found = LAW.compared(Estimate(names, values, low, high, 0.9, Flags.none(2)), warm_c)
    np.testing.assert_array_equal(found.values[:, ::2], values[:, ::2])  # springs
    np.testing.assert_array_equal(found.low[:, ::2], low[:, ::2])
    z = norm.ppf(0.95)
    for row in range(2):
        for j, b, deviation in ((1, -0.004, 0.002), (3, -0.005, 0.001)):
            log = math.log(values[row, j]) - b * (warm_c - 15.0)
            assert found.values[row, j] == pytest.approx(math.exp(log))
            common = z * deviation * abs(warm_c - 15.0)
            below = math.hypot(math.log(values[row, j] / low[row, j]), common)
            above = math.hypot(math.log(high[row, j] / values[row, j]), common)
            assert found.low[row, j] == pytest.approx(math.exp(log - below))
            assert found.high[row, j] == pytest.approx(math.exp(log + above))


# whole trips


@pytest.fixture(scope="module")
def warm_trip(tmp_path_factory):
    """A trip whose dampers have lost 8 %."""
    lost = {"from_km": 0, "to_km": 0, "ratio": 0.92}
    folder = tmp_path_factory.mktemp("warm")
    (path,) = write_trips(folder, scenario=Scenario("warm", dict.fromkeys(DAMPINGS, lost)))
    return changed(path, folder, "at_35", temperature_c=35.0), path


def test_a_warm_trip_reads_healthy_where_its_temperature_is_known(warm_trip):
    known, unknown = warm_trip
    plain = model_at()
    notes = {"n_trips": 3, "mileage_km": [0.0, 10.0], NOTE: asdict(DampingByTemperature(15.0))}
    model = replace(plain, training=plain.training | {"commissioned": notes})
    as_before = evaluate_trip(known, [plain], TripSettings())
    cold, warm = (evaluate_trip(one, [model], TripSettings()) for one in (unknown, known))
    assert cold.estimates == as_before.estimates
    assert cold.half_widths == as_before.half_widths
    for name in DAMPINGS:
        assert cold.estimates[name] == pytest.approx(0.92, abs=0.02)
        assert warm.estimates[name] == pytest.approx(cold.estimates[name] * math.exp(0.08))
        assert abs(math.log(warm.estimates[name])) < warm.half_widths[name]
        assert warm.half_widths[name] > norm.ppf(0.95) * 0.04
    assert warm.estimates["k_s"] == cold.estimates["k_s"]
    assert healthy_words(model) == "what 3 trips from 0 to 10 km showed, damping at 15 °C"
    alone = model.estimate(known)
    assert dict(zip(alone.names, alone.values[0].tolist(), strict=True)) == warm.estimates


# limits


def test_an_unknown_temperature_changes_nothing():
    one = Estimate(("c_p",), *np.ones((3, 1, 1)), 0.9, Flags.none(1))
    assert LAW.compared(one, None) is one
    assert DampingByTemperature.noted({"commissioned": {"n_trips": 3}}) is None
    assert DampingByTemperature.noted({"seed": 0}) is None
    assert kelvins_warmer([None, 5.0, 9.0]) == (7.0, [0.0, -2.0, 2.0])
    assert kelvins_warmer([None, None]) == (None, [0.0, 0.0])


def test_intervals_that_are_missing_or_reach_0_stay_so():
    nan = np.full((1, 1), np.nan)
    found = LAW.compared(Estimate(("c_s",), np.ones((1, 1)), nan, nan, 0.9, Flags.none(1)), 25.0)
    assert found.values[0, 0] == pytest.approx(math.exp(0.05))
    assert np.isnan([found.low, found.high]).all()
    ends = np.zeros((1, 1)), np.full((1, 1), np.inf)
    found = LAW.compared(Estimate(("c_s",), np.ones((1, 1)), *ends, 0.9, Flags.none(1)), 25.0)
    assert (found.low[0, 0], found.high[0, 0]) == (0.0, np.inf)


# misuse


@pytest.mark.parametrize(
    ("note", "message"),
    [
        ({"healthy_c": math.nan}, "healthy_c` must be a finite number"),
        ({"healthy_c": 10.0, "slopes": [0.0]}, "slopes` must be 2 numbers"),
        ({"healthy_c": 10.0, "deviations": [0.001, math.inf]}, "deviations` must be a finite"),
    ],
)
def test_a_law_that_cannot_be_is_refused(note, message):
    with pytest.raises(ValueError, match=message):
        DampingByTemperature.noted({"commissioned": {NOTE: note}})
