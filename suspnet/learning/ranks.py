"""Collective operations over the processes that fit one model, one rank each (see torchrun).

In a single process each returns its argument. The backend is gloo on the CPU, NCCL on a GPU.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
import torch.distributed as dist
from torch import Tensor

AllReduce = Callable[[Tensor], Tensor]
"""Sum over ranks, in place: `all_reduce`, or `identity` for a fit that is not distributed."""


def is_distributed() -> bool:
    """Return whether this process is one of several ranks."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def is_rank_zero() -> bool:
    """Return whether this process is the one that writes and prints."""
    return not is_distributed() or dist.get_rank() == 0


def start(device: str) -> None:
    """Join the other ranks, each with its own GPU, if torchrun started this process."""
    if "TORCHELASTIC_RUN_ID" in os.environ and not dist.is_initialized():
        if torch.device(device).type == "cuda":
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")


def stop() -> None:
    """Leave the other ranks."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def identity(values: Tensor) -> Tensor:
    """Return the values, their sum over a single rank."""
    return values


def all_reduce(values: Tensor) -> Tensor:
    """Sum a tensor over ranks, in place, and return it."""
    if is_distributed():
        dist.all_reduce(values)
    return values


def broadcast(values: Tensor) -> Tensor:
    """Overwrite a tensor with that of rank zero, and return it."""
    if is_distributed():
        dist.broadcast(values, src=0)
    return values


def all_gather(rows: Tensor) -> Tensor:
    """Return the rows (n, n_columns) of all ranks, in the order of ranks; n may differ, or be 0."""
    if not is_distributed():
        return rows
    counts = torch.zeros(dist.get_world_size(), dtype=torch.int64, device=rows.device)
    counts[dist.get_rank()] = len(rows)
    dist.all_reduce(counts)
    padded = rows.new_zeros(int(counts.max()), rows.shape[1])
    padded[: len(rows)] = rows
    parts = [torch.empty_like(padded) for _ in counts]
    dist.all_gather(parts, padded)
    return torch.cat([part[:n] for part, n in zip(parts, counts.tolist(), strict=True)])


def shard(n_items: int) -> slice:
    """Return the slice of `n_items` that this rank processes; the last ranks may have none."""
    if not is_distributed():
        return slice(0, n_items)
    each = -(-n_items // dist.get_world_size())
    start = min(dist.get_rank() * each, n_items)
    return slice(start, min(start + each, n_items))
