"""Sums over the processes that share a fit, one rank each (torchrun starts them).

Without such processes a sum is the values themselves. gloo serves the CPU, NCCL a GPU.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
import torch.distributed as dist
from torch import Tensor

Total = Callable[[Tensor], Tensor]
"""Sums a tensor over ranks, in place, and returns it."""


def together() -> bool:
    """Return whether this process is one of several ranks."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def first() -> bool:
    """Return whether this process is the one that writes and prints."""
    return not together() or dist.get_rank() == 0


def start(device: str) -> None:
    """Join the other ranks if torchrun started this process, each with a GPU of its own."""
    if "TORCHELASTIC_RUN_ID" in os.environ and not dist.is_initialized():
        if torch.device(device).type == "cuda":
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")


def stop() -> None:
    """Leave the other ranks."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def agreed(values: Tensor, total: Total) -> Tensor:
    """Return the first rank's values, so that rounding never parts the ranks' ways."""
    if total is not alone and together():
        dist.broadcast(values, src=0)
    return values


def alone(values: Tensor) -> Tensor:
    """Return the sum over ranks where there is one: the values themselves."""
    return values


def total(values: Tensor) -> Tensor:
    """Sum a tensor over ranks, in place, and return it."""
    if together():
        dist.all_reduce(values)
    return values


def gathered(rows: Tensor) -> Tensor:
    """Return the rows (n, n_columns) of all ranks, rank after rank; n may differ, or be 0."""
    if not together():
        return rows
    counts = torch.zeros(dist.get_world_size(), dtype=torch.int64, device=rows.device)
    counts[dist.get_rank()] = len(rows)
    dist.all_reduce(counts)
    padded = rows.new_zeros(int(counts.max()), rows.shape[1])
    padded[: len(rows)] = rows
    parts = [torch.empty_like(padded) for _ in counts]
    dist.all_gather(parts, padded)
    return torch.cat([part[:n] for part, n in zip(parts, counts.tolist(), strict=True)])


def share(n_items: int) -> slice:
    """Return which of `n_items` in a row are this rank's; the last ranks may have none."""
    if not together():
        return slice(0, n_items)
    each = -(-n_items // dist.get_world_size())
    start = min(dist.get_rank() * each, n_items)
    return slice(start, min(start + each, n_items))
