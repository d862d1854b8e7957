"""Motion in time of twelve separate parts against their frequency responses."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import eigh
from scipy.signal import lsim
from vehicles import AM96

from suspnet import SpatialVehicle
from suspnet.vehicle.motion import SampledMotion
from suspnet.vehicle.quantities import ADDITIONS, PARTS, PLACES

FREQUENCIES = torch.tensor([0.3, 0.9, 1.9, 5.4, 11.0, 20.0]).double()
OF_SENSORS = ("sensors", "wheelsets")
MOVING = tuple(part for part in (*PARTS, *ADDITIONS) if part not in OF_SENSORS)
COMBINATIONS = [(), *((part,) for part in MOVING if part in ADDITIONS), MOVING]
HEALTHY = torch.ones(13).double()


def vehicle(parts, **options):
    lateral = (1.0, 0.95, 1.1)
    return SpatialVehicle(AM96, parts=parts, sensors=PLACES, sensor_lateral_m=lateral, **options)


def worn(generator, seed=0):
    values = np.random.default_rng(seed).uniform(0.7, 1.4, len(generator.columns))
    return torch.as_tensor(values)


# reference


@pytest.mark.parametrize(
    ("bogie", "axle", "direction"),
    [("leading", "leading", "forward"), ("trailing", "leading", "reverse")],
)
@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_motion_has_the_channels_of_the_generator(parts, bogie, axle, direction):
    generator = vehicle(parts, bogie=bogie, axle=axle, direction=direction)
    row = worn(generator)
    named = dict(zip(generator.columns, row.tolist(), strict=True))
    system, expected = generator.motion_system(row), generator.channels(row[None], FREQUENCIES)[0]
    a, b, c, d = system.state_space()
    assert b.shape[1] == 4 * len(generator.inputs)
    speed = 70.0 * named["speed"]
    for column, f in enumerate(FREQUENCIES.tolist()):
        s = 2j * math.pi * f
        delays = np.exp(-s * np.array(system.behind_m) / speed)
        wheels = d + c @ np.linalg.solve(s * np.eye(len(a)) - a, b)
        wave = (abs(s) / speed) ** 2
        cross = 0.5 * named["cross_level"] * wave / (wave + 0.438**2)
        sizes = [1.0, math.sqrt(cross) / 0.75, math.sqrt(0.5 * named["alignment"])]
        for i in range(len(generator.inputs)):
            found = sizes[i] * wheels[:, 4 * i : 4 * i + 4] @ delays
            np.testing.assert_allclose(found, expected[i, :, column], rtol=1e-8, atol=1e-10)


def test_steps_in_time_are_those_of_the_state_space_with_one_worn_part():
    generator = vehicle(COMBINATIONS[-1])
    row = generator.complete(HEALTHY[None])[0]
    row[generator.outputs.index("c_p_axle2_left")] = 0.62
    system = generator.motion_system(row)
    inputs = np.random.default_rng(0).standard_normal((12, 1000))
    _, expected, _ = lsim(system.state_space(), inputs.T, np.arange(1000) / 500.0)
    found = SampledMotion(system, 500.0).advance(list(inputs))
    assert found.shape == (len(PLACES), 1000)
    np.testing.assert_allclose(found, expected.T, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_eigenfrequency_of_torsion_is_that_of_frame_and_corners():
    system = vehicle(("torsion",)).motion_system(HEALTHY)
    squares = eigh(system.stiffness, system.mass, eigvals_only=True)
    mass = 0.2 * 2 * AM96.bogie_mass_kg
    own = (2 * math.pi * 35.0) ** 2 + 2 * AM96.primary_stiffness_n_per_m / mass
    assert squares[-2:] == pytest.approx(own, rel=1e-9)


# limit


@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_track_that_stays_raised_or_tilted_takes_every_sensor_with_it(parts):
    generator = vehicle(tuple(part for part in parts if part != "longitudinal"))
    system = generator.motion_system(worn(generator))
    a, b, c, d = system.state_space()
    static = (d - c @ np.linalg.lstsq(a, b, rcond=None)[0])[:, :8]
    static = static @ np.repeat(np.eye(2), 4, axis=0)
    np.testing.assert_allclose(static[:, 0], 1.0, rtol=1e-6)


# property


@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_all_free_motion_decays(parts):
    generator = vehicle(parts)
    for row in (HEALTHY, worn(generator)):
        a, *_ = generator.motion_system(row).state_space()
        assert np.linalg.eigvals(a).real.max() < -0.01


@pytest.mark.parametrize("parts", COMBINATIONS, ids=lambda parts: "+".join(parts) or "none")
def test_only_creep_gives_energy(parts):
    system = vehicle(parts).motion_system(HEALTHY)
    assert (np.diag(system.mass) > 0).all()
    for matrix in (system.stiffness, system.damping):
        if "creep" in parts and matrix is system.stiffness:
            assert np.abs(matrix - matrix.T).max() > 1e4
            continue
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-12)
        assert np.linalg.eigvalsh(matrix).min() >= -1e-9 * np.abs(matrix).max()


@pytest.mark.parametrize("axle", ["leading", "trailing"])
@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_wheelsets_run_behind_axle_1_by_their_distance(axle, direction):
    system = vehicle((), axle=axle, direction=direction).motion_system(HEALTHY)
    ahead = 1 if axle == "leading" else -1
    expected = np.array([0.0, ahead * 2.7, 19.0, 19.0 + ahead * 2.7])
    expected *= 1 if direction == "forward" else -1
    np.testing.assert_allclose(system.behind_m, expected, atol=1e-12)
