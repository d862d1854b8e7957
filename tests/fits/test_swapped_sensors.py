"""Sensors of a bogie in each other's place: found by the drawing alone, and no others."""

from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from test_bogie_fit import MASSES, VEHICLE, drawn, row, trip, without

from suspnet.trains.fits.bogie_misfit import BogieMisfit
from suspnet.trains.fits.bogie_search import misfits_in
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.sensors import swapped_sensors
from suspnet.trains.sensors.swapped_sensors import (
    check_bogie,
    check_end,
    check_order,
    likely_orders,
)
from suspnet.trains.spectra.bogie_trip import smallest_noise

PAIRS = list(combinations(range(6), 2))


def misfit_of(one):
    return BogieMisfit(VEHICLE, [smallest_noise(one.spectra)], [one], are_healthy=False)


def exchanged(one, i, j):
    order = list(range(one.spectra.values.shape[-1]))
    order[i], order[j] = j, i
    return one.in_order(order)


@pytest.mark.parametrize("worn", [{}, {"c_p_axle2_left": 0.3}, {"k_s_left": 1.6, "c_s_right": 0.5}])
@pytest.mark.parametrize("lost", [(), ("axle_box_axle1_left",)])
def test_sensors_in_their_places_are_not_called_swapped(worn, lost):
    for seed in range(5):
        one = trip(drawn(VEHICLE, row(worn, seed=seed), seed), 70.0)
        check_order(VEHICLE, without(one, lost) if lost else one)


@pytest.mark.parametrize(("i", "j"), PAIRS)
def test_the_exchange_that_was_made_fits_best(i, j):
    one = exchanged(trip(drawn(VEHICLE, row({"k_p_axle1_right": 0.7}), 7), 70.0), i, j)
    expected = list(range(6))
    expected[i], expected[j] = j, i
    assert likely_orders(VEHICLE, one, 1.0) == [expected]
    assert likely_orders(VEHICLE, one, 1e9)[0] == expected


@pytest.mark.parametrize(("i", "j", "lost"), [(0, 1, ()), (2, 3, ("axle_box_axle1_left",))])
def test_two_sensors_that_are_swapped_are_named(i, j, lost):
    one = trip(drawn(VEHICLE, row({"k_p_axle1_right": 0.7}), 7), 70.0)
    one = without(exchanged(one, i, j), lost) if lost else exchanged(one, i, j)
    names = f"trip_7.yaml: {VEHICLE.sensors[i]} and {VEHICLE.sensors[j]} look swapped: with them"
    with pytest.raises(TripError, match=names) as error:
        check_order(VEHICLE, one, "trip_7.yaml")
    assert "exchange the columns of their lines in the manifest" in str(error.value)


def test_an_exchange_that_no_fit_confirms_is_none(monkeypatch):
    """The physics of another train may look better with two sensors exchanged."""
    one = trip(drawn(VEHICLE, row({}), 7), 70.0)
    monkeypatch.setattr(swapped_sensors, "likely_orders", lambda *_: [[1, 0, 2, 3, 4, 5]])
    check_order(VEHICLE, one)


@pytest.mark.parametrize(("given", "is_told"), [(1.01, False), (1.1, True)])
def test_an_exchange_that_explains_nothing_is_told_by_the_median_alone(monkeypatch, given, is_told):
    """As of the body's sensors of a train with flexible modes, 23.18 for 23.04."""
    one, swapped = trip(drawn(VEHICLE, row({}), 7), 70.0), [0, 1, 2, 3, 5, 4]

    def at_median(fit, orders):
        of_order = {tuple(range(6)): given, tuple(swapped): 1.0}
        return np.array([of_order.get(tuple(order), 9.0) for order in orders])

    ends = {id(one): 126.0}
    monkeypatch.setattr(swapped_sensors, "misfits_in", at_median)
    monkeypatch.setattr(swapped_sensors, "misfit_near", lambda _, one: ends.get(id(one), 41.0))
    with pytest.raises(TripError, match="look swapped") if is_told else nullcontext():
        check_order(VEHICLE, one)


def test_fits_decide_where_the_given_order_has_smaller_residuals_at_the_median(monkeypatch):
    """As the body's sensors of the trailing bogie of a blind train had, 11.68 for 11.69."""
    one = exchanged(trip(drawn(VEHICLE, row({"k_p_axle1_right": 0.7}), 7), 70.0), 4, 5)

    def chosen(fit, orders):
        of_order = {tuple(range(6)): 1.0, (0, 1, 2, 3, 5, 4): 1.1}  # others are not fitted
        return np.array([of_order.get(tuple(order), 9.0) for order in orders])

    monkeypatch.setattr(swapped_sensors, "misfits_in", chosen)
    check_order(VEHICLE, one)
    with pytest.raises(TripError, match="body_left and body_right look swapped"):
        check_order(VEHICLE, one, nearly=1.2)


@pytest.mark.parametrize("misfit", [1.9, 9.0])
@pytest.mark.parametrize("end", ["leading", "trailing"])
def test_healthy_trips_of_the_other_bogie_are_refused(end, misfit):
    """The bogie is looked at where the trips are not explained, and named if it is the reason."""
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES[:1])]
    given = replace(VEHICLE, bogie=end)
    if (end, misfit) != ("trailing", 9.0):
        check_bogie(given, trips, misfit)
        return
    words = "car7: the healthy trips fit the leading axle of the leading bogie"
    with pytest.raises(TripError, match=words) as error:
        check_bogie(given, trips, misfit, "car7")
    assert "and not the leading axle of the trailing bogie that is given, with 9;" in str(
        error.value
    )


@pytest.mark.parametrize("bogie", ["leading", "trailing"])
@pytest.mark.parametrize("axle", ["leading", "trailing"])
def test_one_trip_of_another_bogie_or_axle_is_refused(bogie, axle):
    one = trip(drawn(VEHICLE, row({"c_p_axle2_left": 0.6}), 3), 70.0)
    given = replace(VEHICLE, bogie=bogie, axle=axle)
    wrong = {("trailing", "leading"): "`bogie`", ("leading", "trailing"): "`axle`"}
    if (bogie, axle) == ("leading", "leading"):
        check_end(given, one)
        return
    with pytest.raises(TripError, match="the trip fits the leading axle") as error:
        check_end(given, one)
    asked = wrong.get((bogie, axle), "`bogie` and `axle`, or `direction`,")
    assert str(error.value).endswith(f"; correct {asked} in the manifests")


@pytest.mark.parametrize("bogie", ["leading", "trailing"])
def test_fits_decide_where_another_bogie_has_smaller_residuals_at_the_median(monkeypatch, bogie):
    at_start = {"leading": 10.4, "trailing": 10.0}  # of a train with everything at once
    monkeypatch.setattr(
        swapped_sensors,
        "_misfit_at_start",
        lambda end, trip: at_start[end.bogie] if end.axle == "leading" else 13.0,
    )
    one = trip(drawn(VEHICLE, row({"c_p_axle2_left": 0.6}), 3), 70.0)
    if bogie == "leading":
        fits = []
        check_end(VEHICLE, one, fit=lambda: fits.append(1) or 1.0)  # of both checks
        assert fits == [1]
        check_end(VEHICLE, one)
        return
    with pytest.raises(TripError, match="fits the leading axle of the leading bogie"):
        check_end(replace(VEHICLE, bogie=bogie), one)


# reference


def test_misfits_of_orders_are_those_of_the_reordered_spectra():
    one = trip(drawn(VEHICLE, row({"c_s_left": 0.5}), 3), 70.0)
    orders = [[0, 1, 2, 3, 4, 5], [0, 4, 2, 3, 1, 5], [5, 1, 2, 3, 4, 0]]
    found = misfits_in(misfit_of(one), orders)
    assert found[1] != pytest.approx(found[0], rel=0.1)
    alone = [misfits_in(misfit_of(one.in_order(order)), orders[:1])[0] for order in orders]
    np.testing.assert_allclose(found, alone, rtol=1e-9)
