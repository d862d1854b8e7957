"""Start of the programs; a signal during their import ends them at once."""

import functools
import gc
import importlib
import os
import signal
import sys
from contextlib import suppress

from suspnet.cli.signals import end_at_once

HOME = os.path.realpath(f"{__file__}/../../..")  # folder that holds the package suspnet


def start(name: str) -> None:
    """Import what all programs share, and run one."""
    end_at_once()
    leave_current_folder()
    gc.disable()  # a third of the time that modules take to import; see `program._imported`
    program = importlib.import_module("suspnet.cli.program")
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        program.main(name)
    except KeyboardInterrupt:  # before the program listens, or after it has ended
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while Python shuts down


def leave_current_folder() -> None:
    """Import nothing from the current folder, here and in all processes that are started.

    It may hold the recordings of others. ``python -m`` puts it first on the path, and so do the
    processes of joblib and multiprocessing. It stays there if it holds suspnet itself.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    if sys.flags.safe_path:
        return
    with suppress(OSError):  # a current folder that was removed holds nothing
        first = os.path.realpath(sys.path[0])
        if first == os.path.realpath("") != HOME:
            del sys.path[0]


PROGRAMS = (
    *("train", "evaluate", "simulate", "check", "init", "history"),
    *("monitor", "replay", "serve", "demo"),
)
train, evaluate, simulate, check, init, history, monitor, replay, serve, demo = (
    functools.partial(start, name) for name in PROGRAMS
)
