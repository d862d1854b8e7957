"""The series of a suspension's trips that are relative to the same healthy vehicle."""

from dataclasses import replace

import numpy as np
from trip_records import trip

from suspnet.ground.records import Commissioning, Place
from suspnet.trains.maintenance.series import Event, series_of

PLACE = Place("x")
HEALTHY = {"k_p": 1.2e6, "c_s": 3e4}
KEY = "AM96 217", PLACE


def one(i, since_km=np.nan, **fields):
    given = {"place": PLACE, "healthy_si": HEALTHY, "healthy_since_km": since_km}
    return trip(i, with_curves=False, **given | fields)


def test_trips_of_these_references_are_those_of_the_series(store):
    equal = {name: value * (1 - 0.9e-9) for name, value in HEALTHY.items()}
    other = HEALTHY | {"c_s": 3e4 * (1 + 1.1e-9)}
    fitting = [one(0), one(1, healthy_si=equal), one(2, missing=True, healthy_si={})]
    later = [one(3, 1e4), one(4, 1e4)]
    others = [one(5, healthy_si=other), one(6, healthy_si={"k_p": 1.2e6}), one(7, healthy_si={})]
    elsewhere = [one(8, place=Place("y")), one(9, vehicle="another")]
    store.write([*fitting, *later, *others, *elsewhere])
    store.add_event(*KEY, Event(1e4))
    store.add_event("another", PLACE, Event(2e4))
    nominal = Commissioning(np.nan, HEALTHY)
    found, n_others = store.comparable(*KEY, [nominal])
    assert found.equals(series_of(fitting, [Event(1e4)]))
    assert n_others == len(later) + len(others)
    found, n_others = store.comparable(*KEY, [nominal, Commissioning(1e4, HEALTHY)])
    assert found.equals(series_of([*fitting, *later], [Event(1e4)]))
    assert n_others == len(others)
    found, n_others = store.comparable(*KEY, [Commissioning(np.nan, {"k_p": np.nan})])
    assert found.equals(series_of(fitting[2:], [Event(1e4)]))
    assert store.comparable("nowhere", PLACE, [nominal]) == (None, 0)


def test_trips_just_stored_are_of_the_series_each_once(store):
    other = one(0, healthy_si={"k_p": 1.0})
    dated, elsewhere = one(1), one(1, mileage_km=np.nan, start="2024-01-05")
    lost = one(2, mileage_km=np.nan)
    undated = [replace(dated, start=""), replace(lost, start="")]
    store.write([other, dated, elsewhere, lost])
    store.write(undated)
    found, n_others = store.comparable(*KEY, [Commissioning(np.nan, HEALTHY)], [other, *undated])
    assert found.equals(series_of([other, elsewhere, *undated]))
    assert n_others == 0
