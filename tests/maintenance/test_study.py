"""State of a made-up fleet, its overview and plan."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from depot_trips import N_TRIPS, place, trips

from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.ground.records import Place
from suspnet.trains.history import History
from suspnet.trains.jobs.maintenance import existing_history, write_maintenance
from suspnet.trains.maintenance.alarms import Acknowledgement
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.plan import PlanSettings, place_of, plan_of, trains_of
from suspnet.trains.maintenance.series import Event
from suspnet.trains.maintenance.state import by_urgency, state_of
from suspnet.trains.pages.board import BoardSettings
from suspnet.trains.pages.overview import overview_row, overview_table

pytestmark = pytest.mark.usefixtures("blank", "trips_fitted_once")

TODAY = "2026-03-01"
SEEN = "2026-02-01T08:00:00+00:00"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Return a history: one healthy suspension, one with a failed air spring, one that wears."""
    path = tmp_path_factory.mktemp("depot") / "fleet.db"
    failed = np.where(np.arange(N_TRIPS) < 38, 1.0, 1.5)
    worn = 1 - 0.2 * np.clip((np.arange(N_TRIPS) - 10) / 30, 0, None)
    with History(path) as history:
        history.write(trips(place("left"), 0))
        history.write(trips(place("right"), 1, {"k_s": failed}))
        history.write(trips(place("left", "4"), 2, {"c_s": worn}))
    return path


@pytest.fixture(scope="module")
def states(store):
    with History(store) as history:
        return by_urgency(
            state_of(one, DEFAULT_LIMITS, ChangeSettings()) for one in history.series()
        )


def test_worst_suspension_comes_first(states):
    assert [one.series.place.side for one in states] == ["right", "left", "left"]
    assert [one.severity for one in states] == [Severity.ACT, Severity.NOTICE, Severity.NONE]
    assert states[0].watched.passed == {"k_s"}
    assert states[1].shortest[0] == "c_s"
    low, high = states[1].shortest[1].interval_km()
    # 2 % of healthy in three trips: from 80.7 % to the act limit of 70 % it is 32 000 km
    assert [low, high] == pytest.approx([32_000, 32_000], rel=0.05)
    assert states[2].shortest is None


def test_rows_say_state_reason_and_who_has_seen_it(states):
    key = ("am96", place("right"))
    seen = {key: [Acknowledgement("k_s", Cause.LIMIT, Severity.ACT, 80_000.0, "Kim", SEEN)]}
    rows = [overview_row(state, seen) for state in states]
    assert rows[0]["acknowledged"] == "Kim, 2026-02-01"
    assert rows[0]["reason"] == (
        "the last trip is at 150 % of healthy; the last 2 trips are above the act limit of 125 %; "
        "too few trips so far to call it a lasting change"
    )
    assert rows[0]["k_s_last"] == pytest.approx(1.5, abs=0.01)  # as the reason says
    assert (rows[2]["reason"], rows[2]["parameter"]) == ("within its limits", "")
    text = overview_table(rows)
    assert text.startswith("3 suspensions: 1 to act on, 1 to be looked at, 1 without alarm.")


def test_rows_and_trains_of_the_plan(states):
    today = np.datetime64(TODAY).item()
    row = plan_of(states, PlanSettings(), today).rows()[0]
    assert (row["car"], row["suspension"], row["parameter"]) == ("3", "secondary, right", "k_s")
    assert (row["passed"], row["severity"]) == (True, "act")
    (train,) = trains_of(states, today, 500.0)
    assert (train.name, train.mileage_km) == ("12", 80_000.0)
    assert train.km_per_day == pytest.approx(2000 / 3)
    unnamed = replace(states[0].series, place=Place("x"))
    assert place_of(replace(states[0], series=unnamed))[0] == "am96: x"
    bogies = [
        replace(states[0], series=replace(unnamed, place=Place("x", bogie=bogie)))
        for bogie in ("leading", "trailing")
    ]
    assert {place_of(one)[0] for one in bogies} == {"am96: x"}
    lone = replace(states[0], series=replace(unnamed, place=Place(bogie="leading")))
    assert place_of(lone)[0] == "am96"


def test_mileage_per_day_that_is_assumed_is_shown_as_such(states):
    today = np.datetime64(TODAY).item()
    assert plan_of(states, PlanSettings(), today).assumed == ()
    undated = []
    for state in states:
        starts = np.full_like(state.series.start, np.datetime64("NaT"))
        undated.append(replace(state, series=replace(state.series, start=starts)))
    plan = plan_of(undated, PlanSettings(), today)
    assert [(one.name, one.km_per_day) for one in plan.assumed] == [("12", 500.0)]
    assert "12: 500 km a day are assumed" in plan.summary


def test_study_writes_overview_plan_and_calendar(store, tmp_path):
    found = run_study(store, tmp_path)
    assert [one.severity for one in found] == [Severity.ACT, Severity.NOTICE, Severity.NONE]
    with (tmp_path / "plan.csv").open() as stream:
        jobs = list(csv.DictReader(stream))
    assert jobs[0]["parameter"] == "k_s"
    assert jobs[0]["day"] == "2026-03-15"
    assert jobs[0]["urgency"] == "now"
    with (tmp_path / "overview.csv").open() as stream:
        assert [row["severity"] for row in csv.DictReader(stream)] == ["act", "notice", "none"]
    page = (tmp_path / "overview.html").read_text()
    assert "http" not in page.replace("http://www.w3.org", "")
    assert (tmp_path / "calendar.png").read_bytes()[:4] == b"\x89PNG"


def test_maintenance_clears_the_state(store, tmp_path):
    copy = tmp_path / "copy.db"
    copy.write_bytes(store.read_bytes())
    with History(copy) as history:
        history.add_event("am96", place("right"), Event(76_500.0, "exchanged", "air spring"))
        (series,) = (one for one in history.series() if one.place == place("right"))
    state = state_of(series, DEFAULT_LIMITS, ChangeSettings())
    # what was mounted is judged by itself: 150 % of what was healthy before
    assert state.series.recent.sum() == 2
    assert state.severity == Severity.ACT
    assert state.watched.changes.why_not == "2 of 20 trips for the reference so far"


def test_mistakes_are_told(tmp_path):
    with pytest.raises(ValueError, match="there is no such store"):
        run_study(tmp_path / "none.db", tmp_path)
    with pytest.raises(ValueError, match="which history"):
        run_study("", tmp_path)
    History(tmp_path / "empty.db").close()
    with pytest.raises(ValueError, match="no trip is stored here yet"):
        run_study(tmp_path / "empty.db", tmp_path)
    with pytest.raises(ValueError, match="must be a day like"):
        run_study(tmp_path / "empty.db", tmp_path, today="tomorrow")


def test_limits_of_a_vehicle_can_be_replaced(store, tmp_path):
    limits = {"k_s": {"notice": [0.5, 1.6], "act": [0.4, 1.7]}}
    found = run_study(store, tmp_path, limits=limits)
    assert DEFAULT_LIMITS["k_s"].act == (0.8, 1.25)
    assert found[0].severity == Severity.NOTICE


def test_plan_of_old_trips_says_how_old_they_are(store, tmp_path):
    """The newest trip, of train 12, is of 2026-02-26; nothing is known of the decade after it."""
    run_study(store, tmp_path, today="2036-11-22")
    page = (tmp_path / "overview.html").read_text()
    assert "12: the newest trip is 3 922 days old (2026-02-26)." in page
    assert "give today=2026-02-27 for the plan of that time" in page
    with (tmp_path / "plan.csv").open() as stream:
        jobs = list(csv.DictReader(stream))
    assert {job["unknown"] for job in jobs} == {"the newest trip is 3 922 days old"}
    assert {job["mileage_km"] for job in jobs} <= {"", "nan"}  # not four millions
    planned = [job for job in jobs if job["day"]]
    assert {(job["parameter"], job["what"]) for job in planned} == {
        ("k_s", "inspect"),
        ("c_s", "inspect"),
    }
    run_study(store, tmp_path, today="2026-08-24")  # 179 days
    assert "days old" not in (tmp_path / "overview.html").read_text()


def run_study(store, folder, *, today=TODAY, limits=None):
    with existing_history(str(store)) as history:
        return write_maintenance(history, folder, BoardSettings(limits=limits, today=today))


def test_what_cannot_be_computed_is_unknown_in_plan_overview_and_page(tmp_path):
    """Two new trips, nine flagged ones, and a healthy suspension that needs nothing."""
    few, flagged, well = place("left"), place("right"), place("left", "4")
    with History(tmp_path / "fleet.db") as history:
        history.write(trips(few, 0, n_trips=2))
        history.write([replace(one, flags="misfit") for one in trips(flagged, 1, n_trips=9)])
        history.write(trips(well, 2))
    run_study(tmp_path / "fleet.db", tmp_path)
    jobs = rows_of(tmp_path / "plan.csv")
    names = ["k_p", "c_p", "k_s", "c_s"]
    assert [(row["suspension"], row["parameter"]) for row in jobs] == [
        *(("secondary, left", name) for name in names),
        *(("secondary, right", name) for name in names),
    ]
    assert {row["urgency"] for row in jobs} == {row["what"] for row in jobs} == {"unknown"}
    assert {row["probability"] for row in jobs} == {"nan"}
    reasons = ["too few trips (2 of 5)"] * 4 + ["all of the last 5 trips are flagged"] * 4
    assert [row["unknown"] for row in jobs] == reasons
    overview = {row["side"] + row["car"]: row for row in rows_of(tmp_path / "overview.csv")}
    assert overview["left3"]["life_unknown"] == overview["right3"]["life_unknown"]
    assert overview["left3"]["life_unknown"] == "k_p, c_p, k_s, c_s"
    assert overview["left3"]["life_unknown_why"] == "too few trips (2 of 5)"
    assert overview["left4"]["life_unknown"] == ""
    page = (tmp_path / "overview.html").read_text()
    assert page.count("<small>too few trips (2 of 5)</small>") == 1
    assert "8 parts unknown" in page
    assert "no end in sight" in page


def rows_of(path):
    with path.open() as stream:
        return list(csv.DictReader(stream))
