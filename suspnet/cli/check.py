"""Check manifests and recordings, with a model or without: suspnet check DIR ..."""

from argparse import Namespace
from collections import Counter
from collections.abc import Container, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

from suspnet.cli.config_files import own_vehicles
from suspnet.cli.kinds import named_runs, read_rigs, vehicles_with
from suspnet.cli.typed_words import listed
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.trip_settings import LEAST_TRIPS, N_HEALTHY
from suspnet.ground import own_files, progress
from suspnet.ground.settings import check_number
from suspnet.ground.storage import distinct, new_folder, printable
from suspnet.ground.wording import command
from suspnet.ground.workers import LostWorkerError, each, workers_for
from suspnet.runs.language import speaking
from suspnet.trains.jobs.check import CheckSettings, Opened, check_trip
from suspnet.trains.pages import check_page
from suspnet.trains.recordings.manifest_files import find_trips
from suspnet.trains.trips.sensor_checks import NO_DIRECTION


def check(arguments: Namespace) -> int:
    """Check what the command line names; return 0 if every trip could be read, else 1."""
    if arguments.workers is not None:
        check_number("--workers", arguments.workers, low=1, whole=True)
    options = vehicles_with(arguments.config_dir)
    vehicles = {vehicle.name: vehicle for vehicle in options.values()}
    rigs = read_rigs(arguments.config_dir) if arguments.config_dir else {}
    models = [load_model(run) for run in named_runs(arguments.run or [])]
    output = _folder(arguments.output)
    pictures = None if arguments.no_pictures else output
    of_rigs = {rig.name: rig for rig in rigs.values()}
    settings = CheckSettings(vehicles, of_rigs, pictures=pictures, models=models)
    paths, elsewhere = find_trips(arguments.trips)
    with progress.on_stderr():
        n_workers = workers_for(len(paths), arguments.workers)
        checked = _checked(paths, settings, n_workers, arguments.language)
        checks = check_page.with_shared_data(check_page.with_distinct_names(checked))
    with speaking(arguments.language):
        page = check_page.write_checks(checks, elsewhere, output)
    print(f"{check_page.summary(checks, elsewhere)}\n-> {page}")
    code = int(bool(elsewhere) or any(check.state == check_page.PROBLEM for check in checks))
    names = {vehicle.name for vehicle in options.values()} | set(of_rigs)
    for line in next_steps(arguments, checks, names, code):
        print(printable(line))
    return code


def _checked(
    paths: Sequence[Path], settings: CheckSettings, n_workers: int, language: str
) -> list[check_page.TripCheck]:
    opened = Opened() if n_workers == 1 else None  # processes share nothing
    # the losses that one trip of a folder would name are shown: the first may not be ready
    n_of: Counter[Path] = Counter()
    items = []
    for path, name in picture_names(paths).items():
        items.append((path, name, n_of[path.parent] < LEAST_TRIPS))
        n_of[path.parent] += 1
    check_item = partial(_check_one, settings=settings, opened=opened, language=language)
    done = each(check_item, items, n_workers)
    checks = {}
    for (path, *_), result in progress.bar("trips", len(paths), items=done, unit="trip"):
        if isinstance(result, LostWorkerError):
            result = check_page.TripCheck(path, problems=(str(result),))
        checks[path] = result
    return [checks[path] for path in paths]


def _check_one(
    item: tuple[Path, str, bool], settings: CheckSettings, opened: Opened | None, language: str
) -> check_page.TripCheck:
    path, picture, with_losses = item
    with speaking(language):
        return check_trip(path, replace(settings, with_losses=with_losses), picture, opened)


def next_steps(
    arguments: Namespace, checks: Sequence[check_page.TripCheck], names: Container[str], code: int
) -> list[str]:
    """Return lines with the command to run next; `code` is the exit code.

    Without the numbers of a vehicle, which is none of `names`, the next command is the
    check with them, whatever the code; otherwise the training on the folder, or with `run` the
    evaluation. There is none for single manifests, trips of several vehicles, and a suspension that
    has too few ready trips.
    """
    # a check without the vehicle's numbers says little: ask for them before anything else
    unchecked = {check.vehicle for check in checks if check.unchecked}
    if unknown := sorted(name for name in unchecked if name not in names):
        folder = own_vehicles(unknown[0])
        again = command("check", *arguments.trips, "--config-dir", folder or "DIR")
        where = f", where DIR is the folder with vehicle/{unknown[0]}.yaml"
        return [
            f"not checked without the numbers of {', '.join(unknown)}: {check_page.NEED_A_VEHICLE}",
            f"to check them too: {again}{where * (folder is None)}",
        ]
    vehicles = {check.vehicle for check in checks}
    ready_of = [
        [c for c in each if c.state == check_page.READY]
        for each in check_page.suspensions(checks).values()
    ]
    n_ready = [len(ready) for ready in ready_of]
    folder, *others = arguments.trips
    # a command that would fail or take part of the trips only is not proposed
    if any(check.unchecked for check in checks) or min(n_ready, default=0) < LEAST_TRIPS:
        return []
    if others or not folder.is_dir() or len(vehicles) != 1:
        return []
    when = "with the problems mended, run" if code else "then run"
    if any(NO_DIRECTION in check.remarks for ready in ready_of for check in ready):
        when = "with the direction of all trips stated, run"  # training refuses them without it
    if arguments.run:
        evaluation = command("evaluate", f"trips={folder}", f"run={listed(arguments.run)}")
        return [f"{when}: {evaluation}"]
    n_healthy = min(N_HEALTHY, *n_ready)
    at_centre = all(check.frame_sensor == "centre" for r in ready_of for check in r[:n_healthy])
    train = [
        *(["--config-dir", arguments.config_dir] if arguments.config_dir else []),
        *(f"healthy={folder}", f"n_healthy={n_healthy}"),
        *(["generator.frame_sensor=centre"] if at_centre else []),
    ]
    of_rig = all(check.is_rig for check in checks)
    of_each = "trips of each suspension by mileage are taken as healthy; give as many as were run "
    named = "before any wear, {NAME:number} of each"
    if of_rig:
        of_each = "records by start, or else by name, are taken as healthy; give as many as were "
        named = "made before any change"
    return [
        f"{when}: {command('train', *train)}",
        f"  n_healthy={n_healthy}: the first {n_healthy} {of_each}{named}",
    ]


def picture_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return a unique picture name for each manifest."""
    names = distinct(path.stem for path in paths)
    return {path: f"{name}.png" for path, name in zip(paths, names, strict=True)}


def _folder(wanted: Path | None) -> Path:
    """Make and return the output folder: the one given, or a new one named by the time."""
    if wanted is None:
        wanted = new_folder(Path(f"outputs/check/{datetime.now():%Y-%m-%d_%H-%M-%S}"))
    own_files.begin(wanted)
    return wanted
