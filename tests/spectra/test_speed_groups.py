"""Which model reads which part of a trip: each speed of a range is read, by one model."""

import math
from collections import Counter
from types import SimpleNamespace

import pytest
import torch
from speed_ranges import speed_ranges

from suspnet.curves.estimates import SPEED_HALF_WIDTH, EstimateSettings
from suspnet.curves.speeds import SpeedRange, range_words, reading_range
from suspnet.trains.spectra.steady_parts import (
    groups_of,
    groups_to_read,
    no_group_words,
    speed_range,
)

LOW, HIGH = 61.0, 78.0
N_SPEEDS = 200
TOLERANCE = 0.02
SPREADS = (0.0, 0.003, 0.018)
"""Largest distance of the speed of a segment from that of the trip, [-]."""


def model_of(speed, half_width=0.08):
    """Return as much of a model as the choice by speed asks for."""
    settings = EstimateSettings(speed_half_width=half_width)
    return SimpleNamespace(generator=SimpleNamespace(speed_m_per_s=speed), settings=settings)


@pytest.fixture
def models():
    return [model_of(*one[1:]) for one in speed_ranges(LOW, HIGH, SPEED_HALF_WIDTH)]


def trip_at(speed, spread, n_segments=40, n_samples=20):
    """Return the speeds in the segments of a trip that runs a little faster and slower."""
    phase = torch.linspace(0.0, 6 * math.pi, n_segments * n_samples, dtype=torch.float64)
    return (speed * (1 + spread * torch.sin(phase))).reshape(n_segments, n_samples)


def speeds_between(low, high, n=N_SPEEDS):
    return [low + i * (high - low) / (n - 1) for i in range(n)]


@pytest.mark.parametrize("spread", SPREADS)
def test_each_of_200_speeds_in_a_range_is_read_whole_by_exactly_one_model(models, spread):
    n_read, readers = 0, Counter()
    for speed in speeds_between(LOW, HIGH):
        speeds = trip_at(speed, spread)
        groups = groups_to_read(speeds, TOLERANCE, 0.0)
        (steady,) = [group for group in groups if int(group.sum()) == len(speeds)]
        by = [i for i, one in enumerate(models) if groups_of(one, models, speeds, [steady])]
        n_read += len(by) == 1
        readers[by[0] if by else None] += 1
    print(f"spread {100 * spread:g} %: {n_read} of {N_SPEEDS} trips are read by one model")
    assert n_read == N_SPEEDS
    assert set(readers) == set(range(len(models)))


def test_speeds_beside_the_range_are_read_by_none_and_the_reason_names_both(models):
    for speed in (LOW * 0.999, HIGH * 1.001, 250.0):
        speeds = trip_at(speed, 0.0)
        groups = groups_to_read(speeds, TOLERANCE, 0.0)
        assert not any(groups_of(one, models, speeds, groups) for one in models)
        words = no_group_words(speeds, groups, models, TOLERANCE, 10.0)
        assert f"the trip is run at {speed:.1f} m/s, the models read 61.0 to 78.0 m/s" in words


def test_nearest_of_several_models_reads_a_speed_that_both_hold():
    ranges = [SpeedRange.around(speed, 0.08) for speed in (65.0, 70.0)]
    assert reading_range(66.0, ranges) is ranges[0]
    assert reading_range(69.0, ranges) is ranges[1]
    assert reading_range(80.0, ranges) is None


def test_models_of_any_speed_read_all_segments_that_are_fast_enough():
    model, speeds = model_of(None), trip_at(40.0, 0.3)
    speeds[3] = 9.0
    (group,) = groups_to_read(speeds, TOLERANCE, 10.0, at_any_speed=True)
    assert int(group.sum()) == len(speeds) - 1
    assert groups_of(model, [model], speeds, [group]) == [group]
    assert speed_range(model) is None


def test_ranges_that_meet_are_named_as_one():
    ranges = [one for one, *_ in speed_ranges(45.0, 80.0, 0.08)]
    assert range_words(ranges) == "45.0 to 80.0 m/s"
    assert range_words([ranges[0], ranges[-1]]).count(" and ") == 1
