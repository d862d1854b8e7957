"""suspnet init of a folder: all manifests at once, and one list of what is missing."""

import shlex
import shutil
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from cli_runner import typed
from recording_files import write_mdf
from trip_fixtures import RATES_HZ, signal, small_fleet

from suspnet import read_vehicles
from suspnet.cli import check, init
from suspnet.cli.config_files import CONFIGS
from suspnet.ground import own_files
from suspnet.ground.storage import write_atomically
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.trips.trip_files import find_trip_files
from suspnet.vehicle import Vehicle

WORDS = ("Achslager", "Rahmen", "Wagenkasten")
SAID = ("vehicle=am96", "suspension=car 7", "speed=70", "unit=m/s2", "rate_hz=250", "side=left")
START = datetime(2015, 8, 3, 8)


def written(folder, *said):
    """Run the program with success and return what it prints."""
    done = typed(init, folder, *said, cwd=folder)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    return done.stdout


def asked(folder, *said):
    """Run the program, which writes nothing, and return the keys that it asks for."""
    before = sorted(folder.rglob("*.yaml"))
    done = typed(init, folder, *said, cwd=folder)
    assert (done.returncode, done.stderr) == (1, "")
    assert sorted(folder.rglob("*.yaml")) == before
    lines = done.stdout.splitlines()[1:-1]
    keys = {line.partition(":")[0].split()[0] for line in lines if line[2:3] != " "}
    return keys - {"assumed", "columns"}


def write_german(path, n=400, columns=None, above=()):
    """Write a CSV file as German loggers do, with time stamps at 250 Hz."""
    columns = columns or {
        **{
            f"{word} {side} [m/s²]": np.sin(np.arange(n)) for word in WORDS for side in ("li", "re")
        },
        "v GPS [km/h]": np.full(n, 252.0),
    }
    times = [START + timedelta(milliseconds=4 * i) for i in range(n)]
    stamps = [f"{at:%d.%m.%Y %H:%M:%S},{at.microsecond // 1000:03d}" for at in times]
    cells = [[f"{x:.5f}".replace(".", ",") for x in values] for values in columns.values()]
    rows = [";".join(row) for row in zip(stamps, *cells, strict=True)]
    lines = [*above, ";".join(["Zeitstempel", *columns]), *rows]
    path.write_bytes("\r\n".join(lines).encode("latin-1"))


def write_plain(path, names=CHANNELS, n=500):
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table({name: np.sin(np.arange(n)) for name in names}), path)


def test_german_files_of_two_formats_need_one_command(tmp_path):
    above = ["Gerät;Lögger", "Fahrzeug;am96", "Drehgestell;vorn", "Kilometerstand;19.250,5 km", ""]
    write_german(tmp_path / "Fahrt_1.csv", above=above)
    columns = {f"DG2 {word}": np.sin(np.arange(400)) for word in WORDS}
    write_mdf(tmp_path / "Fahrt_2.mf4", columns, unit="g", rate_hz=250.0, start=START)
    assert asked(tmp_path) == {"vehicle", "suspension", "side", "mileage_km", "speed"}
    table = tmp_path / "Fahrten.csv"
    table.write_text("Datei;Kilometerstand;Richtung;Fahrzeug\nFahrt_2.mf4;20.000;vorwärts;am96\n")
    words = written(tmp_path, "suspension=4711", "speed=252 km/h", "side=middle", "--table", table)
    assert "2 manifests of 2 trips" in words
    one, two = (read_manifest(tmp_path / f"Fahrt_{i}.yaml") for i in (1, 2))
    assert (one.bogie, two.bogie, two.direction) == ("leading", None, "forward")
    assert (one.mileage_km, two.mileage_km) == (19250.5, 20000.0)
    assert one.suspension == two.suspension == "4711"
    assert one.channels["bogie"][1].column == "Rahmen re [m/s²]"
    assert {channel.time for channel in one.channels["bogie"]} == {"Zeitstempel"}
    assert one.speed == two.speed == 70.0


def test_simulated_trips_of_a_folder_are_ready(tmp_path):
    for number, manifest in enumerate(small_fleet()[:2], start=1):
        for name, rate in zip(CHANNELS, RATES_HZ, strict=True):
            values = signal(manifest, name)
            field = pa.field("left", pa.float64(), metadata={"unit": "m/s2", "rate_hz": str(rate)})
            file = tmp_path / f"run_{number}" / f"{name}.parquet"
            file.parent.mkdir(exist_ok=True)
            pq.write_table(pa.table([values], schema=pa.schema([field])), file)
    (tmp_path / "km.csv").write_text("trip,mileage_km\nrun_1,1000\nrun_2,2000.5\n")
    said = [*SAID[:3], "side=middle", "direction=forward", "--table", tmp_path / "km.csv"]
    assert "then run: suspnet check" in written(tmp_path, *said)
    done = typed(check, tmp_path, "--no-pictures", cwd=tmp_path)
    assert "2 of 2 trips ready for an estimate" in done.stdout, done.stdout
    assert "1000 to 2000 km" in done.stdout


def test_missing_mileages_are_asked_for_in_a_table(tmp_path):
    for number in (1, 2):
        write_plain(tmp_path / f"run_{number}.parquet")
    write_plain(tmp_path / "=1+1.parquet")
    table = tmp_path / "km.csv"
    assert asked(tmp_path, *SAID, "--table", table) == {"mileage_km"}
    lines = table.read_text().splitlines()
    assert lines[0] == "file;mileage_km;start;direction"
    assert lines[1].startswith("./=1+1.parquet;")  # no name of a file is a formula
    filled = [line.replace(";", ";1000,5", 1) for line in lines[1:]]
    table.write_text("\n".join([lines[0], *filled]))
    written(tmp_path, *SAID, "--table", table)
    assert [read_manifest(tmp_path / f"run_{i}.yaml").mileage_km for i in (1, 2)] == [1000.5] * 2


def test_columns_of_both_bogies_in_one_file_are_said(tmp_path):
    names = [f"DG{bogie} {word}" for bogie in (1, 2) for word in WORDS]
    write_plain(tmp_path / "run.parquet", names)
    said = [*SAID, "mileage_km=7"]
    assert asked(tmp_path, *said) == {f"channels.{name}" for name in CHANNELS}
    said += [f"channels.{c}=DG2 {word}" for c, word in zip(CHANNELS, WORDS, strict=True)]
    written(tmp_path, *said, "bogie=trailing")
    assert read_manifest(tmp_path / "run.yaml").channels["body"].column == "DG2 Wagenkasten"


def test_columns_of_unclear_names_are_said_once(tmp_path):
    write_plain(tmp_path / "run.parquet", ["ch0", "ch1", "ch2", "ch3"])
    assert asked(tmp_path, *SAID, "mileage_km=7") == {f"channels.{name}" for name in CHANNELS}
    said = ["channels.axle_box=ch0,ch3", "channels.bogie=ch1", "channels.body=ch2"]
    written(tmp_path, *SAID, "mileage_km=7", *said)
    text = (tmp_path / "run.yaml").read_text()
    assert text.count("# by the command line") == 8
    found = read_manifest(tmp_path / "run.yaml")
    assert [one.column for one in found.channels["axle_box"]] == ["ch0", "ch3"]
    assert [found.channels[name].column for name in CHANNELS[1:]] == ["ch1", "ch2"]


def test_speed_is_that_of_the_receiver_unless_the_table_says_another(tmp_path):
    columns = dict.fromkeys([*CHANNELS, "v_wheel [km/h]", "v GPS [km/h]"], np.ones(500))
    pq.write_table(pa.table(columns), tmp_path / "run.parquet")
    said = [one for one in SAID if not one.startswith("speed")]
    written(tmp_path, *said, "mileage_km=7", "speed_rate_hz=250")
    assert read_manifest(tmp_path / "run.yaml").speed.column == "v GPS [km/h]"
    (tmp_path / "km.csv").write_text("file;mileage_km;speed\nrun;7;180 km/h\n")
    written(tmp_path, *said, "--table", tmp_path / "km.csv", "--force")
    assert read_manifest(tmp_path / "run.yaml").speed == 50.0
    (tmp_path / "km.csv").write_text("Datei;km;Geschwindigkeit [km/h]\nrun;7;180,9\n")
    written(tmp_path, *said, "mileage_km=7", "--table", tmp_path / "km.csv", "--force")
    assert read_manifest(tmp_path / "run.yaml").speed == pytest.approx(50.25)


def test_files_are_grouped_by_trip_and_folder(tmp_path):
    names = [
        *("a/run_1_axle_box.csv", "a/run_1_bogie.csv", "a/run_1_gps.csv", "a/run_10.csv"),
        *("a/run_2.csv", "b/trip 3/AxleBoxLeft.csv", "b/trip 3/CarBody.csv", "b/notes.md"),
        *("vehicle/x.csv", ".hidden/y.csv"),
    ]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = find_trip_files(tmp_path)
    got = {one.path.relative_to(tmp_path).as_posix(): len(one.files) for one in found}
    assert got == {"a/run_1.yaml": 3, "a/run_2.yaml": 1, "a/run_10.yaml": 1, "b/trip 3.yaml": 2}
    assert list(got)[:3] == ["a/run_1.yaml", "a/run_2.yaml", "a/run_10.yaml"]


def test_manifests_that_exist_are_left_and_new_trips_added(tmp_path):
    write_plain(tmp_path / "run_1.parquet")
    written(tmp_path, *SAID, "mileage_km=7")
    (tmp_path / "run_1.yaml").write_text("mine")
    write_plain(tmp_path / "run_2.parquet")
    (tmp_path / "km.csv").write_text("file;mileage_km\nrun_1;7\nrun_2;8\n")
    words = written(tmp_path, *SAID, "--table", tmp_path / "km.csv")
    assert "1 manifest of 2 trips; 1 manifest left as they were, --force replaces" in words
    assert (tmp_path / "run_1.yaml").read_text() == "mine"
    assert read_manifest(tmp_path / "run_2.yaml").mileage_km == 8.0
    written(tmp_path, *SAID, "--table", tmp_path / "km.csv", "--force")
    assert read_manifest(tmp_path / "run_1.yaml").mileage_km == 7.0


def test_two_loggers_in_one_folder_have_their_own_columns(tmp_path):
    write_german(tmp_path / "DG1_1.csv")
    names = ["ACC_1", "ACC_2", "ACC_3"]
    columns = {name: np.sin(np.arange(400.0)) for name in names}
    pq.write_table(pa.table(columns), tmp_path / "DG2_1.parquet")
    channels = [f"channels.{key}={name}" for key, name in zip(CHANNELS, names, strict=True)]
    (tmp_path / "km.csv").write_text("file;mileage_km\nDG1_1;7\nDG2_1;7\n")
    written(tmp_path, *SAID, *channels, "--table", tmp_path / "km.csv")
    first, second = (read_manifest(tmp_path / f"DG{i}_1.yaml") for i in (1, 2))
    assert "Achslager li [m/s²]" in str(first.channels["axle_box"])
    assert "ACC_1" in str(second.channels["axle_box"])


def test_unknown_vehicles_of_loggers_are_listed_with_all_that_is_missing(tmp_path):
    write_german(tmp_path / "run.csv", above=["Fahrzeug;ET 4711 Wagen 3\n"])
    (tmp_path / "mine/vehicle").mkdir(parents=True)
    shutil.copy(Path(CONFIGS) / "vehicle/am96.yaml", tmp_path / "mine/vehicle")
    write_german(tmp_path / "other.csv", above=["Fahrzeug;ET 12\n"])
    done = typed(init, tmp_path, "--config-dir", tmp_path / "mine", cwd=tmp_path)
    assert done.returncode == 1
    first, *rest = done.stdout.splitlines()
    assert first.endswith("nothing is written yet; these are missing or wrong:")
    assert "  vehicle: 'ET 12' (by the line 'Fahrzeug') is no vehicle of suspnet's, nor" in rest[0]
    assert "  vehicle: 'ET 4711 Wagen 3' (by the line 'Fahrzeug" in rest[1]
    assert "vehicle=am96 or another of them says it for all trips" in rest[0]
    assert any(line.startswith("  suspension: ") for line in rest)  # with all that is missing
    assert not list(tmp_path.glob("*.yaml"))


@pytest.mark.parametrize(
    ("said", "table", "words"),
    [
        (["colour=red"], "", "`colour` is not known; allowed are vehicle, suspension"),
        (["side=up"], "", "`side` must be one of left, right, middle, got 'up'"),
        (["unit=m/s2", "unit=g"], "", "`unit` is given twice"),
        (["rate_hz=fast"], "", "`rate_hz` must be a number, got 'fast'"),
        (["mileage_km=7"], "", "`mileage_km` is another one in each of the 2 trips"),
        (["channels.body=nowhere"], "", "must name one or two of the columns axle_box, "),
        ([], "a;b\n1;2\n", "no column is called file, trip, Datei or Fahrt"),
        ([], "file;mileage_km\nrun_9;7\n", "the table names run_9, which"),
        ([], "file;mileage_km\nrun_1;7\nrun_1;7\n", "row 3: it names 'run_1' a second time"),
        ([], "file;mileage_km\nrun_1;much\n", "row 2: 'mileage_km' cannot be read, got 'much'"),
        (["-o", "x.yaml"], "", "--output is for the manifest of one trip"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(tmp_path, said, table, words):
    for number in (1, 2):
        write_plain(tmp_path / f"run_{number}.parquet")
    if table:
        (tmp_path / "km.csv").write_text(table)
        said = [*said, "--table", tmp_path / "km.csv"]
    done = typed(init, tmp_path, *said, cwd=tmp_path)
    assert done.returncode == 1
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("*.yaml"))


def test_a_folder_without_data_files_is_refused(tmp_path):
    (tmp_path / "1.lvm").write_text("x")
    done = typed(init, tmp_path, cwd=tmp_path)
    assert "holds no data file; they end with .asc, .csv" in done.stderr


NUMBERS = {
    "bogie_mass_kg": 1300.0,
    "body_mass_kg": 5200.0,
    "primary_stiffness_n_per_m": 1.1e6,
    "primary_damping_ns_per_m": 8e3,
    "secondary_stiffness_n_per_m": 0.45e6,
    "secondary_damping_ns_per_m": 18e3,
    "half_wheelbase_m": 1.05,
    "half_pivot_distance_m": 5.5,
}


def test_vehicle_is_written_to_be_filled_in(tmp_path):
    done = typed(init, "--vehicle", "br412", "mine", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--config-dir mine vehicle=br412" in done.stdout
    file = tmp_path / "mine" / "vehicle" / "br412.yaml"
    text = file.read_text()
    assert "# Drawing: a quarter of the body; M_s is relative to it\nbody_mass_kg: ???\n" in text
    assert max(map(len, text.splitlines())) < 140
    numbers = NUMBERS | {"bogie_gyration_m": 0.62, "body_gyration_m": 4.5}
    for key, value in numbers.items():
        with pytest.raises(TypeError, match=r"br412\.yaml: `\w+` must be a finite number > 0"):
            read_vehicles(tmp_path / "mine")
        text = text.replace(f"{key}: ???", f"{key}: {value}")
        file.write_text(text)
    assert vars(read_vehicles(tmp_path / "mine")["br412"]) == vars(Vehicle("br412", **numbers))
    done = typed(init, "--vehicle", "br412", "mine", cwd=tmp_path)
    assert "exists; --force replaces it" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("must be a plain name", ["a/b"]),
        ("numbers are filled in in the file", ["a", "body_mass_kg=5200"]),
    ],
)
def test_mistakes_in_a_vehicle_are_one_line(tmp_path, words, said):
    done = typed(init, "--vehicle", *said, cwd=tmp_path)
    assert done.returncode == 1
    assert words in done.stderr
    assert not list(tmp_path.iterdir())


def test_own_vehicle_is_found_in_a_folder_here_or_asked_for(tmp_path):
    write_plain(tmp_path / "car 7" / "run_1.parquet")
    said = ("car 7", "vehicle=metro", *SAID[1:], "mileage_km=1")
    done = typed(init, *said, cwd=tmp_path)
    assert "  vehicle: 'metro' (by the command line) is no vehicle of suspnet's: " in done.stdout
    assert "--config-dir DIR, the folder with vehicle/metro.yaml, which suspnet" in done.stdout
    shipped = (Path(CONFIGS) / "vehicle" / "am96.yaml").read_text()
    own = tmp_path / "mine" / "vehicle"
    own.mkdir(parents=True)
    (own / "metro.yaml").write_text(shipped.replace("name: am96", "name: metro"))
    done = typed(init, *said, cwd=tmp_path)
    assert done.stdout.endswith("then run: suspnet check 'car 7' --config-dir mine\n")
    checked = typed(check, *shlex.split(done.stdout.splitlines()[-1])[4:], cwd=tmp_path)
    assert "metro, car 7" in checked.stdout
    wrong = typed(init, *said, "vehicle=tram", "--config-dir", "mine", "--force", cwd=tmp_path)
    assert "`vehicle` is given twice" in wrong.stderr
    manifest = (tmp_path / "car 7" / "run_1.yaml").read_text()
    assert "run: suspnet check 'car 7/run_1.yaml' --config-dir mine\n" in manifest


def test_what_is_assumed_is_listed_with_the_number_of_trips(tmp_path):
    write_plain(tmp_path / "car 7" / "run_1.parquet")
    said = [*(one for one in SAID if not one.startswith("suspension")), "mileage_km=1"]
    line = "states it: bogie (1): the leading one; axle (1): the leading one of that bogie; direc"
    assert line in typed(init, tmp_path, cwd=tmp_path).stdout
    assert line in (words := written(tmp_path, *said))
    assert "suspension: by the folder (1)" in words
    manifest = tmp_path / "car 7" / "run_1.yaml"
    assert read_manifest(manifest).axle is None
    stated = ("bogie=trailing", "axle=trailing", "direction=reverse", "train=12")
    assert "assumed unless" not in written(tmp_path, *said, *stated, "--force")
    found = read_manifest(manifest)
    assert (found.bogie, found.axle, found.train) == ("trailing", "trailing", "12")
    assert found.suspension == "car 7"


def test_sensors_at_both_axles_are_written_with_their_axle(tmp_path):
    boxes, frames = ("b1", "b2", "b3", "b4"), ("f1", "f2")
    said = ("channels.axle_box=b1,b2,b3@2,b4@2", "channels.bogie=f1,f2@2", "channels.body=body")
    write_plain(tmp_path / "run_1.parquet", (*boxes, *frames, "body"))
    written(tmp_path, *SAID, "mileage_km=1", *said)
    manifest = read_manifest(tmp_path / "run_1.yaml")
    found = [(one.axle or 1, one.side) for one in manifest.channels["axle_box"]]
    assert found == [(1, "left"), (1, "right"), (2, "left"), (2, "right")]
    assert [one.column for one in manifest.channels["axle_box"]] == list(boxes)
    found = [(one.axle or 1, one.side) for one in manifest.channels["bogie"]]
    assert found == [(1, "left"), (2, "right")]


PLACES = ("axle_box", "bogie", "body")
GERMAN = ("Achslager", "Drehgestell", "Wagenkasten")
LOGGERS = {
    "in the folder": (PLACES, "DIR.yaml"),
    "in German": (GERMAN, "DIR.yaml"),
    "in a subfolder": ([f"run 7/{place}" for place in PLACES], "run 7.yaml"),
    "behind a name": ([f"run_7_{place}" for place in PLACES], "run_7.yaml"),
}
"""Files of three loggers of one kind, without their ending, and the manifest of their trip."""


@pytest.mark.parametrize("columns", [["Acc_X", "Acc_Y", "Acc_Z"]], ids=len)
@pytest.mark.parametrize(("files", "manifest"), LOGGERS.values(), ids=LOGGERS)
def test_names_of_files_show_the_places_of_identical_loggers(tmp_path, files, manifest, columns):
    folder = tmp_path / "DIR"
    for name in files:
        write_plain(folder / f"{name}.parquet", columns)
    assert "1 manifest of 1 trip\n" in written(folder, *SAID, "mileage_km=7")
    (path,) = folder.rglob("*.yaml")
    assert path == folder / manifest
    found = read_manifest(path)
    at = [(found.channels[name].file, found.channels[name].column) for name in CHANNELS]
    assert at == [(f"{name}.parquet", columns[-1]) for name in files]  # the vertical one of three
    assert "guess by the name" in path.read_text()


def test_loggers_of_unclear_names_are_said_as_file_and_column(tmp_path):
    for run in (1, 2):
        for number in range(1, 6):
            write_plain(tmp_path / f"run {run}" / f"S{number}.parquet", ["Acc_X", "Temp [°C]"])
    (tmp_path / "km.csv").write_text("file;mileage_km\nrun 1;7\nrun 2;8\n")
    asks = typed(init, tmp_path, *SAID, cwd=tmp_path).stdout
    assert "columns: S1:Acc_X, S1:Temp [°C], S2:Acc_X" in asks
    said = ["channels.axle_box=S3:Acc_X,S1.parquet:Acc_X", "channels.bogie=S2:Acc_X,S4:Acc_X"]
    table = ("--table", tmp_path / "km.csv")
    written(tmp_path, *SAID, *said, "channels.body=S5:Acc_X", *table)
    for run in (1, 2):
        found = read_manifest(tmp_path / f"run {run}.yaml")
        at = {one.side: one.file for one in found.channels["axle_box"]}
        assert at == {"left": f"run {run}/S3.parquet", "right": f"run {run}/S1.parquet"}
        assert found.channels["body"].file == f"run {run}/S5.parquet"
        assert found.channels["body"].column == "Acc_X"
    wrong = typed(init, tmp_path, *SAID, *said, "channels.body=S6:Acc_X", cwd=tmp_path)
    assert "FILE:COLUMN is that of one file; got 'S6:Acc_X'" in wrong.stderr


def test_files_of_long_names_get_manifests(tmp_path):
    name = "ü" * 100 + "x" * (255 - 200 - len(".parquet")) + ".parquet"
    write_plain(tmp_path / name)
    written(tmp_path, *SAID, "mileage_km=7")
    (path,) = tmp_path.glob("*.yaml")
    assert read_manifest(path).channels["body"].file == name
    own_files.begin(tmp_path / "results")
    for text in "ab":
        write_atomically(tmp_path / "results" / f"{'y' * 251}.txt", text)
    assert not list(tmp_path.rglob(".*"))
