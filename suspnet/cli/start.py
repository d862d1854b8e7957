"""Start of the programs; a signal during their import ends them with one line."""

from __future__ import annotations

import functools
import gc
import importlib
import signal
import sys

from suspnet.cli.signals import end_at_once


def start(name: str) -> None:
    """Import what all programs share, and run one."""
    end_at_once()
    gc.disable()  # a third of the time that modules take to import; see `program._imported`
    program = importlib.import_module("suspnet.cli.program")
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        program.main(name)
    except KeyboardInterrupt:  # before the program listens, or after it has ended
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while Python shuts down


PROGRAMS = (
    *("train", "evaluate", "simulate", "check", "init", "history"),
    *("monitor", "replay", "serve"),
)
train, evaluate, simulate, check, init, history, monitor, replay, serve = (
    functools.partial(start, name) for name in PROGRAMS
)
