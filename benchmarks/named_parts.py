"""Whether the right spring or damper is named, on trains written without a look at the estimator.

python benchmarks/named_parts.py [--case plain] [--seeds 0 1] [--trips 8] [--levels 30 62]

Each seed is a train of tests/blind_train.py. It is commissioned on 5 healthy trips; then come trips
with one of the twelve parts at each level, with two parts, with all twelve at 50 to 130 %, and
healthy ones. Every part of every trip goes to named_parts.csv, where the rows of the same case and
seed are replaced; named_parts.md has the tables of all cases in it. A case is one of CASES: plain,
all at once, or one of them with an ingredient of the train left out or put in, or with another
layout of sensors.
"""

import csv
import itertools
import sys
import tempfile
import time
from argparse import ArgumentParser
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from cells import write_rows
from tabulate import tabulate

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path.insert(0, str(TESTS))

from blind_train import COMPONENTS, PAIRS, SIDE_NAMES, Run, Track, Train, record, write_trip  # noqa: E402

import suspnet  # noqa: E402
from suspnet.ground.tensors import threads  # noqa: E402
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE  # noqa: E402
from suspnet.vehicle.quantities import BOGIE_MASS_DEVIATION  # noqa: E402

RESULTS = TESTS.parent / "benchmarks" / "results"
FAMILY = PARTS_OF_BOGIE  # as the programs have it
WEARS = ("one part", "healthy", "two parts", "all twelve")
LEVELS = (30, 62, 80, 90, 95)
KINDS = ("k_p", "c_p", "k_s", "c_s", "M_s", "M_s change")
Z90 = 1.6448536269514722


@dataclass(frozen=True)
class Case:
    """What the train and its trips have, and what the estimator's family has."""

    family: tuple = FAMILY
    geometry: float = 0.1  # scatter of wheelbase and pivots, which the estimator has as nominal
    drawings: bool = False  # the estimator knows wheelbase and pivots
    unequal: float = 0.05
    scatter: float = 0.1  # of all other numbers
    sensors: bool = False
    torsion: bool = False
    numbers: dict = field(default_factory=dict)  # numbers of the train that are given
    speeds: tuple = (70.0, 70.0)
    reverse: bool = False
    payload: float = 1.0
    alone: float = 0.0
    noise: bool = True
    places: tuple = PAIRS  # of the sensors, as Train has them


PLAIN = Case()
ALL = Case(
    sensors=True,
    torsion=True,
    speeds=(48.0, 78.0),
    reverse=True,
    payload=1.25,
    alone=0.01,
)
BOXES = tuple(("axle_box", axle, side) for axle in (1, 2) for side in (1, -1))
DIAGONAL = (("bogie", 1, 1), ("bogie", 2, -1))
CENTRE = (("bogie", 0, 1), ("bogie", 0, -1))
LAYOUTS = {
    "eight": (*BOXES, *DIAGONAL, *PAIRS[4:]),
    "seven": (*BOXES, *DIAGONAL, PAIRS[4]),
    "seven, body in the middle": (*BOXES, *DIAGONAL, ("body", 0, 0)),
    "six, frame at its centre": (*PAIRS[:2], *CENTRE, *PAIRS[4:]),
    "five, body on one side": PAIRS[:5],
    "five, axle box on one side": (PAIRS[0], *PAIRS[2:]),
    "four, no axle box": PAIRS[2:],
}
CASES = {
    "plain": PLAIN,
    **{f"plain, {name}": replace(PLAIN, places=places) for name, places in LAYOUTS.items()},
    **{f"all at once, {name}": replace(ALL, places=places) for name, places in LAYOUTS.items()},
    "all at once": ALL,
    "plain, wheelbase and pivots on drawings": replace(PLAIN, drawings=True),
    "plain, wheelbase and pivots nominal": replace(PLAIN, geometry=0.0),
    "plain, parts equal": replace(PLAIN, unequal=0.0),
    "plain, rigid contact": replace(PLAIN, numbers={"contact_k": 1e12}),
    "plain, no anti-roll bar": replace(PLAIN, numbers={"antiroll": 0.0}),
    "plain, yaw dampers of a half": replace(PLAIN, numbers={"yaw_damper_c": 1e5}),
    "plain, yaw dampers without bushings": replace(PLAIN, numbers={"yaw_damper_bushing": 1e9}),
    "plain, likewise, low": replace(
        PLAIN, numbers={"yaw_damper_bushing": 1e9, "yaw_damper_z_m": -0.3}
    ),
    "plain, likewise, bending damped": replace(
        PLAIN,
        numbers={"yaw_damper_bushing": 1e9, "yaw_damper_z_m": -0.3, "bending_damping": 0.1},
    ),
    "plain, no yaw dampers in the family": replace(
        PLAIN, family=tuple(part for part in FAMILY if part != "yaw_dampers")
    ),
    "plain, no guidance in the family": replace(
        PLAIN, family=tuple(part for part in FAMILY if part != "guidance")
    ),
    "plain, all numbers nominal": replace(PLAIN, scatter=0.0),
    "plain, all numbers nominal, parts equal": replace(PLAIN, scatter=0.0, unequal=0.0),
    "plain, springs at 1 m": replace(PLAIN, numbers={"primary_y_m": 1.0, "secondary_y_m": 1.0}),
    "plain, no arms of springs": replace(PLAIN, numbers={"primary_z_m": 0.0}),
    "plain, no bushings": replace(
        PLAIN, numbers={n: 1e9 for n in ("primary_bushing", "secondary_bushing")}
    ),
    "plain, no noise": replace(PLAIN, noise=False),
    "plain, dampers 0.25 m outside": replace(PLAIN, numbers={"secondary_damper_y_m": 0.25}),
    "plain, cones lift": replace(PLAIN, numbers={"cone_lift": 1.0}),
    "plain, reverse": replace(PLAIN, reverse=True),
    "plain, payload": replace(PLAIN, payload=1.25),
    "plain, sensors": replace(PLAIN, sensors=True),
    "plain, speeds": replace(PLAIN, speeds=(48.0, 78.0)),
    "plain, alone": replace(PLAIN, alone=0.01),
    "plain, torsion": replace(PLAIN, torsion=True),
    "all at once, not alone": replace(ALL, alone=0.0),
    "all at once, one speed": replace(ALL, speeds=(70.0, 70.0)),
    "all at once, one direction": replace(ALL, reverse=False),
    "all at once, one payload": replace(ALL, payload=1.0),
}


def drawn_trips(parts, levels, n_each, n_healthy, rng, n_later):
    """Return (kind, level, ratios) of each trip; the level is that of the one worn part, in %."""
    trips = [("commission", 100, np.ones(13)) for _ in range(n_healthy)]
    for part, level in itertools.product([COMPONENTS.index(p) for p in parts], levels):
        ratios = np.ones(13)
        ratios[part] = level / 100
        trips.append(("one part", level, ratios))
    for _ in range(n_later):
        trips.append(("healthy", 100, np.ones(13)))
    for kind, n_worn in (("two parts", 2), ("all twelve", 12)):
        for _ in range(n_each):
            ratios = np.ones(13)
            worn = rng.choice(12, n_worn, replace=False)
            ratios[worn] = rng.uniform(0.5, 1.3, n_worn)
            trips.append((kind, "", ratios))
    return trips


def runs_of(case, n_trips, minutes, rng):
    """Return how each trip is run, and the mass of the body over the empty one."""
    speeds = rng.uniform(*case.speeds, n_trips).round(2)
    ways = rng.choice(["forward", "reverse"], n_trips) if case.reverse else ["forward"] * n_trips
    loads = rng.uniform(1.0, case.payload, n_trips)
    runs = [
        Run(float(v), str(way), minutes, case.alone, case.noise)
        for v, way in zip(speeds, ways, strict=True)
    ]
    return runs, loads


def family_of(case, train):
    """Return the estimator's vehicle."""
    vehicle = suspnet.read_vehicles()["am96"]
    if case.drawings:
        vehicle = replace(
            vehicle,
            half_wheelbase_m=train.half_wheelbase_m,
            half_pivot_distance_m=train.half_pivot_m,
        )
    centre = any(channel == "bogie" and not axle for channel, axle, _ in case.places)
    return suspnet.SpatialVehicle(
        vehicle,
        parts=case.family,
        distribution="prior",
        frame_sensor="centre" if centre else "axle",
        sensors=[_place(*one) for one in case.places],
    )


def _place(channel, axle, side):
    """Return a place of a sensor as the estimator names it."""
    where = "axle_box" if channel == "axle_box" else "frame" if channel == "bogie" else "body"
    if channel != "body":
        where += f"_axle{axle}" if axle else "_centre"
    return f"{where}_{SIDE_NAMES[side]}"


def read_train(name, seed, options, folder):
    """Return a row of every part on every trip of one train."""
    case = CASES[name]
    rng = np.random.default_rng([seed, 10])
    train = Train.scattered(
        seed, case.geometry, case.unequal, case.sensors, case.torsion, case.scatter
    )
    train = replace(train, **case.numbers)
    if case.places != PAIRS:
        train = train.measured_at(case.places, seed if case.sensors else None)
    family = family_of(case, train)
    n_later = options.trips if options.healthy_trips is None else options.healthy_trips
    trips = drawn_trips(options.parts, options.levels, options.trips, options.healthy, rng, n_later)
    runs, loads = runs_of(case, len(trips), options.minutes, rng)
    healthy, commissioned, rows, begun = [], None, [], time.perf_counter()
    for i, ((kind, level, ratios), run, load) in enumerate(zip(trips, runs, loads, strict=True)):
        ratios[-1] = load
        if kind not in ("commission", *options.wears):
            Track.drawn(rng)  # the other trips are those of a whole run
            continue
        signals = record(train.worn(ratios), Track.drawn(rng), run, [seed, 11, i])
        path = write_trip(folder, f"trip_{i}", signals, run, 1000.0 + i, case.places)
        recording = suspnet.load_recording(suspnet.read_manifest(path), 100.0)
        trip = suspnet.bogie_trip(recording, family)
        (folder / f"trip_{i}.parquet").unlink()
        if kind == "commission":
            healthy.append((trip, load))
            continue
        if commissioned is None:
            commissioned, mass = commission(family, healthy)
            took = time.perf_counter() - begun
            print(f"{name}, {seed}: {took:.0f} s, misfit {commissioned.misfit:.2f}", flush=True)
        found = suspnet.fit_parts(commissioned, trip)
        head = {"case": name, "seed": seed, "trip": i, "wear": kind, "level_percent": level}
        head |= {"speed_m_per_s": run.speed_m_per_s, "direction": run.direction}
        head |= {"healthy_misfit": commissioned.misfit, "misfit": found.misfit}
        head |= {"converged": int(commissioned.converged) + 2 * int(found.converged)}
        truth = np.append(ratios[:-1], ratios[-1] * train.body_kg / 25200.0)
        rows += rows_of(head, truth, found, load / mass)
    each = (time.perf_counter() - begun - took) / len({row["trip"] for row in rows})
    print(f"{name}, {seed}: {each:.1f} s a trip", flush=True)
    return rows


def commission(family, healthy):
    """Return the commissioned bogie, and what turns its mass into that of the empty body."""
    found = suspnet.commission_bogie(family, [trip for trip, _ in healthy])
    loads = np.array([load for _, load in healthy])
    return found, float(np.exp(np.mean(np.log(loads) - np.log(found.masses))))


def rows_of(head, truth, found, mass):
    """Return a row of each part; `mass` is the body's as its healthy trips would have it."""
    values, deviations = np.append(found.values, found.values[-1]), found.deviations
    own = np.sqrt(deviations[-1] ** 2 - BOGIE_MASS_DEVIATION**2)  # without what trips share
    truth, deviations = np.append(truth, mass), np.append(deviations, own)
    accused = ["+".join(one.names) for one in suspnet.worn_parts(found)]
    rows = []
    for part, true, value, deviation in zip(
        (*COMPONENTS, "M_s change"), truth, values, deviations, strict=True
    ):
        row = head | {"part": part, "truth": f"{true:.4f}", "estimate": f"{value:.5f}"}
        row |= {"deviation_percent": f"{100 * deviation:.3f}"}
        rows.append(row | {"accused": " ".join(accused) if part == COMPONENTS[0] else ""})
    return rows


def verdict(trip):
    """Return right, wrong or abstained, of the rows of one trip."""
    worn = {r["part"] for r in trip if r["part"] in COMPONENTS[:-1] and float(r["truth"]) != 1}
    groups = [one.split("+") for one in trip[0]["accused"].split()]
    if any(not worn & set(names) for names in groups):
        return "wrong"
    if not worn:
        return "right"
    return "right" if {n for names in groups for n in names} == worn else "abstained"


def by_trip(rows):
    """Return the rows of each trip."""
    trips = {}
    for row in rows:
        trips.setdefault((row["case"], row["seed"], row["trip"]), []).append(row)
    return list(trips.values())


def accuracy_table(rows, pooled=False):
    """Return rms error, largest error of an unworn part and coverage of each kind of part.

    With a line for each train, or for all trains of one case where they are `pooled`.
    """

    def key(row):
        return row["case"], "all" if pooled else str(row["seed"]), row["wear"]

    lines = []
    for case, seed, wear in dict.fromkeys(map(key, rows)):
        of = [r for r in rows if key(r) == (case, seed, wear)]
        n = len(by_trip(of))
        misfits = [float(trip[0]["misfit"]) for trip in by_trip(of)]
        line = [wear, n] if pooled else [case, seed, wear, n]
        line.append(f"{np.median([float(r['healthy_misfit']) for r in of]):.2f}")
        line.append(f"{np.median(misfits):.2f}")
        for kind in KINDS:
            # "M_s" is no beginning of "M_s change"
            kept = [r for r in of if r["part"] == kind or r["part"].startswith(f"{kind}_")]
            truth = np.array([float(r["truth"]) for r in kept])
            errors = np.log([float(r["estimate"]) for r in kept]) - np.log(truth)
            deviations = np.array([float(r["deviation_percent"]) for r in kept]) / 100
            held = 100 * np.mean(np.abs(errors) < Z90 * deviations)
            unworn = np.abs(errors[truth == 1]) if not kind.startswith("M_s") else np.array([])
            worst = f"{100 * unworn.max():.2g}" if unworn.size else "-"
            line.append(f"{100 * np.sqrt(np.mean(errors**2)):.2g} / {worst} / {held:.0f}")
        lines.append(line)
    headers = ["worn", "trips", "misfit", "trips' misfit", *KINDS]
    headers = headers if pooled else ["case", "seed", *headers]
    return tabulate(lines, headers, tablefmt="pipe", disable_numparse=True)


def named_table(rows):
    """Return right / wrong / abstained of each level, by kind of part."""
    lines = []
    one = [r for r in rows if r["wear"] == "one part"]
    for case in dict.fromkeys(r["case"] for r in rows):
        for kind in ("all", *KINDS[:4]):
            line = [case, kind]
            for level in LEVELS:
                trips = [
                    t
                    for t in by_trip([r for r in one if r["case"] == case])
                    if str(t[0]["level_percent"]) == str(level) and worn_kind(t, kind)
                ]
                line.append(counts(trips))
            lines.append(line)
        for wear in ("two parts", "healthy"):
            trips = by_trip([r for r in rows if r["case"] == case and r["wear"] == wear])
            lines.append([case, wear, counts(trips), *[""] * (len(LEVELS) - 1)])
    headers = ["case", "worn part", *(f"{level} %" for level in LEVELS)]
    return tabulate(lines, headers, tablefmt="pipe", disable_numparse=True)


def layouts_table(rows):
    """Return a line for each layout of all at once: its errors over all trips, and the verdicts.

    A cell holds rms error / coverage of 90 % intervals.
    """
    lines = []
    for name in LAYOUTS:
        of = [r for r in rows if r["case"] == f"all at once, {name}"]
        if not of:
            continue
        misfit = np.median([float(trip[0]["misfit"]) for trip in by_trip(of)])
        line = [name, f"{misfit:.2f}"]
        for kind in KINDS[:4]:
            kept = [r for r in of if r["part"].startswith(f"{kind}_")]
            errors = np.log([float(r["estimate"]) / float(r["truth"]) for r in kept])
            deviations = np.array([float(r["deviation_percent"]) for r in kept]) / 100
            held = 100 * np.mean(np.abs(errors) < Z90 * deviations)
            line.append(f"{100 * np.sqrt(np.mean(errors**2)):.2g} / {held:.0f}")
        for wear in ("one part", "two parts", "healthy"):
            line.append(counts(by_trip([r for r in of if r["wear"] == wear])))
        lines.append(line)
    headers = ["sensors", "misfit", *KINDS[:4], "one part at 62 %", "two parts"]
    return tabulate(lines, [*headers, "healthy"], tablefmt="pipe", disable_numparse=True)


def worn_kind(trip, kind):
    """Return whether the worn part is of a kind."""
    worn = [r["part"] for r in trip if r["part"] in COMPONENTS[:-1] and float(r["truth"]) != 1]
    return kind == "all" or worn[0].startswith(kind)


def counts(trips):
    """Return how many trips are right / wrong / abstained."""
    every = [verdict(trip) for trip in trips]
    if not every:
        return "-"
    return " / ".join(str(every.count(v)) for v in ("right", "wrong", "abstained"))


def accused_words(rows):
    """Return one line for each trip on which another part is accused."""
    lines = []
    for trip in by_trip(rows):
        if trip[0]["wear"] == "all twelve" or verdict(trip) != "wrong":
            continue
        worn = [
            f"{r['part']} {100 * float(r['truth']):.0f} %"
            for r in trip
            if r["part"] in COMPONENTS[:-1] and float(r["truth"]) != 1
        ]
        head = f"{trip[0]['case']}, seed {trip[0]['seed']}: {', '.join(worn) or 'healthy'}"
        lines.append(f"- {head} -> {trip[0]['accused'].replace(' ', ', ')}")
    return "\n".join(lines) or "none"


def stored(cases):
    """Return the rows of some cases in the results."""
    with (RESULTS / "named_parts.csv").open(newline="") as file:
        return [r for r in csv.DictReader(file) if r["case"] in cases]


def merged(rows, path):
    """Write the rows beside those of other cases and seeds, and return all."""
    new = {(r["case"], str(r["seed"]), r["wear"]) for r in rows}
    before = []
    if path.exists():
        with path.open(newline="") as file:
            before = [
                r for r in csv.DictReader(file) if (r["case"], r["seed"], r["wear"]) not in new
            ]
    every = before + rows
    write_rows(path, every)
    return every


def page(rows, options):
    """Return the tables and what they say."""
    return (
        f"Trips of {options.minutes:g} minutes after {options.healthy} healthy ones. Rms error / "
        "largest error of a part that did not wear / coverage of 90 % intervals, in %. M_s is the "
        "body's mass over the vehicle's nominal, M_s change that over the healthy trips'.\n\n"
        f"{accuracy_table(rows)}\n\n"
        "Trips on which the worn part alone is named / another part is accused / nothing is, or a "
        "group that holds it. Of healthy trips and of two parts: all levels.\n\n"
        f"{named_table(rows)}\n\nOther parts accused:\n\n{accused_words(rows)}\n"
    )


@threads(1)
def main():
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", choices=list(CASES), default="plain", help="train and trips")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="a train each")
    parser.add_argument("--trips", type=int, default=8, help="of healthy, two parts, and all each")
    parser.add_argument("--levels", nargs="*", type=int, default=list(LEVELS), help="of one part")
    parser.add_argument("--parts", nargs="*", default=COMPONENTS[:-1], help="that wear alone")
    parser.add_argument("--healthy", type=int, default=5, help="trips to commission on")
    parser.add_argument("--healthy_trips", type=int, help="after these; default: as --trips")
    parser.add_argument("--wears", nargs="+", default=WEARS, choices=WEARS, help="kinds of trips")
    parser.add_argument("--minutes", type=float, default=20.0, help="of a trip")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the tables")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            rows = read_train(options.case, seed, options, Path(folder))
        rows = merged(rows, options.output / "named_parts.csv")
        (options.output / "named_parts.md").write_text(page(rows, options))
        print(page([r for r in rows if r["case"] == options.case], options), flush=True)


if __name__ == "__main__":
    main()
