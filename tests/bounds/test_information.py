"""Bounds: Fisher information, Cramer-Rao, and the limit where the mass cannot be told apart."""

import math

import numpy as np
import pytest
import reference
from protocols import shipped_protocol
from scipy.optimize import least_squares

from suspnet.bounds import information
from suspnet.bounds.information import (
    best_possible,
    cramer_rao,
    fisher_information,
    output_bounds,
    relative_percent,
)
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import TEST
from suspnet.vehicle import PARAMETERS

OBSERVED = CurveSettings()
FREQUENCIES = OBSERVED.frequencies_hz()
DEGRADED = np.array([0.8, 1.3, 1.2, 0.9, 1.1])


def bound(quarter_car, ratios, **options):
    return cramer_rao(fisher_information(OBSERVED.observer(quarter_car), ratios, **options))


# reference


@pytest.mark.parametrize(
    ("parameters", "responses"),
    [
        (PARAMETERS, ("G_p", "G_s")),
        (("k_p", "c_p"), ("G_p",)),
        (("k_s", "c_s"), ("G_s",)),
        (("M_s", "k_p"), ("G_s", "G_p")),
    ],
)
def test_fisher_information_equals_finite_differences(quarter_car, parameters, responses):
    observer = OBSERVED.observer(quarter_car)
    found = fisher_information(observer, DEGRADED[None], parameters, responses)[0]
    expected = reference.fisher_by_differences(
        quarter_car.vehicle,
        DEGRADED,
        FREQUENCIES.numpy(),
        34.0,
        [PARAMETERS.index(name) for name in parameters],
        [("G_p", "G_s").index(name) for name in responses],
    )
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert size.min() > 0
    # central differences with a step of 1e-5 are exact to about 1e-8
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-6)


def test_cramer_rao_is_reached_by_least_squares(quarter_car):
    """An efficient estimator: least squares on noisy curves, weighted by the known noise."""
    frequencies, n_draws = FREQUENCIES.numpy(), 100
    clean = reference.magnitudes(quarter_car.vehicle, DEGRADED, frequencies)
    rms = np.sqrt((clean**2).mean(axis=1, keepdims=True)) * 10 ** (-34 / 20)
    rng = np.random.default_rng(0)
    estimates = []
    for _ in range(n_draws):
        noisy = clean + rms * rng.standard_normal(clean.shape)

        def residual(x, noisy=noisy):
            return (
                (reference.magnitudes(quarter_car.vehicle, x, frequencies) - noisy) / rms
            ).ravel()

        estimates.append(least_squares(residual, DEGRADED, method="lm").x)
    least = bound(quarter_car, DEGRADED[None])[0]
    scatter = np.std(estimates, axis=0, ddof=1)
    # a standard deviation from 100 draws is known to 1 / sqrt(200) = 7 %; three of those
    np.testing.assert_allclose(scatter / least, 1.0, atol=0.21)
    bias = np.mean(estimates, axis=0) - DEGRADED
    assert (np.abs(bias) < 4 * least / math.sqrt(n_draws)).all()


def test_cramer_rao_of_a_small_matrix_by_hand():
    information = np.array([[[4.0, 0.0], [0.0, 100.0]], [[2.0, 1.0], [1.0, 2.0]]])
    # inverses: diag(1/4, 1/100) and [[2, -1], [-1, 2]] / 3
    expected = [[0.5, 0.1], [math.sqrt(2 / 3), math.sqrt(2 / 3)]]
    np.testing.assert_allclose(cramer_rao(information), expected, rtol=1e-12)


def test_bounds_of_the_joint_protocol_are_those_of_the_design_page(task, quarter_car):
    ratios = task("joint", "all").sample(512, seed=0, stream=TEST)
    relative = 100 * np.median(bound(quarter_car, ratios) / ratios, axis=0)
    # design section 3 item 4, an independent prototype, two digits
    np.testing.assert_allclose(relative, [0.12, 1.8, 0.23, 0.28, 0.23], rtol=0.1)


@pytest.mark.parametrize(
    ("group", "expected"), [("primary", [0.09, 0.92]), ("secondary", [0.09, 0.11])]
)
def test_bounds_of_the_groups_are_those_of_the_design_page(task, quarter_car, group, expected):
    problem = task("multi_location", group)
    ratios = problem.sample(512, seed=0, stream=TEST)
    bounds = bound(quarter_car, ratios, parameters=problem.unknown)[:, :2]
    relative = 100 * np.median(bounds / ratios[:, problem.output_indices], axis=0)
    np.testing.assert_allclose(relative, expected, rtol=0.1)


# limit


def test_g_s_alone_cannot_tell_stiffness_from_mass(quarter_car):
    unknown = bound(
        quarter_car, DEGRADED[None], parameters=("k_s", "c_s", "M_s"), responses=("G_s",)
    )
    assert np.isinf(unknown).all()


def test_singular_vehicles_do_not_spoil_the_others():
    information = np.array([[[1.0, 1.0], [1.0, 1.0]], [[4.0, 0.0], [0.0, 4.0]]])
    found = cramer_rao(information)
    assert np.isinf(found[0]).all()
    assert found[1].tolist() == pytest.approx([0.5, 0.5])


# property


def test_information_of_both_curves_is_the_sum_of_each(quarter_car):
    parts = [
        fisher_information(OBSERVED.observer(quarter_car), DEGRADED[None], responses=responses)
        for responses in (("G_p",), ("G_s",), ("G_p", "G_s"))
    ]
    size = np.abs(parts[2]).max()
    np.testing.assert_allclose(parts[0] + parts[1], parts[2], rtol=1e-9, atol=1e-12 * size)


def test_information_of_many_vehicles_equals_one_by_one(task, quarter_car, monkeypatch):
    monkeypatch.setattr(information, "ROWS", 4)
    ratios = task("joint", "all").sample(6, seed=0, stream=TEST)  # more than one block
    together = fisher_information(OBSERVED.observer(quarter_car), ratios)
    assert together.shape == (6, 5, 5)
    for row in (0, 3, 4, 5):
        alone = fisher_information(OBSERVED.observer(quarter_car), ratios[row : row + 1])[0]
        np.testing.assert_allclose(together[row], alone, rtol=1e-9)


# best_possible


def best(quarter_car, problem, n=40):
    ratios = problem.sample(n, seed=0, stream=TEST)
    bounds = output_bounds(problem, OBSERVED.observer(quarter_car), ratios)
    return best_possible(problem, bounds, ratios), ratios


@pytest.mark.parametrize(
    ("name", "group", "changes"),
    [
        ("own_curve", "primary", {}),
        pytest.param("own_curve", "secondary", {"mass_known": True}, marks=pytest.mark.slow),
        pytest.param("multi_location", "primary", {}, marks=pytest.mark.slow),
        pytest.param("multi_location", "secondary", {}, marks=pytest.mark.slow),
        ("multi_location", "secondary", {"mass_known": True}),
        ("multi_location", "secondary", {"estimate_mass": True}),
        ("joint", "all", {}),
    ],
)
def test_best_possible_is_the_cramer_rao_bound_elsewhere(task, quarter_car, name, group, changes):
    problem = task(name, group, **changes)
    found, ratios = best(quarter_car, problem)
    unknown = list(problem.varied)
    if "mass_known" in changes:
        unknown.remove("M_s")
    bounds = bound(quarter_car, ratios, parameters=unknown, responses=problem.responses)
    assert tuple(found) == problem.outputs
    for output in problem.outputs:
        deviation = bounds[:, unknown.index(output)]
        actual = ratios[:, PARAMETERS.index(output)]
        # E|x| of a Gaussian is sqrt(2 / pi) of its standard deviation
        mape = 100 * np.mean(math.sqrt(2 / math.pi) * deviation / actual)
        assert found[output]["mape_percent"] == pytest.approx(mape)
        assert found[output]["rmse"] == pytest.approx(math.sqrt(np.mean(deviation**2)))
        assert 0 < found[output]["mape_percent"] < 10


@pytest.mark.parametrize(
    ("outputs", "varied"),
    [(["c_s"], ("c_s", "M_s")), (["k_p", "k_s"], ("k_s", "M_s")), (["k_p", "k_s", "c_s"], ())],
)
def test_best_possible_is_the_bound_of_what_varies(quarter_car, outputs, varied):
    """G_s alone with the mass unknown: separable unless springs and dampers vary together."""
    groups = {"one": {"outputs": outputs, "responses": ["G_s"], "peaks": ["secondary"]}}
    problem = shipped_protocol("own_curve", groups=groups, step=0.1).task("one")
    found, ratios = best(quarter_car, problem, n=3)
    assert tuple(found) == problem.outputs
    columns = [PARAMETERS.index(name) for name in varied]
    for name in outputs:
        if name in varied:
            every = [
                reference.fisher_by_differences(
                    quarter_car.vehicle, row, FREQUENCIES.numpy(), 34.0, columns, [1]
                )
                for row in ratios
            ]
            deviation = np.sqrt(np.linalg.inv(every)[:, 0, 0])
            mape = 100 * np.mean(math.sqrt(2 / math.pi) * deviation / ratios[:, columns[0]])
            assert found[name]["mape_percent"] == pytest.approx(mape, rel=1e-5)
            assert mape < 0.5
        else:  # G_s does not depend on it, or cannot separate it from the mass
            assert found[name] == {"mape_percent": math.inf, "rmse": math.inf}


def test_bounds_of_several_sets_are_those_of_the_vehicles_own(quarter_car, task):
    problem = task("paper", "I")
    observer = CurveSettings(snr_db=34.0).observer(quarter_car)
    ratios = problem.sample(8, seed=0, stream=TEST)
    bounds = output_bounds(problem, observer, ratios)
    frequencies_hz = observer.frequencies_hz.numpy()
    for row, bound in zip(ratios, bounds, strict=True):
        springs = (row[[0, 2]] != 1).any()
        columns = [0, 2, 4] if springs else [1, 3, 4]
        information = reference.fisher_by_differences(
            quarter_car.vehicle, row, frequencies_hz, 34.0, columns, [0, 1]
        )
        deviation = np.sqrt(np.linalg.inv(information)[0, 0])
        expected = [deviation, 0] if springs else [0, deviation]
        np.testing.assert_allclose(bound, expected, rtol=1e-4)
    assert 0 < (bounds == 0).mean() < 1
    anywhere = np.full((1, 5), 1.1)  # a vehicle of no set: everything is unknown
    expected = cramer_rao(fisher_information(observer, anywhere))[:, :2]
    np.testing.assert_allclose(output_bounds(problem, observer, anywhere), expected, rtol=1e-12)


def test_matrix_that_is_not_finite_has_no_bounds_and_harms_no_other():
    information = np.array([np.diag([4.0, 100.0])] * 4)
    information[1, 0, 1] = math.nan
    information[2, 1, 1] = math.inf
    bounds = cramer_rao(information)
    assert np.isinf(bounds[1:3]).all()
    np.testing.assert_allclose(bounds[[0, 3]], [[0.5, 0.1]] * 2, rtol=1e-12)
    assert np.isnan(information[1, 0, 1])


def test_output_bounds_are_infinite_where_nothing_can_be_told(task, quarter_car):
    ratios = np.ones((1, 5))
    secondary = task("own_curve", "secondary")
    bounds = output_bounds(secondary, OBSERVED.observer(quarter_car), ratios)
    assert np.isinf(bounds).all()
    known = task("own_curve", "secondary", mass_known=True)
    bounds = output_bounds(known, OBSERVED.observer(quarter_car), 2 * ratios)
    assert np.isfinite(bounds).all()
    np.testing.assert_allclose(relative_percent(known, bounds, 2 * ratios), 50 * bounds[0])
