"""Signals that end a program: at once as long as nothing has begun, later in one line."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

VERBS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""Verb of the line that a program prints when a signal ends it."""
SIGNALS = tuple(VERBS)


def until_it_listens() -> AbstractContextManager[None]:
    """Let a signal end the process at once, unless other threads or programs handle signals."""
    return _handled_by(signal.SIG_DFL, *SIGNALS)


def end_at_once() -> None:
    """Make a signal end the process at once and without a word: nothing can be half done yet."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)


class Terminated(BaseException):
    """SIGTERM was received."""


def terminable() -> AbstractContextManager[None]:
    """Make SIGTERM unwind the program as Ctrl-C does; a second one ends it at once."""

    def terminate(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise Terminated

    return _handled_by(terminate, signal.SIGTERM)


@contextmanager
def _handled_by(handler: Any, *numbers: signal.Signals) -> Iterator[None]:
    """Let `handler` take some signals, unless this is not the main thread, which alone can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


def output_ended() -> int:
    """Silence standard output, whose reader has ended; return the exit code of SIGPIPE."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141
