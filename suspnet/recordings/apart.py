"""Readers in processes of their own: a file that crashes or hangs one costs an error, no more.

Libraries for binary formats crash on some damaged files (the MAT reader of scipy on 6 of 500), or
never return (HDF5 on 2 of 500). No exception tells of it, so a reader of such a format runs in
another process. That process is asked for one step at a time, to open a file or to read its next
block; each step has a bound in time. Requests are lines of JSON, answers too, followed by the bytes
of the arrays: nothing is unpickled.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from suspnet.recordings.checked_mapping import TripError
from suspnet.recordings.columns import Block, Column, OpenFile
from suspnet.recordings.manifest import CsvDialect

Reader = Callable[[Path, CsvDialect | None], AbstractContextManager[OpenFile]]

LIMIT = "SUSPNET_READER_S"
"""Environment variable: longest time that opening a file, or reading its next block, may take [s].

A block is 262,144 samples; only of MAT files before version 7.3 and of UFF it is a whole column."""
LIMIT_S = 300.0
"""That time where the variable is not set, [s]: a column of a gigabyte is read in half a minute."""
CRASH_S = 5.0
"""Longest time between the end of a process's answers and its own, [s]."""
DTYPES = ("float64", "datetime64[ns]")
"""Those of a block."""


def apart(reader: Reader) -> Reader:
    """Return a reader that does the same in another process.

    Parameters
    ----------
    reader : callable
        A function of a module that can be imported.

    Returns
    -------
    callable
        Raises TripError where the process is killed or takes longer than ``SUSPNET_READER_S``, and
        ValueError with the words of any other error; also where blocks are read.
    """

    @contextmanager
    @functools.wraps(reader)
    def opened(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
        with _borrowed(path) as process:
            place = {"module": reader.__module__, "function": reader.__name__}
            found, _arrays = process.ask(place | {"open": str(path)})
            columns = tuple(Column(**column) for column in found["columns"])
            numbers = itertools.count()

            def read(names: Sequence[str]) -> Iterator[Block]:
                number = next(numbers)
                while True:  # ends: with the columns of the file
                    _, block = process.ask({"block": number, "names": list(names)})
                    if not block:
                        return
                    yield block

            yield OpenFile(columns, read, found["words"], found["hint"])

    return opened


class _Process:
    """One process that reads files, one after the other."""

    def __init__(self) -> None:
        code = (
            f"import sys; sys.path[:] = {[str(place) for place in sys.path]}; "
            f"from {__name__} import serve; serve()"
        )
        self._child = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )
        self.path = Path()
        self._is_late = False
        self._pipes()[1].readline()  # it is ready: a slow start is no fault of the first file

    def ask(self, request: dict[str, Any]) -> tuple[dict[str, Any], Block]:
        """Return what the process answers: values, and arrays.

        Raises
        ------
        TripError
            As the reader's own, or if the process ends or is late: then it is gone.
        ValueError
            With the words of any other error.
        """
        if self._pipes()[0].closed:
            raise ValueError("its reader has ended")
        limit_s = _limit_s()
        timer = threading.Timer(limit_s, self._end_late)
        timer.daemon = True
        timer.start()
        try:
            answer, arrays = self._exchange(request | {"limit_s": limit_s})
        except (OSError, ValueError):  # the pipe is broken, or ended within an answer
            raise TripError(self._ending(limit_s)) from None
        except BaseException:
            self.end()
            raise
        finally:
            timer.cancel()
        if "problems" in answer:
            raise TripError(*answer["problems"])
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer, arrays

    def _exchange(self, request: dict[str, Any]) -> tuple[dict[str, Any], Block]:
        """Send a request and return the answer; OSError or ValueError if none comes."""
        requests, answers = self._pipes()
        requests.write(json.dumps(request).encode() + b"\n")
        requests.flush()
        answer = json.loads(answers.readline())
        arrays = []
        for dtype, n_samples in answer.get("arrays", []):
            array = np.empty(n_samples, dtype=DTYPES[DTYPES.index(dtype)])
            if n_samples and answers.readinto(array.view(np.uint8)) < array.nbytes:  # type: ignore[attr-defined]
                raise OSError
            arrays.append(array)
        return answer, tuple(arrays)

    def _pipes(self) -> tuple[IO[bytes], IO[bytes]]:
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        return self._child.stdin, self._child.stdout

    def _end_late(self) -> None:
        """End the process because it takes too long."""
        self._is_late = True
        self._child.kill()

    def _ending(self, limit_s: float) -> str:
        """Return in words why the process has ended; a file that is late is not tried again."""
        code = self.end(CRASH_S)
        if self._is_late or code == -getattr(signal, "SIGALRM", 0):
            words = (
                f"{self.path}: its reader took longer than {limit_s:g} s for one step, so the file "
                f"is damaged, or very slow to read (the variable {LIMIT} gives more time)"
            )
            with suppress(OSError):
                _late[_state(self.path)] = words
            return words
        how = f"exit code {code}"
        if code < 0:
            with suppress(ValueError):
                how = signal.Signals(-code).name
        short = ", or there was too little memory" if code == -getattr(signal, "SIGKILL", 9) else ""
        return f"{self.path}: its reader crashed ({how}), so the file is damaged{short}"

    @property
    def is_alive(self) -> bool:
        """Whether it can be asked."""
        return self._child.poll() is None

    def end(self, grace_s: float = 0.0) -> int:
        """End the process if it does not end by itself in some time; return its exit code."""
        with suppress(subprocess.TimeoutExpired):
            self._child.wait(grace_s)
        self._child.kill()
        for pipe in self._pipes():
            with suppress(OSError):
                pipe.close()
        return self._child.wait()


_idle: dict[int, list[_Process]] = {}
"""Processes that wait for a file, by the process that started them: a fork has none."""
_late: dict[tuple[str, int, int], str] = {}
"""Files whose readers took too long, by path, size and time of change, and the words of it."""
_lock = threading.Lock()


@contextmanager
def _borrowed(path: Path) -> Iterator[_Process]:
    """Give a process that is to read a file; it is kept for the next one unless it has ended."""
    words = _late.get(_state(path))
    if words is not None:
        raise TripError(words)
    with _lock:
        idle = _idle.setdefault(os.getpid(), [])
        while idle and not idle[-1].is_alive:
            idle.pop().end()
        process = idle.pop() if idle else _Process()
    process.path = path
    try:
        yield process
    finally:
        with suppress(ValueError):  # all was read; a process that has ended is replaced
            process.ask({"close": True})
        with _lock:
            if process.is_alive:
                idle.append(process)
            else:
                process.end()


@atexit.register
def end_all() -> None:
    """End the processes that wait for a file."""
    with _lock:
        for process in _idle.pop(os.getpid(), []):
            process.end()


def _state(path: Path) -> tuple[str, int, int]:
    """Return what tells whether a file has changed."""
    found = path.stat()
    return str(path), found.st_size, found.st_mtime_ns


def _limit_s() -> float:
    """Return the longest time of one step, [s]; TripError if the variable is no such time."""
    text = os.environ.get(LIMIT, "")
    if not text:
        return LIMIT_S
    with suppress(ValueError):
        if 0 < float(text) <= threading.TIMEOUT_MAX:
            return float(text)
    raise TripError(f"the environment variable {LIMIT} must be a time in seconds, got {text!r}")


# in the other process


def serve() -> None:
    """Answer requests until there are no more; what libraries print goes nowhere."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that asks hears it
    requests = sys.stdin.buffer
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with os.fdopen(os.dup(1), "wb") as answers, suppress(BrokenPipeError):
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        answers.write(b"\n")
        answers.flush()
        for answer, arrays in _answers(requests):
            _bound(0)
            kinds = [[str(array.dtype), len(array)] for array in arrays]
            answers.write(json.dumps(answer | {"arrays": kinds}).encode() + b"\n")
            for array in arrays:
                answers.write(np.ascontiguousarray(array).view(np.uint8).data)
            answers.flush()


def _answers(requests: IO[bytes]) -> Iterator[tuple[dict[str, Any], Block]]:
    """Yield the answer to each request."""
    with ExitStack() as stack:
        file, blocks = OpenFile((), lambda _: iter(())), dict[int, Iterator[Block]]()
        for line in requests:
            request = json.loads(line)
            _bound(request["limit_s"])
            answer: dict[str, Any] = {}
            arrays: Block = ()
            try:
                if "block" in request:
                    number = request["block"]
                    if number not in blocks:
                        blocks[number] = iter(file.read(request["names"]))
                    arrays = next(blocks[number], ())
                else:
                    blocks.clear()
                    file = OpenFile((), lambda _: iter(()))
                    stack.close()
                if "open" in request:
                    read = getattr(importlib.import_module(request["module"]), request["function"])
                    file = stack.enter_context(read(Path(request["open"]), None))
                    columns = [asdict(column) for column in file.columns]
                    answer = {"columns": columns, "words": file.words, "hint": file.hint}
            except TripError as error:
                answer = {"problems": error.problems}
            except Exception as error:  # whatever a library raises on a damaged file
                answer = {"error": str(error) or type(error).__name__}
            yield answer, arrays


def _bound(limit_s: float) -> None:
    """Let the system end this process after some time; 0 takes that back.

    The process that asks does so too, but it may be gone by then.
    """
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, min(limit_s, 1e8))
