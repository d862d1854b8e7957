"""Readers in separate processes: a file that crashes or hangs its reader only causes an error.

Libraries for binary formats crash on some damaged files, or never return, and some execute what a
file contains: run a formula, read other files. Each file is therefore read in a separate process
that can do nothing else (`reader_server`). It opens the file or reads the next block on request;
each of these steps has a time limit. The processes are forked from a server that has imported the
libraries. Requests and answers are lines of JSON; the bytes of arrays follow an answer. Nothing is
unpickled.
"""

import atexit
import functools
import itertools
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, at, restored, together
from suspnet.ground.storage import open_plain, stored_bytes
from suspnet.trains.recordings import columns
from suspnet.trains.recordings.errors import TripError

log = logging.getLogger(__name__)
LIMIT = "SUSPNET_READER_S"
"""Environment variable: longest time to open a file or to read its next block, [s].

A block has 262,144 samples, but is a whole column in UFF files and MAT files before version 7.3."""
CRASH_S = 5.0  # longest time a process may take to exit after it has closed its connection, [s]
DTYPES = ("float64", "datetime64[ns]")  # types of the arrays of a block
PASSED = re.compile(
    r"PATH|HOME|TMPDIR|TZ|LANG|LANGUAGE|LD_LIBRARY_PATH|HDF5_USE_FILE_LOCKING|\w+_NUM_THREADS"
    r"|(LC|PYTHON|MKL|NPY|MALLOC)_?\w+"
)
"""Environment variables that reader processes get: none with a secret."""
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "NUMEXPR_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
"""Environment variables of reader processes, in addition; HDF5 then loads no filter plug-ins."""

SERVER_CODE = "from suspnet.trains.recordings.reader_server import serve; serve()"


def in_own_process(reader: columns.Reader, library: str | None = None) -> columns.Reader:
    """Return a reader that runs `reader`, an importable function, in a separate process.

    The server imports `library` in advance. Opening and reading raise TripError if the process
    crashes or takes longer than ``SUSPNET_READER_S``, and ValueError with the text of other errors.
    """

    @contextmanager
    @functools.wraps(reader)
    def opened(path: Path) -> Iterator[columns.OpenFile]:
        process = _Process(path, [reader.__module__, reader.__name__], library)
        try:
            description, _ = process.ask({"open": True})
            if description["missing"]:
                _warn_once(together(description["missing"]))
            numbers = itertools.count()  # several blocks of one file may be read by turns

            def read(names: Sequence[str]) -> Iterator[columns.Block]:
                number = next(numbers)
                while True:  # ends with the columns of the file
                    _, block = process.ask({"block": number, "names": list(names)})
                    if not block:
                        return
                    yield block

            yield columns.OpenFile(
                columns=tuple(
                    columns.Column(**column | {"unread": restored(column["unread"])})
                    for column in description["columns"]
                ),
                read=read,
                words=restored(description["words"]),
                notes=tuple(description["notes"]),
            )
        finally:
            process.end()

    return opened


@functools.cache
def _warn_once(missing: str) -> None:
    log.warning("%s", Finding("readers-unconfined", missing=missing))


class _Server:
    def __init__(self) -> None:
        path = f"import sys; sys.path[:] = {[str(folder) for folder in sys.path]}; "
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._child = subprocess.Popen(
                [sys.executable, "-c", path + SERVER_CODE],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                env={k: v for k, v in os.environ.items() if PASSED.fullmatch(k)} | ENVIRONMENT,
            )
        self._control.recv(1)  # wait until ready: a slow start must not count for the first file

    def ask(self, request: dict[str, Any], handles: Sequence[int] = ()) -> int:
        """Return the number that the server answers; OSError or ValueError if it has ended."""
        socket.send_fds(self._control, [json.dumps(request).encode()], handles)
        return int(self._control.recv(64))

    def end(self) -> None:
        """Kill the server."""
        self._control.close()
        self._child.kill()
        self._child.wait()


_servers: dict[int, _Server] = {}
"""Server of each process by its id: a fork must not use that of its parent."""
_late: dict[tuple[str, int, int], str] = {}
"""Messages on files whose readers took too long, by path, size and time of change."""
_lock = threading.Lock()


def _started(request: dict[str, Any], handles: Sequence[int]) -> int:
    with _lock:
        if (server := _servers.get(os.getpid())) is not None:
            with suppress(OSError, ValueError):
                return server.ask(request, handles)
            server.end()
        _servers[os.getpid()] = _Server()
        return _servers[os.getpid()].ask(request, handles)


def _ended(request: dict[str, Any]) -> int:
    """End a reader process and return its exit code; SIGKILL if its server has ended."""
    with _lock, suppress(OSError, ValueError, KeyError):
        return _servers[os.getpid()].ask(request)
    return -signal.SIGKILL


@atexit.register
def end_all() -> None:
    """End the server of this process and with it all readers."""
    with _lock:
        if (server := _servers.pop(os.getpid(), None)) is not None:
            server.end()


class _Process:
    def __init__(self, path: Path, function: Sequence[str], library: str | None) -> None:
        self.path = path
        self._is_late = False
        if (late := _late.get(_state(path))) is not None:
            raise TripError(late)
        ours, theirs = socket.socketpair()
        with ours, theirs, open_plain(path) as stream:
            n_bytes = stored_bytes(stream)
            self._limit_s = _limit_s(n_bytes)
            request = {
                "path": str(path),
                "folder": os.getcwd(),
                "function": list(function),
                "library": library,
                "memory_bytes": columns.memory_bytes(n_bytes),
            }
            self._pid = _started(request, [stream.fileno(), theirs.fileno()])
            self._requests, self._answers = ours.makefile("wb"), ours.makefile("rb")

    def ask(self, request: dict[str, Any]) -> tuple[dict[str, Any], columns.Block]:
        """Return the answer of the process: values and arrays.

        Raises the reader's TripError, or one if the process crashes or is late, which ends it;
        other errors are raised as ValueError.
        """
        if self._requests.closed:
            raise ValueError("its reader has ended")
        timer = threading.Timer(self._limit_s, self._end_late)
        timer.daemon = True
        timer.start()
        try:
            answer, arrays = self._exchange(request | {"limit_s": self._limit_s})
        except (OSError, ValueError):  # the connection is broken, or ended within an answer
            raise TripError(self._ending()) from None
        except BaseException:
            self.end()
            raise
        finally:
            timer.cancel()
        if "problems" in answer:
            raise TripError(*map(restored, answer["problems"]))
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer, arrays

    def _exchange(self, request: dict[str, Any]) -> tuple[dict[str, Any], columns.Block]:
        self._requests.write(json.dumps(request).encode() + b"\n")
        self._requests.flush()
        answer = json.loads(self._answers.readline())
        # a reader is not trusted: it must not make this process take more memory than a block
        if 8 * sum(abs(n_samples) for _, n_samples in answer["arrays"]) > columns.MOST_BLOCK_BYTES:
            raise ValueError
        arrays = []
        for dtype, n_samples in answer["arrays"]:
            array = np.empty(n_samples, DTYPES[DTYPES.index(dtype)])
            if self._answers.readinto(array.view(np.uint8).data) != array.nbytes:
                raise ValueError
            arrays.append(array)
        return answer, tuple(arrays)

    def _end_late(self) -> None:
        self._is_late = True
        with suppress(ProcessLookupError):  # it has just ended by itself
            os.kill(self._pid, signal.SIGKILL)

    def _ending(self) -> str:
        code = self.end(CRASH_S)
        if self._is_late or code == -signal.SIGALRM:
            late = at(self.path, "reader-late", limit_s=self._limit_s, variable=LIMIT)
            with suppress(OSError):
                _late[_state(self.path)] = late
            return late
        how: str = Finding("exit-code", code=code)
        if code < 0:
            with suppress(ValueError):
                how = signal.Signals(-code).name
        kind = "reader-killed" if code == -signal.SIGKILL else "reader-crashed"
        return at(self.path, kind, how=how)

    def end(self, grace_s: float = 0.0) -> int:
        """Wait up to `grace_s` for the process to exit, kill it otherwise; return its exit code."""
        if self._requests.closed:
            return 0
        for stream in (self._requests, self._answers):
            with suppress(OSError):
                stream.close()
        return _ended({"end": self._pid, "grace_s": grace_s})


def _state(path: Path) -> tuple[str, int, int]:
    stat = path.stat()
    return str(path), stat.st_size, stat.st_mtime_ns


def _limit_s(n_bytes: int) -> float:
    text = os.environ.get(LIMIT, "")
    if not text:
        return columns.step_s(n_bytes)
    with suppress(ValueError):
        if 0 < float(text) <= threading.TIMEOUT_MAX:
            return float(text)
    raise TripError(Finding("reader-variable", variable=LIMIT, got=repr(text)))
