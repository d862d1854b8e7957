"""Revisions say which suspensions changed: each change raises them, whoever writes at once."""

import threading
from dataclasses import replace

import pytest
import sqlalchemy
from forked import forks
from trip_records import trip

from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place
from suspnet.trains.history import History
from suspnet.trains.history.database import database_url
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm
from suspnet.trains.maintenance.series import Event

VEHICLE = "AM96 217"
PLACES = [Place("a"), Place("b")]
KEYS = [(VEHICLE, place) for place in PLACES]
ALARM = Alarm("k_p", Cause.LIMIT, Severity.ACT, 20_000.0)
SEEN = Acknowledgement("k_p", Cause.LIMIT, Severity.ACT, 4e4, "Kim", "2026-11-22T13:00:00Z")
N_WRITERS, N_TRIPS = 2, 2


def write_many(place, worker):
    """Write trips of both suspensions one at a time, in an order of its own, and alarms."""
    with History(place) as store:
        for i in range(N_TRIPS):
            number = 100 * worker + i
            both = [trip(number, with_curves=i % 2 == 0, place=where) for where in PLACES]
            store.write(both[:: 1 - 2 * (worker % 2)])
            alarms = [replace(ALARM, begin_km=float(number))]
            store.keep_all_alarms(dict.fromkeys(KEYS[:: 2 * (worker % 2) - 1], alarms))


# property


@pytest.mark.representatives(5)
@pytest.mark.parametrize(
    "change",
    [
        lambda store: store.write([trip(1, place=PLACES[0])]),
        lambda store: store.write([trip(0, place=PLACES[0])]),
        lambda store: store.add_event(*KEYS[0], Event(1e4)),
        lambda store: store.keep_alarms(*KEYS[0], [ALARM]),
        lambda store: store.acknowledge(*KEYS[0], [SEEN]),
    ],
    ids=["trip", "trip again", "maintenance", "alarm", "acknowledgement"],
)
def test_each_change_raises_the_revision_of_its_suspension_alone(store, change):
    store.write([trip(0, place=place) for place in PLACES])
    before = store.revisions()
    assert set(before) == set(KEYS)
    change(store)
    after = store.revisions()
    assert after[KEYS[0]] > before[KEYS[0]]
    assert after[KEYS[1]] == before[KEYS[1]]


def test_alarms_as_they_were_raise_nothing(store):
    store.write([trip(0, place=PLACES[0])])
    open_and_over = [ALARM, replace(ALARM, parameter="c_s", end_km=30_000.0)]
    store.keep_alarms(*KEYS[0], open_and_over)
    before = store.revisions()
    store.keep_alarms(*KEYS[0], open_and_over[::-1])
    store.keep_all_alarms({})
    store.write([])
    assert store.revisions() == before
    store.keep_alarms(*KEYS[0], [ALARM])
    assert store.revisions() != before


def test_writers_at_once_lose_no_trip_and_no_revision(store, place):
    workers = [forks().Process(target=write_many, args=(place, i)) for i in range(N_WRITERS)]
    for worker in workers:
        worker.start()
    contents = {}
    while any(worker.is_alive() for worker in workers):
        before, series, after = store.revisions(), store.series(), store.revisions()
        for one in series:
            key = one.vehicle, one.place
            if before.get(key) == after[key]:  # what was read is of this revision
                contents.setdefault((key, after[key]), set()).add(tuple(one.trip))
        workers[0].join(0.3)
    for worker in workers:
        worker.join(120)
        assert worker.exitcode == 0
    revisions = store.revisions()
    assert all(revisions[key] >= N_WRITERS * N_TRIPS for key in KEYS)
    assert all(len(found) == 1 for found in contents.values())
    assert [len(s.trip) for s in store.series()] == [N_WRITERS * N_TRIPS] * 2
    assert all(len(store.responses(*key)) == N_WRITERS for key in KEYS)
    assert [len(store.alarms(*key)) for key in KEYS] == [1, 1]


def test_a_reader_waits_for_no_writer_that_has_not_committed(store, place):
    store.write([trip(0, place=PLACES[0])])
    found = []
    engine = sqlalchemy.create_engine(database_url(place))
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE suspensions SET revision = 99")
        reader = threading.Thread(target=lambda: found.append(store.revisions()))
        reader.start()
        reader.join(30)
        assert found == [{KEYS[0]: 1}]
    engine.dispose()
    assert store.revisions() == {KEYS[0]: 99}


def test_some_suspensions_are_read_alone(store):
    store.write([trip(i, with_curves=False, place=place) for place in PLACES for i in range(3)])
    store.add_event(*KEYS[1], Event(1e4))
    (one,) = store.series([KEYS[1], ("am96", Place("unknown"))])
    assert one.equals(store.series()[1])
    assert not one.equals(store.series()[0])
    assert one.events == (Event(1e4),)
    assert store.series([]) == []
