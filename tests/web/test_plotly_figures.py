"""Figures as plotly takes them: its own schema, and where things are drawn."""

import json
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from served_fleet import FAILED, NAMED_EVIL, SETTINGS, WORN, trips

from suspnet.depot.web.figures import finite, html, response_figure, trend_figure
from suspnet.trains.history import History
from suspnet.trains.maintenance.series import Event
from suspnet.trains.pages.board import Board
from suspnet.trains.pages.tables import response
from suspnet.trains.pages.trend import FLAGGED, PASSING, TRIP, ranges, trend_of_state


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    path = tmp_path_factory.mktemp("figures") / "fleet.db"
    with History(path) as store:
        store.write(trips(WORN, 2, {"c_s": lambda i: 1 - 0.2 * max(i - 5, 0) / 25}))
        store.write(trips(FAILED, 1, {"k_s": lambda i: 3.0 if i == 7 else 1.0}))
        store.add_event("am96", FAILED, Event(9_000.0, "exchanged", "<b>new</b> %{x}"))
        store.write(trips(NAMED_EVIL, 4, n_trips=1))
    found = Board(str(path), SETTINGS)
    found.refresh()
    return found


def state(board, place):
    return next(one for one in board.view.states if one.series.place == place)


def trend_of(one):
    return trend_figure(trend_of_state(one), "x")


def responses(board, place):
    with History(board.store) as store:
        return [response(one.trip, one.mileage_km, one) for one in store.responses("am96", place)]


def traces(figure, name):
    return [one for one in figure["data"] if one["name"] == name]


@pytest.mark.parametrize("place", [WORN, FAILED, NAMED_EVIL])
def test_figures_keep_to_the_schema_of_plotly_and_to_json(board, place):
    shown = responses(board, place)
    for figure in (trend_of(state(board, place)), response_figure(shown, "x")):
        go.Figure(figure)  # raises if a key or a value is none of plotly's
        json.dumps(figure, allow_nan=False)


def test_trend_has_every_trip_in_percent_with_its_interval(board):
    shown = state(board, WORN)
    figure = trend_of(shown)
    dots = [one for one in traces(figure, TRIP) if one["yaxis"] == "y"]
    series = shown.series
    used = ~series.flagged
    assert dots[0]["x"] == series.mileage_km[used].tolist()
    np.testing.assert_allclose(dots[0]["y"], 100 * series.estimates["k_p"][used], rtol=1e-5)
    high = 100 * series.estimates["k_p"] * np.exp(series.half_widths["k_p"])
    found = np.add(dots[0]["y"], dots[0]["error_y"]["array"])
    np.testing.assert_allclose(found, high[used], rtol=1e-5)
    (flagged,) = [one for one in traces(figure, FLAGGED) if one["yaxis"] == "y"]
    assert flagged["x"] == [16_000.0]


def test_crossing_lies_where_the_life_says_on_the_act_limit(board):
    shown = state(board, WORN)
    figure = trend_of(shown)
    bar, diamond = (one for one in traces(figure, PASSING) if one["yaxis"] == "y4")
    life = shown.lives["c_s"]
    assert bar["x"] == pytest.approx([shown.last_km + km for km in life.interval_km()])
    assert diamond["x"] == pytest.approx([shown.last_km + life.quantile_km(0.5)])
    assert diamond["y"] == [70.0]
    low, high = figure["layout"]["yaxis4"]["range"]
    assert low < 70 < 100 < high
    levels = [one["y0"] for one in figure["layout"]["shapes"] if one["yref"] == "y4"]
    assert sorted(levels) == pytest.approx([70, 80, 100, 125, 140])
    assert not [one for one in traces(figure, PASSING) if one["yaxis"] == "y"]


def test_flagged_trip_far_away_is_a_triangle_at_the_edge_and_maintenance_a_line(board):
    figure = trend_of(state(board, FAILED))
    (far,) = [one for one in traces(figure, FLAGGED) if one["yaxis"] == "y3"]
    assert far["marker"]["symbol"] == ["triangle-up"]
    assert far["y"][0] == pytest.approx(figure["layout"]["yaxis3"]["range"][1], rel=1e-5)
    assert "300" in far["text"][0] or "299" in far["text"][0]
    lines = [one["x0"] for one in figure["layout"]["shapes"] if one["yref"] == "paper"]
    assert lines == [9_000.0]
    (note,) = [one for one in figure["layout"]["annotations"] if one.get("textangle") == -90]
    assert note["text"] == html("<b>new</b> %{x}")
    assert "<" not in note["text"]
    assert "%{" not in note["text"]


def test_ranges_hold_what_they_say(board):
    shown = state(board, WORN)
    (everything, first, last), (_, begin, end) = ranges(trend_of_state(shown))
    assert everything == "All"
    assert first <= 2_000 < shown.last_km + shown.lives["c_s"].quantile_km(0.5) < last
    km = shown.series.mileage_km
    assert ((km >= begin) & (km <= end)).sum() == 20
    assert len(ranges(trend_of_state(state(board, NAMED_EVIL)))) == 1


def test_responses_are_amplifications_of_first_and_newest(board):
    with History(board.store) as store:
        kept = store.responses("am96", WORN)
    shown = responses(board, WORN)
    figure = response_figure(shown, "x")
    assert len(figure["data"]) == 2 * len(kept)
    np.testing.assert_allclose(figure["data"][0]["y"], np.abs(kept[0].responses[0]), rtol=1e-5)


def test_numbers_and_texts_are_safe():
    assert finite([1.0, np.nan, np.inf, 1 / 3]) == [1.0, None, None, 0.333333]
    assert html("<i>&") == "&lt;i&gt;&amp;"


@pytest.mark.parametrize("n_clear", [0, 5])
def test_axis_holds_flagged_trips_that_are_all_there_is_or_stay_where_they_are(tmp_path, n_clear):
    made = trips(WORN, 2, {"c_s": lambda i: 1.0 if i < n_clear else 0.85 - 0.01 * i}, n_trips=20)
    flagged = [replace(r, flags="odd" if i >= n_clear else "") for i, r in enumerate(made)]
    with History(tmp_path / "fleet.db") as store:
        store.write(flagged)
    found = Board(str(tmp_path / "fleet.db"), SETTINGS)
    found.refresh()
    figure = trend_of(found.view.states[0])
    low, high = figure["layout"]["yaxis4"]["range"]
    assert low < 67
    assert high > 100
    (drawn,) = [one for one in traces(figure, FLAGGED) if one["yaxis"] == "y4"]
    assert set(drawn["marker"]["symbol"]) == {"circle-open"}
    np.testing.assert_allclose(drawn["y"][-1], 66.0, atol=0.5)
