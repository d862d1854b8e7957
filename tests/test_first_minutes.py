"""What README and getting_started.md have a new user do and see: done as they say, and seen."""

import re
import shlex

import pytest
from cli_runner import ROOT, python, typed
from test_docs import README, blocks, overrides_of, python_blocks

from suspnet.cli import check, init, simulate

PAGE = ROOT / "docs" / "getting_started.md"
N_TRIPS = 2
SMALL = [f"fleet.n_trips={N_TRIPS}", "fleet.minutes=2.6", "workers=1", "progress=false"]
NUMBER = re.compile(r"-?\d+\.?\d*")
SAME_PERCENT = 5.0
"""Largest difference of printed numbers from those that README shows, [%]."""


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
    assert done.stdout.strip() == expected.replace("10", str(N_TRIPS))
    done = typed(check, "mine", "--no-pictures", cwd=tmp_path)
    assert "2 of 2 trips ready for an estimate" in done.stdout, done.stdout
    assert "2 of 2 trips ready, 30800 to 61600 km, at 70.0 m/s" in done.stdout


@pytest.mark.slow
def test_demonstration_of_readme_prints_what_stands_there(tmp_path):
    code = [code.replace("\\\n", " ") for code in blocks(README)]
    place = next(i for i, one in enumerate(code) if one.startswith("suspnet simulate"))
    commands, expected = code[place].splitlines(), code[place + 1]
    printed = ""
    for line in commands:
        start, *words = shlex.split(line)
        words = [str(ROOT / w) if w.endswith(".py") else w for w in words]
        module = ["-m", "suspnet"] if start == "suspnet" else []
        # several times as long on busy cores
        done = python(*module, *words, cwd=tmp_path, timeout=600)
        printed += done.stdout
    assert done.returncode == 4, done.stderr  # "act"
    shown = [line for line in expected.splitlines() if line.strip() not in ("", "...")]
    assert len(shown) > 10
    seen = {key_of(line): line for line in printed.splitlines()}
    for line in shown:
        found = seen[key_of(line)]
        if line.startswith("| trip_"):
            numbers, others = (list(map(float, NUMBER.findall(one))) for one in (line, found))
            assert numbers == pytest.approx(others, rel=SAME_PERCENT / 100), found


def key_of(line):
    """Return the trip of a row, else a line without its numbers and what they change: widths."""
    if trip := re.match(r"\| (trip_\d+) ", line):
        return trip[1]
    return NUMBER.sub("", re.sub(r"[\s-]+", " ", line))
