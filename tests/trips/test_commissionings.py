"""Commissioned anew after maintenance: which models read a trip, and what compares across."""

import json
import math
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from trip_fixtures import OUTPUTS, changed, model_at
from trip_records import fleet as made_up
from trip_records import trend_of
from vehicles import AM96

from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.maintenance.series import relative_to_first_healthy, series_of
from suspnet.trains.pages.details import healthy_words
from suspnet.trains.pages.trend import AGAIN_OF_FIRST, health_trend
from suspnet.trains.trips.commissionings import (
    check_models,
    commissionings,
    eras,
    models_at,
    since_km,
    with_truth_of_each,
)
from suspnet.vehicle import VerticalVehicle
from suspnet.vehicle.quantities import LogNormal

ANEW_KM = 195_000.0
NEW_DAMPER = 1.25


def commissioned(first_km, last_km=None, damper=1.0, trips=()):
    """Return a model with healthy trips from `first_km` on, whose c_s is `damper` times nominal."""
    posterior = LogNormal(("healthy_c_s",), (math.log(damper),), ((1e-4,),))
    generator = VerticalVehicle(AM96, distribution=posterior)
    notes = {"n_trips": 5, "mileage_km": [first_km, last_km or first_km + 4e4], "trips": trips}
    model = model_at()
    return replace(model, generator=generator, training=model.training | {"commissioned": notes})


@pytest.fixture(scope="module")
def both():
    return [commissioned(ANEW_KM, damper=NEW_DAMPER), commissioned(10_000.0)]


def read_with(models):
    """Return made-up trips of which each knows its commissioning."""
    found = []
    for trip in made_up(missing=()):
        model = models_at(models, trip.mileage_km)[0]
        values = dict(zip(OUTPUTS, model.healthy.values.tolist(), strict=True))
        found.append(replace(trip, healthy_since_km=since_km(model), healthy_si=values))
    return found


# reference


@pytest.mark.parametrize(
    ("km", "first"), [(0.0, 1e4), (194_999.0, 1e4), (ANEW_KM, ANEW_KM), (math.nan, ANEW_KM)]
)
def test_trip_is_read_with_the_latest_commissioning_that_begins_before_it(both, km, first):
    assert [since_km(model) for model in models_at(both, km)] == [first]


def test_trips_of_two_commissionings_compare_in_si_units(both):
    results = read_with(both)
    found = commissionings(both, results)
    assert [one.since_km for one in found] == [1e4, ANEW_KM]
    assert found[0].relative == dict.fromkeys(OUTPUTS, 1.0)
    assert found[1].relative["c_s"] == pytest.approx(NEW_DAMPER)
    first = found[0].healthy_si["c_s"]
    for trip, compared in zip(results, relative_to_first_healthy(results, found), strict=True):
        assert compared.estimates["c_s"] == pytest.approx(trip.si("c_s")[0] / first)
        assert compared.estimates["k_p"] == pytest.approx(trip.estimates["k_p"])
        assert compared.half_widths == trip.half_widths
    # limits and tests use the trips since the last
    last = [r.trip for r in results if r.mileage_km >= ANEW_KM]
    whole = series_of(results)
    assert whole.trip[whole.of_newest_reference].tolist() == last
    # one commissioning is as none
    results = read_with(both[:1])
    assert commissionings(both[:1], results) == []
    assert series_of(results).of_newest_reference.all()


def test_truth_is_relative_to_the_healthy_trips_of_each():
    healthy = tuple(f"trip_{i:03d}" for i in range(24, 29))
    models = [commissioned(10_000.0), commissioned(250_000.0, trips=healthy)]
    results = read_with(models)
    done = with_truth_of_each(results, commissionings(models, results))
    assert done[0].truth == results[0].truth
    median = np.median([r.truth["c_s"] for r in results[24:29]])
    assert done[29].truth["c_s"] == pytest.approx(results[29].truth["c_s"] / median)
    assert done[29].truth["k_p"] == pytest.approx(1.0)
    assert done[29].truth["M_s"] == results[29].truth["M_s"]


@pytest.mark.slow
def test_trips_name_their_healthy_state_in_tables(both, manifests, blank, tmp_path):
    for i, km in enumerate((5_000.0, 20_000.0, ANEW_KM, 3e5)):
        changed(manifests[i], tmp_path, f"trip_{i}", mileage_km=km)
    out = tmp_path / "out"
    settings = FleetSettings(TripSettings())
    (done,) = evaluate_fleet(tmp_path, both, out, settings, progress=False)
    rows = pq.read_table(out / "trips.parquet").to_pylist()
    assert [row["healthy_since_km"] for row in rows] == [1e4, 1e4, ANEW_KM, ANEW_KM]
    c_s = AM96.healthy_values()[3]
    for row, factor in zip(rows, (1.0, 1.0, NEW_DAMPER, NEW_DAMPER), strict=True):
        assert row["c_s_ns_per_m_healthy"] == pytest.approx(factor * c_s)
        assert row["c_s_ns_per_m"] == pytest.approx(factor * c_s * row["c_s"])
        half = math.log(row["c_s_ns_per_m_high"] / row["c_s_ns_per_m"])
        expected = math.hypot(math.log(row["c_s_high"] / row["c_s"]), 1.6448536 * 0.01)
        assert half == pytest.approx(expected, rel=1e-6)
        assert row["k_p_n_per_m_high"] == pytest.approx(row["k_p_high"] * AM96.healthy_values()[0])
    page = (out / "report.html").read_text()
    assert "Commissioned again: from" in page
    assert "c_s 125\N{NO-BREAK SPACE}%" in page
    metrics = json.loads((out / "metrics.json").read_text())
    assert [one["since_km"] for one in metrics["commissionings"]] == [1e4, ANEW_KM]
    spans = ("10 000 to 50 000", "195 000 to 235 000")
    words = "; then ".join(f"what 5 trips from {span} km showed" for span in spans)
    assert metrics["details"]["healthy is"] == words
    assert {one["n_trips"] for one in metrics["trends"]} == {2}
    assert done.results[0].healthy_since_km == 1e4


def test_figure_marks_where_it_was_commissioned_anew(both):
    results = read_with(both)
    found = commissionings(both, results)
    compared = relative_to_first_healthy(results, found)
    limits = {"c_s": DEFAULT_LIMITS["c_s"]}
    axis = health_trend(trend_of(compared, ("c_s",), limits=limits, commissionings=found)).axes[0]
    lines = {line.get_label(): line for line in axis.get_lines()}
    assert lines[AGAIN_OF_FIRST].get_xdata()[0] == ANEW_KM / 1000
    low, high = axis.get_ylim()
    expected = [100 * NEW_DAMPER * one for one in limits["c_s"].act + limits["c_s"].notice]
    drawn = [line.get_ydata()[0] for label, line in lines.items() if label.endswith(" limit")]
    assert drawn
    assert all(any(abs(one - other) < 1e-9 for other in expected) for one in drawn)
    assert all(low < one < high for one in drawn)


# limit


def test_nominal_models_are_one_era():
    model = model_at()
    assert eras([model]) == [[model]]
    assert models_at([model], 1e5) == [model]
    assert math.isnan(since_km(model))
    assert healthy_words(model) == "the vehicle file's drawing"


# failure


def test_runs_that_do_not_fit_together_are_refused(both):
    assert check_models(both) == OUTPUTS
    with pytest.raises(ModelFileError, match="one run is commissioned and another is not"):
        check_models([*both, model_at()])
    with pytest.raises(ModelFileError, match=r"same speed \(64.4 to 75.6 m/s\)"):
        check_models([*both, both[0]])
