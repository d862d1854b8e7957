"""A folder of trips: the same whatever the workers, and everything that is written of it."""

import csv
import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from cli_runner import blank_figures
from trip_fixtures import OUTPUTS, changed, recalled_trip, signal
from trip_records import fleet as made_up

from suspnet.curves.curves import CurveSettings
from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.ground.records import NO_ESTIMATE
from suspnet.ground.storage import load_arrays, read_plain
from suspnet.trains.jobs import fleet
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.pages import output
from suspnet.trains.pages.output import (
    coverage_percent,
    errors_percent,
    sensor_lines,
    summary,
    write_tables,
)
from suspnet.trains.recordings import manifest_files
from suspnet.trains.recordings.cleaning import Fault
from suspnet.trains.recordings.dead_sensors import NOTHING, dead_faults
from suspnet.trains.trips import earlier as finished
from suspnet.trains.trips.commissionings import check_models

TRIPS = TripSettings()
SETTINGS = FleetSettings(TRIPS)
FIGURES = {"trend", "responses", "signals"}


def read(folder, models, out, settings=SETTINGS):
    """Return the results of a folder of one suspension."""
    (one,) = evaluate_fleet(folder, models, out, settings, progress=False)
    return one.results


@pytest.fixture(scope="module")
def alone(manifests, model):
    """Each trip's result, evaluated by itself."""
    return [recalled_trip(path, [model], TRIPS) for path in manifests]


@pytest.fixture(scope="module")
def broken(manifests, tmp_path_factory):
    """A folder of four good trips, in another order, and three bad ones."""
    folder = tmp_path_factory.mktemp("broken")
    for name, i in (("d", 0), ("c", 3), ("b", 1), ("a", 4)):
        changed(manifests[i], folder, name)
    changed(manifests[2], folder, "slow", speed=20.0)
    changed(manifests[5], folder, "dead", signals={"body": 0 * signal(manifests[5], "body")})
    (folder / "nonsense.yaml").write_text("<b>: [")
    return folder


@pytest.fixture(scope="module")
def done(broken, model, tmp_path_factory):
    """The folder written of `broken`, and the results."""
    folder = tmp_path_factory.mktemp("done")
    with blank_figures():
        return folder, read(broken, [model], folder)


def estimates(results):
    return {r.mileage_km: r.estimates for r in results if r.status == "ok"}


def rows(path):
    if path.suffix == ".parquet":
        return pq.read_table(path).to_pylist()
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def same(a, b):
    """Whether two values, or a value and its text, are equal; NaN is NaN."""
    b = type(a)(b) if not isinstance(a, str) else b
    return a == b or (a != a and b != b)


# reference: the fleet is its trips


def test_bad_trips_are_rows_and_the_others_as_if_alone(done, alone):
    _, results = done
    assert [r.trip for r in results] == ["d", "b", "slow", "c", "a", "dead", "nonsense"]
    assert [r.status for r in results] == [*("ok", "ok", "no estimate", "ok", "ok"), *["error"] * 2]
    good = {i: results[place] for i, place in ((0, 0), (1, 1), (3, 3), (4, 4))}
    for i, result in good.items():
        assert result.estimates == alone[i].estimates
        assert result.quality == alone[i].quality
    assert "the model reads 64.4 to 75.6 m/s" in results[2].reason
    assert results[5].reason.startswith("channel 'body' is constant (0) throughout")
    assert results[6].reason.startswith("is not valid YAML")


def test_errors_and_coverage_are_the_naive_ones(alone):
    held = coverage_percent(alone, OUTPUTS)
    for name, error in errors_percent(alone, OUTPUTS).items():
        ratios = np.array([r.estimates[name] / r.truth[name] for r in alone])
        assert error == pytest.approx(100 * np.sqrt(np.mean((ratios - 1) ** 2)))
        assert error > 0
        inside = np.abs(np.log(ratios)) <= [r.half_widths[name] for r in alone]
        assert held[name] == pytest.approx(100 * np.mean(inside))


def test_errors_and_coverage_are_of_trips_with_an_estimate_and_a_known_truth(alone):
    unknown = [
        replace(alone[0], truth={}),
        replace(alone[1], truth={"k_p": 1.0}, half_widths={}),
        replace(alone[2], status="error", estimates={}),
    ]
    partly = [unknown[1], alone[3]]
    expected = errors_percent([alone[3]], OUTPUTS) | errors_percent(partly, ("k_p",))
    assert errors_percent([*unknown, alone[3]], OUTPUTS) == expected
    assert coverage_percent(unknown, OUTPUTS) == {}
    found = coverage_percent([*unknown, alone[3]], OUTPUTS)
    assert found == coverage_percent([alone[3]], OUTPUTS)


# going on


def unread(*_, **__):
    raise KeyboardInterrupt("read again")


def copied(manifests, folder, names):
    """Copy trips into a folder, without their files."""
    for name, manifest in zip(names, manifests, strict=False):
        changed(manifest, folder, name)
    return folder


@pytest.fixture
def three(manifests, tmp_path):
    (tmp_path / "trips").mkdir()
    return copied(manifests, tmp_path / "trips", "abc")


def test_manifests_are_read_once_and_finished_trips_not_again(
    three, model, no_figures, recalled, monkeypatch, tmp_path
):
    seen = []

    def noted(path, *most):
        seen.append(path)
        return read_plain(path, *most)

    monkeypatch.setattr(manifest_files, "read_plain", noted)
    first = read(three, [model], tmp_path / "out")
    assert [r.status for r in first] == ["ok"] * 3
    assert len(seen) == len(set(seen)) == 3
    monkeypatch.setattr(fleet, "evaluate_trip", unread)
    again = read(three, [model], tmp_path / "out")
    assert [repr(r.row(OUTPUTS)) for r in again] == [repr(r.row(OUTPUTS)) for r in first]
    for one, other in zip(first, again, strict=True):
        for name, values in vars(one.curves).items():
            np.testing.assert_array_equal(values, getattr(other.curves, name))


def test_interrupted_fleet_goes_on_and_ends_as_if_uninterrupted(
    three, manifests, model, no_figures, recalled, monkeypatch, tmp_path
):
    seen = []

    def interrupted(file, *arguments, **options):
        seen.append(file.path.stem)
        if seen == ["a", "b"]:
            raise KeyboardInterrupt("stop")
        return recalled_trip(file, *arguments, **options)

    monkeypatch.setattr(fleet, "evaluate_trip", interrupted)
    with pytest.raises(KeyboardInterrupt, match="stop"):
        read(three, [model], tmp_path / "out")
    assert not (tmp_path / "out" / "trips.csv").exists()
    copied(manifests[3:], three, "d")  # a new one
    found = read(three, [model], tmp_path / "out")
    assert seen == ["a", "b", "b", "c", "d"]
    assert estimates(found) == estimates(read(three, [model], tmp_path / "whole"))


@pytest.mark.representatives(2)
@pytest.mark.parametrize("what", ["file", "manifest", "model", "settings", "kept"])
def test_trip_is_read_again_if_anything_differs(
    three, manifests, model, no_figures, recalled, monkeypatch, tmp_path, what
):
    seen, models, settings = [], [model], SETTINGS
    target = three / "a.yaml"
    if what == "file":
        changed(manifests[0], three, "a", {"body": signal(manifests[0], "body")})
    read(three, models, tmp_path / "out")
    if what == "file":
        changed(manifests[0], three, "a", {"body": 1.01 * signal(manifests[0], "body")})
    if what == "manifest":
        target.write_text(target.read_text() + "# text")
    if what == "model":
        models = [replace(model, training=model.training | {"seed": 1})]
    if what == "settings":
        settings = replace(SETTINGS, trips=TripSettings(level=0.95))
    if what == "kept":
        kept = sorted((tmp_path / "out" / finished.FOLDER).iterdir())[0]
        kept.write_bytes(kept.read_bytes()[:-1])
    monkeypatch.setattr(fleet, "evaluate_trip", lambda p, *_, **__: seen.append(p) or made_up(1)[0])
    read(three, models, tmp_path / "out", settings)
    assert len(seen) == (3 if what in ("model", "settings") else 1)


# what is written


def test_tables_have_a_row_a_trip_and_agree(done):
    folder, results = done
    parquet, text = rows(folder / "trips.parquet"), rows(folder / "trips.csv")
    assert len(parquet) == len(text) == len(results)
    for a, b, result in zip(parquet, text, results, strict=True):
        assert list(a) == list(b) == list(result.row(OUTPUTS))
        for name, value in result.row(OUTPUTS).items():
            assert same(value, a[name]), name
            assert same(value, b[name]), name


def test_columns_do_not_depend_on_success(done, alone, tmp_path):
    folder, results = done
    schema = pq.read_schema(folder / "trips.parquet")
    for name, some in (("good", alone[:2]), ("bad", results[5:]), ("one", results[2:3])):
        write_tables(some, OUTPUTS, tmp_path / name)
        assert pq.read_schema(tmp_path / name / "trips.parquet") == schema
        assert pacsv.read_csv(tmp_path / name / "trips.csv").column_names == schema.names
        exists = (tmp_path / name / "responses.parquet").exists()
        assert exists is (name == "good")
    for field in schema:
        name = field.name
        number = isinstance(alone[0].row(OUTPUTS)[name], float | int)
        assert pa.types.is_string(field.type) is not number


def test_responses_are_those_of_each_trip(done, alone):
    folder, _ = done
    table = pq.read_table(folder / "responses.parquet").to_pydict()
    assert list(dict.fromkeys(table["trip"])) == ["d", "b", "c", "a"]
    chosen = np.array(table["trip"]) == "b"
    columns = {name: np.array(values)[chosen] for name, values in table.items()}
    curves = alone[1].curves
    for i, link in enumerate(("p", "s")):
        response = columns[f"magnitude_{link}"] * np.exp(1j * columns[f"phase_rad_{link}"])
        np.testing.assert_allclose(response, curves.responses[i], rtol=1e-12)
        np.testing.assert_array_equal(columns[f"coherence_{link}"], curves.coherences[i])
        np.testing.assert_array_equal(columns[f"deviation_{link}"], curves.deviations[i])
    np.testing.assert_array_equal(columns["frequency_hz"], curves.frequencies_hz)


def test_metrics_and_figures(done, broken, alone):
    folder, _ = done
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (metrics["n_trips"], metrics["n_estimated"]) == (7, 4)
    expected = errors_percent([alone[i] for i in (0, 1, 3, 4)], OUTPUTS)
    assert metrics["rms_error_percent"] == pytest.approx(expected)
    assert [one["parameter"] for one in metrics["trends"]] == list(OUTPUTS)
    for one in metrics["trends"]:  # four trips show no change, but levels beyond limits
        limits, newest = DEFAULT_LIMITS.get(one["parameter"]), alone[4].estimates[one["parameter"]]
        assert (one["n_trips"], one["changed"]) == (4, False)
        if limits and not limits.notice[0] <= newest <= limits.notice[1]:
            assert one["severity"] in ("unknown", "notice", "act")
        if not limits:
            assert one["severity"] == "none"
    order = ["none", "unknown", "notice", "act"]
    severities = [one["severity"] for one in metrics["trends"]]
    assert metrics["severity"] == max(severities, key=order.index)
    details = metrics["details"]
    assert details["trips"] == str(broken)
    assert details["model"].startswith("msvr, trained on 1000 curves")
    assert details["speeds"] == "64.4 to 75.6 m/s"
    assert details["healthy is"] == "the vehicle file's drawing"
    drawn = {path.stem for path in (folder / "figures").glob("*.png")}
    found = [one["parameter"] for one in metrics["trends"] if one["severity"] != "none"]
    findings = {f"trend_{name}" for name in found}
    assert drawn == FIGURES | findings


def test_nothing_works_at_all(broken, model, blank, tmp_path):
    folder = tmp_path / "bad"
    folder.mkdir()
    shutil.copy(broken / "nonsense.yaml", folder)
    shutil.copy(broken / "dead.yaml", folder)
    results = read(folder, [model], tmp_path / "out")
    assert [r.status for r in results] == ["error", "error"]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["n_estimated"] == 0
    assert metrics["rms_error_percent"] == {}
    assert "nonsense" in (tmp_path / "out" / "report.html").read_text()
    assert len(rows(tmp_path / "out" / "trips.csv")) == 2
    assert not (tmp_path / "out" / "responses.parquet").exists()


def test_dead_sensors_and_alarms_of_sensors_are_printed(alone):
    constant = Finding("is-constant", value=0.0)
    dead = dead_faults({"bogie right": NOTHING, "body axle2 right": constant}, 300.0, 100.0)
    repaired = Fault("bogie left", "gap", 9, 1.0, 0.0, True)
    faults = together(map(str, [repaired, *dead]))
    half_dead = [replace(r, quality=replace(r.quality, faults=faults)) for r in alone[1:3]]
    alarms = [
        Alarm("body left", Cause.SENSOR, Severity.NOTICE, 7e4, end, "sensor body left: noise")
        for end in (np.nan, 9e4)
    ]
    alarm, first, second = sensor_lines([alone[0], *half_dead], alarms)
    assert alarm == "  notice   sensor body left: noise (alarm since 70 000 km)"
    assert first.startswith("  notice   sensor bogie right: dead")
    assert second.startswith("  notice   sensor body axle2 right: dead and left out")
    names = f"(in {alone[1].trip}, {alone[2].trip})"
    assert first.endswith(f"it {NOTHING} {names}")
    assert second.endswith(f"it {constant} {names}")


# failure


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("write_table", OSError("disk full")),
        ("replace", KeyboardInterrupt("stop")),
        ("write_report", KeyboardInterrupt("stop")),
    ],
)
def test_interrupted_run_leaves_only_whole_files(
    manifests, model, no_figures, recalled, monkeypatch, tmp_path, place, error
):
    def fail(*_):
        raise error

    folder = tmp_path / "trips"
    folder.mkdir()
    changed(manifests[0], folder)
    target = {"write_table": pq, "replace": os, "write_report": output}[place]
    monkeypatch.setattr(target, place, fail)
    out = tmp_path / "out"
    with pytest.raises(type(error), match=str(error)):
        read(folder, [model], out)
    monkeypatch.undo()
    files = {p for p in out.rglob("*") if p.is_file()}
    kept = {p for p in files if p.parent.name == finished.FOLDER}
    assert all(load_arrays(p.read_bytes().split(b"\n", 2)[2], p.name) for p in kept)
    left = {p.name for p in files - kept}
    assert "report.html" not in left
    assert not [name for name in left if name.startswith(".")]
    if place == "write_report":
        assert len(rows(out / "trips.parquet")) == len(rows(out / "trips.csv")) == 1
        assert json.loads((out / "metrics.json").read_text())["n_trips"] == 1
    else:
        assert left == set()


def test_models_that_cannot_read_trips_are_refused(model):
    generator = model.generator
    slower = replace(model, generator=replace(generator, speed_m_per_s=50.0))
    assert check_models([model]) == check_models([slower, model]) == OUTPUTS
    heavy = replace(model.vehicle, bogie_mass_kg=2000.0)
    for changes, message in (
        ({"settings": CurveSettings()}, r"protocol 'trips' was trained on curves of section"),
        ({"task": replace(model.task, mass_known=True)}, "mass_known=true cannot read trips"),
        ({"generator": replace(generator, vehicle=heavy)}, "must share vehicle and outputs"),
        ({"task": replace(model.task, outputs=OUTPUTS[:4])}, "must share vehicle and outputs"),
    ):
        with pytest.raises(ModelFileError, match=message):
            check_models([model, replace(model, **changes)])


# intervals and flags


def test_reasons_are_whole_in_the_summary_and_in_the_table(alone, tmp_path):
    words = "k_p at about 27 % lies outside the 50 to 160 % trained for; " * 5
    loose = replace(alone[1].quality, faults="a is loose")
    names = ("1.10", "001", "1e5")  # stay as they are
    results = [
        replace(one, trip=name, flags=flags)
        for one, name, flags in zip(alone, names, (words, "", words), strict=False)
    ]
    table, *reasons = summary(results, OUTPUTS).split("\n\n")
    first, *lines = table.splitlines()
    assert first == "3 of 3 trips have an estimate, 2 are flagged"
    cells = [[cell.strip() for cell in line.split("|")] for line in lines[2:5]]
    assert [(row[1], row[-2]) for row in cells] == list(
        zip(names, ("flagged", "", "flagged"), strict=True)
    )
    assert reasons == [f"1.10, 1e5: {words}"]
    write_tables(results, OUTPUTS, tmp_path)
    assert [row["flags"] for row in rows(tmp_path / "trips.csv")] == [words, "", words]
    # a trip without an estimate also says which faults it has
    sound = replace(results[1], quality=loose)
    assert "loose" not in summary([sound], OUTPUTS)
    none = replace(sound, status=NO_ESTIMATE, reason="too few averages")
    _, *reasons = summary([none], OUTPUTS).split("\n\n")
    assert reasons == ["001: too few averages; a is loose"]


def test_level_and_flags_are_counted(manifests, model, no_figures, monkeypatch, tmp_path):
    def odd(file, *_):
        result = recalled_trip(file, [model], TRIPS)
        return replace(result, flags="odd" if file.path == manifests[1] else "")

    levels = []
    monkeypatch.setattr(output, "write_report", lambda *given: levels.append(given[2].level))
    monkeypatch.setattr(fleet, "evaluate_trip", odd)
    wide = TripSettings(level=0.95)
    results = read(manifests[0].parent, [model], tmp_path, FleetSettings(wide))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["n_flagged"] == 1
    assert metrics["coverage_percent"] == pytest.approx(coverage_percent(results, OUTPUTS))
    assert levels == [0.95]
    n = len(model.intervals.conformal.scores)
    assert metrics["details"]["intervals"].startswith(f"95 %, calibrated on {n} simulated curves")


def test_model_without_calibration_gives_no_intervals(manifests, model, no_figures, tmp_path):
    folder = tmp_path / "trips"
    folder.mkdir()
    changed(manifests[0], folder)
    plain = replace(model, intervals=None, ood=None)
    (result,) = read(folder, [plain], tmp_path / "out")
    assert result.status == "ok"
    assert np.isnan(result.interval("k_p")).all()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["coverage_percent"] == {}
    assert metrics["details"]["intervals"].startswith("none: the model was trained with")
