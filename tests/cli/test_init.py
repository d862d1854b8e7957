"""suspnet init: what it finds in data files, and that a completed template passes suspnet check."""

import re

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
from suspnet.trains.trips.file_contents import guessed_meaning, guessed_side, look_into, names_times
from suspnet.trains.trips.manifest_template import BLANK

FILLED = {"vehicle": "am96", "suspension": "car 7", "mileage_km": "1000.0"}


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


def written(tmp_path, *files, **options):
    """Return the text of the template that the program writes of some files."""
    done = typed(init, *files, "-o", tmp_path / "trip.yaml", cwd=tmp_path, **options)
    assert (done.returncode, done.stderr) == (0, "")
    return (tmp_path / "trip.yaml").read_text(encoding="utf-8")


def complete(path, **blanks):
    """Fill in the first lines of a template, and each blank of a key with one value."""
    text = path.read_text(encoding="utf-8")
    for key, value in FILLED.items():
        text = re.sub(rf"^{key}:", f"{key}: {value}", text, flags=re.MULTILINE)
    for key, value in blanks.items():
        text = text.replace(f"{key}: {BLANK}", f"{key}: {value}")
    path.write_text(text, encoding="utf-8")


def assert_ready(tmp_path):
    options = ["--no-pictures", "-o", tmp_path / "out"]
    done = typed(check, tmp_path / "trip.yaml", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert "1 of 1 trip ready" in done.stdout
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
    text = written(tmp_path, file)
    assert BLANK not in text.partition("channels:")[2]
    assert 'unit: "g"' in text
    assert "mg by the file" in text
    text = re.sub(r"^speed:.*$", "speed: 70.0", text, flags=re.MULTILINE)
    (tmp_path / "trip.yaml").write_text(text)
    complete(tmp_path / "trip.yaml")
    manifest = assert_ready(tmp_path)
    assert [manifest.channels[name].unit for name in CHANNELS] == ["g", "m/s2", None]


@pytest.mark.parametrize("suffix", [".tdms", ".mf4", ".uff"])
def test_units_and_rates_of_logger_files_are_found(tmp_path, suffix):
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=500) for name in ("Achslager", "Drehgestell")}
    WRITERS[suffix](tmp_path / f"run{suffix}", columns, unit="g", rate_hz=500.0)
    found, _ = look_into(tmp_path / f"run{suffix}")
    assert [one.meaning for one in found] == ["axle_box", "bogie"]
    assert [one.unit for one in found] == ["g", "g"]
    assert [one.rate_hz for one in found] == pytest.approx([500.0, 500.0], rel=1e-3)
    assert [one.mean for one in found] == pytest.approx([v.mean() for v in columns.values()])


def test_rate_by_times_and_their_unit(tmp_path):
    times = np.arange(1000) * 4.0
    pq.write_table(pa.table({"t_ms": times, "box": times % 7}), tmp_path / "a.parquet")
    (one,), _ = look_into(tmp_path / "a.parquet")
    assert (one.rate_hz, one.time, one.time_unit) == (pytest.approx(250.0), "t_ms", "ms")
    pq.write_table(pa.table({"t": times[::-1], "box": times}), tmp_path / "b.parquet")
    assert np.isnan(look_into(tmp_path / "b.parquet")[0][0].rate_hz)


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
    text = written(tmp_path, "Messung.csv", "gps.csv")
    assert BLANK not in text.partition("speed:")[2]
    assert "delimiter ';'" in text
    complete(tmp_path / "trip.yaml")
    manifest = assert_ready(tmp_path)
    assert [one.column for one in manifest.channels["bogie"]] == [
        "Drehgestell li [m/s2]",
        "Drehgestell re [m/s2]",
    ]


def test_side_is_asked_for_where_names_of_single_sensors_do_not_tell_it(tmp_path):
    columns = {"Achslager": np.arange(500.0), "Drehgestell": np.arange(500.0)}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    assert f"\nside:             # {BLANK}: left or right" in written(tmp_path, "a.parquet")
    both = {f"{name} {side}": columns[name] for name in columns for side in ("li", "re")}
    pq.write_table(pa.table(both), tmp_path / "a.parquet")
    assert "\n# side: left" in written(tmp_path, "a.parquet", "--force")


def test_simulated_files_become_a_manifest_once_blanks_are_filled(manifests, tmp_path):
    files = sorted(manifests[0].with_suffix("").glob("*.parquet"))
    text = written(tmp_path, *files)
    done = typed(check, tmp_path / "trip.yaml", "--no-pictures", cwd=tmp_path)
    assert done.returncode == 1
    for key in ("vehicle", "suspension", "mileage_km"):
        assert f"`{key}` is missing" in done.stdout
    for key in ("speed", *(f"channels.{name}[0]" for name in CHANNELS)):
        assert f"`{key}.unit` must be one of" in done.stdout
        assert f"`{key}.rate_hz` must be a number" in done.stdout
    speed, _, rest = text.partition("channels:")
    speed = speed.replace(f"unit: {BLANK}", "unit: m/s").replace(
        f"rate_hz: {BLANK}", "rate_hz: 1.0"
    )
    (tmp_path / "trip.yaml").write_text(f"{speed}channels:{rest}")
    complete(tmp_path / "trip.yaml", unit="m/s2", rate_hz="250.0")
    text = (tmp_path / "trip.yaml").read_text()
    axle = re.sub(r"rate_hz: 250.0(.*unit m/s2)", r"rate_hz: 400.0\1", text, count=1)
    (tmp_path / "trip.yaml").write_text(axle)
    assert_ready(tmp_path)


def test_columns_of_unclear_names_are_offered(channels, tmp_path):
    columns = {f"ch{i}": values for i, values in enumerate(channels.values())}
    pq.write_table(pa.table(columns), tmp_path / "run.parquet")
    text = written(tmp_path, "run.parquet")
    assert text.count('    # - {file: "run.parquet", column: "ch1"') == 3
    assert 'columns of unknown meaning: "ch0", "ch1", "ch2"' in text
    lines = text.splitlines()
    for i, name in enumerate(CHANNELS):
        start = next(k for k, line in enumerate(lines) if line.startswith(f"  {name}:"))
        at = next(k for k in range(start, len(lines)) if f'"ch{i}"' in lines[k])
        lines[at] = lines[at].replace("# - ", "- ")
    text = re.sub(r"^speed:.*$", "speed: 70.0", "\n".join(lines), flags=re.MULTILINE)
    (tmp_path / "trip.yaml").write_text(text)
    complete(tmp_path / "trip.yaml", unit="m/s2", rate_hz="250.0")
    assert [one.column for one in assert_ready(tmp_path).channels.values()] == ["ch0", "ch1", "ch2"]


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
        pq.write_table(pa.table({name: np.arange(10.0)}), file)
        text = written(tmp_path, file, "--force")
        content = yaml.safe_load(text)
        (source,) = content["channels"]["bogie"]
        assert (source["file"], source["column"]) == (file.name, name)


def test_manifest_that_exists_is_left(manifests, tmp_path):
    file = manifests[0].with_suffix("") / "body.parquet"
    (tmp_path / "trip.yaml").write_text("mine")
    done = typed(init, file, "-o", tmp_path / "trip.yaml", cwd=tmp_path)
    assert done.returncode == 1
    assert "exists; --force replaces it" in done.stderr
    assert (tmp_path / "trip.yaml").read_text() == "mine"
    named = typed(init, file, "-o", tmp_path / "trip.csv", cwd=tmp_path)
    assert "must end with .yaml" in named.stderr
    assert BLANK in written(tmp_path, file, "--force")


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
