"""Look into a history, add maintenance, write tables: suspnet-history STORE ..."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from dataclasses import asdict
from pathlib import Path

import pyarrow as pa
from tabulate import tabulate

from suspnet.cli import program
from suspnet.dynamics import PARAMETERS
from suspnet.history import Event, History, HistoryError
from suspnet.history.records import OK
from suspnet.history.schema import PLACE
from suspnet.history.store import KINDS
from suspnet.recordings.manifest import Place
from suspnet.trips.output import write_table

DESCRIPTION = """\
The history of a fleet, as evaluate.py trips=DIR store=STORE keeps it: what is in it, maintenance
that was done, and all of it as tables."""

EPILOG = """\
  suspnet-history fleet.db list
  suspnet-history fleet.db event --vehicle am96 --suspension "car 7, left" --at-km 120000 \\
      --kind exchanged --words "new primary dampers"
  suspnet-history fleet.db export tables

STORE is a file, or postgresql://user:password@host/database."""


def parser() -> ArgumentParser:
    """Return what the command line may hold."""
    found = ArgumentParser(
        "suspnet-history",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
    )
    found.add_argument("store", metavar="STORE", help="the store [path or URL]")
    does = found.add_subparsers(dest="does", required=True, metavar="list | event | export")
    does.add_parser("list", help="each suspension with its trips and maintenance")
    event = does.add_parser(
        "event", help="add maintenance: tests for changes, and the report's words, begin anew there"
    )
    event.add_argument("--vehicle", required=True, help="as in the manifests [text]")
    for name in PLACE:
        event.add_argument(
            f"--{name}", default="", help="as in the manifests, if it stands there [text]"
        )
    event.add_argument(
        "--at-km", type=float, required=True, metavar="KM", help="mileage at which it was done [km]"
    )
    event.add_argument("--kind", choices=KINDS, default="other", help="[other if not given]")
    event.add_argument("--words", default="", help="what was done [text]")
    export = does.add_parser("export", help="write trips and events as Parquet and CSV")
    export.add_argument("folder", type=Path, metavar="DIR", help="where to [path]")
    return found


def history(arguments: Namespace) -> None:
    """Do what the command line says.

    Raises
    ------
    HistoryError
        If there is no store, or it cannot be used.
    ValueError
        If an event is not valid.
    """
    if "://" not in arguments.store and not Path(arguments.store).is_file():
        raise HistoryError(
            f"{arguments.store}: there is no such file; evaluate.py trips=DIR store=FILE makes one"
        )
    with History(arguments.store) as store:
        if arguments.does == "event":
            place = Place(**{name: getattr(arguments, name) for name in PLACE})
            event = Event(arguments.at_km, arguments.kind, arguments.words)
            store.add_event(arguments.vehicle, place, event)
            print(f"{place}: {event}")
        elif arguments.does == "export":
            print(_export(store, arguments.folder))
        else:
            print(_listed(store))


def _listed(store: History) -> str:
    """Return a table of the suspensions."""
    rows = []
    for vehicle, place in store.places():
        results = store.read(vehicle, place)
        known = [r.mileage_km for r in results if r.mileage_km == r.mileage_km]
        span = f"{min(known):,.0f} to {max(known):,.0f}".replace(",", " ") if known else ""
        n_done = sum(r.status == OK for r in results)
        done = "; ".join(map(str, store.events(vehicle, place)))
        rows.append([vehicle, place, len(results), n_done, span, done])
    header = ["vehicle", "suspension", "trips", "with estimate", "km", "maintenance"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def _export(store: History, folder: Path) -> str:
    """Write trips and events as tables and say where they are."""
    trips, events = [], []
    for vehicle, place in store.places():
        trips += [result.row(PARAMETERS) for result in store.read(vehicle, place)]
        where = {"vehicle": vehicle, **asdict(place)}
        events += [where | asdict(event) for event in store.events(vehicle, place)]
    for name, rows in (("trips", trips), ("events", events)):
        if rows:
            write_table(pa.Table.from_pylist(rows), folder / name)
    return f"{len(trips)} trips and {len(events)} events -> {folder}"


def main() -> None:
    """Run the program."""
    arguments = parser().parse_args()
    program.run(lambda: history(arguments))
