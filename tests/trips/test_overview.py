"""Several suspensions: each its own report and model, and one overview with the worst first."""

import csv
import json
from dataclasses import replace
from html.parser import HTMLParser

import pyarrow.parquet as pq
import pytest
from trip_fixtures import changed, model_at, small_fleet
from trip_records import HALF_WIDTHS, flagged, trip

from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import DEFAULT_LIMITS, Severity, kind_of
from suspnet.ground.records import Place
from suspnet.trains.jobs import fleet
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.maintenance.series import series_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.output import write_overview
from suspnet.trains.pages.overview import Evaluated

SETTINGS = FleetSettings(TripSettings())


@pytest.fixture(scope="module")
def models():
    """A model of either bogie; that of the trailing one is the other's, under another name."""
    leading = model_at()
    return [leading, replace(leading, generator=replace(leading.generator, bogie="trailing"))]


@pytest.fixture
def made_up(monkeypatch):
    """Read no recording: a trip's name says how stiff its k_s is, in %."""

    def read(file, *_):
        k_s = float(file.path.stem.rpartition("_")[2]) / 100
        result = trip(0, with_curves=False, half_widths=HALF_WIDTHS)
        return replace(result, manifest=str(file.path), estimates=result.estimates | {"k_s": k_s})

    monkeypatch.setattr(fleet, "evaluate_trip", read)


def write(folder, *stiffness, suspension="car 7", **where):
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{key}: {value}" for key, value in ({"suspension": suspension} | where).items()]
    for i, percent in enumerate(stiffness):
        (folder / f"trip_{i}_{percent}.yaml").write_text("\n".join(lines))


def bogie_of(folder):
    return json.loads((folder / "metrics.json").read_text())["details"]["bogie"]


# the whole way


def test_one_pool_reads_all_suspensions_in_any_order(
    models, made_up, no_figures, tmp_path, monkeypatch
):
    folder = tmp_path / "trips"
    for car in (1, 2, 3):
        write(folder / f"{car}", 100, 90 + car, suspension=f"car {car}", bogie="leading")
    several = replace(SETTINGS, workers=2)
    calls, kept = [], {}
    monkeypatch.setattr(fleet.FinishedTrips, "made_from", lambda _, file: file.path)
    monkeypatch.setattr(fleet.FinishedTrips, "read", lambda _, path: kept.get(path))
    monkeypatch.setattr(fleet.FinishedTrips, "write", lambda _, path, one: kept.update({path: one}))

    def read(function, items, n_workers):
        calls.append((len(items), n_workers))
        return [(item, function(item)) for item in items[::-1]]

    monkeypatch.setattr(fleet, "each", read)
    found = evaluate_fleet(folder, models, tmp_path / "out", several, progress=False)
    assert calls == [(6, 2)]
    k_s = {one.name: {r.estimates["k_s"] for r in one.results} for one in found}
    assert k_s == {f"{car}": {1.0, (90 + car) / 100} for car in (1, 2, 3)}
    again = evaluate_fleet(folder, models, tmp_path / "out", several, progress=False)
    assert calls == [(6, 2), (0, 2)]  # all trips are finished
    assert [one.name for one in again] == [one.name for one in found]


def test_each_suspension_has_its_model_and_the_worst_is_first(
    models, made_up, no_figures, tmp_path, caplog
):
    folder, out = tmp_path / "trips", tmp_path / "out"
    write(folder / "good", 100, suspension="car 1", bogie="leading", side="left")
    write(folder / "failed", 100, 150, suspension="car 2", bogie="trailing", side="right")
    write(folder / "worn", 88, 87, suspension="car 3", bogie="leading")
    write(folder / "unnamed", 100, suspension="car 4")  # fits neither model alone
    (folder / "empty").mkdir()
    with caplog.at_level("INFO", logger="suspnet"):
        done = evaluate_fleet(folder, models, out, SETTINGS, progress=False)
    assert [one.name for one in done] == ["failed", "worn", "empty", "unnamed", "good"]
    assert [str(one.severity) for one in done] == ["act", "notice", "unknown", "unknown", "none"]
    assert bogie_of(out / "failed") == "trailing"
    assert bogie_of(out / "worn") == bogie_of(out / "good") == "leading"
    assert not (out / "unnamed").exists()
    assert "the models are for both bogies: name `bogie: leading` or" in done[3].error
    assert "empty is not read: " in caplog.text
    assert (
        "Act: 1 of 4 parameters is beyond the act limit:\n  act      k_s: the last" in caplog.text
    )
    assert "5 suspensions: 1 to act on, 1 to be looked at, 2 not judged, 1 without" in caplog.text
    table = pq.read_table(out / "overview.parquet").to_pylist()
    with (out / "overview.csv").open(newline="") as stream:
        text = list(csv.DictReader(stream))
    assert [row["suspension"] for row in table] == ["car 2", "car 3", "empty", "car 4", "car 1"]
    assert [row["severity"] for row in text] == [str(one.severity) for one in done]
    first = table[0]
    assert (first["parameter"], first["bogie"], first["side"]) == ("k_s", "trailing", "right")
    assert first["k_s_last"] == 1.5  # that of the newest trip, as the reason says
    assert (first["n_trips"], first["n_estimated"], first["report"]) == (2, 2, "failed/report.html")
    assert "150 % of healthy, above the act limit" in first["reason"]
    assert table[2]["reason"].startswith("not read: ")
    assert table[2]["report"] == ""


def test_recordings_of_two_suspensions_in_one_folder_are_read_apart(
    models, no_figures, recalled, tmp_path
):
    manifests, folder = small_fleet(), tmp_path / "trips"
    folder.mkdir()
    changed(manifests[0], folder, "a", suspension="x", bogie="leading")
    changed(manifests[1], folder, "b", suspension="y", bogie="leading")
    changed(
        manifests[2],
        folder,
        "c",
        suspension="x",
        bogie="leading",
        channels={"body": {"file": "no"}},
    )
    done = evaluate_fleet(folder, models[:1], tmp_path / "out", SETTINGS, progress=False)
    read = {str(one.place): [(r.trip, r.status) for r in one.results] for one in done}
    assert read == {
        "x, leading bogie": [("a", "ok"), ("c", "error")],
        "y, leading bogie": [("b", "ok")],
    }
    assert {one.name: one.is_complete for one in done} == {
        "x_leading_bogie": False,
        "y_leading_bogie": True,
    }


# the models


def test_none_left_is_an_error(models, made_up, no_figures, tmp_path):
    for name in ("one", "two"):
        write(tmp_path / "trips" / name, 100, suspension=name)
    with pytest.raises(
        ValueError, match=r"none of its 2 suspensions can be read \(one: the models"
    ):
        evaluate_fleet(tmp_path / "trips", models, tmp_path / "out", SETTINGS, progress=False)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "severity", "why"),
    [
        (None, Severity.ACT, "rule 7"),
        ({"k_s": {"act": [0.5, 2.0]}}, Severity.NOTICE, "set for this evaluation"),
    ],
)
def test_limits_are_the_vehicles_unless_the_settings_say_others(
    models, made_up, no_figures, tmp_path, given, severity, why
):
    write(tmp_path / "trips", 115, bogie="trailing", side="right")
    rules = {"k_s": {"act": [0.5, 1.12], "why": "rule 7"}, "k_p": None}
    generator = models[1].generator
    ours = replace(generator, vehicle=replace(generator.vehicle, limits=rules))
    model = replace(models[1], generator=ours)

    def evaluated(limits):
        settings = FleetSettings(TripSettings(), limits=limits)
        (one,) = evaluate_fleet(tmp_path / "trips", [model], tmp_path / "out", settings, False)
        return one

    one = evaluated(given)
    assert (one.is_complete, one.severity) == (True, severity)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert {kind_of(name) for name in metrics["limits"]} == {"c_p", "k_s", "c_s"}
    assert metrics["limits"]["k_s"]["notice"] == [0.9, 1.1]
    assert metrics["limits"]["k_s"]["why"] == why
    assert f"({why})" in metrics["details"]["limits"]
    (row,) = pq.read_table(tmp_path / "out" / "trips.parquet").to_pylist()
    assert (row["bogie"], row["side"]) == ("trailing", "right")
    assert not (tmp_path / "out" / "overview.csv").exists()
    with pytest.raises(ValueError, match=r"`limits\.k_s`: limits `notice` .* within `act`"):
        evaluated({"k_s": {"notice": [0.9, 1.2]}})


# the page


class Links(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.links, self.rows = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag == "a":
            self.links.append(dict(attributes)["href"])
        if tag == "tr":
            self.rows.append(dict(attributes).get("class"))


def test_page_links_each_report_and_escapes_names(tmp_path):
    hostile = "<script>alert('x')</script> & \"y\""
    odd = flagged(trip(0, with_curves=False))
    state = State(series_of([odd]), DEFAULT_LIMITS)
    done = [
        Evaluated("a b#?", Place(hostile, "leading", "left"), [odd], state),
        Evaluated("broken", Place("broken"), error=hostile),
    ]
    words = write_overview(done, tmp_path)
    assert words.startswith("2 suspensions: 2 not judged.")
    text = (tmp_path / "overview.html").read_text()
    page = Links(text)
    assert "<script" not in text
    assert page.links == ["a%20b%23%3F/report.html"]
    assert page.rows == [None, "plain", "plain"]
    assert "nan" not in text.lower().split()
