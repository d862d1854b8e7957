"""Manifests: what is read is what was written, and every mistake is named."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from suspnet.ground.parameters import SIDES
from suspnet.ground.records import Place
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import CHANNELS, TripManifest
from suspnet.recordings.manifest_files import (
    ManifestFile,
    find_manifests,
    read_manifest,
    write_manifest,
)
from suspnet.recordings.manifest_keys import DELIMITERS, CsvDialect
from suspnet.recordings.manifest_sources import Channel, SpeedSource

TRIP = """
format: suspnet-trip-1
vehicle: am96
suspension: car 7, leading bogie, right   # free text
mileage_km: 10267
start: 2015-08-03T08:00:00
speed: {file: speed.csv, column: speed, unit: km/h, rate_hz: 1}
channels:
  axle_box: {file: axle_box.parquet, column: acceleration, unit: m/s2, rate_hz: 5000.0}
  bogie:    {file: sub/bogie.csv, column: a, unit: g, time: t, sign: -1, range: 2.0, start_s: 0.5}
  body:     {file: all.mat, unit: m/s2, rate_hz: 2000, time: t}
truth: {k_p: 1.0, c_p: 0.9}
"""
FILES = ("speed.csv", "axle_box.parquet", "sub/bogie.csv", "all.mat")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    for name in FILES:
        (tmp_path / name).touch()
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "trip.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def changed(folder: Path, *keys: str, to: object = None) -> Path:
    """Write the trip with one value replaced, or removed."""
    content = yaml.safe_load(TRIP)
    section = content
    for key in keys[:-1]:
        section = section[key]
    section.pop(keys[-1], None)
    if to is not None:
        section[keys[-1]] = to
    return write(folder, yaml.safe_dump(content))


def test_manifest_reads_every_key(folder):
    path = write(folder, TRIP)
    assert read_manifest(path) == TripManifest(
        path=path,
        name="trip",
        vehicle="am96",
        suspension="car 7, leading bogie, right",
        mileage_km=10267.0,
        start=datetime(2015, 8, 3, 8),
        speed=SpeedSource("speed.csv", "km/h", column="speed", rate_hz=1.0),
        channels={
            "axle_box": Channel("axle_box.parquet", "m/s2", "acceleration", rate_hz=5000.0),
            "bogie": Channel("sub/bogie.csv", "g", "a", time="t", sign=-1, range=2.0, start_s=0.5),
            "body": Channel("all.mat", "m/s2", rate_hz=2000.0, time="t"),
        },
        truth={"k_p": 1.0, "c_p": 0.9},
    )


def test_channels_come_in_fixed_order(folder):
    content = yaml.safe_load(TRIP)
    content["channels"] = dict(reversed(content["channels"].items()))
    assert tuple(read_manifest(write(folder, yaml.safe_dump(content))).channels) == CHANNELS


def test_optional_keys_may_be_missing_or_null(folder):
    path = changed(folder, "speed", to=70.0)
    path.write_text(path.read_text().replace("truth:", "truth: null\nignored:").split("ignored")[0])
    manifest = read_manifest(changed(folder, "truth"))
    assert manifest.truth == {}
    assert read_manifest(changed(folder, "start")).start is None
    assert read_manifest(changed(folder, "speed", to=70)).speed == 70.0


@pytest.mark.parametrize("text", ["252 km/h", "252.0km/h", "70 m/s"])
def test_constant_speed_may_name_its_unit(folder, text):
    assert read_manifest(changed(folder, "speed", to=text)).speed == pytest.approx(70.0)


@pytest.mark.parametrize("text", ["0 km/h", "-252 km/h", "252,0 km/h", "252 mph", "252 kmh"])
def test_constant_speed_of_another_unit_is_refused(folder, text):
    with pytest.raises(TripError, match=r"`speed` must be a number of m/s > 0, one with its unit"):
        read_manifest(changed(folder, "speed", to=text))


def test_single_sensors_are_on_the_side_of_the_suspension_unless_they_say_another(folder):
    manifest = read_manifest(changed(folder, "channels", "body", "side", to="middle"))
    assert manifest.unplaced == ("axle_box", "bogie")
    manifest = replace(manifest, side="right")
    sides = [manifest.side_of(channel) for channel in manifest.sensors().values()]
    assert (sides, manifest.unplaced) == (["right", "right", "middle"], ())


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("2015-08-03", datetime(2015, 8, 3)),
        ("'2015-08-03T08:00'", datetime(2015, 8, 3, 8)),
        ("2015-08-03T08:00:00Z", datetime(2015, 8, 3, 8, tzinfo=UTC)),
    ],
)
def test_start_takes_iso_8601(folder, written, meant):
    path = write(folder, TRIP.replace("2015-08-03T08:00:00", written))
    assert read_manifest(path).start == meant


def test_absolute_and_parent_paths_are_allowed(folder, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "a.parquet"
    elsewhere.touch()
    manifest = read_manifest(changed(folder, "channels", "body", "file", to=str(elsewhere)))
    assert manifest.file_of(manifest.channels["body"]) == elsewhere
    upwards = f"../{folder.name}/all.mat"
    manifest = read_manifest(changed(folder, "channels", "body", "file", to=upwards))
    assert manifest.file_of(manifest.channels["body"]).samefile(folder / "all.mat")


words = st.text(min_size=1, max_size=20).filter(str.strip)
positive = st.floats(1e-6, 1e6)
sources = {
    "file": st.sampled_from(FILES),
    "column": st.none() | words,
    "time": st.none() | words,
    "rate_hz": positive,
    "start_s": st.floats(-1e9, 1e9),
}
sources |= {
    "time_unit": st.none() | st.sampled_from(["s", "ms"]),
    "time_zone": st.none() | st.sampled_from(["UTC", "+02:00", "Europe/Berlin"]),
    "csv": st.none()
    | st.builds(
        CsvDialect,
        delimiter=st.none() | st.sampled_from(list(DELIMITERS.values())),
        decimal=st.none() | st.sampled_from([".", ","]),
        header_line=st.none() | st.integers(0, 99),
        encoding=st.none() | st.sampled_from(["utf-16", "latin-1"]),
    ),
}
channels = st.builds(
    Channel,
    unit=st.none() | st.sampled_from(["m/s2", "g"]),
    sign=st.sampled_from([1, -1]),
    range=st.none() | positive,
    **sources,
)
single = st.builds(replace, channels, side=st.none() | st.sampled_from(SIDES))
pairs = st.builds(
    lambda left, right: (replace(left, side="left"), replace(right, side="right")),
    channels,
    channels,
)


@settings(max_examples=10)
@given(
    st.builds(
        TripManifest,
        path=st.none(),
        name=st.just("trip"),
        vehicle=words.map(str.strip),
        suspension=words.map(str.strip),
        mileage_km=st.floats(0, 1e7),
        start=st.none() | st.datetimes(datetime(1990, 1, 1), datetime(2025, 1, 1)),
        temperature_c=st.none() | st.floats(-60, 60),
        speed=positive | st.builds(SpeedSource, unit=st.sampled_from(["m/s", "km/h"]), **sources),
        channels=st.fixed_dictionaries(dict.fromkeys(CHANNELS, single | pairs)),
        truth=st.dictionaries(st.sampled_from(["k_p", "c_p", "k_s", "c_s", "M_s"]), positive),
    )
)
def test_written_manifest_reads_the_same(tmp_path_factory, manifest):
    sensors = manifest.sensors().values()
    assume(len({(c.file, c.column) for c in sensors}) == len(sensors))
    folder = tmp_path_factory.mktemp("trip")
    (folder / "sub").mkdir()
    for name in FILES:
        (folder / name).touch()
    manifest = replace(manifest, path=folder / "trip.yaml")
    assert read_manifest(write_manifest(manifest)) == manifest


def test_find_manifests_sorts_and_stays_in_the_folder(folder):
    for name in ("b.yaml", "a.yaml", "sub/c.yaml", "d.yml"):
        (folder / name).touch()
    assert find_manifests(folder) == [folder / "a.yaml", folder / "b.yaml"]


def test_find_manifests_needs_a_folder_with_trips(folder):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        find_manifests(folder / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"holds no \*\.yaml"):
        find_manifests(folder)


BODY = ("channels", "body")
MISTAKES = [
    (("format",), "suspnet-trip-2", r"`format` must be one of \['suspnet-trip-1'\], got 'suspn"),
    (("vehicel",), "am96", r"`vehicel` is not known; allowed are"),
    (("vehicle",), None, "`vehicle` is missing"),
    (("vehicle",), [96], r"`vehicle` must be text .*, got \[96\]"),
    (("suspension",), "  ", "`suspension` must be text"),
    *(
        ((name,), "é" * 101, rf"`{name}` must be one line of at most 100 characters, got 'é")
        for name in ("vehicle", "suspension", "train", "car")
    ),
    (("car",), "7\ndone: all is well", "`car` must be one line"),
    (
        ("train",),
        "\N{RIGHT-TO-LEFT OVERRIDE}" * 20,
        "`train` must be one line of at most 100 characters",
    ),
    (("mileage_km",), "far", r"`mileage_km` must be a number >= 0 .*, got 'far'"),
    (("mileage_km",), -1.0, r"`mileage_km` must be a number >= 0, got -1.0"),
    (("mileage_km",), True, r"`mileage_km` must be a number"),
    (("temperature_c",), 60.5, r"`temperature_c` must be a number from -60 to 60, got 60.5"),
    (("temperature_c",), "warm", r"`temperature_c` must be a number .*, got 'warm'"),
    (("mileage_km",), float("nan"), r"`mileage_km` must be a number >= 0, got nan"),
    (("start",), "2015-13-45", r"`start` must be a time like 2015-08-03T08:00:00, got '2015-13"),
    (("start",), "noon", r"`start` must be a time like 2015-08-03T08:00:00, got 'noon'"),
    (("start",), 8.0, r"`start` must be a time"),
    (("speed",), None, "`speed` is missing"),
    (("speed",), 0.0, r"`speed` must be a number of m/s > 0"),
    (("speed",), float("inf"), r"`speed` must be a number of m/s > 0"),
    (("speed", "unit"), "mph", r"`speed.unit` must be one of \['m/s', 'km/h'\], got 'mph'"),
    (("speed", "sign"), 1, r"`speed.sign` is not known"),
    (("channels",), ["a"], r"`channels` must be a mapping, got \['a'\]"),
    (("channels", "wheel"), {}, r"`channels.wheel` is not known"),
    (BODY, None, "`channels.body` is missing"),
    ((*BODY, "file"), None, "`channels.body.file` is missing"),
    ((*BODY, "file"), "gone.mat", r"`channels.body.file` must name an existing .*'gone.mat'"),
    ((*BODY, "file"), "sub", r"`channels.body.file` must name an existing plain file"),
    ((*BODY, "unit"), "mg", r"`channels.body.unit` must be one of \['m/s2', 'g'\], got 'mg'"),
    ((*BODY, "unit"), ["g"], r"`channels.body.unit` must be one of"),
    ((*BODY, "rate_hz"), 0, r"`channels.body.rate_hz` must be a number > 0, got 0"),
    ((*BODY, "rate_hz"), "5k", r"`channels.body.rate_hz` .* \(written like 5000.0\), got '5k'"),
    ((*BODY, "rate_hz"), 10**400, r"`channels.body.rate_hz` must be a number > 0"),
    ((*BODY, "sign"), 2, r"`channels.body.sign` must be 1 or -1, got 2"),
    ((*BODY, "range"), -2.0, r"`channels.body.range` must be a number > 0, got -2.0"),
    ((*BODY, "start_s"), float("-inf"), r"`channels.body.start_s` must be a finite number"),
    ((*BODY, "column"), 3, r"`channels.body.column` must be text"),
    (
        (*BODY, "time_unit"),
        "min",
        r"`channels.body.time_unit` must be one of \['s', 'ms', 'us', 'ns",
    ),
    ((*BODY, "time_zone"), "Mars/X", r"`channels.body.time_zone` must be one like \"UTC\""),
    ((*BODY, "csv"), ";", r"`channels.body.csv` must be a mapping, got ';'"),
    ((*BODY, "csv"), {"sep": ";"}, r"`channels.body.csv.sep` is not known; allowed are"),
    ((*BODY, "csv"), {"delimiter": ":"}, r"`channels.body.csv.delimiter` must be one of"),
    ((*BODY, "csv"), {"decimal": ";"}, r"`channels.body.csv.decimal` must be one of"),
    ((*BODY, "csv"), {"header_line": -1}, r"`channels.body.csv.header_line` must be a line"),
    ((*BODY, "csv"), {"encoding": "rot13"}, r"`channels.body.csv.encoding` must be one like"),
    (("truth",), {"k_x": 1.0}, r"`truth.k_x` is not known; allowed are \('k_p'"),
    (("truth",), {"k_p": 0.0}, r"`truth.k_p` must be a number > 0"),
]


@pytest.mark.parametrize(("keys", "value", "message"), MISTAKES)
def test_mistake_is_named(folder, keys, value, message):
    path = changed(folder, *keys, to=value)
    with pytest.raises(TripError, match=rf"trip\.yaml: {message}") as caught:
        read_manifest(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1", "is not valid YAML .*line"),
        ("a: {b: 1}: 2", "is not valid YAML"),
        ("!!python/object/apply:os.getcwd []", "is not valid YAML"),
        (
            "a: 1\nb: 2\na: 3",
            r"is not valid YAML \(line 3: the key 'a' is given twice, first in line 1",
        ),
        ("a: {b: 1, b: 2}", "is not valid YAML .*line 1: the key 'b' is given twice"),
        ("- " * 100_000, "is not valid YAML .*nested more than 20 deep"),
        ("a: !!float 1", "is not valid YAML .*line 1: tags are not allowed"),
        ("a: *b", "is not valid YAML .*line 1: the alias 'b' is unknown"),
        ("a: &a [*a]", "is not valid YAML .*line 1: the alias 'a' is unknown"),
        ("a: 1\n---\nb: 1", "is not valid YAML .*line 2: a second document"),
        ("? [a]\n: 1", "is not valid YAML .*line 1: a key must be text"),
        ("#" * 2**21, "is not valid YAML .*at most 1048576 are read"),
        ("[" * 5000, "is not valid YAML"),
        ("", "the manifest must be a mapping, got None"),
        ("- 1", "the manifest must be a mapping"),
        ("1: 2", "`1` is not known"),
    ],
)
def test_damaged_yaml_is_named(folder, text, message):
    with pytest.raises(TripError, match=rf"trip\.yaml: {message}"):
        read_manifest(write(folder, text))


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("0777", 777.0),
        ("1e3", 1000.0),
        ("0o17", 15.0),
        ("0x1F", 31.0),
        ("12:30:45", "'12:30:45'"),
        ("1_000", "'1_000'"),
        ("no", "'no'"),
        ("0b11", "'0b11'"),
        ("true", "True"),
        (".nan", "nan"),
        ("9" * 400, "999"),
    ],
)
def test_numbers_are_what_stands_there_or_refused(folder, written, meant):
    path = write(folder, TRIP.replace("10267", written))
    if isinstance(meant, float):
        assert read_manifest(path).mileage_km == meant
    else:
        with pytest.raises(TripError, match=rf"`mileage_km` must be a number >= 0.*, got {meant}"):
            read_manifest(path)


@pytest.mark.parametrize(
    "word",
    ["no", "Off", "y", "12:30:45", "2015-08-03", "=", "1_0", "4711", "0777", "1e5", "0x1F", "7.10"],
)
def test_words_stay_words(folder, word):
    path = write(folder, TRIP.replace("car 7, leading bogie, right", word))
    assert read_manifest(path).suspension == word
    assert ManifestFile(path).place.suspension == word
    for refused in ("true", "null"):
        with pytest.raises(TripError, match=r"`suspension` (must be text|is missing)"):
            read_manifest(write(folder, TRIP.replace("car 7, leading bogie, right", refused)))


def test_byte_order_mark_anchors_and_merge_keys_are_read(folder):
    text = TRIP.replace("axle_box: {file", "axle_box: &box {file")
    text = text.replace("{file: all.mat, unit: m/s2, rate_hz: 2000, time: t}",
                        "{<<: *box, file: all.mat, rate_hz: 2000}")  # fmt: skip
    path = folder / "trip.yaml"
    path.write_text(text, encoding="utf-8-sig")
    manifest = read_manifest(path)
    assert manifest.channels["body"] == Channel("all.mat", "m/s2", "acceleration", 2000.0)


def test_binary_missing_and_nested_manifests_are_named(folder):
    (folder / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(TripError, match=r"binary\.yaml: is not valid YAML"):
        read_manifest(folder / "binary.yaml")
    with pytest.raises(TripError, match=r"nowhere\.yaml: cannot be read \(No such file"):
        read_manifest(folder / "nowhere.yaml")
    laughs = ["a: &a0 [ha]", *(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]" for i in range(1, 30))]
    with pytest.raises(TripError, match=r"line 7: it has more than 262144 values"):
        read_manifest(write(folder, "\n".join(laughs)))


def test_writing_refuses_what_could_not_be_read(folder):
    manifest = read_manifest(write(folder, TRIP))
    with pytest.raises(TripError, match="`mileage_km` must be a number >= 0, got nan"):
        write_manifest(replace(manifest, mileage_km=float("nan")))
    with pytest.raises(TripError, match="`name` must be that of the file, got 'other'"):
        write_manifest(replace(manifest, name="other"))
    assert read_manifest(folder / "trip.yaml") == manifest


def test_two_channels_from_one_column_are_refused(folder):
    path = changed(folder, "channels", "axle_box", "file", to="sub/../sub/bogie.csv")
    assert read_manifest(path).channels["axle_box"].column == "acceleration"
    content = yaml.safe_load(path.read_text())
    content["channels"]["axle_box"]["column"] = "a"
    with pytest.raises(TripError, match="two `channels` have the same file and column"):
        read_manifest(write(folder, yaml.safe_dump(content)))


def test_all_mistakes_are_told_at_once(folder):
    content = yaml.safe_load(TRIP)
    content |= {"vehicel": "am96", "mileage_km": -1.0, "side": "top", "truth": {"k_p": 0, "c_p": 0}}
    content["speed"] = {"file": "gone.csv", "unit": "mph"}
    del content["suspension"]
    content["channels"]["body"]["unit"] = "mg"
    content["channels"]["bogie"] = [LEFT | {"rate_hz": 0}, RIGHT | {"sign": 3, "range": "much"}]
    path = write(folder, yaml.safe_dump(content))
    with pytest.raises(
        TripError, match=r"`vehicel` is not known.*\(and 11 more: suspnet check"
    ) as e:
        read_manifest(path)
    told = [problem.removeprefix(f"{path}: ") for problem in e.value.problems]
    assert len(told) == 12
    keys = (
        *("vehicel", "suspension", "side", "mileage_km", "speed.unit", "channels.bogie[0].rate_hz"),
        *("channels.bogie[1].sign", "channels.bogie[1].range", "channels.body.unit"),
        *("truth.k_p", "truth.c_p", "speed.file"),
    )
    assert [problem.split()[0] for problem in told] == [f"`{key}`" for key in keys]


# where on the vehicle


def test_bogie_and_side_are_optional_and_kept(folder):
    plain = read_manifest(write(folder, TRIP))
    assert (plain.bogie, plain.side) == (None, None)
    placed = replace(plain, bogie="trailing", side="left")
    assert read_manifest(write_manifest(placed)) == placed
    assert ManifestFile(placed.path).place == Place(
        "car 7, leading bogie, right", "trailing", "left"
    )
    assert "bogie: trailing" in placed.path.read_text().split("channels")[0]


@pytest.mark.parametrize(
    ("key", "to", "rule"),
    [
        ("bogie", "front", r"one of \['leading', 'trailing'\], got 'front'"),
        ("bogie", 1, r"one of \['leading', 'trailing'\], got 1"),
        ("side", ["left"], r"one of \['left', 'right'\], got \['left'\]"),
    ],
)
def test_wrong_place_is_named(folder, key, to, rule):
    path = changed(folder, key, to=to)
    with pytest.raises(TripError, match=f"`{key}` must be {rule}"):
        read_manifest(path)
    assert ManifestFile(path).place == Place("car 7, leading bogie, right")


@pytest.mark.parametrize(
    "text", ["<b>: [", "just text", "[]", "suspension: true", "\0", f"suspension: {'x' * 101}"]
)
def test_manifest_that_does_not_say_its_place_has_none(folder, text):
    assert ManifestFile(write(folder, text)).place is None
    assert ManifestFile(folder / "nowhere.yaml").place is None


def test_place_of_a_manifest_needs_nothing_else(folder):
    assert ManifestFile(write(folder, "suspension: ' a '\nside: left")).place == Place(
        "a", "", "left"
    )
    words = [str(Place("a", "leading", "left")), str(Place("a")), str(Place())]
    assert words == ["a, leading bogie, left", "a", "unknown"]


# sensors left and right

LEFT = {"file": "all.mat", "column": "l", "unit": "g", "rate_hz": 200.0}
RIGHT = {"file": "all.mat", "column": "r", "unit": "m/s2", "time": "t", "sign": -1}


@pytest.mark.parametrize(
    ("sides", "columns"),
    [
        ((None, None), "lr"),
        (("left", "right"), "lr"),
        (("right", "left"), "rl"),
        (("right", None), "rl"),
        ((None, "left"), "rl"),
        (("left", None), "lr"),
        ((None, "right"), "lr"),
    ],
)
def test_pair_is_left_then_right(folder, sides, columns):
    listed = [LEFT | {"side": sides[0]}, RIGHT | {"side": sides[1]}]
    manifest = read_manifest(changed(folder, *BODY, to=listed))
    left, right = manifest.channels["body"]
    assert (left.side, right.side) == SIDES
    assert left.column + right.column == columns
    assert {one.column: one.unit for one in (left, right)} == {"l": "g", "r": "m/s2"}
    assert list(manifest.sensors()) == ["axle_box", "bogie", "body left", "body right"]
    assert read_manifest(write_manifest(manifest)) == manifest


def test_list_of_one_is_one_sensor(folder):
    path = changed(folder, *BODY, to=[LEFT | {"side": "right"}])
    manifest = read_manifest(path)
    assert manifest.channels["body"] == Channel("all.mat", "g", "l", 200.0, side="right")
    assert read_manifest(write_manifest(manifest)) == manifest


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ([], "`channels.body` must be a sensor, or a list .* got a list of 0"),
        ([LEFT, RIGHT, LEFT], "`channels.body` must be a sensor, or a list .* got a list of 3"),
        ([LEFT, "all.mat"], r"`channels.body\[1\]` must be a mapping, got 'all.mat'"),
        ([LEFT, RIGHT | {"unit": "mg"}], r"`channels.body\[1\].unit` must be one of"),
        ([LEFT | {"side": "middle"}, RIGHT], r"`channels.body\[0\].side` must be one of \['left'"),
        ([LEFT | {"side": "left"}] * 2, "`channels.body` has two sensors on the left; a pair is"),
        ([LEFT | {"side": "right"}] * 2, "`channels.body` has two sensors on the right; a pair"),
        ([LEFT, LEFT], "two `channels` have the same file and column, body left and body right"),
        ([LEFT, RIGHT | {"file": "x.mat"}], r"`channels.body\[1\].file` must name an existing"),
        (
            [LEFT, RIGHT | {"file": "sub/bogie.csv", "column": "a"}],
            "two `channels` have the same file and column, bogie and body right; each is one",
        ),
    ],
)
def test_mistake_in_a_pair_is_named(folder, listed, message):
    with pytest.raises(TripError, match=rf"trip\.yaml: {message}"):
        read_manifest(changed(folder, *BODY, to=listed))


# sensors at the bogie's other axle


def sensor(column, side=None, axle=None):
    """Return a sensor of its own column."""
    where = {"side": side, "axle": axle}
    return LEFT | {"column": column} | {key: one for key, one in where.items() if one}


BOXES = [
    sensor("d", "right", 2),
    sensor("b", "right"),
    sensor("a", "left", 1),
    sensor("c", None, 2),
]


def test_four_axle_boxes_and_corners_of_the_frame_on_a_diagonal(folder):
    diagonal = [sensor("f", "right", 2), sensor("e", "left")]
    channels = {"axle_box": BOXES, "bogie": diagonal, "body": [sensor("g", "left")]}
    manifest = read_manifest(changed(folder, "channels", to=channels))
    found = {name: one.column for name, one in manifest.sensors().items()}
    assert found == {
        "axle_box left": "a",
        "axle_box right": "b",
        "axle_box axle2 left": "c",
        "axle_box axle2 right": "d",
        "bogie": "e",
        "bogie axle2": "f",
        "body": "g",
    }
    assert [manifest.is_pair(name) for name in CHANNELS] == [True, False, False]
    assert manifest.unplaced == ()
    assert read_manifest(write_manifest(manifest)) == manifest


def test_four_sensors_may_leave_a_channel_out(folder):
    pairs = [sensor("a"), sensor("b")], [sensor("c", axle=2), sensor("d", axle=2)]
    path = changed(folder, "channels", to=dict(zip(("body", "bogie"), pairs, strict=True)))
    manifest = read_manifest(path)
    assert list(manifest.sensors()) == [
        *("bogie axle2 left", "bogie axle2 right", "body left", "body right")
    ]
    assert not manifest.is_pair("bogie")
    assert not manifest.is_pair("axle_box")
    assert read_manifest(write_manifest(manifest)) == manifest


@pytest.mark.parametrize(
    ("channel", "listed", "message"),
    [
        ("bogie", sensor("a", axle=2), "`channels.bogie` has a sensor at axle 2 only: call its"),
        ("bogie", sensor("a", axle=3), "`channels.bogie.axle` must be 1 or 2, got 3"),
        ("bogie", sensor("a", axle="2"), "`channels.bogie.axle` must be 1 or 2 .*, got '2'"),
        ("body", sensor("a", axle=1), "`channels.body.axle` is not known; allowed are"),
        ("axle_box", [*BOXES, LEFT], "`channels.axle_box` must be .* right at each axle, got a li"),
        ("axle_box", [sensor("a", "left", 2)] * 2, "`channels.axle_box` has two sensors on the l"),
        ("axle_box", [BOXES[1], sensor("b", "middle")], r"`channels.axle_box\[1\].side` must be"),
    ],
)
def test_mistake_in_a_place_is_named(folder, channel, listed, message):
    with pytest.raises(TripError, match=rf"trip\.yaml: {message}"):
        read_manifest(changed(folder, "channels", channel, to=listed))
