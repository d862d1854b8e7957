"""Manifests: what is read is what was written, and every mistake is named."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml

from suspnet.ground.parameters import SIDES
from suspnet.ground.records import Place
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.manifest_files import (
    ManifestFile,
    find_manifests,
    read_manifest,
    write_manifest,
)
from suspnet.trains.recordings.manifest_sources import (
    CsvDialect,
    SensorSource,
    SpeedSource,
)

SUSPENSION = "car 7, leading bogie, right"
TRIP = f"""
format: suspnet-trip-1
vehicle: am96
suspension: {SUSPENSION}   # free text
mileage_km: 10267
start: 2015-08-03T08:00:00
speed: {{file: speed.csv, column: speed, unit: km/h, rate_hz: 1}}
channels:
  axle_box: {{file: axle_box.parquet, column: acceleration, unit: m/s2, rate_hz: 5000.0}}
  bogie:    {{file: sub/bogie.csv, column: a, unit: g, time: t, sign: -1, range: 2.0, start_s: 0.5}}
  body:     {{file: all.mat, unit: m/s2, rate_hz: 2000, time: t}}
truth: {{k_p: 1.0, c_p: 0.9}}
"""
FILES = ("speed.csv", "axle_box.parquet", "sub/bogie.csv", "all.mat")
LEFT = {"file": "all.mat", "column": "l", "unit": "g", "rate_hz": 200.0}
RIGHT = {"file": "all.mat", "column": "r", "unit": "m/s2", "time": "t", "sign": -1}


def with_files(folder: Path) -> Path:
    (folder / "sub").mkdir()
    for name in FILES:
        (folder / name).touch()
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return with_files(tmp_path)


def write(folder: Path, text: str) -> Path:
    path = folder / "trip.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def changed(folder: Path, key: str, to: object = None) -> Path:
    """Write the trip with the value of a key, such as "speed.unit", replaced or removed."""
    content = section = yaml.safe_load(TRIP)
    *keys, last = key.split(".")
    for one in keys:
        section = section.setdefault(one, {})
    section.pop(last, None)
    if to is not None:
        section[last] = to
    return write(folder, yaml.safe_dump(content))


def problem(path: Path) -> str:
    """Return the only problem of a manifest, which is one line, without the name of the file."""
    with pytest.raises(TripError) as caught:
        read_manifest(path)
    (finding,) = caught.value.args
    assert "\n" not in finding
    return finding.removeprefix(f"{path}: ")


def test_manifest_reads_every_key(folder):
    path = write(folder, TRIP)
    assert read_manifest(path) == TripManifest(
        path=path,
        name="trip",
        vehicle="am96",
        suspension=SUSPENSION,
        mileage_km=10267.0,
        start=datetime(2015, 8, 3, 8),
        speed=SpeedSource("speed.csv", "km/h", column="speed", rate_hz=1.0),
        channels={
            "axle_box": SensorSource("axle_box.parquet", "m/s2", "acceleration", rate_hz=5000.0),
            "bogie": SensorSource(
                "sub/bogie.csv", "g", "a", time="t", sign=-1, range=2.0, start_s=0.5
            ),
            "body": SensorSource("all.mat", "m/s2", rate_hz=2000.0, time="t"),
        },
        truth={"k_p": 1.0, "c_p": 0.9},
    )


@pytest.mark.parametrize(
    ("key", "written", "meant"),
    [
        ("truth", None, {}),
        ("start", None, None),
        ("start", "2015-08-03", datetime(2015, 8, 3)),
        ("start", "2015-08-03T08:00", datetime(2015, 8, 3, 8)),
        ("start", "2015-08-03T08:00:00Z", datetime(2015, 8, 3, 8, tzinfo=UTC)),
        ("speed", 70, 70.0),
        ("speed", "252 km/h", pytest.approx(70.0)),
        ("speed", "252.0km/h", pytest.approx(70.0)),
        ("speed", "70 m/s", 70.0),
    ],
)
def test_optional_keys_times_and_constant_speeds(folder, key, written, meant):
    assert getattr(read_manifest(changed(folder, key, written)), key) == meant


def test_single_sensors_are_on_the_side_of_the_suspension_unless_they_state_another(folder):
    manifest = read_manifest(changed(folder, "channels.body.side", "middle"))
    assert manifest.unplaced == ("axle_box", "bogie")
    manifest = replace(manifest, side="right")
    sides = [manifest.side_of(channel) for channel in manifest.sensors().values()]
    assert (sides, manifest.unplaced) == (["right", "right", "middle"], ())


def test_absolute_and_parent_paths_are_allowed(folder, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "a.parquet"
    elsewhere.touch()
    for file, target in ((str(elsewhere), elsewhere), (f"../{folder.name}/all.mat", "all.mat")):
        manifest = read_manifest(changed(folder, "channels.body.file", file))
        assert manifest.file_of(manifest.channels["body"]).samefile(folder / target)


def test_a_manifest_of_pairs_and_dialects_reads_the_same(folder):
    pair = tuple(SensorSource("all.mat", "g", side, rate_hz=9.5, side=side) for side in SIDES)
    dialect = CsvDialect(delimiter="\t", header_line=0)
    manifest = replace(
        read_manifest(write(folder, TRIP)),
        channels={"axle_box": pair, "bogie": SensorSource("sub/bogie.csv", csv=dialect, sign=-1)},
        speed=SpeedSource("speed.csv", time="t", time_zone="Europe/Berlin", start_s=-0.25),
        temperature_c=-3.5,
        truth={},
    )
    manifest = replace(manifest, channels=manifest.channels | {"body": SensorSource("all.mat")})
    assert read_manifest(write_manifest(manifest)) == manifest


def test_find_manifests_sorts_and_stays_in_the_folder(folder):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        find_manifests(folder / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"\*\.yaml"):
        find_manifests(folder)
    for name in ("b.yaml", "a.yaml", "sub/c.yaml", "d.yml"):
        (folder / name).touch()
    assert find_manifests(folder) == [folder / "a.yaml", folder / "b.yaml"]


# mistakes

BODY, BOGIE = "channels.body", "channels.bogie"
INFINITE, NAN = float("inf"), float("nan")
NUMBER, ONE_OF, FILE = "must be a number", "must be one of [", "must name an existing plain file"
MISTAKES = [  # key, value, and how the problem continues behind the key
    ("format", "suspnet-trip-2", "must be one of ['suspnet-trip-1'], got 'suspn"),
    ("vehicel", "am96", "is not known; allowed are"),
    ("vehicle", None, "is missing"),
    ("vehicle", [96], "must be text"),
    ("suspension", "  ", "must be text"),
    *((name, "é" * 101, "must be one line") for name in ("vehicle", "suspension", "train", "car")),
    ("car", "7\ndone: all is well", "must be one line"),
    ("train", "\N{RIGHT-TO-LEFT OVERRIDE}" * 20, "must be one line"),
    *(("mileage_km", value, NUMBER) for value in ("far", -1.0, True, NAN)),
    ("mileage_km", 51_333_333.0, "must be at most 20000000 km"),
    *(("temperature_c", value, NUMBER) for value in (60.5, "warm")),
    *(("start", value, "must be a time") for value in ("2015-13-45", "noon", 8.0)),
    ("start", "1970-01-01T00:00:00", "1970-01-01T00:00:00 is before 1990"),
    ("start", "2199-01-01T00:00:00", "2199-01-01T00:00:00 is in the future"),
    *(("bogie", value, ONE_OF) for value in ("front", 1)),
    ("side", ["left"], ONE_OF),
    ("speed", None, "is missing"),
    *(("speed", value, NUMBER) for value in (0.0, INFINITE, "0 km/h", "-252 km/h", "252,0 km/h")),
    *(("speed", value, NUMBER) for value in ("252 mph", "252 kmh")),
    ("speed.unit", "mph", "must be one of ['m/s', 'km/h'], got 'mph'"),
    ("speed.sign", 1, "is not known"),
    ("channels", ["a"], "must be a mapping"),
    ("channels.wheel", {}, "is not known"),
    (BODY, None, "is missing"),
    (f"{BODY}.file", None, "is missing"),
    *((f"{BODY}.file", value, FILE) for value in ("gone.mat", "sub")),
    *((f"{BODY}.unit", value, ONE_OF) for value in ("mg", ["g"])),
    *((f"{BODY}.rate_hz", value, NUMBER) for value in (0, "5k", 10**400)),
    (f"{BODY}.sign", 2, "must be one of [1, -1], got 2"),
    (f"{BODY}.range", -2.0, NUMBER),
    (f"{BODY}.start_s", -INFINITE, "must be a finite number"),
    (f"{BODY}.column", 3, "must be text"),
    (f"{BODY}.time_unit", "min", ONE_OF),
    (f"{BODY}.time_zone", "Mars/X", 'must be one like "UTC"'),
    (f"{BODY}.csv", ";", "must be a mapping"),
    (f"{BODY}.csv.sep", ";", "is not known"),
    (f"{BODY}.csv.delimiter", ":", ONE_OF),
    (f"{BODY}.csv.decimal", ";", ONE_OF),
    (f"{BODY}.csv.header_line", -1, "must be a line"),
    (f"{BODY}.csv.encoding", "rot13", "must be one like"),
    ("truth.k_x", 1.0, "is not known; allowed are ('k_p'"),
    ("truth.k_p", 0.0, NUMBER),
    # lists of sensors, and sensors at the other axle
    *((BODY, value, "must be a sensor, or a list") for value in ([], [LEFT, RIGHT, LEFT])),
    *((BODY, [LEFT | {"side": side}] * 2, f"has two sensors on the {side}") for side in SIDES),
    ("channels.axle_box", [LEFT | {"axle": 2, "side": "left"}] * 2, "has two sensors on the left"),
    ("channels.axle_box", [*[LEFT] * 3, LEFT | {"axle": 2}], "must be a sensor, or a list"),
    (BOGIE, LEFT | {"axle": 2}, "has a sensor at axle 2 only"),
    (f"{BOGIE}.axle", 3, "must be one of [1, 2], got 3"),
    (f"{BOGIE}.axle", "2", "must be one of [1, 2]"),
    (f"{BODY}.axle", 1, "is not known"),
]
IN_PAIRS = [  # sensors, and the key and the rule of the problem
    ([LEFT, "all.mat"], f"{BODY}[1]", "must be a mapping"),
    ([LEFT, RIGHT | {"unit": "mg"}], f"{BODY}[1].unit", ONE_OF),
    ([LEFT | {"side": "middle"}, RIGHT], f"{BODY}[0].side", ONE_OF),
    ([LEFT, RIGHT | {"file": "x.mat"}], f"{BODY}[1].file", FILE),
]


@pytest.mark.parametrize(
    ("place", "value", "key", "rule"),
    [
        *((key, value, key, rule) for key, value, rule in MISTAKES),
        *((BODY, *row) for row in IN_PAIRS),
    ],
)
def test_mistake_is_named(folder, place, value, key, rule):
    assert problem(changed(folder, place, value)).startswith(f"`{key}` {rule}")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [1", "line"),
        ("a: {b: 1}: 2", "line"),
        ("!!python/object/apply:os.getcwd []", "tags are not allowed"),
        ("a: !!float 1", "line 1: tags are not allowed"),
        ("a: 1\nb: 2\na: 3", "line 3: the key 'a' is given twice, first in line 1"),
        ("a: {b: 1, b: 2}", "line 1: the key 'b' is given twice"),
        ("- " * 100_000, "nested more than 20 deep"),
        ("[" * 5000, "nesting depth"),
        ("a: *b", "line 1: the alias 'b' is unknown"),
        ("a: &a [*a]", "line 1: the alias 'a' is unknown"),
        ("a: 1\n---\nb: 1", "line 2: a second document"),
        ("? [a]\n: 1", "line 1: a key must be text"),
        ("#" * 2**21, "at most 1048576 are read"),
        (
            "\n".join(
                ["a: &a0 [ha]", *(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]" for i in range(1, 9))]
            ),
            "line 7: it has more than 262144 values",
        ),
    ],
)
def test_damaged_yaml_is_named(folder, text, reason):
    words = problem(write(folder, text))
    assert words.startswith("is not valid YAML (")
    assert reason in words


@pytest.mark.parametrize("text", ["", "- 1", "just text"])
def test_manifest_that_is_no_mapping_is_named(folder, text):
    assert problem(write(folder, text)).startswith("the manifest must be a mapping, got")


def test_binary_and_missing_manifests_are_named(folder):
    (folder / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    assert problem(folder / "binary.yaml").startswith("is not valid YAML")
    assert problem(folder / "nowhere.yaml").startswith("cannot be read (No such file")


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        *(("0777", 777.0), ("1e3", 1000.0), ("0o17", 15.0), ("0x1F", 31.0)),
        *((text, f"'{text}'") for text in ("12:30:45", "1_000", "no", "0b11")),
        *(("true", "True"), (".nan", "nan"), ("9" * 400, "999")),
    ],
)
def test_numbers_are_read_by_yaml_1_2_or_refused(folder, written, meant):
    path = write(folder, TRIP.replace("10267", written))
    if isinstance(meant, float):
        assert read_manifest(path).mileage_km == meant
    else:
        assert f", got {meant}" in problem(path)


@pytest.mark.parametrize(
    "word",
    ["no", "Off", "y", "12:30:45", "2015-08-03", "=", "1_0", "4711", "0777", "1e5", "0x1F", "7.10"],
)
def test_names_stay_text(folder, word):
    path = write(folder, TRIP.replace(SUSPENSION, word))
    assert read_manifest(path).suspension == word
    assert ManifestFile(path).place.suspension == word


def test_byte_order_mark_anchors_and_merge_keys_are_read(folder):
    text = TRIP.replace("axle_box: {file", "axle_box: &box {file")
    merged = "{<<: *box, file: all.mat, rate_hz: 2000}"
    text = text.replace("{file: all.mat, unit: m/s2, rate_hz: 2000, time: t}", merged)
    path = folder / "trip.yaml"
    path.write_text(text, encoding="utf-8-sig")
    manifest = read_manifest(path)
    assert manifest.channels["body"] == SensorSource("all.mat", "m/s2", "acceleration", 2000.0)


def test_writing_refuses_values_that_could_not_be_read(folder):
    manifest = read_manifest(write(folder, TRIP))
    with pytest.raises(TripError, match="`mileage_km` must be a number"):
        write_manifest(replace(manifest, mileage_km=NAN))
    with pytest.raises(TripError, match="`name` must be that of the file"):
        write_manifest(replace(manifest, name="other"))
    assert read_manifest(folder / "trip.yaml") == manifest


@pytest.mark.parametrize(
    ("key", "value", "both"),
    [
        (BODY, [LEFT, LEFT], "body left and body right"),
        (BODY, [LEFT, RIGHT | {"file": "sub/bogie.csv", "column": "a"}], "bogie and body right"),
        (
            "channels.axle_box",
            {"file": "sub/../sub/bogie.csv", "column": "a", "rate_hz": 1.0},
            "axle_box and bogie",
        ),
    ],
)
def test_two_sensors_of_one_column_are_refused(folder, key, value, both):
    expected = f"two `channels` have the same file and column, {both};"
    assert problem(changed(folder, key, value)).startswith(expected)


def test_all_mistakes_are_reported_at_once(folder):
    content = yaml.safe_load(TRIP)
    content |= {"vehicel": "am96", "mileage_km": -1.0, "side": "top", "truth": {"k_p": 0, "c_p": 0}}
    content["speed"] = {"file": "gone.csv", "unit": "mph"}
    del content["suspension"]
    content["channels"]["body"]["unit"] = "mg"
    content["channels"]["bogie"] = [LEFT | {"rate_hz": 0}, RIGHT | {"sign": 3, "range": "much"}]
    path = write(folder, yaml.safe_dump(content))
    with pytest.raises(TripError, match=r"`vehicel` .*\(and 11 more: suspnet check") as caught:
        read_manifest(path)
    keys = (
        *("vehicel", "suspension", "side", "mileage_km", "speed.unit", f"{BOGIE}[0].rate_hz"),
        *(f"{BOGIE}[1].sign", f"{BOGIE}[1].range", f"{BODY}.unit", "truth.k_p", "truth.c_p"),
        "speed.file",
    )
    problems = [words.removeprefix(f"{path}: ").split()[0] for words in caught.value.problems]
    assert problems == [f"`{key}`" for key in keys]


# where on the vehicle


@pytest.mark.parametrize(
    ("text", "place"),
    [
        *((text, None) for text in ("<b>: [", "just text", "[]", "suspension: true", "\0")),
        (f"suspension: {'x' * 101}", None),
        ("suspension: ' a '\nside: left", Place("a", "", "left")),
        ("suspension: a\nbogie: front\nside: [left]", Place("a")),
    ],
)
def test_place_of_a_manifest_needs_nothing_else(folder, text, place):
    assert ManifestFile(write(folder, text)).place == place
    assert ManifestFile(folder / "nowhere.yaml").place is None


# sensors left and right, and at the bogie's other axle


@pytest.mark.parametrize(
    ("sides", "columns"),
    [
        *(((None, None), "lr"), (("left", "right"), "lr"), (("right", "left"), "rl")),
        *((("right", None), "rl"), ((None, "left"), "rl"), (("left", None), "lr")),
        ((None, "right"), "lr"),
    ],
)
def test_pair_is_left_then_right(folder, sides, columns):
    listed = [LEFT | {"side": sides[0]}, RIGHT | {"side": sides[1]}]
    manifest = read_manifest(changed(folder, BODY, listed))
    left, right = manifest.channels["body"]
    assert (left.side, right.side) == SIDES
    assert left.column + right.column == columns
    assert {sensor.column: sensor.unit for sensor in (left, right)} == {"l": "g", "r": "m/s2"}
    assert list(manifest.sensors()) == ["axle_box", "bogie", "body left", "body right"]
    assert read_manifest(write_manifest(manifest)) == manifest


def sensor(column, side=None, axle=None):
    """Return a sensor of its own column."""
    where = {"side": side, "axle": axle}
    return LEFT | {"column": column} | {key: value for key, value in where.items() if value}


BOXES = [
    sensor("d", "right", 2),
    sensor("b", "right"),
    sensor("a", "left", 1),
    sensor("c", None, 2),
]


@pytest.mark.parametrize(
    ("channels", "columns", "pairs"),
    [
        (
            {
                "axle_box": BOXES,
                "bogie": [sensor("f", "right", 2), sensor("e", "left")],
                "body": [sensor("g", "left")],
            },
            {
                **{"axle_box left": "a", "axle_box right": "b", "axle_box axle2 left": "c"},
                **{"axle_box axle2 right": "d", "bogie": "e", "bogie axle2": "f", "body": "g"},
            },
            [True, False, False],
        ),
        (
            {
                "body": [sensor("a"), sensor("b")],
                "bogie": [sensor("c", axle=2), sensor("d", axle=2)],
            },
            {
                **{"bogie axle2 left": "c", "bogie axle2 right": "d"},
                **{"body left": "a", "body right": "b"},
            },
            [False, False, True],
        ),
    ],
)
def test_sensors_of_the_other_axle_have_names_of_their_own(folder, channels, columns, pairs):
    manifest = read_manifest(changed(folder, "channels", channels))
    assert {name: one.column for name, one in manifest.sensors().items()} == columns
    assert [manifest.is_pair(name) for name in CHANNELS] == pairs
    assert read_manifest(write_manifest(manifest)) == manifest
