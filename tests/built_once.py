"""What takes seconds to build, built by one of the processes that run the tests, read by all.

It lies in pytest's temporary folder of this run, so that none of another version is ever read.
"""

import fcntl
import os
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

FOLDER = "SUSPNET_TESTS_BUILT"
"""Environment variable with the folder of a run; tests/conftest.py sets it."""


def built_once(name, build):
    """Return the folder of a name, which the first process to come fills by `build(folder)`."""
    folder = Path(os.environ[FOLDER] if FOLDER in os.environ else _of_this_process(), name)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with Path(f"{folder}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder / ".built"
        if not done.exists():
            build(folder)
            done.touch()
    return folder


@cache
def _of_this_process():
    """Return a folder for benchmarks and scripts, which pytest does not run."""
    return mkdtemp(prefix="suspnet_tests_")
