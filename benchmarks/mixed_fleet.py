"""Find changes on trips of both directions and of many loads, after one commissioning.

python benchmarks/mixed_fleet.py [--seeds 0 1 2]

Each train has the family's effects and its own laws of the payload (rich_train.py); it runs forward
and in reverse in turn, laden at random. A vehicle is commissioned on healthy trips of both
directions and has a model for each. After 20 healthy trips one parameter changes; alarms and
severities are those of `suspnet.trains.maintenance`, which sees the trips in the order of mileage.
Writes mixed_fleet.csv.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from cells import Parser, Row, at_least, write_rows
from foreign_trains import SPEED, Case
from mismatch import (
    RESULTS,
    Trips,
    commissioned,
    configuration,
    drawn_spectra,
    read,
    settings_of,
    trained,
)
from rich_effects import FAMILY
from verdicts import LOADS, NAMES, due, severities

from suspnet.curves.speeds import Speeds
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.parameters import DEFAULT_LIMITS, DIRECTIONS, REVERSE, Direction, Severity
from suspnet.trains.maintenance.alarms import Alarm, watch
from suspnet.trains.maintenance.series import make_series
from suspnet.vehicle import PARAMETERS

CASE = Case((*FAMILY, "payload"))
N_HEALTHY, KM_PER_TRIP, N_LAST = 20, 2000.0, 5
CHANGES = {
    "step of -1 %": ("k_p", np.full(20, 0.99)),
    "fade to 70 % over 30 trips": ("c_s", np.linspace(0.99, 0.7, 30)),
}
"""The parameter that changes, and its ratio on each trip from then on."""


def trips(options, ratios: np.ndarray, seed: int) -> dict[Direction, Trips]:
    """Return a trip of each row of ratios, in turn forward and in reverse, by direction."""
    settings, found = settings_of(options, CASE), {}
    for i, direction in enumerate(DIRECTIONS):
        rows = ratios[i::2]
        train = replace(CASE.train(options.seed), reverse=direction == REVERSE)
        spectra = drawn_spectra(CASE, train, rows, settings, seed + i)
        n = len(rows)
        at = [Speeds((SPEED,), (1.0,))] * n
        found[direction] = Trips(CASE, spectra, rows, n, at, [direction] * n)
    return found


def models_of(options) -> tuple[dict[Direction, TrainedModel], float]:
    """Return a model for each direction of one vehicle, and the misfit of its healthy trips."""
    config = configuration(options, CASE)
    healthy = trips(options, with_loads(np.ones((options.healthy, 4)), options.seed), options.seed)
    one, other = healthy.values()
    both = replace(
        one,
        given=[*one.given, *other.given],
        n_healthy=options.healthy,
        speeds=[*one.speeds, *other.speeds],
        directions=[*one.directions, *other.directions],
    )
    vehicle = commissioned(config, both, Path())
    models = {
        direction: trained(config, vehicle.generator.running(direction), vehicle)[0]
        for direction in DIRECTIONS
    }
    return models, vehicle.misfit


def with_loads(ratios: np.ndarray, seed: int) -> np.ndarray:
    """Return ratios with masses of the car body that are drawn for each trip."""
    loads = np.random.default_rng([seed, 8]).uniform(*LOADS, len(ratios))
    return np.column_stack([ratios, loads])


def read_in_turn(
    options, models: Mapping[Direction, TrainedModel], ratios: np.ndarray, seed: int
) -> list[Estimate | None]:
    """Return the estimate of each trip, in turn forward and in reverse."""
    found: list[Estimate | None] = [None] * len(ratios)
    for i, (direction, some) in enumerate(trips(options, ratios, seed).items()):
        found[i::2] = read(models[direction], some)
    return found


def alarms_of(estimates: list[Estimate | None]) -> list[Alarm]:
    """Return the alarms of a history of trips, as a report shows them."""
    unknown = np.full(len(PARAMETERS), np.nan)

    def columns(part: str) -> dict[str, np.ndarray]:
        rows = [unknown if e is None else getattr(e, part)[0] for e in estimates]
        return dict(zip(PARAMETERS, np.array(rows).T, strict=True))

    flagged = [e is not None and bool(e.flags.flagged[0]) for e in estimates]
    km = KM_PER_TRIP * np.arange(1, len(estimates) + 1)
    series = make_series(km, columns("values"), columns("half_widths"), flagged)
    return watch(series, DEFAULT_LIMITS).alarms


def change_row(
    options, models: Mapping[Direction, TrainedModel], change: str, misfit: float
) -> Row:
    """Return after how many trips a change was found, and what else was accused."""
    name, levels = CHANGES[change]
    ratios = np.ones((N_HEALTHY + len(levels), 4))
    ratios[N_HEALTHY:, NAMES.index(name)] = levels
    seed = options.seed + 1000 * (1 + list(CHANGES).index(change))
    ratios = with_loads(ratios, seed)
    estimates = read_in_turn(options, models, ratios, seed)
    healthy_km = KM_PER_TRIP * N_HEALTHY
    alarms = alarms_of(estimates)
    right = [a for a in alarms if a.parameter == name and a.begin_km > healthy_km]
    judged = severities(estimates[-N_LAST:])
    others = {a.parameter for a in alarms if a not in right}
    others |= {one for one in NAMES if one != name and judged[one] > Severity.UNKNOWN}
    after = round((right[0].begin_km - healthy_km) / KM_PER_TRIP) if right else None
    known = [i for i, e in enumerate(estimates) if e is not None]
    errors = np.array([estimates[i].values[0, :4] / ratios[i, :4] - 1 for i in known])
    return {
        "seed": options.seed,
        "misfit": misfit,
        "parameter": name,
        "change": change,
        "after": "" if after is None else after,
        "true_percent": "" if after is None else 100 * levels[after - 1],
        "alarms": " ".join(f"{a.severity!s} ({a.cause})" for a in right),
        "severity": str(judged[name]),
        "due": " or ".join(map(str, due(name, float(levels[-1])))),
        "others": " ".join(sorted(others)),
        "n_trips": len(estimates),
        "n_read": len(known),
        "n_flagged": sum(bool(estimates[i].flags.flagged[0]) for i in known),
        **dict(zip([f"{p}_rms_percent" for p in NAMES], 100 * rms(errors), strict=True)),
    }


def rms(errors: np.ndarray) -> np.ndarray:
    """Return the root of the mean square of each column."""
    return np.sqrt(np.mean(errors**2, axis=0))


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--healthy", type=at_least(4), default=6, help="trips to commission on")
    parser.add_argument("--minutes", type=at_least(1, float), default=20.0, help="of a trip")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="a train each")
    parser.add_argument("--train", nargs="+", default=[], help="more settings, as for train.py")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the table")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as temporary:
        options.cache = Path(temporary) / "cache"
        for seed in options.seeds:
            options.seed = seed
            models, misfit = models_of(options)
            for change in CHANGES:
                rows.append(change_row(options, models, change, misfit))
                print(*rows[-1].values(), flush=True)
                write_rows(options.output / "mixed_fleet.csv", rows)


if __name__ == "__main__":
    main()
