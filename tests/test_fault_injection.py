"""Programs killed at random moments lose nothing, leave no worker, and go on to the same result."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("fault_injection.py")
NEVER = (
    *("half-written", "lost", "orphans", "tracebacks"),
    *("other exit codes", "did not go on", "other results"),
)
"""Counts that must be zero."""

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")


def injected(folder, n_kills, seed, *programs):
    """Return the counts of some kills."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(
        [sys.executable, SCRIPT, folder, str(n_kills), str(seed), *programs],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout), ended.stderr


def test_a_handful_of_kills(tmp_path):
    counts, words = injected(tmp_path, 4, 1, "sweep", "simulate alone")
    assert counts["resumed"] == 2
    assert not any(counts.get(name, 0) for name in NEVER), words


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_two_hundred_kills(tmp_path):
    programs = ["train", "sweep", "joblib", "simulate", "simulate alone", "evaluate"]
    if importlib.util.find_spec("hydra_plugins.hydra_joblib_launcher") is None:
        programs.remove("joblib")
    counts, words = injected(tmp_path, 240, 0, *programs)  # some runs end before their kill
    print(json.dumps(counts, indent=2))
    assert counts["kills"] >= 200
    assert not any(counts.get(name, 0) for name in NEVER), words
