"""Processes forked from a server that has imported the programs, which takes each one seconds.

No thread, lock or open file of this process is copied into them, as a fork of it would do.
"""

import multiprocessing
import multiprocessing.process
import os
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

from suspnet.cli.start import start

IMPORTED = (
    *("suspnet.cli.replay", "suspnet.cli.serve", "suspnet.cli.simulate"),
    "suspnet.trains.jobs.fleet",
)
"""What the server imports once, for the processes of the tests that are not slow."""


def forks():
    """Return the context of processes that the server forks."""
    multiprocessing.set_forkserver_preload([*IMPORTED])
    return multiprocessing.get_context("forkserver")


def started(module, *arguments, cwd, **variables):
    """Do as `run_apart` does with a program, as if typed in the folder `cwd`."""
    name = module.__name__.rpartition(".")[2]
    return run_apart(as_typed, name, [*map(str, arguments)], cwd, variables)


@contextmanager
def run_apart(function, *arguments):
    """Start a function of a module in a process of its own.

    Yields
    ------
    Process, Path, Path
        The process and the files of its standard output and its errors. It is killed at the end.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder, "out"), Path(folder, "err")
        for file in files:
            file.touch()
        process = forks().Process(target=_begin, args=(files, function, arguments))
        process.start()
        try:
            yield process, *files
        finally:
            process.kill()
            process.join()


def _begin(files, function, arguments):
    """Call a function whose output goes to files."""
    multiprocessing.process._parent_process = None  # it is no worker: see suspnet.ground.workers
    for number, file in enumerate(files, start=1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_APPEND), number)
    try:
        function(*arguments)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def as_typed(name, arguments, cwd, variables):
    """Run a program, which hears signals as its start lets it."""
    os.chdir(cwd)
    os.environ.update(variables)
    sys.argv = [f"{name}.py", *arguments]
    start(name)
