"""Time, memory and size of a history of many suspensions: written, read as arrays, alarms kept.

    python benchmarks/history.py --suspensions 1000 --trips 300
    python benchmarks/history.py --store postgresql://user:password@host/database

A store that is there already is not emptied.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import sqlalchemy as sql

from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place, Quality, TripResult
from suspnet.trains.history import History
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.vehicle import PARAMETERS

HALF_WIDTHS = {"k_p": 0.001, "c_p": 0.005, "k_s": 0.001, "c_s": 0.003, "M_s": 0.001}
HEALTHY = {"k_p": 1.3e6, "c_p": 3.7e3, "k_s": 0.69e6, "c_s": 22.6e3, "M_s": 6300.0}
QUALITY = Quality(
    *(0.93, 0.74, 95.4, 110, 120, 1200.0, 98.2, 69.8),
    speed_bins="69.8 m/s: 95 averages",
    faults="axle_box: gap of 2 samples (0.001 s), first at 12.340 s, repaired",
)
TRIP = TripResult("", "", "am96", status="ok", healthy_si=HEALTHY, quality=QUALITY, seconds=2.0)

T = TypeVar("T")


def place(number: int) -> Place:
    """Return one of the suspensions of a fleet: 8 cars a train, 4 a car."""
    car, corner = divmod(number, 4)
    names = [("leading", "left"), ("leading", "right"), ("trailing", "left"), ("trailing", "right")]
    return Place("primary and secondary", *names[corner], str(car // 8), str(car % 8))


def trips(number: int, n_trips: int, seed: int) -> list[TripResult]:
    """Return the trips of a suspension: every 2000 km and day, healthy, 5 % of them flagged."""
    rng = np.random.default_rng([seed, number])
    noise = np.exp(rng.normal(size=(n_trips, 5)) * list(HALF_WIDTHS.values()) / 1.64)
    half_widths = np.tile(list(HALF_WIDTHS.values()), (n_trips, 1)) * rng.uniform(
        0.8, 1.2, (n_trips, 1)
    )
    flags = rng.random(n_trips) < 0.05
    start = np.datetime64("2025-01-01T08:00:00")
    found = []
    for i in range(n_trips):
        values = dict(zip(PARAMETERS, noise[i].tolist(), strict=True))
        found.append(
            replace(
                TRIP,
                trip=f"trip_{i:04d}",
                manifest=f"/recordings/{number:04d}/trip_{i:04d}.yaml",
                place=place(number),
                mileage_km=2000.0 * (i + 1),
                start=str(start + np.timedelta64(i, "D")),
                estimates=values,
                half_widths=dict(zip(PARAMETERS, half_widths[i].tolist(), strict=True)),
                flags="the features lie 1.1 times the threshold" if flags[i] else "",
                temperature_c=float(rng.normal(10, 8)),
            )
        )
    return found


def timed(words: str, function: Callable[[], T]) -> T:
    """Return what a function does, and print its time of this process and of the wall."""
    wall, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
    found = function()
    after = resource.getrusage(resource.RUSAGE_SELF)
    print(
        f"{words:38s} user {after.ru_utime - before.ru_utime:6.1f} s"
        f"  system {after.ru_stime - before.ru_stime:5.1f} s"
        f"  wall {time.perf_counter() - wall:6.1f} s  peak memory {after.ru_maxrss / 1024:.0f} MiB"
    )
    return found


def written(store: History, n_suspensions: int, n_trips: int, seed: int) -> None:
    """Write all trips, those of a suspension at once, as evaluate.py does."""
    wall, spent = 0.0, 0.0
    for number in range(n_suspensions):
        made = trips(number, n_trips, seed)
        began = time.perf_counter(), time.process_time()
        store.write(made)
        wall, spent = wall + time.perf_counter() - began[0], spent + time.process_time() - began[1]
    print(f"{'writing alone':38s} cpu  {spent:6.1f} s  wall {wall:6.1f} s")


def alarms(store: History, n_suspensions: int) -> None:
    """Keep two alarms of each suspension."""
    both = [
        Alarm(name, Cause.CHANGE, Severity.NOTICE, 4e5, words="fell") for name in ("k_p", "c_s")
    ]
    for number in range(n_suspensions):
        store.keep_alarms("am96", place(number), both)


def size(store: str) -> float:
    """Return how much a store takes, [MiB]."""
    if "://" not in store:
        return Path(store).stat().st_size / 2**20
    url = sql.make_url(store).set(drivername="postgresql+psycopg")
    with sql.create_engine(url).connect() as connection:
        found = connection.execute(sql.text("SELECT pg_database_size(current_database())"))
        return float(found.scalar_one()) / 2**20


def main() -> None:
    """Write, read and measure."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--suspensions", type=int, default=1000)
    parser.add_argument("--trips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", help="file or URL; a file of its own if not given")
    parser.add_argument("--read-only", action="store_true", help="read what --store holds")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        where = given.store or f"{folder}/history.db"
        print(f"{given.suspensions} suspensions of {given.trips} trips, seed {given.seed}")
        timed("nothing but the imports", lambda: None)
        with History(where) as store:
            if not given.read_only:
                many = given.suspensions, given.trips, given.seed
                timed("made up and written", lambda: written(store, *many))
                timed("alarms of each suspension kept", lambda: alarms(store, given.suspensions))
            series = timed("all read as arrays", store.series)
            timed("all alarms read", store.all_alarms)
            one = series[0].vehicle, series[0].place
            timed("one suspension read as trips", lambda: store.read(*one))
        held = sum(len(one.trip) for one in series)
        print(f"{len(series)} suspensions, {held} trips; the store takes {size(where):.0f} MiB")


if __name__ == "__main__":
    sys.exit(main())
