"""Ranges of speeds as bins, and the run that trains a model for each."""

import json
import math
from itertools import pairwise

import pytest

from suspnet.runs.train import speed_ranges, train_ranges


def test_bins_cover_the_range_edge_to_edge_with_equal_ratios():
    found = speed_ranges([45.0, 80.0], 0.08)
    assert (found[0].low_m_per_s, found[-1].high_m_per_s) == (45.0, 80.0)
    assert all(a.high_m_per_s == b.low_m_per_s for a, b in pairwise(found))
    for one in found:
        ratio = one.high_m_per_s / one.low_m_per_s
        assert math.log(ratio) == pytest.approx(math.log(80 / 45) / len(found))
        assert one.trained_m_per_s * (1 + one.half_width) == pytest.approx(one.high_m_per_s)
        assert one.trained_m_per_s * (1 - one.half_width) == pytest.approx(one.low_m_per_s)
        assert one.half_width <= 0.08


@pytest.mark.parametrize(("half_width", "n_bins"), [(0.08, 4), (0.04, 8), (0.3, 1), (0.28, 1)])
def test_bins_are_as_few_as_their_width_allows(half_width, n_bins):
    widest = math.log((1 + half_width) / (1 - half_width))
    assert len(speed_ranges([45, 80], half_width)) == n_bins
    assert n_bins - 1 < math.log(80 / 45) / widest <= n_bins


def test_each_range_is_trained_in_a_folder_of_its_own(tmp_path):
    ranges = speed_ranges([40.0, 60.0], 0.1)
    seen = []

    def train_one(one, folder):
        seen.append((one, folder))
        return {"rms_percent": {"k_p": 0.1}, "scores": {}, "other": 1}

    train_ranges(ranges, train_one, tmp_path)
    assert seen == [(one, tmp_path / one.name) for one in ranges]
    rows = json.loads((tmp_path / "speeds.json").read_text())
    assert [row["folder"] for row in rows] == [one.name for one in ranges]
    assert rows[0]["rms_percent"] == {"k_p": 0.1}
    assert "other" not in rows[0]


@pytest.mark.parametrize(
    ("speeds", "half_width", "message"),
    [
        ([45.0], 0.08, "one speed or the lowest and the highest"),
        ([45.0, 60.0, 80.0], 0.08, "one speed or the lowest and the highest"),
        ([80.0, 45.0], 0.08, r"speed_m_per_s\[1\]"),
        ([45.0, 45.0], 0.08, r"speed_m_per_s\[1\]"),
        ([0.0, 45.0], 0.08, r"speed_m_per_s\[0\]"),
        ([45.0, 80.0], 0.0, "speed_half_width"),
    ],
)
def test_what_is_no_range_is_named(speeds, half_width, message):
    with pytest.raises(ValueError, match=message):
        speed_ranges(speeds, half_width)
