"""Estimates with intervals and flags end to end: coverage, seeds, threads, storage."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from protocols import shipped_protocol
from vehicles import AM96

from suspnet.bounds.information import output_bounds
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import BLOCK, CALIBRATE, TEST, Problem
from suspnet.estimation.checkpoint import load_model, save_model
from suspnet.estimation.from_curves import estimate_curves
from suspnet.ground.storage import read_json, write_json
from suspnet.learning import MSVR, MVGPR, CurveFit, LinearRegression
from suspnet.learning.least_squares import BEYOND
from suspnet.runs import scores
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated, predict_stream
from suspnet.runs.tables import scores_table
from suspnet.vehicle import QuarterCar

SETTINGS = CurveSettings(300, 200, 300, low_hz=0.3, high_hz=12.0, step_hz=0.04)
METHODS = {
    "msvr": lambda: MSVR(1e4, 8.0, 1e-3, n_components=256),
    "linear": LinearRegression,
    "mvgpr": lambda: MVGPR(n_optimize=60, n_restarts=0),
    "curve_fit": lambda: CurveFit(64),
}
LEVEL = 0.9


def problem_of(group="primary", protocol="multi_location", seed=0, threads=1, **changes):
    names = {"mass_known", "sampling"} & set(changes)
    posed = shipped_protocol(protocol, **{name: changes.pop(name) for name in names})
    settings = replace(SETTINGS, **changes)
    return Problem(QuarterCar(AM96), posed.task(group), settings, seed, threads, progress=False)


@cache
def outcome_of(name, refined=False, **changes):
    """Return problem, calibrated model and flagged test curves; made once for all tests."""
    problem = problem_of(**changes)
    model = calibrated(problem, replace(fit(problem, METHODS[name](), None), refined=refined))
    return problem, model, predict_stream(problem, model, TEST, flags=True)


def assert_same(first, second):
    for name in ("predicted", "scales", "n_asked"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_array_equal(first.flags.found, second.flags.found)
    assert first.flags.reasons == second.flags.reasons


# reference


@pytest.mark.parametrize(
    ("name", "refined"),
    [
        ("linear", True),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("msvr", False), ("mvgpr", True))
        ),
    ],
)
def test_intervals_hold_the_truth_as_often_as_asked_for(name, refined):
    _, model, outcome = outcome_of(name, refined)
    assert outcome.n_asked == 200
    assert outcome.predicted.shape == outcome.scales.shape == outcome.data.outputs.shape
    truth = outcome.data.outputs
    # 100 calibration and 200 test curves: 3 % and 2.1 %; three and a half of their root sum
    low, high = model.intervals.ends(outcome.predicted, outcome.scales, LEVEL)
    within = (low <= truth) & (truth <= high)
    np.testing.assert_allclose(within.mean(axis=0), LEVEL, atol=0.13)
    low, high = model.intervals.ends(outcome.predicted, outcome.scales, LEVEL, joint=True)
    both = ((low <= truth) & (truth <= high)).all(axis=1)
    assert both.mean() == pytest.approx(LEVEL, abs=0.13)
    assert both.mean() >= within.all(axis=1).mean()
    assert (high / low).max() < 2


def test_scores_are_residuals_of_calibration_curves_over_their_residual_scale():
    problem, model, _ = outcome_of("linear")
    data = problem.features(CALIBRATE).complete()
    estimates = model.predict(data.inputs)
    known = np.hstack(
        [model.input_scaling.apply(data.inputs), model.output_scaling.apply(estimates)]
    )
    every = np.abs(np.log(estimates / data.outputs)) / model.intervals.residual_scale.predict(known)
    scores = model.intervals.conformal.scores
    assert 100 <= len(scores) < len(every)  # the others taught the residual scale
    for score in scores:
        assert np.isclose(every, score, rtol=1e-9).all(axis=1).sum() == 1


@pytest.mark.parametrize(
    "changes",
    [{}, pytest.param({"mass_known": True}, marks=pytest.mark.slow)],
    ids=["unknown", "mass_known"],
)
def test_refined_estimates_reach_the_bound(changes):
    problem, _, outcome = outcome_of("linear", refined=True, **changes)
    bounds = output_bounds(problem.task, problem.observer, outcome.data.ratios)
    normalised = (outcome.predicted - outcome.data.outputs) / bounds
    # 200 curves: 5 %, four of those
    np.testing.assert_allclose(np.sqrt((normalised**2).mean(axis=0)), 1.0, atol=0.2)


def test_flags_of_any_curves_are_those_of_the_stream():
    problem, model, outcome = outcome_of("linear")
    curves = problem.curves(outcome.data.ratios, TEST, 0)
    curves[3] = curves[3] * (1 - 0.3 * torch.exp(-((problem.observer.frequencies_hz - 4) ** 2)))
    found = estimate_curves(model, problem.observer, curves, LEVEL).flags
    others = [row for row in range(BLOCK) if row != 3]
    np.testing.assert_array_equal(found.found[others], outcome.flags.found[others])
    assert found.found[3, 3]
    assert "the model cannot explain the curve" in found.reasons[3]


# limit


@pytest.mark.parametrize("name", ["linear", "curve_fit"])
def test_without_calibration_there_are_neither_intervals_nor_flags(name):
    _, model, outcome = outcome_of(name, n_calibrate=None)
    assert model.intervals is None
    assert model.ood is None
    assert outcome.scales is None
    assert outcome.flags is None
    error = outcome.predicted / outcome.data.outputs - 1
    assert np.abs(error).max() < 0.5


def test_curve_fit_and_refinement_end_in_the_same_optimum():
    fitted = outcome_of("curve_fit", n_calibrate=None)[2]
    refined = outcome_of("linear", refined=True)[2]
    # refinement ends within 1e-5
    np.testing.assert_allclose(refined.predicted, fitted.predicted, rtol=1e-4)


# property


@pytest.mark.parametrize(
    ("name", "refined"), [pytest.param("msvr", False, marks=pytest.mark.slow), ("linear", True)]
)
def test_saved_model_gives_the_same_intervals_and_flags(name, refined, tmp_path):
    problem, model, outcome = outcome_of(name, refined)
    save_model(tmp_path, model)
    loaded = load_model(tmp_path)
    assert loaded.refined is refined
    found = predict_stream(problem, loaded, TEST, flags=True)
    assert_same(found, outcome)
    for joint in (False, True):
        limits = [
            one.intervals.ends(outcome.predicted, outcome.scales, LEVEL, joint)
            for one in (model, loaded)
        ]
        np.testing.assert_array_equal(limits[0], limits[1])


@pytest.mark.parametrize("refined", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_curves_that_lack_a_peak_are_flagged_and_have_no_estimate(refined):
    # the band begins above the lower peak of some heavy vehicles
    problem, _, outcome = outcome_of("linear", refined, low_hz=0.9)
    data = problem.features(TEST)
    assert 2 < (~data.valid).sum() < 60
    assert len(outcome.predicted) == len(outcome.scales) == data.valid.sum()
    assert np.isfinite(outcome.predicted).all()
    assert np.isfinite(outcome.scales).all()
    assert outcome.n_asked == len(outcome.flags.reasons) == 200
    np.testing.assert_array_equal(outcome.flags.found[:, 0], ~data.valid)
    for row in np.flatnonzero(~data.valid):
        names = [
            peak
            for peak, reason in zip(problem.task.extractor.peaks, data.reasons[row], strict=True)
            if reason
        ]
        first = outcome.flags.reasons[row].split("; ")[0]
        assert first.startswith("missing: ")
        assert [
            word.split(" (")[0] for word in first.removeprefix("missing: ").split(", ")
        ] == names


# failure


def test_curves_that_do_not_tell_the_outputs_cannot_be_refined():
    problem = problem_of("secondary", "own_curve", n_train=60, n_test=20, n_calibrate=100)
    model = replace(fit(problem, LinearRegression(), None), refined=True)
    with pytest.raises(ValueError, match="refine=true needs curves that identify k_s"):
        calibrated(problem, model)
    with pytest.raises(ValueError, match="refine=true needs curves that identify k_s"):
        predict_stream(problem, model, TEST)


@pytest.mark.parametrize("is_uncertain", [False, True])
def test_bounds_of_uncertain_numbers_are_those_of_the_first_curves(monkeypatch, is_uncertain):
    problem, model, outcome = outcome_of("linear")
    monkeypatch.setattr(scores, "N_BOUND", 50)
    monkeypatch.setattr(Problem, "is_uncertain", is_uncertain)
    found = scores.scores(problem, model, outcome)
    n = 50 if is_uncertain else 200
    assert found["n_bound"] == n
    bounds = output_bounds(problem.task, problem.observer, outcome.data.ratios[:n])
    truth = outcome.data.outputs[:n]
    error = np.sqrt(np.mean((outcome.predicted / outcome.data.outputs - 1) ** 2, axis=0))
    expected = error / np.sqrt(np.mean((bounds / truth) ** 2, axis=0))
    np.testing.assert_allclose(list(found["rms_ratio"].values()), expected)


@pytest.mark.parametrize(
    ("zeta", "low_hz", "high_hz", "at_bound"), [(0.01, 0.3, 12.0, True), (0.05, 8.0, 12.0, False)]
)
def test_curve_fit_ends_for_light_damping_and_narrow_bands(zeta, low_hz, high_hz, at_bound):
    v = AM96
    damping = {
        "primary_damping_ns_per_m": 2
        * zeta
        * (v.primary_stiffness_n_per_m * v.bogie_mass_kg) ** 0.5,
        "secondary_damping_ns_per_m": 2
        * zeta
        * (v.secondary_stiffness_n_per_m * v.body_mass_kg) ** 0.5,
    }
    task = shipped_protocol("joint", feature_set="curve").task("all")
    settings = replace(SETTINGS, n_train=30, n_test=30, low_hz=low_hz, high_hz=high_hz)
    problem = Problem(QuarterCar(replace(v, **damping)), task, settings, seed=0)
    model = fit(problem, CurveFit(128), None)
    outcome = predict_stream(problem, model, TEST)
    reach = 0.5 / BEYOND * (1 - 1e-9), 2.0 * BEYOND * (1 + 1e-9)
    assert ((outcome.predicted >= reach[0]) & (outcome.predicted <= reach[1])).all()
    if at_bound:
        for ratio in scores.scores(problem, model, outcome)["rms_ratio"].values():
            assert 0.5 < ratio < 1.6  # efficient, within the sampling error of 30 curves


def test_error_over_an_infinite_bound_is_no_number(tmp_path):
    """G_s alone leaves stiffness, damping and mass with a common factor: no Cramer-Rao bound."""
    problem = problem_of("secondary", "own_curve", n_calibrate=None)
    model = fit(problem, LinearRegression(), None)
    found = scores.scores(problem, model, predict_stream(problem, model, TEST))
    written = read_json(write_json(tmp_path / "metrics.json", found))
    for key in ("rms_ratio", "cramer_rao_percent"):
        assert written[key] == {"k_s": None, "c_s": None}
    assert written["bound"]["k_s"] == {"mape_percent": None, "rmse": None}
    for metrics in (found, written):
        assert scores_table(metrics).count(" - ") == 8
