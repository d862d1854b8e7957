"""How much a data file may declare: beyond this no recording goes, whatever its format.

A few bytes can declare any number of samples: compressed zeros, repeated values, holes of a sparse
file. What a recording holds is bounded by time, and by what is really stored.
"""

from __future__ import annotations

from pathlib import Path

from suspnet.ground.storage import open_plain, stored_bytes
from suspnet.recordings.checked_mapping import TripError

MOST_SAMPLES = 48 * 3600 * 10_000
"""Largest number of samples of a channel: two days at 10 kHz."""
FREE_SAMPLES = 2**26
"""Number of samples that any file may declare, as a channel of nothing but zeros may be packed into
a few bytes: 3.7 hours at 5 kHz, 18 hours at 1 kHz."""
SAMPLES_PER_BYTE = 8
"""Number of samples beyond those for each byte that is stored. Packed noise takes a byte or more
for each sample, so that seven eighths of a long recording may be zeros that take no space."""

FREE_MEMORY, MEMORY_PER_BYTE = 5 * 2**28, 16
"""Memory that the reader of a file may take: 1.25 GiB, and 16 bytes for each that is stored.

Columns of MAT and UFF files are read whole: 8 bytes for each sample, twice, of 2 bytes or less."""
FREE_S, SECONDS_PER_BYTE, MOST_S = 20.0, 1e-6, 300.0
"""Time [s] that a reader may take for one step: 20 s, and 1 s for each megabyte, at most 300 s."""
MOST_CHUNK_BYTES = 2**28
"""Largest size of what must be unpacked at once to read one sample of an HDF5 file."""


def most_samples(path: Path) -> int:
    """Return the largest number of samples that a channel of a file may have."""
    with open_plain(path) as stream:
        return min(MOST_SAMPLES, FREE_SAMPLES + SAMPLES_PER_BYTE * stored_bytes(stream))


def check_samples(path: Path, n_samples: int) -> None:
    """Raise TripError if a file declares more samples than a recording of its size has."""
    if n_samples > FREE_SAMPLES and n_samples > (most := most_samples(path)):
        raise TripError(
            f"{path} declares {n_samples} samples in one column; at most {most} are read of a file "
            "that stores so little. Export the recording again, in parts if it is that long"
        )


def memory_bytes(stored: int) -> int:
    """Return how much memory the reader of a file may take, by the bytes that are stored."""
    return FREE_MEMORY + MEMORY_PER_BYTE * stored


def step_s(stored: int) -> float:
    """Return how long a step of the reader of a file may take [s], by the bytes that are stored."""
    return min(MOST_S, FREE_S + round(SECONDS_PER_BYTE * stored))
