"""A failing sensor is named within few trips, and is never a failing damper."""

from dataclasses import replace

import numpy as np
import pytest
from trip_records import trip

from suspnet.ground.findings import parts_of
from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.ground.records import SensorHealth, sensors_from_text, sensors_text
from suspnet.trains.history import History
from suspnet.trains.maintenance.alarms import watch
from suspnet.trains.maintenance.sensors import IN_A_ROW, N_FIRST, sensor_trends
from suspnet.trains.maintenance.series import Event, series_of
from suspnet.trains.maintenance.state import SENSOR_FAILED, State
from suspnet.trains.pages.tables import sensor_rows

PAIRS = [f"{place} {side}" for place in ("axle_box", "bogie", "body") for side in ("left", "right")]
SINGLES = ["axle_box", "bogie", "body"]
SPREADS = SensorHealth(noise=0.1, gain=0.015, tilt=0.03, delay_s=1e-3, faulty=1e-3)
"""Deviations on trips of 20 minutes as they were measured; of the noise that of its logarithm."""
BEGIN = 12


def health(n_trips, names=PAIRS, seed=0, changes=None):
    """Return the texts of trips; `changes` (trip, sensor, number) gives what a failure adds."""
    rng, texts = np.random.default_rng(seed), []
    for i in range(n_trips):
        rough = 0.3 * rng.standard_normal()  # the track's share of all noise
        found = {}
        for name in names:
            x = dict(zip(vars(SPREADS), rng.standard_normal(5), strict=True))
            x = {k: float(v * getattr(SPREADS, k)) for k, v in x.items()}
            x["faulty"] = abs(x["faulty"])
            if name == "body":
                x |= dict.fromkeys(("gain", "tilt", "delay_s"), np.nan)
            for number in x:
                x[number] += changes(i, name, number) if changes else 0.0
            found[name] = SensorHealth(**x | {"noise": 1e-3 * np.exp(x["noise"] + rough)})
        texts.append(sensors_text(found))
    return texts


def trends(texts, replaced=()):
    found = sensor_trends(texts, 1e3 * np.arange(1, len(texts) + 1), replaced)
    return {one.name: one for one in found}


def failing(sensor, number, per_trip, step=0.0):
    """Return the changes of one number of one sensor, growing from trip ``BEGIN`` on."""

    def changes(i, name, which):
        is_meant = (name, which) == (sensor, number) and i >= BEGIN
        return step + per_trip * (i - BEGIN + 1) if is_meant else 0.0

    return changes


def results_of(texts, **estimates):
    """Return trips with these sensors; estimates by name are values of each trip."""
    found = []
    for i, text in enumerate(texts):
        one = trip(i, with_curves=False)
        values = {name: float(value[i]) for name, value in estimates.items()}
        quality = replace(one.quality, sensors=text)
        found.append(replace(one, quality=quality, estimates=one.estimates | values, flags=""))
    return found


# reference


def test_the_text_of_a_trip_is_read_back():
    given = {"body left": SensorHealth(1.5e-3, 0.02, np.nan, -1e-4, 0.0), "bogie": SensorHealth()}
    found = sensors_from_text(sensors_text(given))
    assert found.keys() == given.keys()
    for name, one in given.items():
        np.testing.assert_equal(vars(found[name]), vars(one))
    assert sensors_text({}) == ""
    for text in ("", "{", "[1]", '{"a": 1}', '{"a": ["b"]}', '{"a": [1, 2, 3, 4, 5, 6]}'):
        assert sensors_from_text(text) == {}


@pytest.mark.parametrize("sensor", ["axle_box left", "bogie right"])
@pytest.mark.parametrize(
    ("number", "per_trip", "kind", "most"),
    [
        ("gain", 0.02, "sensor-gain", 9),
        ("gain", -0.02, "sensor-gain", 9),
        ("noise", 0.25, "sensor-noise", 7),
        ("faulty", 0.02, "sensor-drop-outs", 4),
        ("delay_s", 0.004, "sensor-late", 5),
    ],
)
def test_a_failing_sensor_is_named_within_few_trips(sensor, number, per_trip, kind, most):
    for seed in range(3):
        found = trends(health(40, seed=seed, changes=failing(sensor, number, per_trip)))
        assert [one.name for one in found.values() if one.active.any()] == [sensor]
        begin = int(np.flatnonzero(found[sensor].active)[0])
        assert BEGIN + IN_A_ROW - 1 <= begin < BEGIN + most
        assert kind in [one.kind for one in parts_of(found[sensor].words(begin))]


def test_a_chance_does_not_hide_a_trip_of_a_worn_part():
    """1,200 healthy trips: one in 5,000 and sensor misleads, though 1 % exceed four deviations."""
    found = [one for seed in range(6) for one in trends(health(200, seed=seed)).values()]
    beyond = np.concatenate([one.beyond["gain"] | one.beyond["delay_s"] for one in found])
    misleads = np.concatenate([one.misleads for one in found])
    assert misleads.mean() <= 0.0005 < beyond.mean()
    # one trip of a sensor that is far off misleads at once
    odd = trends(
        health(40, changes=lambda i, *of: 0.5 * (of == ("bogie left", "gain") and i == 20))
    )
    assert odd["bogie left"].misleads.nonzero()[0].tolist() == [20]
    assert not odd["bogie left"].active.any()


def test_of_two_sensors_both_are_named():
    found = trends(health(40, changes=failing("body left", "gain", 0.02)))
    active = {one.name: one.words(39) for one in found.values() if one.active[39]}
    assert {name: words.values["fellow"] for name, words in active.items()} == {
        "body left": "body right",
        "body right": "body left",
    }


# limits


def test_healthy_sensors_a_rough_track_and_a_worn_side_raise_no_alarm():
    def rough(i, name, number):
        return 1.5 if number == "noise" and i >= BEGIN else 0.0

    def worn(i, name, number):
        is_worn = name == "bogie left" and i > 20
        return {"gain": 0.1, "tilt": 0.15}.get(number, 0.0) if is_worn else 0.0

    cases = [(names, seed, None) for seed in range(8) for names in (PAIRS, SINGLES)]
    for names, seed, changes in [*cases, (PAIRS, 0, rough), (PAIRS, 0, worn)]:
        found = trends(health(40, names, seed, changes))
        assert not any(one.active.any() for one in found.values())


def test_there_is_no_alarm_before_the_reference():
    texts = health(N_FIRST + 1, changes=lambda i, *_: float(i))
    assert not any(one.active.any() for one in trends(texts).values())
    assert sensor_trends([""] * 3, np.arange(3.0)) == []


def test_an_alarm_ends_with_the_failure():
    passing = failing("bogie left", "faulty", 0.0, step=0.1)
    texts = health(40, changes=lambda i, *which: passing(i, *which) if i < 20 else 0.0)
    active = np.flatnonzero(trends(texts)["bogie left"].active)
    assert (active[0], active[-1]) == (BEGIN + IN_A_ROW - 1, 20 + IN_A_ROW - 2)


# sensors and parts


def test_a_sensor_that_drifts_is_no_failing_damper(tmp_path):
    texts = health(30, changes=failing("bogie left", "gain", 0.03))
    # what the drift makes of an estimate
    c_p = np.r_[np.ones(BEGIN), 1 - 0.05 * np.arange(1, 30 - BEGIN + 1)].clip(0.2)
    without = series_of(results_of([""] * 30, c_p=c_p))
    series = series_of(results_of(texts, c_p=c_p))
    assert any(one.parameter == "c_p" for one in watch(without, DEFAULT_LIMITS).alarms)
    (alarm,) = watch(series, DEFAULT_LIMITS).alarms
    assert (alarm.parameter, alarm.cause) == ("bogie left", Cause.SENSOR)
    assert (alarm.severity, alarm.is_open) == (Severity.NOTICE, True)
    assert alarm.words.startswith("sensor bogie left: sensitivity +")
    state = State(series, DEFAULT_LIMITS, watch(series, DEFAULT_LIMITS))
    assert state.severity == Severity.UNKNOWN
    assert state.reason.startswith(SENSOR_FAILED)
    rows = {row["name"]: row for row in sensor_rows(series)}
    assert [name for name, row in rows.items() if row["active"]] == ["bogie left"]
    assert rows["bogie left"]["beyond"]["gain"]
    assert rows["body left"]["state"] == "as in its first trips"


def test_a_replaced_sensor_has_a_new_reference_and_the_parts_keep_theirs(tmp_path):
    texts = health(30, changes=failing("bogie left", "gain", 0.0, step=0.2))
    results = results_of(texts)
    vehicle, place = results[0].vehicle, results[0].place
    event = Event(results[BEGIN].mileage_km, "sensor", "bogie left replaced")
    with History(tmp_path / "fleet.db") as store:
        store.write(results)
        (before,) = store.series()
        store.add_event(vehicle, place, event)
        (after,) = store.series()
    assert before.equals(series_of(results))
    assert [one.parameter for one in watch(before, DEFAULT_LIMITS).alarms] == ["bogie left"]
    assert watch(after, DEFAULT_LIMITS).alarms == []
    assert after.repairs == []
    assert len(after.between) == 1
    assert after.recent.all()
    # one of the right sensor leaves the left one's reference
    of_other = replace(after, events=(replace(event, words="bogie right"),))
    assert [one.parameter for one in watch(of_other, DEFAULT_LIMITS).alarms] == ["bogie left"]
