"""A file that crashes, hangs or fails its reader costs one error, and the next file is read."""

import os
import subprocess
import sys
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from dying_readers import N_BLOCKS, N_SAMPLES, open_dying

from suspnet.trains.recordings import formats, reader_process
from suspnet.trains.recordings.columns import Column
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_columns, open_file
from suspnet.trains.recordings.reader_server import NO_MEMORY

A = np.arange(float(N_BLOCKS * N_SAMPLES))


@pytest.fixture
def file(monkeypatch, tmp_path):
    """Return a function that writes a file which does something to its reader."""
    monkeypatch.setitem(formats.READERS, ".mat", reader_process.in_own_process(open_dying))

    def written(what, name="data"):
        path = tmp_path / f"{name}.mat"
        path.write_text(what)
        return path

    return written


def read(path, *columns):
    blocks = list(open_columns(path, columns or ("a",)))
    return [np.concatenate(column) for column in zip(*blocks, strict=True)]


def reader_of(path):
    """Return the process that reads a file."""
    with open_file(path) as opened:
        return int(opened.words)


def is_there(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


# what comes across


def test_columns_words_and_blocks_are_those_of_the_reader(file):
    path = file("fine")
    with open_file(path) as opened:
        assert opened.columns == (Column("t", is_time=True), Column("a", "g"))
        assert int(opened.words) != os.getpid()
    t, a = read(path, "t", "a")
    np.testing.assert_array_equal(a, A)
    np.testing.assert_array_equal(t, A.astype("M8[ns]"))
    assert t.dtype == "M8[ns]"
    a += 1.0  # as of any other reader, it can be written to


def test_reads_of_one_file_and_files_of_one_thread_do_not_mix(file):
    with open_file(file("fine")) as one, open_file(file("fine", "b")) as other:
        assert one.words != other.words
        readers = [opened.read(["a"]) for opened in (one, one, other)]
        rows = list(zip(*readers, strict=True))
    np.testing.assert_array_equal(np.concatenate([row[2][0] for row in rows]), A)
    assert all(np.array_equal(x[0], y[0]) for row in rows for x, y in pairwise(row))


def test_each_file_has_a_process_that_ends_with_it(file):
    found = [reader_of(file(what)) for what in ("fine", "chatter", "fine")]
    assert len(set(found)) == 3
    with open_file(file("fine")) as opened:
        next(opened.read(["a"]))  # as of who needs the beginning only
        found.append(int(opened.words))
        assert is_there(found[-1])
    assert not any(map(is_there, found))


def test_processes_are_started_again_after_their_server_was_killed(file):
    with open_file(file("fine")) as opened:
        reader_process.end_all()
        with pytest.raises(ValueError, match="its reader crashed"):
            list(opened.read(["a"]))
    np.testing.assert_array_equal(read(file("fine"))[0], A)


def test_what_libraries_print_goes_nowhere(file, capfd):
    np.testing.assert_array_equal(read(file("chatter:1"))[0], A)
    assert capfd.readouterr() == ("", "")


# what goes wrong


@pytest.mark.skipif(os.name != "posix", reason="runs on POSIX systems, whose signals it sends")
@pytest.mark.parametrize(
    "when", [":2", *(pytest.param(when, marks=pytest.mark.slow) for when in ("", ":0"))]
)
@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("crash", "its reader crashed (SIGSEGV), so the file is damaged"),
        ("abort", "its reader crashed (SIGABRT), so the file is damaged"),
        ("exit", "its reader crashed (exit code 3), so the file is damaged"),
        (
            "short of memory",
            "its reader crashed (SIGKILL), so the file is damaged, or there was too little memory",
        ),
        ("trip", "one problem (and 1 more: suspnet check shows all)"),
        ("error", "is damaged, cut off or not a .mat file (division by zero)"),
        ("speechless", f"{NO_MEMORY}"),
    ],
)
def test_end_of_a_reader_is_one_error(file, what, words, when):
    path = file(what + when)
    with pytest.raises(TripError) as caught:
        read(path)
    assert str(caught.value).removeprefix(f"{path}: ").removeprefix(f"{path} ") == words
    np.testing.assert_array_equal(read(file("fine"))[0], A)


@pytest.mark.parametrize(
    "what", ["hang inside", *(pytest.param(w, marks=pytest.mark.slow) for w in ("hang", "hang:2"))]
)
def test_reader_that_takes_too_long_is_ended_and_the_file_not_tried_again(file, monkeypatch, what):
    assert reader_of(file("fine"))  # the time is not that of the start
    monkeypatch.setenv(reader_process.LIMIT, "0.5")
    path = file(what)
    start = time.monotonic()
    with pytest.raises(TripError, match=r"data.mat: its reader took longer than 0.5 s for one"):
        read(path)
    assert 0.4 < time.monotonic() - start < 20
    with pytest.raises(TripError, match=r"took longer .* \(the variable SUSPNET_READER_S gives"):
        read(path)
    monkeypatch.delenv(reader_process.LIMIT)
    path.write_text("fine again")
    np.testing.assert_array_equal(read(path)[0], A)


@pytest.mark.parametrize("text", ["soon", "0", "-1", "nan", "inf", "1e300"])
def test_invalid_time_is_named(file, monkeypatch, text):
    monkeypatch.setenv(reader_process.LIMIT, text)
    with pytest.raises(TripError, match=f"SUSPNET_READER_S must be a time in .* got '{text}'"):
        read(file("fine"))


def test_threads_have_readers_of_their_own(file):
    path, found = file("fine"), []
    meet = threading.Barrier(2, timeout=60)

    def both():
        with open_file(path) as opened:
            meet.wait()
            found.append(opened.words)

    threads = [threading.Thread(target=both) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 2


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="runs on Linux, which has /proc")
@pytest.mark.parametrize("what", ["fine", pytest.param("hang inside:1", marks=pytest.mark.slow)])
def test_reader_ends_with_the_process_that_is_killed(file, what):
    code = (
        "import os, signal, sys, threading; from pathlib import Path; "
        "from suspnet.trains.recordings.reader_process import in_own_process; "
        "from dying_readers import open_dying\n"
        f"with in_own_process(open_dying)(Path({str(file(what))!r})) as opened:\n"
        "    print(opened.words, flush=True)\n"
        "    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGKILL)).start()\n"
        "    list(opened.read(['a'])); signal.pause()"
    )
    path = os.pathsep.join(sys.path)
    environment = os.environ | {"PYTHONPATH": path, reader_process.LIMIT: "2"}
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, env=environment, check=False
    )
    assert ended.returncode == -9, ended.stderr
    process, last = f"/proc/{int(ended.stdout)}", time.monotonic() + 10
    while os.path.exists(process) and time.monotonic() < last:
        time.sleep(0.05)
    assert not os.path.exists(process)
