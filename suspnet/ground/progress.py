"""Output of a program: bars of progress or lines in the log, and visible control characters."""

import functools
import logging
import math
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO, cast

from tqdm import tqdm

from suspnet.ground.storage import one_line, printable

log = logging.getLogger(__name__)
MOVES = re.compile(r"[\r\n]*(\x1b\[A)*")
"""Cursor movements that progress bars write on their own: line starts and lines up."""
INTERVAL_S = 30.0  # time between two log lines of one step, [s]


def bar(
    title: str,
    total: int | None = None,
    *,
    items: Iterable[Any] | None = None,
    unit: str = "",
    shown: bool = True,
) -> Any:
    """Return a progress bar of tqdm, on a terminal or as lines of the log.

    A line is logged when the step starts and when an item is done ``INTERVAL_S`` after the last
    line, without `shown` only at the start. `unit` is the singular of the things counted, empty if
    nothing is.
    """
    made = functools.partial(tqdm, items, title, total, unit=unit, leave=False)
    if shown and sys.stderr.isatty():
        return made(bar_format=None if unit else "{desc}: {elapsed}", dynamic_ncols=True)
    count = "{desc}: {n_fmt} of {total_fmt} [{elapsed}<{remaining}]"
    interval_s = INTERVAL_S if shown else math.inf
    return made(
        bar_format=count if total else "{desc}: {n_fmt} [{elapsed}]" if unit else "{desc}",
        file=_LogStream(),
        smoothing=0,
        mininterval=interval_s,
        maxinterval=interval_s,
        disable=total == 0,
    )


class _LogStream:
    """A text stream whose lines go to the log."""

    def write(self, text: str) -> int:
        if not MOVES.fullmatch(text) and text.strip():
            log.info("%s", text.strip().removesuffix(" [00:00<?]").removesuffix(" [00:00]"))
        return len(text)

    def flush(self) -> None:
        pass


def stage(text: str) -> None:
    """Log that a step starts."""
    log.info("%s", text)


class LineFormatter(logging.Formatter):
    """Formatter of log lines, without control characters: no name in a line forges another one.

    A record has several lines only if its format has.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name in logging
        """Return the text of a record."""
        text = super().formatMessage(record)
        return printable(text) if "\n" in str(record.msg) else one_line(text)


@contextmanager
def on_stderr(before: str = "") -> Iterator[None]:
    """Log progress to standard error instead of standard output, which is for results.

    Each line starts with `before`, for several programs that write at the same time.
    """
    root = logging.getLogger()
    consoles = [h for h in root.handlers if getattr(h, "stream", None) is sys.stdout]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter(f"{before}%(message)s"))
    handler.addFilter(logging.Filter(log.name))
    for console in consoles:
        console.addFilter(_is_result)
    root.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(handler)
        for console in consoles:
            console.removeFilter(_is_result)


def _is_result(record: logging.LogRecord) -> bool:
    return record.name != log.name


class Visible:
    """A text stream that writes control characters as escapes, such as x1b.

    A carriage return at the start of a text stays as it is: progress bars replace their line with
    it.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text and return its length."""
        if not MOVES.fullmatch(text):
            lead = "\r" * text.startswith("\r")
            self._stream.write(lead + printable(text[len(lead) :]))
        else:
            self._stream.write(text)
        return len(text)


@contextmanager
def visible() -> Iterator[None]:
    """Escape control characters in everything that is printed and logged."""
    out, err = (cast(TextIO, Visible(stream)) for stream in (sys.stdout, sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        yield
