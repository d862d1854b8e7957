"""True numbers of simulated vehicles: drawn about nominal with a seed of their own."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from vehicles import AM96

from suspnet.trains.simulation.true_vehicle import scattered, true_numbers
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle
from suspnet.vehicle.quantities import IN_MOTION, QUANTITIES, UNMEASURED, LogNormal

FAMILY = VerticalVehicle(AM96, parts=IN_MOTION[:-1], sensor_lateral_m=(1.0, 1.0, 1.0))
QUANTITY = {quantity.name: quantity for quantity in QUANTITIES}
ABSENT = [
    quantity.name
    for quantity in QUANTITIES
    if quantity.may_be_absent and quantity.median and quantity.part in FAMILY.parts
]
FREQUENCIES = torch.linspace(0.5, 15, 40).double()


def standardised(name, ratio):
    """Return how many deviations of its logarithm a number lies off its median."""
    quantity = QUANTITY[name]
    offset = float(quantity.may_be_absent)
    return math.log((ratio + offset) / (quantity.median + offset)) / quantity.deviation


# reference


def test_vehicle_moves_as_its_numbers_say():
    drawn = scattered(FAMILY, 1.0, seed=3)
    numbers = true_numbers(drawn)
    ratios = torch.ones(1, len(PARAMETERS) + len(UNMEASURED), dtype=torch.float64)
    for name, one in numbers.items():
        ratios[0, len(PARAMETERS) + UNMEASURED.index(name)] = one["ratio"]
    ratios[0, 0], five = 0.8, torch.tensor([[0.8, 1.0, 1.0, 1.0, 1.0]]).double()
    torch.testing.assert_close(
        drawn.channels(five, FREQUENCIES), FAMILY.channels(ratios, FREQUENCIES)
    )
    assert numbers["healthy_k_p"]["value"] == pytest.approx(
        numbers["healthy_k_p"]["ratio"] * AM96.primary_stiffness_n_per_m
    )
    assert numbers["healthy_k_p"]["unit"] == "N/m"
    assert numbers["bending_frequency"]["value"] == pytest.approx(
        10.0 * numbers["bending_frequency"]["ratio"]
    )


def test_numbers_are_as_far_off_as_their_priors_say():
    prior = LogNormal.prior(FAMILY.parts)
    ratios = [true_numbers(scattered(FAMILY, 1.0, seed)) for seed in range(40)]
    standard = np.array(
        [
            [standardised(name, one[name]["ratio"]) for one in ratios]
            for name in prior.names
            if not QUANTITY[name].may_be_absent
        ]
    )
    # 40 draws: standard error 0.16 of a mean, 0.11 of a deviation, four times that; a vehicle that
    # is drawn anew for a loss too large takes a little off
    assert np.abs(standard.mean(axis=1)).max() < 0.65
    assert np.abs(standard.std(axis=1) - 1).max() < 0.45
    correlation = np.corrcoef(standard) - np.eye(len(standard))
    assert np.abs(correlation).max() < 0.65
    for name in ABSENT:
        found = np.array([one[name]["ratio"] for one in ratios])
        # a draw below 0 is 0: of these normal numbers only the upper part is compared
        present = np.sort([standardised(name, ratio) for ratio in found])[-14:]
        least = -math.log(2) / QUANTITY[name].deviation
        below = np.mean(found == 0)
        assert below == pytest.approx(stats.norm.cdf(least), abs=0.19)
        expected = stats.norm.ppf((np.arange(26, 40) + 0.5) / 40)
        assert present.mean() == pytest.approx(expected.mean(), abs=0.65)


def test_what_may_be_absent_is_never_negative():
    drawn = [true_numbers(scattered(FAMILY, 3.0, seed)) for seed in range(12)]
    found = np.array([[numbers[name]["ratio"] for name in ABSENT] for numbers in drawn])
    assert (found >= 0).all()
    assert (found == 0).any(axis=0).all()
    assert (found > 0).any(axis=0).all()


def test_quarter_car_has_its_springs_and_dampers_scattered():
    drawn = scattered(QuarterCar(AM96), 1.0, seed=1)
    assert drawn.vehicle.body_mass_kg == AM96.body_mass_kg
    assert drawn.vehicle.bogie_mass_kg == AM96.bogie_mass_kg
    values = drawn.vehicle.healthy_values()
    assert [one["value"] for one in true_numbers(drawn).values()] == list(values[:4])
    assert all(a != b for a, b in zip(values[:4], AM96.healthy_values()[:4], strict=True))


# limit


def test_numbers_of_absent_parts_are_left_out():
    names = true_numbers(scattered(VerticalVehicle(AM96), 1.0, 0))
    assert "bending_frequency" not in names
    assert "speed" not in names
    assert "body_gyration" in names


# property


# failure


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, 5.1])
def test_scatter_out_of_range_is_rejected(value):
    with pytest.raises(ValueError, match="`scatter` must be a finite number >= 0 and <= 5, got"):
        scattered(FAMILY, value, 0)


def test_generator_without_numbers_is_rejected():
    with pytest.raises(TypeError, match="`scatter` needs a generator of suspnet, got object"):
        scattered(object(), 1.0, 0)
