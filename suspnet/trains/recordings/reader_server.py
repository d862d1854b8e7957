"""Server side of `reader_process`: it forks a confined process for each file.

A confined process only reads its file: no writing, no programs, no connections. The protections
are independent, as not every system has all of them: resource limits (POSIX), Landlock (Linux from
5.13 on), and an audit hook in Python.
"""

import ctypes
import importlib
import json
import os
import resource
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from suspnet.ground.findings import Finding, of, stored
from suspnet.trains.recordings.columns import MOST_BLOCK_BYTES, Block, OpenFile, Reader
from suspnet.trains.recordings.dates import short_lines
from suspnet.trains.recordings.errors import TripError

MOST_NOTES = 1000
"""Largest number of lines in which a logger describes a recording; the rest is ignored."""
NO_MEMORY = Finding("takes-too-much-memory")


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
            message, handles, _, _ = socket.recv_fds(control, 2**16, 2)
            if not message:
                return
            request = json.loads(message)
            if "end" in request:
                number = _end(request["end"], request["grace_s"])
            else:
                number = _fork(request, handles, control)
            for handle in handles:
                os.close(handle)
            control.send(str(number).encode())


def _fork(request: dict[str, Any], handles: Sequence[int], control: socket.socket) -> int:
    # import in the server, so that each process need not do it again
    module, name = request["function"]
    reader = getattr(importlib.import_module(module), name)
    if request["library"] is not None:
        with suppress(Exception):  # the reader reports what is wrong with it
            importlib.import_module(request["library"])
    pid = os.fork()
    if pid == 0:
        try:
            control.close()
            file, connection = handles
            os.chdir(request["folder"])  # names in messages may be relative to it
            path = Path(request["path"])
            missing = confine(file, path, request["memory_bytes"])
            _serve_file(reader, path, connection, missing)
        finally:
            os._exit(0 if sys.exc_info()[0] is None else 1)
    return pid


def _end(pid: int, grace_s: float) -> int:
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


def _serve_file(reader: Reader, path: Path, connection: int, missing: Sequence[str]) -> None:
    with (
        os.fdopen(connection, "rb", closefd=False) as requests,
        os.fdopen(connection, "wb", closefd=False) as answers,
        suppress(BrokenPipeError, ConnectionResetError),
    ):
        for answer, arrays in _answers(reader, path, requests):
            signal.setitimer(signal.ITIMER_REAL, 0)
            answer["arrays"] = [[str(array.dtype), len(array)] for array in arrays]
            answers.write(json.dumps(answer | {"missing": missing}).encode() + b"\n")
            for array in arrays:
                answers.write(np.ascontiguousarray(array).view(np.uint8).data)
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
                    file = stack.enter_context(reader(path))
                    answer = _description(file)
                else:
                    number = request["block"]
                    if number not in blocks:
                        blocks[number] = _pieces(file.read(request["names"]))
                    arrays = next(blocks[number], ())
            except TripError as error:
                answer = {"problems": [*map(stored, error.problems)]}
            except MemoryError:
                answer = {"problems": [stored(of(path, NO_MEMORY))]}
            except Exception as error:  # whatever a library raises on a damaged file
                answer = {"error": str(error) or type(error).__name__}
            yield answer, arrays


def _description(file: OpenFile) -> dict[str, Any]:
    return {
        "columns": [asdict(column) | {"unread": stored(column.unread)} for column in file.columns],
        "words": stored(file.words),
        "notes": short_lines(file.notes)[:MOST_NOTES],
    }


def _pieces(blocks: Iterator[Block]) -> Iterator[Block]:
    for block in blocks:
        most = max(MOST_BLOCK_BYTES // 8 // max(len(block), 1), 1)
        for start in range(0, len(block[0]), most):
            yield tuple(array[start : start + most] for array in block)


MOST_DESCRIPTORS = 64  # largest number of files that a reader may have open
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FS_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""Number of file access rights, by the version of Landlock that introduced them."""
CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
"""Numbers of Landlock's system calls, the same on all processors."""
_SET_PDEATHSIG, _SET_NO_NEW_PRIVS = 1, 38
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_REFUSED_EVENTS = (
    *("ctypes.dlopen", "os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn"),
    *("os.startfile", "os.system", "pty.spawn", "subprocess.Popen", "socket.", "pickle.find_class"),
    *("os.chmod", "os.chown", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir"),
    *("os.symlink", "os.truncate", "os.utime", "os.kill", "shutil.", "sqlite3.", "urllib."),
    "webbrowser.",
)
"""Prefixes of Python audit events that no reader needs."""


def confine(descriptor: int, path: Path, memory_bytes: int) -> list[str]:
    """Restrict this process irrevocably to reading one file and the code of Python.

    `descriptor` is the open file, `path` the name by which libraries open it again. `memory_bytes`
    is the allowed address space in addition to what is in use. What this system lacks is returned,
    with what a file could therefore make its reader do.
    """
    folders = _code_folders()
    is_limited, is_private = _limit(memory_bytes), False
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None, use_errno=True)
        libc.prctl(_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if libc.prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0:
            is_private = _restrict_files(libc, descriptor, folders)
    _refuse_events(path, folders)
    parts = {
        "/proc (take any amount of memory)": is_limited,
        "Landlock (read and change other files, start programs, connect)": is_private,
    }
    return [part for part, is_present in parts.items() if not is_present]


def _code_folders() -> list[str]:
    prefixes = tuple({f"{os.path.realpath(root)}/lib" for root in (sys.prefix, sys.base_prefix)})
    packages = [
        folder
        for folder in map(os.path.realpath, filter(None, sys.path))
        if os.path.basename(folder) in ("site-packages", "dist-packages")
        or folder.startswith(prefixes)
    ]
    system = ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/share/zoneinfo")
    return list(filter(os.path.isdir, {*prefixes, *packages, *map(os.path.realpath, system)}))


def _limit(memory_bytes: int) -> bool:
    """Limit open files, forbid that files grow and cores are dumped; return whether memory is."""
    bounds = {resource.RLIMIT_FSIZE: 0, resource.RLIMIT_CORE: 0}
    bounds[resource.RLIMIT_NOFILE] = MOST_DESCRIPTORS
    with suppress(OSError, ValueError):  # without /proc the memory in use is not known
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        bounds[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory_bytes
    for kind, bound in bounds.items():
        hard = resource.getrlimit(kind)[1]
        bound = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
        resource.setrlimit(kind, (bound, bound))
    return resource.RLIMIT_AS in bounds


def _restrict_files(libc: Any, descriptor: int, folders: Sequence[str]) -> bool:
    """Refuse other files, programs, TCP and signals to other processes; return whether it is so.

    Earlier versions of Landlock refuse TCP and signals to Python alone, by its audit hook.
    """
    version = libc.syscall(CREATE_RULESET, None, 0, 1)
    if version < 1:
        return False
    n_rights = max(n for first, n in _FS_RIGHTS.items() if first <= version)
    attributes = ((1 << n_rights) - 1, 0b11 * (version >= 4), 0b11 * (version >= 6))
    size = 8 * (1 + (version >= 4) + (version >= 6))
    ruleset = libc.syscall(CREATE_RULESET, struct.pack("QQQ", *attributes)[:size], size, 0)
    if ruleset < 0:
        return False
    try:
        _allow(libc, ruleset, descriptor, _READ_FILE)
        for folder in folders:
            handle = os.open(folder, os.O_PATH | os.O_CLOEXEC)
            _allow(libc, ruleset, handle, _READ_FILE | _READ_DIR)
            os.close(handle)
        return bool(libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0)
    finally:
        os.close(ruleset)


def _allow(libc: Any, ruleset: int, handle: int, rights: int) -> None:
    libc.syscall(_ADD_RULE, ruleset, 1, struct.pack("=Qi", rights, handle), 0)


def _refuse_events(path: Path, folders: Sequence[str]) -> None:
    """Refuse what no reader needs by an audit hook of Python, which works on every system."""
    allowed = tuple(f"{folder}/" for folder in folders)
    data_file = os.path.realpath(path)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        is_allowed = not event.startswith(_REFUSED_EVENTS)
        if event == "open" and not isinstance(arguments[0], int):
            name, _, flags = arguments
            target = os.path.realpath(os.fsdecode(name))
            is_read_only = not (isinstance(flags, int) and flags & _WRITES)
            is_allowed = is_read_only and (target == data_file or target.startswith(allowed))
        if not is_allowed:
            action = f"{event} {arguments[0]}" if arguments else event
            raise PermissionError(Finding("reader-misled", what=action))

    sys.addaudithook(hook)
