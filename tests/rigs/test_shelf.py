"""The measured shelf: no flag on its healthy records, and both kinds of walls distinguished."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from suspnet import Rig, RigRecord, commission_rig, read_rig
from suspnet.ground.parameters import Severity

PLACES = [p / "shared" / "real" / "shelf" for p in Path(__file__).parents]
SHELF = next((place for place in PLACES if place.is_dir()), PLACES[0])
pytestmark = pytest.mark.skipif(not SHELF.is_dir(), reason="../shared/real/shelf is absent")
INDEPENDENT = {"k_p": 3.0, "k_s_over_M_s": 5.8}
"""k/m of stiff over flexible walls by fits in time: ../shared/real/README.md."""


def read(walls):
    tables = [pq.read_table(file) for file in sorted(SHELF.glob(f"{walls}_*.parquet"))]
    floors = [[table[f"floor{i}"].to_numpy() for i in (1, 2, 3)] for table in tables]
    return [RigRecord(np.stack(signals), 120.0) for signals in floors]


@pytest.fixture(scope="module")
def stiff():
    return commission_rig(Rig("shelf", primary_hz=15.0, secondary_hz=15.0), read("stiff"))


def test_healthy_records_are_healthy_and_scatter_within_their_intervals(stiff):
    for i in range(3):
        estimate = stiff.estimate_healthy(i)
        assert estimate.severity == Severity.NONE
        assert all(value.low < 1 < value.high for value in estimate.ratios.values())
        assert estimate.ratios["k_s_over_M_s"].high < 1.15


def test_numbers_are_those_of_independent_estimates(stiff):
    # the dip of G_p, and the peak of G_s, are where the body resonates: 21.6 to 22.0 Hz
    healthy = stiff.healthy()["secondary_hz"]
    assert healthy.low < 21.6 < 1.02 * healthy.high


@pytest.mark.slow
def test_flexible_walls_are_told_apart_by_as_much_as_independent_fits_say(stiff):
    for record in read("flexible"):
        estimate = read_rig(stiff, record)
        assert estimate.severity == Severity.ACT
        for name, ratio in INDEPENDENT.items():
            value = estimate.ratios[name]
            assert value.low < 1 / ratio < value.high
            assert value.high < 0.5
