"""Worker processes that end with their parent, and work that survives the death of a worker.

In the pools of concurrent.futures and loky one killed process breaks the pool, which loses all
waiting and running items; here each worker is a pool of one process.
"""

import functools
import math
import multiprocessing
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing import forkserver
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from joblib import cpu_count, register_parallel_backend
from joblib.externals.loky import ProcessPoolExecutor
from joblib.parallel import LokyBackend
from tqdm import tqdm

from suspnet.ground.findings import Finding

WATCH_S = 1.0  # time between two checks that the parent process is alive, [s]
ATTEMPTS = 2  # largest number of attempts at one item whose process is killed
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables for the number of threads of a process."""
USUAL_WORKERS, ITEMS_A_WORKER = 2, 10
"""Number of processes if none is asked for, and smallest number of trips for each of them: one
takes 2 s to start, about as long as 10 trips of 5 minutes."""
Item = TypeVar("Item")
Result = TypeVar("Result")
start_method = "loky"
"""How processes start: each on its own, or "forkserver" for programs (`fork_from_server`)."""


class LostWorkerError(RuntimeError):
    """Every process that worked on an item was killed."""


def workers_for(n_items: int, wanted: int | None) -> int:
    """Return the number of processes for some trips, as wanted; None is as many as save time."""
    if wanted is not None:
        return wanted
    return max(1, min(USUAL_WORKERS, math.ceil(n_items / ITEMS_A_WORKER)))


def fork_from_server(module: str, n_workers: int) -> None:
    """Start a process that imports `module`, and let all later workers be forked from it.

    The import takes seconds, which each worker would need otherwise; it runs alongside what this
    process does next. Only for programs: workers import the main module again, which must start
    nothing then. Workers start on their own where processes cannot be forked, and in a worker.
    """
    global start_method
    is_worker = multiprocessing.parent_process() is not None
    if is_worker or n_workers < 2 or "forkserver" not in multiprocessing.get_all_start_methods():
        return
    multiprocessing.set_forkserver_preload([module])
    with ExitStack() as stack:
        # the server inherits both; Ctrl-C is for this process, which ends it
        stack.enter_context(environment(_threads(n_workers)))
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGINT, signal.SIG_IGN)
            stack.callback(signal.signal, signal.SIGINT, before)
        forkserver.ensure_running()
    start_method = "forkserver"


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables inside a ``with`` block."""
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            del os.environ[name]
        os.environ.update(before)


def _threads(n_workers: int) -> dict[str, str]:
    """Return the numbers of threads of processes that share the cores, unless they are set."""
    n_threads = str(max(cpu_count() // n_workers, 1))
    return {name: os.environ.get(name, n_threads) for name in THREADS}


def guarded(n_workers: int) -> ProcessPoolExecutor:
    """Return an executor with one process that ends with this one; `n_workers` share the cores."""
    is_forked = start_method == "forkserver"
    context = multiprocessing.get_context("forkserver") if is_forked else None
    env = _threads(n_workers)
    return ProcessPoolExecutor(
        1, context=context, env=env, initializer=begin, initargs=(is_forked,)
    )


def each(
    function: Callable[[Item], Result], items: Iterable[Item], n_workers: int
) -> Iterator[tuple[Item, Result | LostWorkerError]]:
    """Yield every item with the function's result for it, in order of completion.

    An item whose process dies is tried ``ATTEMPTS`` times, then its result is a LostWorkerError.
    Exceptions of the function, which must be picklable, are raised here. With one worker this
    process does the work itself.
    """
    if n_workers == 1 or multiprocessing.current_process().daemon:  # daemons have no children
        for item in items:
            yield item, function(item)
        return
    waiting = deque((item, 1) for item in items)
    idle = [guarded(n_workers) for _ in range(min(n_workers, len(waiting)))]
    running: dict[Future[Result], tuple[Item, int, ProcessPoolExecutor]] = {}
    alive = set(idle)
    try:
        # terminates: each pass ends at least one attempt, and an item has at most ATTEMPTS
        while waiting or running:
            while waiting and idle:
                item, attempt = waiting.popleft()
                executor = idle.pop()
                running[executor.submit(function, item)] = item, attempt, executor
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                item, attempt, executor = running.pop(future)
                try:
                    result: Result | LostWorkerError = future.result()
                except BrokenProcessPool as error:
                    # a killed process breaks its pool: replace it
                    executor.shutdown(kill_workers=True)
                    alive.remove(executor)
                    executor = guarded(n_workers)
                    alive.add(executor)
                    if attempt < ATTEMPTS:
                        waiting.append((item, attempt + 1))
                        idle.append(executor)
                        continue
                    codes = re.search(r"\{(.*)\}", str(error))
                    killed = Finding("killed-by", how=codes[1]) if codes else Finding("killed")
                    result = LostWorkerError(killed)
                idle.append(executor)
                yield item, result
    finally:
        for executor in alive:
            executor.shutdown(kill_workers=True)


def begin(is_forked: bool = False) -> None:
    """Prepare a worker process: it ends with its parent, and only the parent receives Ctrl-C."""
    # tqdm's default lock is a system semaphore, which a killed worker would leave behind
    tqdm.set_lock(threading.RLock())
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(is_forked)


@functools.cache
def end_with_parent(is_forked: bool = False) -> None:
    """End this process within ``WATCH_S`` of its parent, if it is a worker.

    A killed parent cannot stop its workers, which would wait for work forever.
    """
    parent = multiprocessing.parent_process()
    if parent is not None and parent.pid is not None and hasattr(os, "getppid"):
        threading.Thread(target=_watch, args=(parent, is_forked), daemon=True).start()


def _watch(parent: BaseProcess, is_forked: bool) -> None:
    # an orphan is adopted by another process; of those forked by a server, the server is adopted
    while parent.is_alive() if is_forked else os.getppid() == parent.pid:
        time.sleep(WATCH_S)
    os._exit(128 + signal.SIGTERM)


class _GuardedLoky(LokyBackend):  # type: ignore[misc]
    """joblib's loky backend with worker processes that end with their parent."""

    def configure(self, *args: Any, **options: Any) -> int:
        """Configure the backend with ``begin`` as the initializer of each process."""
        return int(super().configure(*args, **options | {"initializer": begin}))


def guard_joblib() -> None:
    """Let all processes that joblib starts after this call end with this one."""
    register_parallel_backend("loky", _GuardedLoky)
