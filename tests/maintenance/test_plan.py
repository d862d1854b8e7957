"""Plan: days and risks by known answers, bundling, alarms, and what is refused."""

from dataclasses import replace
from datetime import date, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from suspnet.ground.parameters import Severity
from suspnet.trains.maintenance import Part, PlanSettings, Train, make_plan
from suspnet.trains.maintenance.plan import joined, km_per_day
from suspnet.trains.pages.maintenance_figures import MOST_TRAINS, plan_calendar

TODAY = date(2026, 11, 22)
TRAIN = Train("T1", 100_000.0, TODAY, 500.0)
SETTINGS = PlanSettings()
NEVER = np.inf


def part(
    samples_km, suspension="left", severity=Severity.NONE, train="T1", parameter="c_p", unknown=""
):
    samples = np.atleast_1d(np.asarray(samples_km, dtype=float))
    return Part(train, suspension, parameter, samples, 100_000.0, severity, unknown=unknown)


def planned(*parts, settings=SETTINGS, trains=(TRAIN,)):
    return make_plan(parts, trains, settings, TODAY)


def spread_life(median_km, spread, seed=0, n=200):
    return median_km * np.exp(spread * np.random.default_rng(seed).normal(size=n))


# limit: known answers


def test_certain_life_is_used_up_to_the_last_day_before_its_end():
    (visit,) = planned(part(100_000.0)).visits
    (job,) = visit.jobs
    assert visit.day == TODAY + timedelta(days=199)  # after 200 days it has failed
    assert (job.what, job.probability, visit.urgency) == ("replace", 0.0, "later")
    assert visit.mileage_km == 100_000 + 199 * 500
    assert visit.decide_by == visit.day - timedelta(days=14)
    # 100 days have been run since the last trip: by the newer mileage, or by the days since
    for train in (
        replace(TRAIN, mileage_km=150_000.0),
        replace(TRAIN, on=TODAY - timedelta(days=100)),
    ):
        (visit,) = planned(part(100_000.0), trains=(train,)).visits
        assert (train.mileage_at(TODAY), visit.day) == (150_000, TODAY + timedelta(days=99))


@pytest.mark.parametrize("risk", [0.001, 0.02, 0.3])
def test_visit_is_on_the_last_day_of_the_accepted_risk(risk):
    life = spread_life(200_000, 0.4, n=1000)
    (visit,) = planned(part(life), settings=replace(SETTINGS, risk=risk)).visits
    km = 500 * (visit.day - TODAY).days
    assert visit.jobs[0].probability == np.mean(life <= km) <= risk < np.mean(life <= km + 500)


@pytest.mark.parametrize(
    ("km", "bundle_days", "train", "n_jobs"),
    [
        (130_000.0, 90, "T1", [2]),
        (330_000.0, 90, "T1", [1, 1]),
        (130_000.0, 0, "T1", [1, 1]),
        (130_000.0, 90, "T2", [1, 1]),
    ],
)
def test_lives_of_a_train_that_end_at_about_the_same_time_share_a_visit(
    km, bundle_days, train, n_jobs
):
    parts = part(100_000.0, "left"), part(km, "right", train=train)
    settings = replace(SETTINGS, bundle_days=bundle_days)
    found = planned(*parts, settings=settings, trains=(TRAIN, replace(TRAIN, name="T2")))
    assert [len(visit.jobs) for visit in found.visits] == n_jobs
    assert found.visits[0].day == TODAY + timedelta(days=199)


def test_what_never_passes_a_limit_needs_nothing():
    plan = planned(part([NEVER] * 5), part(5e6, "right"))
    assert (plan.visits, plan.n_quiet) == ((), 2)
    assert "0 visits with 0 jobs" in plan.summary
    assert plan.rows() == []


@pytest.mark.parametrize(("share", "what"), [(0.4, "inspect"), (0.6, "replace")])
def test_part_is_replaced_if_it_is_likely_to_fail_within_reach(share, what):
    n = round(100 * share)
    (visit,) = planned(part([30_000.0] * n + [NEVER] * (100 - n))).visits
    assert [job.what for job in visit.jobs] == [what]


# limit: nothing is known


WHY = "too few trips (3 of 5)"


def test_part_of_unknown_life_is_unknown_and_comes_before_all_others():
    known = part(20_000.0, "left")
    never = part([NEVER], "right", unknown=WHY)
    unseen = [never, replace(never, parameter="k_p")]
    looked_at = part([NEVER], "middle", Severity.NOTICE, unknown=WHY)
    found = planned(known, *unseen, looked_at)
    assert [job.part.parameter for job in found.unknown] == ["c_p", "k_p"]  # as they were given
    assert found.n_quiet == 0
    rows = found.rows()
    assert [row["urgency"] for row in rows] == ["unknown", "unknown", "unknown", "soon"]
    for row in rows[:3]:
        assert row["unknown"] == WHY
        assert np.isnan(row["probability"])
    assert [row["day"] != "" for row in rows] == [False, False, True, True]
    assert found.summary.startswith("2 parts unknown, 1 visit with 2 jobs")
    assert [row["parameters"] for row in joined(rows)] == [["c_p", "k_p"], ["c_p"], ["c_p"]]


def test_calendar_shows_what_is_unknown_on_top():
    unseen = part([NEVER], train="T2", unknown=WHY)
    trains = (TRAIN, replace(TRAIN, name="T2"))
    axis = plan_calendar(planned(part(20_000.0), unseen, trains=trains)).axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["T2", "T1"]
    assert "1 part unknown" in axis.get_title()
    assert "?" in [text.get_text() for text in axis.texts]
    (legend,) = axis.figure.legends
    assert "remaining life unknown" in [text.get_text() for text in legend.get_texts()]


# property: alarms, order, units


def test_alarm_to_act_on_is_seen_to_on_the_first_day_and_takes_others_along():
    (visit,) = planned(part([NEVER], "left", Severity.ACT), part(20_000.0, "right")).visits
    assert (visit.day, visit.urgency) == (TODAY + timedelta(days=14), "now")
    assert {job.part.suspension: job.what for job in visit.jobs} == {
        "left": "inspect",
        "right": "replace",
    }
    unknown = planned(part([NEVER], severity=Severity.ACT, unknown=WHY))
    assert [(row["urgency"], row["unknown"]) for row in unknown.rows()] == [("now", WHY)]


@pytest.mark.parametrize("severity", [Severity.ACT, Severity.NONE])
def test_passed_limit_is_seen_to_on_the_first_day(severity):
    plan = planned(part([0.0] * 10, severity=severity))
    (visit,) = plan.visits
    assert (visit.urgency, visit.jobs[0].what, visit.jobs[0].probability) == ("now", "replace", 1)
    assert plan.rows()[0]["passed"]


def test_limit_passed_since_the_last_trip_is_no_failure_before_0_percent():
    """20,000 km have been run since the last trip, which had 5,000 km to go."""
    later = replace(TRAIN, mileage_km=120_000.0)
    (row,) = planned(part(np.linspace(4_000, 6_000, 9)), trains=(later,)).rows()
    assert (row["probability"], row["passed"]) == (1.0, True)
    half = planned(part([5_000.0] * 5 + [NEVER] * 5), trains=(later,))
    assert half.visits[0].jobs[0].probability == 0.5


def test_notice_without_a_predicted_passing_is_looked_at_in_time_and_in_company():
    (visit,) = planned(part([NEVER], "left", Severity.NOTICE)).visits
    assert visit.jobs[0].what == "inspect"
    assert visit.day - TODAY == timedelta(days=90)
    joined = planned(part([NEVER], "left", Severity.NOTICE), part(28_000.0, "right"))
    assert [len(visit.jobs) for visit in joined.visits] == [2]
    predicted = planned(part(100_000.0, "left", Severity.NOTICE))
    assert predicted.visits[0].day == TODAY + timedelta(days=199)


@examples(max_examples=12, deadline=None)
@given(
    lives=st.lists(
        st.lists(st.one_of(st.floats(0, 2e6), st.just(np.inf)), min_size=1, max_size=6),
        min_size=1,
        max_size=5,
    ),
    levels=st.lists(st.sampled_from(list(Severity)), min_size=5, max_size=5),
    pace=st.floats(1, 2000),
    lead=st.floats(0, 60),
)
def test_any_lives_give_a_whole_plan_that_the_order_does_not_change(lives, levels, pace, lead):
    parts = [
        part(life, f"{i}", level)
        for i, (life, level) in enumerate(zip(lives, levels, strict=False))
    ]
    some = replace(SETTINGS, lead_days=lead)
    trains = (replace(TRAIN, km_per_day=pace),)
    plan = planned(*parts, settings=some, trains=trains)
    rows = plan.rows()
    turned = planned(*parts[::-1], settings=some, trains=trains).rows()
    assert repr(rows) == repr(turned)  # NaN is not equal to itself
    n_jobs = sum(len(visit.jobs) for visit in plan.visits)
    assert n_jobs + plan.n_quiet == len(parts)
    assert len({visit.day for visit in plan.visits}) == len(plan.visits)
    for visit in plan.visits:
        assert lead <= (visit.day - TODAY).days <= some.horizon_days
        assert all(0 <= job.probability <= 1 for job in visit.jobs)
    assert all(row["urgency"] == "now" for row in rows if row["severity"] == "act")
    assert len(plan_calendar(plan).axes) == 1


def test_rows_say_where_what_and_until_when():
    plan = planned(part(100_000.0), part(spread_life(900_000, 0.1), "right"))
    expected = {
        "train": "T1",
        "suspension": "left",
        "parameter": "c_p",
        "day": "2027-06-09",
        "decide_by": "2027-05-26",
        "mileage_km": 199_500,
    }
    row = plan.rows()[0]
    assert {name: row[name] for name in expected} == expected


def test_calendar_shows_the_most_urgent_trains():
    trains = [Train(f"T{i:02d}", 100_000.0, TODAY, 500.0) for i in range(40)]
    parts = [part(8_000.0 * (40 - i), train=f"T{i:02d}") for i in range(40)]
    axis = plan_calendar(planned(*parts, trains=trains)).axes[0]
    shown = [label.get_text() for label in axis.get_yticklabels()]
    assert len(shown) == MOST_TRAINS
    assert shown[:3] == ["T39", "T38", "T37"]
    assert "30 trains of 40" in axis.get_title()
    assert plan_calendar(planned(part([NEVER]))).axes[0].texts[0].get_text() == "nothing to be done"


# pace of a train


STARTS = ["2020-01-01", "NaT", "2026-05-01T10:00", "2026-06-30T23:00", "2026-08-09"]
KM = [0.0, 5.0, 100_000.0, 130_000.0, 150_000.0]


@pytest.mark.parametrize(
    ("starts", "km", "expected"),
    [
        (STARTS, KM, 500.0),
        (STARTS[::-1], KM[::-1], 500.0),
        (["NaT"] * 5, KM, np.nan),
        (STARTS[:1], KM[:1], np.nan),
        (["2026-08-01", "2026-08-09"], [0.0, 4_000.0], np.nan),  # too short
        (STARTS[2:], [3e5, 2e5, 1e5], np.nan),  # the mileage falls
        ([], [], np.nan),
        (["2026-05-01", "2026-07-01"], [1.0, np.nan], np.nan),
    ],
)
def test_pace_is_that_of_the_newest_trips(starts, km, expected):
    starts = np.array(starts, dtype="datetime64[s]")
    np.testing.assert_equal(km_per_day(starts, np.array(km, dtype=float)), expected)


# failure


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"risk": 1}, r"`risk` must be a finite number > 0 and < 1, got 1"),
        ({"bundle_days": "1"}, r"`bundle_days` must be a finite number >= 0, got '1'"),
        ({"lead_days": 800}, r"`horizon_days` must be > `lead_days` \(800\), got 730"),
        ({"horizon_days": np.nan}, r"`horizon_days` must be a finite number > 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        replace(SETTINGS, **changes)


def test_the_train_of_each_part_must_be_given():
    with pytest.raises(ValueError, match="must hold the train of each part, not that of T9, left"):
        planned(part(1.0, train="T9"))
