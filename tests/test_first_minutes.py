"""What README and getting_started.md have a new user do and see: done as they say, and seen."""

import shlex
import subprocess
import sys

import pytest
from cli_runner import ROOT, python, typed
from hydra import compose, initialize_config_dir
from test_docs import README, blocks, overrides_of, python_blocks

from suspnet.cli import check, demo, init, simulate
from suspnet.cli.config_files import CONFIGS

PAGE = ROOT / "docs" / "getting_started.md"
SMALL = ["fleet.n_trips=1", "fleet.minutes=3.2", "workers=1", "progress=false"]


def test_three_csv_files_become_trips_that_are_ready(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shell = [code.replace("\\\n", " ") for code in blocks(PAGE)]
    line = next(code for code in shell if code.startswith("suspnet simulate"))
    done = typed(simulate, *overrides_of(line)[1], *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (write,) = (code for code in python_blocks(PAGE) if '"mine"' in code)
    exec(compile(write, "write", "exec"), {})
    files = sorted((tmp_path / "mine" / "trip_001").glob("*.csv"))
    assert [file.name for file in files] == ["axle_box.csv", "body.csv", "bogie.csv"]
    line = next(code for code in shell if code.startswith("suspnet init mine vehicle="))
    done = typed(init, *shlex.split(line)[2:], cwd=tmp_path)
    expected = next(code for code in shell if code.startswith("-> mine"))
    expected = expected.replace("10 manifests of 10 trips", "1 manifest of 1 trip")
    assert done.stdout.strip() == expected.replace("(10)", "(1)")
    done = typed(check, "mine", "--no-pictures", cwd=tmp_path)
    assert "1 of 1 trip ready for an estimate" in done.stdout, done.stdout
    assert "1 of 1 trip ready, 30800 km, at 70.0 m/s" in done.stdout


@pytest.mark.slow
def test_demonstration_prints_what_stands_in_readme(tmp_path):
    code = blocks(README)
    place = next(i for i, one in enumerate(code) if "suspnet demo" in one)
    done = python("-m", "suspnet", "demo", cwd=tmp_path, timeout=1200)  # busy cores
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines() == code[place + 1].strip().splitlines()
    assert (tmp_path / "demo" / "report" / "report.html").is_file()


PROGRAM = """
import sys
print("| trip_008 |", "simulated: Act", "  act c_p", "-> somewhere", sep="\\n")
sys.exit({"simulate": 0, "train": CODE, "evaluate": 4}[sys.argv[3]])
"""


@pytest.mark.parametrize("code", [0, 1])
def test_demonstration_runs_three_programs_and_prints_the_verdict(
    code, tmp_path, monkeypatch, capsys
):
    asked = []

    def run(words, **options):
        asked.append(words[3])
        program = [sys.executable, "-c", PROGRAM.replace("CODE", str(code)), *words[1:]]
        return subprocess.CompletedProcess(*started(program, **options))

    def started(words, **options):
        done = original(words, **options)
        return words, done.returncode, done.stdout, done.stderr or "error: no trips\n" * code

    original = subprocess.run
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo.subprocess, "run", run)
    if code:
        with pytest.raises(ValueError, match="learn the train on its first 4 trips: no trips"):
            demo.demo(None)
        assert asked == ["simulate", "train"]
        return
    assert demo.demo(None) == 0
    assert asked == ["simulate", "train", "evaluate"]
    verdict = "simulated: Act\n  act c_p\n-> demo/report/report.html\n"
    assert capsys.readouterr().out == verdict


def test_steps_of_the_demonstration_are_commands():
    for program, *words in demo.STEPS.values():
        with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
            compose(program, [word for word in words if not word.startswith("hydra.")])
