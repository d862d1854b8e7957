"""Suspensions of one car are found in the history and compared since their last maintenance."""

from dataclasses import replace

import numpy as np
import pytest
from trip_records import HALF_WIDTHS, trip

from suspnet.ground.records import Place
from suspnet.history import History
from suspnet.maintenance.series import Event, of_same_car
from suspnet.maintenance.sisters import SisterSettings, alarms_of_sisters

CORNERS = [
    Place("x", bogie, side) for bogie in ("leading", "trailing") for side in ("left", "right")
]


@pytest.fixture
def store(tmp_path):
    """Four suspensions of a car; k_s of the last is 8 % low from the 15th trip on."""
    with History(tmp_path / "history.db") as found:
        for i, place in enumerate(CORNERS):
            change = [{"k_s": 0.92 if i == 3 and n >= 15 else 1.0} for n in range(30)]
            found.write(
                [trip(100 * i + n, change[n], with_curves=False, place=place) for n in range(30)]
            )
        yield found


@pytest.fixture
def series(store):
    found = []
    for one in store.series():
        km = 2000.0 * np.arange(1, len(one.trip) + 1)
        halves = {name: np.full(len(km), half) for name, half in HALF_WIDTHS.items()}
        found.append(replace(one, mileage_km=km, half_widths=halves))
    return found


def test_suspensions_of_a_car_are_together(series):
    named = [replace(one, place=replace(one.place, car="7")) for one in series]
    moved = replace(named[0], place=replace(named[0].place, suspension="y"))
    other = replace(series[0], place=replace(series[0].place, suspension="z"))
    cars = of_same_car([*series, *named, moved, other])
    assert [len(one) for one in cars] == [4, 5]


def test_the_odd_suspension_of_the_history_is_told(series):
    found = alarms_of_sisters(series, SisterSettings())
    assert list(found) == [("AM96 217", CORNERS[3])]
    (alarm,) = found["AM96 217", CORNERS[3]]
    assert alarm.parameter == "k_s"
    assert alarm.is_open
    assert 15 * 2000 < alarm.begin_km <= 21 * 2000
    assert alarm.words.endswith("% below its sisters (median of 3)")


def test_flagged_trips_and_those_before_maintenance_do_not_count(series):
    late = [replace(one, events=(Event(59_000.0, "exchanged"),)) for one in series]
    assert alarms_of_sisters([*series[:3], late[3]], SisterSettings()) == {}
    doubtful = replace(series[3], flagged=np.ones(30, dtype=bool))
    assert alarms_of_sisters([*series[:3], doubtful], SisterSettings()) == {}
