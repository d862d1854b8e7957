"""Protocols: the grids of Table IV, Sobol points, and what a group asks for."""

import itertools
import math

import numpy as np
import pytest

from suspnet.curves.problem import CALIBRATE, TEST, TRAIN
from suspnet.curves.protocols import Protocol
from suspnet.vehicle import PARAMETERS

GROUP = {"outputs": ["k_p", "c_p"], "responses": ["G_p"], "peaks": ["primary_largest"]}
VARIED = {"primary": [0, 1, 4], "secondary": [2, 3, 4], "all": [0, 1, 2, 3, 4]}


def as_set(ratios):
    return {tuple(row) for row in np.round(ratios, 9).tolist()}


# reference


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("own_curve", "primary"),
        pytest.param("multi_location", "secondary", marks=pytest.mark.slow),
        pytest.param("own_curve", "secondary", marks=pytest.mark.slow),
        pytest.param("multi_location", "primary", marks=pytest.mark.slow),
    ],
)
def test_grid_of_a_group_holds_364816_curves(task, name, group):
    problem = task(name, group)
    assert [len(problem.levels(p)) for p in problem.varied] == [151, 151, 16]
    assert sum(problem.grid_sizes) == 364_816  # 151 x 151 x 16, design section 2
    whole = problem.sample(None, seed=0, stream=TRAIN)
    assert whole.shape == (364_816, 5)
    assert len(np.unique(whole, axis=0)) == 364_816


def test_whole_grid_is_the_product_of_its_levels(task):
    problem = task(step=0.5, mass_step=0.75)
    levels = [problem.levels(name).tolist() for name in ("k_p", "c_p", "M_s")]
    expected = [[k, c, 1.0, 1.0, m] for k, c, m in itertools.product(*levels)]
    assert problem.sample(None, seed=3, stream=TRAIN).tolist() == expected
    assert len(expected) == sum(problem.grid_sizes) == 4 * 4 * 3


UNION = {"varied": [["k_p", "k_s", "M_s"], ["c_p", "c_s", "M_s"]]}
"""Table IV: springs and dampers never vary together."""


def test_the_papers_protocol_is_table_iv_scored_as_table_vi(task):
    for group, outputs in (("I", ("k_p", "c_p")), ("II", ("k_s", "c_s"))):
        problem = task("paper", group)
        assert problem.varied_sets == tuple(map(tuple, UNION["varied"]))
        assert (problem.varied, problem.outputs) == (PARAMETERS, outputs)
        assert sum(problem.grid_sizes) == 2 * 364_816


def test_whole_grid_of_several_sets_is_the_grid_of_each(task):
    problem = task(**UNION, step=0.5, mass_step=0.75)
    levels = [problem.levels(name).tolist() for name in ("k_p", "k_s", "M_s")]
    products = list(itertools.product(*levels))
    expected = [[p, 1.0, s, 1.0, m] for p, s, m in products]
    expected += [[1.0, p, 1.0, s, m] for p, s, m in products]
    assert problem.sample(None, seed=3, stream=TRAIN).tolist() == expected


@pytest.mark.parametrize("sampling", ["grid", "sobol"])
def test_curves_are_drawn_from_each_set(task, sampling):
    problem = task(**UNION, sampling=sampling)
    ratios = problem.sample(1001, seed=0, stream=TRAIN)
    springs, dampers = (ratios[:, [0, 2]] != 1).any(axis=1), (ratios[:, [1, 3]] != 1).any(axis=1)
    assert not (springs & dampers).any()
    assert springs.sum() == pytest.approx(500, abs=1 if sampling == "sobol" else 60)
    assert dampers.sum() == pytest.approx(500, abs=1 if sampling == "sobol" else 60)
    np.testing.assert_array_equal(ratios[:300], problem.sample(300, seed=0, stream=TRAIN)[:300])


def test_test_vehicles_may_lie_between_the_steps_of_the_grid(task):
    problem = task(test_sampling="sobol")
    levels = problem.levels("k_p")
    for stream, share in ((TRAIN, 1.0), (TEST, 0.0), (CALIBRATE, 1.0)):
        ratios = problem.sample(200, seed=0, stream=stream)
        assert np.isin(ratios[:, 0], levels).mean() == share


def test_a_set_without_an_output_of_the_group_is_refused(protocol):
    with pytest.raises(ValueError, match=r"`outputs` must be chosen from \('k_p', 'M_s'\)"):
        protocol("paper", varied=[["k_p", "M_s"]])


def test_relative_changes_need_positive_features(protocol):
    with pytest.raises(ValueError, match="'curve' has no relative changes"):
        protocol("trips", standardised=False)


# property


@pytest.mark.parametrize("group", ["primary", "secondary"])
def test_sample_lies_on_the_grid_and_leaves_the_rest_healthy(task, group):
    problem = task("multi_location", group)
    ratios = problem.sample(500, seed=0, stream=TRAIN)
    fixed = [j for j in range(5) if j not in VARIED[group]]
    assert (ratios[:, fixed] == 1).all()
    for name, column in zip(problem.varied, VARIED[group], strict=True):
        assert np.isin(ratios[:, column], problem.levels(name)).all()
        assert ratios[:, column].std() > 0.3  # uniform in 0.5-2 has 0.43


@pytest.mark.parametrize(
    ("name", "group"),
    [pytest.param("multi_location", "primary", marks=pytest.mark.slow), ("joint", "all")],
)
def test_vehicles_of_the_three_streams_are_disjoint(task, name, group):
    problem = task(name, group)
    numbers = {TRAIN: 20_000, TEST: 4000, CALIBRATE: 30_000}  # those of CurveSettings
    train, test, calibrate = (
        as_set(problem.sample(n_curves, seed=0, stream=stream))
        for stream, n_curves in numbers.items()
    )
    assert [len(train), len(test), len(calibrate)] == list(numbers.values())
    assert not train & test
    assert not calibrate & (train | test)


@pytest.mark.parametrize(("name", "group"), [("own_curve", "secondary"), ("joint", "all")])
@pytest.mark.parametrize("stream", [TRAIN, TEST, CALIBRATE])
def test_same_seed_gives_the_same_sample_and_another_seed_another(task, name, group, stream):
    problem = task(name, group)
    first = problem.sample(256, seed=1, stream=stream)
    np.testing.assert_array_equal(first, problem.sample(256, seed=1, stream=stream))
    assert len(as_set(first) & as_set(problem.sample(256, seed=2, stream=stream))) < 10


def test_sobol_points_fill_the_range_evenly(task):
    problem = task("joint", "all")
    train = problem.sample(1024, seed=0, stream=TRAIN)
    assert train.min() >= 0.5
    assert train.max() <= 2.0
    # 1024 scrambled points put exactly one in each of 1024 slices of every axis
    slices = np.floor((train - 0.5) / 1.5 * 1024).astype(int)
    for column in slices.T:
        assert sorted(column.tolist()) == list(range(1024))


@pytest.mark.parametrize(
    ("changes", "inputs", "outputs", "unknown"),
    [
        ({}, 3, ("k_p", "c_p"), ("k_p", "c_p", "M_s")),
        ({"mass_known": True}, 4, ("k_p", "c_p"), ("k_p", "c_p")),
        ({"estimate_mass": True}, 3, ("k_p", "c_p", "M_s"), ("k_p", "c_p", "M_s")),
    ],
)
def test_mass_switches_change_inputs_outputs_and_unknowns(task, changes, inputs, outputs, unknown):
    problem = task("own_curve", "primary", **changes)
    assert len(problem.inputs) == inputs
    assert problem.outputs == outputs
    assert problem.unknown == unknown
    assert problem.output_indices == [PARAMETERS.index(name) for name in outputs]
    assert ("M_s" in problem.inputs) == ("mass_known" in changes)


def test_estimates_are_bounded_to_half_and_twice_the_range(task):
    ratios = np.array([[0.24, 3.3, 1.0, np.inf, 0.1], [0.26, 3.1, np.nan, 0.0, 2.7]])
    expected = np.array([[0.25, 3.2, 1.0, 3.2, 0.4], [0.26, 3.1, np.nan, 0.25, 2.6]])
    bounded = task("trips", "all").bounded(ratios)
    np.testing.assert_allclose(bounded, expected, rtol=1e-12)


# failure


def test_unknown_group_is_rejected_with_the_choices(protocol):
    with pytest.raises(ValueError, match=r"no group 'tertiary'; choose from \['primary', 'second"):
        protocol().task("tertiary")


@pytest.mark.parametrize(
    ("key", "names", "message"),
    [
        ("outputs", ["k_x"], "`outputs` must be chosen from"),
        ("outputs", ["M_s"], "`outputs` must be chosen from"),
        ("outputs", [], "`outputs` must be chosen from"),
        ("responses", ["G_x"], "`responses` must be chosen from"),
        ("responses", [], "`responses` must be chosen from"),
        ("peaks", ["highest"], "`peaks` must be chosen from"),
    ],
)
def test_unknown_names_are_rejected_when_the_protocol_is_made(key, names, message):
    with pytest.raises(ValueError, match=message):
        Protocol("wrong", {"primary": GROUP | {key: names}})


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"sampling": "random"}, "`sampling` must be one of .*'random'"),
        ({"lower": 0.0}, "`lower` must be a finite number > 0 and < 1, got 0.0"),
        ({"lower": 1.0}, "`lower` must be a finite number > 0 and < 1, got 1.0"),
        ({"upper": 0.9}, "`upper` must be a finite number >= 1, got 0.9"),
        ({"lower": math.nan}, "`lower` must be a finite number > 0 and < 1, got nan"),
        ({"step": 0.0}, "`step` must be a finite number > 0, got 0.0"),
        ({"mass_step": -0.1}, "`mass_step` must be a finite number > 0, got -0.1"),
        ({"mass_known": True, "estimate_mass": True}, "known or estimated, not both"),
    ],
)
def test_settings_out_of_range_are_rejected(protocol, setting, message):
    with pytest.raises(ValueError, match=message):
        protocol(**setting)


def test_more_curves_than_the_grid_holds_are_rejected(task):
    problem = task(step=0.5, mass_step=0.5)
    with pytest.raises(ValueError, match="holds 64 curves, 65 were asked for"):
        problem.sample(65, seed=0, stream=TRAIN)


def test_whole_sobol_sequence_is_rejected(task):
    problem = task("joint", "all")
    with pytest.raises(ValueError, match="'joint' has no finite grid"):
        problem.sample(None, seed=0, stream=TRAIN)


def test_incomplete_group_is_named():
    with pytest.raises(ValueError, match=r"lacks \['peaks'\]"):
        Protocol("mine", {"primary": {"outputs": ["k_p"], "responses": ["G_p"]}})


def test_whole_curves_need_both_responses(protocol):
    with pytest.raises(ValueError, match=r"both responses, protocol 'own_curve' only \['G_p'\]"):
        protocol("own_curve", feature_set="curve")
    assert protocol("joint", feature_set="curve").task("all").extractor.kind == "curve"


def test_names_given_twice_are_rejected(protocol):
    twice = {"outputs": ["k_p", "k_p"], "responses": ["G_p"], "peaks": ["primary_largest"]}
    with pytest.raises(ValueError, match="each once"):
        Protocol("mine", {"primary": twice})


def test_step_that_does_not_divide_the_range_stays_inside(task):
    levels = task("multi_location", "primary", step=0.4).levels("k_p")
    np.testing.assert_allclose(levels, [0.5, 0.9, 1.3, 1.7])
