"""Rows of the table of trips, and ends of intervals."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from trip_records import FLAG, OUTPUTS, flagged, trip

from suspnet.ground.records import Quality, TripResult

FEW = ("k_p", "M_s")


def test_row_is_flat_and_in_order():
    result = trip(3, {"k_p": 0.9})
    row = result.row(FEW)
    assert list(row)[:12] == [
        *("trip", "mileage_km", "start", "status", "reason", "flags", "vehicle", "suspension"),
        *("bogie", "side", "train", "car"),
    ]
    limits = ["k_p_low", "k_p_high", "M_s_low", "M_s_high"]
    others = ["k_p_truth", "M_s_truth"]
    assert list(row)[12:20] == ["k_p", "M_s", *limits, *others]
    assert row["k_p"] == result.estimates["k_p"]
    assert row["k_p_truth"] == 0.9
    assert {name: row[name] for name in asdict(Quality())} == asdict(result.quality)
    assert (row["manifest"], row["mileage_km"]) == ("trip_003.yaml", 40_000.0)
    assert all(isinstance(value, str | float | int) for value in row.values())
    row = flagged(trip(3), k_p=0.5).row(FEW)
    assert row["flags"] == FLAG
    ends = (0.5 * np.exp(-0.0033), 0.5 * np.exp(0.0033))
    assert (row["k_p_low"], row["k_p_high"]) == pytest.approx(ends)


def test_row_of_a_failed_trip_has_the_same_columns():
    whole, failed = trip(0).row(OUTPUTS), TripResult("x", "x.yaml").row(OUTPUTS)
    assert list(failed) == list(whole)
    assert [type(v) for v in failed.values()] == [type(v) for v in whole.values()]
    for name in OUTPUTS:
        assert all(np.isnan(failed[name + end]) for end in ("", "_truth"))


# intervals and flags


def test_interval_reaches_from_estimate_over_factor_to_estimate_times_factor():
    result = trip(estimates={"k_p": 0.8, "c_p": 0.5}, half_widths={"k_p": np.log(2)})
    assert result.interval("k_p") == pytest.approx((0.4, 1.6))
    assert np.isnan(result.interval("c_p")).all()
    assert np.isnan(result.interval("k_s")).all()
    for half in (np.inf, 1e4):
        assert replace(result, half_widths={"k_p": half}).interval("k_p") == (0.0, np.inf)
