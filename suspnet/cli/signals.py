"""Signals that end a program at once, in one line, as long as nothing has begun."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

VERBS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""Verb of the line that a program prints when a signal ends it."""
SIGNALS = tuple(VERBS)
_has_ended = threading.Event()
"""Whether the program has said that a signal ends it; a further signal then says nothing."""


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
    """Make a signal end the process at once: nothing can be half done yet."""
    _has_ended.clear()
    for number in SIGNALS:
        signal.signal(number, _end)


def announce(words: str) -> None:
    """Print the line that says why a signal ends the program, once."""
    _has_ended.set()
    print(words, file=sys.stderr)


def _end(number: int, frame: object) -> None:
    if not _has_ended.is_set():
        os.write(
            sys.stderr.fileno(), f"{VERBS[signal.Signals(number)]}: nothing had begun\n".encode()
        )
    os._exit(128 + number)


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
