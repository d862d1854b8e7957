"""`--help` answers before what takes seconds is imported; pages are served without torch."""

import subprocess
import sys

import pytest
from cli_runner import ROOT

from suspnet.cli.start import PROGRAMS

SLOW = {"torch", "matplotlib", "sklearn", "sqlalchemy", "plotly"}
"""What takes seconds to import."""
WITHOUT_SCIPY = ("check", "history")
"""Programs whose options name what is read and written, and no number of a model."""
HELP = """
import sys
from suspnet.cli import start
sys.argv = ["{0}", "--help"]
try:
    start.start("{0}")
finally:
    print("\\nimported:", *sorted({{name.partition(".")[0] for name in sys.modules}}))
"""


@pytest.mark.parametrize("name", PROGRAMS)
def test_help_imports_nothing_slow(name, tmp_path):
    ended = subprocess.run(
        [sys.executable, "-c", HELP.format(name)],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    text, _, imported = ended.stdout.rpartition("imported:")
    assert "Usage" in text or "usage" in text
    assert not SLOW & set(imported.split())
    assert "scipy" not in imported.split() or name not in WITHOUT_SCIPY
    assert not list(tmp_path.iterdir())
