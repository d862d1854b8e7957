"""Curves out of range are flagged, and intervals hold the truth: as benchmarks measures."""

import sys
from pathlib import Path

import numpy as np
import pytest

from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import TEST, Problem
from suspnet.estimation.from_curves import estimate_curves
from suspnet.learning import MSVR
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated, predict_stream
from suspnet.vehicle import PARAMETERS, Vehicle
from tests.vehicles import AM96

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
reliability = pytest.importorskip("reliability", reason="needs benchmarks")

pytestmark = pytest.mark.slow
SETTINGS = CurveSettings(n_train=500, n_test=200, n_calibrate=600, step_hz=0.08)
ICE3 = Vehicle("ice3", 1750.0, 10000.0, 1.2e6, 10e3, 0.35e6, 20e3)


@pytest.fixture(scope="module")
def trained(quarter_car, task):
    problem = Problem(quarter_car, task(), SETTINGS, progress=False)
    estimator = MSVR(1e4, 3.0, 1e-6, n_components=200)
    return calibrated(problem, fit(problem, estimator, None))


@pytest.fixture(scope="module")
def fresh(quarter_car, task):
    return Problem(quarter_car, task(), SETTINGS, seed=1000, progress=False)


@pytest.fixture(scope="module")
def measured(trained, fresh):
    return reliability.measure(fresh, trained, {"am96": AM96, "ice3": ICE3}, 4)


def test_what_lies_out_of_range_is_flagged_and_what_lies_in_range_is_not(measured):
    shares = {name: kinds["any"] for name, kinds in measured.flags.items()}
    assert shares.pop(reliability.IN_RANGE) < 2.5  # 200 curves
    assert min(shares.values()) >= 95.0, shares
    assert set(shares) == {
        *(f"{name} at {percent} %" for name in PARAMETERS for percent in (30, 250)),
        *(f"{pair} swapped" for pair in ("axle box and bogie", "bogie and body")),
        "axle box and body swapped",
        "vehicle ice3",  # the model's own is left out
    }


def test_parameters_that_are_fitted_are_called_out_of_range_others_unexplained(measured):
    for percent in (30, 250):
        assert measured.flags[f"k_p at {percent} %"]["range"] == 100.0
        assert measured.flags[f"k_p at {percent} %"]["misfit"] == 0.0
        assert measured.flags[f"k_s at {percent} %"]["misfit"] == 100.0


def test_coverage_is_near_the_level(measured):
    scores = measured.intervals["conformal"]
    values = [v["coverage_percent"] for v in scores["outputs"].values()]
    # 300 curves taught the scale, 300 and 200 tell: a standard deviation of 2.7 %
    assert all(82 < v < 98 for v in [*values, scores["joint_coverage_percent"]])


def test_flags_of_curves_are_those_of_the_stream(trained, fresh):
    outcome = predict_stream(fresh, trained, TEST, flags=True)
    ratios = fresh.ratios(TEST)
    curves = fresh.curves(ratios, TEST, 0)
    flags = estimate_curves(trained, fresh.observer, curves, 0.9).flags
    np.testing.assert_array_equal(flags.found, outcome.flags.found[: len(curves)])
    assert flags.reasons == outcome.flags.reasons[: len(curves)]
