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

from suspnet.trains.recordings import formats, reader_process
from suspnet.trains.recordings import reader_server as confinement
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_file

HAS_LANDLOCK = platform.system() == "Linux" and (
    ctypes.CDLL(None, use_errno=True).syscall(confinement.CREATE_RULESET, None, 0, 1) > 0
)
LANDLOCK = "Landlock (read and change other files, start programs, connect)"
NEEDS_LANDLOCK = {one for one in attempts(Path()) if one.endswith(" by C")}
NEEDS_LANDLOCK |= {"list", "passwords", "kill the parent", "trace"}


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
    if what in NEEDS_LANDLOCK and not HAS_LANDLOCK:
        pytest.skip("runs on Linux with Landlock")
    path = file(what)
    before = state(tmp_path)
    try:
        with open_file(path) as opened:
            found = opened.words
    except TripError as error:
        found = str(error)
    assert found.startswith("refused: ") or "exit code" in found or "memory" in found, found
    assert state(tmp_path) == before


def test_reader_gets_no_secret_of_the_environment(file, monkeypatch):
    for name in ("SUSPNET_SMTP_PASSWORD", "PGPASSWORD", "AWS_SECRET_ACCESS_KEY", "MY_TOKEN"):
        monkeypatch.setenv(name, "secret")
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    reader_process.end_all()  # the next reader gets a server of this environment
    with open_file(file("environment")) as opened:
        names = opened.words.split()
    assert {"LC_ALL", "OPENBLAS_NUM_THREADS"} <= set(names)
    assert [one for one in names if not reader_process.PASSED.fullmatch(one)] == [
        "HDF5_PLUGIN_PRELOAD"
    ]


def test_what_a_system_lacks_is_one_warning(file, monkeypatch, caplog):
    answer = reader_process._Process.ask

    def ask(self, request):
        found, arrays = answer(self, request)
        return found | {
            "missing": [
                *found["missing"],
                "Landlock (read and change other files, start programs, connect)",
            ]
        }, arrays

    monkeypatch.setattr(reader_process._Process, "ask", ask)
    reader_process._warn_once.cache_clear()
    for _ in range(2):
        with open_file(file("thread")):
            pass
    (line,) = caplog.messages
    assert LANDLOCK in line


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
def test_python_refuses_most_without_landlock(tmp_path):
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "data.mat").write_text("x")
    before, (out, into) = state(tmp_path), os.pipe()
    if (pid := os.fork()) == 0:
        try:
            confinement.CREATE_RULESET = 1_000_000  # no such system call
            handle = os.open(tmp_path / "data.mat", os.O_RDONLY)
            lacking = confinement.confine(handle, tmp_path / "data.mat", 2**28)
            os.write(into, f"{[one.split(' (')[0] for one in lacking]} ".encode())
            for what in ("write", "truncate", "system", "fork", "connection", "read", "rename"):
                try:
                    attempts(tmp_path)[what]()
                except OSError:
                    os.write(into, b".")
            os.write(into, Path(tmp_path / "data.mat").read_bytes())
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    assert os.read(out, 999).decode() == "['Landlock'] .......x"
    assert state(tmp_path) == before
