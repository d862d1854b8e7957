"""Write manifests from data files, or a vehicle's file: suspnet init DIR | FILE ... | --vehicle."""

import os
import re
from argparse import Namespace
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from shlex import join
from string import Template

from suspnet.cli.config_files import is_shipped, own_vehicles
from suspnet.ground.storage import printable, write_atomically
from suspnet.ground.wording import command, count
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.trips import folder_manifests as folders
from suspnet.trains.trips.rig_manifests import as_record, as_said_for_trips, rig_words
from suspnet.trains.trips.trip_files import TripFiles, find_trip_files, read_table, table_of

ASSUMED = {
    "bogie": "the leading one",
    "axle": "the leading one of that bogie",
    "direction": "that which the phases show, else asked for by check and train",
    "train": "another one for each suspension",
}
"""What is assumed of each key that no trip needs."""
NAME = re.compile(r"[A-Za-z_][\w.-]{0,99}", re.ASCII)
FORM = Template(resources.files("suspnet.cli").joinpath("vehicle_form.yaml").read_text("utf-8"))
"""The file of a vehicle ``$name``; ``???``, as Hydra marks it, is what the user has to give."""


def init(arguments: Namespace) -> int:
    """Write what the command line asks for and return the exit code.

    It is 1 if values are missing, or vehicles not known; nothing is then written. ValueError if
    files cannot be read (the message lists all of them), or if the manifest of a trip exists and is
    not to be replaced.
    """
    words = list(dict.fromkeys(map(str, arguments.files)))
    settings = [word for word in words if "=" in word and not Path(word).exists()]
    paths = [Path(word) for word in words if word not in settings]
    if arguments.vehicle is not None:
        return _write_vehicle(arguments.vehicle, paths, settings, arguments.force)
    if not paths:
        raise ValueError("give a folder of data files, or the files of one trip")
    try:
        return _write(paths, settings, arguments)
    except TripError as error:
        raise ValueError("; ".join(error.problems)) from error


def _write_vehicle(name: str, paths: Sequence[Path], words: Sequence[str], force: bool) -> int:
    """Write DIR/vehicle/NAME.yaml with marks where numbers are to be filled in, and return 0.

    ValueError if the name is wrong, or the file exists and is not replaced.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"--vehicle must be a plain name without blanks, got {name!r}")
    if len(paths) > 1 or words:
        raise ValueError("give the folder of vehicles alone: numbers are filled in in the file")
    path = (paths[0] if paths else Path("vehicles")) / "vehicle" / f"{name}.yaml"
    if os.path.lexists(path) and not force:
        raise ValueError(f"{path} exists; --force replaces it")
    write_atomically(path, FORM.substitute(name=name))
    option = "--config-dir", path.parents[1]
    print(
        printable(
            f"-> {path}: fill in each ???\nuse it: {command('check', 'DIR', *option)}\n"
            f"        {command('train', *option, f'vehicle={name}')} ..."
        )
    )
    return 0


def _write(paths: Sequence[Path], settings: Sequence[str], arguments: Namespace) -> int:
    # what is known of the trips: their files, the command line, and a table
    is_rig = _is_rig(settings, arguments.config_dir)
    said = as_said_for_trips(settings) if is_rig else settings
    table, keys = arguments.table, folders.read_settings(said)
    if len(paths) == 1 and paths[0].is_dir():
        if arguments.output:
            raise ValueError("--output is for the manifest of one trip; a folder's lie in it")
        (folder,) = paths
        tables = [table] if table else []
        trip_files = find_trip_files(folder, tables, folders.loggers_of(keys))
    else:
        path = arguments.output or paths[0].with_suffix(".yaml")
        if path.suffix != ".yaml":
            raise ValueError(f"the name of a manifest must end with .yaml, got {path}")
        if os.path.lexists(path) and not arguments.force:
            raise ValueError(f"{path} exists; --force replaces it, --output writes another")
        folder, trip_files = path.parent, [TripFiles(path, tuple(paths))]
    rows = read_table(table) if table and table.exists() else {}
    vehicles = arguments.config_dir or own_vehicles(keys.get("vehicle", ""))
    try:
        trips = folders.folder_manifests(trip_files, folder, keys, rows, vehicles)
    except ValueError as error:
        if not is_rig or isinstance(error, TripError):
            raise
        words = str(error).replace(folders.OF_OTHER_AXLE, "").replace("one or two", "one")
        raise ValueError(rig_words(words)) from error
    if is_rig:
        trips = [as_record(trip) for trip in trips]
    noun = "record" if is_rig else "trip"
    # a manifest may have been edited by hand, so it is replaced on request only
    new = [trip for trip in trips if arguments.force or not os.path.lexists(trip.path)]
    missing = list(dict.fromkeys(key for trip in new for key in trip.missing))
    of_vehicles = [] if vehicles is None else ["--config-dir", str(vehicles)]
    options = [*(["--table", str(table)] if table else []), *of_vehicles]
    wrong = _unknown_vehicles(vehicles, new)
    # write all manifests or none: a folder half done would be checked and trained as it is
    if missing or wrong:
        print(f"{count(len(new), noun)} in {folder}; nothing is written yet; ", end="")
        print(f"these are {'missing or wrong' if wrong else 'missing'}:", *wrong, sep="\n")
        for key in missing:
            without = [trip for trip in new if key in trip.missing]
            where = "" if len(without) == len(new) else f" (in {len(without)} of them)"
            print(printable(f"  {key}{where}: {folders.how_to_say(key)}"))
        if without := [trip for trip in new if any(key not in folders.HOW for key in trip.missing)]:
            print(printable(f"  columns: {folders.names_of_columns(without)}"))
        if table and not table.exists() and "mileage_km" in missing:
            firsts = ((trip.files[0].relative_to(folder), trip.stated) for trip in new)
            write_atomically(table, table_of(firsts))
            print(f"-> {table}: fill in its columns, then run the same command again")
        right = [word for word in settings if not (wrong and word.startswith("vehicle="))]
        again = f"{command('init', *paths, *right)} KEY=VALUE ... {printable(join(options))}"
        said_once = f"say each once for all trips: {again.rstrip()}"
        print(*([] if is_rig else _assumed(new)), said_once, sep="\n")
        return 1
    for trip in new:
        write_atomically(trip.path, trip.text)
    n_old = len(trips) - len(new)
    old = f"; {count(n_old, 'manifest')} left as they were, --force replaces them" if n_old else ""
    print(f"-> {folder}: {count(len(new), 'manifest')} of {count(len(trip_files), noun)}{old}")
    for line in folders.origins(new):
        print(printable(f"  {line}"))
    checked = folder if paths == [folder] else trip_files[0].path
    if not is_rig:
        print(*_assumed(new), sep="\n")
    print(f"then run: {command('check', checked, *of_vehicles)}")
    return 0


def _is_rig(words: Sequence[str], config_dir: Path | None) -> bool:
    """Return whether the vehicle that KEY=VALUE names is a rig of the user's."""
    name = next((word.partition("=")[2] for word in words if word.startswith("vehicle=")), "")
    folder = config_dir or own_vehicles(name)
    if name in _rigs(folder):
        return True
    if any(word.startswith(("channels.base=", "channels.frame=")) for word in words):
        raise ValueError(
            f"`base` and `frame` are of rigs, and vehicle={name} is not known as one: say "
            "vehicle=NAME and give --config-dir DIR, the folder with vehicle/NAME.yaml, in which "
            "`kind: rig` stands"
        )
    return False


def _rigs(folder: Path | None) -> set[str]:
    if folder is None:
        return set()
    from suspnet.cli.kinds import read_rigs  # with Hydra

    return {rig.name for rig in read_rigs(folder).values()}


def _unknown_vehicles(folder: Path | None, trips: Sequence[folders.Trip]) -> list[str]:
    """Return a line on each vehicle of the trips that neither the folder nor suspnet has."""
    names: set[str] = set()
    if folder is not None:
        from suspnet.cli.kinds import vehicles_with  # with Hydra

        names = {vehicle.name for vehicle in vehicles_with(folder).values()} | _rigs(folder)
    stated = dict.fromkeys(t.stated["vehicle"] for t in trips if "vehicle" in t.stated)
    return [
        printable(
            f"  vehicle: {vehicle.value!r} ({vehicle.source}) is no vehicle of suspnet's"
            f"{f', nor of {folder}' if folder else ''}: vehicle=am96 or another of them says it "
            "for all trips; of yours, give --config-dir DIR, the folder with "
            f"vehicle/{vehicle.value}.yaml, which suspnet init --vehicle writes"
        )
        for vehicle in stated
        if str(vehicle.value) not in names and not is_shipped(str(vehicle.value))
    ]


def _assumed(trips: Sequence[folders.Trip]) -> list[str]:
    """Return a line on the keys of ``ASSUMED`` that are not stated, with the number of trips."""
    missing = {key: sum(key not in trip.stated for trip in trips) for key in ASSUMED}
    listed = "; ".join(f"{key} ({n}): {ASSUMED[key]}" for key, n in missing.items() if n)
    return [f"  assumed unless KEY=VALUE or a table states it: {listed}"] if listed else []
