"""Starts of the programs: a signal that comes while they are imported is told in one line, too."""

from __future__ import annotations

import functools
import importlib
import os
import signal
import sys


def start(name: str) -> None:
    """Import a program of this package, which takes seconds, and run it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    main = importlib.import_module(f"suspnet.cli.{name}").main
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        main()
    except KeyboardInterrupt:  # before the program listens, or after it has ended
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # the end of Python prints nothing of it


def _end(number: int, frame: object) -> None:
    """End the process at once: nothing has begun that could be left half done."""
    verb = "interrupted" if number == signal.SIGINT else "terminated"
    os.write(sys.stderr.fileno(), f"{verb}: nothing had begun\n".encode())
    os._exit(128 + number)


PROGRAMS = (
    *("train", "evaluate", "simulate", "check", "init", "history"),
    *("monitor", "replay", "serve"),
)
train, evaluate, simulate, check, init, history, monitor, replay, serve = (
    functools.partial(start, name) for name in PROGRAMS
)
