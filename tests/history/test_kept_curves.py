"""Curves of the first and the newest trips are kept, as they were, and checked when read."""

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest
import sqlalchemy as sql
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from trip_records import curves, trip

from suspnet.ground.records import Place
from suspnet.ground.storage import dump_arrays
from suspnet.trains.history import History, HistoryError
from suspnet.trains.history.arrays import N_NEWEST
from suspnet.trains.history.schema import curves as table

PLACE = Place("bogie 1, left")
VEHICLE = "AM96 217"
FIELDS = ("frequencies_hz", "responses", "coherences", "deviations")


def kept(store):
    return [one.trip for one in store.responses(VEHICLE, PLACE)]


# reference


def test_curves_are_read_back_as_they_were_written(store):
    results = [trip(i) for i in range(3)]
    store.write(results)
    found = store.responses(VEHICLE, PLACE)
    assert [one.trip for one in found] == [r.trip for r in results]
    assert [one.mileage_km for one in found] == [r.mileage_km for r in results]
    assert [one.start for one in found] == [r.start for r in results]
    for one, result in zip(found, results, strict=True):
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(one, name), getattr(result.curves, name))
    assert np.abs(found[0].responses).max() > 1


@settings(max_examples=4, deadline=None)
@given(st.data(), st.integers(0, 5))
def test_whatever_curves_hold_comes_back(tmp_path_factory, data, n_freq):
    def drawn(kind, *shape):
        return data.draw(arrays.arrays(kind, (*shape, n_freq)))

    values = {
        "frequencies_hz": drawn(np.float64),
        "responses": drawn(np.complex128, 2),
        "coherences": drawn(np.float64, 2),
        "deviations": drawn(np.float64, 2),
    }
    with History(tmp_path_factory.mktemp("store") / "history.db") as store:
        store.write([replace(trip(0), curves=replace(curves(), **values))])
        (found,) = store.responses(VEHICLE, PLACE)
    for name, array in values.items():
        assert getattr(found, name).dtype == array.dtype
        np.testing.assert_array_equal(getattr(found, name), array)


# property


@settings(max_examples=5, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([math.nan, *(1e3 * i for i in range(12))]), st.booleans()),
        min_size=1,
        max_size=14,
        unique_by=lambda one: repr(one[0]),
    ),
    st.lists(st.integers(1, 4), min_size=14, max_size=14),
)
def test_the_first_and_the_newest_are_kept_in_any_order(tmp_path_factory, given_, sizes):
    results = [
        replace(trip(i, with_curves=has_curves), mileage_km=km)
        for i, (km, has_curves) in enumerate(given_)
    ]
    with History(tmp_path_factory.mktemp("store") / "history.db") as store:
        rest = list(results)
        for size in sizes:
            store.write(rest[:size])
            rest = rest[size:]
        found = store.responses(VEHICLE, PLACE)
    ordered = sorted(
        (r for r in results if r.curves), key=lambda r: (not math.isnan(r.mileage_km), r.mileage_km)
    )
    newest = [r.trip for r in ordered[-N_NEWEST:]]
    assert [one.trip for one in found][-N_NEWEST:] == newest
    assert len(found) == min(len(ordered), N_NEWEST + 1)
    assert not ordered or found[0].trip == ordered[0].trip


def test_live_trips_push_older_ones_out(store, by_hand):
    for i in range(8):
        store.write([trip(i, missing=i in (0, 6))])
    assert kept(store) == ["trip_001", "trip_004", "trip_005", "trip_007"]
    assert by_hand(sql.select(sql.func.count()).select_from(table)) == 4


def test_a_trip_read_again_replaces_its_curves(store):
    store.write([trip(i) for i in range(5)])
    store.write([trip(4, change={"k_p": 0.5}), trip(0, missing=True)])
    found = store.responses(VEHICLE, PLACE)
    assert [one.trip for one in found] == ["trip_002", "trip_003", "trip_004"]
    expected = trip(4, change={"k_p": 0.5}).curves
    np.testing.assert_array_equal(found[-1].responses, expected.responses)


# failure


@pytest.mark.parametrize(
    ("content", "is_signed", "message"),
    [
        (b"", False, r"AM96 217: bogie 1, left: .* of trip_000 is damaged"),
        (b"no arrays", False, "of trip_000 is damaged"),
        (dump_arrays({"real": np.zeros(3)}), False, "of trip_000 is damaged"),
        # arrays of other shapes, with their own hash
        (dump_arrays({"real": np.zeros(3)}), True, r"is damaged: it holds .*real"),
    ],
)
def test_altered_curves_are_one_clear_error(store, by_hand, content, is_signed, message):
    store.write([trip(0)])
    digest = {"sha256": hashlib.sha256(content).hexdigest()} if is_signed else {}
    by_hand(table.update().values(arrays=content, **digest))
    with pytest.raises(HistoryError, match=message):
        store.responses(VEHICLE, PLACE)
    assert len(store.read(VEHICLE, PLACE)) == 1
