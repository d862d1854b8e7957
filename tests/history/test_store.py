"""The store keeps trips and events: what is written is read, once, whoever writes at once."""

import math
import sqlite3
from dataclasses import asdict, replace

import numpy as np
import pytest
import sqlalchemy
from empty_stores import empty_store
from hypothesis import given, settings
from hypothesis import strategies as st
from trip_records import fleet, trip

from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place, TripResult
from suspnet.trains.history import History, HistoryError
from suspnet.trains.history.schema import SCHEMA, suspensions
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event

PLACE = Place("bogie 1, left")
VEHICLE = "AM96 217"
ALARMS = [
    Alarm("k_p", Cause.CHANGE, Severity.NOTICE, 10_000.0, words="k_p fell"),
    Alarm("k_p", Cause.LIMIT, Severity.ACT, 20_000.0, 30_000.0),
    Alarm("c_s", Cause.LIMIT, Severity.ACT, 20_000.0),
]
SEEN = Acknowledgement("k_p", Cause.CHANGE, Severity.NOTICE, 4e4, "Kim", "2026-11-22T13:00:00Z")


def same(one, other):
    """Return whether two results are equal, NaN to NaN and whatever the order of parameters."""
    texts = []
    for result in (one, other):
        fields = asdict(replace(result, curves=None))
        texts.append(
            {k: sorted(v.items()) if isinstance(v, dict) else v for k, v in fields.items()}
        )
    return repr(texts[0]) == repr(texts[1])


# reference


def test_trips_are_read_back_as_they_were_written(store):
    results = fleet(with_curves=False)
    store.write(results)
    found = store.read(VEHICLE, PLACE)
    assert len(found) == len(results)
    assert all(map(same, found, results))
    assert store.places() == [(VEHICLE, PLACE)]


def test_last_trips_before_one_have_an_estimate(store):
    results = fleet(8, missing=(4,), with_curves=False)
    store.write([*results[::-1], replace(results[2], place=Place("other"))])
    found = store.last_before(results[6], 3)
    assert [one.trip for one in found] == [results[i].trip for i in (2, 3, 5)]
    assert store.last_before(results[0], 3) == []
    assert store.last_before(replace(results[6], mileage_km=math.inf), 1)[0].trip == "trip_007"


words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)


@settings(max_examples=4, deadline=None)
@given(
    words,
    words,
    st.dictionaries(st.sampled_from(["k_p", "M_s"]), st.floats(allow_nan=False)),
    st.floats(allow_infinity=False),
)
def test_whatever_a_result_holds_comes_back(tmp_path_factory, name, reason, values, mileage_km):
    place = Place(suspension=name, train=reason)
    given_ = TripResult(name, "a.yaml", "am96", place, mileage_km, reason=reason, estimates=values)
    with History(tmp_path_factory.mktemp("store") / "history.db") as store:
        store.write([given_])
        assert same(store.read("am96", place)[0], given_)


@pytest.mark.parametrize("name", ["suspension", "train", "car", "vehicle"])
def test_names_are_as_short_as_those_of_manifests(store, name):
    for length in (100, 101):
        text = length * "x"
        place = Place() if name == "vehicle" else Place(**{name: text})
        given_ = trip(0, with_curves=False, place=place, vehicle=text if name == "vehicle" else "a")
        if length == 100:
            store.write([given_])
        else:
            with pytest.raises(ValueError, match="a name must have at most 100 characters"):
                store.write([given_])
    assert len(store.places()) == 1


# property


def test_writing_a_trip_again_replaces_it(store):
    results = fleet(6, missing=(), with_curves=False)
    store.write(results)
    store.write(results[:3])
    changed = replace(results[2], estimates={"k_p": 0.5}, flags="odd")
    store.write([changed])
    found = store.read(VEHICLE, PLACE)
    assert len(found) == 6
    assert same(found[2], changed)
    assert all(map(same, found[:2], results[:2]))


def test_suspensions_and_trips_of_other_days_are_kept_apart(store):
    places = [
        Place("a"),
        Place("a", "leading"),
        Place("a", "leading", "left"),
        Place("a", train="1"),
        Place("a", car="1"),
    ]
    for i, place in enumerate(places):
        store.write([trip(i, with_curves=False, place=place)])
    store.write([trip(7, with_curves=False, place=places[0], vehicle="ice3")])
    assert [len(store.read(VEHICLE, place)) for place in places] == [1] * 5
    assert len(store.places()) == 6
    assert store.read("ice3", places[1]) == []
    first = trip(0, with_curves=False)
    others = [replace(first, start="2025-01-01"), replace(first, mileage_km=math.nan)]
    for _ in range(2):
        store.write([first, *others])
    assert len(store.read(VEHICLE, PLACE)) == 3


def test_all_or_none_of_some_trips_are_kept(store):
    broken = replace(trip(1, with_curves=False), reason=object())
    with pytest.raises(HistoryError, match="cannot be used"):
        store.write([trip(0, with_curves=False), broken])
    assert store.places() == []


def test_events_are_kept_by_mileage_and_once(store):
    store.write([trip(0, with_curves=False)])
    events = [
        Event(9e4, "reprofiled"),
        Event(5e4, "exchanged", "new primary dampers"),
        Event(9e4, "exchanged"),
    ]
    for event in [*events, replace(events[0], words="wheels turned")]:
        store.add_event(VEHICLE, PLACE, event)
    found = store.events(VEHICLE, PLACE)
    assert [event.mileage_km for event in found] == [5e4, 9e4, 9e4]
    assert [event.words for event in found] == ["new primary dampers", "", "wheels turned"]
    assert str(found[0]) == "new primary dampers at 50 000 km"


def test_alarms_are_replaced_as_a_whole(store):
    store.write([trip(0, with_curves=False)])
    for _ in range(2):
        store.keep_alarms(VEHICLE, PLACE, ALARMS[::-1])
    found = store.alarms(VEHICLE, PLACE)
    assert [one.begin_km for one in found] == [1e4, 2e4, 2e4]
    assert repr(sorted(found, key=repr)) == repr(sorted(ALARMS, key=repr))
    assert repr(store.all_alarms()) == repr({(VEHICLE, PLACE): found})
    store.keep_alarms(VEHICLE, PLACE, ALARMS[1:2])
    assert store.alarms(VEHICLE, PLACE) == ALARMS[1:2]
    store.keep_alarms(VEHICLE, PLACE, [])
    assert store.alarms(VEHICLE, PLACE) == []
    assert store.all_alarms() == {}


def test_acknowledgements_outlive_their_alarms(store):
    store.write([trip(0, with_curves=False)])
    store.keep_alarms(VEHICLE, PLACE, ALARMS)
    later = replace(SEEN, at="2026-11-22T14:00:00Z", words="ordered")
    store.acknowledge(VEHICLE, PLACE, [later, SEEN])
    store.keep_alarms(VEHICLE, PLACE, [])
    store.acknowledge(VEHICLE, PLACE, [replace(later, words="mounted")])
    expected = [SEEN, replace(later, words="mounted")]
    assert store.acknowledgements(VEHICLE, PLACE) == expected
    assert store.all_acknowledgements() == {(VEHICLE, PLACE): expected}
    assert store.acknowledgements(VEHICLE, Place("other")) == []


# failure


def test_data_of_an_unknown_suspension_are_refused_as_a_whole(store):
    unknown = "am96", Place("x")
    with pytest.raises(HistoryError, match="no trip of am96: x is stored here; known: none"):
        store.keep_alarms(*unknown, ALARMS)
    store.write([trip(0, with_curves=False)])
    for change in (
        lambda: store.add_event(*unknown, Event(1.0)),
        lambda: store.acknowledge(*unknown, [SEEN]),
        lambda: store.keep_all_alarms({(VEHICLE, PLACE): ALARMS, unknown: ALARMS}),
    ):
        with pytest.raises(HistoryError, match="x is stored here; known: AM96 217: bogie 1"):
            change()
    assert store.all_alarms() == {}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((np.nan,), "mileage in km"),
        ((1.0, "repaired"), "one of exchanged, reprofiled, sensor, other"),
    ],
)
def test_a_wrong_event_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Event(*fields)


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        (
            f"UPDATE suspnet_version SET schema = {SCHEMA - 1}",
            f"a store of version {SCHEMA - 1}, this suspnet reads version {SCHEMA}",
        ),
        ("CREATE TABLE trips (id INTEGER)", "not a store of suspnet"),
    ],
)
def test_stores_of_other_versions_and_other_applications_are_refused(tmp_path, statement, message):
    path = tmp_path / "history.db"
    if statement.startswith("UPDATE"):
        History(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute(statement)
    connection.close()
    with pytest.raises(HistoryError, match=message):
        History(path)


def test_a_store_with_a_column_of_earlier_versions_is_read_and_written(tmp_path):
    path, (first, second) = tmp_path / "history.db", fleet(2, with_curves=False)
    with History(path) as store:
        store.write([first])
    with sqlite3.connect(path) as connection:
        connection.execute("ALTER TABLE trips ADD COLUMN features_found VARCHAR")
        connection.execute("UPDATE trips SET features_found = '16 of 16'")
    connection.close()
    with History(path) as store:
        store.write([second])
        assert all(map(same, store.read(VEHICLE, PLACE), [first, second]))


def test_new_tables_next_to_those_of_others_on_a_server_are_reported(tmp_path, caplog):
    place = empty_store("postgresql", tmp_path)
    url = place.replace("postgresql:", "postgresql+psycopg:", 1)
    engine = sqlalchemy.create_engine(url)
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE notes (words TEXT)")
    for _ in range(2):
        with History(place) as store:
            store.write([trip(0, with_curves=False)])
    with engine.begin() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM notes").scalar() == 0
    engine.dispose()
    (line,) = [one.getMessage() for one in caplog.records]
    assert "new tables of a store, next to 1 other tables" in line


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("mysql://host/x", "not mysql://"),
        ("sqlite://", "path of a file"),
        ("://", "not a database URL"),
    ],
)
def test_a_wrong_url_is_refused(url, message):
    with pytest.raises(HistoryError, match=message):
        History(url)


def test_the_password_is_not_shown():
    pytest.importorskip("psycopg", reason="needs suspnet[postgres]")
    with pytest.raises(HistoryError) as caught:
        History("postgresql://me:secret@127.0.0.1:1/x")
    assert "secret" not in str(caught.value)
    assert "127.0.0.1" in str(caught.value)


def test_a_trip_that_was_kept_without_its_date_is_the_same_trip(store):
    store.write([trip(i, start="") for i in range(3)])
    store.write([trip(i) for i in range(2)])  # its files said the date this time
    found = store.read(VEHICLE, PLACE)
    assert [one.trip for one in found] == ["trip_000", "trip_001", "trip_002"]
    assert [one.start for one in found] == [trip(0).start, trip(1).start, ""]
    assert [one.trip for one in store.responses(VEHICLE, PLACE)] == [r.trip for r in found]
    store.write([trip(0, start="2025-01-01"), trip(0, start="", mileage_km=1.0)])
    assert len(store.read(VEHICLE, PLACE)) == 5  # another date or mileage is another trip


def test_columns_of_suspensions_are_in_the_order_of_older_stores():
    places = ["train", "car", "suspension", "bogie", "side"]
    assert suspensions.columns.keys() == ["id", "vehicle", *places, "revision"]
