"""The three-dimensional train of the tests, against closed forms and independent formulations."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import phasors
from rich_effects import EFFECTS, FAMILY, ROUGH
from rich_modes import Modes, simulate_modes, tones
from rich_motion import simulate
from rich_spectra import (
    SIDES,
    expected_estimates,
    noise_densities,
    process_spectra,
    responses_of,
    spectra,
)
from rich_structure import second_bending_shape
from rich_train import RichTrain
from rich_train_trips import true_ratios
from rich_vehicle import RichVehicle, bending_shape
from scipy.signal import csd
from trips_reference import pitching_matrices, pitching_numbers
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.vehicle import PARAMETERS, VerticalVehicle
from suspnet.vehicle.quantities import UNMEASURED

SPEED = 70.0
HEALTHY = np.ones(5)
WORN = np.array([0.8, 1.3, 1.2, 0.7, 1.1])
BINS = np.arange(0.5, 15.0, 0.25)
LINEAR = (*FAMILY, "second_bending")
SETTINGS = EstimateSettings(rates_hz=(1000.0, 500.0, 500.0)).bound(AM96)


def half_vehicle_responses(rich, ratios):
    """Return the responses of the vertical half vehicle of rich_vehicle.py, (n_freq, 3)."""
    system, train = rich.build(ratios), RichTrain()
    found = []
    for f, wheels in zip(BINS, train.phasors(BINS)[:, :, 0], strict=True):
        s = 2j * math.pi * f
        forced = (system.b_r + s * system.b_v) @ wheels
        x = np.linalg.solve(s * np.eye(len(system.a)) - system.a, forced)
        found.append((s * system.s @ x + s**2 * system.s_w @ wheels) / s**2)
    return np.array(found)


# reference


@pytest.mark.parametrize("speed", [30.0, 70.0])
def test_plain_train_moves_as_the_closed_form_of_the_vertical_vehicle(speed):
    numbers = {"bogie_mass": 1.1, "half_wheelbase": 0.95, "half_pivot_distance": 1.05}
    numbers |= {"bogie_gyration": 0.9, "body_gyration": 1.1}
    train = RichTrain(speed_m_per_s=speed, **numbers)
    found = responses_of(train, WORN, BINS)[..., 0]
    vehicle = VerticalVehicle(AM96, speed_m_per_s=speed)
    row = vehicle.complete(torch.as_tensor(np.array([WORN])))
    for name, value in numbers.items():
        row[0, len(PARAMETERS) + UNMEASURED.index(name)] = value
    g_p, g_s = vehicle.responses(row, torch.as_tensor(BINS))
    expected = torch.stack([torch.ones_like(g_p), g_p, g_p * g_s], dim=-1)[0].numpy()
    np.testing.assert_allclose(found[:, 0::2], expected, rtol=1e-10)
    np.testing.assert_allclose(found[:, 1::2], expected, rtol=1e-10)


def test_healthy_train_off_the_drawing_is_a_worn_one_of_the_drawing():
    factors = {"k_p": 0.8, "c_p": 1.3, "k_s": 1.2, "c_s": 0.7}
    train = replace(RichTrain(), **factors)
    same = VerticalVehicle(AM96, other_bogie="same")
    g_p, _ = same.responses(
        torch.as_tensor(np.array([[*factors.values(), 1.1]])), torch.as_tensor(BINS)
    )
    found = responses_of(train, [1, 1, 1, 1, 1.1], BINS)
    np.testing.assert_allclose(found[:, 2, 0], g_p[0].numpy(), rtol=1e-10)


@pytest.mark.parametrize("parts", [["bending"], ["bushings"], ["rubber"], ["contact"], "all"])
def test_vertical_train_moves_as_the_half_vehicle_written_by_hand(parts):
    parts = ["bending", "bushings", "rubber", "contact"] if parts == "all" else parts
    train = RichTrain(frozenset(parts), bending_hz=9.0)
    names = [{"bushings": "dampers"}.get(name, name) for name in parts]
    rich = RichVehicle(**dict.fromkeys(names, True))
    expected = half_vehicle_responses(rich, WORN)
    found = responses_of(train, WORN, BINS)[:, 0::2, 0]
    plain = responses_of(RichTrain(), WORN, BINS)[:, 0::2, 0]
    assert np.abs(plain / expected - 1).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("share", [-0.1, 0.3])
def test_sensor_on_the_arm_feels_the_frame_above_the_axle(share):
    train = RichTrain.scattered(6, {"roll", "axle_box_arm"}, sensor_on_arm=share)
    plain, found = (
        responses_of(replace(train, sensor_on_arm=one), WORN, BINS) for one in (0.0, share)
    )
    for side in (0, 1):  # the frame's sensor is above the axle
        expected = (1 - share) * plain[:, side] + share * plain[:, 2 + side]
        np.testing.assert_allclose(found[:, side], expected, rtol=1e-12)
    np.testing.assert_array_equal(found[:, 2:], plain[:, 2:])


def test_sensor_on_the_arm_is_the_part_of_the_family():
    train = RichTrain(sensor_on_arm=0.07)
    box, frame, body = responses_of(train, WORN, BINS, "mean")[..., 0].T
    vehicle = VerticalVehicle(AM96, parts=("axle_box_arm",))
    row = vehicle.complete(torch.as_tensor(np.array([WORN])))
    row[0, len(PARAMETERS) + UNMEASURED.index("arm_share")] = 0.07
    g_p, g_s = vehicle.responses(row, torch.as_tensor(BINS))
    np.testing.assert_allclose(frame / box, g_p[0].numpy(), rtol=1e-10)
    np.testing.assert_allclose(body / frame, g_s[0].numpy(), rtol=1e-10)


def test_guidance_and_longitudinal_parts_act_by_their_lever_arms():
    train = RichTrain(frozenset({"guidance", "longitudinal"}))
    n = pitching_numbers(AM96, WORN, SPEED)
    mass, damping, stiffness, input_damping, input_stiffness = pitching_matrices(n)
    for pitch in (3, 5):
        arms = np.zeros(6)
        arms[1], arms[pitch] = train.body_arm_m, train.bogie_arm_m  # of a side
        stiffness += train.longitudinal_n_per_m * np.outer(arms, arms)
        damping += train.longitudinal_ns_per_m * np.outer(arms, arms)
        # two axle boxes of a side
        stiffness[pitch, pitch] += 2 * train.guidance_n_per_m * train.guidance_height_m**2
        damping[pitch, pitch] += 2 * train.guidance_ns_per_m * train.guidance_height_m**2
    found = responses_of(train, WORN, BINS, "mean")[..., 0]
    wheels = train.phasors(BINS)[:, :, 0]
    for f, one, inputs in zip(BINS, found, wheels, strict=True):
        s = 2j * math.pi * f
        q = np.linalg.solve(
            mass * s**2 + damping * s + stiffness, (input_damping * s + input_stiffness) @ inputs
        )
        expected = [1.0, q[2] + n["a"] * q[3], q[0] + n["L"] * q[1]]
        np.testing.assert_allclose(one, expected, rtol=1e-9)
    own = train.guidance_n_per_m * 4 * train.guidance_height_m**2
    primary = 2 * AM96.primary_stiffness_n_per_m * AM96.half_wheelbase_m**2
    assert own / primary == pytest.approx(0.1, rel=0.02)


def test_modes_move_as_the_dynamic_stiffness_says():
    train, f = RichTrain.scattered(3, LINEAR).at(55.0), [0.9, 2.3, 5.1, 8.0]
    rate_hz, n = 500.0, 2000
    signals = simulate_modes(train.matrices(WORN), tones(train, f), rate_hz, n, 40_000)
    found = phasors(signals, np.arange(n) / rate_hz, f)
    expected = responses_of(train, WORN, f) @ np.exp(1j * np.arange(3))
    expected *= -2 * math.pi * np.array(f)[:, None] * 0.01
    error = np.abs(found / expected - 1)
    assert error[:, 2:].max() < 2e-6  # (2 pi 8 / 500)^4 / 90 = 1.1e-6
    # corners of the straight lines excite the axle boxes on the contact, at 190 Hz
    assert error.max() < 2e-4


def test_laws_act_on_both_sides_as_on_the_half_vehicle():
    train = RichTrain(frozenset({"rubber", "friction", "blow_off"}))
    rich = RichVehicle(dampers=True, rubber=True)
    track = tones(train, [1.4, 5.2, 9.0], velocity=0.2)
    found = simulate([WORN], train, [track], 500.0, 1500)[0]
    expected = simulate([WORN], rich, [track], 500.0, 1500)[0]
    for sensor, one in enumerate(found):
        size = np.abs(expected[sensor // 2]).max()
        # the step's error is another one: each damper is implicit in its own force
        np.testing.assert_allclose(one, expected[sensor // 2], rtol=0, atol=1e-4 * size)


@pytest.mark.slow
def test_spectra_are_those_of_a_long_trip():
    train, rate_hz = RichTrain.scattered(2), 200.0
    n, rng = 200_000, np.random.default_rng(0)
    lags = np.rint(train.behind_m / SPEED * rate_hz).astype(int)
    white = rng.standard_normal((3, n + lags.max()))
    inputs = np.concatenate([[w[lags.max() - lag :][:n] for lag in lags] for w in white])
    found = Modes(train.matrices(WORN), rate_hz).advance(np.pad(inputs, ((0, 0), (1, 1))))[0::2]
    f, measured = csd(found[:, None], found[None], rate_hz, nperseg=4096)
    band = (f > 0.5) & (f < 12)
    late = np.exp(-2j * np.pi * f[band, None] * lags / rate_hz)
    arrivals = np.kron(np.eye(3), np.ones((4, 1))) * np.tile(late, 3)[..., None]
    response = train.matrices(WORN).responses(f[band], arrivals)[:, 0::2]
    expected = np.einsum("fip,fjp->jif", response, response.conj()) * 2 / rate_hz  # E[conj(X) Y]
    size = np.sqrt(np.einsum("iif->if", expected).real)
    error = (measured[..., band] - expected) / (size[:, None] * size[None])
    assert np.sqrt(np.mean(np.abs(error) ** 2)) < 0.15  # 97 segments, overlapping
    assert np.abs(error.mean(axis=-1)).max() < 0.02


def test_second_bending_is_that_of_a_free_beam():
    x, h = np.linspace(-13.3, 13.3, 100_001, retstep=True)
    shape = second_bending_shape(x, 26.6)
    assert np.trapezoid(shape**2, x) == pytest.approx(26.6, rel=1e-6)
    for other in (np.ones_like(x), x, bending_shape(x, 26.6)):  # no pitch in it
        assert np.trapezoid(shape * other, x) == pytest.approx(0, abs=1e-6)
    curvature = (shape[2:] - 2 * shape[1:-1] + shape[:-2]) / h**2
    assert abs(curvature[-1]) < 1e-3 * np.abs(curvature).max()


def test_cross_level_and_alignment_are_the_german_ones():
    n = np.geomspace(0.003, 3, 50)
    omega, a, w_c, w_r, w_s = 2 * math.pi * n, 4.032e-7, 0.8246, 0.0206, 0.4380
    _, cross_level, alignment = process_spectra(RichTrain(frozenset({"roll"})))
    below = (omega**2 + w_r**2) * (omega**2 + w_c**2)
    # angle times half the distance of the wheels, per cycle/m
    expected = 2 * math.pi * a * w_c**2 * omega**2 / (below * (omega**2 + w_s**2))
    np.testing.assert_allclose(cross_level.density(n), expected, rtol=1e-9)
    np.testing.assert_allclose(
        alignment.density(n), 2 * math.pi * 2.119e-7 * w_c**2 / below, rtol=1e-9
    )


# limit


@pytest.mark.parametrize("effects", [(), LINEAR])
def test_rigid_motion_of_the_track_makes_no_force(effects):
    train = RichTrain.scattered(5, {*effects, "roll"})
    matrices, slow = train.matrices(WORN), np.array([1e-6])
    lifted = np.zeros((1, 12, 3))
    lifted[0, :4, 0] = lifted[0, 4:8, 1] = lifted[0, 8:, 2] = 1.0
    up, tilted, aside = matrices.responses(slow, lifted)[0].T
    np.testing.assert_allclose(up, 1.0, atol=1e-6)
    lever = train.sensor_half_m / train.contact_half_m
    np.testing.assert_allclose(tilted, lever * np.array([1, -1] * 3), atol=1e-6)
    np.testing.assert_allclose(aside, 0.0, atol=1e-6)


# property


@pytest.mark.representatives(1)
@pytest.mark.parametrize("speed", [30.0, 60.0, 90.0])
def test_every_train_is_stable_and_has_mass(speed):
    for seed in range(10):
        for effects in ((), LINEAR):
            matrices = RichTrain.scattered(seed, effects).at(speed).matrices(WORN)
            assert (matrices.mass > 0).all()
            a, _, _ = matrices.state_space()
            assert np.linalg.eigvals(a).real.max() < -0.2


def test_average_of_both_sides_does_not_see_roll():
    train = RichTrain.scattered(4)
    both, mean = (responses_of(train, WORN, BINS, sides) for sides in ("both", "mean"))
    assert np.abs(both[..., 1:]).max(axis=(0, 2)).min() > 0.5
    assert np.abs(mean[..., 1:]).max() < 1e-9
    vertical = replace(train, effects=train.effects - {"roll"})
    np.testing.assert_allclose(mean[..., 0], responses_of(vertical, WORN, BINS, "mean")[..., 0])
    one = replace(train, effects=train.effects | {"one_side"})
    assert np.abs(responses_of(one, WORN, BINS, "mean")[..., 1:]).max() > 1e-3


def test_pair_sees_about_the_mean_where_one_side_wears():
    train = RichTrain(frozenset({"one_side"}))
    both = list(true_ratios(train, WORN, "mean").values())
    np.testing.assert_allclose(both, [0.9, 1.15, 1.1, 0.85, 1.1])
    found = responses_of(train, WORN, BINS, "mean")
    expected = responses_of(RichTrain(), both, BINS, "mean")
    plain = responses_of(RichTrain(), [1, 1, 1, 1, 1.1], BINS, "mean")
    assert 0 < np.abs(found / expected - 1).max() < 0.1 * np.abs(plain / expected - 1).max()
    difference = responses_of(train, WORN, BINS, "difference")[:, 1:]
    assert np.abs(difference).max(axis=(0, 2)).min() > 0.05
    assert true_ratios(train, WORN, "left")["k_p"] == WORN[0]
    assert true_ratios(train, WORN, "right")["k_p"] == 1
    assert true_ratios(RichTrain(), WORN, "mean")["k_p"] == WORN[0]


@pytest.mark.parametrize("effect", [e for e in EFFECTS if e not in ("healthy", "drift", *ROUGH)])
def test_each_effect_changes_what_the_sensors_see(effect):
    train = RichTrain.scattered(1, {effect})
    track = tones(RichTrain(), [1.4, 5.2, 9.0], velocity=0.3)
    if train.is_linear:
        plain, found = (
            spectra(one, [WORN], BINS, "left") for one in (RichTrain.scattered(1, ()), train)
        )
    else:
        plain, found = (simulate([WORN], one, [track], 500.0, 1000) for one in (RichTrain(), train))
    change = np.abs(found / plain - 1)
    assert change.max() > 5e-3


@pytest.mark.slow
def test_expected_estimates_of_the_plain_train_are_those_of_training_curves():
    observer = SETTINGS.observer(VerticalVehicle(AM96))
    ours = expected_estimates(RichTrain(), WORN[None], SETTINGS, "left")
    theirs = observer.expected(torch.as_tensor(WORN[None]))
    torch.testing.assert_close(ours.cross, theirs.cross, rtol=1e-8, atol=0)
    torch.testing.assert_close(ours.auto, theirs.auto, rtol=2e-4, atol=0)  # grid of the noise
    mean, left = (noise_densities(RichTrain(), SETTINGS, sides) for sides in ("mean", "left"))
    np.testing.assert_allclose(mean, left / 2)


def test_spectra_of_both_sides_hold_every_combination():
    train = RichTrain.scattered(6)
    both = spectra(train, [WORN, HEALTHY], BINS, "both")
    assert both.shape == (2, 6, 6, len(BINS))
    for name in ("mean", "difference", "left"):
        mix = SIDES[name]
        expected = np.einsum("ia,vabf,jb->vijf", mix, both, mix)
        size = np.abs(both).max()
        np.testing.assert_allclose(
            spectra(train, [WORN, HEALTHY], BINS, name), expected, atol=1e-9 * size
        )
    roots = np.linalg.eigvalsh(np.moveaxis(both[0], -1, 0))
    assert (roots > -1e-9 * roots.max(axis=1, keepdims=True)).all()


# failure


def test_nonlinear_trains_have_no_spectra():
    with pytest.raises(ValueError, match="simulate trips"):
        spectra(RichTrain(frozenset({"friction"})), [WORN], BINS)
