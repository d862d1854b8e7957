"""How well the parts of rough trains are read, which have what suspnet's family lacks.

python benchmarks/rough_train.py [--sets "flexible modes" ballast all] [--seeds 0] [--minutes 20]
    [--later-minutes 5] [--together 3] [--speeds 48 78] [--both-ways] [--sensors seven]

Each set is one of SETS of tests/rich_train.py. A bogie is commissioned on healthy trips of payloads
0.95 to 1.18; then each of its twelve parts wears on a trip of its own, and healthy trips follow.
Three sensors read all parts of a kind as one: all of a kind wear, and no part is named.
Writes a row of each trip to rough_train.csv, in place of those of the same set and seed, and prints
a line for each set: misfit, rms errors, half widths and coverage by kind of part, coverage of all
parts with its binomial interval, verdicts of single trips and of --together trips of one fault.
The time of commissioning is that of the processor, on one thread.
"""

import csv
import tempfile
import time
from pathlib import Path

import numpy as np
from cells import Parser, at_least, write_rows
from foreign_trains import TESTS
from named_parts import Z90
from rich_effects import SETS
from rich_structure import SENSORS, SEVEN
from rich_train import RichTrain
from rich_train_trips import write_train_trips
from scipy.stats import binomtest
from tabulate import tabulate
from vehicles import AM96

import suspnet
from suspnet.ground.parameters import COMPONENTS
from suspnet.ground.tensors import threads
from suspnet.trains.fits.bogie_fit import FURTHER_PARTS, fit_parts
from suspnet.trains.fits.joint_estimate import joint_estimate
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE
from suspnet.trains.simulation import Fleet

RESULTS = TESTS.parent / "benchmarks" / "results"
LEVELS = (0.5, 0.62, 0.75, 0.85, 0.92)
PAYLOADS = (0.95, 1.18)
KINDS = ("k_p", "c_p", "k_s", "c_s")
RATE_HZ = 500.0
"""At 250 Hz, tracks that are straight between samples shake contacts of 200 Hz: c_p errs by 8 %."""
SPEED_M_PER_S = 70.0
LAYOUTS = {"six": SENSORS, "seven": SEVEN, "three on the left": SENSORS[::2]}
PLACES = {
    "axle_box": "axle_box_axle1",
    "axle_box2": "axle_box_axle2",
    "bogie": "frame_axle1",
    "body": "body",
}
"""Names of the package for the rich train's places."""
LATER_SEEDS = 1000
"""Between the seed of a train and that of its later trips, where these have another length."""


def drawn_ratios(options, seed):
    """Return the ratios of each trip, (n_trips, 13): healthy, one part each, healthy again."""
    rng = np.random.default_rng([seed, 30])
    n_parts = len(COMPONENTS) - 1
    ratios = np.ones((options.healthy + options.worn + options.later, n_parts + 1))
    ratios[:, -1] = rng.uniform(*PAYLOADS, len(ratios))
    ratios[: options.healthy, -1] = rng.permutation(np.linspace(*PAYLOADS, options.healthy))
    # each kind of part at low and high levels, in another order for each seed
    n_faults = options.worn // options.together
    n_drawn = max(n_faults, n_parts)
    levels = np.resize(rng.permutation(LEVELS), n_drawn)
    for i, number in enumerate(np.linspace(0, n_drawn - 1, n_faults).round().astype(int)):
        first = options.healthy + options.together * i
        worn = [number % n_parts]
        ratios[first : first + options.together, worn] = levels[number]
    return ratios


def vehicle(options):
    """Return the vehicle before its trips, with the sensors of the layout."""
    places = [sensor.split() for sensor in LAYOUTS[options.sensors]]
    return suspnet.SpatialVehicle(
        AM96,
        parts=PARTS_OF_BOGIE,
        sensors=tuple(f"{PLACES[name]}_{side}" for name, side in places),
        distribution="prior",
    )


def simulated(name, seed, options, folder):
    """Return the ratios of one train's trips, their temperatures [°C] and the trips."""
    ratios, manifests = written(name, seed, options, folder)
    celsius, of = [manifest.temperature_c for manifest in manifests], vehicle(options)
    trips = [
        suspnet.bogie_trip(suspnet.load_recording(manifest, 100.0), of) for manifest in manifests
    ]
    return ratios, celsius, trips


def written(name, seed, options, folder):
    """Return the ratios of one train's trips and their manifests, written to a folder."""
    ratios = drawn_ratios(options, seed)
    speeds = np.random.default_rng([seed, 31]).uniform(*options.speeds, len(ratios))
    train = RichTrain.scattered(seed, SETS[name], sensors=LAYOUTS[options.sensors])

    def write(some, minutes, own_seed):
        way = "both" if options.both_ways else "forward"
        fleet = Fleet(len(ratios[some]), minutes=minutes, direction=way, rate_hz=RATE_HZ)
        at = {"speeds_m_per_s": speeds[some], "rate_hz": RATE_HZ}
        return write_train_trips(folder / str(own_seed), train, ratios[some], fleet, own_seed, **at)

    begun = time.perf_counter()
    if options.later_minutes is None:
        paths = write(slice(None), options.minutes, seed)
    else:
        paths = write(slice(options.healthy), options.minutes, seed)
        later = slice(options.healthy, None)
        paths += write(later, options.later_minutes, seed + LATER_SEEDS)
    print(f"{name}, {seed}: {time.perf_counter() - begun:.0f} s to simulate", flush=True)
    return ratios, [suspnet.read_manifest(path) for path in paths]


def read(name, seed, options, ratios, celsius, trips):
    """Return a row of each trip of one train."""
    begun = time.process_time()
    healthy, temperatures_c = trips[: options.healthy], celsius[: options.healthy]
    commissioned = suspnet.commission_bogie(
        vehicle(options), healthy, temperatures_c, further_parts=FURTHER_PARTS
    )
    took = time.process_time() - begun
    print(f"{name}, {seed}: {took:.0f} s, misfit {commissioned.misfit:.2f}", flush=True)
    head = {
        "set": label(name, options),
        "seed": seed,
        "minutes": options.minutes,
        "n_healthy": options.healthy,
    }
    head |= {"healthy_misfit": f"{commissioned.misfit:.3f}", "commission_s": f"{took:.0f}"}
    head |= {"commission_is_done": int(commissioned.converged)}
    later = range(options.healthy, len(trips))
    rows, readings = [], []
    for i in later:
        found = fit_parts(commissioned, trips[i], temperature_c=celsius[i])
        is_flagged = not (commissioned.converged and found.converged)  # as by estimate_parts
        row = head | {"trip": i} | row_of(found, ratios[i])
        rows.append(row | {"flagged": int(is_flagged), "is_done": int(found.converged)})
        readings = [*readings, found][-options.together :]
        is_last = (i + 1 - options.healthy) % options.together == 0
        joint = options.together > 1 and is_last
        rows[-1]["together"] = joint_verdict(commissioned, readings, ratios[i]) if joint else ""
    return rows


def joint_verdict(commissioned, readings, truth):
    """Return the verdict of several trips of one fault."""
    logs = np.array([np.log(found.values[:-1]) for found in readings])
    widths = np.array([Z90 * found.deviations[:-1] for found in readings])
    joint = joint_estimate(commissioned, logs, widths, 0.9)
    return verdict(worn_names(truth), [one.names for one in suspnet.worn_parts(joint)])


def row_of(found, truth):
    """Return what was read of one trip."""
    names, shows_parts = list(found.names), found.names == COMPONENTS
    true = dict(zip(COMPONENTS, truth, strict=True))
    if not shows_parts:  # all of a kind are alike
        true |= {name: true[next(c for c in COMPONENTS if c.startswith(name))] for name in names}
    truth = np.array([true[name] for name in names])
    errors = np.log(found.values) - np.log(truth)
    worn = [name for name in names[:-1] if true[name] != 1]
    row = {"part": worn[0] if worn else "healthy", "misfit": f"{found.misfit:.3f}"}
    if worn:
        place = names.index(worn[0])
        row |= {"percent": 100 * truth[place], "read_percent": f"{100 * found.values[place]:.2f}"}
    else:
        row |= {"percent": 100.0, "read_percent": ""}
    row |= {"accused": "", "verdict": ""}
    if shows_parts:
        accused = [one.names for one in suspnet.worn_parts(found)]
        row |= {"accused": " ".join(map("+".join, accused)), "verdict": verdict(worn, accused)}
    for kind in (*KINDS, "M_s"):
        of = np.array([name.startswith(kind) for name in names])
        held = np.abs(errors[of]) < Z90 * found.deviations[of]
        row[f"rms_{kind}_percent"] = f"{100 * np.sqrt(np.mean(errors[of] ** 2)):.3f}"
        row[f"held_{kind}_percent"] = f"{100 * held.mean():.0f}"
        row[f"width_{kind}_percent"] = f"{100 * Z90 * np.median(found.deviations[of]):.2f}"
    return row


def worn_names(truth):
    """Return the names of the parts whose ratios are not 1."""
    return [name for name, true in zip(COMPONENTS[:-1], truth[:-1], strict=True) if true != 1]


def verdict(worn, accused):
    """Return right, wrong or silent: parts that did not wear are accused, or none is."""
    if any(not set(worn) & set(group) for group in accused):
        return "wrong"
    return "right" if bool(accused) == bool(worn) else "silent"


def label(name, options):
    """Return the name of a set with what differs from the usual trips."""
    low, high = options.speeds
    further = [name]
    further += [f"{low:g} to {high:g} m/s"] if high > low else []
    further += ["both ways"] if options.both_ways else []
    further += [f"{options.later_minutes:g} minutes"] if options.later_minutes else []
    further += [f"{options.together} trips each"] if options.together > 1 else []
    further += [f"sensors: {options.sensors}"] if options.sensors != "six" else []
    return ", ".join(further)


def table(rows):
    """Return a line for each set, over its trains, parts and trips."""
    lines = []
    for name in dict.fromkeys(row["set"] for row in rows):
        of = [row for row in rows if row["set"] == name]
        worn = [row for row in of if row["part"] != "healthy"]
        misfits = sorted({float(row["healthy_misfit"]) for row in of})
        ends = f"{misfits[0]:.2f} to {misfits[-1]:.2f}" if len(misfits) > 1 else f"{misfits[0]:.2f}"
        seeds = sorted({int(row["seed"]) for row in of})
        line = {"set": name, "seeds": " ".join(map(str, seeds)), "misfit": ends}
        if len(seeds) > 6:
            line["seeds"] = f"{seeds[0]} to {seeds[-1]}"
        n_held, n_all = 0.0, 0
        for kind in KINDS:
            squares = [float(row[f"rms_{kind}_percent"]) ** 2 for row in worn]
            held = [float(row[f"held_{kind}_percent"]) / 100 for row in worn]
            width = np.median([float(row[f"width_{kind}_percent"]) for row in worn])
            rms, percent = np.sqrt(np.mean(squares)), 100 * np.mean(held)
            line[kind] = f"{rms:.2g} / +-{width:.2g} / {percent:.0f}"
            alike = not any(row.get("verdict") for row in of)  # all parts of a kind as one
            n_parts = 1 if alike else sum(part.startswith(kind) for part in COMPONENTS)
            n_held, n_all = n_held + n_parts * sum(held), n_all + n_parts * len(held)
        low, high = binomtest(round(n_held), n_all).proportion_ci(method="wilson")
        line["held"] = f"{100 * n_held / n_all:.0f} ({100 * low:.0f} to {100 * high:.0f})"
        line["right"] = line["wrong"] = "-"
        if not alike:
            line["right"] = f"{sum(row['verdict'] == 'right' for row in worn)} of {len(worn)}"
            line["wrong"] = f"{sum(row['verdict'] == 'wrong' for row in of)} of {len(of)}"
        line["flagged"] = sum(int(row["flagged"]) for row in of)
        joint = [row["together"] for row in worn if row.get("together")]
        line["joint"] = f"{joint.count('right')} of {len(joint)}" if joint else "-"
        lines.append(line)
    return tabulate(lines, headers="keys", tablefmt="pipe", disable_numparse=True)


def stored(path, rows):
    """Return the rows of a file but for those of the same sets and seeds, and the new ones."""
    runs = {(row["set"], str(row["seed"])) for row in rows}
    old = list(csv.DictReader(path.open())) if path.exists() else []
    return [row for row in old if (row["set"], row["seed"]) not in runs] + rows


@threads(1)
def main():
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="a train each")
    parser.add_argument("--healthy", type=at_least(3), default=6, help="trips to commission on")
    parser.add_argument("--worn", type=at_least(1), default=12, help="trips with a worn part")
    parser.add_argument("--later", type=at_least(0), default=3, help="healthy trips after these")
    parser.add_argument("--minutes", type=at_least(4, float), default=20.0, help="of a trip")
    parser.add_argument("--together", type=at_least(1), default=1, help="trips of each fault")
    parser.add_argument("--later-minutes", type=at_least(3, float), help="of trips after these")
    parser.add_argument("--speeds", nargs=2, type=float, default=[SPEED_M_PER_S] * 2, help="m/s")
    parser.add_argument("--sensors", choices=list(LAYOUTS), default="six", help="where they are")
    parser.add_argument("--both-ways", action="store_true", help="every other trip in reverse")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the table")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "rough_train.csv"
    for name in options.sets:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                train = simulated(name, seed, options, Path(folder))
            rows = stored(path, read(name, seed, options, *train))
            write_rows(path, rows)
            print(table(rows), flush=True)


if __name__ == "__main__":
    main()
