"""Write manifests from data files, or a vehicle's file: suspnet init DIR | FILE ... | --vehicle."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shlex import join, quote

from suspnet.cli.config_files import is_shipped, own_vehicles
from suspnet.ground.records import Place
from suspnet.ground.storage import printable, write_atomically
from suspnet.ground.wording import command, count
from suspnet.trains.recordings.errors import TripError, all_of
from suspnet.trains.trips import folder_manifests as folders
from suspnet.trains.trips.file_contents import Signal, look_into
from suspnet.trains.trips.grouping import lone_trains
from suspnet.trains.trips.manifest_template import template
from suspnet.trains.trips.trip_files import find_tables, find_trip_files, unread_files

LEFT_OPEN = {
    "bogie": "is taken as the leading one, which decides how the other bogie and the body's pitch "
    "add to its motion: bogie=leading or trailing, as the vehicle runs forward",
    "axle": "is taken as the leading one of that bogie: axle=leading or trailing, at which the "
    "sensors are",
    "direction": "is found where the phases show it, else asked for by check and train: "
    "direction=forward or reverse",
    "train": "is taken as another one for each suspension, which the plan calls in by itself: "
    "train=12 if they are of one train, and car=7 if of one car",
}
"""Default of each key that no trip needs, and how to state the key."""
FRAME_PLACE = (
    "  the frame's sensor is taken as above the measured axle; if it is at the frame's centre, "
    "train with generator.frame_sensor=centre; check compares both where rigid bodies explain a "
    "trip"
)
"""What holds for the place that no manifest gives."""


def init(arguments: Namespace) -> int:
    """Write what the command line asks for and return the exit code.

    It is 1 if values are missing, or vehicles not known; the manifests of a folder are then not
    written. ValueError if files cannot be read (the message lists all of them), or if a manifest
    exists and is not to be replaced.
    """
    words = list(dict.fromkeys(map(str, arguments.files)))
    settings = [word for word in words if "=" in word and not Path(word).exists()]
    paths = [Path(word) for word in words if word not in settings]
    if arguments.vehicle is not None:
        from suspnet.cli.vehicle_form import write_vehicle

        return write_vehicle(arguments.vehicle, paths, settings, arguments.force)
    if not paths:
        raise ValueError("give a folder of data files, or the files of one trip")
    try:
        if len(paths) == 1 and paths[0].is_dir():
            return _folder(paths[0], settings, arguments)
        if settings or arguments.table:
            raise ValueError(
                f"{(*settings, '--table')[0]} is for a folder: suspnet init DIR KEY=VALUE"
            )
        return _one_trip(paths, arguments)
    except TripError as error:
        raise ValueError("; ".join(error.problems)) from error


def _one_trip(files: Sequence[Path], arguments: Namespace) -> int:
    path = arguments.output or files[0].with_suffix(".yaml")
    if path.suffix != ".yaml":
        raise ValueError(f"the name of a manifest must end with .yaml, got {path}")
    if os.path.lexists(path) and not arguments.force:
        raise ValueError(f"{path} exists; --force replaces it, --output writes another")
    _unknown_vehicles(arguments.config_dir, [])  # raises if there is no such folder
    seen = all_of(partial(look_into, file) for file in files)
    signals = [signal for columns, _ in seen for signal in columns]
    read_as = [how for _, how in seen if how]
    manifest = template(signals, path, read_as, config_dir=arguments.config_dir)
    write_atomically(path, manifest.text, force=arguments.force)
    for line in _untimed(signals):
        print(printable(line))
    print(
        f"-> {path}: {count(len(signals), 'column')} of {count(len(files), 'file')}\n"
        f"fill in: {', '.join(manifest.blanks) or 'nothing'}\n"
        f"guessed, to be checked: {', '.join(manifest.guesses) or 'nothing'}\n"
        f"then run: {command('check', path, *_known_vehicles(arguments.config_dir, []))}"
    )
    return 0


def _folder(folder: Path, settings: Sequence[str], arguments: Namespace) -> int:
    """Write the manifests of all trips of a folder, or print what is missing for them."""
    if arguments.output:
        raise ValueError("--output is for the manifest of one trip; a folder's lie in it")
    # what is known of the trips: their files, the command line, and a table
    table, tables = arguments.table, find_tables(folder)
    keys = folders.read_said(settings)
    tables_of_trips = [*tables, *([table] if table else [])]
    trip_files = find_trip_files(folder, tables_of_trips, folders.loggers_of(keys))
    rows = folders.read_table(table) if table and table.exists() else {}
    vehicles = arguments.config_dir or own_vehicles(keys.get("vehicle", ""))
    trips = folders.folder_manifests(trip_files, folder, keys, rows, vehicles)
    new = [trip for trip in trips if arguments.force or not os.path.lexists(trip.path)]
    missing = list(dict.fromkeys(key for trip in new for key in trip.missing))
    of_vehicles = _known_vehicles(vehicles, new)
    options = [*(["--table", str(table)] if table else []), *of_vehicles]
    # remarks come first, so that the list of what is missing, or the next command, ends the output
    for path in tables:
        if table is None or path.resolve() != table.resolve():
            print(printable(f"{path} is a table of trips, which --table {quote(str(path))} reads"))
    signals = [signal for trip in new for signal in trip.signals]
    for line in (*unread_files(folder), *_untimed(signals)):
        print(printable(line))
    wrong = _unknown_vehicles(vehicles, new)
    if missing or wrong:
        print(f"{count(len(new), 'trip')} in {folder}; nothing is written yet; ", end="")
        print(f"these are {'missing or wrong' if wrong else 'missing'}:", *wrong, sep="\n")
        _print_missing(missing, new)
        if table and not table.exists() and "mileage_km" in missing:
            write_atomically(table, folders.table_of(new, folder))
            print(f"-> {table}: fill in its columns, then run the same command again")
        right = [word for word in settings if not (wrong and word.startswith("vehicle="))]
        again = f"{command('init', folder, *right)} KEY=VALUE ... {printable(join(options))}"
        print(*_left_open(new), f"say each once for all trips: {again.rstrip()}", sep="\n")
        return 1
    for trip in new:
        write_atomically(trip.path, trip.manifest.text, force=arguments.force)
    n_old = len(trips) - len(new)
    old = f"; {count(n_old, 'manifest')} left as they were, --force replaces them" * (n_old > 0)
    print(f"-> {folder}: {count(len(new), 'manifest')} of {count(len(trip_files), 'trip')}{old}")
    for line in folders.origins(new):
        print(printable(f"  {line}"))
    print(
        *_left_open(new, [*settings, *options]),
        f"then run: {command('check', folder, *of_vehicles)}",
        sep="\n",
    )
    return 0


def _print_missing(missing: Sequence[str], trips: Sequence[folders.Trip]) -> None:
    """Print each missing key, in how many trips it is missing, and how to state it."""
    for key in missing:
        without = [trip for trip in trips if key in trip.missing]
        where = "" if len(without) == len(trips) else f" (in {len(without)} of them)"
        print(printable(f"  {key}{where}: {folders.how_to_say(key, without)}"))
    if any(key.startswith("channels.") for key in missing) and folders.hint_at_one_trip(trips):
        print(printable(folders.hint_at_one_trip(trips)))


def _untimed(signals: Sequence[Signal]) -> list[str]:
    """Return a line on the first file whose times are not used, with the number of others."""
    files = {signal.file: signal.untimed for signal in signals if signal.untimed}
    more = f" (likewise {count(len(files) - 1, 'other file')})" if len(files) > 1 else ""
    return [words + more for words in files.values()][:1]


def _known_vehicles(folder: Path | None, trips: Sequence[folders.Trip]) -> list[str]:
    """Return the option that names the user's own vehicles, for the next command.

    Without it, a line explains the option for a vehicle that suspnet does not have.
    """
    if folder is not None:
        return ["--config-dir", str(folder)]
    names = {str(trip.known["vehicle"].value) for trip in trips if "vehicle" in trip.known}
    own = sorted(name for name in names if not is_shipped(name))
    for name in own:
        print(
            printable(
                f"{name} is no vehicle of suspnet's: say vehicle=am96 or another of them if that "
                "is a number of the train, or give --config-dir DIR, the folder with "
                f"vehicle/{name}.yaml ({command('init', '--vehicle', name)} writes "
                "one to fill in); without it swapped sensors, units and signs are not checked"
            )
        )
    return ["--config-dir", "DIR"] if own else []


def _unknown_vehicles(folder: Path | None, trips: Sequence[folders.Trip]) -> list[str]:
    """Return a line on each vehicle of the trips that neither the folder nor suspnet has."""
    if folder is None:
        return []
    from suspnet.cli.kinds import vehicles_with  # with Hydra

    names = sorted({vehicle.name for vehicle in vehicles_with(folder).values()})
    stated = dict.fromkeys(t.known["vehicle"] for t in trips if "vehicle" in t.known)
    return [
        printable(
            f"  vehicle: must be one of {', '.join(names)}, got {vehicle.value!r} "
            f"({vehicle.source}); vehicle=NAME says it for all trips"
        )
        for vehicle in stated
        if vehicle.value not in names
    ]


def _vehicle_and_place(trip: folders.Trip) -> tuple[str, Place]:
    values = {key: str(stated.value) for key, stated in trip.known.items()}
    keys = ("suspension", "train", "car")
    return values.get("vehicle", ""), Place(**{key: values.get(key, "") for key in keys})


def _left_open(trips: Sequence[folders.Trip], settings: Sequence[str] | None = None) -> list[str]:
    """Return a line on each of ``LEFT_OPEN`` that is not stated.

    Where trips of several folders lack the bogie, the command of each folder follows, with the
    words of the command line in `settings`; None: before the manifests are written.
    """
    lines = []
    for key, words in LEFT_OPEN.items():
        if key == "train" and not lone_trains(map(_vehicle_and_place, trips)):
            continue
        if n := sum(key not in trip.known for trip in trips):
            lines.append(f"  {key}, not stated in {n}, {words}, or in a table")
        if key == "bogie" and settings is not None:
            without = dict.fromkeys(trip.path.parent for trip in trips if key not in trip.known)
            for folder in without if len({trip.path.parent for trip in trips}) > 1 else ():
                again = command("init", folder, "--force", *settings, "bogie=leading")
                lines.append(f"    of {folder} alone: {again} (or trailing)")
    return [*lines, FRAME_PLACE] if trips and settings is not None else lines
