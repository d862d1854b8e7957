"""suspnet check: what it tells of good and of broken trips, and that it always ends in words."""

import json
import random
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.signal
import yaml
from cli_runner import ROOT, typed
from dying_readers import open_dying
from hydra import compose, initialize_config_dir
from matplotlib.figure import Figure
from matplotlib.image import imread
from trip_fixtures import changed, signal, small_fleet

from suspnet.cli import check, options
from suspnet.cli.config_files import CONFIGS
from suspnet.cli.kinds import read_vehicles
from suspnet.curves.welch import Welch
from suspnet.ground.findings import Finding, together
from suspnet.ground.own_files import MARKER
from suspnet.ground.parameters import BOGIE_PARTS
from suspnet.ground.records import Place
from suspnet.trains.jobs.check import CheckSettings, check_trip
from suspnet.trains.pages.check_page import (
    NEED_A_VEHICLE,
    PARTLY,
    PROBLEM,
    READY,
    TOO_LITTLE,
    SteadyPart,
    TripCheck,
    summary,
)
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.recordings.manifest_files import find_trips, read_manifest
from suspnet.trains.recordings.reader_process import in_own_process
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.trips import sensor_checks

LOSSES = {name: 0.05 for name in BOGIE_PARTS}
N_GOOD = 2
"""Number of trips that are checked; the first is drawn, which takes a second, others are blank."""


def errors(done):
    """Return what a program printed on standard error besides how far it is."""
    return re.sub(r"^trips: .*\n", "", done.stderr, flags=re.MULTILINE)


@pytest.fixture(scope="module")
def manifests():
    return small_fleet()


@pytest.fixture(scope="module")
def settings():
    return CheckSettings({vehicle.name: vehicle for vehicle in read_vehicles().values()})


@pytest.fixture(scope="module")
def fleet(manifests, tmp_path_factory):
    """Return the folder and the words of a check of good trips."""
    output = tmp_path_factory.mktemp("fleet")
    draw = Figure.draw

    def draw_first(*arguments):
        patch.setattr(Figure, "draw", lambda *_: None)
        return draw(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "draw", draw_first)
        done = typed(check, *manifests[:N_GOOD], "-o", output, cwd=output)
    assert (done.returncode, errors(done)) == (0, "")
    return output, done.stdout


def found_in(output):
    return json.loads((output / "check.json").read_text(encoding="utf-8"))


# what an estimate would have to work with


def test_coherence_and_averages_are_those_of_scipy_and_welch(manifests, settings):
    found = check_trip(manifests[0], settings)
    recording = load_recording(read_manifest(manifests[0]))
    (part,) = found.parts
    length = 2000
    for link, coherence, high_hz in ((0, part.coherence_p, 20.9), (1, part.coherence_s, 13.2)):
        x, y = recording.signals[link : link + 2]
        hertz, expected = scipy.signal.coherence(
            x, y, 100.0, "hann", length, length // 2, detrend="constant"
        )
        inside = (hertz >= 0.6) & (hertz <= high_hz)
        assert coherence == pytest.approx(expected[inside].mean(), abs=2e-3)
    n_segments = (len(recording.usable) - length) // (length // 2) + 1
    assert part.n_averages == pytest.approx(Welch().n_averages(n_segments))
    assert part.speed_m_per_s == pytest.approx(70.0)
    assert (found.state, found.problems, found.steady_percent) == (READY, (), 100.0)


def test_good_trips_are_ready_and_drawn(fleet, manifests):
    output, words = fleet
    assert words.startswith("2 of 2 trips ready for an estimate\n")
    assert "am96, simulated: 2 of 2 trips ready, 1000 to 2000 km, at 70.0 m/s" in words
    assert "Problems" not in words
    trips = found_in(output)["trips"]
    assert [trip["state"] for trip in trips] == [READY] * N_GOOD
    assert trips[0]["band_hz"] == pytest.approx([0.595, 20.9], rel=1e-2)
    for trip in trips:
        assert imread(output / trip["picture"]).shape[:2] == (770, 1320)
    page = (output / "check.html").read_text(encoding="utf-8")
    assert all(f'src="{path.stem}.png"' in page for path in manifests[:N_GOOD])
    assert sorted(path.name for path in output.iterdir()) == sorted(
        ["check.html", "check.json", MARKER, *(f"{path.stem}.png" for path in manifests[:N_GOOD])]
    )


def test_lost_samples_and_speed_are_told(manifests, settings, tmp_path):
    body = signal(manifests[0], "body").copy()
    body[5000:15_000] = np.nan  # 40 of 300 s
    path = changed(manifests[0], tmp_path, signals={"body": body})
    found = check_trip(path, settings)
    assert found.state == READY
    assert found.usable_percent == pytest.approx(100 * (1 - 40 / 300), abs=0.2)
    assert any("body: gap of 10000 samples (40 s)" in remark for remark in found.remarks)
    times = np.array([*np.arange(0.0, 101.0, 10.0), 400.0])
    seconds = {"t": times, "v": np.full(len(times), 70.0)}
    source = {"column": "v", "time": "t", "rate_hz": None}
    path = changed(manifests[0], tmp_path, "gps", {"speed": seconds}, {"speed": source})
    assert any("speed is unknown for 6" in remark for remark in check_trip(path, settings).remarks)


def test_each_steady_speed_is_a_part(manifests, tmp_path):
    seconds = np.arange(301.0)
    speed = {"t": seconds, "v": np.where(seconds < 150, 64.0, 76.0)}
    source = {"column": "v", "time": "t", "rate_hz": None}
    path = changed(manifests[0], tmp_path, "steps", {"speed": speed}, {"speed": source})
    done = typed(check, path, "-o", tmp_path / "o", "--no-pictures", cwd=tmp_path)
    (trip,) = found_in(tmp_path / "o")["trips"]
    assert sorted(part["speed_m_per_s"] for part in trip["parts"]) == pytest.approx([64.0, 76.0])
    assert 90 < trip["steady_percent"] < 100  # the segments across the step are left out
    assert "at 64.0 to 76.0 m/s" in done.stdout


def test_slow_trip_holds_too_little_but_is_no_mistake(manifests, tmp_path):
    path = changed(manifests[0], tmp_path, speed=9.0)
    done = typed(check, path, "--no-pictures", "-o", tmp_path / "o", cwd=tmp_path)
    assert done.returncode == 0
    (trip,) = found_in(tmp_path / "o")["trips"]
    assert trip["state"] == TOO_LITTLE
    words = "too little at a steady speed: 0.0 minutes, at least 2.0 are needed, 2.0 more"
    assert words in done.stdout


def test_side_of_single_sensors_is_asked_for(manifests, tmp_path):
    asked = "single sensors are taken as in the middle; if they are on one side, say `side`"
    for side in (None, "right"):
        path = changed(manifests[0], tmp_path, side=side)
        done = typed(check, path, "--no-pictures", "-o", tmp_path / str(side), cwd=tmp_path)
        assert (asked in done.stdout) == (side is None)


@pytest.mark.parametrize(("misfit", "is_doubted"), [(1.5, False), (3.0, True)])
def test_order_by_curves_is_no_doubt_where_parts_explain_single_sensors(
    manifests, tmp_path, monkeypatch, misfit, is_doubted
):
    doubts = [Finding("order-unclear", order_words="x"), Finding("if-sure"), "no gains"]
    monkeypatch.setattr(sensor_checks, "check_channels", lambda *_, **__: together(doubts))
    monkeypatch.setattr(sensor_checks, "misfit_near", lambda *_: misfit)
    for name in ("check_order", "check_end"):
        monkeypatch.setattr(sensor_checks, name, lambda vehicle, trip, **_: None)
    path = changed(manifests[0], tmp_path, side="right", direction="forward")
    done = typed(check, path, "--no-pictures", "-o", tmp_path / "o", cwd=tmp_path)
    for words in ("the order of the channels is not clear", "if you are sure, continue"):
        assert (words in done.stdout) == is_doubted
    assert "no gains" in done.stdout


def test_pairs_are_named_and_mixed_sensors_told(manifests, tmp_path, monkeypatch):
    for name in ("check_order", "check_end"):  # sensors that show the same have no sides
        monkeypatch.setattr(sensor_checks, name, lambda vehicle, trip, **_: None)
    changed(manifests[0], tmp_path, "single")
    content = yaml.safe_load((tmp_path / "single.yaml").read_text())
    for name in ("axle_box", "bogie"):
        source, values = content["channels"][name], signal(manifests[0], name)
        noise = 0.01 * values.std() * np.random.default_rng(0).standard_normal(len(values))
        table = pa.table({"l": values, "r": values + noise})
        pq.write_table(table, tmp_path / f"{name}.parquet", use_dictionary=False)
        pair = [source | {"file": f"{name}.parquet", "column": column} for column in "lr"]
        content["channels"][name] = pair
    (tmp_path / "pair.yaml").write_text(yaml.safe_dump(content))
    done = typed(check, tmp_path, "--no-pictures", "-o", tmp_path / "o", cwd=tmp_path)
    assert done.returncode == 0
    assert "differ in their sensors (pairs: axle_box, bogie; single sensors)" in done.stdout
    assert "commissioning needs 3 ready healthy trips" in done.stdout
    assert not list((tmp_path / "o").glob("*.png"))


# what is wrong


@pytest.mark.usefixtures("blank")
def test_problems_of_all_trips_and_arguments_are_told_at_once(manifests, tmp_path):
    good = manifests[0]
    (tmp_path / "trips").mkdir()
    trips = tmp_path / "trips"
    changed(good, trips, "a_good")
    changed(good, trips, "b_file", channels={"body": {"file": "gone.parquet", "unit": "mg"}})
    changed(good, trips, "c_column", channels={"body": {"column": "z"}, "bogie": {"column": "y"}})
    changed(good, trips, "e_unit", channels={"body": {"unit": "g"}})
    changed(good, trips, "g_both", vehicel="am96", channels={"bogie": {"column": "y"}})
    dead = np.zeros_like(signal(good, "body"))
    changed(good, trips, "h_dead", {"body": dead})
    (trips / "i_binary.csv").write_bytes(bytes(random.Random(0).randbytes(50_000)))
    csv = {"file": str(trips / "i_binary.csv"), "column": "a"}
    changed(good, trips, "i_binary", channels={"body": csv})
    (trips / "j_yaml.yaml").write_text("a: [1")
    (trips / "k_none.yaml").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "empty").mkdir()
    data = good.parent / good.stem / "body.parquet"
    done = typed(
        check, trips, tmp_path / "empty", tmp_path / "nowhere", data, "-o", "o", cwd=tmp_path
    )
    assert done.returncode == 1
    assert errors(done) == ""
    told = {trip["manifest"].rpartition("/")[2]: trip for trip in found_in(tmp_path / "o")["trips"]}
    expected = {
        "b_file": ["channels.body.unit", "channels.body.file"],
        "c_column": ["no column 'y'", "no column 'z'"],
        "e_unit": ["m/s2 and g are mixed up"],
        "g_both": ["`vehicel` is not known", "no column 'y'"],
        "h_dead": ["channel 'body' is constant (0)"],
        "i_binary": ["i_binary.csv"],
        "j_yaml": ["not valid YAML"],
        "k_none": ["not valid YAML"],
    }
    for name, words in expected.items():
        trip = told[f"{name}.yaml"]
        assert trip["state"] == PROBLEM, name
        assert len(trip["problems"]) == len(words), trip["problems"]
        assert all(word in " ".join(trip["problems"]) for word in words), trip["problems"]
        assert all(problem.isprintable() for problem in trip["problems"])
    assert told["a_good.yaml"]["state"] == READY
    assert "b_file: `channels.body.unit` must be one of" in done.stdout
    assert "empty holds no *.yaml file" in done.stdout
    assert "there is no file or folder" in done.stdout
    assert "is no manifest (*.yaml); to write one: suspnet init" in done.stdout
    assert told["e_unit.yaml"]["picture"]


def test_file_that_kills_its_reader_is_one_problem(manifests, tmp_path, monkeypatch):
    """One that hangs it is in tests/recordings/test_reader_process.py."""
    monkeypatch.setitem(READERS, ".mat", in_own_process(open_dying))
    for what in ("crash", "exit:1"):
        (tmp_path / f"{what}.mat").write_text(what)
        channels = {"body": {"file": f"{what}.mat", "column": "a", "unit": "g"}}
        changed(manifests[0], tmp_path, what, channels=channels)
    changed(manifests[0], tmp_path, "good")
    done = typed(check, tmp_path, "--no-pictures", "-o", tmp_path / "o", cwd=tmp_path)
    assert (done.returncode, errors(done)) == (1, "")
    told = {trip["manifest"].rpartition("/")[2]: trip for trip in found_in(tmp_path / "o")["trips"]}
    words = {"crash": "(SIGSEGV), so", "exit:1": "(exit code 3), so"}
    for name, one in words.items():
        (problem,) = told[f"{name}.yaml"]["problems"]
        assert problem.startswith(f"{tmp_path / name}.mat: its reader ")
        assert one in problem
    assert told["good.yaml"]["state"] == READY


def test_table_fits_a_terminal_whatever_the_names_and_speeds():
    parts = tuple(SteadyPart(speed, 12.0, 0.991, 0.983, 2.0) for speed in (77.9, 48.2))
    values = {"duration_s": 7205.0, "usable_percent": 100.0, "steady_percent": 99.0, "parts": parts}
    names = ("a/2026_03_01_0815_of_the_first_logger", "short")
    checks = [TripCheck(Path(f"{name}.yaml"), READY, label=name, **values) for name in names]
    checks.append(TripCheck(Path("c.yaml"), READY, unchecked=True, sensors="x" * 90, **values))
    table = [line for line in summary(checks).splitlines() if line.startswith("|")]
    assert {len(line) for line in table} == {100}
    assert "| \N{HORIZONTAL ELLIPSIS}" in table[2]
    assert table[2].split("|")[1].strip().endswith("logger")
    assert "| short " in table[3]


def test_unknown_vehicle_is_told_and_may_be_given(manifests, tmp_path):
    path = changed(manifests[0], tmp_path, vehicle="mine")
    done = typed(check, path, "--no-pictures", "-o", "a", cwd=tmp_path)
    assert done.returncode == 0
    assert "vehicle 'mine' is none of ['am96'," in done.stdout
    assert "1 of 1 trip ready for an estimate, 1 of them only partly checked" in done.stdout
    assert f"| {PARTLY} " in done.stdout
    left_out, how = done.stdout.splitlines()[-2:]
    assert left_out == f"not checked without the numbers of mine: {NEED_A_VEHICLE}"
    again = f"suspnet check {path} --config-dir"
    assert how == f"to check them too: {again} DIR, where DIR is the folder with vehicle/mine.yaml"
    page = (tmp_path / "a/check.html").read_text(encoding="utf-8")
    assert f'<span class="label notice">{PARTLY}</span>' in page
    assert found_in(tmp_path / "a")["trips"][0]["unchecked"] is True
    own = tmp_path / "own" / "vehicle"
    own.mkdir(parents=True)
    (own / "mine.yaml").touch()  # found by its name, and not read
    done = typed(check, path, "--no-pictures", "-o", "a", cwd=tmp_path)
    assert done.stdout.splitlines()[-1] == f"to check them too: {again} own"
    (tmp_path / "vehicle").mkdir()
    shipped = (Path(CONFIGS) / "vehicle/am96.yaml").read_text()
    (tmp_path / "vehicle/mine.yaml").write_text(shipped.replace("name: am96", "name: mine"))
    swapped = changed(
        manifests[0], tmp_path, "unit", vehicle="mine", channels={"body": {"unit": "g"}}
    )
    options = ["--no-pictures", "--config-dir", tmp_path, "-o", "b"]
    done = typed(check, path, swapped, *options, cwd=tmp_path)
    assert done.returncode == 1
    assert "unit: body: the gain G_s" in done.stdout
    assert "is none of" not in done.stdout
    assert PARTLY not in done.stdout
    assert "not checked without" not in done.stdout


READY_TRIP = TripCheck(
    Path("t.yaml"),
    READY,
    vehicle="mine",
    duration_s=959.0,
    parts=(SteadyPart(70.0, 90.0, 1.0, 1.0, 1.0),),
)


def steps(*words, code=0, n=6, **changes):
    """Return what is to be done after a check of a folder of ready trips."""
    arguments = options.check_parser().parse_args([".", *words])
    checks = [replace(READY_TRIP, **changes)] * n
    return steps_after(arguments, checks, code)


def steps_after(arguments, checks, code=0):
    return check.next_steps(arguments, checks, {"mine"}, code)


def test_training_is_the_next_command_and_can_be_copied():
    command, why = steps("--config-dir", "our vehicles", least_losses=LOSSES)
    head, *words = shlex.split(command.partition("then run: ")[2])
    assert (head, words[:3]) == ("suspnet", ["train", "--config-dir", "our vehicles"])
    assert "first 5 trips of each suspension" in why
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose("train", overrides=["experiment=trips", *words[3:]])
    assert (config.healthy, config.n_healthy, config.generator.bogie) == (".", 5, "leading")
    of_one = steps(place=Place("S1", "trailing"), n=3, duration_s=1200.0)[0]
    assert of_one == "then run: suspnet train healthy=. n_healthy=3"
    after = steps(code=1)[0]
    assert after.startswith("with the problems mended, run: suspnet train healthy=. ")
    (read,) = steps("--run", "outputs/one", "--run", "outputs/two")
    assert read == "then run: suspnet evaluate trips=. 'run=[outputs/one,outputs/two]'"


def test_next_training_has_no_speeds_as_a_bogie_is_read_at_any():
    arguments = options.check_parser().parse_args(["."])
    trips = [replace(READY_TRIP, mileage_km=float(i)) for i in range(7)]
    slow = replace(trips[6], parts=(replace(trips[6].parts[0], speed_m_per_s=30.0),))
    assert "speed" not in steps_after(arguments, [slow, *trips[:6]])[0]


@pytest.mark.parametrize(
    ("code", "n", "changes"),
    [(0, 2, {}), (0, 6, {"state": TOO_LITTLE}), (0, 6, {"unchecked": True})],
)
def test_no_training_is_proposed_that_would_fail(code, n, changes):
    assert steps(code=code, n=n, **changes) == []


def test_folder_of_vehicles_is_checked_and_runs_nothing(manifests, tmp_path):
    done = typed(check, manifests[0], "--config-dir", tmp_path, cwd=tmp_path)
    assert done.returncode == 1
    assert "holds no vehicles: each is a file vehicle/NAME.yaml" in done.stderr
    (tmp_path / "vehicle").mkdir()
    (tmp_path / "vehicle/evil.yaml").write_text(
        f"_target_: pathlib.Path.touch\n_args_: [{tmp_path / 'hit'}]\n"
    )
    done = typed(check, manifests[0], "--config-dir", tmp_path, cwd=tmp_path)
    assert done.returncode == 1
    assert "`vehicle._target_` is no setting of vehicle" in done.stderr
    assert not (tmp_path / "hit").exists()
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-o", "file"], "file"),
        (["--workers", "0"], "`--workers` must be a whole number >= 1, got 0"),
    ],
)
def test_mistakes_are_one_line(manifests, tmp_path, options, words):
    (tmp_path / "file").touch()
    done = typed(check, manifests[0], *options, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert words in done.stderr


def test_subfolders_are_searched_and_pictures_have_names_of_their_own(manifests, tmp_path):
    for part in ("left", "right"):
        (tmp_path / "trips" / part).mkdir(parents=True)
        changed(manifests[0], tmp_path / "trips" / part, "trip")
    paths, problems = find_trips([tmp_path / "trips", tmp_path / "trips/left"])
    assert [path.parent.name for path in paths] == ["left", "right"]
    assert problems == []
    assert list(check.picture_names(paths).values()) == ["trip.png", "trip_2.png"]


def test_commands_of_the_docs_are_understood():
    parsers = {"suspnet check": options.check_parser(), "suspnet init": options.init_parser()}
    found = []
    for page in (ROOT / "docs").glob("*.md"):
        for line in page.read_text(encoding="utf-8").splitlines():
            if match := re.match(r"    (suspnet (?:check|init)) (.*)", line):
                words = shlex.split(match[2], comments=True)
                found.append(parsers[match[1]].parse_args(words))
    assert len(found) >= 4
