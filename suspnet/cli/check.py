"""Check manifests and recordings, with a model or without: suspnet-check DIR ..."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from suspnet.cli import program
from suspnet.cli.configs import read_vehicles
from suspnet.cli.named_runs import named_runs
from suspnet.estimation.checkpoint import load_model
from suspnet.ground import ledger, progress
from suspnet.ground.checks import check_number
from suspnet.ground.storage import new_folder
from suspnet.ground.workers import LostWorkerError, each
from suspnet.recordings.manifest_files import find_trips
from suspnet.report.check_page import summary, with_shared_data, write_checks
from suspnet.report.check_records import PROBLEM, TripCheck
from suspnet.trips.check import CheckSettings, Opened, check_trip

DESCRIPTION = """\
Read manifests and recordings, with a model or without. Show everything that is wrong with all of
them at once, and what an estimate would have to work with: usable share, steady speeds, independent
averages, coherence in the vehicle's band, pairs of sensors; for a known vehicle also whether units,
signs and the order of the channels are plausible. A trip is ready if a model of its speed would
read it; with --run if the models of that run do.

The output folder gets check.html, check.json and a picture of each trip that could be read: its
channels and speed, their spectra, and the coherence. Trips are not changed."""

EPILOG = """\
exit code: 0 if every trip could be read, 1 if there is any problem.

  suspnet-check trips/car7                  all manifests of a folder, or of its subfolders
  suspnet-check trip_001.yaml trip_002.yaml --no-pictures
  suspnet-check trips/car7 --run outputs/trips/RUN       are these trips read by that model?"""


def parser() -> ArgumentParser:
    """Return what the command line may hold."""
    found = ArgumentParser(
        "suspnet-check",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
    )
    found.add_argument(
        "trips",
        nargs="+",
        type=Path,
        metavar="DIR",
        help="folder with a manifest (*.yaml) for each trip, or with subfolders that hold them; or "
        "a manifest [one or more paths]",
    )
    found.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of page, JSON and pictures: a new one, or that of an earlier check [path; "
        "outputs/check/TIME if not given]",
    )
    found.add_argument(
        "--no-pictures", action="store_true", help="draw nothing, which is faster [switch]"
    )
    found.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of trips that are read at the same time, each in a process [whole number; at "
        "least 1; 1 if not given]",
    )
    found.add_argument(
        "--config-dir",
        type=Path,
        metavar="DIR",
        help="folder with vehicles of yours, vehicle/NAME.yaml, as for train.py [path; none if not "
        "given]",
    )
    found.add_argument(
        "--run",
        type=Path,
        action="append",
        metavar="DIR",
        help="folder of a training whose models must read the trips, as of evaluate.py; may be "
        "given several times [path; none if not given]",
    )
    return found


def check(arguments: Namespace) -> int:
    """Check what the command line names and return the exit code."""
    check_number("--workers", arguments.workers, low=1, whole=True)
    vehicles = read_vehicles()
    if arguments.config_dir is not None:
        if not (arguments.config_dir / "vehicle").is_dir():
            raise ValueError(f"--config-dir={arguments.config_dir} holds no folder `vehicle`")
        vehicles |= read_vehicles(arguments.config_dir)
    known = {vehicle.name: vehicle for vehicle in vehicles.values()}
    models = [load_model(run) for run in named_runs(arguments.run or [])]
    output = _folder(arguments.output)
    pictures = None if arguments.no_pictures else output
    settings = CheckSettings(known, pictures=pictures, models=models)
    paths, elsewhere = find_trips(arguments.trips)
    with progress.on_stderr():
        checks = with_shared_data(_checked(paths, settings, arguments.workers))
    page = write_checks(checks, elsewhere, output)
    print(f"{summary(checks, elsewhere)}\n-> {page}")
    return exit_code(checks, elsewhere)


def _checked(paths: Sequence[Path], settings: CheckSettings, n_workers: int) -> list[TripCheck]:
    """Return the check of each manifest, in their order."""
    opened = Opened() if n_workers == 1 else None  # processes share nothing
    names = picture_names(paths)
    done = each(partial(_check_one, settings=settings, opened=opened), names.items(), n_workers)
    found = {}
    for (path, _), result in progress.bar("trips", len(paths), items=done, unit="trip"):
        if isinstance(result, LostWorkerError):
            result = TripCheck(path, problems=(str(result),))
        found[path] = result
    return [found[path] for path in paths]


def _check_one(item: tuple[Path, str], settings: CheckSettings, opened: Opened | None) -> TripCheck:
    """Return the check of a manifest whose picture has a name."""
    return check_trip(item[0], settings, item[1], opened)


def exit_code(checks: Sequence[TripCheck], elsewhere: Sequence[str]) -> int:
    """Return 0 if every trip could be read, 1 otherwise."""
    return int(bool(elsewhere) or any(check.state == PROBLEM for check in checks))


def picture_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return a name of its own for the picture of each manifest."""
    names: dict[Path, str] = {}
    taken: set[str] = set()
    for path in paths:
        base, number = path.stem, 1
        name = base
        while name.lower() in taken:  # ends: there are fewer names taken than numbers
            number += 1
            name = f"{base}_{number}"
        taken.add(name.lower())
        names[path] = f"{name}.png"
    return names


def _folder(wanted: Path | None) -> Path:
    """Make and return the folder of the output: the one wanted, or a new one named by the time."""
    if wanted is None:
        wanted = new_folder(Path(f"outputs/check/{datetime.now():%Y-%m-%d_%H-%M-%S}"))
    ledger.begin(wanted)
    return wanted


def main() -> None:
    """Run the program."""
    arguments = parser().parse_args()
    program.run(lambda: sys.exit(check(arguments)))
