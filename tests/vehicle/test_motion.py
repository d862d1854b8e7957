"""Motion in time against scipy's simulation of the same state space, block by block."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.signal import cont2discrete, dlsim, lsim
from vehicles import AM96

from suspnet.vehicle import QuarterCar, VerticalVehicle
from suspnet.vehicle.motion import LinearSystem, SampledMotion, foh_weights
from suspnet.vehicle.quantities import IN_MOTION, UNMEASURED

SYSTEMS = {
    "quarter_car": QuarterCar(AM96).motion_system(torch.tensor([0.7, 1.5, 1.3, 0.6, 1.1])),
    "overdamped": QuarterCar(AM96).motion_system(torch.tensor([1.0, 40.0, 1.0, 20.0, 1.0])),
    "leading": VerticalVehicle(AM96).motion_system(torch.tensor([0.7, 1.5, 1.3, 0.6, 1.1])),
    "trailing": VerticalVehicle(
        AM96, bogie="trailing", axle="trailing", frame_sensor="centre", body_sensor_m=1.0
    ).motion_system(torch.linspace(0.7, 1.4, 5 + len(UNMEASURED))),
    "all parts": VerticalVehicle(AM96, parts=IN_MOTION).motion_system(torch.ones(5)),
}


def oscillator(damping, mass=1.0, stiffness=1.0):
    """One mass on a spring and a damper: half its motion is the second sensor."""
    k, c = np.array([[stiffness]]), np.array([[damping]])
    sensors = np.array([[1.0], [0.5]])
    return LinearSystem(np.array([[mass]]), c, k, c, k, sensors, (0.0,))


def noise(system, n_samples, seed=0, first=None):
    inputs = np.random.default_rng(seed).standard_normal((len(system.behind_m), n_samples))
    if first is not None:
        inputs[:, 0] = first
    return inputs


def relative_error(found, expected):
    assert np.abs(expected).max() > 0
    return np.abs(found - expected).max() / np.abs(expected).max()


# reference


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("rate_hz", [20.0, 200.0, 5000.0])
def test_outputs_are_those_of_lsim(name, rate_hz):
    system = SYSTEMS[name]
    inputs = noise(system, 1500)
    _, expected, _ = lsim(system.state_space(), inputs.T, np.arange(1500) / rate_hz, interp=True)
    found = SampledMotion(system, rate_hz).advance(list(inputs))
    assert found.shape == (2, 1500)
    # both are exact for linear pieces; lsim's matrix exponential loses a few more digits
    assert relative_error(found, expected.T) < 1e-9


@pytest.mark.parametrize("name", SYSTEMS)
def test_outputs_are_those_of_a_first_order_hold(name):
    system, rate_hz = SYSTEMS[name], 250.0
    inputs = noise(system, 1000, first=0.0)  # scipy's hold ramps up to the first sample
    discrete = cont2discrete(system.state_space(), 1 / rate_hz, method="foh")
    _, expected, _ = dlsim(discrete, inputs.T)
    found = SampledMotion(system, rate_hz).advance(list(inputs))
    assert relative_error(found, expected.T) < 1e-9


@pytest.mark.parametrize("damping", [0.05, 1.0, 5.0])
def test_ramp_response_of_an_oscillator_in_closed_form(damping):
    system, rate_hz, n = oscillator(damping), 10.0, 200
    times = np.arange(n) / rate_hz
    found = SampledMotion(system, rate_hz).advance([times])[0]
    # z'' + d z' + z = d + t: z = t + a e^(p t) + b e^(q t), z(0) = z'(0) = 0
    p, q = np.roots([1.0, damping, 1.0]).astype(complex)
    a, b = -1 / (p - q), 1 / (p - q)
    expected = times + (a * np.exp(p * times) + b * np.exp(q * times)).real
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.0999, 0.1001, 0.5, 3.0, 30.0])
@pytest.mark.parametrize("angle", [math.pi, 0.6 * math.pi, 0.501 * math.pi])
def test_weights_are_the_integrals_of_a_linear_input(size, angle):
    """Those of exp(lambda (h - s)) (1 - s / h) and exp(lambda (h - s)) s / h over a step."""
    step_s, z = 0.02, size * np.exp(1j * angle)
    found = np.concatenate(foh_weights(np.array([z / step_s]), step_s))
    expected, _ = quad_vec(lambda s: np.exp(z * (1 - s)) * np.array([1 - s, s]), 0, 1, epsrel=1e-13)
    assert found == pytest.approx(step_s * expected, rel=1e-12)


# limit


@pytest.mark.parametrize("name", SYSTEMS)
def test_track_that_stays_raised_lifts_every_sensor_by_as_much(name):
    system, rate_hz = SYSTEMS[name], 100.0
    found = SampledMotion(system, rate_hz).advance([np.ones(20_000)] * len(system.behind_m))
    np.testing.assert_allclose(found[:, -1], [1.0, 1.0], rtol=1e-9)


@pytest.mark.parametrize("name", SYSTEMS)
def test_motion_starts_at_rest(name):
    system = SYSTEMS[name]
    inputs = noise(system, 50, first=100.0)
    found = SampledMotion(system, 200.0).advance(list(inputs))
    assert not found[:, 0].any()
    assert found[:, 1].all()
    still = SampledMotion(system, 200.0).advance(list(np.zeros_like(inputs)))
    assert not still.any()


@pytest.mark.parametrize("mass", [1.0, 1725.0, 6300.0])
@pytest.mark.parametrize("change", [1e-6, -1e-6, 1e-3])
def test_nearly_critical_damping_is_still_accurate(mass, change):
    damping = 2 * mass * 20.0 * (1 + change)
    system = oscillator(damping, mass, mass * 400.0)
    inputs = noise(system, 500)
    _, expected, _ = lsim(system.state_space(), inputs.T, np.arange(500) / 100.0, interp=True)
    # the eigenvectors are nearly parallel: their condition is about 20 / sqrt(1e-6)
    assert relative_error(SampledMotion(system, 100.0).advance(inputs), expected.T) < 1e-8


# property


@given(
    name=st.sampled_from(sorted(SYSTEMS)),
    cuts=st.lists(st.integers(1, 299), max_size=8, unique=True).map(sorted),
)
def test_blocks_of_any_size_give_the_same_motion(name, cuts):
    system = SYSTEMS[name]
    inputs = noise(system, 300)
    whole = SampledMotion(system, 100.0).advance(list(inputs))
    motion = SampledMotion(system, 100.0)
    parts = [motion.advance(list(part)) for part in np.split(inputs, cuts, axis=1)]
    np.testing.assert_allclose(
        np.concatenate(parts, axis=1), whole, rtol=0, atol=1e-13 * np.abs(whole).max()
    )


# failure


def test_modes_that_coincide_are_rejected():
    with pytest.raises(ValueError, match=r"coincide \(critical damping\): change one"):
        SampledMotion(oscillator(2.0), 100.0)
