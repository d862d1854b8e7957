"""Time and memory of overview and plan of a large fleet, from its history.

    python benchmarks/depot.py --suspensions 1000 --trips 300
    python benchmarks/depot.py --store postgresql://user:password@host/database

One suspension in ten wears: a parameter, from some trip on, by up to 40 % until the last.
"""

from __future__ import annotations

import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from history import size, timed, trips

from suspnet.ground.records import TripResult
from suspnet.trains.history import History
from suspnet.trains.jobs.maintenance import write_maintenance
from suspnet.trains.pages.board import BoardSettings


def fleet(n_suspensions: int, n_trips: int, seed: int) -> Iterator[list[TripResult]]:
    """Yield the trips of each suspension."""
    rng = np.random.default_rng([seed, n_suspensions])
    for number in range(n_suspensions):
        found = trips(number, n_trips, seed)
        name = ("k_p", "c_p", "k_s", "c_s")[int(rng.integers(4))]
        onset, loss = rng.uniform(0, n_trips), rng.uniform(0.05, 0.4)
        if number % 10 == 0:
            ramp = np.clip((np.arange(n_trips) - onset) / (n_trips - onset), 0, 1)
            found = [
                replace(r, estimates=r.estimates | {name: r.estimates[name] * (1 - loss * share)})
                for r, share in zip(found, ramp.tolist(), strict=True)
            ]
        yield found


def main() -> None:
    """Write, read and measure."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--suspensions", type=int, default=1000)
    parser.add_argument("--trips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", help="file or URL; a file of its own if not given")
    parser.add_argument("--output", type=Path, help="folder that keeps overview and plan")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        where = given.store or f"{folder}/history.db"
        output = given.output or Path(folder)
        print(f"{given.suspensions} suspensions of {given.trips} trips, seed {given.seed}")
        with History(where) as store:
            for made in fleet(given.suspensions, given.trips, given.seed):
                store.write(made)
            print(f"the store takes {size(where):.0f} MiB")
            states = timed(
                "overview and plan",
                lambda: write_maintenance(
                    store, output, BoardSettings(today="2025-10-28", seed=given.seed)
                ),
            )
    wrong = sum(s.series.place.car != "" and bool(s.alarms) for s in states)
    print(f"{wrong} of {len(states)} suspensions have an alarm")


if __name__ == "__main__":
    sys.exit(main())
