"""The programs on a rig: from files to a verdict, and wrong input in one line."""

import csv
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from cli_runner import typed as typed_in
from rig_records import numbers, record

pytestmark = pytest.mark.usefixtures("records_fitted_once")
TRUE = numbers(20.0, 25.0, 0.8, 0.01, 0.02)
WORN = np.array([0.7, 1.0, 1.0, 1.0, 1.0])
FILE = "kind: rig\nname: bench\nprimary_hz: 26\nsecondary_hz: 18\nbogie_mass_kg: 2\n"
CHANNELS = ("channels.base=a0 [m/s2]", "channels.frame=a1 [m/s2]", "channels.body=a2 [m/s2]")


def typed(*words):
    """Run a program as if typed in the current folder."""
    name, *arguments = words
    return typed_in(importlib.import_module(f"suspnet.cli.{name}"), *arguments, cwd=Path())


def write(folder, true, seeds):
    folder.mkdir()
    for seed in seeds:
        signals = record(true, 200.0, 24.0, seed)
        times = np.arange(signals.shape[1]) / 200.0
        rows = np.column_stack([times, *signals])
        header = "time [s],a0 [m/s2],a1 [m/s2],a2 [m/s2]"
        np.savetxt(folder / f"r{seed}.csv", rows, "%.9g", ",", header=header, comments="")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    vehicle = tmp_path / "rigs" / "vehicle" / "bench.yaml"
    vehicle.parent.mkdir(parents=True)
    vehicle.write_text(FILE)
    return tmp_path


def test_from_files_to_a_verdict(folder):
    write(folder / "healthy", TRUE, range(3))
    write(folder / "later", TRUE * WORN, [7])
    asked = typed("init", "healthy", "vehicle=bench")
    assert asked.returncode == 1
    assert "channels.base: channels.base=COLUMN" in asked.stdout
    assert "mileage" not in asked.stdout
    for name in ("healthy", "later"):
        written = typed("init", name, "vehicle=bench", *CHANNELS)
        assert written.returncode == 0, written.stdout + written.stderr
    checked = typed("check", "healthy", "--config-dir", "rigs", "--no-pictures")
    assert checked.returncode == 0, checked.stdout
    assert "3 of 3 trips ready" in checked.stdout
    assert "frame alone at 20 Hz, body alone at 25 Hz" in checked.stdout
    assert "suspnet train --config-dir rigs healthy=healthy n_healthy=3" in checked.stdout
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy", "hydra.run.dir=run")
    assert trained.returncode == 0, trained.stderr
    assert "bench: 3 healthy records" in trained.stdout + trained.stderr
    found = json.loads(Path("run/commissioning.json").read_text())
    assert found["healthy"]["primary_hz"]["value"] == pytest.approx(20.0, rel=0.01)
    assert found["healthy_si"]["k_p"] == pytest.approx(2 * TRUE[0], rel=0.01)
    read = typed("evaluate", "trips=later", "run=run", "hydra.run.dir=out")
    assert read.returncode == 4, read.stderr
    (row,) = csv.DictReader(Path("out/records.csv").read_text().splitlines())
    assert float(row["k_p_low"]) < 0.7 < float(row["k_p_high"])
    assert row["verdict"] == "act"
    limits = ["monitor.limits.k_p.notice=[0.5,2]", "monitor.limits.k_p.act=[0.5,2]"]
    wide = typed("evaluate", "trips=later", "run=run", "hydra.run.dir=wide", *limits)
    assert wide.returncode == 0, wide.stderr
    again = typed("evaluate", "trips=healthy", "run=run", "hydra.run.dir=again")
    assert again.returncode == 0, again.stderr
    assert json.loads(Path("again/records.json").read_text())["records"][0]["verdict"] == "none"
    assert "no verdict" not in again.stdout + again.stderr
    tight = ["monitor.limits.c_s.notice=[0.999999,1.1]", "monitor.limits.c_s.act=[0.999999,1.1]"]
    unsure = typed("evaluate", "trips=healthy", "run=run", "hydra.run.dir=unsure", *tight)
    assert unsure.returncode == 0, unsure.stderr
    names = ", ".join(f"{path.stem}" for path in sorted(Path("healthy").glob("*.yaml")))
    words = f"no verdict, as the interval is too wide: c_s of {names}\n"
    assert words in unsure.stdout + unsure.stderr


def test_mistakes_are_one_line(folder):
    write(folder / "healthy", TRUE, [0])
    assert typed("init", "healthy", "vehicle=bench", *CHANNELS).returncode == 0
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy")
    few = "error: healthy: 1 healthy records are given, at least 3 are needed"
    assert one_line(trained) == few
    typed_words = ("train", "--config-dir", "rigs", "healthy=healthy")
    for word in ("speed_m_per_s=3", "model=msvr"):
        key = word.partition("=")[0]
        assert f"`{key}` is not for rigs: leave it out" in one_line(typed(*typed_words, word))
    assert "give --config-dir DIR" in one_line(typed("train", "healthy=healthy"))
    assert "give healthy=DIR" in one_line(typed("train", "--config-dir", "rigs", "vehicle=bench"))
    assert "`speed` is not known for a rig" in one_line(
        typed("init", "healthy", "vehicle=bench", "speed=3", "--force")
    )
    manifest = folder / "healthy" / "r0.yaml"
    text = manifest.read_text()
    manifest.write_text(text.replace("a1 [m/s2]", "a0 [m/s2]"))
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy")
    assert "the same file and column, base and frame" in one_line(trained)
    manifest.write_text(text.replace("vehicle: bench", "vehicle: other"))
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy", "vehicle=bench")
    assert "the record is of 'other', the rig is 'bench'" in one_line(trained)
    manifest.write_text(text + "mileage_km: 3\n")
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy")
    assert "mileage_km" in one_line(trained)
    vehicle = folder / "rigs" / "vehicle" / "bench.yaml"
    vehicle.write_text(FILE.replace("kind: rig", "kind: rigg"))
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy", "vehicle=bench")
    assert "`vehicle.kind` must be one of rig, or left out, got 'rigg'" in one_line(trained)
    vehicle.write_text("kind: rig\nname: bench\n")
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy", "vehicle=bench")
    assert "`vehicle.primary_hz` is missing" in one_line(trained)


def one_line(ended):
    """Return the only line of a program's errors; it has failed."""
    assert ended.returncode == 1, ended.stdout
    lines = [line for line in ended.stderr.strip().splitlines() if line.startswith("error:")]
    assert len(lines) == 1, ended.stderr
    assert "Traceback" not in ended.stderr
    return lines[0]


@pytest.mark.slow
def test_exchanged_sensors_are_named(folder):
    write(folder / "healthy", TRUE, range(3))
    swapped = (CHANNELS[0], "channels.frame=a2 [m/s2]", "channels.body=a1 [m/s2]")
    assert typed("init", "healthy", "vehicle=bench", *swapped).returncode == 0
    checked = typed("check", "healthy", "--config-dir", "rigs", "--no-pictures")
    assert checked.returncode == 1
    words = "sensors look exchanged: base, frame and body fit far better as base, body, frame"
    assert f"r0, r1, r2: {words}" in " ".join(checked.stdout.split())
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy", "hydra.run.dir=run")
    assert one_line(trained) == f"error: healthy: r0: {words}"
    assert not Path("run/rig.json").exists()


def test_records_that_show_nothing_are_one_line(folder):
    (folder / "healthy").mkdir()
    for seed in range(3):
        noise = np.random.default_rng(seed).standard_normal((4800, 4))
        noise[:, 0] = np.arange(4800) / 200.0
        header = "time [s],a0 [m/s2],a1 [m/s2],a2 [m/s2]"
        path = folder / "healthy" / f"r{seed}.csv"
        np.savetxt(path, noise, "%.9g", ",", header=header, comments="")
    assert typed("init", "healthy", "vehicle=bench", *CHANNELS).returncode == 0
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy")
    assert "healthy: r0: the record does not show k_p" in one_line(trained)


def test_trips_of_a_rig_are_named_by_a_check(folder):
    write(folder / "healthy", TRUE, [0])
    words = ("suspension=a", "side=left", "mileage_km=3", "speed=30")
    channels = [f"channels.{k}=a{i} [m/s2]" for i, k in enumerate(("axle_box", "bogie", "body"))]
    assert typed("init", "healthy", "vehicle=am96", *words, *channels).returncode == 0
    manifest = folder / "healthy" / "r0.yaml"
    manifest.write_text(manifest.read_text().replace('vehicle: "am96"', "vehicle: bench"))
    checked = typed("check", "healthy", "--config-dir", "rigs", "--no-pictures")
    assert checked.returncode == 1
    assert "the manifest is of a train's trip, its vehicle a rig" in checked.stdout


def test_channels_of_a_rig_that_is_not_found_ask_for_its_folder(folder):
    write(folder / "healthy", TRUE, [0])
    asked = typed("init", "healthy", "vehicle=other", *CHANNELS)
    assert "give --config-dir DIR, the folder with vehicle/NAME.yaml" in one_line(asked)


def test_record_without_an_estimate_harms_no_other(folder):
    write(folder / "healthy", TRUE, range(3))
    write(folder / "later", TRUE, [8])
    lost = np.random.default_rng(0).standard_normal((4800, 4))
    lost[:, 0] = np.arange(4800) / 200.0
    header = "time [s],a0 [m/s2],a1 [m/s2],a2 [m/s2]"
    np.savetxt(folder / "later" / "lost.csv", lost, "%.9g", ",", header=header, comments="")
    for name in ("healthy", "later"):
        assert typed("init", name, "vehicle=bench", *CHANNELS).returncode == 0
    trained = typed("train", "--config-dir", "rigs", "healthy=healthy", "hydra.run.dir=run")
    assert trained.returncode == 0, trained.stderr
    read = typed("evaluate", "trips=later", "run=run", "hydra.run.dir=out")
    assert read.returncode == 2, read.stderr
    rows = {
        row["record"]: row
        for row in csv.DictReader(Path("out/records.csv").read_text().splitlines())
    }
    assert rows["lost"]["status"] == "no estimate"
    assert "does not show k_p" in rows["lost"]["reason"]
    assert rows["r8"]["status"] == "ok"
