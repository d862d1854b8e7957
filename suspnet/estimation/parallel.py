"""Blocks of curves made by several threads at the same time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch


@contextmanager
def pool_of(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a pool of threads, each with one thread of torch if there are several.

    The arrays of a block are too small to split, so blocks share the cores, not operations. Blocks
    that wait are dropped when the pool is left by an error or Ctrl-C.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1 if workers > 1 else before)
    pool = ThreadPoolExecutor(workers)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(before)
