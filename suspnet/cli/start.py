"""Start of the programs: a signal that comes while they are imported ends them in one line."""

from __future__ import annotations

import functools
import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

VERBS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""What the line of a program says that ends by a signal."""
SIGNALS = tuple(VERBS)


def start(name: str) -> None:
    """Import what all programs share, and run one of them."""
    end_at_once()
    program = importlib.import_module("suspnet.cli.program")
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        program.main(name)
    except KeyboardInterrupt:  # before the program listens, or after it has ended
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # the end of Python prints nothing of it


@contextmanager
def until_it_listens() -> Iterator[None]:
    """Let a signal end the process at once, but where other threads or programs handle signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    end_at_once()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end_at_once() -> None:
    """Let a signal end the process at once from here on: nothing can be left half done."""
    for number in SIGNALS:
        signal.signal(number, _end)


def _end(number: int, frame: object) -> None:
    os.write(sys.stderr.fileno(), f"{VERBS[signal.Signals(number)]}: nothing had begun\n".encode())
    os._exit(128 + number)


PROGRAMS = (
    *("train", "evaluate", "simulate", "check", "init", "history"),
    *("monitor", "replay", "serve"),
)
train, evaluate, simulate, check, init, history, monitor, replay, serve = (
    functools.partial(start, name) for name in PROGRAMS
)
