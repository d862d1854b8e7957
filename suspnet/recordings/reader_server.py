"""Server side of `reader_process`: it forks a confined process for each file."""

from __future__ import annotations

import importlib
import json
import mmap
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from suspnet.recordings.columns import SHARED_BYTES, Block, OpenFile, Reader
from suspnet.recordings.confinement import confine
from suspnet.recordings.manifest_keys import TripError

MEMORY_WORDS = (
    "reading it takes more memory than a recording of its size does, so the file is damaged or "
    "declares more than it holds; export the recording again"
)


def serve() -> None:
    """Fork a process for each file; output of libraries is discarded."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the client handles it
    control = socket.socket(fileno=os.dup(0))
    control.send(b"1")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 2):
        os.dup2(nowhere, stream)
    with suppress(BrokenPipeError, ConnectionResetError):
        while True:  # ends with the client
            message, handles, _, _ = socket.recv_fds(control, 2**16, 3)
            if not message:
                return
            request = json.loads(message)
            if "end" in request:
                number = _end(request["end"], request["grace_s"])
            else:
                number = _forked(request, handles, control)
            for handle in handles:
                os.close(handle)
            control.send(str(number).encode())


def _forked(request: dict[str, Any], handles: Sequence[int], control: socket.socket) -> int:
    module, name = request["function"]
    reader = getattr(importlib.import_module(module), name)
    if request["library"] is not None:
        with suppress(Exception):  # the reader reports what is wrong with it
            importlib.import_module(request["library"])
    pid = os.fork()
    if pid == 0:
        try:
            control.close()
            file, connection, memory = handles
            shared = mmap.mmap(memory, SHARED_BYTES)
            os.chdir(request["folder"])  # names in messages may be relative to it
            confine(file, Path(request["path"]), request["memory_bytes"])
            _serve_file(reader, Path(request["path"]), connection, shared)
        finally:
            os._exit(0 if sys.exc_info()[0] is None else 1)
    return pid


def _end(pid: int, grace_s: float) -> int:
    """Wait up to `grace_s` for a process to exit, kill it otherwise; return its exit code."""
    last = time.monotonic() + grace_s
    with suppress(ChildProcessError):  # it belongs to another server, from before a fork
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            if time.monotonic() >= last:
                os.kill(pid, signal.SIGKILL)
                ended = os.waitpid(pid, 0)
                break
            time.sleep(0.001)
        return os.waitstatus_to_exitcode(ended[1])
    return -signal.SIGKILL


def _serve_file(reader: Reader, path: Path, connection: int, shared: mmap.mmap) -> None:
    with (
        os.fdopen(connection, "rb", closefd=False) as requests,
        os.fdopen(connection, "wb", closefd=False) as answers,
        suppress(BrokenPipeError, ConnectionResetError),
    ):
        for answer, arrays in _answers(reader, path, requests):
            signal.setitimer(signal.ITIMER_REAL, 0)
            kinds, place = [], 0
            for array in arrays:
                kinds.append([str(array.dtype), len(array)])
                np.frombuffer(shared, array.dtype, len(array), place)[:] = array
                place += array.nbytes
            answers.write(json.dumps(answer | {"arrays": kinds}).encode() + b"\n")
            answers.flush()


def _answers(
    reader: Reader, path: Path, requests: IO[bytes]
) -> Iterator[tuple[dict[str, Any], Block]]:
    with ExitStack() as stack:
        file, blocks = OpenFile((), lambda _: iter(())), dict[int, Iterator[Block]]()
        for line in requests:
            request = json.loads(line)
            # The client limits the time of a step, too, but may have ended by then.
            signal.setitimer(signal.ITIMER_REAL, min(request["limit_s"], 1e8))
            answer: dict[str, Any] = {}
            arrays: Block = ()
            try:
                if "open" in request:
                    file = stack.enter_context(reader(path, None))
                    columns = [asdict(column) for column in file.columns]
                    answer = {"columns": columns, "words": file.words, "hint": file.hint}
                else:
                    number = request["block"]
                    if number not in blocks:
                        blocks[number] = _pieces(file.read(request["names"]))
                    arrays = next(blocks[number], ())
            except TripError as error:
                answer = {"problems": error.problems}
            except MemoryError:
                answer = {"problems": [f"{path}: {MEMORY_WORDS}"]}
            except Exception as error:  # whatever a library raises on a damaged file
                answer = {"error": str(error) or type(error).__name__}
            yield answer, arrays


def _pieces(blocks: Iterator[Block]) -> Iterator[Block]:
    """Yield blocks cut so that they fit in the shared memory."""
    for block in blocks:
        most = max(SHARED_BYTES // 8 // max(len(block), 1), 1)
        for start in range(0, len(block[0]), most):
            yield tuple(array[start : start + most] for array in block)
