"""Reads all columns of data files and prints, as JSON, what came of each; a process of its own."""

import json
import os
import re
import resource
import sys
import time
from pathlib import Path

import numpy as np

from suspnet.trains.recordings import reader_process
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_file, read_columns


def cpu_s() -> float:
    """Return the processor time of this process and of all readers so far [s]."""
    own, server = resource.getrusage(resource.RUSAGE_SELF), reader_process._servers.get(os.getpid())
    found = own.ru_utime + own.ru_stime
    if server is not None:
        stat = Path(f"/proc/{server._child.pid}/stat").read_text().rpartition(")")[2].split()
        found += sum(map(int, stat[11:15])) / os.sysconf("SC_CLK_TCK")
    return found


def read_all(path: Path, secret: float = np.nan) -> dict:
    """Return how many columns were read, the errors, whether a value came in, and the seconds."""
    start, cpu, n_read, errors, leaked = time.monotonic(), cpu_s(), 0, [], False
    try:
        with open_file(path) as file:
            names = [column.name for column in file.columns]
            for name in names[:3] or [None, "a"]:
                try:
                    for block in read_columns(path, file, [name]):
                        leaked = leaked or bool(np.any(block[0].astype(np.float64) == secret))
                    n_read += 1
                except TripError as error:
                    errors.append(str(error))
    except TripError as error:
        errors.append(str(error))
    seconds, cpu = time.monotonic() - start, cpu_s() - cpu
    return {"read": n_read, "errors": errors, "leaked": leaked, "seconds": seconds, "cpu": cpu}


def main() -> None:
    """Read the files that are named, and print the results and the largest memory [bytes]."""
    found = {name: read_all(Path(name), float(sys.argv[1])) for name in sys.argv[2:]}
    reader_process.end_all()
    own = int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) * 1024
    readers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    print(json.dumps({"found": found, "own": own, "readers": readers}))


if __name__ == "__main__":
    main()
