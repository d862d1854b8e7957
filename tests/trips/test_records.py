"""Rows of the table of trips, and parameters relative to the first trips."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from trip_records import FLAG, HALF_WIDTHS, OUTPUTS, flagged, fleet, trip

from suspnet.ground.records import Quality, TripResult
from suspnet.trains.maintenance.relative import first_trips, relative_results

FEW = ("k_p", "M_s")


def made_up(n=8, missing=(1, 5)):
    """Return trips in a random order, their names in that of falling mileage."""
    results = fleet(n, missing, with_curves=False)
    order = np.random.default_rng(4).permutation(n)
    return [replace(results[i], trip=f"trip_{n - i}") for i in order]


def test_row_is_flat_and_in_order():
    result = replace(trip(3, {"k_p": 0.9}), raw={"k_p": 0.8, "M_s": 0.7})
    row = result.row(FEW)
    assert list(row)[:12] == [
        *("trip", "mileage_km", "start", "status", "reason", "flags", "vehicle", "suspension"),
        *("bogie", "side", "train", "car"),
    ]
    limits = ["k_p_low", "k_p_high", "M_s_low", "M_s_high"]
    others = ["k_p_raw", "M_s_raw", "k_p_truth", "M_s_truth"]
    assert list(row)[12:22] == ["k_p", "M_s", *limits, *others]
    assert row["k_p"] == result.estimates["k_p"]
    assert (row["k_p_raw"], row["M_s_raw"]) == (0.8, 0.7)
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
        assert all(np.isnan(failed[name + end]) for end in ("", "_raw", "_truth"))


@pytest.mark.parametrize("n_first", [1, 2, 6])
def test_stiffness_and_damping_are_relative_to_the_median_of_the_first(n_first):
    results = made_up()
    found = relative_results(results, [], n_first)
    assert [r.trip for r in found] == [r.trip for r in results]
    known = [r for r in results if r.status == "ok"]
    for name in OUTPUTS:
        first = []
        for _ in range(n_first):  # the next one by mileage, one by one
            rest = [r for r in known if r.mileage_km not in [m for m, _ in first]]
            least = min(rest, key=lambda r: r.mileage_km)
            first.append((least.mileage_km, least.raw[name]))
        values = sorted(v for _, v in first)
        middle = (values[(n_first - 1) // 2] + values[n_first // 2]) / 2
        reference = 1.0 if name == "M_s" else middle
        for before, after in zip(results, found, strict=True):
            assert replace(after, estimates={}) == replace(before, estimates={})
            if before.status == "ok":
                expected = before.raw[name] / reference
                assert after.estimates[name] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("n_first", [7, 30])
def test_too_few_trips_are_the_reference_as_far_as_they_go(n_first):
    results = made_up()
    assert relative_results(results, [], n_first) == relative_results(results, [], 6)
    failed = [replace(r, status="error", estimates={}, raw={}) for r in results]
    assert relative_results(failed, [], n_first) == failed


def test_truth_is_relative_to_the_first_trips_too():
    results = [
        replace(
            trip(i, {"k_p": 0.8 * wear, "M_s": 1.1}),
            raw={"k_p": 0.9 * wear, "M_s": 1.2},
            truth={"k_p": 0.8 * wear, "M_s": 1.1},
        )
        for i, wear in enumerate((1.0, 1.0, 1.0, 0.5))
    ]
    last = relative_results(results, [], 3)[-1]
    assert last.estimates["k_p"] == pytest.approx(0.5)
    assert last.truth["k_p"] == pytest.approx(0.5)
    assert (last.estimates["M_s"], last.truth["M_s"]) == (1.2, 1.1)
    unknown = [replace(one, truth={}) for one in results]
    assert all(r.truth == {} for r in relative_results(unknown, [], 3))


# intervals and flags


def test_interval_reaches_from_estimate_over_factor_to_estimate_times_factor():
    result = trip(estimates={"k_p": 0.8, "c_p": 0.5}, half_widths={"k_p": np.log(2)})
    assert result.interval("k_p") == pytest.approx((0.4, 1.6))
    assert np.isnan(result.interval("c_p")).all()
    assert np.isnan(result.interval("k_s")).all()
    for half in (np.inf, 1e4):
        assert replace(result, half_widths={"k_p": half}).interval("k_p") == (0.0, np.inf)


def test_interval_relative_to_the_first_trips_holds_the_truth():
    """Where the error is noise: 400 vehicles, each read at once and relative to its first trips."""
    n_first, rng, inside, half = 4, np.random.default_rng(0), [], 0.02 * 1.645
    for _ in range(400):
        raw = [{"k_p": float(np.exp(0.02 * rng.normal()))} for _ in range(n_first + 1)]
        trips = [
            trip(i, raw=one, estimates=one, truth={"k_p": 1.0}, half_widths={"k_p": half})
            for i, one in enumerate(raw)
        ]
        low, high = relative_results(trips, [], n_first)[-1].interval("k_p")
        inside.append(low <= 1 <= high)
    # 90 % +- 1.5 %; pi / 2 is the variance of the median of many, that of few is less
    assert 0.9 - 3 * 0.015 < np.mean(inside) < 0.92 + 3 * 0.015


def test_half_widths_relative_to_the_first_trips_are_wider_by_the_median():
    trips = [replace(trip(i), half_widths=HALF_WIDTHS | {"c_s": 0.01 * (i + 1)}) for i in range(6)]
    for before, after in zip(trips, relative_results(trips, [], 3), strict=True):
        wider = {name: h * np.sqrt(1 + np.pi / 6) for name, h in HALF_WIDTHS.items()}
        wider |= {"M_s": HALF_WIDTHS["M_s"]}
        wider |= {"c_s": np.hypot(before.half_widths["c_s"], 0.02 * np.sqrt(np.pi / 6))}
        assert after.half_widths == pytest.approx(wider)
    unknown = [replace(r, half_widths={}) for r in trips]
    assert all(r.half_widths == {} for r in relative_results(unknown, [], 3))


def test_flagged_trips_are_among_the_first():
    trips = fleet(6, (1,), with_curves=False)
    trips[0] = flagged(trips[0])
    assert [r.trip for r in first_trips(trips[::-1], 3)] == ["trip_000", "trip_002", "trip_003"]
    assert len(first_trips(trips, 9)) == 5
