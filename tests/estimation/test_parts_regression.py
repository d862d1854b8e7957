"""Parts of a bogie by regression: what is drawn, what is read, and the fit that starts there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_bogie_fit import BINS, NOISE, VEHICLE, drawn, trip

from suspnet.estimation.bogie_fit import CommissionedBogie
from suspnet.estimation.parts_regression import drawn_wear, train_parts, training_trips
from suspnet.ground.parameters import COMPONENTS, REVERSE

KNOWN = replace(VEHICLE, distribution={"healthy_k_s": 0.01})
BOGIE = CommissionedBogie(KNOWN, NOISE, np.ones(3), 1.0, True)
WORN = {"k_p_axle2_left": 0.6, "c_s_right": 0.5}


def row(worn):
    """Return ratios (1, 13) of a trip."""
    ratios = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
    for name, ratio in (worn | {"M_s": 1.05}).items():
        ratios[0, COMPONENTS.index(name)] = ratio
    return ratios


@pytest.fixture(scope="module")
def healthy():
    return [trip(drawn(KNOWN, row({}), seed), 70.0) for seed in range(3)]


@pytest.fixture(scope="module")
def regression(healthy):
    return train_parts(BOGIE, healthy, n_trips=400)


# property


def test_half_of_the_trips_have_all_parts_worn_and_the_others_one_or_two():
    logs = np.log(drawn_wear(400, np.random.default_rng(0)))
    assert logs.shape == (400, len(COMPONENTS))
    assert np.log(0.4) <= logs[:200, :-1].min() <= logs[:200, :-1].max() <= np.log(1.6)
    beyond = np.sum(np.abs(logs[200:, :-1]) > 0.25, axis=1)
    assert beyond.max() <= 2
    assert logs.min() < np.log(0.1)  # a part that has failed


def test_drawn_trips_are_those_of_their_seed(healthy):
    first, same, other = (training_trips(BOGIE, healthy, 160, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.inputs, same.inputs)
    assert not np.allclose(first.ratios, other.ratios)
    assert np.mean(first.inputs**2) == pytest.approx(1)


def test_worn_parts_are_read(regression):
    found = regression(trip(drawn(KNOWN, row(WORN), 50), 70.0))
    errors = np.log(found / row(WORN)[0].numpy())
    springs = np.array([name.startswith("k") for name in COMPONENTS])
    assert np.abs(errors[springs]).max() < 0.1
    assert np.abs(errors).max() < 0.4


@pytest.mark.parametrize("start", ["regression", "far away"])
def test_the_fit_ends_where_that_from_the_healthy_vehicle_does(regression, start):
    one = trip(drawn(KNOWN, row(WORN), 50), 70.0)
    ratios = regression(one) if start == "regression" else np.tile([0.4, 2.0], 7)[:13]
    expected, found = BOGIE.estimate(one), BOGIE.estimate(one, start=ratios)
    assert found.converged
    np.testing.assert_allclose(found.values, expected.values, rtol=5e-3)
    assert found.misfit == pytest.approx(expected.misfit, rel=1e-3)


def test_ratios_beyond_those_of_the_training_are_its_limits(regression):
    spectra = drawn(KNOWN, row(dict.fromkeys(COMPONENTS[:-1], 5.0)), 50)
    found = regression(trip(spectra, 70.0))
    assert 0.0799 < found.min() <= found.max() < 2.0001


def test_trips_unlike_those_of_the_training_are_not_read(regression):
    one = trip(drawn(KNOWN, row({}), 5), 70.0)
    assert regression.reads(one)
    assert regression.reads(replace(one, speed_m_per_s=70.5))
    assert not regression.reads(replace(one, speed_m_per_s=75.0))
    assert not regression.reads(replace(one, direction=REVERSE))
    assert not regression.reads(replace(one, frequencies_hz=BINS + 0.1))


# error


def test_fewer_trips_than_features_are_refused(healthy):
    with pytest.raises(ValueError, match="150 components were asked for, 100 curves of 270"):
        train_parts(BOGIE, healthy, n_trips=100)
