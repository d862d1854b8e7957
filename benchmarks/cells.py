"""Fit models in a process each, so that time and memory are their own: for the scripts here."""

import argparse
import csv
import json
import math
import os
import platform
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NoReturn

import joblib

Row = dict[str, Any]
WARM_UP = 500
"""Samples of the first fit, which is not timed."""
LONG_S = 15.0
"""A fit that takes longer is not repeated."""
PATIENCE = 10
"""A cell is ended when it takes this many times the limit in all."""


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, with a column for each key of any row, in the order of appearance."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, dict.fromkeys(key for row in rows for key in row))
        writer.writeheader()
        writer.writerows(rows)


class Parser(argparse.ArgumentParser):
    """Ends with one line on a wrong option."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see --help\n")


def at_least(low: float, kind: type = int) -> Callable[[str], Any]:
    """Return what reads a number that must not be below `low`."""

    def read(text: str) -> Any:
        try:
            number = kind(text)
        except ValueError:
            number = math.nan
        if not low <= number < math.inf:
            name = "whole number" if kind is int else "number"
            raise argparse.ArgumentTypeError(f"must be a {name} >= {low}, got {text!r}")
        return number

    return read


def machine() -> str:
    """Return what a measured second depends on."""
    loads = ", ".join(f"{load:.1f}" for load in os.getloadavg())
    return (
        f"{joblib.cpu_count()} threads for torch, OpenMP and BLAS; load average at the start: "
        f"{loads} (above 0.5, seconds are too long); Python {platform.python_version()}"
    )


def run_cell(script: str, cell: Row, timeout_s: float, threads: int | None = None) -> Row:
    """Return what `serve` printed in a fresh process, or {"failed": one line}."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads or joblib.cpu_count())}
    try:
        ended = subprocess.run(
            [sys.executable, script, "cell", json.dumps(cell)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"ended after {timeout_s:.0f} s"}
    if ended.returncode:
        lines = ended.stderr.strip().splitlines()
        return {"failed": lines[-1] if lines else f"exit code {ended.returncode}, out of memory?"}
    found: Row = json.loads(ended.stdout.strip().splitlines()[-1])
    return found


def serve(measure: Callable[[Row], Row]) -> bool:
    """Print the result of one cell if this process was started by `run_cell`."""
    if sys.argv[1:2] != ["cell"]:
        return False
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = measure(json.loads(sys.argv[2]))
    notes = {str(w.message).splitlines()[0] for w in told if "Convergence" in w.category.__name__}
    print(json.dumps({**found, "warning": "; ".join(sorted(notes))}))
    return True


def measured(model: Any, X: Any, Y: Any, repeats: int) -> Row:
    """Return the median seconds of a fit, the peak memory, and how far fitting raised it."""
    before = peak_mib()
    model.fit(X[:WARM_UP], Y[:WARM_UP])
    seconds = [_seconds(model, X, Y)]
    after = peak_mib()
    while len(seconds) < repeats and seconds[0] <= LONG_S:
        seconds.append(_seconds(model, X, Y))
    return {"seconds": median(seconds), "peak_mib": after, "fit_mib": after - before}


def _seconds(model: Any, X: Any, Y: Any) -> float:
    start = time.perf_counter()
    model.fit(X, Y)
    return time.perf_counter() - start


def peak_mib() -> float:
    """Return the peak resident memory of this process so far, [MiB]."""
    # not ru_maxrss, which starts from that of the process that started this one
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024
