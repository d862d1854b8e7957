"""Degradation along the mileage, trip by trip."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trips_reference
import yaml

from suspnet.trains.simulation.fleet import Scenario
from suspnet.vehicle import PARAMETERS
from suspnet.vehicle.quantities import QUANTITIES
from suspnet.vehicle.vertical_motion import secondary_element

SHIPPED = yaml.safe_load(
    (Path(__file__).parents[2] / "configs" / "scenarios.yaml").read_text(encoding="utf-8")
)

MILEAGE = np.linspace(0, 300_000, 61)
FADE = {"from_km": 100_000.0, "to_km": 200_000.0, "ratio": 0.6}
STEP = {"from_km": 150_000.0, "to_km": 150_000.0, "ratio": 1.5}


def steady(changes, **options):
    return Scenario("test", changes, **({"mass_low": 1.0, "mass_high": 1.0} | options))


# reference


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("change", [FADE, STEP])
def test_ratios_follow_the_mileage(name, change):
    ratios = steady({name: change}).ratios(MILEAGE, seed=0)
    expected = trips_reference.degraded_ratios(MILEAGE, {name: change}, PARAMETERS)
    assert ratios.shape == (61, 5)
    assert expected.min() < 1 or expected.max() > 1
    np.testing.assert_allclose(ratios, expected, rtol=1e-12)


def test_blocked_choke_has_the_stiffness_of_the_air_spring_with_no_flow():
    nominal = {one.name: one.nominal for one in QUANTITIES if one.part == "air_spring"}
    numbers = {
        name: torch.tensor(x, dtype=torch.float64)
        for name, x in ({"k_s": 1.0, "c_s": 1e9} | nominal).items()
    }
    blocked = secondary_element(numbers, "", ["air_spring"])
    stiffness = blocked.at(2 * math.pi * torch.linspace(0.5, 10, 20, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(stiffness, SHIPPED["blocked_choke"]["changes"]["k_s"]["ratio"])


def test_emergency_spring_alone_is_stiffer_than_in_series_with_the_air_spring():
    air, emergency = 1.0, 5.0
    in_series = 1 / (1 / air + 1 / emergency)
    changes = SHIPPED["failed_air_spring"]["changes"]
    assert changes["k_s"]["ratio"] == pytest.approx(emergency / in_series)


# limit


# property


def test_pay_load_and_spread_are_uniform_in_their_ranges():
    n = 20_000
    ratios = Scenario("test", spread=0.4).ratios(np.zeros(n), seed=0)
    low = np.array([0.6] * 4 + [0.9])
    high = np.array([1.4] * 4 + [1.2])
    uniform = (ratios - low) / (high - low)
    assert (uniform >= 0).all()
    assert (uniform <= 1).all()
    # standard errors: 0.29 / sqrt(n) = 0.002, about 0.0006 of the variance 1 / 12
    np.testing.assert_allclose(uniform.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(uniform.var(axis=0), 1 / 12, atol=0.003)
    assert np.abs(np.corrcoef(uniform.T) - np.eye(5)).max() < 5 / math.sqrt(n)


# failure


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spread": 1.0}, "`scenario.spread` must be a finite number >= 0 and < 1, got 1.0"),
        ({"spread": -0.1}, "`scenario.spread` must be a finite number >= 0 and < 1"),
        ({"spread": math.nan}, "`scenario.spread` must be a finite number >= 0 and < 1"),
        ({"mass_low": 0.0}, "`scenario.mass_low` must be a finite number > 0, got 0.0"),
        ({"mass_low": 1.3}, "need mass_low <= mass_high, got 1.3, 1.2"),
        ({"changes": {"k_x": FADE}}, "`changes` must be named as in .*'k_x'"),
        ({"changes": {"k_p": {"ratio": 0.5}}}, r"'k_p' needs from_km, to_km, ratio: \['ratio'\]"),
        ({"changes": {"k_p": FADE | {"per": 1}}}, "'k_p' needs from_km, to_km, ratio"),
        ({"changes": {"k_p": FADE | {"to_km": 9e4}}}, "k_p`: need from_km <= to_km, got .*90000"),
        (
            {"changes": {"k_p": FADE | {"ratio": 0.0}}},
            "k_p.ratio` must be a finite number > 0, got 0",
        ),
        ({"effects": ["wheels"]}, "scenario.effects` must be one of .*track.*, got 'wheels'"),
    ],
)
def test_impossible_scenarios_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        Scenario("test", **options)
