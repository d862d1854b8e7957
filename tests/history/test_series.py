"""All suspensions at once as arrays: the same numbers as trip by trip."""

from dataclasses import replace

import numpy as np
from trip_records import HALF_WIDTHS, OUTPUTS, flagged, fleet, trip

from suspnet.ground.records import Place
from suspnet.trains.history import arrays as module
from suspnet.trains.maintenance.series import Event


def test_arrays_hold_what_the_trips_do(store, monkeypatch):
    monkeypatch.setattr(module, "ROWS", 7)
    assert store.series() == []
    results = fleet(20, with_curves=False)
    results[3] = flagged(results[3])
    results[5] = replace(
        results[5], mileage_km=np.nan, start="", healthy_since_km=1e4, temperature_c=-4.5
    )
    other = [trip(i, with_curves=False, place=Place("x"), half_widths=HALF_WIDTHS) for i in (2, 1)]
    store.write([*results[::-1], *other])
    store.add_event("AM96 217", Place("x"), Event(5e3, "exchanged"))
    first, second = store.series()
    assert (first.place, second.place) == (Place("bogie 1, left"), Place("x"))
    assert (first.events, second.events) == ((), (Event(5e3, "exchanged"),))
    for one in (first, second):
        expected = store.read(one.vehicle, one.place)
        assert list(one.trip) == [r.trip for r in expected]
        assert list(one.flagged) == [bool(r.flags) for r in expected]
        assert list(one.done) == [r.status == "ok" for r in expected]
        for name in ("mileage_km", "healthy_since_km", "temperature_c"):
            np.testing.assert_array_equal(getattr(one, name), [getattr(r, name) for r in expected])
        np.testing.assert_array_equal(
            one.speed_m_per_s, [r.quality.speed_m_per_s for r in expected]
        )
        for name in OUTPUTS:
            for what in ("estimates", "half_widths"):
                wanted = [getattr(r, what).get(name, np.nan) for r in expected]
                np.testing.assert_array_equal(getattr(one, what)[name], wanted)
    assert np.isfinite(second.half_widths["c_s"]).all()


def test_starts_are_in_utc_where_a_zone_is_known(store):
    starts = ("2024-07-01T08:15:00", "2024-07-01T08:15:00+02:00", "")
    store.write([trip(i, with_curves=False, start=start) for i, start in enumerate(starts)])
    (one,) = store.series()
    wanted = ["2024-07-01T08:15:00", "2024-07-01T06:15:00", "NaT"]
    np.testing.assert_array_equal(one.start, np.array(wanted, dtype="datetime64[s]"))


def test_recent_trips_are_those_since_commissioning_and_maintenance(store):
    place = Place("x")
    since = [np.nan, 0.0, 0.0, 4e4, 4e4, 4e4]
    results = [
        trip(i, with_curves=False, place=place, healthy_since_km=one) for i, one in enumerate(since)
    ]
    store.write(results)
    assert list(store.series()[0].recent) == [False] * 3 + [True] * 3
    store.add_event("AM96 217", place, Event(5e4, "exchanged"))
    store.add_event("AM96 217", place, Event(2e4, "reprofiled"))
    (one,) = store.series()
    assert list(one.recent) == [False] * 4 + [True] * 2
    plain = replace(one, healthy_since_km=np.full(6, np.nan), events=())
    assert plain.recent.all()
    nowhere = {name: np.full(6, np.nan) for name in OUTPUTS}
    assert not replace(one, estimates=nowhere).recent.any()
