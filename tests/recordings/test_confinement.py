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

from suspnet.recordings import formats, reader_process, reader_server
from suspnet.recordings.errors import TripError
from suspnet.recordings.formats import open_file

LANDLOCK = platform.system() == "Linux" and ctypes.CDLL(None, use_errno=True).syscall(
    reader_server.CREATE_RULESET, None, 0, 1
)
"""Version of Landlock; 0 and less is none."""
NEEDS_LANDLOCK = {name: 1 for name in attempts(Path()) if name.endswith(" by C")}
NEEDS_LANDLOCK |= {"list": 1, "passwords": 1, "trace": 1, "truncate by C": 3, "connect by C": 4}
NEEDS_LANDLOCK |= {"kill by C": 6, "kill the parent": 6}
"""First version that refuses an attempt which Python does not notice."""


@pytest.fixture
def file(monkeypatch, tmp_path):
    """Return a function that writes a file which makes its reader try something."""
    monkeypatch.setitem(formats.READERS, ".mat", reader_process.in_own_process(open_misbehaving))
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
        stat = path.lstat()
        digest.update(repr((path.name, stat.st_mode, stat.st_size, stat.st_mtime_ns)).encode())
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()


@pytest.mark.parametrize("what", attempts(Path()))
def test_reader_can_do_nothing_but_read_its_file(file, tmp_path, what):
    if LANDLOCK < (version := NEEDS_LANDLOCK.get(what, 0)):
        pytest.skip(f"runs on Linux with Landlock {version} or newer, here it is {LANDLOCK}")
    path = file(what)
    before = state(tmp_path)
    try:
        with open_file(path) as opened:
            outcome = opened.words
    except TripError as error:
        outcome = str(error)
    assert outcome.startswith("refused: ") or "exit code" in outcome or "memory" in outcome, outcome
    assert state(tmp_path) == before


def test_reader_gets_no_secret_of_the_environment(file, monkeypatch):
    for name in ("SUSPNET_SMTP_PASSWORD", "PGPASSWORD", "AWS_SECRET_ACCESS_KEY", "MY_TOKEN"):
        monkeypatch.setenv(name, "secret")
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    reader_process.end_all()  # the next reader gets a server of this environment
    with open_file(file("environment")) as opened:
        names = opened.words.split()
    assert {"LC_ALL", "OPENBLAS_NUM_THREADS"} <= set(names)
    others = [name for name in names if not reader_process.PASSED.fullmatch(name)]
    assert others == ["HDF5_PLUGIN_PRELOAD"]


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


def test_python_itself_refuses_where_landlock_is_missing(tmp_path):
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "data.mat").write_text("x")
    before, (out, into) = state(tmp_path), os.pipe()
    if (pid := os.fork()) == 0:
        try:
            reader_server.CREATE_RULESET = 1_000_000  # no such system call
            handle = os.open(tmp_path / "data.mat", os.O_RDONLY)
            lacking = reader_server.confine(handle, tmp_path / "data.mat", 2**28)
            os.write(into, f"{[part.split(' (')[0] for part in lacking]} ".encode())
            for what in ("write", "truncate", "system", "fork", "connection", "read", "rename"):
                try:
                    attempts(tmp_path)[what]()
                except OSError:
                    os.write(into, b".")
            os.write(into, Path(tmp_path / "data.mat").read_bytes())
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    lacking, _, done = os.read(out, 999).decode().rpartition(" ")
    assert lacking == "['Landlock']"
    assert done == "." * 7 + "x"
    assert state(tmp_path) == before


def test_what_a_system_lacks_is_one_warning(file, monkeypatch, caplog):
    monkeypatch.setattr(reader_server, "CREATE_RULESET", 1_000_000)
    reader_process.end_all()
    code = (
        "from suspnet.recordings import reader_server; reader_server.CREATE_RULESET = 1_000_000; "
    )
    monkeypatch.setattr(reader_process, "SERVER_CODE", code + reader_process.SERVER_CODE)
    for _ in range(2):
        with open_file(file("thread")):
            pass
    reader_process.end_all()
    (line,) = caplog.messages
    assert "Landlock (read and change other files" in line
