"""Judge single faults of foreign trains: right parameter, right severity, after how many trips.

Each train has the family's effects and those of its trips (rich_train.py). A model is commissioned
on its healthy trips; then each parameter in turn is at each level for some trips, with everything
else healthy, and the trips are judged as a report would, by the last of them.
"""

import tempfile
from pathlib import Path

import numpy as np
import torch
from cells import Parser, at_least, write_rows
from foreign_trains import SPEED, Case
from mismatch import (
    RESULTS,
    Trips,
    commissioned,
    configuration,
    drawn_spectra,
    made,
    read,
    settings_of,
    trained,
)
from rich_effects import FAMILY
from tabulate import tabulate

from suspnet.curves.speeds import Speeds
from suspnet.ground.parameters import BODY_MASS, DEFAULT_LIMITS, Severity
from suspnet.trains.maintenance.judge import LastTrips, judge_last
from suspnet.vehicle import PARAMETERS

LEVELS = (0.05, 0.1, 0.3, 0.5, 0.62, 0.73, 0.8, 0.9, 1.1, 1.25, 1.5, 2.5, 4.0)
LOADS = (0.9, 1.25)
"""Range of the car body's mass over the trips."""
NAMES = tuple(name for name in PARAMETERS if name != BODY_MASS)


def worn_trips(options, case: Case, rows: np.ndarray) -> Trips:
    """Return a trip of each row of ratios, of the train that `made` has."""
    train, settings = case.train(options.seed), settings_of(options, case)
    spectra = drawn_spectra(case, train, rows, settings, options.seed + 1000)
    return Trips(case, spectra, rows, 0, [Speeds((SPEED,), (1.0,))] * len(rows))


def due(name: str, level: float) -> tuple[Severity, ...]:
    """Return the severities that a level may have by the default limits, several on a limit."""
    limits, found = DEFAULT_LIMITS[name], set()
    for at in (level * (1 - 1e-6), level * (1 + 1e-6)):
        out = [not low <= at <= high for low, high in (limits.act, limits.notice)]
        found.add(Severity.ACT if out[0] else Severity.NOTICE if out[1] else Severity.NONE)
    return tuple(sorted(found | {Severity.UNKNOWN} if len(found) > 1 else found))


def severities(estimates) -> dict[str, Severity]:
    """Return the severity of each parameter after some trips; None is a trip without estimate."""
    known = [e for e in estimates if e is not None and not e.flags.has("misfit")[0]]
    flagged = np.array([bool(e.flags.flagged[0]) for e in known], dtype=bool)
    found = {}
    for j, name in enumerate(NAMES):
        ends = [
            np.array([getattr(e, part)[0, j] for e in known]) for part in ("values", "low", "high")
        ]
        last = LastTrips(*ends, flagged, bool(len(known)) and bool(flagged.all()))
        found[name] = judge_last(last, DEFAULT_LIMITS[name])[0]
    return found


def train_rows(options) -> list[dict]:
    """Return a row for each parameter and level of one train."""
    case = Case((*FAMILY, *options.effects), options.sides)
    config = configuration(options, case)
    vehicle = commissioned(config, made(options, case, None), Path())
    model = trained(config, vehicle.generator, vehicle)[0]
    rng = np.random.default_rng(options.seed)
    faults = [(name, level) for name in NAMES for level in LEVELS] + [
        ("none", 1.0)
    ] * options.healthy
    rows = []
    for name, level in faults:
        ratios = np.ones((options.last, len(PARAMETERS)))
        ratios[:, -1] = rng.uniform(*LOADS, options.last)
        if name != "none":
            ratios[:, PARAMETERS.index(name)] = level
        estimates = read(model, worn_trips(options, case, ratios))
        after = [severities(estimates[: n + 1]) for n in range(options.last)]
        wanted = due(name, level) if name != "none" else (Severity.NONE,)
        right = [name == "none" or found[name] in wanted for found in after]
        others = [other for other in NAMES if other != name and after[-1][other] > Severity.UNKNOWN]
        done = [e for e in estimates if e is not None and not e.flags.has("misfit")[0]]
        at = [e.values[0, NAMES.index(name)] for e in done] if name != "none" else []
        wrong = [i for i, is_right in enumerate(right) if not is_right]
        rows.append(
            {
                "seed": options.seed,
                "misfit": vehicle.misfit,
                "parameter": name,
                "level_percent": 100 * level,
                "due": " or ".join(map(str, wanted)),
                "severity": str(after[-1].get(name, max(after[-1].values()))),
                "after": max(wrong, default=-1) + 2 if right[-1] else "",
                "others": " ".join(f"{other}={after[-1][other]!s}" for other in others),
                "read_percent": 100 * float(np.median(at)) if at else float("nan"),
                "n_read": len(done),
                "n_flagged": sum(bool(e.flags.flagged[0]) for e in done),
            }
        )
        print(*rows[-1].values(), flush=True)
    return rows


def summary(rows: list[dict]) -> str:
    """Return the counts over all trains, by parameter."""
    lines = []
    for name in (*NAMES, "none"):
        of = [row for row in rows if row["parameter"] == name]
        right = [row for row in of if row["severity"] in row["due"].split(" or ")]
        took = [row["after"] for row in right if row["after"] != ""]
        lines.append(
            {
                "parameter": name,
                "faults": len(of),
                "right severity": len(right),
                "too low": sum(LEAST[row["severity"]] < LEAST[row["due"].split()[0]] for row in of),
                "others accused": sum(bool(row["others"]) for row in of),
                "trips, median": float(np.median(took)) if took else float("nan"),
                "flagged trips": sum(row["n_flagged"] for row in of),
                "trips without estimate": sum(ROWS_OF - row["n_read"] for row in of),
            }
        )
    return tabulate(lines, headers="keys", tablefmt="github", floatfmt=".3g")


LEAST = {str(one): int(one) for one in Severity}
ROWS_OF = 5


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--effects", nargs="*", default=["payload"], help="beyond the family's")
    parser.add_argument("--sides", choices=["mean", "left"], default="mean")
    parser.add_argument("--healthy", type=at_least(3), default=5, help="trips to commission on")
    parser.add_argument("--minutes", type=at_least(1, float), default=20.0, help="of a trip")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="a train each")
    parser.add_argument("--train", nargs="+", default=[], help="more settings, as for train.py")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the table")
    options = parser.parse_args()
    options.trips, options.time, options.last = 1, False, ROWS_OF
    torch.set_num_threads(1)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        options.cache = Path(temporary) / "cache"
        for seed in options.seeds:
            options.seed = seed
            rows += train_rows(options)
    print(summary(rows))
    options.output.mkdir(parents=True, exist_ok=True)
    write_rows(options.output / "verdicts.csv", rows)


if __name__ == "__main__":
    main()
