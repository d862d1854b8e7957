"""Faults are found where they were planted, and nowhere in ordinary vibration."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from suspnet.trains.recordings import cleaning
from suspnet.trains.recordings.cleaning import (
    KINDS,
    Cleaner,
    Fault,
    fill,
    find_clipping,
    find_constant,
    find_gaps,
    find_spikes,
    local_level,
    paint,
    runs,
)

RATE_HZ = 1000.0


def noise(n: int = 20_000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def clean(values: np.ndarray, block: int = 2**20, rate_hz: float = RATE_HZ, **options):
    """Return cleaned values, bad mask and faults by (kind, repaired)."""
    cleaner = Cleaner("body", rate_hz, **options)
    blocks = (values[i : i + block] for i in range(0, len(values), block))
    parts = [part for block in blocks for part in cleaner.push(block)] + list(cleaner.finish())
    cleaned = np.concatenate([part for part, _ in parts])
    bad = np.concatenate([part for _, part in parts])
    return cleaned, bad, {(f.kind, f.repaired): f for f in cleaner.faults(5.0)}


def spikes(values: np.ndarray, segment: int = 1000) -> np.ndarray:
    centre, spread = local_level(values, segment)
    return find_spikes(values, segment, centre, 25 * spread, longest=3)


# --- reference: slow, obvious versions -------------------------------------------------------


def naive_runs(mask) -> list[tuple[int, int]]:
    found_runs, start = [], None
    for i, value in enumerate([*mask, False]):
        if value and start is None:
            start = i
        if not value and start is not None:
            found_runs.append((start, i))
            start = None
    return found_runs


@given(hnp.arrays(np.bool_, st.integers(0, 30)), st.integers(1, 4), st.integers(1, 6))
def test_runs_match_a_loop(mask, at_least, at_most):
    expected = [r for r in naive_runs(mask) if at_least <= r[1] - r[0] <= at_most]
    starts, stops = runs(mask, at_least=at_least, at_most=at_most)
    assert list(zip(starts, stops, strict=True)) == expected
    painted = np.zeros(len(mask), dtype=bool)
    for start, stop in expected:
        painted[start:stop] = True
    np.testing.assert_array_equal(paint(len(mask), starts, stops), painted)


@given(
    hnp.arrays(
        np.float64, st.integers(1, 60), elements=st.sampled_from([0.0, 1.0, 2.0, np.nan, np.inf])
    ),
    st.integers(1, 8),
)
def test_constant_matches_a_loop(values, longest):
    expected = np.zeros(len(values), dtype=bool)
    for i in range(len(values) - longest):
        if (values[i : i + longest + 1] == values[i]).all():
            expected[i : i + longest + 1] = True
    np.testing.assert_array_equal(find_constant(values, longest), expected)


def test_filled_holes_lie_on_a_line():
    holes = np.array([True, False, True, True, False, True])
    np.testing.assert_array_equal(fill(np.array([9.0, 1, 9, 9, 4, 9]), holes), [1, 1, 2, 3, 4, 4])
    np.testing.assert_array_equal(fill(np.array([7, np.nan]), np.ones(2, dtype=bool)), [7, 0])


def test_gaps_are_what_no_sensor_gives():
    values = np.array([0, np.nan, np.inf, -np.inf, 3.4e38, -1e6])
    np.testing.assert_array_equal(find_gaps(values), [False, True, True, True, True, False])


# --- spikes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("height", [40.0, -40.0, 1e6])
def test_short_spikes_are_found_exactly(width, height):
    values = noise()
    at = np.array([700, 999, 5000, 14_003])
    for i in at:
        values[i : i + width] += height
    expected = paint(len(values), at, at + width)
    np.testing.assert_array_equal(spikes(values), expected)
    cleaned, bad, faults = clean(values)
    assert not bad.any()
    assert faults.keys() == {("spike", True)}
    assert faults["spike", True] == Fault("body", "spike", 4 * width, 4 * width / 1e3, 5.7, True)
    np.testing.assert_array_equal(cleaned, fill(values, expected))


@given(st.integers(0, 2**32 - 1))
def test_gaussian_noise_has_no_faults(seed):
    assert clean(noise(20_000, seed))[2] == {}


@pytest.mark.parametrize("peak", [10.0, 60.0])
@pytest.mark.parametrize("frequency_hz", [80.0, 300.0, 450.0])
def test_ringing_rail_joints_are_no_spikes(peak, frequency_hz):
    values = noise()
    t = np.arange(100) / RATE_HZ
    ringing = peak * np.exp(-60 * t) * np.sin(2 * np.pi * frequency_hz * t + 0.4)
    for start in range(500, 19_000, 750):
        values[start : start + 100] += ringing
    cleaned, bad, faults = clean(values)
    assert faults == {}
    np.testing.assert_array_equal(cleaned, values)
    assert not bad.any()


def test_slow_motion_and_standstill_have_no_spikes():
    t = np.arange(40_000) / RATE_HZ
    values = 30 * np.sin(2 * np.pi * 1.2 * t) + 0.01 * noise(40_000)
    values[20_000:] = 0.01 * noise(20_000)
    assert not spikes(values).any()
    values[33_333] += 5
    assert np.flatnonzero(spikes(values)).tolist() == [33_333]


def test_flickering_last_digit_at_rest_is_no_spike():
    values = np.round(0.2 * noise(60_000))
    assert 0.001 < np.abs(values).mean() < 0.05
    assert not spikes(values).any()
    values[30_000] = 90.0
    assert np.flatnonzero(spikes(values)).tolist() == [30_000]


# --- gaps, saturation, constant runs ---------------------------------------------------------


def test_short_gaps_are_repaired_and_long_ones_marked():
    values = noise()
    values[[100, 5000, 5001, 5002]] = np.nan
    values[8000:8004] = np.nan
    cleaned, bad, faults = clean(values)
    assert np.isfinite(cleaned).all()
    assert np.flatnonzero(bad).tolist() == [8000, 8001, 8002, 8003]
    assert faults == {
        ("gap", True): Fault("body", "gap", 4, 0.004, 5.1, True),
        ("gap", False): Fault("body", "gap", 4, 0.004, 13.0, False),
    }
    np.testing.assert_array_equal(cleaned, fill(values, np.isnan(values)))


def test_saturation_with_a_range_counts_every_sample():
    values = 20 * np.sin(2 * np.pi * np.arange(20_000) / 1e3 * 3) + noise()
    clipped = np.clip(values, -19.62, 19.62)
    _, bad, faults = clean(clipped, range_m_per_s2=19.62)
    np.testing.assert_array_equal(bad, np.abs(clipped) >= 0.999 * 19.62)
    assert faults["saturation", False].n_samples == bad.sum() > 100


def test_saturation_without_a_range_is_seen_by_its_flat_top():
    values = 20 * np.sin(2 * np.pi * np.arange(20_000) / 1e3 * 3) + noise()
    clipped = np.clip(values, -15.0, 12.5)
    bad = clean(clipped)[1]
    flat = np.zeros(len(values), dtype=bool)
    for level in (-15.0, 12.5):
        for start, stop in naive_runs(clipped == level):
            flat[start:stop] = stop - start >= 4
    np.testing.assert_array_equal(bad, flat)
    assert flat.sum() > 1000


@pytest.mark.parametrize("step", [1e-3, 1e-2])
def test_rounded_tops_of_slow_waves_are_not_saturation(step):
    values = step * np.round(np.sin(2 * np.pi * 0.9 * np.arange(20_000) / 1e3) / step)
    assert max(stop - start for start, stop in naive_runs(values == values.max())) >= 4
    assert not find_clipping(values, 4).any()


def test_held_values_longer_than_a_tenth_of_a_second_are_constant():
    values = noise()
    values[2000:2100] = values[2000]  # 0.1 s, not longer
    values[5000:5101] = values[5000]
    values[9000:12_000] = 0.0
    cleaned, bad, faults = clean(values)
    expected = np.zeros(len(values), dtype=bool)
    expected[5000:5101] = expected[9000:12_000] = True
    np.testing.assert_array_equal(bad, expected)
    assert faults == {("constant", False): Fault("body", "constant", 3101, 3.101, 10.0, False)}
    np.testing.assert_array_equal(cleaned, fill(values, expected))


def test_a_dead_channel_is_bad_throughout():
    for value in (0.0, 7.0):
        _, bad, faults = clean(np.full(5000, value))
        assert bad.all()
        assert faults.keys() == {("constant", False)}
    _, bad, faults = clean(np.full(5000, np.nan))
    assert bad.all()
    assert faults.keys() == {("gap", False)}


# --- offset, order ---------------------------------------------------------------------


def test_offset_is_reported_with_its_size():
    values = noise(60_000) + 3.0 + np.linspace(0, 2, 60_000)
    cleaned, bad, faults = clean(values)
    assert faults.keys() == {("offset", True)}
    assert faults["offset", True].size_m_per_s2 == pytest.approx(4.0, abs=0.02)
    assert not bad.any()
    np.testing.assert_array_equal(cleaned, values)


def test_faults_come_in_order_with_their_times():
    values = noise() + 9.81
    values[300] += 99
    values[500:800] = 0.0
    values[1000:1002] = np.nan
    faults = tuple(clean(values)[2].values())
    kinds = [fault.kind for fault in faults]
    assert kinds == sorted(kinds, key=KINDS.index)
    assert kinds == ["gap", "spike", "constant", "offset"]
    times = [(fault.n_samples, fault.first_s, fault.repaired) for fault in faults[:3]]
    assert times == [(2, 6.0, True), (1, 5.3, True), (300, 5.5, False)]
    assert str(faults[0]) == "body: gap of 2 samples (0.002 s), first at 6.000 s, repaired"
    assert str(faults[3]) == f"body: offset of {faults[3].size_m_per_s2:.3g} m/s2, harmless"


# --- properties ------------------------------------------------------------------------------


def faulty(seed: int, n: int) -> np.ndarray:
    """Return noise with faults of all kinds and lengths, those at the borders included."""
    rng = np.random.default_rng(seed)
    values = np.clip(rng.standard_normal(n), -2.8, 2.8)
    for _ in range(12):
        start, length = int(rng.integers(n)), int(rng.choice([1, 2, 3, 4, 30, 300]))
        kind = rng.integers(4)
        part = values[start : start + length]
        part[:] = [np.nan, part[0], 0.0, 80.0][kind]
    return values


@given(st.integers(0, 2**32 - 1), st.integers(100, 4000), st.sampled_from([1, 37, 700, 1024, 5000]))
def test_blocks_change_nothing(seed, n, block):
    values = faulty(seed, n)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cleaning, "CORE_SAMPLES", 500)
        whole, parts = clean(values, rate_hz=200.0), clean(values, block=block, rate_hz=200.0)
    np.testing.assert_array_equal(parts[0], whole[0])
    np.testing.assert_array_equal(parts[1], whole[1])
    assert parts[2] == whole[2]


def test_input_is_not_changed():
    values = faulty(0, 4000)
    before = values.copy()
    clean(values)
    np.testing.assert_array_equal(values, before)
