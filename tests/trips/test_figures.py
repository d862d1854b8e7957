"""Figures of trips show what they should, with intervals and flags, whatever is missing."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from trip_records import HALF_WIDTHS, OUTPUTS, curves, flagged, fleet, trend_of, trip

from suspnet.ground.parameters import Cause
from suspnet.trains.maintenance import Alarm, Life, Severity
from suspnet.trains.pages import trend, trip_figures
from suspnet.trains.pages.trend import AHEAD, LEAST_SPAN_PERCENT, health_trend

FEW = OUTPUTS[:2]
MISSING = "trip without an estimate"
FLAGGED, BEYOND, INTERVAL = "flagged: see the table", "beyond the axis", "its 90 % interval"


def made(results, outputs=FEW, **options):
    """Return a figure's panels."""
    return health_trend(trend_of(results, outputs, **options)).axes


def drawn(results, outputs=FEW, **options):
    """Return a figure's panels, drawn (a warning is an error), which takes longest."""
    axes = made(results, outputs, **options)
    FigureCanvasAgg(axes[0].figure).draw()
    return axes


def labels(axis):
    return [line.get_label() for line in (*axis.lines, *axis.collections)]


def points(axis, label):
    """Return the x and y values of all lines with a label, in ascending order of x."""
    found = [line.get_xydata() for line in axis.lines if line.get_label() == label]
    rows = np.concatenate(found) if found else np.zeros((0, 2))
    return rows[np.argsort(rows[:, 0])].T


def bars(axis, label=INTERVAL):
    """Return place, lower and upper end of each interval, (n, 3)."""
    (found,) = [part for part in axis.collections if part.get_label() == label]
    return np.array([[x, low, high] for (x, low), (_, high) in found.get_segments()])


def measured(n=12, missing=()):
    """Return a fleet's trips with intervals."""
    trips = fleet(n, missing)
    return [replace(r, half_widths=HALF_WIDTHS) if r.estimates else r for r in trips]


def legend(axis):
    (found,) = axis.figure.legends
    return [text.get_text() for text in found.get_texts()]


def draw(figure):
    """Draw a figure (a warning is an error), which takes longest, and return the texts on it."""
    FigureCanvasAgg(figure).draw()
    return texts(figure)


def texts(figure):
    return [text.get_text() for axis in figure.axes for text in axis.texts]


# reference


def test_running_median_agrees_with_a_loop():
    values = np.random.default_rng(0).normal(size=9)
    median = trend.running_median(values)
    assert median[4] == np.median(values[2:7])
    assert median[1] == np.median(values[:3])
    assert median[[0, -1]].tolist() == values[[0, -1]].tolist()
    fading = np.array([100, 100, 100, 100, 88, 75.5, 63, 51.2])  # once 63, with 51.2 the newest
    np.testing.assert_array_equal(trend.running_median(fading), fading)


def test_health_trend_shows_percent_of_healthy_over_thousands_of_km():
    trips = fleet(8, missing=(3,))
    figure = health_trend(trend_of(trips[::-1], OUTPUTS))
    assert len(figure.axes) == len(OUTPUTS)
    known = [r for r in trips if r.status == "ok"]
    for axis, name in zip(figure.axes, OUTPUTS, strict=True):
        x, y = points(axis, "trip")
        np.testing.assert_allclose(x, [r.mileage_km / 1000 for r in known])
        np.testing.assert_allclose(y, [100 * r.estimates[name] for r in known])
        np.testing.assert_allclose(points(axis, MISSING)[0], [40.0])
        low, high = axis.get_ylim()
        assert high - low >= LEAST_SPAN_PERCENT
    assert figure.axes[-1].get_xlabel() == "mileage [1000 km]"


def test_trip_signals_shows_kilometres_per_hour_and_the_time_in_minutes():
    result = trip()
    figure = trip_figures.trip_signals(result)
    assert texts(figure) == []
    np.testing.assert_allclose(figure.axes[3].lines[0].get_ydata().max(), 252.0)
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xdata(), result.curves.overview_s / 60)
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata(), result.curves.overview_mean[2])
    short = trip_figures.trip_signals(trip(curves=curves(n_windows=20)))
    assert short.axes[3].get_xlabel() == "time [s]"


def test_trip_responses_draws_every_trip_with_curves_and_a_colour_bar():
    trips = fleet(6, missing=(2,))
    figure = responses(trips)
    *axes, bar = figure.axes
    assert [len(axis.lines) for axis in axes] == [5] * 4
    assert bar.get_ylabel() == "mileage [1000 km]"
    assert axes[0].get_xlim() == pytest.approx((0.5, 12.0))
    np.testing.assert_allclose(axes[1].lines[0].get_ydata(), np.abs(trips[0].curves.responses[1]))


def test_bands_that_nothing_is_known_of_do_not_hide_the_curves():
    known = curves()
    wild = replace(known, deviations=np.full_like(known.deviations, 1e6))
    wild.deviations[:, :10] = np.inf
    unknown = replace(known, deviations=np.full_like(known.deviations, np.nan))
    low, high = figures_limits(wild)
    assert high / low < 1e6
    figures_limits(unknown)


def responses(results):
    return trip_figures.response_figure([(r.mileage_km, r.curves) for r in results])


def figures_limits(shown):
    figure = responses([trip(curves=shown)])
    texts(figure)
    return figure.axes[0].get_ylim()


def whole(results):
    """Return all three figures, that of the trend with two panels."""
    return (
        health_trend(trend_of(results, OUTPUTS[:2])),
        responses(results),
        trip_figures.trip_signals(results[-1]),
    )


def test_trips_without_any_estimate_say_so():
    drawn = [texts(f) for f in whole([trip(i, missing=True) for i in range(3)])]
    assert drawn[0] == ["no trip with an estimate and a mileage"] * 2
    assert drawn[1] == ["no trip has curves"] * 4
    assert drawn[2] == ["no signals"] * 4


def test_trips_without_a_mileage_are_counted():
    unplaced = [replace(r, mileage_km=np.nan) for r in fleet(4, ())]
    drawn = [texts(f) for f in whole(unplaced)]
    assert drawn[0] == ["no trip with an estimate and a mileage"] * 2
    assert drawn[1] == []
    figure = health_trend(trend_of([*fleet(3, ()), unplaced[0]], OUTPUTS))
    assert figure.axes[0].get_title() == "without a mileage, not shown: 1"


# intervals and flags


def test_bars_are_the_intervals_in_percent():
    trips = measured(missing=(3,))
    known = [r for r in trips if r.estimates]
    for axis, name in zip(made(trips[::-1], OUTPUTS), OUTPUTS, strict=True):
        expected = [[r.mileage_km / 1000, *(100 * v for v in r.interval(name))] for r in known]
        np.testing.assert_allclose(bars(axis), expected)
        low, high = axis.get_ylim()
        assert low < np.min(expected, axis=0)[1]
        assert high > np.max(expected, axis=0)[2]


def test_flagged_trips_are_hollow_and_without_interval():
    trips = measured()
    trips[2] = flagged(trips[2])
    for axis, name in zip(drawn(trips), FEW, strict=True):
        np.testing.assert_allclose(
            points(axis, FLAGGED)[:, 0], [30.0, 100 * trips[2].estimates[name]]
        )
        (hollow,) = [line for line in axis.lines if line.get_label() == FLAGGED]
        assert hollow.get_markerfacecolor() == "none"
        assert 30.0 not in points(axis, "trip")[0]
        assert len(points(axis, "trip")[0]) == len(bars(axis)) == 11
        assert 30.0 not in bars(axis)[:, 0]
        assert FLAGGED in legend(axis)


# limit: what the axis holds


@pytest.mark.parametrize(
    ("value", "edge", "words", "place"), [(0.27, 0, "27 %", 0), (2.5, 1, "250 %", 11)]
)
def test_a_single_odd_trip_does_not_spoil_the_axis(value, edge, words, place):
    trips = measured()
    usual = made(trips)[0].get_ylim()
    trips[place] = flagged(trips[place], k_p=value)
    axis, other = made(trips)[:2]
    assert np.ptp(axis.get_ylim()) < 1.5 * np.ptp(usual)
    np.testing.assert_allclose(points(axis, BEYOND)[:, 0], [10.0 * (place + 1), edge])
    assert [text.get_text() for text in axis.texts] == [words]
    assert BEYOND not in labels(other)
    assert BEYOND in legend(axis)


def test_a_lasting_change_stays_on_the_axis_though_flagged():
    """A damper that has failed is out of the range trained for from then on."""
    trips = [replace(trip(i), half_widths=HALF_WIDTHS) for i in range(9)]
    trips += [flagged(trip(i), c_s=0.3) for i in range(9, 12)]
    (axis,) = drawn(trips, ("c_s",))
    assert axis.get_ylim()[0] < 30
    assert BEYOND not in labels(axis)


# failure


@pytest.mark.parametrize("half", [np.nan, np.inf])
def test_unknown_intervals_are_left_out(half):
    trips = measured()
    trips[5] = replace(trips[5], half_widths=dict.fromkeys(OUTPUTS, half))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        axis = drawn(trips)[0]
    assert 60.0 not in bars(axis)[:, 0]
    assert 60.0 in points(axis, "trip")[0]


# alarms and remaining life


def test_alarm_is_marked_where_it_began():
    alarms = [Alarm("k_p", Cause.CHANGE, Severity.NOTICE, 5e4)]
    axes = drawn(measured(), alarms=alarms)
    assert points(axes[0], "notice: start of an alarm").T.tolist() == [[50.0, 1.0]]
    assert "notice: start of an alarm" not in labels(axes[1])


def test_crossing_ahead_makes_room_for_itself():
    """Of three lives one is near, one has no end in sight, one is over."""
    trips = measured()
    last = max(r.mileage_km for r in trips)
    span = last - min(r.mileage_km for r in trips)
    near = Life("linear", np.linspace(0.1, 2.0, 101) * span)
    lives = {
        "k_p": near,
        "c_p": Life("no trend", np.full(3, np.inf)),
        "k_s": Life("x", np.zeros(1)),
    }
    axes = made(trips, OUTPUTS[:3], lives=lives)
    begin, end = points(axes[0], "act limit will be passed (80 %)")[0]
    assert begin == pytest.approx((last + near.interval_km()[0]) / 1000)
    assert end == pytest.approx((last + AHEAD * span) / 1000)
    assert axes[0].get_xlim()[1] == pytest.approx(end)
    for axis in axes[1:]:
        assert "act limit will be passed (80 %)" not in labels(axis)
    # far away, nothing is drawn
    far = made(trips, FEW, lives={"k_p": Life("linear", np.array([9e6]))})
    assert far[0].get_xlim()[1] < last / 1000 + 0.1 * span / 1000
