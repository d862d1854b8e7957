"""Trips of earlier folders, kept in the store, are in tables, trend and report."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trip_fixtures import changed, recalled_trip
from trip_records import trip

from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.estimate import HealthyValues
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding
from suspnet.ground.parameters import COMPONENTS, DEFAULT_LIMITS, Cause
from suspnet.ground.records import ERROR, SensorHealth, sensors_text
from suspnet.trains.history import History
from suspnet.trains.jobs import fleet as fleet_module
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.maintenance import Acknowledgement, Severity
from suspnet.trains.maintenance.alarms import watch
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.series import Event, series_of
from suspnet.trains.trips.earlier import keep_trips, with_earlier

SETTINGS = FleetSettings(TripSettings())
SEEN = "2026-02-01T08:00:00+00:00"


@pytest.fixture
def store(tmp_path):
    with History(tmp_path / "history.db") as found:
        yield found


@pytest.fixture
def folders(manifests, tmp_path):
    """Two folders of three trips each, one after the other, and a broken one in the second."""
    for name, chosen in (("may", manifests[:3]), ("june", manifests[3:])):
        (tmp_path / name).mkdir()
        for i, path in enumerate(chosen):
            changed(path, tmp_path / name, f"trip_{i}")
    (tmp_path / "june" / "broken.yaml").write_text("[")
    return tmp_path / "may", tmp_path / "june"


def read(folder, model, out, store):
    (one,) = evaluate_fleet(folder, [model], out, SETTINGS, progress=False, store=store)
    return one.results


def test_a_folder_is_read_with_the_trips_of_earlier_ones(
    folders, model, store, no_figures, recalled, tmp_path, caplog
):
    first = read(folders[0], model, tmp_path / "one", store)
    both = read(folders[1], model, tmp_path / "two", store)
    assert [r.trip for r in first] == ["trip_0", "trip_1", "trip_2"]
    assert [r.trip for r in both] == ["trip_0", "trip_1", "trip_2"] * 2 + ["broken"]
    assert [r.estimates for r in both[:3]] == [r.estimates for r in first]
    metrics = json.loads((tmp_path / "two" / "metrics.json").read_text())
    assert metrics["details"]["history"].endswith("history.db")
    assert metrics["trends"][0]["n_trips"] == 6
    place = both[0].place
    assert len(store.read("am96", place)) == 6  # the broken one may be whole another day
    kept = store.responses("am96", place)
    assert [one.trip for one in kept] == ["trip_0", *["trip_0", "trip_1", "trip_2"]]
    np.testing.assert_array_equal(kept[-1].responses, both[5].curves.responses)
    # trips relative to another healthy vehicle are left out, and since maintenance there is one
    other = replace(both[0], trip="other", healthy_si={k: 2.0 for k in both[0].healthy_si})
    store.write([other])
    store.add_event("am96", place, Event(both[5].mileage_km, "exchanged", "new springs"))
    again = read(folders[1], model, tmp_path / "three", store)
    assert [(r.trip, r.estimates) for r in again] == [(r.trip, r.estimates) for r in both]
    assert "1 earlier trips of" in caplog.text
    metrics = json.loads((tmp_path / "three" / "metrics.json").read_text())
    assert metrics["trends"][0]["n_trips"] == 1
    assert metrics["maintenance"][0]["words"] == "new springs"


def test_what_several_trips_name_is_stored_with_the_curves_of_all(
    folders, model, store, no_figures, recalled, tmp_path, monkeypatch
):
    read(folders[0], model, tmp_path / "one", store)
    worn = Finding("worn", odds="9 : 1")
    monkeypatch.setattr(
        fleet_module, "with_joint_verdicts", lambda all_, *_: [replace(r, worn=worn) for r in all_]
    )
    both = read(folders[1], model, tmp_path / "two", store)
    stored = store.read("am96", both[0].place)
    # a trip of an earlier folder has no curves here, and keeps what is stored
    assert [one.worn for one in stored] == [""] * 3 + [worn] * 3
    kept = store.responses("am96", both[0].place)
    assert [one.trip for one in kept] == ["trip_0", *["trip_0", "trip_1", "trip_2"]]


def test_a_trip_whose_date_is_known_once_is_listed_once(model, store):
    healthy = dict(zip(model.healthy.names, model.healthy.values, strict=True))
    known = trip(0, vehicle=model.vehicle.name, healthy_si=healthy)
    undated = replace(known, start="")
    store.write([undated])
    assert with_earlier([known], known.place, [model], store) == [known]
    failed = replace(undated, status=ERROR)  # before its files said their date
    assert with_earlier([failed], known.place, [model], store) == [failed]


def test_trips_read_part_by_part_are_not_those_of_a_model_of_equal_sides(model, store):
    of_parts = commissioned(model, np.nan)
    values = dict(zip(COMPONENTS, of_parts.healthy.values.tolist(), strict=True))
    first = trip(0, vehicle=model.vehicle.name, healthy_si=values)
    second = replace(first, trip="second", mileage_km=first.mileage_km + 1)
    store.write([first])
    assert with_earlier([second], first.place, [of_parts], store)[1].trip == first.trip
    assert with_earlier([second], first.place, [model], store) == [second]


def test_alarms_are_kept_and_name_who_acknowledged_them(
    folders, model, store, monkeypatch, no_figures, tmp_path
):
    def stiff(path, models, settings):
        found = recalled_trip(path, models, settings)
        return replace(found, estimates=found.estimates | {"k_p": 1.5}, half_widths={"k_p": 0.01})

    monkeypatch.setattr(fleet_module, "evaluate_trip", stiff)
    results = read(folders[0], model, tmp_path / "one", store)
    where = "am96", results[0].place
    (alarm,) = (one for one in store.alarms(*where) if one.parameter == "k_p")
    assert (alarm.cause, alarm.severity, alarm.is_open) == (Cause.LIMIT, Severity.ACT, True)
    seen = Acknowledgement("k_p", Cause.LIMIT, alarm.severity, alarm.begin_km, "Kim", SEEN, "known")
    store.acknowledge(*where, [seen])
    read(folders[0], model, tmp_path / "two", store)
    metrics = json.loads((tmp_path / "two" / "metrics.json").read_text())
    (row,) = (one for one in metrics["alarms"] if one["parameter"] == "k_p")
    assert (row["end_km"], row["cause"], row["severity"]) == (None, "limit", "act")
    assert (row["seen_by"], metrics["severity"]) == ("Kim", "act")


TELLING = 1
"""Seed of a history with alarms of each kind."""


def commissioned(model, km, of=1.0):
    """Return a bogie commissioned at a mileage, its healthy values times `of`."""
    healthy = HealthyValues(COMPONENTS, of * np.arange(1.0, 14.0), np.zeros(13))
    bogie = SimpleNamespace(healthy=healthy, law=None)
    training = {"commissioned": {"mileage_km": [km]}}
    return BogieModel(bogie, model.generator, model.settings, training)


def history_of(models, rng, n_trips):
    """Return trips of two commissionings, in an order of their own; what is odd is drawn."""
    found = []
    for i in range(n_trips):
        km = 1e4 * (i + 1)
        era = models[int(km >= 1.5e5)]
        healthy = era.healthy
        odd = float(rng.choice([0, 0, 0, 5e-10, 2e-9]))  # equal, and not equal any more
        values = dict(zip(healthy.names, ((1 + odd) * healthy.values).tolist(), strict=True))
        change = {"c_s": 1.0 - 0.06 * max(0, i % 15 - 4), "k_p": 1.2 if i == 20 else 1.0}
        gain = 0.3 if i > 11 else 0.001 * rng.normal()
        sensors = {"axle_box": SensorHealth(1e-3, 0.0, 0.0, 0.0, 0.0)}
        sensors["bogie"] = SensorHealth(1e-3, gain, 0.0, 0.0, 0.0)
        one = trip(
            i,
            change,
            bool(rng.random() < 0.1),
            False,
            vehicle=era.vehicle.name,
            healthy_si={} if rng.random() < 0.05 else values,
            healthy_since_km=era.training["commissioned"]["mileage_km"][0],
            flags="odd" if rng.random() < 0.1 else "",
            half_widths={"c_s": 0.01, "k_p": 0.01},
            temperature_c=float(rng.normal()),
        )
        direction = str(rng.choice(["forward", "reverse", ""]))
        quality = replace(one.quality, sensors=sensors_text(sensors), direction=direction)
        one = replace(one, quality=quality)
        if rng.random() < 0.1:
            one = replace(one, start="")
        if rng.random() < 0.1:
            one = replace(one, mileage_km=np.nan)
        found.append(one)
    return [found[i] for i in rng.permutation(n_trips)]


@pytest.mark.slow
@settings(max_examples=2)
@example(TELLING)
@given(st.integers(0, 1000))
def test_alarms_of_the_series_are_those_of_the_whole_history(model, tmp_path_factory, seed):
    """Two commissionings, of one or both of which models are given, and maintenance."""
    rng = np.random.default_rng(seed)
    models = [commissioned(model, 1e4), commissioned(model, 1.5e5, of=0.9)]
    trips = history_of(models, rng, 32)
    place, changes, alarms = trips[0].place, ChangeSettings(), []
    with History(tmp_path_factory.mktemp("history") / "fleet.db") as store:
        store.write(trips[:-1])
        where = model.vehicle.name, place
        store.add_event(*where, Event(2.2e5, "exchanged", "new damper"))
        store.add_event(*where, Event(2.6e5, "sensor", "bogie"))
        undated = replace(trips[0], start="")  # the same trip, of a file that has lost its date
        last = trips[-1:]
        several = ((last, models[:1]), (last, models[1:]), (last, models), ([undated], models))
        for new, chosen in several:
            found = keep_trips(new, place, chosen, DEFAULT_LIMITS, changes, store)
            every = with_earlier(new, place, chosen, store)
            whole = watch(series_of(every, store.events(*where)), DEFAULT_LIMITS, changes)
            assert repr(found) == repr(whole.alarms) == repr(store.alarms(*where))
            alarms.append(found)
    if seed == TELLING:  # the comparison is not one of nothing
        assert {one.parameter for found in alarms for one in found} >= {"c_s", "k_p", "bogie"}
        assert len({repr(found) for found in alarms[:3]}) == 3


def test_trips_of_another_reference_are_named_once_by_a_monitor(model, store, caplog):
    first, last = commissioned(model, 0.0), commissioned(model, 5e4)
    for i, era in enumerate((first, first, last, last)):
        healthy = dict(zip(era.healthy.names, era.healthy.values.tolist(), strict=True))
        since = {"healthy_si": healthy, "healthy_since_km": 5e4 * (era is last)}
        one = trip(i, vehicle=model.vehicle.name, with_curves=False, **since)
        keep_trips([one], one.place, [era], DEFAULT_LIMITS, ChangeSettings(), store)
    (record,) = caplog.records
    assert "2 earlier trips of" in record.getMessage()
    assert str(store) in record.getMessage()
