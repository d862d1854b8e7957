"""A folder of trips: the same whatever the workers, and everything that is written of it."""

import csv
import json
import os
import shutil
import sys
from dataclasses import replace
from html import unescape

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from cli_runner import blank_figures
from dying_readers import open_dying
from dying_trips import mortal
from forked import forks
from joblib.externals.loky import ProcessPoolExecutor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trip_fixtures import OUTPUTS, changed, recalled_trip, signal, slow_model
from trip_records import fleet as made_up

from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground import workers
from suspnet.ground.findings import NO_PART, Finding
from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.ground.storage import read_arrays, read_plain
from suspnet.maintenance.alarms import Alarm
from suspnet.maintenance.series import series_of
from suspnet.maintenance.state import State
from suspnet.maintenance.trend import LEAST_PERCENT
from suspnet.recordings import manifest_files
from suspnet.recordings.cleaning import Fault
from suspnet.recordings.dead_sensors import NOTHING, dead_faults
from suspnet.recordings.formats import READERS
from suspnet.recordings.reader_process import LIMIT, in_own_process
from suspnet.report import output
from suspnet.report.output import (
    coverage_percent,
    errors_percent,
    sensor_lines,
    summary,
    write_tables,
)
from suspnet.report.tensorboard import RunLog
from suspnet.spectra.curves import CurveSettings
from suspnet.trips import earlier as finished
from suspnet.trips import fleet
from suspnet.trips.commissionings import check_models
from suspnet.trips.fleet import FleetSettings, evaluate_fleet

TRIPS = TripSettings()
SETTINGS = FleetSettings(TRIPS)
FIGURES = {"trend", "responses", "signals", "quality"}


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
    b = type(a)(b)
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


@pytest.mark.slow  # one of two workers that is killed costs its trip alone: see below
def test_two_workers_change_nothing(manifests, model, alone, no_figures, tmp_path):
    results = read(manifests[0].parent, [model], tmp_path, FleetSettings(TRIPS, workers=2))
    assert list(estimates(results)) == list(estimates(alone))
    are_as_if_alone(results, alone)


def are_as_if_alone(results, alone):
    """Compare the estimates of good trips with those that each gets by itself."""
    found, expected = estimates(results), estimates(alone)
    for mileage, values in expected.items():
        # BLAS may sum in another order where it has other threads
        assert found[mileage] == pytest.approx(values, rel=1e-9)


def test_dask_changes_nothing(manifests, model, alone, no_figures, tmp_path):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    with distributed.LocalCluster(**options, dashboard_address=":0") as cluster:
        settings = FleetSettings(TRIPS, cluster=cluster.scheduler_address)
        results = read(manifests[0].parent, [model], tmp_path, settings)
    assert estimates(results) == estimates(alone)


def test_errors_are_the_naive_ones(alone):
    for name, value in errors_percent(alone, OUTPUTS).items():
        squares = [(r.estimates[name] / r.truth[name] - 1) ** 2 for r in alone]
        assert value == pytest.approx(100 * (sum(squares) / len(squares)) ** 0.5)
        assert value > 0


def test_errors_are_of_trips_with_an_estimate_and_a_known_truth(alone):
    unknown = [
        replace(alone[0], truth={}),
        replace(alone[1], truth={"k_p": 1.0}),
        replace(alone[2], status="error", estimates={}),
    ]
    both = [unknown[1], alone[3]]
    assert errors_percent(unknown, OUTPUTS) == errors_percent([unknown[1]], ("k_p",))
    found = errors_percent([*unknown, alone[3]], OUTPUTS)
    assert found == errors_percent([alone[3]], OUTPUTS) | errors_percent(both, ("k_p",))


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


def test_finished_trips_are_not_read_again(
    three, model, no_figures, recalled, monkeypatch, tmp_path
):
    first = read(three, [model], tmp_path / "out")
    monkeypatch.setattr(fleet, "evaluate_trip", unread)
    again = read(three, [model], tmp_path / "out")
    assert [repr(r.row(OUTPUTS)) for r in again] == [repr(r.row(OUTPUTS)) for r in first]
    for one, other in zip(first, again, strict=True):
        for name, values in vars(one.curves).items():
            np.testing.assert_array_equal(values, getattr(other.curves, name))


def test_each_manifest_is_read_once(three, model, no_figures, recalled, monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(
        manifest_files,
        "read_plain",
        lambda path, *most: seen.append(path) or read_plain(path, *most),
    )
    found = read(three, [model], tmp_path / "out")
    assert [r.status for r in found] == ["ok"] * 3
    assert len(seen) == len(set(seen)) == 3


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
    curves = alone[1].curves
    for i, link in enumerate(("p", "s")):
        magnitude, phase, coherence, deviation = (
            np.array(table[f"{what}_{link}"])[chosen]
            for what in ("magnitude", "phase_rad", "coherence", "deviation")
        )
        response = magnitude * np.exp(1j * phase)
        np.testing.assert_allclose(response, curves.responses[i], rtol=1e-12)
        np.testing.assert_array_equal(coherence, curves.coherences[i])
        np.testing.assert_array_equal(deviation, curves.deviations[i])
    np.testing.assert_array_equal(np.array(table["frequency_hz"])[chosen], curves.frequencies_hz)


def test_metrics_and_figures(done, broken, alone):
    folder, _ = done
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (metrics["n_trips"], metrics["n_estimated"]) == (7, 4)
    expected = errors_percent([alone[i] for i in (0, 1, 3, 4)], OUTPUTS)
    assert metrics["rms_error_percent"] == pytest.approx(expected)
    assert [one["parameter"] for one in metrics["trends"]] == list(OUTPUTS)
    assert [one["n_trips"] for one in metrics["trends"]] == [4] * 5
    for one in metrics["trends"]:  # four trips tell no change, but levels beyond limits
        limits, newest = DEFAULT_LIMITS.get(one["parameter"]), alone[4].estimates[one["parameter"]]
        assert not one["changed"]
        if limits and not limits.notice[0] <= newest <= limits.notice[1]:
            assert one["severity"] in ("unknown", "notice", "act")
            assert "the last" in one["words"]
        if not limits:
            assert one["severity"] == "none"
    assert metrics["severity"] == max(
        (one["severity"] for one in metrics["trends"]),
        key=["none", "unknown", "notice", "act"].index,
    )
    details = metrics["details"]
    assert details["trips"] == str(broken)
    assert details["model"] == "msvr, trained on 1000 curves of VerticalVehicle"
    assert details["speeds"] == "64.4 to 75.6 m/s"
    assert details["transfer functions"] == "IV, hann windows of 20 s"
    assert details["healthy is"] == "the vehicle file's drawing"
    assert details["misfit of the healthy trips"].startswith("none: the vehicle is that of the")
    assert {path.stem for path in (folder / "figures").glob("*.png")} == FIGURES


def test_tensorboard_has_a_scalar_at_each_mileage(done, alone):
    folder, _ = done
    events = EventAccumulator(str(folder)).Reload()
    tags = events.Tags()
    assert set(tags["scalars"]) == {f"trips/{name}" for name in (*OUTPUTS, "n_averages")}
    assert set(tags["images"]) == FIGURES
    assert "trips/text_summary" in tags["tensors"]
    scalars = events.Scalars("trips/c_s")
    for name in ("c_s", "n_averages"):
        steps = [event.step for event in events.Scalars(f"trips/{name}")]
        assert steps == [1000, 2000, 4000, 5000]
    expected = [alone[i].estimates["c_s"] for i in (0, 1, 3, 4)]
    assert [event.value for event in scalars] == pytest.approx(expected, rel=1e-6)


def test_report_names_each_trip_and_reason(done):
    folder, results = done
    text = (folder / "report.html").read_text()
    assert "<b>" not in text.replace("<body>", "")
    plain = " ".join(unescape(text).split())
    for result in results:
        assert result.trip in plain
        assert result.reason in plain
    assert plain.count("data:image/") >= len(FIGURES)


def test_summary_names_trips_errors_and_reasons(done):
    _, results = done
    text = summary(results, OUTPUTS)
    table, *reasons = text.split("\n\n")
    first, _, _, *lines = table.splitlines()
    assert first.startswith("4 of 7 trips have an estimate, ")
    assert [line.split("|")[1].strip() for line in lines[:-2]] == [r.trip for r in results]
    assert lines[-2].startswith("| rms error %")
    assert lines[-1].startswith("| intervals hold %")
    assert "`" not in lines[0]
    assert lines[2].endswith("| no estimate |")
    assert f"{results[2].trip}: {results[2].reason}" in reasons
    first = summary(results[5:], OUTPUTS).splitlines()[0]
    assert first == "0 of 2 trips have an estimate, 0 are flagged"
    assert "rms error" not in summary(results[5:], OUTPUTS)


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


def test_reference_of_the_first_trips(manifests, model, alone, no_figures, recalled, tmp_path):
    folder = manifests[0].parent
    settings = FleetSettings(TRIPS, reference="first_trips", n_reference=3)
    results = read(folder, [model], tmp_path, settings)
    for name in OUTPUTS:
        reference = 1.0 if name == "M_s" else sorted(r.raw[name] for r in alone[:3])[1]
        for result, by_itself in zip(results, alone, strict=True):
            assert result.raw == by_itself.raw
            expected = by_itself.raw[name] / reference
            assert result.estimates[name] == pytest.approx(expected, rel=1e-12)
    table = pq.read_table(tmp_path / "trips.parquet").to_pydict()
    assert table["k_s"] == [r.estimates["k_s"] for r in results] != table["k_s_raw"]
    details = json.loads((tmp_path / "metrics.json").read_text())["details"]
    assert details["healthy is"] == "the median of the first 3 trips (k and c)"


def test_report_is_there_where_too_few_trips_say_what_is_healthy(
    three, model, no_figures, recalled
):
    out = three.parent / "out"
    settings = FleetSettings(TRIPS, reference="first_trips", n_reference=5)
    (one,) = evaluate_fleet(three, [model], out, settings, progress=False)
    missing = "healthy is not known yet: 3 trips have an estimate, the first 5 are needed"
    for found in one.state.assessments:
        assert found.limited == (found.parameter != "M_s")
        assert found.words.startswith("healthy is not known yet; ") == found.limited
        assert (found.severity >= Severity.UNKNOWN) == found.limited
    metrics = json.loads((out / "metrics.json").read_text())
    words = metrics["details"]["healthy is"]
    assert words.startswith(f"the median of the first 3 trips (k and c); {missing} (lower monitor")
    assert sorted(r.estimates["k_p"] for r in one.results)[1] == 1.0


def test_report_is_there_where_no_trip_says_what_is_healthy(three, model, no_figures, recalled):
    for path in three.glob("*.yaml"):
        changed(path, three, path.stem, speed=20.0)
    out = three.parent / "out"
    settings = FleetSettings(TRIPS, reference="first_trips", n_reference=5)
    (one,) = evaluate_fleet(three, [model], out, settings, progress=False)
    words = json.loads((out / "metrics.json").read_text())["details"]["healthy is"]
    assert words.startswith("healthy is not known yet: 0 trips have an estimate")
    assert one.severity == Severity.UNKNOWN


def test_names_of_the_files_do_not_matter(done, broken, model, no_figures, recalled, tmp_path):
    """The first trips are those of least mileage, here d, b and c."""
    _, absolute = done
    settings = FleetSettings(TRIPS, reference="first_trips", n_reference=3)
    results = read(broken, [model], tmp_path, settings)
    assert [r.trip for r in results] == [r.trip for r in absolute]
    expected = sorted(r.raw["k_p"] for r in absolute if r.trip in ("d", "b", "c"))[1]
    for before, after in zip(absolute, results, strict=True):
        if before.status == "ok":
            assert before.estimates["k_p"] / after.estimates["k_p"] == pytest.approx(expected)


@pytest.mark.slow  # test_trip.py reads trips with models of two speeds
def test_models_of_two_speeds_read_one_folder(manifests, model, no_figures, tmp_path):
    folder = tmp_path / "trips"
    folder.mkdir()
    changed(manifests[0], folder, "fast")
    changed(manifests[1], folder, "middle", speed=60.0)
    models = [slow_model(), model]
    results = read(folder, models, tmp_path / "out")
    assert [r.status for r in results] == ["ok", "no estimate"]
    assert results[0].quality.speed_bins == "70.0 m/s: 27 averages"
    details = json.loads((tmp_path / "out" / "metrics.json").read_text())["details"]
    assert details["speeds"] == "46.0 to 54.0 m/s, 64.4 to 75.6 m/s"


def test_dead_sensors_and_alarms_of_sensors_are_printed(
    three, model, no_figures, monkeypatch, caplog
):
    alone = "{} and left out, bogie is read by its left sensor alone: it {}"
    constant = "is constant (0) throughout: is the sensor connected?"
    dead = [
        Fault("bogie left", "gap", 9, 1.0, 0.0, True),
        *dead_faults({"bogie right": NOTHING, "body axle2 right": constant}, 300.0, 100.0),
        Fault("body", "drift", 9, 1.0, 0.0, True, 0.3),
    ]

    def half_dead(*given):
        result = recalled_trip(*given)
        if result.trip == "a":
            return result
        return replace(result, quality=replace(result.quality, faults="; ".join(map(str, dead))))

    monkeypatch.setattr(fleet, "evaluate_trip", half_dead)
    with caplog.at_level("INFO", fleet.log.name):
        read(three, [model], three.parent / "dead")
    lines = caplog.messages[-1].splitlines()
    first = lines.index(f"  notice   sensor bogie right: {alone.format('dead', NOTHING)} (in b, c)")
    assert lines[first + 1].startswith("  notice   sensor body axle2 right: dead and left out")
    assert lines[first + 1].endswith(f"it {constant} (in b, c)")
    assert lines[first + 2].startswith("Alarms of changes: ")
    alarms = [
        Alarm("body left", Cause.SENSOR, Severity.NOTICE, 7e4, end, "sensor body left: noise")
        for end in (np.nan, 9e4)
    ]
    (line,) = sensor_lines([], alarms)
    assert line == "  notice   sensor body left: noise (alarm since 70 000 km)"


def test_change_below_what_the_model_resolves_does_not_changed_ones(model, monkeypatch):
    """k_p falls by 1 %, c_s by 40 % in the made-up fleet."""
    results = made_up(with_curves=False)

    def changed_ones(*errors):
        models = [
            replace(one, training={"test_rms_percent": {"k_p": e, "c_s": e}} if e else {})
            for one, e in zip((model, model), errors, strict=False)
        ]
        least = fleet.least_percent(OUTPUTS, models)
        found = State(series_of(results), DEFAULT_LIMITS, least_percent=least).assessments
        return {one.parameter for one in found if one.trend.changed}

    assert LEAST_PERCENT < 0.2
    assert changed_ones(None) == changed_ones(0.1) == {"k_p", "c_s"}
    assert changed_ones(1.0) == changed_ones(0.1, 1.0) == changed_ones(1.0, 0.1) == {"c_s"}
    assert changed_ones(50.0) == set()


# failure


@pytest.mark.slow  # test_workers.py kills a worker, test_bad_trips_are_rows has faults
def test_bad_trip_costs_its_row_and_the_report_exists(
    three, manifests, model, blank, alone, monkeypatch
):
    (three / "b.yaml").unlink()
    (three / "c.yaml").unlink()
    changed(manifests[0], three, "deadly")
    changed(manifests[0], three, "far", mileage_km=1e19)
    changed(manifests[0], three, "fast", channels={"body": {"rate_hz": 1e9}})
    changed(manifests[0], three, os.fsdecode(b"n\xffme"))
    changed(manifests[0], three, "untrue", truth=dict.fromkeys(OUTPUTS, 1e-299))
    changed(manifests[0], three, "surrogate", suspension="a \ud800 b")
    changed(manifests[0], three, os.fsdecode(b"b\xffd"), channels={"body": {"rate_hz": 50.0}})
    monkeypatch.setattr(fleet, "evaluate_trip", mortal)
    monkeypatch.setattr(workers, "guarded", lambda _: ProcessPoolExecutor(1, context=forks()))
    monkeypatch.setattr(RunLog, "figure", lambda *_: None)
    out = three.parent / "out"
    found = evaluate_fleet(three, [model], out, FleetSettings(TRIPS, workers=2), progress=False)
    results = {r.trip: r for one in found for r in one.results}
    assert {name for name, r in results.items() if r.status == "ok"} >= {"a", "n\\udcffme"}
    are_as_if_alone([results["a"]], alone[:1])
    reasons = {
        "deadly": "was killed (SIGKILL(-9)), and so was that of a second attempt",
        "far": "`mileage_km` must be at most 20000000 km (is it in metres?), got 1e+19",
        "fast": "channel 'body' has 1e+09 Hz; at most 1e+06 Hz can be read",
        "b\\udcffd": "channel 'body' has 50 Hz; at least 100 Hz are needed",
    }
    for name, reason in reasons.items():
        assert results[name].status == "error"
        assert reason in results[name].reason
    assert results.keys() == {"a", "n\\udcffme", "surrogate", "untrue", *reasons}
    assert (out / "overview.html").is_file() == (len(found) > 1)
    assert len(list(out.rglob("report.html"))) == len(found)


@pytest.mark.slow  # test_reader_process.py has each of them by default
def test_file_that_kills_or_hangs_its_reader_costs_its_row(
    three, manifests, model, blank, monkeypatch
):
    monkeypatch.setitem(READERS, ".mat", in_own_process(open_dying))
    monkeypatch.setenv(LIMIT, "2")
    for what in ("exit", "crash:1", "hang"):
        (three / f"{what}.mat").write_text(what)
        channels = {"body": {"file": f"{what}.mat", "column": "a", "unit": "g"}}
        changed(manifests[0], three, what, channels=channels)
    monkeypatch.setattr(RunLog, "figure", lambda *_: None)
    out = three.parent / "out"
    found = evaluate_fleet(three, [model], out, SETTINGS, progress=False)
    results = {r.trip: r for one in found for r in one.results}
    assert {name for name, r in results.items() if r.status == "ok"} == {"a", "b", "c"}
    assert results["exit"].reason.endswith("reader crashed (exit code 3), so the file is damaged")
    assert results["crash:1"].reason.endswith("crashed (SIGSEGV), so the file is damaged")
    assert "hang.mat: its reader took longer than 2 s for one step" in results["hang"].reason
    assert len(list(out.rglob("report.html"))) == len(found) == 1


@pytest.mark.every_value
@pytest.mark.parametrize("place", ["write_table", "replace", "write_report"])
@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt("stop")])
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
    files = {p for p in out.rglob("*") if p.is_file() and "tfevents" not in p.name}
    kept = {p for p in files if p.parent.name == finished.FOLDER}
    assert all(read_arrays(p) for p in kept)
    left = {p.name for p in files - kept}
    assert "report.html" not in left
    assert not [name for name in left if name.startswith(".")]
    if place == "write_report":
        assert len(rows(out / "trips.parquet")) == len(rows(out / "trips.csv")) == 1
        assert json.loads((out / "metrics.json").read_text())["n_trips"] == 1
    else:
        assert left == set()


def test_ctrl_c_in_a_trip_ends_the_run(manifests, model, monkeypatch, tmp_path):
    def interrupt(*_, **__):
        raise KeyboardInterrupt("stop")

    monkeypatch.setattr(fleet, "evaluate_trip", interrupt)
    with pytest.raises(KeyboardInterrupt, match="stop"):
        read(manifests[0].parent, [model], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_folder_without_trips_is_refused(model, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no folder .*nowhere; give the one"):
        evaluate_fleet(tmp_path / "nowhere", [model], tmp_path, SETTINGS)
    with pytest.raises(FileNotFoundError, match=r"holds no \*\.yaml file; each trip needs one"):
        evaluate_fleet(tmp_path, [model], tmp_path / "out", SETTINGS)


def test_models_that_cannot_read_trips_are_refused(model):
    assert check_models([model]) == check_models([slow_model(), model]) == OUTPUTS
    curves = replace(model, settings=CurveSettings())
    with pytest.raises(ModelFileError, match=r"protocol 'trips' was trained on curves of section"):
        check_models([model, curves])
    known = replace(model, task=replace(model.task, mass_known=True))
    with pytest.raises(ModelFileError, match="mass_known=true cannot read trips"):
        check_models([known])
    heavy = replace(model.vehicle, bogie_mass_kg=2000.0)
    other = replace(model, generator=replace(model.generator, vehicle=heavy))
    fewer = replace(model, task=replace(model.task, outputs=OUTPUTS[:4]))
    for different in (other, fewer):
        with pytest.raises(ModelFileError, match="must share vehicle and outputs"):
            check_models([model, model, different])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": "x"}, "`reference` must be one of .*'vehicle', 'first_trips'.*, got 'x'"),
        ({"workers": 0}, "`workers` must be a whole number >= 1 or null, got 0"),
        ({"workers": True}, "`workers` must be a whole number >= 1 or null, got True"),
        ({"n_reference": 1.5}, r"`n_reference` must be a whole number >= 1, got 1\.5"),
    ],
)
def test_settings_are_checked(change, message):
    with pytest.raises((TypeError, ValueError), match=message):
        FleetSettings(TRIPS, **change)


def test_cluster_needs_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r'distributed is missing: .*"\.\[cluster\]"'):
        FleetSettings(TRIPS, cluster="local")
    assert FleetSettings(TRIPS).cluster is None


def test_two_models_of_one_speed_are_refused(model):
    with pytest.raises(ModelFileError, match=r"same speed \(64.4 to 75.6 m/s\);"):
        check_models([model, replace(model)])


def test_names_that_look_like_numbers_stay_as_they_are(alone):
    named = [replace(alone[0], trip=name, truth={}) for name in ("1.10", "001", "1e5")]
    lines = summary(named, OUTPUTS).splitlines()
    assert [line.split("|")[1].strip() for line in lines[3:]] == ["1.10", "001", "1e5"]


# intervals and flags


def test_reasons_are_whole_in_the_summary_and_in_the_table(alone, tmp_path):
    words = "k_p at about 27 % lies outside the 50 to 160 % trained for; " * 5
    results = [replace(alone[0], flags=words), alone[1], replace(alone[2], flags=words)]
    table, *reasons = summary(results, OUTPUTS).split("\n\n")
    lines = table.splitlines()
    assert lines[0] == "3 of 3 trips have an estimate, 2 are flagged"
    cells = [line.rpartition("| ")[2].rstrip(" |") for line in lines[3:6]]
    assert cells == ["flagged", "", "flagged"]
    assert reasons == [f"{alone[0].trip}, {alone[2].trip}: {words}"]
    write_tables(results, OUTPUTS, tmp_path)
    assert [row["flags"] for row in rows(tmp_path / "trips.csv")] == [words, "", words]
    assert "1 is flagged" in summary(results[1:], OUTPUTS)


def test_trip_without_its_parts_says_why_and_which_faults_it_has(alone):
    why = Finding(NO_PART, words="misfit 24 times that of noise")
    quality = replace(alone[0].quality, warnings=f"a sensor is alone; {why}", faults="a is loose")
    _, *reasons = summary([replace(alone[0], quality=quality), alone[1]], OUTPUTS).split("\n\n")
    assert reasons == [f"{alone[0].trip}: {why}; a is loose"]
    read = replace(alone[0], quality=replace(quality, warnings=""))
    assert "loose" not in summary([read], OUTPUTS)


def test_coverage_is_the_naive_one(alone):
    held = coverage_percent(alone, OUTPUTS)
    for name in OUTPUTS:
        n = sum(
            abs(np.log(r.estimates[name] / r.truth[name])) <= r.half_widths[name] for r in alone
        )
        assert held[name] == pytest.approx(100 * n / len(alone))
    unknown = [replace(alone[0], half_widths={}), replace(alone[1], truth={})]
    assert coverage_percent(unknown, OUTPUTS) == {}
    assert coverage_percent([*unknown, alone[2]], OUTPUTS) == coverage_percent([alone[2]], OUTPUTS)


def test_level_and_calibration_are_told_and_flags_counted(
    manifests, model, no_figures, monkeypatch, tmp_path
):
    seen = {}
    monkeypatch.setattr(output, "write_report", lambda *given: seen.update(level=given[2].level))
    monkeypatch.setattr(
        fleet,
        "evaluate_trip",
        lambda file, *_, **__: replace(
            recalled_trip(file, [model], TRIPS), flags="odd" if file.path == manifests[1] else ""
        ),
    )
    settings = replace(
        SETTINGS, trips=TripSettings(level=0.95), reference="first_trips", n_reference=3
    )
    results = read(manifests[0].parent, [model], tmp_path, settings)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["n_flagged"] == 1
    assert metrics["coverage_percent"] == pytest.approx(coverage_percent(results, OUTPUTS))
    assert seen == {"level": 0.95}
    n = len(model.intervals.conformal.scores)
    assert metrics["details"]["intervals"].startswith(f"95 %, calibrated on {n} simulated curves")
    assert metrics["details"]["healthy is"].endswith("(k and c), 1 of them flagged")
    assert metrics["trends"][0]["words"].endswith("; 1 of the first 3 trips is flagged")


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
