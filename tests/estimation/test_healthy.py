"""Healthy values in SI units: of the vehicle file, or of the posterior of commissioning."""

import math

import numpy as np
import pytest
from vehicles import AM96

from suspnet.estimation.estimate import Estimate, Flags, HealthyValues
from suspnet.ground.parameters import COMPONENTS, SIDES
from suspnet.vehicle import PARAMETERS, QuarterCar, SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

POSTERIOR = LogNormal(
    ("healthy_c_p", "body_gyration", "healthy_k_s"),
    (math.log(0.5), 0.1, math.log(1.2)),
    ((0.04, 0.0, 0.001), (0.0, 0.01, 0.0), (0.001, 0.0, 0.0001)),
)


def commissioned():
    return VerticalVehicle(AM96, distribution=POSTERIOR)


@pytest.mark.parametrize("generator", [QuarterCar(AM96), VerticalVehicle(AM96)])
def test_nominal_healthy_values_are_those_of_the_vehicle_file(generator):
    found = HealthyValues.of(generator, PARAMETERS)
    np.testing.assert_array_equal(found.values, AM96.healthy_values())
    assert (found.deviations == 0).all()
    assert found.units == ("N/m", "N s/m", "N/m", "N s/m", "kg")


def test_commissioned_healthy_values_are_the_posterior():
    found = HealthyValues.of(commissioned(), ("k_s", "c_p", "M_s"))
    k_s, c_p, mass = (AM96.healthy_values()[i] for i in (2, 1, 4))
    np.testing.assert_allclose(found.values, [1.2 * k_s, 0.5 * c_p, mass])
    np.testing.assert_allclose(found.deviations, [0.01, 0.2, 0.0])


def test_primary_parts_are_those_of_one_axle_box():
    vehicle = SpatialVehicle(AM96, sensors=("body_left", "body_right"))
    healthy = dict(zip(COMPONENTS, HealthyValues.of(vehicle, COMPONENTS).values, strict=True))
    k_p, c_p, k_s, c_s, mass = AM96.healthy_values()
    for corner in ("axle1_left", "axle1_right", "axle2_left", "axle2_right"):
        assert (healthy[f"k_p_{corner}"], healthy[f"c_p_{corner}"]) == (k_p / 2, c_p / 2)
    assert [healthy[f"{k}_{s}"] for k in ("k_s", "c_s") for s in SIDES] == [k_s, k_s, c_s, c_s]
    assert healthy["M_s"] == mass


def test_si_interval_holds_the_uncertainty_of_the_healthy_value():
    healthy = HealthyValues.of(commissioned(), ("c_p", "M_s"))
    ratios, half = np.array([[0.8, 1.1]]), np.array([[0.3, 0.02]])
    found = Estimate(
        ("c_p", "M_s"),
        ratios,
        ratios * np.exp(-half),
        ratios * np.exp(half),
        0.9,
        Flags.none(1),
        healthy,
    )
    values, low, high = found.si()
    np.testing.assert_allclose(values, ratios * healthy.values)
    expected = [math.hypot(0.3, 1.6448536 * 0.2), 0.02]
    np.testing.assert_allclose(np.log(high / values)[0], expected, rtol=1e-6)
    np.testing.assert_allclose(np.log(values / low)[0], expected, rtol=1e-6)
    told = found.to_dict()["estimates"][0]["parameters"]["c_p"]["si"]
    assert told == {"value": values[0, 0], "low": low[0, 0], "high": high[0, 0], "unit": "N s/m"}


def test_estimate_without_healthy_values_has_none_in_si_units():
    one = np.ones((1, 1))
    bare = Estimate(("k_p",), one, one, one, 0.9, Flags.none(1))
    assert "si" not in bare.to_dict()["estimates"][0]["parameters"]["k_p"]
    with pytest.raises(ValueError, match="has no healthy values"):
        bare.si()


def test_level_is_checked():
    with pytest.raises(ValueError, match="level"):
        HealthyValues.of(commissioned(), ("k_s",)).half_widths(1.0)
