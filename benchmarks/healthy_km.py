"""Count false verdicts on healthy foreign trains: alarms in 1,000,000 km.

python benchmarks/healthy_km.py [--cases all none ...] [--seeds 0 1 2]

For each case and seed a model is commissioned on healthy trips of a train (rich_train.py), reads
more of them, laden at random, and their estimates, drawn with replacement, make histories of
1,000,000 km. Alarms are those of `suspnet.trains.maintenance`. Writes healthy_km.csv.
"""

import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from cells import Parser, Row, at_least, write_rows
from foreign_trains import CASES
from mismatch import (
    RESULTS,
    Trips,
    commissioned,
    configuration,
    drawn_at,
    made,
    read,
    trained,
)
from mixed_fleet import KM_PER_TRIP, alarms_of, with_loads

from suspnet.curves.speeds import Speeds
from suspnet.estimation.estimate import Estimate

KM_PER_HISTORY = 1_000_000.0
DRAWN_FROM = 10_000
"""Number of the first trip of histories; no trip to commission on is among them."""


def estimates_of(options, name: str) -> tuple[list[Estimate | None], float]:
    """Return estimates of healthy trips of a train after commissioning, and its misfit."""
    case = CASES[name]
    config = configuration(options, case)
    vehicle = commissioned(config, made(options, case, Path()), Path())
    model, _ = trained(config, vehicle.generator, vehicle)
    n = options.read
    speeds = case.speeds_of(0, n, options.seed + 1)
    ratios = with_loads(np.ones((n, 4)), options.seed + 1)
    alike = [(speed, bool(case.faults)) for speed in speeds]
    spectra = drawn_at(options, case, ratios, alike, DRAWN_FROM)
    at = [Speeds((speed,), (1.0,)) for speed in speeds]
    return read(model, Trips(case, spectra, ratios, 0, at)), vehicle.misfit


def case_row(options, name: str) -> Row:
    """Return the alarms of healthy histories of one train."""
    estimates, misfit = estimates_of(options, name)
    known = [one for one in estimates if one is not None]
    errors = np.array([one.values[0, :4] - 1 for one in known])
    rng = np.random.default_rng([options.seed, 5])
    found: Counter[str] = Counter()
    for _ in range(options.histories):
        drawn = rng.choice(len(estimates), int(KM_PER_HISTORY / KM_PER_TRIP))
        for alarm in alarms_of([estimates[i] for i in drawn]):
            found[f"{alarm.parameter} {alarm.severity!s} ({alarm.cause})"] += 1
    return {
        "case": name,
        "seed": options.seed,
        "misfit": misfit,
        "n_trips": len(estimates),
        "n_read": len(known),
        "n_flagged": sum(bool(one.flags.flagged[0]) for one in known),
        "largest_error_percent": 100 * float(np.abs(errors).max()),
        "km": options.histories * KM_PER_HISTORY,
        "alarms": found.total(),
        "which": "; ".join(f"{n} x {which}" for which, n in found.most_common()),
    }


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    usual = [name for name, case in CASES.items() if name.startswith("all") or name == "none"]
    usual = [name for name in usual if not CASES[name].in_time_only and "one_side" not in name]
    parser.add_argument("--cases", nargs="+", choices=usual, default=usual)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="a train each")
    parser.add_argument("--healthy", type=at_least(3), default=5, help="trips to commission on")
    parser.add_argument("--read", type=at_least(10), default=60, help="healthy trips after these")
    parser.add_argument("--histories", type=at_least(1), default=10, help="of a train")
    parser.add_argument("--minutes", type=at_least(1, float), default=20.0, help="of a trip")
    parser.add_argument("--train", nargs="+", default=[], help="more settings, as for train.py")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the table")
    options = parser.parse_args()
    options.trips, options.time = 1, False
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as temporary:
        options.cache = Path(temporary) / "cache"
        for name in options.cases:
            for seed in options.seeds:
                options.seed = seed
                rows.append(case_row(options, name))
                print(*rows[-1].values(), flush=True)
                write_rows(options.output / "healthy_km.csv", rows)


if __name__ == "__main__":
    main()
