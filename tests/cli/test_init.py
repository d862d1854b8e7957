"""suspnet init: what it finds in data files, and that a completed template passes suspnet check."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from cli_runner import typed
from recording_files import WRITERS
from trip_fixtures import RATES_HZ, signal, small_fleet

from suspnet.cli import check, init
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.trips.file_contents import (
    contents_of,
    guessed_meaning,
    guessed_side,
    names_times,
)

SAID = ("vehicle=am96", "suspension=car 7", "mileage_km=1000", "side=left")


@pytest.fixture(scope="module")
def manifests():
    return small_fleet()


@pytest.fixture(scope="module")
def channels(manifests):
    """Return the three channels of a trip at 250 Hz, 300 s."""
    n = 75_000
    at = np.arange(n) / 250.0
    found = {}
    for name, rate_hz in zip(CHANNELS, RATES_HZ, strict=True):
        values = signal(manifests[0], name)
        found[name] = np.interp(at, np.arange(len(values)) / rate_hz, values)
    return found


def written(tmp_path, *words):
    """Return the manifest that the program writes of some files, as text."""
    done = typed(init, *words, "-o", tmp_path / "trip.yaml", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    return (tmp_path / "trip.yaml").read_text(encoding="utf-8")


def assert_ready(tmp_path, words="1 of 1 trip ready"):
    options = ["--no-pictures", "-o", tmp_path / "out"]
    done = typed(check, tmp_path / "trip.yaml", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert words in done.stdout
    return read_manifest(tmp_path / "trip.yaml")


# what names say


@pytest.mark.parametrize(
    ("names", "meaning", "side"),
    [
        (["Achslager links"], "axle_box", "left"),
        (["AxleBoxRight"], "axle_box", "right"),
        (["Radsatzlager re z"], "axle_box", "right"),
        (["bogie frame, right"], "bogie", "right"),
        (["Wagenkasten"], "body", ""),
        (["car body left"], "body", "left"),
        (["CarBody_R", "axle speed/CarBody_R"], "body", "right"),
        (["left", "axle_box"], "axle_box", "left"),
        (["Geschwindigkeit [km/h]"], "speed", ""),
        (["gps speed"], "speed", ""),
        (["Kanal 7 [V]"], "", ""),
        (["left or right"], "", ""),
        ([""], "", ""),
    ],
)
def test_names_are_guessed(names, meaning, side):
    assert guessed_meaning(*names) == meaning
    assert guessed_side(*names) == side


@pytest.mark.parametrize(
    "name", ["t", "Time [s]", "Zeit", "timestamp_ms", "Zeitstempel", "TimeUTC"]
)
def test_times_are_known_by_name(name):
    assert names_times(name)
    assert not names_times(name.replace("t", "b").replace("T", "B").replace("Z", "B"))


# what files say


def test_units_and_rates_of_files_are_found(channels, tmp_path):
    fields, values = [], []
    for name, unit in zip(CHANNELS, (b"g", b"m/s^2", b"mg"), strict=True):
        size = {b"g": 9.80665, b"mg": 9.80665e-3}.get(unit, 1.0)
        said = {b"unit": unit, b"rate_hz": b"250"}
        fields.append(pa.field(name, pa.float64(), metadata=said))
        values.append(channels[name] / size)
    file = tmp_path / "all.parquet"
    pq.write_table(pa.table(values, schema=pa.schema(fields)), file)
    text = written(tmp_path, file, *SAID, "speed=70")
    assert 'unit: "g"' in text
    manifest = assert_ready(tmp_path)
    assert [manifest.channels[name].unit for name in CHANNELS] == ["g", "m/s2", None]


@pytest.mark.parametrize("suffix", [".tdms", ".mf4", ".uff"])
def test_units_and_rates_of_logger_files_are_found(tmp_path, suffix):
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=500) for name in ("Achslager", "Drehgestell")}
    WRITERS[suffix](tmp_path / f"run{suffix}", columns, unit="g", rate_hz=500.0)
    found = contents_of(tmp_path / f"run{suffix}").signals
    assert [one.meaning for one in found] == ["axle_box", "bogie"]
    assert [one.unit for one in found] == ["g", "g"]
    assert [one.rate_hz for one in found] == pytest.approx([500.0, 500.0], rel=1e-3)
    assert [one.first for one in found] == pytest.approx([v[0] for v in columns.values()])


def test_rate_by_times_and_their_unit(tmp_path):
    times = np.arange(1000) * 4.0
    pq.write_table(pa.table({"t_ms": times, "box": times % 7}), tmp_path / "a.parquet")
    (one,) = contents_of(tmp_path / "a.parquet").signals
    assert (one.rate_hz, one.time, one.time_unit) == (pytest.approx(250.0), "t_ms", "ms")
    pq.write_table(pa.table({"t": times[::-1], "box": times}), tmp_path / "b.parquet")
    assert np.isnan(contents_of(tmp_path / "b.parquet").signals[0].rate_hz)


# the way from data files to a manifest


def test_german_csv_of_a_logger_becomes_a_manifest(channels, tmp_path):
    names = ("Achslager", "Drehgestell", "Wagenkasten")
    header = ";".join(
        ["Zeit [s]", *(f"{one} {side} [m/s2]" for one in names for side in ("li", "re"))]
    )
    columns, rng = [np.arange(75_000) / 250.0], np.random.default_rng(0)
    for one in channels.values():
        columns += [one, one + 0.01 * one.std() * rng.standard_normal(len(one))]
    rows = np.column_stack(columns)[:40_000]
    (tmp_path / "Messung.csv").write_text(
        header
        + "\n"
        + "\n".join(";".join(f"{x:.6f}" for x in row) for row in rows).replace(".", ",")
    )
    gps = "\n".join(f"{second};252,0" for second in range(301))
    (tmp_path / "gps.csv").write_text("t;v [km/h]\n" + gps)
    text = written(tmp_path, "Messung.csv", "gps.csv", *SAID[:3])
    assert "delimiter ';'" in text
    # no train moves like copies of one side: they are too short to be read as parts
    manifest = assert_ready(tmp_path, "1 can be read but holds too little")
    assert [one.column for one in manifest.channels["bogie"]] == [
        "Drehgestell li [m/s2]",
        "Drehgestell re [m/s2]",
    ]


def test_side_is_asked_for_where_names_of_single_sensors_do_not_tell_it(tmp_path):
    columns = {"Achslager": np.arange(500.0), "Drehgestell": np.arange(500.0)}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    assert "\n  side: side=left or right" in typed(init, "a.parquet", cwd=tmp_path).stdout
    both = {f"{name} {side}": columns[name] for name in columns for side in ("li", "re")}
    pq.write_table(pa.table(both), tmp_path / "a.parquet")
    assert "  side:" not in typed(init, "a.parquet", cwd=tmp_path).stdout


def test_odd_names_of_columns_and_files_come_back(tmp_path):
    file = tmp_path / "bogie # {1}.parquet"
    for name in (
        'a"b',
        "a: b",
        "#c",
        "{d}",
        "f\ng",
        "h\u2028i",
        "Größe",
        "no",
        "1",
        "'",
        "\\",
        "😀",
    ):
        places = {name: np.arange(10.0)} | dict.fromkeys(("axle_box", "body"), np.arange(10.0))
        pq.write_table(pa.table(places), file)
        said = (*SAID, "speed=70", "unit=g", "rate_hz=250")
        text = written(tmp_path, file, *said, f"channels.bogie={name}", "--force")
        (source,) = yaml.safe_load(text)["channels"]["bogie"]
        assert (source["file"], source["column"]) == (file.name, name)


def test_files_that_cannot_be_read_are_told_at_once(tmp_path):
    (tmp_path / "noise.csv").write_bytes(np.random.default_rng(0).bytes(20_000))
    (tmp_path / "cut.parquet").write_bytes(b"PAR1")
    (tmp_path / "words.csv").write_text("a,b\nx,y\nx,y\n")
    (tmp_path / "empty.mat").touch()
    files = ["noise.csv", "cut.parquet", "words.csv", "empty.mat", "gone.csv", "notes.docx", "."]
    done = typed(init, *files, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert all(name in done.stderr for name in files)
    assert done.stderr.isprintable() or done.stderr.strip().isprintable()
    assert not list(tmp_path.glob("*.yaml"))
