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

from suspnet.dynamics import PARAMETERS, QuarterCar, ResponseGenerator, VerticalVehicle
from suspnet.dynamics.quantities import PARTS, QUANTITIES, UNMEASURED, LogNormal
from suspnet.dynamics.vehicle import GEOMETRY

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
        stacked(generator, ratios)[0].numpy(),
        naive(generator, ratios[0], FREQUENCIES),
        rtol=1e-9,
    )
    # columns that are given win over `other_bogie`
    rows = stacked(generator, ALL[:1])[0].numpy()
    np.testing.assert_allclose(rows, naive(generator, ALL[0], FREQUENCIES), rtol=1e-9)
    apart = stacked(VerticalVehicle(AM96, bogie=bogie, other_bogie="same"), ratios)[0]
    healthy = stacked(VerticalVehicle(AM96, bogie=bogie), ratios)[0]
    assert (apart / healthy - 1).abs().max() > 0.01


def test_magnitudes_are_absolute_values_of_responses():
    generator = VerticalVehicle(AM96)
    curves = generator.magnitudes(FIVE, FREQUENCIES)
    assert curves.shape == (3, 2, len(FREQUENCIES))
    assert curves.dtype == torch.float64
    assert curves.min() > 0
    torch.testing.assert_close(curves, stacked(generator, FIVE).abs(), rtol=1e-12, atol=0)


@pytest.mark.parametrize(("bogie", "axle", "frame_sensor", "body_sensor_m"), PLACES)
@pytest.mark.parametrize("ratios", [FIVE[0], ALL[0]], ids=["five", "all"])
def test_motion_system_has_the_same_frequency_response(
    bogie, axle, frame_sensor, body_sensor_m, ratios
):
    generator = VerticalVehicle(
        AM96,
        bogie=bogie,
        axle=axle,
        frame_sensor=frame_sensor,
        body_sensor_m=body_sensor_m,
        other_bogie="same",
    )
    system = generator.motion_system(ratios)
    speed = 70.0 * (float(ratios[5]) if len(ratios) > 5 else 1.0)
    a, b, c, d = system.state_space()
    assert d.shape == (2, 4)
    assert not d.any()
    g_p, g_s = stacked(generator, ratios[None])[0].numpy()
    for column, f in enumerate(FREQUENCIES.tolist()):
        s = 2j * math.pi * f
        wheels = np.exp(-s * np.array(system.behind_m) / speed)
        frame, body = c @ np.linalg.solve(s * np.eye(12) - a, b @ wheels)
        assert frame == pytest.approx(g_p[column], rel=1e-8)
        assert body == pytest.approx(g_p[column] * g_s[column], rel=1e-8)


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


def test_nearly_undamped_response_peaks_at_the_eigenfrequencies():
    model = VerticalVehicle(AM96.degraded(c_p=0.05, c_s=0.02), other_bogie="same")
    system = model.motion_system(torch.ones(5))
    modes = np.sqrt(eigh(system.stiffness, system.mass, eigvals_only=True)) / math.tau
    frequencies = torch.linspace(1.0, 8.0, 70_001, dtype=torch.float64)
    curve = model.magnitudes(HEALTHY, frequencies)[0, 0].numpy()
    inner = curve[1:-1]
    top = np.flatnonzero((inner > curve[:-2]) & (inner > curve[2:])) + 1
    # two modes of the body and their neighbours overlap, the peaks move by some 1e-3
    for peak in frequencies[top].numpy():
        assert np.abs(modes / peak - 1).min() < 2e-3
    assert len(top) >= 3


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


@pytest.mark.parametrize("bogie", SIDES)
def test_gain_at_zero_frequency_is_one(bogie):
    generator = VerticalVehicle(AM96, bogie=bogie, body_sensor_m=2.0)
    for ratios in (FIVE, ALL):
        gains = stacked(generator, ratios, torch.tensor([0.0]))
        torch.testing.assert_close(gains, torch.ones_like(gains), rtol=1e-12, atol=1e-12)
    # the delays change it in first order of frequency: 1e-6 Hz * 20 m / (70 m/s)
    near = stacked(generator, FIVE, torch.tensor([1e-6]))
    assert (near - 1).abs().max() < 1e-5


# property


@pytest.mark.parametrize("frame_sensor", ["axle", "centre"])
def test_vehicle_seen_from_the_rear_is_its_mirror_image_if_nothing_is_delayed(frame_sensor):
    options = {"speed_m_per_s": 1e18, "frame_sensor": frame_sensor}
    front = VerticalVehicle(AM96, body_sensor_m=1.3, **options)
    rear = VerticalVehicle(AM96, bogie="trailing", axle="trailing", body_sensor_m=-1.3, **options)
    torch.testing.assert_close(stacked(rear, FIVE), stacked(front, FIVE), rtol=1e-11, atol=0)
    other = VerticalVehicle(AM96, bogie="trailing", body_sensor_m=1.3, **options)
    assert (stacked(other, FIVE) / stacked(front, FIVE) - 1).abs().max() > 0.01


def test_undamped_vehicle_seen_from_the_rear_runs_backwards_in_time():
    undamped = FIVE.clone()
    undamped[:, [1, 3]] = 1e-13
    columns = torch.ones(3, 5 + len(UNMEASURED))
    columns[:, :5], columns[:, 6:10] = undamped, undamped[:, :4]
    front = stacked(VerticalVehicle(AM96), columns)
    rear = stacked(VerticalVehicle(AM96, bogie="trailing", axle="trailing"), columns)
    assert front.imag.abs().max() > 0.1
    torch.testing.assert_close(rear, front.conj(), rtol=1e-7, atol=0)


@pytest.mark.parametrize("bogie", SIDES)
def test_sensor_at_the_centre_sees_the_two_axles_a_wheelbase_apart(bogie):
    front, back = (
        stacked(VerticalVehicle(AM96, bogie=bogie, axle=axle, frame_sensor="centre"), FIVE)
        for axle in SIDES
    )
    delay = torch.exp(-2j * math.pi * FREQUENCIES * 2 * 1.35 / 70.0)
    torch.testing.assert_close(front[:, 0], delay * back[:, 0], rtol=1e-10, atol=0)
    torch.testing.assert_close(front[:, 1], back[:, 1], rtol=1e-10, atol=0)


@pytest.mark.parametrize("bogie", SIDES)
def test_mean_over_both_axles_is_the_centre(bogie):
    front, back = (stacked(VerticalVehicle(AM96, bogie=bogie, axle=axle), FIVE) for axle in SIDES)
    centre = stacked(VerticalVehicle(AM96, bogie=bogie, frame_sensor="centre"), FIVE)
    delay = torch.exp(-2j * math.pi * FREQUENCIES * 2 * 1.35 / 70.0)
    mean = 0.5 * (front[:, 0] + delay * back[:, 0])
    torch.testing.assert_close(mean, centre[:, 0], rtol=1e-10, atol=0)
    assert (front[:, 0] / centre[:, 0] - 1).abs().max() > 0.01


def test_scaling_masses_dampers_and_springs_together_changes_nothing():
    names = ("bogie_mass_kg", "body_mass_kg")
    names += ("primary_stiffness_n_per_m", "secondary_stiffness_n_per_m")
    names += ("primary_damping_ns_per_m", "secondary_damping_ns_per_m")
    heavier = dataclasses.replace(AM96, **{name: 3.0 * getattr(AM96, name) for name in names})
    torch.testing.assert_close(
        stacked(VerticalVehicle(heavier), ALL),
        stacked(VerticalVehicle(AM96), ALL),
        rtol=1e-11,
        atol=0,
    )


def test_scaling_all_lengths_and_the_speed_together_changes_nothing():
    larger = dataclasses.replace(AM96, **{name: 2.5 * getattr(AM96, name) for name in GEOMETRY})
    before = VerticalVehicle(AM96, speed_m_per_s=40.0, body_sensor_m=1.0)
    after = VerticalVehicle(larger, speed_m_per_s=100.0, body_sensor_m=2.5)
    torch.testing.assert_close(stacked(after, ALL), stacked(before, ALL), rtol=1e-11, atol=0)


@pytest.mark.parametrize("bogie", SIDES)
@pytest.mark.parametrize("ratios", [FIVE[0], ALL[0]], ids=["five", "all"])
def test_matrices_of_the_motion_are_symmetric_and_positive(bogie, ratios):
    system = VerticalVehicle(AM96, bogie=bogie).motion_system(ratios)
    for matrix in (system.mass, system.damping, system.stiffness):
        assert matrix.shape == (6, 6)
        np.testing.assert_array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix).min() > 1.0  # N/m, N s/m, kg


def test_track_that_rises_as_a_whole_lifts_everything_alike():
    system = VerticalVehicle(AM96, body_sensor_m=3.0).motion_system(ALL[0])
    for inner, outer in (
        (system.stiffness, system.input_stiffness),
        (system.damping, system.input_damping),
    ):
        rigid = np.linalg.solve(inner, outer @ np.ones(4))
        np.testing.assert_allclose(rigid, [1, 0, 1, 0, 1, 0], atol=1e-12)
        np.testing.assert_allclose(system.sensors @ rigid, [1, 1], rtol=1e-12)


@pytest.mark.parametrize(
    ("bogie", "axle", "expected"),
    [
        ("leading", "leading", (0.0, 2.7, 19.0, 21.7)),
        ("leading", "trailing", (-2.7, 0.0, 16.3, 19.0)),
        ("trailing", "leading", (0.0, 2.7, -19.0, -16.3)),
        ("trailing", "trailing", (-2.7, 0.0, -21.7, -19.0)),
    ],
)
def test_wheelsets_run_behind_the_measured_one_by_their_distance(bogie, axle, expected):
    system = VerticalVehicle(AM96, bogie=bogie, axle=axle).motion_system(torch.ones(5))
    np.testing.assert_allclose(system.behind_m, expected, atol=1e-12)


def test_batch_equals_one_by_one():
    generator = VerticalVehicle(AM96)
    alone = torch.cat([stacked(generator, row[None]) for row in ALL])
    torch.testing.assert_close(stacked(generator, ALL), alone, rtol=1e-13, atol=0)


def test_ratios_are_left_untouched_and_float32_gives_float64():
    ratios = torch.full((2, 5), 0.75)
    curves = VerticalVehicle(AM96).magnitudes(ratios, FREQUENCIES.float())
    assert curves.dtype == torch.float64
    assert torch.equal(ratios, torch.full((2, 5), 0.75))


def test_vertical_vehicle_is_a_response_generator():
    assert isinstance(VerticalVehicle(AM96), ResponseGenerator)


def test_every_parameter_changes_the_responses():
    generator = VerticalVehicle(AM96)
    n_columns = 5 + len(UNMEASURED)
    before = stacked(generator, torch.ones(1, n_columns))
    own = {quantity.name for quantity in QUANTITIES if not quantity.part}
    for column, name in enumerate((*PARAMETERS, *UNMEASURED)):
        if name in UNMEASURED and name not in own:
            continue
        ratios = torch.ones(1, n_columns)
        ratios[0, column] = 1.1
        change = (stacked(generator, ratios) / before - 1).abs().max()
        assert change > 1e-3, name


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


def test_columns_are_drawn_independently():
    generator = VerticalVehicle(AM96, distribution=dict.fromkeys(UNMEASURED, 0.2))
    samples = generator.sample_unmeasured(torch.ones(4000, 5), seed=0)[:, 5:]
    offsets = torch.tensor([float(quantity.may_be_absent) for quantity in QUANTITIES])
    assert offsets.sum() == 14
    correlation = np.corrcoef((samples + offsets).log().numpy().T) - np.eye(len(UNMEASURED))
    assert np.abs(correlation).max() < 5.0 / math.sqrt(4000)


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


def test_words_count_the_uncertain_numbers():
    assert "taken as known" in VerticalVehicle(AM96).assumptions()
    words = VerticalVehicle(AM96, distribution={"speed": 0.1, "half_wheelbase": 0.05}).assumptions()
    assert "; 2 of its numbers are uncertain" in words
    assert "geometry" not in words


def test_samples_are_those_of_their_seed():
    generator = VerticalVehicle(AM96, distribution={"speed": 0.1})
    ratios = torch.ones(5, 5)
    first = generator.sample_unmeasured(ratios, seed=4)
    assert torch.equal(first, generator.sample_unmeasured(ratios, seed=4))
    assert not torch.equal(first, generator.sample_unmeasured(ratios, seed=5))


def test_same_keeps_the_other_bogie_equal():
    generator = VerticalVehicle(AM96, other_bogie="same", distribution={"speed": 0.1})
    samples = generator.sample_unmeasured(FIVE, seed=0)
    assert torch.equal(samples[:, 6:10], FIVE[:, :4])
    assert not (samples[:, 5] == 1).any()


def test_a_sixth_column_is_the_speed():
    given = torch.cat([FIVE, torch.tensor([[0.8], [1.0], [1.3]], dtype=torch.float64)], dim=1)
    found = stacked(VerticalVehicle(AM96, speed_m_per_s=50.0), given)
    for row, speed in enumerate((40.0, 50.0, 65.0)):
        alone = stacked(VerticalVehicle(AM96, speed_m_per_s=speed), FIVE[row : row + 1])
        torch.testing.assert_close(found[row : row + 1], alone, rtol=1e-10, atol=0)
    assert torch.equal(VerticalVehicle(AM96).sample_unmeasured(given, 0)[:, :6], given)
    cars = [torch.stack(QuarterCar(AM96).responses(rows, FREQUENCIES)) for rows in (given, FIVE)]
    assert torch.equal(*cars)


def test_nothing_uncertain_gives_the_responses_of_five_columns():
    for other_bogie in ("healthy", "same"):
        generator = VerticalVehicle(AM96, other_bogie=other_bogie)
        samples = generator.sample_unmeasured(FIVE, seed=0)
        assert torch.equal(stacked(generator, samples), stacked(generator, FIVE))
    quarter_car = QuarterCar(AM96)
    assert quarter_car.sample_unmeasured(FIVE, 0) is FIVE


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
        ({"axle": "both"}, r"`axle` must be one of .*'both'"),
        ({"frame_sensor": "roof"}, r"`frame_sensor` must be one of .*'roof'"),
        ({"other_bogie": "broken"}, r"`other_bogie` must be one of .*'broken'"),
        ({"speed_m_per_s": 0.0}, r"`speed_m_per_s` must be a finite number > 0, got 0.0"),
        ({"speed_m_per_s": -1.0}, r"`speed_m_per_s` must be a finite number > 0"),
        ({"speed_m_per_s": math.nan}, r"`speed_m_per_s` must be a finite number > 0"),
        ({"speed_m_per_s": math.inf}, r"`speed_m_per_s` must be a finite number > 0"),
        ({"distribution": {"k_p": 0.1}}, r"`distribution` must be named as in .*\['k_p'\]"),
        (
            {"distribution": {"speed": 10.0}},
            r"`distribution.speed` must be a finite number >= 0 and < 10, got 10.0",
        ),
        (
            {"distribution": {"speed": -0.1}},
            r"`distribution.speed` must be a finite number >= 0 and < 10",
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


@pytest.mark.parametrize("value", [True, "fast", None])
def test_settings_that_are_no_numbers_are_rejected(value):
    with pytest.raises(TypeError, match="`speed_m_per_s` must be a finite number > 0"):
        VerticalVehicle(AM96, speed_m_per_s=value)
    with pytest.raises(
        TypeError, match=r"`distribution\.speed` must be a finite number >= 0 and < 10"
    ):
        VerticalVehicle(AM96, distribution={"speed": value})


@pytest.mark.parametrize(
    ("n_columns", "expected"), [(4, 5), (7, N_ALL), (N_ALL - 1, N_ALL), (N_ALL + 1, N_ALL)]
)
def test_ratios_of_the_wrong_shape_are_rejected(n_columns, expected):
    with pytest.raises(ValueError, match=rf"must have shape \(n_vehicles, {expected}\)"):
        VerticalVehicle(AM96).responses(torch.ones(2, n_columns), FREQUENCIES)


@pytest.mark.parametrize("value", [0.0, -0.5, math.nan, math.inf])
@pytest.mark.parametrize("column", [2, 12, 5 + UNMEASURED.index("bending_damping")])
def test_ratios_that_are_not_positive_and_finite_are_rejected(value, column):
    ratios = torch.ones(3, N_ALL)
    ratios[1, column] = value
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        VerticalVehicle(AM96).magnitudes(ratios, FREQUENCIES)


@pytest.mark.parametrize("value", [-1.0, -1.5, math.nan, math.inf])
def test_ratios_of_what_may_be_absent_must_lie_above_minus_one(value):
    ratios = torch.ones(3, N_ALL)
    ratios[1, 5 + UNMEASURED.index("rubber_share")] = value
    with pytest.raises(ValueError, match="`ratios` must be positive and finite"):
        VerticalVehicle(AM96, parts=("rubber",)).magnitudes(ratios, FREQUENCIES)
