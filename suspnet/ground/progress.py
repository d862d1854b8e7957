"""Output of a program: bars of progress or lines in the log, and visible control characters."""

from __future__ import annotations

import logging
import math
import re
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO, cast

from tqdm import tqdm

from suspnet.ground.storage import one_line, printable

log = logging.getLogger(__name__)
MOVES = re.compile(r"[\r\n]*(\x1b\[A)*")
"""Cursor movements that progress bars write on their own: line starts and lines up."""
INTERVAL_S = 30.0
"""Time between two log lines of one step, [s]."""


def bar(
    title: str,
    total: int | None = None,
    *,
    items: Iterable[Any] | None = None,
    unit: str = "",
    shown: bool = True,
) -> Any:
    """Return a progress bar of tqdm, or a similar object that logs lines instead.

    A line is logged when the step starts and every ``INTERVAL_S``, also without progress. `unit` is
    the singular of the things counted, empty if nothing is. Unless `shown`, there is no bar and
    only the first line.
    """
    if shown and sys.stderr.isatty():
        form = None if unit else "{desc}: {elapsed}"
        return tqdm(items, title, total, unit=unit, bar_format=form)
    interval_s = INTERVAL_S if shown else math.inf
    # gui: tqdm draws nothing itself
    lines = Lines(items, title, total, unit=unit, gui=True, maxinterval=interval_s)
    if lines.total != 0:
        lines.refresh()
    return lines


def stage(text: str) -> None:
    """Log that a step starts."""
    log.info("%s", text)


class Lines(tqdm):  # type: ignore[type-arg]
    """A bar of tqdm as lines of the log, written by tqdm's monitoring thread."""

    monitor = None
    monitor_interval = 1
    counted_s = 0.0
    """When the last item was counted, after the start, [s]."""

    def __iter__(self) -> Iterator[Any]:
        """Yield the items and count each; tqdm's own loop counts only what `miniters` lets it."""
        with self:
            for item in self.iterable:
                yield item
                self.update()

    def update(self, n: float | None = 1) -> bool | None:
        """Count `n` more items."""
        if n:
            self.counted_s = self.format_dict["elapsed"]
        return super().update(n)

    def refresh(self, nolock: bool = False, lock_args: Any = None) -> None:
        """Log a line; the next one comes after `maxinterval`."""
        self.last_print_t, self.miniters = time.time(), math.inf
        log.info("%s", self.text())

    def text(self) -> str:
        """Return count, elapsed time and estimated remaining time.

        Without an item that is counted meanwhile the remaining time shrinks; once it is over, it is
        not given.
        """
        state = self.format_dict
        n, total, elapsed_s = state["n"], state["total"], state["elapsed"]
        parts = [f"{n:,} of {total:,}"] if total is not None else [f"{self.unit} {n:,}"] * (n > 0)
        parts += [_span(elapsed_s)] * (elapsed_s >= 1)
        if n and total and elapsed_s >= 1:
            # by the pace at the last item: by the time now, it would grow while one is waited for
            left_s = self.counted_s * total / n - elapsed_s
            parts += [f"about {_span(left_s)} left"] * (left_s >= 1)
        return f"{self.desc}: {', '.join(parts)}" if parts else self.desc


def _span(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


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
    own = logging.StreamHandler(sys.stderr)
    own.setFormatter(LineFormatter(f"{before}%(message)s"))
    own.addFilter(logging.Filter(log.name))
    for console in consoles:
        console.addFilter(_is_result)
    root.addHandler(own)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(own)
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
