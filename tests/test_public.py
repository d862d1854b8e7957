"""The public interface: every name, quick to import, and what a model says of curves and trips."""

import ast
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from trip_fixtures import model_at, recalled_trip, small_fleet

import suspnet
from suspnet import (
    LinearRegression,
    Problem,
    TripSettings,
    load_model,
    load_recording,
    read_manifest,
    save_model,
)
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import TEST
from suspnet.curves.speeds import NoEstimateError
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated, predict_stream
from suspnet.trains.identification.from_recording import read_trip
from suspnet.trains.spectra.segments import recording_segments

SETTINGS = CurveSettings(300, 120, 300, low_hz=0.3, high_hz=12.0, step_hz=0.04)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(False, id="plain"),
        pytest.param(True, id="refined", marks=pytest.mark.slow),
    ],
)
def trained(request, task, quarter_car):
    """Return a problem, a calibrated model of it and the estimates on its test curves."""
    problem = Problem(quarter_car, task(), SETTINGS)
    fitted = replace(fit(problem, LinearRegression(), None), refined=request.param)
    model = calibrated(problem, fitted)
    return problem, model, predict_stream(problem, model, TEST, flags=True)


def test_every_public_name_is_there_and_listed_once():
    for name in suspnet.__all__:
        assert getattr(suspnet, name) is not None
    table = Path(suspnet.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    imported = [
        alias.asname for node in ast.parse(table).body[1:] for alias in node.names
    ]  # what type checkers see
    assert sorted(imported) == sorted({*suspnet.__all__, "__version__"})
    assert set(imported) <= set(dir(suspnet))
    with pytest.raises(AttributeError, match="module 'suspnet' has no attribute 'nothing'"):
        suspnet.nothing  # noqa: B018


def test_import_does_not_pull_in_torch():
    script = (
        "import sys, suspnet; print([m for m in ('torch', 'numpy', 'hydra') if m in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "[]"


def test_model_from_a_folder_estimates_curves_as_a_run_does(trained, tmp_path):
    problem, model, outcome = trained
    save_model(tmp_path, model)
    curves = problem.curves(problem.ratios(TEST), TEST, 0)
    found = load_model(tmp_path).estimate(curves.numpy(), problem.observer.frequencies_hz)
    complete = np.isfinite(found.values).all(axis=1)
    assert complete.sum() == len(outcome.predicted)
    np.testing.assert_allclose(found.values[complete], outcome.predicted, rtol=1e-9)
    low, high = model.intervals.ends(outcome.predicted, outcome.scales, 0.9)
    np.testing.assert_allclose(found.low[complete], low, rtol=1e-9)
    np.testing.assert_allclose(found.high[complete], high, rtol=1e-9)
    assert found.flags.reasons == outcome.flags.reasons
    one = model.estimate(curves[0])
    np.testing.assert_allclose(one.values[0], found.values[0], rtol=1e-9)


def test_model_says_what_it_is(trained):
    model = trained[1]
    refined = ", refined" if model.refined else ""
    expected = f"(linear{refined}, calibrated: k_p, c_p of am96, protocol multi_location)"
    assert repr(model) == f"TrainedModel{expected}"


def test_estimate_reads_aloud_and_goes_into_json(trained):
    problem, model, _ = trained
    curves = problem.curves(problem.ratios(TEST), TEST, 0)
    curves[1] = 1.0  # no peak at all
    found = model.estimate(curves)
    lines = repr(found).splitlines()
    assert len(found) == 120
    assert lines[-1] == "... and 110 more"
    assert lines[0].startswith("k_p ")
    assert " to " in lines[0]
    plain = json.loads(json.dumps(found.to_dict()))
    assert plain["level"] == 0.9
    first, second = plain["estimates"][:2]
    assert first["parameters"]["k_p"]["value"] == found.values[0, 0]
    assert first["parameters"]["c_p"]["high"] == found.high[0, 1]
    assert lines[1].startswith("k_p no estimate, c_p no estimate; flagged: missing: ")
    nothing = {"value": None, "low": None, "high": None}
    assert second["parameters"]["k_p"] == nothing | {"si": nothing | {"unit": "N/m"}}
    si = first["parameters"]["c_p"]["si"]
    assert si["unit"] == "N s/m"
    assert si["high"] == pytest.approx(found.high[0, 1] * model.vehicle.healthy_values()[1])
    assert second["flags"] == found.flags.reasons[1] != ""


@pytest.mark.parametrize(
    "kind", ["path", "recording", pytest.param("text", marks=pytest.mark.slow)]
)
def test_model_estimates_a_trip_as_the_program_does(kind):
    model = model_at()
    path = small_fleet()[0]
    settings = TripSettings()
    expected = recalled_trip(path, [model], settings)
    given = {
        "path": lambda: path,
        "text": lambda: str(path),
        "recording": lambda: load_recording(read_manifest(path), settings.rate_hz),
    }[kind]()
    found = model.estimate(given, settings=settings)
    assert dict(zip(found.names, found.values[0].tolist(), strict=True)) == expected.estimates
    half = dict(zip(found.names, found.half_widths[0].tolist(), strict=True))
    assert half == pytest.approx(expected.half_widths, rel=1e-9)
    assert found.flags.reasons[0] == expected.flags
    if kind == "recording":
        wider = model.estimate(given, settings=settings, level=0.99)
        assert (wider.high > found.high).all()


def test_trips_are_read_with_the_public_tfestimate():
    path = small_fleet()[0]
    recording = load_recording(read_manifest(path), 100.0)
    model, welch = model_at(), suspnet.Welch()
    segments = recording_segments(recording, welch)
    (found,) = read_trip([(model, segments)], recording, TripSettings()).bins
    assert found.chosen.all()
    axle_box, bogie, body = recording.signals
    links = [(axle_box, bogie, body), (bogie, body, axle_box)]
    for link, (x, y, third) in zip(found.spectra.responses("IV"), links, strict=True):
        estimate = suspnet.tfestimate(x, y, 100.0, welch, "IV", instrument=third)
        low, high = model.settings.frequencies_hz()[[0, -1]]
        bins = (estimate.frequencies_hz - (low + high) / 2).abs() <= (high - low) / 2 + 1e-6
        torch.testing.assert_close(estimate.response[bins], link, rtol=1e-9, atol=0)


def test_peaks_are_found_with_the_public_findpeaks(quarter_car):
    observer = SETTINGS.observer(quarter_car)
    curves = observer.observe(torch.ones(5, 5), 0)
    table = suspnet.PeakFeatures(("secondary",), low_hz=0.3, high_hz=12.0).extract(
        curves, observer.frequencies_hz
    )
    peaks = suspnet.findpeaks(
        curves[:, 1], observer.frequencies_hz, fit=suspnet.PeakFit("lorentzian", 0.2, 0.4, 0.4)
    )
    expected = torch.stack([peaks.position_hz, peaks.height, peaks.width_hz], dim=1)
    torch.testing.assert_close(table.values, expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (np.ones((3, 2, 7)), {}, r"curves must have shape \(n_curves, 2, 293\), got \(3, 2, 7\)"),
        (np.ones((2, 293)), {"frequencies_hz": np.arange(1, 294)}, "must be the 293 bins of the"),
        (np.ones((2, 293)), {"mass": [1.0]}, "trained without the car-body mass"),
    ],
)
def test_curves_that_do_not_fit_get_one_clear_error(trained, data, options, message):
    with pytest.raises(ValueError, match=message):
        trained[1].estimate(data, **options)


def test_known_mass_is_asked_for_and_checked(task, quarter_car):
    problem = Problem(quarter_car, task(mass_known=True), replace(SETTINGS, n_calibrate=None))
    model = fit(problem, LinearRegression(), None)
    ratios = problem.ratios(TEST)
    curves = problem.curves(ratios, TEST, 0)
    found = model.estimate(curves, mass=ratios[:120, 4])
    known = np.isfinite(found.values).all(axis=1)
    assert np.abs(found.values[known] / ratios[:120, :2][known] - 1).max() < 0.5
    assert np.isnan(found.low).all()
    assert not found.flags.flagged.any()
    with pytest.raises(ValueError, match="was trained to know the car-body mass: give `mass`"):
        model.estimate(curves)
    with pytest.raises(ValueError, match="one positive number for each of 120 curves"):
        model.estimate(curves, mass=[1.0, -1.0])
    with pytest.raises(ValueError, match="`level` must be a finite number > 0 and < 1"):
        model.estimate(curves, mass=ratios[:120, 4], level=1.5)


def test_trip_without_enough_averages_has_no_estimate():
    path = small_fleet()[0]
    with pytest.raises(NoEstimateError, match=r"minutes, at least .* are needed"):
        model_at().estimate(path, settings=TripSettings(min_averages=1e6))


def test_model_of_curves_cannot_read_a_trip(trained):
    with pytest.raises(suspnet.ModelFileError, match="trips need one of"):
        trained[1].estimate(suspnet.Recording(None, 100.0, {}, None, None, (), 0.1))
