"""Responses of the pitching vehicle against a 6 x 6 system written for heave and pitch angles."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
import trips_reference
from scipy import stats
from scipy.linalg import eigh
from vehicles import AM96, MEDIANS

from suspnet.vehicle import QuarterCar, VerticalVehicle
from suspnet.vehicle.quantities import PARTS, QUANTITIES, UNMEASURED, LogNormal
from suspnet.vehicle.vehicle import GEOMETRY

FREQUENCIES = torch.tensor([0.05, 0.4, 0.9, 1.31, 1.9, 3.3, 5.4, 7.7, 11.0, 19.0]).double()
HEALTHY = torch.ones(1, 5, dtype=torch.float64)
RNG = np.random.default_rng(7)
FIVE = torch.as_tensor(RNG.uniform(0.5, 2.0, (3, 5)))
ALL = torch.as_tensor(RNG.uniform(0.7, 1.4, (3, 5 + len(UNMEASURED))))
ALL[:, 15:] = 1.0  # healthy values and parts are those of test_family.py
N_ALL = 5 + len(UNMEASURED)
SIDES = ("leading", "trailing")
PLACES = list(itertools.product(SIDES, SIDES, ("axle", "centre"), (0.0, 1.7)))


def naive(generator, ratios, frequencies_hz):
    """Return G_p and G_s of one vehicle from the 6 x 6 system, (2, n_freq)."""
    numbers = trips_reference.pitching_numbers(
        generator.vehicle, ratios, generator.speed_m_per_s, generator.other_bogie
    )
    place = (generator.bogie, generator.axle, generator.frame_sensor, generator.body_sensor_m)
    return np.array(
        [trips_reference.pitching_transfer(numbers, f, *place) for f in frequencies_hz.tolist()]
    ).T


def stacked(generator, ratios, frequencies_hz=FREQUENCIES):
    return torch.stack(generator.responses(ratios, frequencies_hz), dim=1)


# reference


@pytest.mark.parametrize(("bogie", "axle", "frame_sensor", "body_sensor_m"), PLACES)
@pytest.mark.parametrize("ratios", [FIVE, ALL], ids=["five", "all"])
def test_responses_solve_newtons_equations(bogie, axle, frame_sensor, body_sensor_m, ratios):
    generator = VerticalVehicle(
        AM96,
        speed_m_per_s=52.0,
        bogie=bogie,
        axle=axle,
        frame_sensor=frame_sensor,
        body_sensor_m=body_sensor_m,
    )
    found = stacked(generator, ratios).numpy()
    for row, vehicle_ratios in enumerate(ratios.tolist()):
        expected = naive(generator, vehicle_ratios, FREQUENCIES)
        # the closed solution and the solver lose a few digits where terms nearly cancel
        np.testing.assert_allclose(found[row], expected, rtol=1e-9)


@pytest.mark.parametrize("other_bogie", ["healthy", "same"])
@pytest.mark.parametrize("bogie", SIDES)
def test_other_bogie_is_healthy_or_the_same_unless_columns_say_otherwise(other_bogie, bogie):
    generator = VerticalVehicle(AM96, bogie=bogie, other_bogie=other_bogie)
    ratios = FIVE[:1].clone()
    np.testing.assert_allclose(
        stacked(generator, ratios)[0].numpy(), naive(generator, ratios[0], FREQUENCIES), rtol=1e-9
    )
    # columns that are given win over `other_bogie`
    rows = stacked(generator, ALL[:1])[0].numpy()
    np.testing.assert_allclose(rows, naive(generator, ALL[0], FREQUENCIES), rtol=1e-9)
    apart = stacked(VerticalVehicle(AM96, bogie=bogie, other_bogie="same"), ratios)[0]
    healthy = stacked(VerticalVehicle(AM96, bogie=bogie), ratios)[0]
    assert (apart / healthy - 1).abs().max() > 0.01


@pytest.mark.parametrize("bogie", SIDES)
def test_eigenfrequencies_are_those_of_newtons_matrices(bogie):
    ratios = ALL[1]
    system = VerticalVehicle(AM96, bogie=bogie).motion_system(ratios)
    numbers = trips_reference.pitching_numbers(AM96, ratios, 70.0)
    mass, damping, stiffness, _, _ = trips_reference.pitching_matrices(numbers, bogie)
    for found, expected in ((system.stiffness, stiffness), (system.damping, damping)):
        np.testing.assert_allclose(
            eigh(found, system.mass, eigvals_only=True),
            eigh(expected, mass, eigvals_only=True),
            rtol=1e-10,
        )


def test_eigenfrequencies_of_the_symmetric_vehicle_in_closed_form():
    system = VerticalVehicle(AM96).motion_system(torch.ones(5))
    found = np.sqrt(eigh(system.stiffness, system.mass, eigvals_only=True)) / math.tau
    k_p, k_s, m_p, m_s = 1.30e6, 0.69e6, 1725.0, 6300.0
    expected = [math.sqrt(k_p / m_p) / (0.8 / 1.35) / math.tau] * 2  # both bogies pitch alone
    # heave, then pitch: a body of M_s or M_s (rho / L)^2 on a bogie of M_p
    for body in (m_s, m_s * (7.8 / 9.5) ** 2):
        squares = np.roots([m_p * body, -(m_p * k_s + body * (k_p + k_s)), k_p * k_s])
        expected += (np.sqrt(squares) / math.tau).tolist()
    np.testing.assert_allclose(found, sorted(expected), rtol=1e-10)


# limit


@pytest.mark.parametrize("bogie", SIDES)
@pytest.mark.parametrize("frame_sensor", ["axle", "centre"])
def test_locked_pitch_and_wheelsets_in_step_leave_the_quarter_car(bogie, frame_sensor):
    locked = dataclasses.replace(AM96, bogie_gyration_m=1e12, body_gyration_m=1e12)
    generator = VerticalVehicle(
        locked, speed_m_per_s=1e18, bogie=bogie, frame_sensor=frame_sensor, other_bogie="same"
    )
    expected = torch.stack(QuarterCar(AM96).responses(FIVE, FREQUENCIES), dim=1)
    torch.testing.assert_close(stacked(generator, FIVE), expected, rtol=1e-11, atol=0)


# property


@pytest.mark.parametrize("frame_sensor", ["axle", "centre"])
def test_vehicle_seen_from_the_rear_is_its_mirror_image_if_nothing_is_delayed(frame_sensor):
    options = {"speed_m_per_s": 1e18, "frame_sensor": frame_sensor}
    front = VerticalVehicle(AM96, body_sensor_m=1.3, **options)
    rear = VerticalVehicle(AM96, bogie="trailing", axle="trailing", body_sensor_m=-1.3, **options)
    torch.testing.assert_close(stacked(rear, FIVE), stacked(front, FIVE), rtol=1e-11, atol=0)
    other = VerticalVehicle(AM96, bogie="trailing", body_sensor_m=1.3, **options)
    assert (stacked(other, FIVE) / stacked(front, FIVE) - 1).abs().max() > 0.01


@pytest.mark.parametrize(
    ("bogie", "axle", "expected"),
    [
        ("leading", "leading", (0.0, 2.7, 19.0, 21.7)),
        ("leading", "trailing", (0.0, -2.7, 19.0, 16.3)),
        ("trailing", "leading", (0.0, 2.7, -19.0, -16.3)),
        ("trailing", "trailing", (0.0, -2.7, -19.0, -21.7)),
    ],
)
def test_wheelsets_run_behind_the_measured_one_by_their_distance(bogie, axle, expected):
    system = VerticalVehicle(AM96, bogie=bogie, axle=axle).motion_system(torch.ones(5))
    np.testing.assert_allclose(system.behind_m, expected, atol=1e-12)


# sample_unmeasured


def test_samples_have_the_distribution_asked_for_and_are_nominal_elsewhere():
    widths = {"speed": 0.02, "body_gyration": 0.1, "other_c_s": 0.5}
    ratios = torch.as_tensor(np.random.default_rng(1).uniform(0.5, 2.0, (4000, 5)))
    samples = VerticalVehicle(AM96, distribution=widths).sample_unmeasured(ratios, seed=3)
    assert samples.shape == (4000, 5 + len(UNMEASURED))
    assert torch.equal(samples[:, :5], ratios)
    for name, column in zip(UNMEASURED, samples[:, 5:].T, strict=True):
        width = widths.get(name, 0.0)
        if width == 0:
            assert (column == MEDIANS[name]).all()
            continue
        # standard errors of mean and deviation of 4000 draws
        assert float(column.log().mean()) == pytest.approx(0, abs=4 * width / math.sqrt(4000))
        assert float(column.log().std()) == pytest.approx(width, rel=4 / math.sqrt(8000))


def test_samples_follow_a_given_mean_and_covariance():
    covariance = np.array([[0.04, 0.03, 0.0], [0.03, 0.09, -0.01], [0.0, -0.01, 0.01]])
    names, mean = ("healthy_k_p", "bogie_gyration", "half_wheelbase"), (0.2, -0.1, 0.0)
    belief = LogNormal(names, mean, covariance)
    generator = VerticalVehicle(AM96, distribution=belief)
    samples = generator.sample_unmeasured(torch.ones(20_000, 5), seed=0)
    logs = samples[:, [5 + UNMEASURED.index(name) for name in names]].log().numpy()
    np.testing.assert_allclose(logs.mean(axis=0), mean, atol=4 * 0.3 / math.sqrt(20_000))
    np.testing.assert_allclose(np.cov(logs.T), covariance, atol=4 * 0.09 * math.sqrt(2 / 20_000))
    # five columns stand for the median
    median = VerticalVehicle(AM96).complete(torch.ones(1, 5)).to(torch.float64)
    median[0, [5 + UNMEASURED.index(name) for name in names]] = torch.tensor(
        mean, dtype=torch.float64
    ).exp()
    assert torch.equal(stacked(generator, torch.ones(1, 5)), stacked(generator, median))


def test_prior_is_about_nominal_and_reaches_0_of_what_may_be_absent():
    generator = VerticalVehicle(AM96, parts=PARTS, distribution="prior")
    prior = generator.distribution
    medians = [MEDIANS[name] for name in prior.names]
    np.testing.assert_allclose(prior.median, medians, rtol=1e-12, atol=1e-15)
    assert set(medians) == {0.0, 1.0}
    expected = torch.tensor([list(MEDIANS.values())] * 3, dtype=torch.float64)
    torch.testing.assert_close(generator.complete(FIVE)[:, 5:], expected)
    samples = generator.sample_unmeasured(torch.ones(4000, 5), seed=2)
    for name, offset in zip(prior.names, prior.offsets, strict=True):
        column = samples[:, 5 + UNMEASURED.index(name)].numpy()
        quantity = next(one for one in QUANTITIES if one.name == name)
        assert offset == float(quantity.may_be_absent)
        assert (column > -offset).all()
        # of normal numbers; 4000 draws give a share to 0.8 %, four of those
        log_median = math.log(1 + quantity.median)
        below = stats.norm.cdf(-log_median / quantity.deviation) if offset else 0.0
        assert (column < 0).mean() == pytest.approx(below, abs=0.032 if offset else 0.0)
        assert (np.abs(column).min() < 0.01) >= bool(offset)
    assert prior.offsets.sum() == 14


@pytest.mark.parametrize("n_deviations", [-2.0, -1.0, 0.0, 0.5, 3.0])
def test_quantiles_and_draws_are_those_of_the_formula(n_deviations):
    names = ("rubber_loss", "bogie_gyration", "guidance_damping")
    mean, covariance = (0.3, -0.2, 0.7), ((0.09, 0.02, 0.0), (0.02, 0.16, 0.03), (0.0, 0.03, 0.25))
    belief = LogNormal(names, mean, covariance)
    found = belief.quantile(n_deviations)
    for i, offset in enumerate((1.0, 0.0, 1.0)):
        deviation = math.sqrt(covariance[i][i])
        expected = math.exp(mean[i] + n_deviations * deviation) - offset
        assert found[i] == pytest.approx(expected, abs=1e-12)
        assert belief.median[i] == pytest.approx(math.exp(mean[i]) - offset, abs=1e-12)
    standard = np.array([[0.3, -1.0, n_deviations], [1.0, 2.0, -0.5]])
    rows = belief.ratios(standard)
    for row, z in zip(rows, standard, strict=True):
        logs = [mean[i] + sum(belief.factor[i, j] * z[j] for j in range(3)) for i in range(3)]
        expected = [math.exp(log) - offset for log, offset in zip(logs, (1, 0, 1), strict=True)]
        np.testing.assert_allclose(row, expected, rtol=1e-12, atol=1e-12)


def test_the_prior_is_of_the_parts_that_there_are():
    for parts in ((), ("bending",), PARTS):
        belief = VerticalVehicle(AM96, parts=parts, distribution="prior").distribution
        expected = {q.name: q.deviation for q in QUANTITIES if q.part in ("", *parts)}
        expected = {name: value for name, value in expected.items() if value}
        assert dict(zip(belief.names, belief.deviations, strict=True)) == pytest.approx(expected)


def test_a_sixth_column_is_the_speed():
    given = torch.cat([FIVE, torch.tensor([[0.8], [1.0], [1.3]], dtype=torch.float64)], dim=1)
    found = stacked(VerticalVehicle(AM96, speed_m_per_s=50.0), given)
    for row, speed in enumerate((40.0, 50.0, 65.0)):
        alone = stacked(VerticalVehicle(AM96, speed_m_per_s=speed), FIVE[row : row + 1])
        torch.testing.assert_close(found[row : row + 1], alone, rtol=1e-10, atol=0)
    assert torch.equal(VerticalVehicle(AM96).sample_unmeasured(given, 0)[:, :6], given)
    cars = [torch.stack(QuarterCar(AM96).responses(rows, FREQUENCIES)) for rows in (given, FIVE)]
    assert torch.equal(*cars)


# failure


@pytest.mark.parametrize("name", GEOMETRY)
def test_vehicle_without_geometry_is_rejected(name):
    bare = dataclasses.replace(AM96, **{name: None})
    with pytest.raises(ValueError, match=rf"'am96' lacks \['{name}'\].*generator=quarter_car"):
        VerticalVehicle(bare)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bogie": "middle"}, r"`bogie` must be one of .*'middle'"),
        ({"speed_m_per_s": 0.0}, r"`speed_m_per_s` must be a finite number > 0, got 0.0"),
        ({"distribution": {"k_p": 0.1}}, r"`distribution` must be named as in .*\['k_p'\]"),
        (
            {"distribution": {"speed": 10.0}},
            r"`distribution.speed` must be a finite number >= 0 and < 10, got 10.0",
        ),
        ({"distribution": "posterior"}, r"`distribution` must be one of .*'posterior'"),
        ({"parts": ("wings",)}, r"`parts` must be one of .*'wings'"),
        ({"nominal": {"speed": 3.0}}, r"`nominal` must be named as in .*\['speed'\]"),
        ({"nominal": {"rubber_loss": 0.0}}, r"`nominal.rubber_loss` must be a finite number > 0"),
        ({"sensor_lateral_m": (1.0, 1.0)}, r"`sensor_lateral_m` must be three places"),
        ({"sensor_lateral_m": (1.0, 1.0, 3.0)}, r"`sensor_lateral_m\[2\]` must be a finite"),
        ({"body_sensor_m": math.nan}, r"`body_sensor_m` must be a finite number"),
        ({"device": "cuda:99"}, r"`device`='cuda:99' cannot be used here"),
    ],
)
def test_settings_out_of_range_are_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        VerticalVehicle(AM96, **changes)


@pytest.mark.parametrize("value", [-1.0, -1.5, math.nan, math.inf])
def test_ratios_of_what_may_be_absent_must_lie_above_minus_one(value):
    ratios = torch.ones(3, N_ALL)
    ratios[1, 5 + UNMEASURED.index("rubber_share")] = value
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        VerticalVehicle(AM96, parts=("rubber",)).magnitudes(ratios, FREQUENCIES)
