"""Signals that end a program: at once as long as nothing has begun, later in one line."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

VERBS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""Verb of the line that a program prints when a signal ends it."""
SIGNALS = tuple(VERBS)


@contextmanager
def until_it_listens() -> Iterator[None]:
    """Let a signal end the process at once, unless other threads or programs handle signals."""
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
    """Make a signal end the process at once and without a word: nothing can be half done yet."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)


class Terminated(BaseException):
    """SIGTERM was received."""


@contextmanager
def terminable() -> Iterator[None]:
    """Make SIGTERM unwind the program as Ctrl-C does; a second one ends it at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def terminate(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise Terminated

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
