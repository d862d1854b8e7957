"""The verdict for parts: naive evidence, one part and several, parts that cannot be told apart."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student_t
from test_bogie_fit import VEHICLE

from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.ground.parameters import COMPONENTS
from suspnet.trains.fits.bogie_fit import PartsEstimate, beyond_noise
from suspnet.trains.fits.bogie_misfit import WEAR
from suspnet.trains.fits.worn_parts import (
    ODDS,
    RARE,
    SHARED,
    STIFFER,
    USUAL,
    false_verdicts,
    least_losses,
    worn_parts,
)

PARTS = COMPONENTS[:-1]
DEVIATIONS = np.array([0.003 if name[0] == "k" else 0.01 for name in COMPONENTS])


def estimate_of(worn, covariance=None, seed=None):
    """Return an estimate of these ratios, with errors of its covariance where there is a seed."""
    covariance = np.diag(DEVIATIONS**2) if covariance is None else covariance
    logs = np.log([worn.get(name, 1.0) for name in COMPONENTS])
    if seed is not None:
        logs = np.random.default_rng(seed).multivariate_normal(logs, covariance)
    return PartsEstimate(np.exp(logs), covariance, 1.0, True, 0.9)


@pytest.mark.parametrize(("level", "side"), [(0.9, 1 - STIFFER["c"]), (1.2, STIFFER["c"])])
def test_odds_are_those_of_normal_densities(level, side):
    estimate = estimate_of({"c_p_axle2_left": level}, seed=1)
    (found,) = worn_parts(estimate)
    usual = np.diag([USUAL[name[0]] ** 2 for name in PARTS])
    for i, one in enumerate(PARTS):
        for k, other in enumerate(PARTS):
            if one[:3] == other[:3]:
                usual[i, k] += SHARED[one[0]] ** 2
    plain = estimate.covariance[:12, :12] + usual
    wider = plain.copy()
    j = PARTS.index("c_p_axle2_left")
    wider[j, j] += WEAR**2
    logs = np.log(estimate.values[:12])
    densities = [multivariate_normal(cov=cov).logpdf(logs) for cov in (wider, plain)]
    expected = 2 * side * math.exp(densities[0] - densities[1]) * RARE / (1 - RARE)
    assert found.odds == pytest.approx(expected, rel=1e-6)
    assert (found.names, found.is_named) == (("c_p_axle2_left",), True)


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("level", [0.3, 0.8, 1.25])
def test_each_part_is_named_alone(name, level):
    found = worn_parts(estimate_of({name: level}, seed=3))
    assert [one.names for one in found] == [(name,)]
    assert found[0].ratio == pytest.approx(level, rel=0.04)


def test_several_parts_are_named_the_most_certain_first():
    worn = {"k_s_left": 0.7, "c_p_axle1_right": 0.8, "c_s_right": 0.5}
    found = worn_parts(estimate_of(worn))
    assert {one.names[0] for one in found} == set(worn)
    assert all(one.is_named for one in found)
    assert [one.odds for one in found] == sorted((one.odds for one in found), reverse=True)
    every = worn_parts(estimate_of(dict.fromkeys(PARTS, 0.6)))
    assert {one.names[0] for one in every} == set(PARTS)


@pytest.mark.parametrize(
    "worn",
    [
        {"k_p_axle1_left": 0.66, "k_p_axle1_right": 0.52},
        {"k_p_axle1_left": 0.6, "k_p_axle1_right": 0.6},
        {"k_p_axle1_left": 0.6, "k_p_axle1_right": 0.6, "k_p_axle2_left": 0.6},
        {"c_s_left": 0.6, "c_s_right": 0.6},
        {"c_p_axle1_left": 0.7, "c_p_axle2_right": 0.72, "k_s_right": 0.9},
    ],
)
def test_parts_of_a_kind_that_have_not_worn_are_not_taken_along(worn):
    for seed in range(5):
        found = worn_parts(estimate_of(worn, seed=seed))
        assert {one.names for one in found} == {(name,) for name in worn}


def test_healthy_bogies_accuse_nothing():
    assert not any(worn_parts(estimate_of({}, seed=seed)) for seed in range(300))


def test_what_all_dampers_share_accuses_none_of_them():
    warmer = {name: 0.97 for name in PARTS if name.startswith("c_p")}
    assert worn_parts(estimate_of(warmer)) == []
    found = worn_parts(estimate_of(warmer | {"c_p_axle1_left": 0.9}))
    assert [one.names for one in found] == [("c_p_axle1_left",)]


def test_the_weaker_of_two_dampers_is_named():
    certain = np.diag(np.full(len(COMPONENTS), 0.002**2))
    weaker = worn_parts(estimate_of({"c_s_left": 0.95}, certain))
    assert [one.names for one in weaker] == [("c_s_left",)]
    stiffer = worn_parts(estimate_of({"c_s_left": 1.05}, certain))  # or the other is weaker
    assert {name for one in stiffer for name in one.names} == {"c_s_left", "c_s_right"}


def test_parts_that_trade_for_each_other_are_named_together():
    covariance = np.diag(DEVIATIONS**2)
    pair = [PARTS.index(name) for name in ("c_p_axle1_left", "c_p_axle1_right")]
    # their sum is known to 1 %, their difference not at all
    covariance[np.ix_(pair, pair)] = 0.01**2 * np.ones((2, 2)) / 4
    covariance[np.ix_(pair, pair)] += 0.3**2 * np.array([[1, -1], [-1, 1]])
    logs = np.zeros(len(COMPONENTS))
    logs[pair] = -0.1
    found = worn_parts(PartsEstimate(np.exp(logs), covariance, 1.0, True, 0.9))
    assert set(found[0].names) == {"c_p_axle1_left", "c_p_axle1_right"}
    assert not found[0].is_named
    assert found[0].odds > ODDS


ONE_SIDE = replace(
    VEHICLE, sensors=tuple(f"{place}_left" for place in ("axle_box_axle1", "frame_axle1", "body"))
)


@pytest.mark.parametrize(
    ("misfit", "vehicle", "most"),
    [(1.0, VEHICLE, 0.2), (3.0, VEHICLE, 0.2), (1.0, ONE_SIDE, 0.2), (1.2, ONE_SIDE, 1.0)],
)
def test_a_part_is_named_from_its_least_loss_on(misfit, vehicle, most):
    noise = tuple(map(tuple, np.zeros((12, 12))))
    scatter = HealthyScatter((1e-3, 5e-3, 1e-3, 2e-3), (0.0,) * 4, 6, noise)
    bogie = CommissionedBogie(vehicle, None, np.ones(6), misfit, True, scatter)
    losses = least_losses(bogie)
    for i, name in enumerate(COMPONENTS[:-1]):
        for loss, is_named in ((losses[name] + 2e-3, True), (losses[name] - 3e-3, False)):
            logs = np.zeros(13)
            logs[i] = np.log(1 - loss)
            # the trip shows it too small, by what the interval allows for its wear
            logs[i] += 1.6449 * np.sqrt(beyond_noise(bogie, logs, 0.9)[1][i])
            found = beyond_noise(bogie, logs, 0.9)
            estimate = PartsEstimate(np.exp(logs), found[0], 1.0, True, 0.9, by_own_wear=found[1])
            worn = worn_parts(estimate)
            assert ([part.names for part in worn] == [(name,)]) == is_named
    assert losses["k_p_axle1_left"] < losses["c_p_axle1_left"] < most
    never = replace(scatter, own=(2.0,) * 4)
    assert set(least_losses(replace(bogie, scatter=never)).values()) == {1.0}


def scattering(own, n_trips):
    """Return a bogie of which each part scatters by `own` beyond noise of 0.5 %."""
    noise = tuple(map(tuple, (0.005**2 * np.eye(12)).tolist()))
    scatter = HealthyScatter((own,) * 4, (0.0,) * 4, n_trips, noise)
    return CommissionedBogie(VEHICLE, None, np.ones(n_trips), 1.0, True, scatter)


STUDENT = student_t.ppf(0.95, 2) / norm.ppf(0.95)


def test_healthy_trips_accuse_as_often_as_draws_of_them():
    bogie, n = scattering(0.05, 3), 600
    rng = np.random.default_rng(7)
    spread = np.sqrt(2 / rng.chisquare(2, (n, 1)))
    logs = 0.005 * rng.standard_normal((n, 12)) + 0.05 * spread * rng.standard_normal((n, 12))
    covariance = (0.005**2 + STUDENT**2 * 0.05**2) * np.eye(13)
    accused = [
        bool(worn_parts(PartsEstimate(np.exp(np.append(e, 0.0)), covariance, 1.0, True, 0.9)))
        for e in logs
    ]
    share = np.mean(accused)
    assert 0.02 < share < 0.5
    scatter = math.sqrt(share * (1 - share) / n)
    assert false_verdicts(bogie) == pytest.approx(share, abs=4 * scatter)
    assert false_verdicts(bogie) == false_verdicts(bogie) != false_verdicts(bogie, seed=1)


def test_fewer_healthy_trips_accuse_more_often():
    rates = [false_verdicts(scattering(0.02, n)) for n in (3, 6, 20)]
    assert rates[0] > rates[1] > rates[2]
    assert false_verdicts(scattering(0.0, 6)) < 1e-4
