"""Motion in time of every part of the vertical vehicle against its responses in closed form."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import lsim
from vehicles import AM96

from suspnet.vehicle import PARAMETERS, VerticalVehicle
from suspnet.vehicle.motion import SampledMotion
from suspnet.vehicle.quantities import IN_MOTION, UNMEASURED
from suspnet.vehicle.vertical_motion import LOSS_HZ, LOSS_REFERENCE_HZ, LOSS_SHARES, Element

FREQUENCIES = torch.tensor([0.3, 0.9, 1.31, 1.9, 3.3, 5.4, 7.7, 11.0, 20.0]).double()
NAMES = (*PARAMETERS, *UNMEASURED)
ALL = torch.as_tensor(np.random.default_rng(5).uniform(0.7, 1.4, (2, len(NAMES))))
COMBINATIONS = [(), *((part,) for part in IN_MOTION), IN_MOTION, IN_MOTION[:-1]]
LATERAL = (1.0, 0.95, -1.1)


def family(parts, trailing=False, **options):
    options = {"speed_m_per_s": 52.0, "parts": parts, "sensor_lateral_m": LATERAL} | options
    if trailing:
        options |= {"bogie": "trailing", "frame_sensor": "centre", "body_sensor_m": 1.7}
    return VerticalVehicle(AM96, **options)


def channels_of(system, speed):
    """Return what `channels` does, and the same of the other side: C (j w - A)^-1 B.

    The cross level has the colour of the German spectra over that of the mean.
    """
    a, b, c, d = system.state_space()
    assert not d.any()
    n = len(system.behind_m)
    found = []
    for f in FREQUENCIES.tolist():
        s = 2j * math.pi * f
        wheels = np.exp(-s * np.array(system.behind_m) / speed)
        motion = c @ np.linalg.solve(s * np.eye(len(a)) - a, b)
        sides = motion.reshape(-1, 2, b.shape[1])
        mean = np.insert(sides[:, :, :n] @ wheels, 0, 1.0, axis=1)
        inputs = [mean]
        if system.roll_per_m:
            box = np.array([[system.lateral_m[0]], [-system.lateral_m[0]]])
            rolled = np.hstack([box, sides[:, :, n:] @ wheels])
            wave = abs(s) / speed
            inputs.append(system.roll_per_m * wave / math.hypot(wave, 0.4380) * rolled)
        found.append(np.stack(inputs, axis=1))
    return np.moveaxis(np.array(found), 0, -1)  # (n_sides, n_inputs, 3, n_freq)


# reference


@pytest.mark.parametrize(
    ("trailing", "direction"), [(False, "forward"), (True, "forward"), (True, "reverse")]
)
@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_motion_has_the_channels_of_the_generator(parts, trailing, direction):
    generator = family(parts, trailing, direction=direction)
    expected = generator.channels(ALL, FREQUENCIES).numpy()
    for row, channels in zip(ALL, expected, strict=True):
        found = channels_of(generator.motion_system(row), 52.0 * float(row[len(PARAMETERS)]))
        assert found.shape == (1 + ("roll" in parts), *channels.shape)
        np.testing.assert_allclose(found[0], channels, rtol=1e-9)
        if "roll" in parts:  # the other side feels the mean alike and leans the other way
            np.testing.assert_allclose(found[1], channels * [[[1.0]], [[-1.0]]], rtol=1e-9)


def test_motion_in_time_is_that_of_the_state_space():
    system = family(IN_MOTION[:-1]).motion_system(ALL[0])
    inputs = np.random.default_rng(0).standard_normal((8, 1500))
    _, expected, _ = lsim(system.state_space(), inputs.T, np.arange(1500) / 500.0)
    found = SampledMotion(system, 500.0).advance(list(inputs))
    assert found.shape == (4, 1500)
    np.testing.assert_allclose(found, expected.T, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_ladder_of_branches_has_the_stated_loss_and_stiffness():
    k, eta = 1.3e6, 0.03
    element = Element(torch.tensor([[k]]).double(), None, (), torch.tensor([[eta]]).double())
    stiffness, damping, branches = element.causal()
    assert damping == 0
    s = 2j * math.pi * np.geomspace(0.3, 20, 300)
    kappa = stiffness + sum(b * s / (s + rate) for rate, b in branches.items())
    assert np.abs(kappa.imag / (eta * k) - 1).max() < 0.013
    rise = (kappa.real / k - 1) / eta
    assert (rise[0], rise[-1]) == pytest.approx((-1.45, 1.36), abs=0.05)
    assert (np.diff(rise) > 0).all()
    assert np.interp(LOSS_REFERENCE_HZ, np.abs(s) / math.tau, rise) == pytest.approx(0, abs=1e-4)
    assert np.diff(np.log10(LOSS_HZ)).max() < 1
    # causality (Kramers and Kronig): the slope over ln(omega) of a constant loss is 2 / pi of it
    slope = np.polyfit(np.log(np.abs(s)), rise, 1)[0]
    assert slope == pytest.approx(2 / math.pi, rel=0.05)


# limit


def test_branches_of_one_rate_are_one():
    share, eta = torch.tensor([[5e4]]).double(), torch.tensor([[0.03]]).double()
    rates = torch.tensor([2 * math.pi * 5.0, 7.0], dtype=torch.float64)
    rubber = Element(torch.tensor([[1e6]]).double(), None, [(share, rate) for rate in rates], eta)
    _, _, branches = rubber.causal()
    assert len(branches) == len(LOSS_HZ) + 1
    assert branches[2 * math.pi * 5.0] == pytest.approx(5e4 + 0.03 * 1e6 * LOSS_SHARES[2])
    assert branches[7.0] == pytest.approx(5e4)


def test_track_that_stays_tilted_tilts_every_sensor_with_it():
    system = family(IN_MOTION[:-1]).motion_system(ALL[0])
    a, b, c, _ = system.state_space()
    static = -c @ np.linalg.solve(a, b) @ np.repeat(np.eye(2), 4, axis=0)
    _, frame, body = system.lateral_m
    expected = [[1, frame], [1, body], [1, -frame], [1, -body]]
    np.testing.assert_allclose(static, expected, rtol=1e-8)


# property


@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_all_free_motion_decays(parts):
    for row in (*ALL, torch.ones(5)):
        a, *_ = family(parts).motion_system(row).state_space()
        assert np.linalg.eigvals(a).real.max() < -0.01


@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_matrices_are_symmetric_and_no_element_gives_energy(parts):
    system = family(parts).motion_system((ALL)[1])
    for matrix in (system.mass, system.damping, system.stiffness):
        np.testing.assert_array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix).min() >= -1e-9 * np.abs(matrix).max()
    for branch in system.branches:
        assert branch.stiffness > 0
        assert branch.rate > 0


@pytest.mark.parametrize("part", ["sensors", "wheelsets", "axle_box_arm"])
def test_what_does_not_move_leaves_the_motion_as_it_is(part):
    with_part, without = (
        VerticalVehicle(AM96, parts=parts).motion_system(torch.ones(5)) for parts in ((part,), ())
    )
    for found, expected in zip(with_part.state_space(), without.state_space(), strict=True):
        np.testing.assert_array_equal(found, expected)
