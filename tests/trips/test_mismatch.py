"""The richer simulator of the tests, against suspnet's, closed forms and an independent solver."""

import math

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import trip_fixtures
from reference import phasors
from rich_motion import BergFriction, simulate
from rich_trips import SENSORS, drawn_ratios, off_ratios, write_rich_trips
from rich_vehicle import RichVehicle, bending_shape, build
from scipy.integrate import solve_ivp
from trips_reference import pitching_matrices, pitching_numbers, pitching_transfer
from vehicles import AM96

from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.simulation import Fleet, Scenario, Simulation, write_fleet
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.motion import SampledMotion

SPEED = 70.0
LAGS_S = np.array([0.0, 2.7, 19.0, 21.7]) / SPEED
HEALTHY = np.ones(5)
DEGRADED = np.array([0.8, 1.3, 1.2, 0.7, 1.1])
NEVER = {"blow_off_m_per_s": 1e6}
BENT = RichVehicle(bending=True)


def waves(frequencies_hz, velocity=0.01):
    """Return a track of cosine waves of the same velocity, [m/s]."""
    omega = 2 * math.pi * np.array(frequencies_hz)[:, None, None]
    start = np.arange(len(omega))[:, None, None]

    def under_wheels(times):
        wave = velocity / omega * np.exp(1j * (omega * (times - LAGS_S[:, None]) + start))
        return np.stack([(wave * factor).real.sum(0) for factor in (1, 1j * omega, -(omega**2))])

    return under_wheels


def rough(n_samples, rate_hz, seed=0):
    """Return a track whose accelerations are white noise, linear between samples, from rest."""
    a = np.random.default_rng(seed).standard_normal((4, n_samples + 1))
    h = 1 / rate_hz
    v = np.pad(np.cumsum(h * (a[:, :-1] + a[:, 1:]) / 2, axis=1), ((0, 0), (1, 0)))
    rise = h * v[:, :-1] + h**2 * (2 * a[:, :-1] + a[:, 1:]) / 6
    r = np.pad(np.cumsum(rise, axis=1), ((0, 0), (1, 0)))
    motion = np.stack([r, v, a])
    return lambda times: motion[:, :, np.rint(times * rate_hz).astype(int)]


def relative_error(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


# reference


@pytest.mark.parametrize("effects", [(), ("inertias", "geometry")])
def test_plain_vehicle_moves_as_suspnet_says(effects):
    rows = off_ratios(np.array([HEALTHY, DEGRADED]), effects)
    rate_hz, n = 200.0, 3000
    tracks = [rough(n, rate_hz, seed) for seed in range(2)]
    found = simulate(rows, RichVehicle(), tracks, rate_hz, n)
    for row, track, signals in zip(rows, tracks, found, strict=True):
        wheels = track(np.arange(n) / rate_hz)[2]
        system = VerticalVehicle(AM96).motion_system(torch.as_tensor(row))
        expected = SampledMotion(system, rate_hz).advance(list(wheels))
        assert relative_error(signals[1:], expected) < 1e-9
        np.testing.assert_array_equal(signals[0], wheels[0])


@pytest.mark.slow
@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("part", "friction"),
    [("dampers", 0), pytest.param("rubber", 1e-12, marks=pytest.mark.slow), ("rubber", 0.1)],
)
def test_bushings_and_rubber_have_the_stiffness_of_maxwell_elements(part, friction):
    frequencies, rate_hz = [0.9, 2.3, 5.1, 7.4, 13.0], 500.0
    rich = RichVehicle(**{part: True}, friction_share=friction, **NEVER)
    n = 10_000
    track = waves(frequencies, velocity=1e-8)  # friction is a spring, F_max / x_2, if x is small
    signals = simulate([DEGRADED], rich, [track], rate_hz, n, round(25 * rate_hz))
    box, frame, body = phasors(signals[0], np.arange(n) / rate_hz, frequencies).T
    for i, f in enumerate(frequencies):
        s = 2j * math.pi * f
        numbers = pitching_numbers(AM96, DEGRADED, SPEED)
        for name in ("measured", "other"):
            k_p, c_p, k_s, c_s = numbers[name]
            primary, secondary = k_p + s * c_p, k_s + s * c_s
            if part == "dampers":  # two primary dampers a side, 1e6 N/m in series with each
                primary = k_p + 2 / (2 / (s * c_p) + 1 / 1e6)
                secondary = k_s + 1 / (1 / (s * c_s) + 1 / 6e6)
            else:
                primary += 0.1 * k_p / (1 + 2 * math.pi * 5.0 / s) + friction * k_p
            numbers[name] = [
                part for x in (primary, secondary) for part in (x.real, x.imag / abs(s))
            ]
        g_p, g_s = pitching_transfer(numbers, f)
        # what is left of the start after 25 s is exp(-0.35 * 25); a friction that is straight
        # between samples is lowered by (2 pi f / rate)^2 / 12, 2e-3 at 13 Hz
        tolerance = 1e-4 + 0.01 * friction
        assert abs(frame[i] / box[i] / g_p - 1) < tolerance
        assert abs(body[i] / frame[i] / g_s - 1) < tolerance


@pytest.mark.slow
def test_dampers_that_blow_off_move_as_an_independent_solver_says():
    track, seconds = waves([1.4, 5.2], velocity=0.2), 1.0
    numbers = pitching_numbers(AM96, DEGRADED, SPEED)
    bogies = [numbers["measured"], numbers["other"]]
    laws = [(c_s, 6e6) for _, _, _, c_s in bogies]
    laws += [(c_p / 2, 1e6) for _, c_p, _, _ in bogies for _ in range(2)]
    for name in ("measured", "other"):
        k_p, _, k_s, _ = numbers[name]
        numbers[name] = (k_p, 0.0, k_s, 0.0)
    mass, _, stiffness, _, input_stiffness = pitching_matrices(numbers)
    L, a = numbers["L"], numbers["a"]
    arms = np.array([  # stretch of each damper from heave and pitch [rad]
        [1, L, -1, 0, 0, 0], [1, -L, 0, 0, -1, 0],
        [0, 0, 1, a, 0, 0], [0, 0, 1, -a, 0, 0], [0, 0, 0, 0, 1, a], [0, 0, 0, 0, 1, -a],
    ])  # fmt: skip

    def rates(time, state):
        q, v, force = state[:6], state[6:12], state[12:]
        r, r_dot, _ = track(np.array([time]))[..., 0]
        acceleration = input_stiffness @ r - stiffness @ q - arms.T @ force
        stretching = arms @ v - np.concatenate([[0, 0], r_dot])
        grown = []
        for (c, k), f, s in zip(laws, force, stretching, strict=True):
            limit = 0.1 * c
            slip = f / c if abs(f) <= limit else math.copysign(0.1 + (abs(f) - limit) / c / 0.2, f)
            grown.append(k * (s - slip))
        return np.concatenate([v, acceleration / np.diag(mass), grown])

    r, v, _ = track(np.zeros(1))[..., 0]
    start = np.concatenate([r[0] * np.array([1, 0] * 3), v[0] * np.array([1, 0] * 3), np.zeros(6)])
    times = np.arange(1000) / 1000.0
    solved = solve_ivp(
        rates, (0, seconds), start, "RK45", times, rtol=1e-7, atol=1e-9, max_step=2e-3
    )
    expected = np.array([rates(t, x)[6:12] for t, x in zip(times, solved.y.T, strict=True)])
    frame, body = expected[:, 2] + a * expected[:, 3], expected[:, 0] + L * expected[:, 1]
    found = simulate([DEGRADED], RichVehicle(dampers=True), [track], 1000.0, 1000)[0]
    assert (np.abs(solved.y[12:]).max(axis=1) > 0.1 * np.array(laws)[:, 0]).all()
    assert relative_error(found[1], frame) < 1e-3
    assert relative_error(found[2], body) < 1e-3


@pytest.mark.slow
def test_bending_has_the_frequency_the_damping_and_the_shape_of_a_free_beam():
    soft = np.array([1, 1, 1e-9, 1e-9, 1])
    for mass_ratio in (1.0, 1.2):  # payload lowers the frequency
        roots = np.linalg.eigvals(
            build([*soft[:4], mass_ratio, 1, 1, 1, 1e-9, 1e-9, *[1] * 5], BENT).a
        )
        mode = roots[np.argmin(np.abs(np.abs(roots) - 2 * math.pi * 9.0))]
        assert abs(mode) / (2 * math.pi) == pytest.approx(9.0 / math.sqrt(mass_ratio), rel=1e-6)
        assert -mode.real / abs(mode) == pytest.approx(0.015 / math.sqrt(mass_ratio), rel=1e-4)
    length = 26.6
    x, h = np.linspace(-length / 2, length / 2, 100_001, retstep=True)
    shape = bending_shape(x, length)
    assert np.trapezoid(shape**2, x) == pytest.approx(length, rel=1e-6)
    assert np.trapezoid(shape, x) == pytest.approx(0, abs=1e-6)  # no heave in it
    assert shape[-1] == pytest.approx(2, rel=1e-6)  # Blevins, Formulas for Natural Frequency
    node = x[np.flatnonzero(np.diff(np.sign(shape)))[-1]]
    assert 0.5 - node / length == pytest.approx(0.2242, abs=1e-4)
    curvature = (shape[2:] - 2 * shape[1:-1] + shape[:-2]) / h**2
    assert abs(curvature[-1]) < 1e-3 * np.abs(curvature).max()  # free ends


def test_force_of_a_suspension_moves_the_body_as_its_three_modes_say():
    numbers = pitching_numbers(AM96, DEGRADED, SPEED)
    mass, ratio = numbers["half_body_kg"], numbers["L"] / numbers["body_gyration"]
    shape = float(bending_shape(numbers["L"], BENT.body_length_m))
    system = build(DEGRADED, RichVehicle(bending=True, dampers=True))
    forces = system.a[:, -6:-4]  # of the secondary dampers, leading and trailing
    leading, trailing = (1 + ratio**2 + shape**2) / mass, (1 - ratio**2 + shape**2) / mass
    np.testing.assert_allclose(system.s[2] @ forces, [-leading, -trailing], rtol=1e-12)


@pytest.mark.slow
def test_friction_rises_by_half_of_its_limit_and_cycles_as_berg_says():
    limit, half, amplitude = 130.0, 1e-3, 3e-3
    first = BergFriction(np.array([limit]), half)
    assert first(np.array([0.0])) == 0
    assert first(np.array([half])) == pytest.approx(limit / 2)
    cycle = amplitude * np.sin(2 * math.pi * np.arange(20_001) / 1000)
    friction = BergFriction(np.array([limit]), half)
    force = np.array([friction(np.array([x]))[0] for x in cycle])
    last = slice(19_000, None)
    # Berg (1998), of a steady cycle: largest force and energy lost
    root = math.sqrt(half**2 + amplitude**2 + 6 * half * amplitude)
    share = (root - half - amplitude) / (2 * half)
    assert force[last].max() == pytest.approx(share * limit, rel=1e-6)
    assert force[last].min() == pytest.approx(-share * limit, rel=1e-6)
    reach = half * (1 + share)
    lost = (
        2
        * limit
        * (2 * amplitude - reach * (1 + share) * math.log((reach + 2 * amplitude) / reach))
    )
    assert np.trapezoid(force[last], cycle[last]) == pytest.approx(lost, rel=1e-4)


# limit


# property


# trips


def small_fleet(**changes):
    return Fleet(**({"n_trips": 3, "minutes": 0.2, "sensors": SENSORS} | changes))


def column(manifest, name):
    return pq.read_table(manifest.with_suffix("") / f"{name}.parquet").column(0).to_numpy()


def test_trips_without_effects_are_those_of_suspnet(tmp_path):
    fleet, scenario = small_fleet(), Scenario("random", spread=0.4)
    ratios = scenario.ratios(fleet.mileage_km(), 5)
    found = write_rich_trips(tmp_path / "rich", (), ratios, fleet, seed=5)
    generator = VerticalVehicle(AM96, speed_m_per_s=SPEED)
    expected = write_fleet(tmp_path / "plain", Simulation(fleet, scenario, generator, seed=5))
    for mine, theirs in zip(found, expected, strict=True):
        a, b = read_manifest(mine), read_manifest(theirs)
        assert (a.truth, a.mileage_km, a.start, a.vehicle) == (
            b.truth,
            b.mileage_km,
            b.start,
            b.vehicle,
        )
        for channel in CHANNELS:
            # noise and track are the same; of the other start exp(-0.35 * 20) is left
            assert relative_error(column(mine, channel), column(theirs, channel)) < 4e-3


def test_a_trip_that_the_model_cannot_explain_has_no_estimate(tmp_path):
    """As README's table of mismatch, at small size, read with the drawing."""
    fleet = small_fleet(n_trips=1, minutes=4.0, sensors=trip_fixtures.SENSORS)
    ratios = drawn_ratios(0, fleet, seed=0)
    (path,) = write_rich_trips(tmp_path, ("bending", "contact"), ratios, fleet, seed=0)
    found = evaluate_trip(path, [trip_fixtures.model_at()], TripSettings())
    assert found.status == "no estimate"
    assert "the model cannot explain the curve" in found.reason
    assert np.isnan(list(found.estimates.values())).all()


# the script
