"""The reliability study: coverage by slices, and what it makes of curves out of range."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from scipy.stats import norm

from suspnet.dynamics import PARAMETERS, QuarterCar, Vehicle, VerticalVehicle
from suspnet.estimation.checkpoint import save_model
from suspnet.estimation.estimate import KINDS
from suspnet.estimation.from_curves import estimate_curves
from suspnet.estimation.problem import TEST, Problem
from suspnet.learning import MSVR, MVGPR
from suspnet.runs.evaluate import FreshCurves
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated, predict_stream
from suspnet.runs.reliability import (
    IN_RANGE,
    N_SLICES,
    _gp_intervals,
    _odd_sets,
    _slices,
    markdown,
    measure,
    records,
    reliability_figure,
    write_reliability,
)
from suspnet.spectra.curves import CurveSettings
from tests.vehicles import AM96

SETTINGS = CurveSettings(n_train=500, n_test=200, n_calibrate=600, step_hz=0.08, cache_dir=None)
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
    return measure(fresh, trained, {"am96": AM96, "ice3": ICE3}, 4)


def test_what_lies_out_of_range_is_flagged_and_what_lies_in_range_is_not(measured):
    shares = {name: kinds["any"] for name, kinds in measured.flags.items()}
    assert shares.pop(IN_RANGE) < 2.5  # 200 curves
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


def test_slices_split_the_range_evenly(task):
    ratios = np.ones((6, 5))
    ratios[:, 0] = 0.5, 0.79, 0.81, 1.99, 2.0, 1.3
    within = np.array([[True, False]] * 3 + [[False, True]] * 3)
    slices = _slices(task(), ratios, within)["k_p"]
    assert len(slices["k_p"]) == N_SLICES
    np.testing.assert_equal(slices["k_p"], [100.0, 100.0, 0.0, np.nan, 0.0])
    np.testing.assert_equal(slices["c_p"], [0.0, 0.0, 100.0, np.nan, 100.0])


def test_swapped_channels_have_the_responses_of_the_swapped_order(fresh):
    sets = dict(_odd_sets(replace_snr(fresh), {}, 4))
    ratios, swapped = sets["axle box and body swapped"]
    primary, secondary = fresh.noise_free(ratios).unbind(1)
    body = primary * secondary  # axle box 1, bogie `primary`, body `body`
    torch.testing.assert_close(swapped[:, 0], primary / body, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(swapped[:, 1], 1 / primary, rtol=1e-3, atol=1e-3)
    _, swapped = sets["axle box and bogie swapped"]
    torch.testing.assert_close(swapped[:, 0], 1 / primary, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(swapped[:, 1], body, rtol=1e-3, atol=1e-3)
    _, swapped = sets["bogie and body swapped"]
    torch.testing.assert_close(swapped[:, 0], body, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(swapped[:, 1], primary / body, rtol=1e-3, atol=1e-3)


def replace_snr(problem):
    return replace(problem, settings=replace(problem.settings, snr_db=150.0))


def test_odd_sets_change_one_parameter_only(fresh):
    ratios, _ = dict(_odd_sets(fresh, {}, 5))["c_s at 30 %"]
    usual = fresh.task.sample(5, fresh.seed, TEST)
    column = PARAMETERS.index("c_s")
    np.testing.assert_array_equal(ratios[:, column], 0.3)
    np.testing.assert_array_equal(np.delete(ratios, column, 1), np.delete(usual, column, 1))


def test_another_vehicle_is_seen_through_the_model_s_own_kind_of_generator(fresh):
    problem = replace(fresh, generator=VerticalVehicle(AM96))
    other = replace(AM96, name="longer", half_pivot_distance_m=12.0)
    sets = dict(_odd_sets(problem, {"longer": other, "ice3": ICE3}, 3))
    expected = VerticalVehicle(other).magnitudes(
        torch.as_tensor(sets["vehicle longer"][0]), problem.observer.frequencies_hz
    )
    rms = expected.square().mean(dim=2, keepdim=True).sqrt()
    assert float(((sets["vehicle longer"][1] - expected) / rms).abs().max()) < 0.12  # 34 dB: 2 %
    expected = QuarterCar(ICE3).magnitudes(
        torch.as_tensor(sets["vehicle ice3"][0]), problem.observer.frequencies_hz
    )
    rms = expected.square().mean(dim=2, keepdim=True).sqrt()
    assert float(((sets["vehicle ice3"][1] - expected) / rms).abs().max()) < 0.12


def test_flags_of_curves_are_those_of_the_stream(trained, fresh):
    outcome = predict_stream(fresh, trained, TEST, flags=True)
    ratios = fresh.ratios(TEST)
    curves = fresh.curves(ratios, TEST, 0)
    flags = estimate_curves(trained, fresh.observer, curves, 0.9).flags
    np.testing.assert_array_equal(flags.found, outcome.flags.found[: len(curves)])
    assert flags.reasons == outcome.flags.reasons[: len(curves)]


def test_gp_s_own_limits_by_hand(quarter_car, task):
    problem = Problem(quarter_car, task(), replace(SETTINGS, n_train=150), progress=False)
    model = fit(problem, MVGPR(n_optimize=60, n_restarts=0), None)
    inputs = problem.features(TEST).complete().inputs[:7]
    low, high = _gp_intervals(model, inputs, 0.9)
    scaled = model.input_scaling.apply(inputs)
    mean, deviation = model.estimator.predict(scaled, return_std=True)
    for j in range(2):
        shift, scale = model.output_scaling.mean[j], model.output_scaling.scale[j]
        for limit, sign in ((low, -1), (high, 1)):
            expected = np.exp(
                (mean[:, j] + sign * norm.ppf(0.95) * deviation[:, j]) * scale + shift
            )
            np.testing.assert_allclose(limit[:, j], expected, rtol=1e-12)


def test_report_holds_every_number(trained, measured, tmp_path, monkeypatch):
    def measured_before(problem, model, others, n_odd):
        assert (problem.seed, problem.settings.n_test, n_odd) == (7, 60, 3)
        np.testing.assert_array_equal(model.healthy_features, trained.healthy_features)
        assert others == {}
        return measured

    monkeypatch.setattr("suspnet.runs.reliability.measure", measured_before)
    save_model(tmp_path / "run", trained)
    folder = tmp_path / "report"
    GlobalHydra.instance().clear()
    found = write_reliability(
        str(tmp_path / "run"),
        {},
        folder,
        FreshCurves(7, 60, progress=False),
        3,
        "cpu",
    )
    assert len(found) == 1
    stored = json.loads((folder / "reliability.json").read_text())
    assert stored[found[0].name]["flags"] == found[0].flags
    with (folder / "reliability.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(list(records(found)))
    flagged = {r["of"]: float(r["percent"]) for r in rows if r["what"] == "flagged_percent any"}
    assert flagged == {name: kinds["any"] for name, kinds in found[0].flags.items()}
    text = (folder / "reliability.md").read_text()
    assert markdown(found[0]) in text
    assert all(name in text for name in found[0].flags)
    assert (folder / "reliability.png").is_file()


def test_model_without_calibration_and_its_own_seed_are_refused(trained, tmp_path):
    fresh = FreshCurves(7, 10, progress=False)
    save_model(tmp_path / "bare", replace(trained, intervals=None, ood=None))
    with pytest.raises(ValueError, match=r"not calibrated: train it with data\.n_calibrate"):
        write_reliability(str(tmp_path / "bare"), {}, tmp_path / "out", fresh, 4, "cpu")
    save_model(tmp_path / "run", trained)
    own = replace(fresh, seed=0)
    with pytest.raises(ValueError, match="seed=0 made the training curves"):
        write_reliability(str(tmp_path / "run"), {}, tmp_path / "out", own, 4, "cpu")
    assert not (tmp_path / "out").exists()


def test_figure_draws_every_slice_and_set(measured):
    figure = reliability_figure([measured])
    left, right = figure.axes
    dots = sum(len(line.get_xdata()) for line in left.lines if line.get_marker() == "o")
    assert dots == N_SLICES * 2 * 3  # two outputs over three parameters
    assert len(right.patches) == len(measured.flags)
    assert {"any", *KINDS} == set(measured.flags[IN_RANGE])


def test_number_of_odd_curves_is_checked_before_anything_is_read(tmp_path):
    fresh = FreshCurves(1, 10, progress=False)
    for wrong in (0, 1.5):
        with pytest.raises((ValueError, TypeError), match="`n_odd` must be a whole number >= 1"):
            write_reliability(str(tmp_path / "none"), {}, tmp_path, fresh, wrong, "cpu")
