"""The programs as installed from a wheel, without a checkout, run from an empty folder."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ("suspnet", "configs", "pyproject.toml", "README.md", "LICENSE")
BUILD = "from setuptools import build_meta as b; b.build_wheel('dist'); b.build_sdist('dist')"
PROGRAMS = (
    *("suspnet-train", "suspnet-evaluate", "suspnet-simulate"),
    *("suspnet-replay", "suspnet-serve"),
)
PLAIN_PROGRAMS = ("suspnet", "suspnet-check", "suspnet-init")
TINY = ["model=linear", "data.n_train=200", "data.n_test=50", "data.n_calibrate=null"]


def ran(command, cwd, expected=0, **variables):
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == expected, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the folder of a wheel and a source distribution, built without the network."""
    folder = tmp_path_factory.mktemp("build")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    ran([sys.executable, "-c", BUILD], folder)
    return folder / "dist"


@pytest.fixture(scope="module")
def program(built, tmp_path_factory):
    """Return a function that runs a program of the wheel, installed outside the checkout."""
    site = tmp_path_factory.mktemp("site")
    (wheel,) = built.glob("*.whl")
    options = ["--quiet", "--no-deps", "--no-index", "--no-compile", "--target", site]
    ran([sys.executable, "-m", "pip", "install", *options, wheel], site)

    def run(name, *arguments, **options):
        return ran([site / "bin" / name, *arguments], PYTHONPATH=str(site), **options)

    where = "import suspnet.cli.config_files as c; print(c.CONFIGS)"
    found = ran([sys.executable, "-c", where], site, PYTHONPATH=str(site))
    assert found.strip() == str(site / "suspnet" / "configs")
    return run


def test_wheel_and_source_distribution_hold_every_file(built):
    tracked = {
        path.relative_to(ROOT)
        for folder in ("suspnet", "configs")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert Path("suspnet/py.typed") in tracked
    (wheel,), (sources,) = built.glob("*.whl"), built.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        names = set(map(Path, archive.namelist()))
        (entries,) = (archive.read(str(n)).decode() for n in names if n.name == "entry_points.txt")
    assert {n for n in names if n.parts[0] == "suspnet"} == {
        path if path.parts[0] == "suspnet" else "suspnet" / path for path in tracked
    }
    assert all(f"{name} = suspnet.cli." in entries for name in (*PROGRAMS, *PLAIN_PROGRAMS))
    with tarfile.open(sources) as archive:
        packed = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    assert tracked | {Path("LICENSE")} <= packed


def test_installed_program_finds_its_configuration(program, tmp_path):
    assert "kind: msvr" in program("suspnet-train", "--cfg=job", cwd=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_installed_programs_work_from_an_empty_folder(program, tmp_path):
    for name in PROGRAMS:
        printed = program(name, "--help", cwd=tmp_path)
        assert name.replace("-", " ") in printed
        assert "Keys, set as KEY=VALUE" in printed
    assert not list(tmp_path.iterdir())
    program("suspnet-train", *TINY, "threads=1", cwd=tmp_path)
    (run,) = (tmp_path / "outputs" / "train").iterdir()
    assert "MAPE %" in (run / "train.log").read_text()
    printed = program("suspnet-evaluate", f"run={run}", "data.n_test=50", cwd=tmp_path)
    assert "| k_p " in printed
    short = ["fleet.n_trips=1", "fleet.minutes=0.5", "workers=1"]
    assert "1 trips of scenario" in program("suspnet-simulate", *short, cwd=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"outputs", "trips"}
    data = next(tmp_path.glob("trips/*/*/body.parquet"))
    asked = program("suspnet-init", data, "-o", "new.yaml", cwd=tmp_path, expected=1)
    assert "nothing is written yet; these are missing:\n  vehicle" in asked
    assert "fill in each ???" in program("suspnet-init", "--vehicle", "mine", cwd=tmp_path)
    assert "exit code" in program("suspnet-check", "--help", cwd=tmp_path)
