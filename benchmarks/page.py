"""Time and memory of the fleet page of a large fleet, also while its state is worked out.

    python benchmarks/page.py --suspensions 1000 --trips 300
    python benchmarks/page.py --store postgresql://user:password@host/database

Suspensions are those of depot.py. Pages are asked for by Flask's client, and over HTTP from the
server of suspnet-serve (waitress), each in the process that also works out the state.
"""

from __future__ import annotations

import csv
import gc
import http.client
import io
import resource
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from depot import fleet
from flask.testing import FlaskClient
from waitress.server import create_server

from suspnet.depot.web.app import create_app
from suspnet.ground.records import TripCurves, TripResult
from suspnet.ground.storage import write_atomically
from suspnet.trains.history import History
from suspnet.trains.history.arrays import N_NEWEST
from suspnet.trains.pages.board import Board, BoardSettings, Refresher

RESULTS = Path(__file__).parent / "results" / "page.csv"
TODAY = "2025-10-28"
N_ASKED = 20
TARGET_S = 0.5
"""Time within which the page of the fleet is to answer, [s]."""
COLUMNS = ("what", "by", "n", "median_s", "worst_s", "processor_s", "kib", "peak_mib")
Row = dict[str, str | int | float]
Ask = Callable[[str], bytes]


def curves(seed: int, n_freq: int = 96) -> TripCurves:
    """Return transfer functions of two masses, with noise."""
    rng = np.random.default_rng(seed)
    frequencies = np.linspace(0.25, 12.0, n_freq)
    relative = frequencies / np.array([[5.0], [1.2]])
    responses = (1 + 0.3j * relative) / (1 - relative**2 + 0.3j * relative)
    deviations = np.full((2, n_freq), 0.05)
    none = np.zeros((3, 0))
    return TripCurves(
        frequencies,
        responses * np.exp(deviations * rng.normal(size=deviations.shape)),
        np.full((2, n_freq), 0.9),
        deviations,
        *(none[0], none, none, none, none[0]),
    )


def with_curves(found: list[TripResult], seed: int) -> list[TripResult]:
    """Return trips of which those have curves that a history keeps."""
    chosen = {0, *range(len(found) - N_NEWEST, len(found))}
    return [replace(r, curves=curves(seed)) if i in chosen else r for i, r in enumerate(found)]


def peak_mib() -> float:
    """Return the largest memory of this process so far, [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def row(what: str, by: str, seconds: list[float], processor_s: float = 0.0, size: int = 0) -> Row:
    """Return a row of the results, and print it."""
    numbers = np.median(seconds), np.max(seconds), processor_s, size / 1024, peak_mib()
    values = (what, by, len(seconds), *(float(f"{number:.4g}") for number in numbers))
    found = dict(zip(COLUMNS, values, strict=True))
    print("  ".join(f"{key} {value}" for key, value in found.items()), flush=True)
    return found


def measured(what: str, by: str, function: Callable[[], object]) -> Row:
    """Return the row of what is done once."""
    wall, processor = time.perf_counter(), time.process_time()
    function()
    seconds = time.perf_counter() - wall
    return row(what, by, [seconds], time.process_time() - processor)


def asked(what: str, by: str, ask: Ask, address: str) -> Row:
    """Return the row of a page that is asked for ``N_ASKED`` times, from the first time on."""
    seconds, processor, content = [], time.process_time(), b""
    for _ in range(N_ASKED):
        begin = time.perf_counter()
        content = ask(address)
        seconds.append(time.perf_counter() - begin)
    return row(what, by, seconds, (time.process_time() - processor) / N_ASKED, len(content))


def asked_while(what: str, by: str, ask: Ask, working: threading.Thread) -> Row:
    """Return the row of the fleet's page, asked for every half second while a thread works."""
    seconds, content = [], b""
    while working.is_alive():
        begin = time.perf_counter()
        content = ask("/")
        seconds.append(time.perf_counter() - begin)
        working.join(0.5)
    return row(what, by, seconds, size=len(content))


def over_http(port: int) -> Ask:
    """Return a function that asks a server of this computer, over one connection each time."""

    def ask(address: str) -> bytes:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("GET", address)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        if answer.status != 200:
            raise RuntimeError(f"{address}: {answer.status} {answer.reason}")
        return content

    return ask


def by_client(client: FlaskClient) -> Ask:
    """Return a function that asks the application without a network."""

    def ask(address: str) -> bytes:
        answer = client.get(address)
        if answer.status_code != 200:
            raise RuntimeError(f"{address}: {answer.status}")
        return answer.data

    return ask


def pages(ask: Ask, by: str, name: str) -> list[Row]:
    """Return the rows of each page and figure."""
    addresses = {
        "page of the fleet": "/",
        "page of one train": "/?train=3",
        "page of the plan": "/plan",
        "page of a suspension": f"/suspension/{name}",
        "figure of its trends": f"/suspension/{name}/trend.svg",
        "figure of its responses": f"/suspension/{name}/responses.svg",
        "question for news": "/state",
    }
    return [asked(what, by, ask, address) for what, address in addresses.items()]


def write_new_trips(store: str, numbers: Iterable[int]) -> None:
    """Write one more trip of some suspensions, one at a time, as a monitor does."""
    with History(store) as history:
        places = history.places()
        for number in numbers:
            last = history.read(*places[number])[-1]
            km, name = last.mileage_km + 2000.0, f"{last.trip}+"
            history.write([replace(last, trip=name, mileage_km=km, curves=curves(number))])


def measure(store: str, settings: BoardSettings) -> list[Row]:
    """Return all rows."""
    board = Board(store, settings)
    refresher = Refresher(board, 3600.0)
    app = create_app(refresher)
    ask = by_client(app.test_client())
    server = create_server(app, host="127.0.0.1", port=0, threads=8)
    threading.Thread(target=server.run, daemon=True).start()
    http_ask = over_http(server.effective_port)
    rows = []
    gc.collect()
    gc.freeze()  # as suspnet-serve does: what the imports made is not walked again and again
    working = threading.Thread(
        target=lambda: rows.append(measured("first view of all", "thread", board.refresh))
    )
    begin = time.perf_counter()
    working.start()
    while not board.view.states:
        time.sleep(0.01)
    rows.append(row("until something is shown", "thread", [time.perf_counter() - begin]))
    rows.append(asked_while("page of the fleet, first view not done", "HTTP", http_ask, working))
    name = next(iter(board.view.keys))
    rows += pages(ask, "client", name) + pages(http_ask, "HTTP", name)
    rows.append(measured("nothing new", "refresh", board.refresh))
    for number in (0, 5):
        write_new_trips(store, [number])
        rows.append(measured("view after one new trip", "refresh", board.refresh))
    write_new_trips(store, range(len(board.view.states)))
    working = threading.Thread(
        target=lambda: rows.append(
            measured("view after a new trip of each", "thread", board.refresh)
        )
    )
    working.start()
    rows.append(asked_while("page of the fleet, these worked out", "HTTP", http_ask, working))
    return rows


def main() -> None:
    """Write, ask and measure."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--suspensions", type=int, default=1000)
    parser.add_argument("--trips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", help="URL of an empty history; a file of its own if not given")
    parser.add_argument("--output", type=Path, default=RESULTS, help="file of the results")
    given = parser.parse_args()
    print(f"{given.suspensions} suspensions of {given.trips} trips, seed {given.seed}")
    with tempfile.TemporaryDirectory() as folder:
        store = given.store or f"{folder}/history.db"
        with History(store) as history:
            for i, made in enumerate(fleet(given.suspensions, given.trips, given.seed)):
                history.write(with_curves(made, i))
        rows = [row("the program before it reads the store", "start", [0.0])]
        rows += measure(store, BoardSettings(today=TODAY, seed=given.seed))
    lines = csv.DictWriter(stream := io.StringIO(), COLUMNS, lineterminator="\n")
    lines.writeheader()
    lines.writerows(rows)
    write_atomically(given.output, stream.getvalue())
    slowest = max(float(r["worst_s"]) for r in rows if r["what"] == "page of the fleet")
    if slowest > TARGET_S:
        sys.exit(f"the page of the fleet took up to {slowest:.2f} s, {TARGET_S} s are allowed")


if __name__ == "__main__":
    main()
