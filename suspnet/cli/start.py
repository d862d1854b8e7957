"""Starts of the programs: a signal that comes while they are imported ends them in one line."""

from __future__ import annotations

import functools
import importlib
import os
import signal
import sys

VERBS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""What the line of a program says that ends by a signal."""
SIGNALS = tuple(VERBS)


def start(name: str) -> None:
    """Import a program of this package, which takes seconds, and run it."""
    end_at_once()
    main = importlib.import_module(f"suspnet.cli.{name}").main
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        main()
    except KeyboardInterrupt:  # before the program listens, or after it has ended
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # the end of Python prints nothing of it


def end_at_once() -> None:
    """Let a signal end the process at once from here on: nothing can be left half done."""
    for number in SIGNALS:
        signal.signal(number, _end)


def _end(number: int, frame: object) -> None:
    """End the process at once."""
    os.write(sys.stderr.fileno(), f"{VERBS[signal.Signals(number)]}: nothing had begun\n".encode())
    os._exit(128 + number)


PROGRAMS = (
    *("train", "evaluate", "simulate", "check", "init", "history"),
    *("monitor", "replay", "serve"),
)
train, evaluate, simulate, check, init, history, monitor, replay, serve = (
    functools.partial(start, name) for name in PROGRAMS
)
