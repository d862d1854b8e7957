"""Plan: known answers, every set of dates tried out, bundling, alarms, and what is refused."""

from dataclasses import replace
from datetime import date, timedelta
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from suspnet.ground.parameters import Severity
from suspnet.maintenance.plan import join_plans, km_per_day, make_plan
from suspnet.maintenance.schedule import Part, Train
from suspnet.maintenance.visit_costs import (
    INSPECT,
    REPLACE,
    Costs,
    PlanSettings,
    choose_dates,
    part_costs,
)
from suspnet.report.maintenance_figures import MOST_TRAINS, plan_calendar

TODAY = date(2026, 11, 22)
TRAIN = Train("T1", 100_000.0, TODAY, 500.0)
COSTS = Costs(replacement=2.0, inspection=0.3, failure=20.0, usual_life_km=600_000.0)
SETTINGS = PlanSettings(visit=1.0, costs=COSTS)
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


def cheapest(costs, visits):
    """Return the least cost over all sets of dates."""
    n = visits.size
    return min(
        costs[:, [*dates, n]].min(axis=1).sum() + visits[list(dates)].sum()
        for size in range(n + 1)
        for dates in combinations(range(n), size)
    )


def cost_of(costs, visits, found):
    dates, served = found[:2]
    assert dates == sorted(set(served) - {visits.size})
    return costs[np.arange(len(costs)), served].sum() + visits[dates].sum()


# reference: other ways to the same numbers


@pytest.mark.parametrize("visit", [0.0, 1.0])
@pytest.mark.parametrize("replacement", [0.0, 2.0])
def test_expected_costs_are_the_means_of_the_docstring(visit, replacement):
    rng = np.random.default_rng(1)
    samples = np.concatenate([rng.uniform(0, 900_000, 40), [0, 0, NEVER, NEVER, 50_000, 50_000]])
    dates = np.array([7_000.0, 50_000, 150_000, 300_000, 640_000])
    costs, end = replace(COSTS, replacement=replacement), 700_000.0
    got = part_costs(samples, dates, visit, end, costs)
    life, reach = costs.usual_life_km, costs.reach_km
    T = np.where(samples == 0, np.nextafter(dates[0], np.inf), samples)
    capped = np.minimum(T, life)

    def price(km):
        return visit * np.maximum(1 - km / end, 0)

    def failing(t):
        return np.mean((costs.failure + price(T)) * (t >= T))

    def thrown_away(t):
        return replacement / life * np.mean(np.maximum(capped - t, 0))

    for i, t in enumerate(dates):
        u = t + reach
        found = np.minimum(replacement / life * (capped - t), price(capped)) * ((t < T) & (u >= T))
        later = [
            failing(v) + thrown_away(v) + price(v) * np.mean(v < T) for v in dates if v >= u
        ] + [failing(dates[-1])]
        go_on = max(min(later) - failing(u), 0.0)
        assert got.passed[i] == np.mean(t >= T)
        np.testing.assert_allclose(got.failing[i], failing(t), rtol=1e-12)
        np.testing.assert_allclose(got.work[REPLACE, i], failing(t) + thrown_away(t), rtol=1e-12)
        inspected = failing(t) + costs.inspection + found.mean() + go_on
        np.testing.assert_allclose(got.work[INSPECT, i], inspected, rtol=1e-9)
    assert got.least[-1] == got.failing[-1]


@pytest.mark.parametrize("n_parts", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4)), 2])
def test_dates_cost_as_little_as_the_best_of_all_sets_of_dates(n_parts):
    """20 tiny fleets with lives of any width, eight dates: 256 sets of dates each."""
    rng = np.random.default_rng(n_parts)
    dates = np.linspace(7_000, 500_000, 8)
    n_visits = []
    for _ in range(20):
        tables = [
            part_costs(
                rng.uniform(50_000, 400_000) * np.exp(rng.uniform(0, 0.6) * rng.normal(size=30)),
                dates,
                1.0,
                600_000.0,
                replace(COSTS, failure=rng.choice([0.5, 5.0, 50.0])),
            )
            for _ in range(n_parts)
        ]
        costs = np.stack([one.least for one in tables])
        visits = 1 - dates / 600_000
        found = choose_dates(costs, visits)
        n_visits.append(len(found[0]))
        assert cost_of(costs, visits, found) == pytest.approx(cheapest(costs, visits), rel=1e-12)
    assert len(set(n_visits)) > 1


@pytest.mark.parametrize(
    "n_parts", [*(pytest.param(n, marks=pytest.mark.slow) for n in (2, 16)), 5]
)
def test_dates_for_costs_of_any_shape_are_the_best_of_all_sets(n_parts):
    """20 random tables with eight dates, one in ten pairs forbidden: 256 sets of dates each."""
    rng = np.random.default_rng(n_parts)
    excess, proven = [], []
    for _ in range(20):
        costs = rng.uniform(0, 10, (n_parts, 9)) * rng.choice([0.1, 1.0, 10.0], (n_parts, 1))
        costs[rng.random(costs.shape) < 0.1] = np.inf
        costs[:, 0] = np.minimum(costs[:, 0], 100.0)
        visits = rng.uniform(0, 8, 8) * rng.choice([0.0, 1.0], 8, p=[0.1, 0.9])
        found = choose_dates(costs, visits)
        best = cheapest(costs, visits)
        excess.append(cost_of(costs, visits, found) / best - 1)
        proven.append(found[2:] == (pytest.approx(best, rel=1e-9),))
    assert max(excess) < 1e-9
    assert all(proven)


@settings(max_examples=12, deadline=None)
@given(
    st.lists(
        st.lists(st.one_of(st.floats(0, 100), st.just(np.inf)), min_size=5, max_size=5),
        min_size=1,
        max_size=4,
    ),
    st.lists(st.floats(0, 50), min_size=5, max_size=5),
)
def test_dates_do_not_depend_on_the_order_of_the_parts(rows, prices):
    costs = np.column_stack([np.array(rows), np.full(len(rows), 60.0)])
    visits = np.array(prices)
    found = choose_dates(costs, visits)
    assert cost_of(costs, visits, found) == pytest.approx(
        cheapest(costs, visits), rel=1e-9, abs=1e-6
    )
    assert choose_dates(costs[::-1], visits).dates == found.dates


def test_search_that_runs_out_of_time_still_serves_each_part_and_says_how_good_that_is():
    rng = np.random.default_rng(0)
    costs = np.column_stack([rng.uniform(0, 10, (60, 100)), np.full(60, np.inf)])
    visits = rng.uniform(5, 20, 100)
    found = choose_dates(costs, visits, max_s=0.0)
    assert costs.min(axis=1).sum() <= found.bound < cost_of(costs, visits, found) < np.inf


# limit: known answers


def test_certain_life_is_used_up_to_the_last_date_before_its_end():
    found = planned(part(100_000.0))
    assert [visit.day for visit in found.visits] == [TODAY + timedelta(days=196)]  # 14 + 26 * 7
    (visit,) = found.visits
    (job,) = visit.jobs
    assert (job.what, job.probability, visit.urgency) == ("replace", 0.0, "later")
    assert visit.latest == visit.day  # a week later it has failed
    assert visit.mileage_km == 100_000 + 196 * 500
    assert job.unused_km == 2_000
    assert job.expected_cost == 2.0
    assert visit.expected_cost == 3.0
    assert visit.decide_by == visit.day - timedelta(days=14)
    assert found.objective == pytest.approx(1 - 98 / 600 + 2.0 * 2 / 600)


def test_lives_that_end_at_about_the_same_time_share_a_visit():
    near = planned(part(100_000.0, "left"), part(130_000.0, "right"))
    assert [len(visit.jobs) for visit in near.visits] == [2]
    assert near.visits[0].day == TODAY + timedelta(days=196)
    far = planned(part(100_000.0, "left"), part(330_000.0, "right"))
    assert [len(visit.jobs) for visit in far.visits] == [1, 1]
    elsewhere = planned(
        part(100_000.0, "left"),
        part(130_000.0, "right", train="T2"),
        trains=(TRAIN, replace(TRAIN, name="T2")),
    )
    assert [visit.train for visit in elsewhere.visits] == ["T1", "T2"]


def test_nothing_is_replaced_where_failures_cost_nothing():
    free = replace(SETTINGS, costs=replace(COSTS, failure=0.0))
    found = planned(part(spread_life(100_000, 0.4)), part(300_000.0, "right"), settings=free)
    assert found.visits == ()
    assert [job.what for job in found.waiting] == ["plan again", "plan again"]


def test_what_never_passes_a_limit_needs_nothing():
    found = planned(part([NEVER] * 5), part(5e6, "right"))
    assert (found.visits, found.waiting, found.n_quiet, found.objective) == ((), (), 2, 0.0)
    assert "0 visits with 0 jobs" in str(found)
    assert found.rows() == []


def test_replacing_all_today_is_never_the_answer_to_wide_lives():
    """A part that may last 100,000 to 900,000 km waits, and the plan says how long."""
    wide = spread_life(300_000, 0.7)
    found = planned(part(wide))
    first = found.visits[0].jobs[0] if found.visits else found.waiting[0]
    assert not found.visits or found.visits[0].day > TODAY + timedelta(days=60)
    assert first.probability < 0.5
    cheap = planned(part(wide), settings=replace(SETTINGS, costs=replace(COSTS, failure=1.0)))
    assert cheap.visits == ()
    (job,) = cheap.waiting
    assert job.plan_again_km == pytest.approx(np.quantile(wide, 0.01, method="lower") - 7_000)


def test_dearer_failures_are_prevented_earlier():
    life = spread_life(200_000, 0.2, n=5000)
    days, risks = [], []
    for failure in (2.0, 10.0, 50.0, 500.0):
        dear = replace(SETTINGS, costs=replace(COSTS, failure=failure, inspection=2.0))
        (visit,) = planned(part(life), settings=dear).visits
        days.append(visit.day)
        risks.append(visit.jobs[0].probability)
    assert days == sorted(days, reverse=True)
    assert len(set(days)) == 4
    assert risks == sorted(risks, reverse=True)
    assert risks[-1] == 0 < risks[0]


def test_inspection_is_chosen_where_it_tells_what_to_do():
    """Half fails within 50,000 km, half never: to look costs 0.3, to replace half of 2."""
    unsure = [30_000.0] * 50 + [NEVER] * 50
    (visit,) = planned(part(unsure)).visits
    assert [job.what for job in visit.jobs] == ["inspect"]
    assert visit.expected_cost == pytest.approx(1.3)
    assert np.isnan(visit.jobs[0].unused_km)
    blind = replace(SETTINGS, costs=replace(COSTS, inspection=2.0))
    (visit,) = planned(part(unsure), settings=blind).visits
    assert [job.what for job in visit.jobs] == ["replace"]


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
        assert row["passing_from"] == ""
    assert [row["day"] != "" for row in rows] == [False, False, True, True]
    text = str(found)
    assert text.startswith("2 parts unknown, 1 visit with 2 jobs")
    lines = text.splitlines()[3:]
    assert "right, c_p, k_p: too few trips (3 of 5) " in lines[0]
    assert "inspect middle, c_p: too few trips (3 of 5)" in lines[1]
    assert [line.split("|")[-2].strip() for line in lines] == ["unknown", "unknown", "0.0 %"]


def test_calendar_shows_what_is_unknown_on_top():
    unseen = part([NEVER], train="T2", unknown=WHY)
    trains = (TRAIN, replace(TRAIN, name="T2"))
    axis = plan_calendar(planned(part(20_000.0), unseen, trains=trains)).axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["T2", "T1"]
    assert "1 part unknown" in axis.get_title()
    assert "?" in [text.get_text() for text in axis.texts]
    (legend,) = axis.figure.legends
    assert "remaining life unknown" in [text.get_text() for text in legend.get_texts()]


def test_alarm_to_act_on_is_seen_to_now_though_its_life_is_unknown():
    found = planned(part([NEVER], severity=Severity.ACT, unknown=WHY))
    assert [row["urgency"] for row in found.rows()] == ["now"]
    assert "unknown" in str(found).splitlines()[-1]


# property: alarms, order, units


def test_alarm_to_act_on_is_seen_to_on_the_first_day_and_takes_others_along():
    found = planned(part([NEVER], "left", Severity.ACT), part(20_000.0, "right"))
    (visit,) = found.visits
    assert (visit.day, visit.urgency) == (TODAY + timedelta(days=14), "now")
    what = {job.part.suspension: job.what for job in visit.jobs}
    assert what == {"left": "inspect", "right": "replace"}
    plan = planned(part([0.0] * 10, severity=Severity.ACT))
    assert "| passed " in str(plan)
    passed = plan.visits[0].jobs[0]
    assert passed.what == "replace"


def test_limit_passed_without_an_alarm_is_seen_to_on_the_first_day():
    (visit,) = planned(part([0.0] * 10)).visits
    assert (visit.urgency, visit.jobs[0].what, visit.jobs[0].probability) == ("now", "replace", 1)


def test_limit_passed_since_the_last_trip_is_no_failure_before_0_percent():
    """20,000 km have been run since the last trip, which had 5,000 km to go."""
    later = replace(TRAIN, mileage_km=120_000.0)
    found = planned(part(np.linspace(4_000, 6_000, 9)), trains=(later,))
    (job,) = found.visits[0].jobs
    assert job.probability == 1.0
    assert "| passed " in str(found)
    half = planned(part([5_000.0] * 5 + [NEVER] * 5), trains=(later,))
    assert half.visits[0].jobs[0].probability == 0.5


def test_notice_without_a_predicted_passing_is_looked_at_in_time_and_in_company():
    alone = planned(part([NEVER], "left", Severity.NOTICE))
    (visit,) = alone.visits
    assert visit.jobs[0].what == "inspect"
    assert timedelta(days=80) < visit.latest - TODAY <= timedelta(days=90)
    joined = planned(part([NEVER], "left", Severity.NOTICE), part(28_000.0, "right"))
    assert [len(visit.jobs) for visit in joined.visits] == [2]
    predicted = planned(part(100_000.0, "left", Severity.NOTICE))
    assert predicted.visits[0].day == TODAY + timedelta(days=196)
    hasty = planned(
        part([NEVER], "left", Severity.NOTICE), settings=replace(SETTINGS, notice_days=1)
    )
    assert hasty.visits[0].urgency == "now"


def test_mileage_since_the_last_trip_counts():
    later = replace(TRAIN, mileage_km=150_000.0)
    found = planned(part(100_000.0), trains=(later,))
    assert found.visits[0].day == TODAY + timedelta(days=98)
    earlier = replace(TRAIN, on=TODAY - timedelta(days=100))
    assert planned(part(100_000.0), trains=(earlier,)).visits[0].day == found.visits[0].day
    assert earlier.mileage_at(TODAY) == 150_000


def test_costs_may_differ_from_parameter_to_parameter():
    spared = replace(SETTINGS, costs={"c_p": COSTS, "k_p": replace(COSTS, failure=0.0)})
    found = planned(
        part(60_000.0, parameter="c_p"), part(300_000.0, parameter="k_p"), settings=spared
    )
    assert [job.part.parameter for visit in found.visits for job in visit.jobs] == ["c_p"]
    with pytest.raises(ValueError, match=r"`costs` must name 'k_s', got \('c_p', 'k_p'\)"):
        planned(part(60_000.0, parameter="k_s"), settings=spared)


@settings(max_examples=12, deadline=None)
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
    some = replace(SETTINGS, lead_days=lead, step_days=30.0)
    trains = (replace(TRAIN, km_per_day=pace),)
    found = planned(*parts, settings=some, trains=trains)
    rows = found.rows()
    assert rows == rows_like(planned(*parts[::-1], settings=some, trains=trains).rows(), rows)
    n_jobs = sum(len(visit.jobs) for visit in found.visits)
    assert n_jobs + len(found.waiting) + found.n_quiet == len(parts)
    assert np.isfinite(found.objective)
    assert len({visit.day for visit in found.visits}) == len(found.visits)
    for visit in found.visits:
        assert (visit.day - TODAY).days >= lead
        assert visit.day <= visit.latest <= found.horizon
        assert all(0 <= job.probability <= 1 for job in visit.jobs)
    for row in rows:
        if row["severity"] == "act":
            assert row["urgency"] == "now"
    assert all(0 <= job.plan_again_km <= pace * some.horizon_days for job in found.waiting)
    assert len(plan_calendar(found).axes) == 1


@pytest.mark.parametrize("n_trains", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_a_large_fleet_is_planned(n_trains):
    """Up to 4,000 parts of 100 trains with 500 samples each, which took 1 s of a processor."""
    rng = np.random.default_rng(0)
    trains = [
        Train(f"T{i}", 100_000.0, TODAY, float(rng.uniform(300, 1000))) for i in range(n_trains)
    ]
    parts = [
        part(spread_life(rng.lognormal(13.5, 0.8), 0.3, i, 500), f"{i}", train=f"T{i % n_trains}")
        for i in range(40 * n_trains)
    ]
    found = planned(*parts, trains=trains)
    assert len(found.visits) > n_trains


def rows_like(rows, others):
    """Return rows with NaN replaced by that of the others, as NaN is not equal to itself."""
    assert len(rows) == len(others)
    return [
        {k: (o[k] if v != v and o[k] != o[k] else v) for k, v in row.items()}
        for row, o in zip(rows, others, strict=True)
    ]


def test_table_and_rows_say_where_what_and_until_when():
    found = planned(part(100_000.0), part(spread_life(900_000, 0.5), "right"))
    first = next(line for line in str(found).splitlines() if "T1" in line)
    cells = [cell.strip() for cell in first.strip("|").split("|")]
    assert cells[:3] == ["T1", "later", "2027-06-06"]
    assert cells[3:] == ["2027-06-06", "198000", "replace left, c_p", "0.0 %"]
    row = found.rows()[0]
    assert (row["train"], row["suspension"], row["parameter"]) == ("T1", "left", "c_p")
    assert (row["day"], row["decide_by"], row["mileage_km"]) == (
        "2027-06-06",
        "2027-05-23",
        198_000,
    )
    assert (row["passing_from"], row["passing_to"]) == ("2027-06-10", "2027-06-10")
    spared = replace(SETTINGS, costs=replace(COSTS, failure=0.0))
    waits = planned(part(300_000.0, "right"), settings=spared)
    assert waits.rows()[-1]["what"] == "plan again"
    assert "First of those that may: T1, right, c_p; plan again within" in str(waits)


def test_calendar_shows_the_most_urgent_trains():
    trains = [Train(f"T{i:02d}", 100_000.0, TODAY, 500.0) for i in range(40)]
    parts = [part(8_000.0 * (40 - i), train=f"T{i:02d}") for i in range(40)]
    axis = plan_calendar(planned(*parts, trains=trains)).axes[0]
    shown = [label.get_text() for label in axis.get_yticklabels()]
    assert len(shown) == MOST_TRAINS
    assert shown[:3] == ["T39", "T38", "T37"]
    assert "30 trains of 40" in axis.get_title()
    assert plan_calendar(planned(part([NEVER]))).axes[0].texts[0].get_text() == "nothing to be done"


@pytest.mark.parametrize(("days", "shown"), [(3000, "2027"), (730, "2027-01"), (60, "12-01")])
def test_days_of_the_calendar_need_no_words(days, shown):
    settings = replace(SETTINGS, horizon_days=days, lead_days=30)
    axis = plan_calendar(planned(part(20_000.0), settings=settings)).axes[0]
    labels = [label.get_text() for label in axis.get_xticklabels()]
    assert shown in labels
    assert not any(letter.isalpha() for letter in "".join(labels))


def test_plans_of_trains_are_joined_to_that_of_all():
    trains = [replace(TRAIN, name=f"T{i}") for i in range(1, 5)]
    parts = [
        part(spread_life(40_000.0 * i, 0.3, seed=i), side, train=f"T{i}")
        for i in range(1, 5)
        for side in ("left", "right")
    ]
    parts += [part([NEVER], "middle"), part([0.0], "first", Severity.ACT, "T4")]
    whole = planned(*parts, trains=trains)
    each = [
        planned(*(one for one in parts if one.train == train.name), trains=[train])
        for train in trains
    ]
    joined = join_plans(each[::-1])
    assert joined.rows() == whole.rows()
    assert len(joined.visits) > 2
    assert joined.n_quiet == whole.n_quiet > 0
    assert joined.objective == pytest.approx(whole.objective, rel=1e-12)
    assert (joined.today, joined.horizon, joined.level) == (TODAY, whole.horizon, whole.level)
    with pytest.raises(ValueError, match="same days and level"):
        join_plans([whole, replace(whole, today=TODAY - timedelta(days=1))])
    with pytest.raises(ValueError, match="same days and level"):
        join_plans([])


# pace of a train


def test_pace_is_that_of_the_newest_trips():
    def pace(starts, km, default):
        return km_per_day(np.array(starts, dtype="datetime64[s]"), np.array(km, float), default)

    starts = ["2020-01-01", "NaT", "2026-05-01T10:00", "2026-06-30T23:00", "2026-08-09"]
    km = [0.0, 5.0, 100_000.0, 130_000.0, 150_000.0]
    assert pace(starts, km, 1.0) == 500.0
    assert pace(["NaT"] * 5, km, 7.0) == 7.0
    assert pace(starts[::-1], km[::-1], 1.0) == 500.0
    assert pace(starts[:1], km[:1], 7.0) == 7.0
    assert pace(["2026-08-01", "2026-08-09"], [0.0, 4_000.0], 7.0) == 7.0  # too short
    assert pace(starts[2:], [3e5, 2e5, 1e5], 7.0) == 7.0  # mileage falls
    assert pace([], [], 7.0) == 7.0
    assert pace(["NaT", "NaT"], [1.0, 2.0], 7.0) == 7.0
    assert pace(["2026-05-01", "2026-07-01"], [1.0, np.nan], 7.0) == 7.0


# failure


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"visit": -1.0}, r"`visit` must be a finite number >= 0, got -1"),
        ({"visit": "1"}, r"`visit` must be a finite number >= 0, got '1'"),
        ({"step_days": 0}, r"`step_days` must be a finite number > 0, got 0"),
        ({"step_days": 0.1}, r"`step_days` must leave at most 1000 dates"),
        ({"lead_days": 800}, r"`horizon_days` must be > `lead_days` \(800\), got 730"),
        ({"horizon_days": np.nan}, r"`horizon_days` must be a finite number > 0"),
        ({"plan_again_risk": 1}, r"`plan_again_risk` must be a finite number > 0 and < 1, got 1"),
        ({"costs": 3}, r"`costs` must be Costs or a mapping of parameters to Costs, got 3"),
        ({"costs": {"c_p": 3}}, r"`costs` must be Costs or a mapping of parameters to Costs"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        replace(SETTINGS, **changes)


@pytest.mark.parametrize("name", ["replacement", "inspection", "failure", "usual_life_km"])
def test_costs_below_zero_are_refused(name):
    with pytest.raises(ValueError, match=rf"`{name}` must be a finite number >=? 0, got -1"):
        replace(COSTS, **{name: -1})


@pytest.mark.parametrize("samples", [[], [np.nan], [-1.0], [[1.0]], 3.0])
def test_samples_that_are_no_mileages_are_refused(samples):
    with pytest.raises(ValueError, match="`samples_km` of T1, left, c_p must be mileages >= 0"):
        Part("T1", "left", "c_p", samples, 0.0)


def test_parts_and_trains_must_fit():
    with pytest.raises(ValueError, match="must name each part once, got T1, left, c_p twice"):
        planned(part(1.0), part(2.0))
    with pytest.raises(ValueError, match="must hold the train of each part, not that of T9, left"):
        planned(part(1.0, train="T9"))
    with pytest.raises(ValueError, match="`trains` must have different names"):
        planned(part(1.0), trains=(TRAIN, TRAIN))
    with pytest.raises(ValueError, match="`km_per_day of train T1` must be a finite number > 0"):
        replace(TRAIN, km_per_day=0)
    with pytest.raises(ValueError, match="`mileage_km of T1, left, c_p` must be a finite number"):
        Part("T1", "left", "c_p", [1.0], np.nan)


def test_pace_of_unreadable_trips_is_refused():
    with pytest.raises(ValueError, match=r"`mileages_km` must be one for each of 1 starts"):
        km_per_day(np.array(["2026-01-01"], dtype="datetime64[s]"), np.ones(2), 1.0)


def test_parts_without_any_allowed_date_are_refused():
    with pytest.raises(ValueError, match="`costs` must have a finite one for each part"):
        choose_dates(np.full((1, 3), np.inf), np.ones(2))
