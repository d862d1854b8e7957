"""A worker that is killed costs what it worked on, and no worker outlives its parent."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from joblib import Parallel, delayed

from suspnet.ground import workers
from suspnet.ground.workers import LostWorkerError, each, guard_joblib

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
ORPHANS_S = 10.0
"""Time after which no worker may be left [s]."""


def work(item):
    """Do what the item says, and return where."""
    if item == "fail":
        raise KeyError("a fault of the function")
    if item == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if isinstance(item, Path) and not item.exists():
        item.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def nap(file):
    """Say who sleeps, and sleep longer than any test."""
    Path(f"{file}.{os.getpid()}").touch()
    time.sleep(600)


@pytest.fixture
def joblib_as_before():
    yield
    workers.register_parallel_backend("loky", workers.LokyBackend)


# one that is killed


def test_death_of_a_worker_costs_what_it_worked_on_alone(tmp_path):
    once = tmp_path / "once"  # as if the memory had been short for a moment
    found = dict(each(work, ["a", "die", "b", once, "c"], 2))
    assert found.keys() == {"a", "die", "b", once, "c"}
    lost = found.pop("die")
    assert isinstance(lost, LostWorkerError)
    assert "was killed (SIGKILL(-9)), and so was that of a second attempt" in str(lost)
    assert os.getpid() not in found.values()
    assert not any(isinstance(one, LostWorkerError) for one in found.values())


def test_one_worker_is_this_process():
    assert list(each(work, ["a", "b"], 1)) == [("a", os.getpid()), ("b", os.getpid())]


@pytest.mark.parametrize("n_workers", [1, 2])
def test_fault_of_the_function_is_raised_and_no_worker_is_left(n_workers):
    before = set(children(os.getpid()))  # those of other tests
    with pytest.raises(KeyError, match="a fault"):
        list(each(work, ["a", "fail"], n_workers))
    assert set(children(os.getpid())) <= before


@pytest.fixture(autouse=True)
def _workers_start_on_their_own(monkeypatch):
    """Start workers as without a program, which forks them."""
    monkeypatch.setattr(workers, "start_method", "loky")


FORKED = """
from test_workers import *
from suspnet.ground.workers import fork_from_server
before = signal.getsignal(signal.SIGINT), dict(os.environ)
fork_from_server("json", 1)
found = {"alone": workers.start_method}
fork_from_server("json", 2)
found["unchanged"] = before == (signal.getsignal(signal.SIGINT), dict(os.environ))
found["pids"] = [one for _, one in each(parent_of, [*range(4)], 2)]
found["children"] = children(os.getpid())
done = dict(each(work, ["a", "die", "b"], 2))
found["lost"] = [str(one) for one in done.values() if not isinstance(one, int)]
(server,) = {parent for _, parent, _ in found["pids"]}
found["left"] = children(server)
print(json.dumps(found))
"""


def parent_of(_):
    """Return this process, its parent and its number of threads."""
    return os.getpid(), os.getppid(), os.environ[workers.THREADS[0]]


def test_workers_of_programs_are_forked_from_one_server():
    path = os.pathsep.join(sys.path)
    environment = {name: one for name, one in os.environ.items() if name not in workers.THREADS}
    command = [sys.executable, "-c", FORKED]
    ended = subprocess.run(command, env=environment | {"PYTHONPATH": path}, capture_output=True)
    assert ended.stderr == b""
    found = json.loads(ended.stdout)
    assert found["alone"] == "loky"
    assert found["unchanged"]
    assert {parent for _, parent, _ in found["pids"]} <= set(found["children"])
    assert len({pid for pid, *_ in found["pids"]} - set(found["children"])) == 2
    assert {threads for *_, threads in found["pids"]} == {str(max(workers.cpu_count() // 2, 1))}
    (lost,) = found["lost"]
    assert "killed (SIGKILL(-9))" in lost
    assert not found["left"]


def test_joblib_is_guarded_and_works_as_before(joblib_as_before):
    guard_joblib()
    assert os.getpid() not in Parallel(2)(delayed(work)(item) for item in "abcd")


# parents that are killed


def children(pid):
    """Return the processes that a process started, but not those that track resources."""
    found = []
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread may have ended
            found += [int(one) for one in file.read_text().split()]
    return [one for one in found if is_alive(one) and "resource_tracker" not in command_of(one)]


def command_of(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def is_alive(pid):
    """Return whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def until(condition, seconds):
    """Wait until something is true, at most so long; return whether it became so."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


PARENTS = {
    "each": "list(each(nap, [folder / 'a', folder / 'b', folder / 'c'], 2))",
    "joblib": "guard_joblib(); Parallel(2)(delayed(nap)(folder / one) for one in 'abc')",
    "forked": "workers.fork_from_server('json', 2); list(each(nap, [folder / o for o in 'ab'], 2))",
    "idle": "guard_joblib(); Parallel(3, pre_dispatch=1)(delayed(nap)(folder / o) for o in 'ab')",
}


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize(
    "kind",
    [
        "forked",
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("each", "joblib", "idle")),
    ],
)
def test_no_worker_outlives_a_parent_that_is_killed(tmp_path, kind):
    code = (
        "from pathlib import Path; from test_workers import *; "
        f"folder = Path({str(tmp_path)!r}); {PARENTS[kind]}"
    )
    path = os.pathsep.join(sys.path)
    parent = subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path})
    try:
        n_sleeping = 1 if kind == "idle" else 2
        assert until(lambda: len(list(tmp_path.iterdir())) >= n_sleeping, 60)
        started = {int(file.suffix[1:]) for file in tmp_path.iterdir()} | {*children(parent.pid)}
        assert len(started) >= n_sleeping
    finally:
        parent.kill()
        parent.wait()
    assert until(lambda: not any(map(is_alive, started)), ORPHANS_S)
