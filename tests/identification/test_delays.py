"""A delay that is the same all along is found by the phases, whatever else is wrong is not one."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from vehicles import AM96

from suspnet.trains.identification.delays import EXPLAINED, find_delays
from suspnet.vehicle import VerticalVehicle

HERTZ = torch.arange(0.6, 20.0, 0.05, dtype=torch.float64)
HEALTHY = torch.ones(1, 5, dtype=torch.float64)
TRAIN = VerticalVehicle(AM96, speed_m_per_s=70.0)


def responses(*ratios):
    rows = torch.tensor([ratios], dtype=torch.float64) if ratios else HEALTHY
    return torch.stack(TRAIN.responses(rows, HERTZ), dim=1)[0]


def late(curves, *delays_s):
    delays = torch.tensor(delays_s, dtype=torch.float64)[:, None]
    return curves * torch.exp(-2j * math.pi * HERTZ * delays)


def noisy(curves, deviation, seed=0):
    source = torch.Generator().manual_seed(seed)
    noise = torch.randn(curves.shape, dtype=torch.complex128, generator=source)
    return curves * torch.exp(deviation * math.sqrt(2) * noise)


@given(st.lists(st.floats(-0.24, 0.24), min_size=2, max_size=2), st.integers(0, 9))
def test_delays_of_both_links_are_found(delays_s, seed):
    curves, deviations = responses(), torch.full((2, len(HERTZ)), 0.02, dtype=torch.float64)
    observed = noisy(late(curves, *delays_s), 0.02, seed)
    found, shares = find_delays(observed, curves, deviations, HERTZ)
    torch.testing.assert_close(
        found, torch.tensor(delays_s, dtype=torch.float64), rtol=0, atol=5e-5
    )
    for delay_s, share in zip(delays_s, shares.tolist(), strict=True):
        assert share > 0.95 or abs(delay_s) < 2e-3


def test_bins_that_are_not_used_do_not_count():
    curves = responses()
    deviations = torch.full((2, len(HERTZ)), 0.02, dtype=torch.float64)
    observed = late(curves, 0.01, -0.02)
    observed[:, 100:], deviations[:, 100:] = torch.nan, torch.inf
    found, shares = find_delays(observed, curves, deviations, HERTZ)
    torch.testing.assert_close(found, torch.tensor([0.01, -0.02], dtype=torch.float64))
    torch.testing.assert_close(shares, torch.ones(2, dtype=torch.float64))
    nothing = torch.full_like(deviations, torch.inf)
    assert find_delays(observed, curves, nothing, HERTZ)[1].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("column", range(5))
@pytest.mark.parametrize("ratio", [0.6, 1.5])
def test_wrong_parameter_is_no_delay(column, ratio):
    """As of a regression that is far off: its curves differ in size, too."""
    ratios = HEALTHY[0].clone()
    ratios[column] = ratio
    deviations = torch.full((2, len(HERTZ)), 0.02, dtype=torch.float64)
    _, shares = find_delays(responses(*ratios.tolist()), responses(), deviations, HERTZ)
    assert float(shares.max()) < EXPLAINED
