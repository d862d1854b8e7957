"""The train of tests/blind_train.py against hand formulae, symmetry and stepping in time."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from blind_train import (
    COMPONENTS,
    PAIRS,
    Motion,
    Run,
    Track,
    Train,
    bending_shape,
    record,
    track_inputs,
    write_trip,
)

import suspnet
from suspnet.ground import parameters

MEAN, CROSS, ASIDE = (np.tile(row, 4) for row in np.eye(3))
STIFF = {"bending_hz": 2e3, "contact_k": 1e13}


def scattered():
    return replace(Train.scattered(3, torsion=True), secondary_damper_y_m=0.2, cone_lift=1.0)


def response(motion, inputs, frequency_hz):
    """Return the sensors' accelerations to inputs (12,) [m]."""
    return motion.response(np.asarray(inputs, complex)[:, None], np.array([frequency_hz]))[:, 0]


def rigid_motions(train):
    """Return sway, bounce, roll and yaw of the whole vehicle about the first height of an axle."""
    frame, body = -train.primary_z_m, train.secondary_z_m - train.primary_z_m - train.body_z_m
    p, x = train.half_pivot_m, Motion(train, 70.0).axle_x()
    found = np.zeros((4, Motion.n_coordinates))
    places = [(0, 0.0, body), (6, p, frame), (12, -p, frame)]
    for first, ahead, z in places:
        found[0, first], found[1, first + 1], found[3, first] = 1, 1, ahead
        found[2, [first, first + 2]], found[3, first + 4] = [-z, 1], 1
    for axle, ahead in enumerate(x):
        first = 18 + 4 * axle
        found[0, first], found[1, first + 1] = 1, 1
        found[2, first + 2], found[3, [first, first + 3]] = 1, [ahead, 1]
    return found


@pytest.mark.parametrize("seed", range(3))
def test_springs_and_dampers_resist_no_rigid_motion(seed):
    train = replace(Train.scattered(seed), contact_k=0.0, creep_x=0.0, creep_y=0.0, gravity_k=0.0)
    motion = Motion(train, 70.0)
    rigid = rigid_motions(train)
    assert np.abs(motion.stiffness @ rigid.T).max() < 1e-6
    assert np.abs(motion.damping @ rigid.T).max() < 1e-6
    assert np.abs(np.array(motion.rows) @ rigid.T).max() < 1e-12


@pytest.mark.parametrize("bounce", [True, False])
def test_vertical_modes_are_those_of_two_masses(bounce):
    train = replace(
        Train(**STIFF),
        primary_c=np.full((2, 4), 1e-3),
        secondary_c=np.full((2, 2), 1e-3),
        secondary_kxy=0.0,
        yaw_damper_c=1e-3,
    )
    lever = 1.0 if bounce else train.half_pivot_m  # frames of a pitching body move against it
    inertia = train.body_kg * (1 if bounce else train.body_gyration_m[1] ** 2)
    k_s, k_p = 4 * 0.69e6, 8 * 0.65e6
    stiffness = np.array([[k_s * lever**2, -k_s * lever], [-k_s * lever, k_s + k_p]])
    squares = scipy.linalg.eigvalsh(stiffness, np.diag([inertia, 2 * train.frame_kg]))
    poles = np.linalg.eigvals(Motion(train, 70.0).a)  # it hunts without yaw dampers
    for omega in np.sqrt(squares):
        assert np.abs(poles.imag - omega).min() < 1e-4 * omega


@pytest.mark.parametrize("frequency", [0.7, 3.0, 11.0, 24.0])
def test_symmetric_vehicle_separates_sides(frequency):
    motion = Motion(Train(torsion_hz=35.0), 70.0)
    rng = np.random.default_rng(0)
    each = np.repeat(rng.standard_normal(4) + 1j, 3)
    lifted = response(motion, each * MEAN, frequency)
    np.testing.assert_allclose(lifted[::2], lifted[1::2], rtol=1e-7)
    for antisymmetric in (CROSS, ASIDE):
        rolled = response(motion, each * antisymmetric, frequency)
        np.testing.assert_allclose(rolled[::2], -rolled[1::2], rtol=1e-7)


@pytest.mark.parametrize("frequency", [0.4, 1.3, 9.0, 35.0])
def test_response_is_that_of_complex_stiffness(frequency):
    motion = Motion(scattered(), 62.0)
    s = 2j * np.pi * frequency
    dynamic = s**2 * motion.mass + s * motion.damping + motion.stiffness
    for row, k, c in zip(motion.rows, motion.series_k, motion.series_c, strict=True):
        dynamic = dynamic + s * c * k / (k + s * c) * np.outer(row, row)
    inputs = np.random.default_rng(1).standard_normal(12)
    moved = np.linalg.solve(dynamic, motion.forcing @ inputs)
    expected = s**2 * motion.sensors() @ moved
    np.testing.assert_allclose(response(motion, inputs, frequency), expected, rtol=1e-7)


def test_response_is_that_of_stepping_in_time():
    motion, rate, frequency = Motion(scattered(), 70.0), 2000.0, 8.0
    system = (motion.a, motion.b, motion.c, motion.d)
    a, b, c, d, _ = scipy.signal.cont2discrete(system, 1 / rate, "foh")
    fed = d * np.sinc(frequency / rate) ** 2  # what straight lines between samples leave of a sine
    times = np.arange(round(25 * rate)) / rate
    inputs = np.random.default_rng(2).standard_normal(12)
    state, found = np.zeros(len(a)), np.empty((6, len(times)))
    swell = np.minimum(1, times / 5) ** 2 * np.sin(2 * np.pi * frequency * times)
    for i, height in enumerate(swell):
        found[:, i] = c @ state + fed @ inputs * height
        state = a @ state + b @ inputs * height
    last = times >= 20
    wave = np.exp(-2j * np.pi * frequency * times[last])
    amplitudes = 2j * (found[:, last] @ wave) / last.sum()
    expected = response(motion, inputs, frequency)
    assert np.abs(amplitudes - expected).max() < 1e-3 * np.abs(expected).max()


def test_wheelset_runs_in_waves_of_klingel():
    train = replace(Train(), primary_kx=0.0, primary_ky=0.0, gravity_k=0.0)
    train = replace(train, wheelset_gyration_m=0.01)
    speed = 2.0
    expected = speed * np.sqrt(train.conicity / (train.half_gauge_m * train.wheel_radius_m))
    poles = np.linalg.eigvals(Motion(train, speed).a)
    assert np.abs(poles - 1j * expected).min() < 0.02 * expected


@pytest.mark.parametrize("frequency", [0.8, 5.0, 20.0])
def test_reverse_is_the_turned_vehicle_forward(frequency):
    train = scattered()
    backward, turned = Motion(train, -66.0), Motion(train.turned(), 66.0)
    a, p = train.half_wheelbase_m, train.half_pivot_m
    points = [turned.wheelset(3, y, 0.0)[2] for y in (-1, 1)]
    points += [turned.frame(1, -a, y, 0.0)[2] for y in (-1, 1)]
    points += [turned.body(-p, y, 0.0)[2] for y in (-1, 1)]
    n = turned.n_coordinates
    turned.c = np.array(points) @ turned.a[n : 2 * n]
    turned.d = np.array(points) @ turned.b[n : 2 * n]
    inputs = np.random.default_rng(4).standard_normal((4, 3))
    expected = response(turned, (inputs[::-1] * [1, -1, -1]).ravel(), frequency)
    np.testing.assert_allclose(response(backward, inputs.ravel(), frequency), expected, rtol=1e-6)
    np.testing.assert_allclose(backward.delays(), turned.delays()[::-1], rtol=1e-12)


def test_bending_mode_is_that_of_a_free_beam():
    x = np.linspace(-10, 10, 20001)
    shape, slope = bending_shape(x, 20.0)
    assert np.mean(shape**2) == pytest.approx(1, abs=1e-3)
    assert np.mean(shape) == pytest.approx(0, abs=1e-3)
    assert 10 - abs(x[np.abs(shape).argmin()]) == pytest.approx(0.224 * 20, rel=2e-3)
    np.testing.assert_allclose(np.gradient(shape, x)[1:-1], slope[1:-1], atol=1e-6)


def test_track_has_its_density_and_is_delayed():
    motion, track = Motion(Train(), 70.0), Track(cross_share=0.3, alignment_share=0.4)
    run, n = Run(), 2**18
    inputs, _ = track_inputs(motion, track, run, n, np.random.default_rng(0))
    heights = np.fft.irfft(inputs, n)
    accelerations = np.diff(heights, 2, axis=1)  # whitens the spectrum: no leakage
    frequencies, density = scipy.signal.welch(accelerations[:3], run.rate_hz, nperseg=4096)
    kept = (frequencies > 0.5) & (frequencies < 80)
    expected = track.densities(frequencies[kept], 70.0)
    expected *= (2 * np.sin(np.pi * frequencies[kept] / run.rate_hz)) ** 4
    ratio = density[:, kept] / expected
    np.testing.assert_allclose(ratio.mean(axis=1), 1, atol=0.01)
    assert ratio.std() < 0.15
    behind = inputs[3] * np.exp(2j * np.pi * np.fft.rfftfreq(n, 1 / run.rate_hz) * 2.7 / 70.0)
    np.testing.assert_allclose(behind, inputs[0], atol=1e-9 * np.abs(inputs[0]).max())


def test_ratios_scale_the_part_of_their_name():
    train = Train.scattered(2)
    assert COMPONENTS == parameters.COMPONENTS
    for name, kind, place in [
        ("k_p_axle1_right", "primary_k", (0, 1)),
        ("c_p_axle2_left", "primary_c", (0, 2)),
        ("k_s_right", "secondary_k", (0, 1)),
        ("c_s_left", "secondary_c", (0, 0)),
    ]:
        ratios = np.ones(13)
        ratios[COMPONENTS.index(name)] = 0.5
        worn = train.worn(ratios)
        for other in ("primary_k", "primary_c", "secondary_k", "secondary_c"):
            ratio = getattr(worn, other) / getattr(train, other)
            expected = np.ones_like(ratio)
            if other == kind:
                expected[place] = 0.5
            np.testing.assert_allclose(ratio, expected)
    heavy = train.worn([1.0] * 12 + [1.25])
    assert heavy.body_kg == pytest.approx(1.25 * train.body_kg)
    assert heavy.body_kg * heavy.bending_hz**2 == pytest.approx(train.body_kg * train.bending_hz**2)


def test_trip_is_read_as_it_was_written(tmp_path):
    run = Run(minutes=2.0, direction="reverse", speed_m_per_s=61.5)
    train = replace(Train.scattered(0), sensitivity=np.linspace(0.98, 1.02, 6))
    signals = record(train, Track(), run, 7)
    manifest = suspnet.read_manifest(write_trip(tmp_path, "trip", signals, run))
    suspnet.load_recording(manifest, 100.0)
    assert signals.shape == (len(PAIRS), 24000)
    clean = record(train, Track(), replace(run, noise=False), 7)
    noise = signals - clean
    np.testing.assert_allclose(noise.std(axis=1) / clean.std(axis=1), 10**-1.7, rtol=0.02)
    ideal = record(replace(train, sensitivity=np.ones(6)), Track(), replace(run, noise=False), 7)
    np.testing.assert_allclose(clean / ideal, train.sensitivity[:, None] + 0 * ideal, rtol=1e-6)
