"""Code in the current folder is not run, by a program or by a process that it starts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from suspnet.cli.start import PROGRAMS

PLANTED = (
    *("joblib", "multiprocessing", "numpy", "torch", "pickle", "hydra", "hydra_plugins"),
    "suspnet",
)
PROBE = """
import multiprocessing, subprocess, sys
from suspnet.cli.start import leave_current_folder
from suspnet.ground.workers import fork_from_server, guarded

if __name__ == "__main__":
    leave_current_folder()
    with guarded(2) as executor:
        executor.submit(len, "loky").result()
    process = multiprocessing.get_context("spawn").Process(target=print, args=("spawn",))
    process.start()
    process.join()
    fork_from_server("json", 2)
    with guarded(2) as executor:
        executor.submit(len, "forkserver").result()
    subprocess.run([sys.executable, "-c", "import joblib, numpy"], check=True)
"""
"""Starts a process in each of the ways in which programs do."""


def planted(folder, names):
    """Make a folder with packages that leave a file behind if they are imported."""
    folder.mkdir()
    for name in names:
        file = folder / name / "__init__.py"
        file.parent.mkdir()
        file.write_text(f"open({str(folder.parent / 'executed')!r}, 'a').write('{name} ')\n")
    return folder


def ran(arguments, cwd):
    """Run a program in a folder; assert that nothing of that folder was executed."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        arguments,
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    marker = cwd.parent / "executed"
    assert not marker.exists(), marker.read_text()
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.representatives(1)
@pytest.mark.parametrize("start", ["script", "module"])
@pytest.mark.parametrize("program", PROGRAMS)
def test_no_program_imports_from_the_current_folder(program, start, tmp_path):
    # with `python -m suspnet` the user asks for what the folder holds of that name
    cwd = planted(tmp_path / "recordings", PLANTED[: None if start == "script" else -1])
    script = [Path(sys.executable).with_name("suspnet")]
    started = script if start == "script" else [sys.executable, "-m", "suspnet"]
    assert program in ran([*started, program, "--help"], cwd)


def test_no_process_that_a_program_starts_imports_from_the_current_folder(tmp_path):
    cwd = planted(tmp_path / "recordings", PLANTED)
    (tmp_path / "probe.py").write_text(PROBE)
    assert "spawn" in ran([sys.executable, tmp_path / "probe.py"], cwd)
