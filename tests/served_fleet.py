"""A small fleet in a store, and the application that serves it, for the tests of the pages."""

import socket
import threading
from contextlib import contextmanager

import numpy as np
from depot_trips import SPREAD, read_trip
from trip_records import curves
from waitress import wasyncore

from suspnet.depot.web.app import create_app, http_server
from suspnet.ground.parameters import COMPONENTS
from suspnet.ground.records import Place
from suspnet.trains.history import History
from suspnet.trains.pages.board import Board, BoardSettings, Refresher

N_TRIPS = 30
EVIL = "<script>window.evil = 1</script>"
SPREAD_OF_PARTS = {name: 0.005 if name[0] == "c" else 0.001 for name in COMPONENTS}
FAILED = Place("", "leading", "left", "12", "3")
WORN = Place("", "trailing", "left", "12", "3")
HEALTHY = Place("", "leading", "right", "9", "1")
NAMED_EVIL = Place(EVIL, train=EVIL, car="<u>1")
SETTINGS = BoardSettings(today="2026-03-01")


def trips(place, seed=0, wear=None, n_trips=N_TRIPS, begin=0, spread=SPREAD, worn=None):
    """Return trips of a suspension, 2000 km and three days apart; `wear` is of some parameters.

    `worn` gives the verdict on the parts of a bogie on each trip.
    """
    rng = np.random.default_rng([seed, begin])
    found = []
    for i in range(begin, begin + n_trips):
        values = {name: float(np.exp(s * rng.normal())) for name, s in spread.items()}
        for name, ratio in (wear or {}).items():
            values[name] *= ratio(i)
        more = {"flags": "beyond what was trained for" if i == 7 else ""}
        more |= {"worn": worn(i) if worn else ""}
        more |= {"curves": curves(seed=i) if i in (0, n_trips - 1) else None}
        found.append(read_trip(place, i, values, spread, **more))
    return found


def bogie_trips(place, seed=0, wear=None, worn=None, **options):
    """Return trips of a bogie with an estimate of each part."""
    return trips(place, seed, wear, spread=SPREAD_OF_PARTS, worn=worn, **options)


def fill(path):
    """Write a suspension that failed, one that wears, a healthy one, and one of evil names."""
    with History(path) as store:
        store.write(trips(FAILED, 1, {"k_s": lambda i: 1.5 if i > 26 else 1.0}))
        store.write(trips(WORN, 2, {"c_s": lambda i: 1 - 0.2 * max(i - 5, 0) / 25}))
        store.write(trips(HEALTHY, 3))
        store.write(trips(NAMED_EVIL, 4, {"k_p": lambda i: 0.5}))
    return path


@contextmanager
def served(path, every_s=0.3, access=None, **options):
    """Serve a store on a free port of this computer; give its address and the thread behind it."""
    refresher = Refresher(Board(str(path), SETTINGS), every_s)
    app = create_app(refresher, (), every_s, access)
    refresher.app = app
    server = http_server(app, socket.create_server(("127.0.0.1", 0)), 8, **options)
    thread = threading.Thread(target=server.run, daemon=True)
    refresher.start()
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.effective_port}", refresher
    finally:
        refresher.stop()
        server.task_dispatcher.shutdown(timeout=5)
        server.trigger.pull_trigger(lambda: wasyncore.close_all(server._map, ignore_all=True))
        thread.join(5)


def name_of(view, place):
    """Return the name of a suspension in addresses."""
    (found,) = [n for n, i in view.keys.items() if view.states[i].place == place]
    return found
