"""Figures of trips can be drawn, whatever is missing, and show what they should."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from trip_records import OUTPUTS, curves, fleet, trend_of, trip

from suspnet.report import figures, trend
from suspnet.report.maintenance_figures import health_trend


def draw(figure):
    """Draw a figure (a warning is an error), which takes longest, and return the texts on it."""
    FigureCanvasAgg(figure).draw()
    return texts(figure)


def texts(figure):
    return [text.get_text() for axis in figure.axes for text in axis.texts]


def labelled(axis, label):
    """Return the x and y values of the only line with a label."""
    (line,) = [line for line in axis.lines if line.get_label() == label]
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def test_running_median_agrees_with_a_loop():
    values = np.random.default_rng(0).normal(size=9)
    median = trend.running_median(values)
    assert median[4] == np.median(values[2:7])
    assert median[1] == np.median(values[:3])
    assert median[[0, -1]].tolist() == values[[0, -1]].tolist()
    np.testing.assert_array_equal(trend.running_median(values, 1), values)
    fading = np.array([100, 100, 100, 100, 88, 75.5, 63, 51.2])  # once 63, with 51.2 the newest
    np.testing.assert_array_equal(trend.running_median(fading), fading)


def test_health_trend_shows_percent_of_healthy_over_thousands_of_km():
    trips = fleet(8, missing=(3,))
    figure = health_trend(trend_of(trips[::-1], OUTPUTS))
    assert len(figure.axes) == len(OUTPUTS)
    known = [r for r in trips if r.status == "ok"]
    for axis, name in zip(figure.axes, OUTPUTS, strict=True):
        x, y = labelled(axis, "trip")
        np.testing.assert_allclose(x, [r.mileage_km / 1000 for r in known])
        np.testing.assert_allclose(y, [100 * r.estimates[name] for r in known])
        np.testing.assert_allclose(labelled(axis, "trip without an estimate")[0], [40.0])
        low, high = axis.get_ylim()
        assert high - low >= trend.LEAST_SPAN_PERCENT
    assert figure.axes[-1].get_xlabel() == "mileage [1000 km]"


def test_a_parameter_missing_from_one_trip_is_marked_in_its_panel_alone():
    trips = fleet(5, ())
    trips[2] = replace(trips[2], estimates=trips[2].estimates | {"c_p": np.nan})
    figure = health_trend(trend_of(trips, ("k_p", "c_p")))
    assert "trip without an estimate" not in [line.get_label() for line in figure.axes[0].lines]
    np.testing.assert_allclose(labelled(figure.axes[1], "trip without an estimate")[0], [30.0])


def test_trip_signals_shows_kilometres_per_hour_and_the_time_in_minutes():
    result = trip()
    figure = figures.trip_signals(result)
    assert texts(figure) == []
    np.testing.assert_allclose(figure.axes[3].lines[0].get_ydata().max(), 252.0)
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xdata(), result.curves.overview_s / 60)
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata(), result.curves.overview_mean[2])
    short = figures.trip_signals(trip(curves=curves(n_windows=20)))
    assert short.axes[3].get_xlabel() == "time [s]"


def test_trip_responses_draws_every_trip_with_curves_and_a_colour_bar():
    trips = fleet(6, missing=(2,))
    figure = figures.trip_responses(trips)
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


def figures_limits(shown):
    figure = figures.trip_responses([trip(curves=shown)])
    texts(figure)
    return figure.axes[0].get_ylim()


def test_quality_marks_trips_without_an_estimate():
    figure = figures.quality(fleet(6, missing=(2,)))
    solid, hollow = figure.axes[0].lines
    assert (len(solid.get_xdata()), len(hollow.get_xdata())) == (5, 1)
    assert hollow.get_markerfacecolor() == "none"


def whole(results):
    """Return all four figures, that of the trend with two panels."""
    return (
        health_trend(trend_of(results, OUTPUTS[:2])),
        figures.trip_responses(results),
        figures.trip_signals(results[-1]),
        figures.quality(results),
    )


def test_trips_without_any_estimate_say_so():
    drawn = [texts(f) for f in whole([trip(i, missing=True) for i in range(3)])]
    assert drawn[0] == ["no trip with an estimate and a mileage"] * 2
    assert drawn[1] == ["no trip has curves"] * 4
    assert drawn[2] == ["no signals"] * 4
    assert drawn[3] == []


def test_trips_without_a_mileage_are_counted():
    unplaced = [replace(r, mileage_km=np.nan) for r in fleet(4, ())]
    drawn = [texts(f) for f in whole(unplaced)]
    assert drawn[0] == ["no trip with an estimate and a mileage"] * 2
    assert drawn[1] == []
    assert drawn[3] == ["no trip with a mileage"] * 3
    figure = health_trend(trend_of([*fleet(3, ()), unplaced[0]], OUTPUTS))
    assert figure.axes[0].get_title() == "without a mileage, not shown: 1"


def failed():
    """Return a trip that failed before it was read."""
    return trip(1, missing=True, status="error", quality=type(trip().quality)(), truth={})


def test_gaps_in_every_curve_can_be_drawn():
    gaps = curves()
    for values in (gaps.overview_low, gaps.overview_high, gaps.overview_mean, gaps.coherences):
        values[:, 20:60] = np.nan
    gaps.overview_mean[2] = np.nan
    gaps.overview_low[2] = np.nan
    gaps.overview_high[2] = np.nan
    gaps.overview_speed[:] = np.nan
    gaps.responses[:, 5] = np.nan
    for figure in whole([trip(0), failed(), trip(2, curves=gaps)]):
        draw(figure)


def test_a_trip_that_failed_before_it_was_read_can_be_drawn():
    for figure in whole([replace(failed(), mileage_km=np.nan)]):
        draw(figure)
