"""The demonstration: simulate a train of which a part wears, learn it, read it: suspnet demo."""

import os
import subprocess
import sys
import webbrowser
from argparse import Namespace
from pathlib import Path

from suspnet.cli.folders import ACT
from suspnet.ground import progress
from suspnet.ground.extras import check_extra

FOLDER = Path("demo")  # folder of trips, model and report
TRIPS, MODEL, REPORT = (FOLDER / name for name in ("trips", "model", "report"))
STEPS = {
    "simulate 8 trips while a damper fades": (
        *("simulate", "scenario=corner_damper_fade", f"out={TRIPS}", "fleet.n_trips=8"),
        *("workers=2", "fleet.rate_hz=500"),
    ),
    "learn the train on its first 4 trips": (
        *("train", f"healthy={TRIPS}", "n_healthy=4", f"hydra.run.dir={MODEL}"),
    ),
    "read all trips": (
        *("evaluate", f"trips={TRIPS}", f"run={MODEL}", "monitor.workers=2"),
        f"hydra.run.dir={REPORT}",
    ),
}
"""What is done, and the words of the command line that does it."""


def demo(_: Namespace) -> int:
    """Run the steps, print the verdict and where the report is, and return the exit code.

    ValueError, with the program's own line, if one fails.
    """
    check_extra("trips")
    with progress.on_stderr(), progress.bar("demo", len(STEPS), unit="step") as bar:
        for title, words in STEPS.items():
            bar.set_description_str(title)
            typed = [sys.executable, "-m", "suspnet", *words]
            done = subprocess.run(typed, capture_output=True, text=True)
            if done.returncode not in (0, ACT):
                lines = done.stderr.splitlines() or [f"exit code {done.returncode}"]
                raise ValueError(f"{title}: {lines[-1].removeprefix('error: ')}")
            bar.update()
    # what follows the tables of trips and parts, but not the folder
    lines = done.stdout.splitlines()
    last_row = max(number for number, line in enumerate(lines) if line.startswith("|"))
    report = REPORT / "report.html"
    print(*lines[last_row + 1 : -1], f"-> {report}", sep="\n")
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if sys.stdout.isatty() and (has_display or sys.platform in ("darwin", "win32")):
        webbrowser.open(report.absolute().as_uri())
    return 0
