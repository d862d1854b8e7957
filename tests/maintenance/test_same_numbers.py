"""Report, overview, plan and the pages of the fleet give the same numbers of the same trips."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from cli_runner import blank_figures
from depot_trips import trips
from trip_fixtures import model_at

from suspnet.cli.evaluate import ALARMS, exit_code
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import Place
from suspnet.runs.tensorboard import RunLog
from suspnet.trains.history import History
from suspnet.trains.jobs import fleet
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.maintenance.series import with_widened
from suspnet.trains.pages import report
from suspnet.trains.pages.board import Board, BoardSettings

pytestmark = pytest.mark.usefixtures("trips_fitted_once")
K_AND_C = ("k_p", "c_p", "k_s", "c_s")
SEED = 3
NAMES = ("worn", "failed", "flagged", "few", "unsure")
"""A worn damper, one that failed on flagged trips, a flagged spring, few trips, and one whose
newest trip is beyond a limit with an interval that reaches back."""


def with_last(results, **changes):
    """Return results of which those of the last three trips are changed."""
    return [replace(r, **changes) if r.trip > "trip_020" else r for r in results]


def made_up(where, vehicle):
    """Return the trips of one of ``NAMES``."""
    trip = np.arange(24)
    wear = {
        "worn": {"c_s": 1 - 0.006 * trip},
        "failed": {"c_s": np.where(trip > 20, 0.55, 1)},
        "flagged": {"k_s": 1 - 0.006 * trip},
        "few": {"k_p": 1 - 0.02 * trip},
        "unsure": {"k_p": np.where(trip > 20, 0.89, 1)},
    }
    name, n_trips = where.suspension, {"few": 7, "flagged": 8}
    results = trips(where, NAMES.index(name), wear[name], n_trips=n_trips.get(name, 24))
    if name == "flagged":
        results = [replace(r, flags="odd") for r in results]
    if name == "failed":
        results = with_last(results, flags="odd")
    if name == "unsure":
        results = with_last(results, half_widths=results[0].half_widths | {"k_p": 0.2})
    return [replace(r, vehicle=vehicle) for r in results]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Return the folder of four suspensions' reports, and the view that is served of them."""
    folder = tmp_path_factory.mktemp("same")
    model = model_at()
    settings = FleetSettings(TripSettings())
    of_place = {}
    for name in NAMES:
        where = Place(name, train="12", car=name)
        (folder / "trips" / name).mkdir(parents=True)
        for one in made_up(where, model.vehicle.name):
            path = folder / "trips" / name / f"{name}_{one.trip}.yaml"
            path.write_text(f"suspension: {name}\ntrain: '12'\ncar: {where.car}\n")
            of_place[path.name] = one

    def read(file, *_, **__):
        one, path = of_place[file.path.name], file.path
        return replace(one, trip=path.stem, manifest=str(path), healthy_si=healthy(model))

    store = folder / "fleet.db"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fleet, "evaluate_trip", read)
        patch.setattr(RunLog, "figure", lambda *_: None)
        patch.setattr(report, "data_uri", lambda _: "")
        with blank_figures(), History(store) as history:
            given = (folder / "trips", [model], folder / "out", settings, False, history, SEED)
            done = evaluate_fleet(*given)
    vehicles = {model.vehicle.name: model.vehicle.known_limits}
    given = {"today": "2026-03-01", "seed": SEED}
    board = Board(str(store), BoardSettings(vehicles, **given))
    board.refresh()
    return folder, board.view, done


def healthy(model):
    return dict(zip(model.healthy.names, model.healthy.values.tolist(), strict=True))


def reported(folder):
    """Return the numbers of each parameter of each suspension, as metrics.json has them."""
    found = {}
    for path in sorted((folder / "out").glob("*/metrics.json")):
        trends = json.loads(path.read_text())["trends"]
        found |= {(path.parent.name, one["parameter"]): one for one in trends}
    return found


def rows_of(path):
    with path.open() as stream:
        return {row["suspension"]: row for row in csv.DictReader(stream)}


def test_report_overview_and_fleet_page_give_the_same_present_values(outcomes):
    folder, view, _ = outcomes
    reports = reported(folder)
    table = rows_of(folder / "out" / "overview.csv")
    for row in view.rows:
        for name in K_AND_C:
            now = reports[row["suspension"], name]["now"]
            assert row[f"{name}_last"] == pytest.approx(now, rel=1e-12)
            assert float(table[row["suspension"]][f"{name}_last"]) == pytest.approx(now)
    assert reports["failed", "c_s"]["now"] == pytest.approx(0.55, abs=0.01)


def test_report_fleet_page_and_plan_give_the_same_remaining_lives(outcomes):
    folder, view, _ = outcomes
    reports = reported(folder)
    n_known = 0
    for state in view.states:
        for name in K_AND_C:
            one, life = reports[state.series.place.suspension, name], state.lives.get(name)
            assert one["unknown_life"] == state.unknown.get(name, "")
            if life is None:
                assert one["life"] is None
                continue
            n_known += 1
            median = life.quantile_km(0.5)
            assert one["life"]["median_km"] == (median if np.isfinite(median) else None)
    assert n_known > 10
    assert reports["flagged", "k_s"]["unknown_life"] == "all of the last 5 trips are flagged"
    in_plan = {(row["suspension"], row["parameter"]): row["unknown"] for row in view.plan.rows()}
    unknown = {key: one["unknown_life"] for key, one in reports.items() if one["unknown_life"]}
    assert unknown.items() <= in_plan.items()


def test_report_overview_plan_and_fleet_page_give_the_same_severities_and_reasons(outcomes):
    folder, view, done = outcomes
    severities = {
        path.parent.name: json.loads(path.read_text())["severity"]
        for path in (folder / "out").glob("*/metrics.json")
    }
    table = rows_of(folder / "out" / "overview.csv")
    assert severities == {row["suspension"]: row["severity"] for row in view.rows}
    assert severities == {name: row["severity"] for name, row in table.items()}
    assert severities == {one.name: str(one.severity) for one in done}
    assert severities["unsure"] == "unknown"
    assert severities["failed"] == "act"
    for row in view.rows:
        if row["severity"] != "none":
            one = table[row["suspension"]]
            assert (row["parameter"], row["reason"]) == (one["parameter"], one["reason"])
    of_each = {key: one["severity"] for key, one in reported(folder).items()}
    for row in view.plan.rows():
        assert row["severity"] == of_each[row["suspension"], row["parameter"]]
    assert exit_code(done) == max(ALARMS.get(state.severity, 0) for state in view.states)


def test_series_and_trips_of_the_store_are_those_of_the_report(outcomes):
    folder, _, done = outcomes
    with History(folder / "fleet.db") as history:
        of_place = {one.place: one for one in history.series()}
        results = {one.place: history.read(*one.state.key) for one in done}
    assert len(of_place) == len(NAMES)
    for one in done:
        series = one.state.series
        assert series.equals(of_place[one.place])
        stored = with_widened(results[one.place], series.events)
        assert [r.estimates for r in stored] == [r.estimates for r in one.results]
        assert [r.half_widths for r in stored] == [r.half_widths for r in one.results]
        for name, column in series.estimates.items():
            assert column.tolist() == [r.estimates[name] for r in stored]
