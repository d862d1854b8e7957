"""`--help` answers before what takes seconds is imported; pages are served without torch."""

import json
import subprocess
import sys

import pytest
from cli_runner import ROOT

from suspnet.cli.start import PROGRAMS

SLOW = {"torch", "matplotlib", "sklearn", "sqlalchemy"}
"""What takes seconds to import."""
WITHOUT_SCIPY = ("check", "history")
"""Programs whose options name what is read and written, and no number of a model."""
QUICK = ("check", "train")
"""A program with options and one with a configuration."""
HELP = """
import importlib, json, os, pathlib, sys
from suspnet.cli import start
importlib.import_module("suspnet.cli.program")  # all import it: then a process of each is forked
for name in json.loads(sys.argv[1]):
    if not (child := os.fork()):
        sys.stdout = open(f"{name}.out", "w")
        sys.argv = [name, "--help"]
        try:
            start.start(name)
        finally:
            sys.stdout.close()
            imported = {name.partition(".")[0] for name in sys.modules}
            pathlib.Path(f"{name}.json").write_text(json.dumps([*imported]))
    elif os.waitpid(child, 0)[1]:
        sys.exit(f"{name} has failed")
"""


def helped(folder, names):
    """Write the help of each program into a folder, and what it imports."""
    ended = subprocess.run(
        [sys.executable, "-c", HELP, json.dumps(names)],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("names", [QUICK, pytest.param(PROGRAMS, marks=pytest.mark.slow)])
def test_help_writes_nothing_and_imports_nothing_slow(names, tmp_path):
    helped(tmp_path, names)
    ours = {f"{name}.{kind}" for name in names for kind in ("out", "json")}
    assert {path.name for path in tmp_path.iterdir()} == ours
    for name in names:
        text = (tmp_path / f"{name}.out").read_text()
        imported = json.loads((tmp_path / f"{name}.json").read_text())
        assert "Usage" in text or "usage" in text
        assert not SLOW & set(imported)
        assert "scipy" not in imported or name not in WITHOUT_SCIPY
