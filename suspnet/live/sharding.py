"""Parts of the suspensions, for processes that share a broker without a word between them."""

from __future__ import annotations

import hashlib
import re


def read_part(text: str) -> tuple[int, int]:
    """Return K and N of the text "K/N"; ValueError unless 1 <= K <= N <= 1000."""
    found = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text) if isinstance(text, str) else None
    part, n_parts = map(int, found.groups()) if found else (0, 0)
    if not 1 <= part <= n_parts <= 1000:
        raise ValueError(f'`part` must be "K/N" with 1 <= K <= N <= 1000, got {text!r}')
    return part, n_parts


def is_in_part(suspension: str, part: int, n_parts: int) -> bool:
    """Return whether a suspension belongs to a part of the processes: by SHA-256 of its name.

    Examples
    --------
    >>> [k for k in (1, 2, 3) if is_in_part("train 1, car 2", k, 3)]
    [1]
    """
    digest = hashlib.sha256(suspension.encode()).digest()
    return int.from_bytes(digest[:8], "big") % n_parts == part - 1
