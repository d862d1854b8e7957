"""A reader's process reads its file, and does nothing else whatever the file makes it try."""

import ctypes
import hashlib
import os
import platform
import resource
import socket
import time
from pathlib import Path

import pytest
from misbehaving_readers import attempts, open_misbehaving

from suspnet.recordings import formats, reader_process
from suspnet.recordings import reader_server as confinement
from suspnet.recordings.errors import TripError
from suspnet.recordings.formats import open_file

HAS_LANDLOCK = platform.system() == "Linux" and (
    ctypes.CDLL(None, use_errno=True).syscall(confinement._CREATE_RULESET, None, 0, 1) > 0
)
HAS_FILTER = platform.system() == "Linux" and platform.machine() in confinement._SYSTEM_CALLS
NEEDS_LANDLOCK = (
    *("list", "kill the parent", "creat by C", "unlink by C", "rename by C", "mkdir by C"),
    *("link by C", "read by C", "passwords"),
)
NEEDS_FILTER = (
    *("fork by C", "system by C", "execve by C", "datagram by C", "stream by C", "chmod by C"),
    "trace",
)


@pytest.fixture
def file(monkeypatch, tmp_path):
    """Return a function that writes a file which makes its reader try something."""
    monkeypatch.setitem(formats.READERS, ".mat", reader_process.in_own_process(open_misbehaving))
    monkeypatch.setattr(reader_process, "_late", {})
    (tmp_path / "secret").write_text("secret")

    def written(what):
        path = tmp_path / "data.mat"
        path.write_text(what)
        return path

    return written


def state(folder: Path) -> str:
    """Return a hash of what a folder holds."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found = path.lstat()
        digest.update(repr((path.name, found.st_mode, found.st_size, found.st_mtime_ns)).encode())
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()


@pytest.mark.parametrize("what", attempts(Path()))
def test_reader_can_do_nothing_but_read_its_file(file, tmp_path, what):
    if (what in NEEDS_LANDLOCK and not HAS_LANDLOCK) or (what in NEEDS_FILTER and not HAS_FILTER):
        pytest.skip("this system lacks what refuses it")
    path = file(what)
    before = state(tmp_path)
    try:
        with open_file(path) as opened:
            found = opened.words
    except TripError as error:
        found = str(error)
    assert found.startswith("refused: ") or "exit code" in found or "memory" in found, found
    assert state(tmp_path) == before


def test_reader_may_import_and_start_threads(file):
    with open_file(file("thread")) as opened:
        assert opened.words == "done"


@pytest.mark.parametrize("what", ["hog", pytest.param("loop", marks=pytest.mark.slow)])
def test_loop_and_hog_end_in_one_line_within_seconds(file, monkeypatch, what):
    monkeypatch.setenv(reader_process.LIMIT, "1")
    path, start = file(what), time.monotonic()
    with pytest.raises(TripError, match=r"data.mat: (its reader took|reading it takes more mem)"):
        with open_file(path):
            pass
    assert time.monotonic() - start < 15


def test_this_process_is_not_confined(file, tmp_path):
    with open_file(file("fork")):
        pass
    (tmp_path / "mine").write_text("x")
    socket.socket().close()
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] == resource.RLIM_INFINITY
    assert os.waitpid(os.posix_spawn("/bin/true", ["true"], {}), 0)[1] == 0


@pytest.mark.skipif(platform.system() != "Linux", reason="of the protections of Linux")
@pytest.mark.parametrize("missing", ["Landlock", "the filter", "both"])
def test_protections_do_not_need_each_other(tmp_path, missing):
    """On a system without some, the others hold: writing is always refused, by Python itself."""
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "data.mat").write_text("x")
    before, (out, into) = state(tmp_path), os.pipe()
    if (pid := os.fork()) == 0:
        try:
            if missing in ("Landlock", "both"):
                confinement._CREATE_RULESET = 1_000_000  # no such system call
            if missing in ("the filter", "both"):
                confinement._SYSTEM_CALLS.clear()
            handle = os.open(tmp_path / "data.mat", os.O_RDONLY)
            confinement.confine(handle, tmp_path / "data.mat", 2**28)
            for what in ("write", "truncate", "system", "fork", "connection", "read", "rename"):
                try:
                    attempts(tmp_path)[what]()
                except OSError:
                    os.write(into, b".")
            os.write(into, Path(tmp_path / "data.mat").read_bytes())
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    assert os.read(out, 99) == b".......x"
    assert state(tmp_path) == before
