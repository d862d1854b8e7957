"""Programs killed at random moments lose nothing, leave no worker, and go on to the same result."""

import importlib.util
import json
from pathlib import Path

import pytest
from forked import run_apart

from benchmarks import fault_injection

NEVER = (
    *("half-written", "lost", "orphans", "tracebacks"),
    *("other exit codes", "did not go on", "other results"),
)
"""Counts that must be zero."""

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")


def injected(folder, n_kills, seed, *programs):
    """Return the counts of some kills."""
    with run_apart(fault_injection.main, folder, n_kills, seed, programs) as (process, out, err):
        process.join()
        assert process.exitcode == 0, err.read_text()
        return json.loads(out.read_text()), err.read_text()


def test_one_kill(tmp_path):
    """Of a training: test_going_on.py takes away what one had not done yet.

    Seed 8 kills after a third of the time of a whole run, which on a machine that others use is up
    to twice that of the next.
    """
    counts, words = injected(tmp_path, 1, 8, "simulate alone")
    assert counts["kills"] == counts["resumed"] == 1
    assert not any(counts.get(name, 0) for name in NEVER), words


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_two_hundred_kills(tmp_path):
    programs = ["train", "sweep", "joblib", "simulate", "simulate alone", "evaluate"]
    name = "hydra_plugins.hydra_joblib_launcher"  # without any plugin there is no such namespace
    if not (importlib.util.find_spec("hydra_plugins") and importlib.util.find_spec(name)):
        programs.remove("joblib")
    counts, words = injected(tmp_path, 240, 0, *programs)  # some runs end before their kill
    print(json.dumps(counts, indent=2))
    assert counts["kills"] >= 200
    assert not any(counts.get(name, 0) for name in NEVER), words
