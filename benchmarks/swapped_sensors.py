"""Whether sensors in each other's place, and a wrong bogie or axle, are found on blind trains.

python benchmarks/swapped_sensors.py [--cases plain "all at once"] [--seeds 0 1 2]

Each seed is a train of tests/blind_train.py: 5 healthy trips to commission, then 2 healthy ones, 6
with two and 6 with twelve worn parts, and 16 with one at 62 or 30 %, of 20 minutes. A correct trip
is looked at with the drawing's vehicle and the commissioned one; in every third trip two sensors
are exchanged, and the likeliest order by the drawing is compared. Likewise with the drawing alone
for bogie and axle, each of the three wrong ones given.
"""

import sys
import tempfile
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
from named_parts import CASES, drawn_trips, family_of, runs_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from blind_train import Track, Train, record, write_trip

import suspnet
from suspnet.ground.tensors import threads
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.sensors.swapped_sensors import NEARLY, check_end, check_order, likely_orders

EXCHANGES = ((0, 1), (2, 3), (4, 5), (0, 2), (1, 3), (2, 4))
ONE_PART = [(part, 62) for part in range(12)] + [(part, 30) for part in range(0, 12, 3)]
EVERY = 3
ENDS = [("leading", "trailing"), ("trailing", "leading"), ("trailing", "trailing")]


def trips_of(name, seed, folder):
    """Return the vehicle of the drawing, the commissioned one and all trips of a train."""
    case, rng = CASES[name], np.random.default_rng([seed, 10])
    train = Train.scattered(
        seed, case.geometry, case.unequal, case.sensors, case.torsion, case.scatter
    )
    family = family_of(case, train)
    trips = drawn_trips([], [], 6, 5, rng, 2)
    for part, level in ONE_PART:
        trips.append(("one part", level, np.where(np.arange(13) == part, level / 100, 1.0)))
    runs, loads = runs_of(case, len(trips), 20.0, rng)
    found = []
    for i, ((_, _, ratios), run, load) in enumerate(zip(trips, runs, loads, strict=True)):
        signals = record(train.worn(np.append(ratios[:-1], load)), Track.drawn(rng), run, [seed, i])
        path = write_trip(folder, f"trip_{i}", signals, run, 1000.0 + i, case.places)
        recording = suspnet.load_recording(suspnet.read_manifest(path), 100.0)
        found.append(suspnet.bogie_trip(recording, family))
        (folder / f"trip_{i}.parquet").unlink()
    return family, suspnet.commission_bogie(family, found[:5]).generator, found


def by_drawing(vehicle, trip):
    check_order(vehicle, trip, nearly=NEARLY)


def is_called(check, vehicle, trip, names=()):
    """Return whether a check refuses a trip, with these names if given; its words are printed."""
    try:
        check(vehicle, trip)
    except TripError as error:
        print(error)
        return all(name in str(error) for name in names)
    return False


@threads(1)
def main():
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=["plain", "all at once"], choices=CASES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options = parser.parse_args()
    for name in options.cases:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                drawing, commissioned, trips = trips_of(name, seed, Path(folder))
            called = sum(is_called(by_drawing, drawing, trip) for trip in trips)
            called += sum(is_called(check_order, commissioned, trip) for trip in trips)
            first, right, chosen = 0, 0, trips[::EVERY]
            for i, j in EXCHANGES:
                order = list(range(6))
                order[i], order[j] = j, i
                names = drawing.sensors[i], drawing.sensors[j]
                for trip in (one.in_order(order) for one in chosen):
                    first += likely_orders(drawing, trip, 1.0)[0] == order
                    right += is_called(by_drawing, drawing, trip, names)
            print(
                f"{name}, {seed}: {called} of 2 x {len(trips)} correct trips called swapped, "
                f"{right} of {len(EXCHANGES) * len(chosen)} exchanges found, {first} first by "
                "their residuals at the median vehicle",
                flush=True,
            )
            called = sum(is_called(check_end, drawing, trip) for trip in trips)
            wrong = [
                replace(drawing, **dict(zip(("bogie", "axle"), one, strict=True))) for one in ENDS
            ]
            found = [sum(is_called(check_end, one, trip) for trip in chosen) for one in wrong]
            print(
                f"{name}, {seed}: {called} of {len(trips)} correct trips called of another end, "
                f"{found} of {len(chosen)} found where {ENDS} is given",
                flush=True,
            )


if __name__ == "__main__":
    main()
