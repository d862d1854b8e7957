"""Output of the programs: no name in a file or a configuration steers the terminal."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO, cast

from suspnet.ground.storage import printable

MOVES = re.compile(r"[\r\n]*(\x1b\[A)*")
"""What progress bars write alone to move the cursor: to the start of a line, and lines up."""


class _Visible:
    """A text stream to which control characters are written as escapes, such as x1b.

    A carriage return at the start of what is written, by which a progress bar replaces its line,
    is written as it is.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text and return its length."""
        if not MOVES.fullmatch(text):
            begin = "\r" * text.startswith("\r")
            self._stream.write(begin + printable(text[len(begin) :]))
        else:
            self._stream.write(text)
        return len(text)


@contextmanager
def visible() -> Iterator[None]:
    """Write control characters in what is printed and logged as escapes."""
    out, err = (cast(TextIO, _Visible(stream)) for stream in (sys.stdout, sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        yield
