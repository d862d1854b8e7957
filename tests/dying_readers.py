"""Readers of data files that do what those of libraries do to damaged files; no more is imported.

The first word of the file says what happens, and the number after a colon in which block of four
samples; without one it happens when the file is opened.
"""

import ctypes
import os
import re
import signal
import sys
import time
from contextlib import contextmanager

import numpy as np

from suspnet.trains.recordings.columns import Column, OpenFile
from suspnet.trains.recordings.errors import TripError

N_BLOCKS, N_SAMPLES = 3, 4


def happen(word):
    match word:
        case "crash":
            ctypes.string_at(0)
        case "abort":
            os.abort()
        case "exit":
            os._exit(3)
        case "short of memory":
            signal.raise_signal(signal.SIGKILL)
        case "hang":
            time.sleep(600)
        case "hang inside":  # as C that never gives Python a turn
            re.match(r"(a+)+$", "a" * 60 + "b")
        case "trip":
            raise TripError("one problem", "another")
        case "error":
            raise ZeroDivisionError("division by zero")
        case "speechless":
            raise MemoryError
        case "chatter":
            os.write(1, b'{"problems": ["printed"]}\n')
            print("printed", flush=True)
            print("printed", file=sys.stderr, flush=True)


@contextmanager
def open_dying(path):
    """Open a file with the columns `t` and `a`, of twelve samples each."""
    word, _, at = path.read_text().partition(":")
    if not at:
        happen(word)

    def read(names):
        for i in range(N_BLOCKS):
            if at == str(i):
                happen(word)
            values = np.arange(N_SAMPLES * i, N_SAMPLES * (i + 1), dtype=float)
            yield tuple(values if name == "a" else values.astype("M8[ns]") for name in names)

    yield OpenFile((Column("t", is_time=True), Column("a", "g")), read, str(os.getpid()))
