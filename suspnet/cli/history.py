"""Show a history, add maintenance and acknowledgements, write tables: suspnet history STORE ..."""

import logging
from argparse import Namespace
from collections.abc import Callable
from dataclasses import asdict
from math import isfinite
from typing import Any

import numpy as np
import pyarrow as pa
from tabulate import tabulate

from suspnet.ground import own_files
from suspnet.ground.parameters import Cause
from suspnet.ground.progress import LineFormatter
from suspnet.ground.records import PLACE, Place, TripResult, outputs_of
from suspnet.ground.storage import printable, write_table
from suspnet.ground.wording import thousands
from suspnet.trains.history import History, HistoryError
from suspnet.trains.history.database import check_exists
from suspnet.trains.history.outbox import MOST_LISTED
from suspnet.trains.history.store import acknowledge_alarms
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, newest_of
from suspnet.trains.maintenance.series import Event


def history(arguments: Namespace) -> None:
    """Do what the command line says.

    HistoryError if the store is missing or cannot be used, ValueError if an event or an
    acknowledgement is not valid.
    """
    check_exists(arguments.store)
    with History(arguments.store) as store:
        # printable: whoever acknowledges writes what is printed here
        print(printable(COMMANDS[arguments.does](store, arguments)))


def _listed(store: History, _: Namespace) -> str:
    rows = []
    for series in store.series():
        km = series.mileage_km[np.isfinite(series.mileage_km)]
        span = f"{thousands(km[0])} to {thousands(km[-1])}" if len(km) else ""
        row = [series.vehicle, series.place, len(series.trip), int(series.done.sum()), span]
        rows.append([*row, "; ".join(map(str, series.events))])
    header = ["vehicle", "suspension", "trips", "with estimate", "km", "maintenance"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def _event(store: History, arguments: Namespace) -> str:
    event = Event(arguments.at_km, arguments.kind, arguments.words)
    store.add_event(arguments.vehicle, _place(arguments), event)
    return f"{_place(arguments)}: {event}"


def _alarms(store: History, arguments: Namespace) -> str:
    """Return a table of alarms, the worst first, those not acknowledged before the others."""
    seen = store.all_acknowledgements()
    chosen = [
        (alarm, newest_of(alarm, seen.get(key, [])), key)
        for key, alarms in store.all_alarms().items()
        for alarm in alarms
        if alarm.is_open or arguments.all
    ]
    if not chosen:
        return "no alarm" if arguments.all else "no open alarm"
    chosen.sort(key=lambda row: (not row[0].is_open, -row[0].severity, row[1] is not None))
    rows = [
        [
            *(str(alarm.severity), *key, alarm.parameter, alarm.cause),
            thousands(alarm.begin_km)
            if alarm.is_open
            else f"{thousands(alarm.begin_km)} to {thousands(alarm.end_km)}",
            alarm.words,
            f"{by.by}, {by.at[:10]}{': ' * bool(by.words)}{by.words}" if by else "",
        ]
        for alarm, by, key in chosen
    ]
    header = ["severity", "vehicle", "suspension", "parameter", "cause", "since km"]
    header += ["words", "acknowledged"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def _acknowledge(store: History, arguments: Namespace) -> str:
    vehicle, place = arguments.vehicle, _place(arguments)
    causes = [arguments.cause] if arguments.cause else list(Cause)
    chosen = [
        alarm
        for alarm in store.alarms(vehicle, place)
        if alarm.is_open and alarm.parameter == arguments.parameter and alarm.cause in causes
    ]
    if not chosen:
        raise HistoryError(
            f"{store}: {vehicle}: {place} has no open alarm of {arguments.parameter}"
            f"{f' with cause {arguments.cause}' * bool(arguments.cause)}; suspnet history STORE "
            "alarms lists all"
        )
    newest = max(r.mileage_km for r in store.read(vehicle, place) if isfinite(r.mileage_km))
    by = arguments.by, arguments.words
    seen = acknowledge_alarms(store, vehicle, place, chosen, newest, *by)
    names = ", ".join(f"{alarm.parameter} ({alarm.cause}, {alarm.severity!s})" for alarm in seen)
    return f"{place}: {names} acknowledged by {arguments.by} at {thousands(newest)} km"


def _export(store: History, arguments: Namespace) -> str:
    tables: dict[str, list[dict[str, Any]]] = {
        name: [] for name in ("trips", "events", "alarms", "acknowledgements")
    }
    several: list[list[TripResult]] = []
    for vehicle, place in store.places():
        results = store.read(vehicle, place)
        several.append(results)
        where = {"vehicle": vehicle, **asdict(place)}
        for name in list(tables)[1:]:
            entries = getattr(store, name)(vehicle, place)
            tables[name] += [where | _plain(entry) for entry in entries]
    outputs = outputs_of(result for results in several for result in results)
    tables["trips"] = [result.row(outputs) for results in several for result in results]
    own_files.begin(arguments.folder)
    for name, rows in tables.items():
        if rows:
            write_table(pa.Table.from_pylist(rows), arguments.folder / name)
    counts = [f"{len(rows)} {name}" for name, rows in tables.items()]
    return f"{', '.join(counts[:-1])} and {counts[-1]} -> {arguments.folder}"


def _notify(store: History, arguments: Namespace) -> str:
    """Send what is new once, or until a signal ends the program."""
    from suspnet.depot.live.notifier import Notifier, read_rules

    notifier = Notifier(store, read_rules(arguments.rules))
    if arguments.retry:
        store.outbox().retry()
    if arguments.follow:
        logging.basicConfig(level=logging.INFO)
        logging.getLogger().handlers[0].setFormatter(LineFormatter())
        notifier.run()
    n_sent, n_failed = notifier.once()
    lines = [f"{n_sent} sent, {n_failed} failed"]
    for row in store.outbox().unsent():
        error = f": {row['error']}" if row["error"] else ""
        lines.append(f"not sent: {row['kind']} to {row['recipient']} by {row['channel']}{error}")
    n_more = sum(store.outbox().count_unsent()[:2]) - MOST_LISTED
    if n_more > 0:
        lines.append(f"and {n_more} more that are not sent")
    if n_failed:
        raise HistoryError("; ".join(lines))
    return "\n".join(lines)


def _plain(entry: Event | Alarm | Acknowledgement) -> dict[str, Any]:
    """Return an entry of the store as a row of a table, with its severity's name."""
    row = asdict(entry)
    return row | {name: str(row[name]) for name in ("severity", "cause") if name in row}


def _place(arguments: Namespace) -> Place:
    return Place(**{name: getattr(arguments, name) for name in PLACE})


COMMANDS: dict[str, Callable[[History, Namespace], str]] = {
    "list": _listed,
    "event": _event,
    "alarms": _alarms,
    "acknowledge": _acknowledge,
    "export": _export,
    "notify": _notify,
}
"""Function of each command."""
