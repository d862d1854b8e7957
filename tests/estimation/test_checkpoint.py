import hashlib
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from protocols import shipped_protocol
from vehicles import AM96

from suspnet.curves.curves import CurveSettings
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import Problem
from suspnet.estimation.checkpoint import load_model, save_model
from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.flags import OODDetector
from suspnet.estimation.intervals import Conformal, Intervals, ResidualScale
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.ground.storage import content_hash, dump_arrays, read_arrays
from suspnet.learning import METHODS, MSVR, MVGPR, SVR, CurveFit, LinearRegression, Scaling
from suspnet.vehicle import QuarterCar, VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

FITTED = [
    MSVR(n_components=64),
    MSVR(n_components=64, feature_map="nystroem"),
    SVR(),
    MVGPR(n_optimize=40, n_restarts=0),
    LinearRegression(),
]


def trained(estimator):
    random = np.random.default_rng(0)
    inputs = random.uniform(0.5, 2, (60, 3))
    outputs = np.column_stack([inputs[:, 0] * inputs[:, 1], inputs[:, 1] / inputs[:, 2]])
    scalings = Scaling.of(inputs), Scaling.of(outputs)
    if not isinstance(estimator, CurveFit):
        estimator.fit(scalings[0].apply(inputs), scalings[1].apply(outputs))
    name = next(key for key, kind in METHODS.items() if type(estimator) is kind)
    task = shipped_protocol("own_curve", log_ratios=True).task("primary")
    generator, settings = QuarterCar(AM96), CurveSettings(n_train=60)
    return TrainedModel(
        name,
        estimator,
        task,
        generator,
        settings,
        Problem(generator, task, settings).healthy_features(),
        *scalings,
        training={"seed": 0},
    )


def calibrated(learnt=True):
    """Return a refined model with intervals and an OOD detector."""
    random = np.random.default_rng(2)
    known, wrong = random.standard_normal((120, 5)), 0.1 * random.standard_normal((120, 2))
    residual_scale = ResidualScale.learnt(known, wrong) if learnt else None
    sizes = residual_scale.predict(known) if residual_scale else np.ones_like(wrong)
    return replace(
        trained(LinearRegression()),
        refined=True,
        intervals=Intervals(Conformal.of(wrong, sizes), True, residual_scale),
        ood=OODDetector.learnt(known[:, :3], known[:40, :3], 1 + 0.1 * random.random(30)),
    )


@pytest.fixture
def saved(tmp_path):
    save_model(str(tmp_path), trained(MSVR(n_components=64)))
    return tmp_path


@pytest.mark.parametrize("estimator", FITTED, ids=lambda e: type(e).__name__)
def test_loaded_model_predicts_bit_for_bit(estimator, tmp_path):
    model = trained(estimator)
    save_model(tmp_path, model)
    inputs = np.random.default_rng(1).uniform(0.5, 2, (500, 3))
    predicted = model.predict(inputs)
    assert predicted.std() > 0
    np.testing.assert_array_equal(load_model(tmp_path).predict(inputs), predicted)


def test_loaded_model_knows_what_it_was_trained_for(saved):
    model, loaded = trained(MSVR(n_components=64)), load_model(saved)
    assert loaded.task == model.task
    assert loaded.generator == model.generator
    assert loaded.settings == model.settings
    assert loaded.training == model.training
    np.testing.assert_array_equal(loaded.healthy_features, model.healthy_features)


def test_posterior_of_what_may_be_absent_survives_exactly(tmp_path):
    names = ("rubber_loss", "healthy_k_p", "guidance_damping")
    posterior = LogNormal(
        names,
        (-0.01, 0.1, math.log(1.7)),  # the first ratio is just below 0
        ((0.01, 0.002, 0.0), (0.002, 0.04, 0.001), (0.0, 0.001, 0.3)),
    )
    assert -0.02 < posterior.median[0] < 0
    generator = VerticalVehicle(AM96, parts=("rubber", "guidance"), distribution=posterior)
    settings = EstimateSettings(body_high_hz=9.0).bound(AM96)
    plain = trained(LinearRegression())
    healthy = Problem(generator, plain.task, settings).healthy_features()
    model = replace(plain, generator=generator, settings=settings, healthy_features=healthy)
    save_model(tmp_path, model)
    loaded = load_model(tmp_path)
    assert loaded.generator == generator
    assert loaded.generator.distribution == posterior
    assert loaded.settings == settings
    ratios, frequencies = torch.ones(1, 5), torch.linspace(0.5, 15.0, 20)
    assert torch.equal(
        loaded.generator.channels(ratios, frequencies), generator.channels(ratios, frequencies)
    )


@pytest.mark.parametrize("learnt", [True, False])
def test_loaded_intervals_and_scope_are_the_same_bit_for_bit(learnt, tmp_path):
    model = calibrated(learnt)
    save_model(tmp_path, model)
    loaded = load_model(tmp_path)
    assert loaded.refined is True
    known, estimates = np.random.default_rng(3).standard_normal((40, 5)), np.full((40, 2), 1.2)
    scales = np.ones((40, 2))
    if learnt:
        scales = model.intervals.residual_scale.predict(known)
        found = loaded.intervals.residual_scale.predict(known)
        np.testing.assert_array_equal(found, scales)
    else:
        assert loaded.intervals.residual_scale is None
    limits = [m.intervals.ends(estimates, scales, 0.9) for m in (model, loaded)]
    np.testing.assert_array_equal(limits[0], limits[1])
    distances = [m.ood.distances(known[:, :3]) for m in (model, loaded)]
    np.testing.assert_array_equal(distances[0], distances[1])
    assert loaded.ood.distance_threshold == model.ood.distance_threshold
    assert loaded.ood.misfit_threshold == model.ood.misfit_threshold


def test_limits_travel_with_the_model(tmp_path):
    model = trained(LinearRegression())
    rules = {"k_p": {"notice": [0.95, None], "act": [0.9, None], "why": "rule 7"}, "c_p": None}
    limited = replace(model.generator, vehicle=replace(AM96, limits=rules))
    save_model(tmp_path, replace(model, generator=limited))
    loaded = load_model(tmp_path).vehicle
    assert loaded.known_limits == limited.vehicle.known_limits
    assert loaded.known_limits["k_p"].notice == (0.95, math.inf)


def test_a_model_without_limits_is_written_as_before_there_were_any(tmp_path):
    model = trained(LinearRegression())
    plain = replace(model.generator, vehicle=replace(AM96, limits=None))
    save_model(tmp_path, replace(model, generator=plain))
    written = json.loads((tmp_path / "model.json").read_text())
    assert "limits" not in written["generator"]["vehicle"]
    assert load_model(tmp_path).vehicle.known_limits == DEFAULT_LIMITS


def test_model_without_calibration_is_loaded_without(saved):
    loaded = load_model(saved)
    assert loaded.refined is False
    assert loaded.intervals is None
    assert loaded.ood is None


def test_scaled_inputs_keep_what_is_missing():
    model = trained(LinearRegression())
    inputs = np.array([[1.0, 0.5, 2.0], [np.nan, 1.0, 1.0], [1.0, -1.0, 1.0]])
    found = model.scaled(inputs)
    np.testing.assert_array_equal(found[0], model.input_scaling.apply(inputs[:1])[0])
    assert np.isnan(found).sum(axis=1).tolist() == [0, 1, 1]
    assert np.isnan(found[[1, 2], [0, 1]]).all()
    side_by_side = model.with_estimates(inputs[:1], np.array([[1.0, 2.0]]))
    scaled = model.output_scaling.apply(np.array([[1.0, 2.0]]))
    np.testing.assert_array_equal(side_by_side, np.hstack([found[:1], scaled]))


def test_curve_fit_is_saved_without_arrays(tmp_path):
    save_model(tmp_path, trained(CurveFit(n_starts=7)))
    assert load_model(tmp_path).estimator.n_starts == 7


def test_model_rejects_inputs_that_do_not_fit():
    model = trained(LinearRegression())
    with pytest.raises(ValueError, match=r"shape \(n_curves, 3\)"):
        model.predict(np.ones((4, 9)))
    with pytest.raises(ValueError, match="positive and finite"):
        model.predict(np.array([[1.0, np.nan, 1.0]]))


def test_truncated_arrays_are_rejected(saved):
    path = saved / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ModelFileError, match="is damaged"):
        load_model(saved)


def test_missing_arrays_are_named(saved):
    (saved / "model.safetensors").unlink()
    with pytest.raises(ModelFileError, match=r"no model\.safetensors"):
        load_model(saved)


def test_altered_description_is_rejected(saved):
    path = saved / "model.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 1'))
    with pytest.raises(ModelFileError, match="was altered"):
        load_model(saved)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "damaged or not JSON"),
        ("[]", "not a suspnet model"),
        ('{"a": 1}', "not a suspnet model"),
        ('{"schema_version": 99}', "schema version 99"),
        (
            '{"schema_version": 11, "model": "msvr", "training": {"commissioned": {}}}',
            "is a regression for the vehicle that healthy trips showed, .*: commission again",
        ),
        ('{"schema_version": 2}', "schema version 2, this suspnet reads 16; train again"),
    ],
)
def test_foreign_description_is_rejected(saved, content, message):
    (saved / "model.json").write_text(content)
    with pytest.raises(ModelFileError, match=message):
        load_model(saved)


def test_what_is_no_trained_model_is_not_written(tmp_path):
    with pytest.raises(TypeError, match=r"got MSVR; an estimator .* joblib\.dump"):
        save_model(tmp_path, MSVR())
    with pytest.raises(TypeError, match="second argument"):
        save_model(trained(MSVR(n_components=8)), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("intervals.scores", None, "not a suspnet model: KeyError"),
        ("intervals.scores", -np.ones((9, 2)), "do not fit together: `scores` must be a table"),
        ("intervals.size_mean", np.ones(3), "do not fit together: `scores` has 2 outputs"),
        ("intervals.residual_scale.coef", np.ones((3, 2)), "do not fit together: coef has shape"),
        ("ood.thresholds", np.ones(3), "do not fit together: `thresholds` must be two numbers"),
        ("intervals.scores", np.ones((9, 3)), "do not fit together: `scores` has 3 outputs"),
        ("intervals.scores", np.ones(4), "do not fit together: `scores` must be a table"),
        ("intervals.log", np.ones(0), "do not fit together: `log` must be one number"),
        ("intervals.residual_scale.intercept", np.ones(3), "do not fit together: coef has shape"),
        ("ood.reference", np.ones(4), "do not fit together: `reference` must be a table"),
        ("ood.reference", np.ones((0, 5)), "do not fit together: `reference` must be a table"),
        ("ood.reference", None, "not a suspnet model: KeyError"),
    ],
)
def test_calibration_that_does_not_fit_is_rejected(tmp_path, name, array, message):
    save_model(tmp_path, calibrated())
    arrays = read_arrays(tmp_path / "model.safetensors")
    del arrays[name]
    if array is not None:
        arrays[name] = array
    content = dump_arrays(arrays)
    (tmp_path / "model.safetensors").write_bytes(content)
    description = json.loads((tmp_path / "model.json").read_text())
    del description["description_sha256"]
    description["arrays_sha256"] = hashlib.sha256(content).hexdigest()
    description["description_sha256"] = content_hash(description)
    (tmp_path / "model.json").write_text(json.dumps(description))
    with pytest.raises(ModelFileError, match=message):
        load_model(tmp_path)


def test_folder_without_model_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no model\.json"):
        load_model(tmp_path)


def test_description_says_units_scaling_and_hashes(saved):
    content = json.loads((saved / "model.json").read_text())
    assert content["inputs"]["names"] == [
        "primary_largest_position",
        "primary_largest_height",
        "primary_largest_width",
    ]
    assert content["outputs"]["log"] is True
    assert len(content["inputs"]["mean"]) == 3
    assert content["units"]["vehicle"] == "kg, N/m, N s/m"
    assert len(content["arrays_sha256"]) == len(content["description_sha256"]) == 64


def test_healthy_curves_have_relative_features_of_one(saved):
    model = load_model(str(saved))
    frequencies_hz = np.arange(5, 1001) * 0.02
    generator = QuarterCar(model.vehicle)
    bins = torch.as_tensor(frequencies_hz)
    curves = generator.magnitudes(torch.ones(1, 5), bins)
    features, _ = model.features(curves, bins)
    table = model.task.extractor.extract(curves, bins)
    np.testing.assert_allclose(features * model.healthy_features, table.values.numpy())
    assert model.predict(features.tolist()).shape == (1, 2)
