"""Responses of a vehicle of twelve separate parts, with all motion that it may have.

pytest benchmarks/test_spatial_speed.py --benchmark-only -n 0
"""

import numpy as np
import pytest
import torch
from vehicles import AM96

from suspnet.vehicle.quantities import ADDITIONS, PARTS
from suspnet.vehicle.spatial_vehicle import SpatialVehicle

FREQUENCIES = torch.linspace(0.3, 20.0, 170, dtype=torch.float64)
N_VEHICLES, N_DIRECTIONS = 200, 50
PLAIN = tuple(part for part in (*PARTS, *ADDITIONS) if part not in ("air_spring", "wheelsets"))


def ratios(n):
    return torch.as_tensor(np.random.default_rng(0).uniform(0.5, 1.5, (n, 13)))


@pytest.mark.parametrize("parts", [PLAIN, (*PLAIN, "wheelsets")], ids=["3 inputs", "11 inputs"])
@pytest.mark.benchmark(group="responses, 200 vehicles, 170 bins, six sensors")
def test_responses(benchmark, capsys, parts):
    generator = SpatialVehicle(AM96, parts=parts)
    channels = benchmark.pedantic(
        generator.channels, (ratios(N_VEHICLES), FREQUENCIES), rounds=3, warmup_rounds=1
    )
    assert channels.shape == (N_VEHICLES, len(generator.inputs), 6, len(FREQUENCIES))
    with capsys.disabled():
        seconds = benchmark.stats.stats.median * 6000 / N_VEHICLES
        print(f"\n{len(generator.inputs)} inputs: {seconds:.0f} s for 6,000 vehicles")


@pytest.mark.parametrize("parts", [PLAIN, (*PLAIN, "wheelsets")], ids=["3 inputs", "11 inputs"])
@pytest.mark.benchmark(group="responses with 50 derivatives, 4 vehicles, 170 bins, six sensors")
def test_derivatives(benchmark, capsys, parts):
    generator = SpatialVehicle(AM96, parts=parts)
    along = torch.eye(len(generator.columns), dtype=torch.float64)[:N_DIRECTIONS]
    _, slopes = benchmark.pedantic(
        generator.channels_along, (ratios(4), FREQUENCIES, along), rounds=5, warmup_rounds=1
    )
    assert slopes.shape[:2] == (4, N_DIRECTIONS)
    with capsys.disabled():
        seconds = benchmark.stats.stats.median / 4
        print(f"\n{len(generator.inputs)} inputs: {seconds:.2f} s for a vehicle")
