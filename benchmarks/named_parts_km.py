"""Count false verdicts on healthy bogies read part by part: alarms in 1,000,000 km.

python benchmarks/named_parts.py --case plain --seeds 0 1 2 --healthy_trips 60 ...
python benchmarks/named_parts_km.py

The healthy trips of named_parts.csv, drawn with replacement, make histories of 1,000,000 km for
each case and train. Alarms are those of `suspnet.trains.maintenance` over all thirteen outputs;
accused parts are those of single trips. Writes named_parts_km.csv.
"""

import csv
from collections import Counter

import numpy as np
from cells import Parser, at_least, write_rows
from named_parts import COMPONENTS, RESULTS, Z90, by_trip

from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.trains.maintenance.alarms import watch
from suspnet.trains.maintenance.series import make_series

KM_PER_TRIP = 2000.0
KM_PER_HISTORY = 1_000_000.0
LEAST_TRIPS = 30


def healthy_trips(path):
    """Return the rows of each healthy trip by case and seed, of those with enough trips."""
    with path.open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["wear"] == "healthy"]
    found = {}
    for trip in by_trip(rows):
        found.setdefault((trip[0]["case"], trip[0]["seed"]), []).append(trip)
    return {key: trips for key, trips in found.items() if len(trips) >= LEAST_TRIPS}


def alarms_of(values, half_widths):
    """Return the alarms of a history, (n_trips, 13) each."""
    km = KM_PER_TRIP * np.arange(1, len(values) + 1)
    columns = (dict(zip(COMPONENTS, one.T, strict=True)) for one in (values, half_widths))
    series = make_series(km, *columns, np.zeros(len(values), bool))
    return watch(series, DEFAULT_LIMITS).alarms


def row_of(key, trips, n_histories):
    """Return the alarms of healthy histories of one train."""

    def column(name, scale=1.0):
        of = [{r["part"]: float(r[name]) * scale for r in trip} for trip in trips]
        return np.array([[one[part] for part in COMPONENTS] for one in of])

    values = column("estimate")
    # the mass is relative to that of the empty body, whose scale the healthy trips do not show
    values[:, -1] /= np.median(values[:, -1])
    half = Z90 * values * column("deviation_percent", 0.01)
    rng, found = np.random.default_rng([int(key[1]), 5]), Counter()
    for _ in range(n_histories):
        drawn = rng.choice(len(trips), int(KM_PER_HISTORY / KM_PER_TRIP))
        for alarm in alarms_of(values[drawn], half[drawn]):
            found[f"{alarm.parameter} {alarm.severity!s} ({alarm.cause})"] += 1
    return {
        "case": key[0],
        "seed": key[1],
        "n_trips": len(trips),
        "accused_trips": sum(bool(trip[0]["accused"]) for trip in trips),
        "largest_error_percent": f"{100 * np.abs(values[:, :-1] - 1).max():.2f}",
        "km": n_histories * KM_PER_HISTORY,
        "alarms": found.total(),
        "which": "; ".join(f"{n} x {which}" for which, n in found.most_common()),
    }


def main():
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--histories", type=at_least(1), default=10, help="of a train")
    options = parser.parse_args()
    every = healthy_trips(RESULTS / "named_parts.csv")
    rows = [row_of(key, trips, options.histories) for key, trips in every.items()]
    write_rows(RESULTS / "named_parts_km.csv", rows)
    for row in rows:
        print(*row.values())


if __name__ == "__main__":
    main()
