"""Names, uncertain numbers and refusals of the vehicle of twelve separate parts."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from vehicles import AM96, MEDIANS

from suspnet import COMPONENTS, SpatialVehicle
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import ADDITIONS, PARTS, UNMEASURED, LogNormal

FREQUENCIES = torch.tensor([0.5, 1.3, 6.0]).double()
HEALTHY = torch.ones(1, 13).double()
EVERY = (*PARTS, *ADDITIONS)
PAIRS = ("axle_box_axle1", "frame_axle1", "body")


# reference


def test_ratios_are_relative_to_the_own_healthy_part():
    generator = SpatialVehicle(AM96)
    names = generator.columns
    worn, scattered = (generator.complete(HEALTHY) for _ in range(2))
    for i, name in enumerate(COMPONENTS[:-1]):
        worn[0, i] *= 0.7 + 0.05 * i
        scattered[0, names.index(f"healthy_{name}")] = 0.7 + 0.05 * i
    found, expected = (generator.channels(rows, FREQUENCIES) for rows in (worn, scattered))
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    assert (found - generator.channels(HEALTHY, FREQUENCIES)).abs().max() > 0.01


# limit


def test_missing_columns_are_healthy_and_nominal():
    generator = SpatialVehicle(AM96, parts=EVERY)
    complete = generator.complete(HEALTHY)[0]
    for name, value in zip(generator.columns[13:], complete[13:].tolist(), strict=True):
        absent = name.startswith(("delay_", "cross_axis_")) or name in (
            "wheelset_roll_share",
            "yaw_height",
            "equipment_ahead",
            "equipment_aside",
            "equipment_at_second",
            "equipment_at_twist",
            "load_ahead",
            "load_aside",
        )
        assert value == (0.0 if absent else MEDIANS.get(name, 1.0)), name
    sixth = torch.cat([HEALTHY, torch.tensor([[0.8]], dtype=torch.float64)], dim=1)
    slower = SpatialVehicle(AM96, parts=EVERY, speed_m_per_s=56.0)
    torch.testing.assert_close(
        generator.channels(sixth, FREQUENCIES), slower.channels(HEALTHY, FREQUENCIES)
    )


# property


def test_sensors_are_the_pairs_of_the_vertical_vehicle_unless_given():
    assert SpatialVehicle(AM96).sensors == tuple(
        f"{place}_{side}" for place in PAIRS for side in ("left", "right")
    )
    assert SpatialVehicle(AM96, frame_sensor="centre").sensors[2:4] == (
        "frame_centre_left",
        "frame_centre_right",
    )
    one = SpatialVehicle(AM96, sensors=["body_middle"])
    assert one.channels(HEALTHY, FREQUENCIES).shape == (1, 2, 1, 3)


def test_alignment_is_an_input_where_it_moves_something():
    track = ("mean", "cross_level")
    for parts in ((), ("roll",), ("body_yaw", "torsion")):
        assert SpatialVehicle(AM96, parts=parts).inputs == track
    for part in ("frame_sway", "frame_yaw", "creep"):
        assert SpatialVehicle(AM96, parts=(part,)).inputs == (*track, "alignment")
    alone = SpatialVehicle(AM96, parts=("wheelsets",)).inputs[2:]
    assert alone[0] == "wheelset1"
    assert alone[-1] == "wheelset4_roll"
    assert len(alone) == 8


def test_prior_is_of_the_parts_and_sensors_that_there_are():
    plain = SpatialVehicle(AM96, distribution="prior").distribution
    vertical = VerticalVehicle(AM96, parts=("roll",), distribution="prior").distribution
    healthy = tuple(f"healthy_{name}" for name in COMPONENTS[:-1])
    other = tuple(f"other_{name}" for name in COMPONENTS[:-1])
    assert plain.names == (*vertical.names, *healthy, *other)
    assert plain.deviations[-24:] == pytest.approx(0.05)
    every = SpatialVehicle(AM96, parts=EVERY, distribution="prior").distribution
    measuring = [
        f"{kind}_{place}_{side}"
        for kind in ("gain", "delay")
        for place in PAIRS
        for side in ("left", "right")
    ]
    expected = [name for name in measuring if not name.endswith("axle_box_axle1_left")]
    assert [name for name in every.names if name.startswith(("gain", "delay"))] == expected
    assert {"conicity", "torsion_rise", "bogie_yaw", "body_yaw", "alignment"} <= set(every.names)
    assert "frame_gain" not in every.names
    widths = dict(zip(every.names, every.deviations, strict=True))
    assert widths["gain_body_left"] == pytest.approx(0.02)
    assert 5e-3 * widths["delay_body_left"] == pytest.approx(0.5e-3)


def test_samples_follow_the_distribution():
    widths = {"speed": 0.02, "healthy_c_p_axle2_right": 0.05, "delay_body_left": 0.1}
    generator = SpatialVehicle(AM96, parts=("sensors",), distribution=widths)
    ratios = torch.as_tensor(np.random.default_rng(1).uniform(0.5, 2.0, (4000, 13)))
    samples = generator.sample_unmeasured(ratios, seed=3)
    assert torch.equal(samples[:, :13], ratios)
    shifted = (samples + generator.offsets).log()
    for name, column in zip(generator.columns[13:], shifted[:, 13:].T, strict=True):
        if name not in widths:
            assert float(column.std()) < 1e-12, name
            continue
        # standard errors of mean and deviation of 4000 draws
        assert float(column.mean()) == pytest.approx(0, abs=4 * widths[name] / math.sqrt(4000))
        assert float(column.std()) == pytest.approx(widths[name], rel=4 / math.sqrt(8000))


# failure


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensors": ("roof",)}, r"`sensors` must be one of .*'roof'"),
        ({"sensors": ()}, r"`sensors` must be places, each once, got \(\)"),
        ({"sensors": ("body_left", "body_left")}, "`sensors` must be places, each once"),
        ({"parts": ("wings",)}, r"`parts` must be one of .*'wings'"),
        ({"other_bogie": "same"}, r"`other_bogie` must be 'healthy'.*`other_k_p`"),
        ({"sensor_lateral_m": (1.0, 0.0, 1.0)}, r"`sensor_lateral_m\[1\]` must be a finite .*> 0"),
        ({"nominal": {"wings": 3.0}}, r"`nominal` must be named as in .*\['wings'\]"),
        ({"distribution": {"k_p": 0.1}}, r"`distribution` must be named as in .*\['k_p'\]"),
        (
            {"parts": ("sensors",), "distribution": {"frame_gain": 0.1}},
            r"`distribution` must be named as in .*\['frame_gain'\]",
        ),
        (
            {"distribution": {"gain_axle_box_axle1_left": 0.1}},
            r"`distribution` must be named as in .*\['gain_axle_box_axle1_left'\]",
        ),
    ],
)
def test_settings_out_of_range_are_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        SpatialVehicle(AM96, **changes)


def test_numbers_of_this_vehicle_are_not_those_of_the_vertical_one():
    belief = LogNormal.independent({"conicity": 0.5, "speed": 0.1})
    assert SpatialVehicle(AM96, distribution=belief).distribution == belief
    with pytest.raises(ValueError, match=r"`distribution` must be named as in .*\['conicity'\]"):
        VerticalVehicle(AM96, distribution=belief)
    assert "conicity" not in UNMEASURED


def test_vehicle_without_geometry_is_rejected():
    bare = dataclasses.replace(AM96, half_wheelbase_m=None)
    with pytest.raises(ValueError, match=r"lacks \['half_wheelbase_m'\], which `SpatialVehicle`"):
        SpatialVehicle(bare)


def test_directions_of_the_wrong_shape_are_rejected():
    with pytest.raises(ValueError, match=r"`directions` must have shape \(n_directions, \d+\)"):
        SpatialVehicle(AM96).channels_along(HEALTHY, FREQUENCIES, torch.eye(13))
