"""Flags of estimates: distances by brute force, thresholds, every flag and its words."""

import math

import numpy as np
import pytest
import torch
from vehicles import AM96

from suspnet.curves.curves import CurveMisfit, CurveSettings
from suspnet.curves.problem import TEST
from suspnet.estimation.estimate import KINDS, Flags
from suspnet.estimation.flags import (
    EDGE_DEVIATIONS,
    FALSE_ALARMS,
    MISFIT_DEVIATIONS,
    N_NEIGHBOURS,
    OODDetector,
)
from suspnet.estimation.refine import Refined, refine
from suspnet.vehicle import PARAMETERS, QuarterCar

CLOUD, MISFIT = 1, 3
OWN = KINDS.index("physics")
"""Kinds that the detector itself finds."""


def cloud(n, seed, n_inputs=9):
    return np.random.default_rng(seed).standard_normal((n, n_inputs))


def distance(point, reference):
    """Return the mean distance to the four nearest, from the differences."""
    lengths = sorted(math.sqrt(sum((point - other) ** 2)) for other in reference)
    return sum(lengths[:4]) / 4


@pytest.fixture(scope="module")
def problem(task):
    return task("joint", "all", estimate_mass=True)


@pytest.fixture(scope="module")
def detector():
    rng = np.random.default_rng(2)
    return OODDetector.learnt(cloud(500, 0), cloud(1000, 1), 1 + 0.02 * rng.standard_normal(1000))


def fitted(n=1, misfit=1.0, deviation=0.01, **ratios):
    """Return refined estimates of healthy vehicles but for some of the parameters."""
    values = np.ones((n, 5))
    for name, ratio in ratios.items():
        values[:, PARAMETERS.index(name)] = ratio
    deviations = np.full((n, 5), deviation)
    return Refined(PARAMETERS, values, deviations, deviations, np.full(n, misfit), np.ones(n, bool))


def flags(detector, problem, refined=None, inputs=None, missing=""):
    refined = fitted() if refined is None else refined
    inputs = np.zeros((len(refined.misfit), 9)) if inputs is None else inputs
    return detector.flags(problem, [missing] * len(inputs), inputs, refined)


# reference


def test_distance_is_the_mean_to_the_four_nearest(detector):
    points = np.vstack([cloud(10, 3), 5 * cloud(10, 4), detector.reference[:3]])
    expected = [distance(point, detector.reference) for point in points]
    assert N_NEIGHBOURS == 4
    assert min(expected) > 0.5
    # a nearest neighbour may be found from squares, which costs half of the digits near zero
    np.testing.assert_allclose(detector.distances(points), expected, rtol=1e-6)


def test_threshold_of_the_distance_is_a_quantile_of_fresh_curves(monkeypatch):
    assert FALSE_ALARMS == 1e-4
    monkeypatch.setattr("suspnet.estimation.flags.FALSE_ALARMS", 5e-4)  # fewer curves will do
    reference, fresh = cloud(100, 5, 2), cloud(6000, 6, 2)
    found = OODDetector.learnt(reference, fresh, np.ones(10)).distance_threshold
    distances = sorted(
        distance(point, reference) for point in fresh[np.argsort((fresh**2).sum(1))][-400:]
    )
    # k = ceil(6001 (1 - 5e-4)) = 5998 of 6000: the third from the end
    assert found == pytest.approx(distances[-3], rel=1e-6)


def test_threshold_of_the_misfit_follows_mean_and_deviation():
    misfits = np.array([1.0, 1.02, 0.98, 1.04])
    deviation = math.sqrt((0.01**2 + 0.01**2 + 0.03**2 + 0.03**2) / 4)
    found = OODDetector.learnt(cloud(20, 0), cloud(20, 1), misfits).misfit_threshold
    assert found == pytest.approx(1.01 + MISFIT_DEVIATIONS * deviation, rel=1e-12)


@pytest.mark.parametrize("factor", [0.9, 1.1])
@pytest.mark.parametrize(
    ("name", "edge", "sign"), [("k_s", 2.0, 1), ("c_p", 0.5, -1), ("M_s", 2.0, 1)]
)
def test_parameter_is_outside_its_range_beyond_some_deviations(
    detector, problem, name, edge, sign, factor
):
    assert EDGE_DEVIATIONS == 2.33
    refined = fitted(deviation=0.03, **{name: edge * math.exp(sign * factor * 2.33 * 0.03)})
    found = flags(detector, problem, refined)
    assert found.found[0, :OWN].tolist() == [False, False, factor > 1, False]


def test_nothing_speaks_against_a_usual_curve(detector, problem):
    found = flags(detector, problem, fitted(3))
    assert found.found.shape == (3, len(KINDS))
    assert not found.flagged.any()
    assert found.reasons == ("", "", "")


def test_parameter_that_the_curve_does_not_tell_is_not_outside(detector, problem):
    found = flags(detector, problem, fitted(deviation=math.inf, k_p=9.0))
    assert not found.flagged.any()


def test_cloud_of_fewer_points_than_neighbours():
    reference = np.array([[0.0, 0.0], [2.0, 0.0]])
    assert OODDetector(reference, 1.0, 1.0).distances(np.zeros((1, 2))).tolist() == [1.0]


def test_range_of_the_mass_is_its_own(detector, task):
    problem = task("joint", "all", estimate_mass=True, mass_lower=0.8, mass_upper=1.3)
    found = flags(detector, problem, fitted(M_s=1.5, k_s=1.5))
    assert found.found[0, :OWN].tolist() == [False, False, True, False]
    assert found.reasons == ("M_s at about 150 % lies outside the 80 to 130 % trained for",)


@pytest.mark.parametrize(("name", "half_step"), [("k_p", 0.01), ("M_s", 0.05)])
def test_grid_stands_for_what_lies_within_half_a_step(detector, task, name, half_step):
    problem = task("multi_location", "primary", step=0.02)
    for edge, sign in ((2.0, 1), (0.5, -1)):
        for share in (0.9, 1.1):
            refined = fitted(deviation=1e-6, **{name: edge + sign * share * half_step})
            found = flags(detector, problem, refined).found[0, :OWN].tolist()
            assert found == [False, False, share > 1, False]


# property


def test_missing_peak_is_said_and_its_distance_not_asked_for(detector, problem):
    inputs = np.zeros((3, 9))
    inputs[1, 2] = np.nan
    inputs[2, 4] = 30.0
    missing = ["", "primary_upper (no maximum)", ""]
    found = detector.flags(problem, missing, inputs, fitted(3))
    assert found.found[:, :OWN].tolist() == [
        [False] * 4,
        [True, *[False] * 3],
        [False, True, False, False],
    ]
    assert found.reasons[:2] == ("", "missing: primary_upper (no maximum)")
    assert found.reasons[2].startswith("the features lie")


@pytest.mark.parametrize(("column", "value"), [(4, 30.0), (7, -30.0)])
def test_features_beyond_the_cloud_name_the_one_that_is(detector, problem, column, value):
    inputs = np.zeros((2, 9))
    inputs[1, column] = value
    found = flags(detector, problem, fitted(2), inputs)
    assert found.found[:, :OWN].tolist() == [[False] * 4, [False, True, False, False]]
    times = distance(inputs[1], detector.reference) / detector.distance_threshold
    assert found.reasons[1] == (
        f"the features lie {times:.2g} times the threshold distance from the training curves, "
        f"mainly because of {problem.inputs[column]}"
    )


def test_feature_within_the_cloud_but_where_no_curve_is_counts_too(problem):
    """All training curves lie on a line; each feature by itself is quite usual."""
    line = np.linspace(-1, 1, 200)[:, None] * np.ones(9)
    detector = OODDetector.learnt(line, line[::3] + 0.001, np.ones(10))
    off = np.array([[0.9, -0.9, *[0.0] * 7]])
    assert flags(detector, problem, inputs=off).found[0, :OWN].tolist() == [
        False,
        True,
        False,
        False,
    ]


def test_parameter_outside_its_range_is_named_with_the_range(detector, problem):
    found = flags(detector, problem, fitted(k_s=2.51, c_p=0.125))
    assert found.found[0, :OWN].tolist() == [False, False, True, False]
    assert found.reasons[0] == (
        "c_p at about 12.5 % lies outside the 50 to 200 % trained for; "
        "k_s at about 251 % lies outside the 50 to 200 % trained for"
    )


def test_curve_that_is_not_explained_is_said_with_numbers(problem):
    detector = OODDetector(cloud(50, 0), 10.0, 1.25)
    found = flags(detector, problem, fitted(misfit=3.4567))
    assert found.found[0, :OWN].tolist() == [False, False, False, True]
    assert found.reasons[0] == (
        "the model cannot explain the curve: its misfit is 3.46 times the noise, at most "
        "1.25 is usual"
    )
    assert not flags(detector, problem, fitted(misfit=1.25)).flagged.any()
    assert flags(detector, problem, fitted(misfit=math.nan)).found[0, MISFIT]


def test_all_that_speaks_against_a_curve_is_said_in_order(detector, problem):
    far = np.full((1, 9), 50.0)
    found = flags(detector, problem, fitted(misfit=9.0, c_s=5.0), far, "secondary (at the edge)")
    assert found.found[:, :OWN].all()
    assert found.flagged.tolist() == [True]
    words = found.reasons[0].split("; ")
    starts = (
        "missing: secondary (at",
        "the features lie",
        "c_s at about 500 %",
        "the model cannot",
    )
    assert len(words) == 4
    for word, start in zip(words, starts, strict=True):
        assert word.startswith(start)


def test_flagged_is_any_of_the_kinds():
    flags = Flags((*(((kind, kind),) for kind in KINDS), ()))
    np.testing.assert_array_equal(flags.found, np.eye(6, 5, dtype=bool))
    assert flags.flagged.tolist() == [True] * 5 + [False]


def test_few_curves_like_the_training_curves_are_flagged(problem):
    """What is learnt from some vehicles' curves holds for others'."""
    observer = CurveSettings(snr_db=34.0, low_hz=0.3, high_hz=15.0, step_hz=0.1).observer(
        QuarterCar(AM96)
    )

    def some(n, seed):
        ratios = problem.sample(n, seed, TEST)
        curves = observer.observe(torch.as_tensor(ratios), seed)
        return np.log(ratios), refine(problem, CurveMisfit(observer, curves), ratios)

    inputs, usual = some(300, 0)
    nine = np.random.default_rng(0).standard_normal((5, 9))  # features that follow from the ratios
    detector = OODDetector.learnt(cloud_of(problem, 4000, 3) @ nine, inputs @ nine, usual.misfit)
    inputs, others = some(300, 1)
    found = detector.flags(problem, [""] * 300, inputs @ nine, others)
    # about 5e-4 of each kind but for the few curves that the limits were learnt from: 1 / 300
    assert (found.found.sum(axis=0) <= [0, 4, 2, 1, 0]).all()
    beyond = detector.flags(problem, [""] * 300, (inputs + 1.0) @ nine, others)
    assert beyond.found[:, CLOUD].mean() > 0.9


def cloud_of(problem, n, seed):
    return np.log(problem.sample(n, seed, TEST))


# failure


@pytest.mark.parametrize("name", ["reference", "thresholds"])
def test_missing_array_is_named(detector, name):
    arrays = detector.state()
    del arrays[name]
    with pytest.raises(KeyError, match=name):
        OODDetector.restored(arrays)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("reference", np.ones(4), "`reference` must be a table of finite numbers"),
        ("reference", np.ones((0, 9)), "`reference` must be a table of finite numbers"),
        ("reference", np.array([[1.0, math.nan]]), "`reference` must be a table of finite"),
        ("thresholds", np.ones(3), "`thresholds` must be two numbers"),
        ("thresholds", np.array([1.0, math.nan]), "`thresholds` must be two numbers"),
    ],
)
def test_arrays_that_are_no_scope_are_rejected(detector, name, array, message):
    with pytest.raises(ValueError, match=message):
        OODDetector.restored(detector.state() | {name: array})
