"""Whether one way of reading trips can replace two: errors, coverage and seconds of each.

python benchmarks/one_way.py [--cases "one side" pairs] [--seeds 0 1 2] [--minutes 20 5]

Each seed is a train of tests/blind_train.py, of which neither way has the equations. Five healthy
trips commission it, then come trips on which all springs and dampers of a kind have worn alike.
Ways:

- transfer functions: `VerticalVehicle`, from axle box to frame to body, means of pairs;
- each part: `SpatialVehicle` and spectral matrices, twelve separate ratios, of which the one of a
  kind is the weighted mean;
- tied: the same with one ratio of each kind (``EQUAL`` of `suspnet.trains.fits.bogie_misfit`), from
  all sensors, or from the means of pairs as sensors in the middle of a vehicle of equal sides.

Every later trip and kind goes to one_way.csv, where the rows of the same case, minutes, speeds and
seed are replaced. Seconds are those of one processor, without spectra.
"""

import csv
import tempfile
import time
from argparse import ArgumentParser
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from named_parts import BOXES, DIAGONAL, PAIRS, RESULTS, Run, Track, Train, record, write_trip
from scipy.stats import norm
from tabulate import tabulate

import suspnet
from suspnet.bounds.information import shifts
from suspnet.curves.problem import CALIBRATE, Problem
from suspnet.curves.welch import Welch
from suspnet.estimation.intervals import COMMON
from suspnet.estimation.refine import refine
from suspnet.ground.parameters import COMPONENTS, PARAMETERS
from suspnet.ground.tensors import threads
from suspnet.runs.predict import N_COST, WORN
from suspnet.trains.fits.bogie_fit import commission_bogie, fit_parts
from suspnet.trains.fits.commissioning import Commissioned, commission
from suspnet.trains.identification.bogie_trips import SEGMENTS_S, bogie_trip, bogie_vehicle
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.commissioning import FAMILY, prior_of
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.segments import sensor_segments
from suspnet.trains.spectra.subspace import SpectralMatrix

LAYOUTS = {
    "one side": PAIRS[::2],
    "pairs": PAIRS,
    "four": PAIRS[2:],
    "seven": (*BOXES, *DIAGONAL, PAIRS[4]),
    "eight": (*BOXES, *DIAGONAL, *PAIRS[4:]),
}
SPEEDS = {"fast": (60.0, 78.0), "slow": (25.0, 40.0)}
"""Ranges of the speeds of all trips [m/s]."""
KINDS = PARAMETERS[:4]
ALIKE = (
    *("bushings", "rubber", "guidance", "longitudinal", "bending", "payload", "sensors"),
    *("other_bogie", "axle_box_arm"),
)
"""Parts that the vertical vehicle has too; what excites single wheelsets is in the noise."""
VERTICAL = (*ALIKE[:-1], "yaw_dampers")
"""Parts of a vehicle whose sensors measure no lateral motion, as trips of each part have them."""
TIED = {"middle": ("tied, three channels", VERTICAL), "alike": ("tied, no yaw dampers", ALIKE)}
"""Ways of three channels, and the parts of their vehicles."""
TRANSFER = {
    "transfer": ("transfer functions", FAMILY),
    "transfer_yaw": ("transfer functions, yaw dampers", (*FAMILY, "yaw_dampers")),
}
"""Ways of the vertical vehicle, and its parts."""
LEVEL = 0.9
N_HEALTHY = 5
BAND_HZ = (0.5, 18.0)
LONG = 15.0
"""Minutes of a trip from which segments are as long as those of the programs."""
SHORT_S = 40.0
"""Length of the segments of six sensors on shorter trips, [s]: seven averages in 5 minutes."""


@dataclass(frozen=True)
class Case:
    """A layout of sensors, the length of a trip and the speeds of a train."""

    layout: str
    minutes: float
    speeds: str
    seed: int

    @property
    def head(self):
        """Columns that tell the case."""
        return {
            "layout": self.layout,
            "minutes": f"{self.minutes:g}",
            "speeds": self.speeds,
            "seed": str(self.seed),
        }


def written(case, n_worn, folder):
    """Write the trips of a case, healthy ones first, and return the worn ones' ratios by kind."""
    rng = np.random.default_rng([case.seed, 30])
    places = LAYOUTS[case.layout]
    train = Train.scattered(case.seed, sensors=True).measured_at(places, case.seed)
    ratios = np.ones((N_HEALTHY + n_worn, len(PARAMETERS)))
    ratios[N_HEALTHY:, :4] = rng.uniform(0.5, 1.3, (n_worn, 4))
    ratios[:, 4] = rng.uniform(1.0, 1.25, len(ratios))
    for i, row in enumerate(ratios):
        parts = [row[PARAMETERS.index(name[:3])] for name in COMPONENTS]
        run = Run(float(rng.uniform(*SPEEDS[case.speeds])), minutes=case.minutes, alone_share=0.01)
        signals = record(train.worn(parts), Track.drawn(rng), run, [case.seed, 31, i])
        write_trip(folder, f"trip_{i}", signals, run, 1000.0 + i, places)
    return ratios[N_HEALTHY:]


def rows_of(case, way, truth, values, deviations, seconds, commission_s, misfit):
    """Return a row of each kind on one trip."""
    head = case.head | {
        "way": way,
        "commission_s": f"{commission_s:.1f}",
        "misfit": f"{misfit:.3f}",
    }
    return [
        head
        | {"kind": kind, "truth": f"{truth[i]:.4f}", "estimate": f"{values[i]:.5f}"}
        | {"deviation_percent": f"{100 * deviations[i]:.3f}", "trip_s": f"{seconds:.2f}"}
        for i, kind in enumerate(KINDS)
    ]


# transfer functions


def commissioned(case, folder, parts=FAMILY):
    """Return settings, the vertical vehicle of the healthy trips, all trips, and the seconds."""
    vehicle = suspnet.read_vehicles()["am96"]
    generator = suspnet.VerticalVehicle(vehicle, parts=parts)
    settings = suspnet.EstimateSettings(minutes=case.minutes)
    trips = suspnet.TripSettings(check_channels=False)
    every = read_healthy(folder, generator, settings.bound(vehicle), trips)
    groups = tuple(one for one in every.groups if one.trip < N_HEALTHY)
    healthy = replace(every, manifests=every.manifests[:N_HEALTHY], groups=groups)
    start = time.process_time()
    outcome = commission(prior_of(generator, healthy), settings.bound(vehicle), healthy.groups)
    return settings, outcome, every.groups, time.process_time() - start


def by_transfer_functions(case, folder, worn, way, parts):
    """Return the rows of the vertical vehicle, each fit started from the healthy vehicle."""
    settings, outcome, groups, took = commissioned(case, folder, parts)
    read = TransferReader(outcome, settings)
    rows = []
    for group in groups:
        if group.trip < N_HEALTHY:
            continue
        start = time.process_time()
        values, deviations, misfit = read(group)
        seconds = time.process_time() - start
        rows += rows_of(
            *(case, way, worn[group.trip - N_HEALTHY]),
            *(values, deviations, seconds, took, misfit),
        )
    return rows


class TransferReader:
    """Reads trips with a commissioned vehicle as `estimate_with_noise` does, but for its start."""

    def __init__(self, outcome: Commissioned, settings):
        self.task = suspnet.read_protocol("trips").task("all")
        problem = Problem(outcome.generator, self.task, settings)
        self.observer = problem.observer
        ratios = self.task.sample(N_COST, problem.seed, CALIBRATE)
        unknown = self.task.unknown
        changes = shifts(problem.observer, ratios, unknown, outcome.residual.logs)
        columns = [unknown.index(name) for name in self.task.outputs]
        self.costs = WORN * np.sqrt(np.mean(changes[:, columns] ** 2, axis=0))

    @threads(1)
    def __call__(self, group, ratios=None):
        """Return values, deviations of their logarithms and the misfit of one group."""
        observer = self.observer.at(group.speeds).without(group.left_out)
        start = np.ones((1, len(self.task.outputs))) if ratios is None else ratios
        misfit = observer.measured_misfit(group.spectra)
        found = refine(self.task, misfit, start, directions=observer.directions)
        values, deviations = (one[0] for one in found.of(self.task.outputs))
        noise = found.noise_of(self.task.outputs)[0]
        lasting = np.maximum(deviations**2 - noise**2, 0)
        lasting = COMMON**2 * (lasting + self.costs**2)
        size = max(1.0, float(found.misfit[0]))
        return values, np.sqrt(lasting + (size * noise) ** 2), float(found.misfit[0])


# spectral matrices


def middle_vehicle(case, parts):
    """Return the vehicle of equal sides whose three sensors are on one side or in the middle."""
    side = "left" if case.layout == "one side" else "middle"
    places = [f"{place}_{side}" for place in ("axle_box_axle1", "frame_axle1", "body")]
    vehicle = suspnet.SpatialVehicle(
        suspnet.read_vehicles()["am96"], parts=parts, sensors=places
    ).with_prior()
    of_sides = [
        one.name
        for one in vehicle.quantities
        if one.name.endswith(("_left", "_right")) and one.name.startswith(("healthy", "other"))
    ]
    if side == "middle":
        of_sides += [one.name for one in vehicle.quantities if one.part == "roll"]
    return replace(vehicle, distribution=vehicle.distribution.without(of_sides))


def matrix_trip(recording, vehicle, segment_s, spacing_hz):
    """Return the spectral matrix of the sensors of a vehicle, those in the middle as means."""
    names, segments = sensor_segments(recording, Welch(segment_s))
    sources = recording.manifest.sensors()
    channels = {"axle_box": "axle_box", "frame": "bogie", "body": "body"}
    rows = []
    for place in vehicle.sensors:
        side = place.rpartition("_")[2]
        channel = next(channels[kind] for kind in channels if place.startswith(kind))
        own = [
            name.split()[0] == channel
            and (side == "middle" or recording.manifest.side_of(sources[name]) == side)
            for name in names
        ]
        rows.append(np.array(own) / np.sum(own))
    mixed = torch.tensor(np.array(rows), dtype=segments.values.dtype) @ segments.values
    every = torch.ones(len(mixed), dtype=torch.bool)
    low, high = (round(end * segment_s) for end in BAND_HZ)
    first = round(float(segments.frequencies_hz[0]) * segment_s)
    bins = torch.arange(low - first, high - first + 1, round(spacing_hz * segment_s))
    matrix = SpectralMatrix.of(replace(segments, values=mixed), every).at(bins)
    speed_m_per_s = float(recording.speed_m_per_s.mean())
    return BogieTrip(segments.frequencies_hz[bins], matrix, speed_m_per_s, welch=segments.welch)


def by_kind(found):
    """Return the ratio of each kind and its deviation, of separate parts their weighted mean."""
    if len(found.names) == len(PARAMETERS):
        return found.values[:4], found.deviations[:4]
    ties = np.array([[name.startswith(kind) for kind in PARAMETERS] for name in COMPONENTS], float)
    inverse = np.linalg.inv(found.covariance)
    covariance = np.linalg.inv(ties.T @ inverse @ ties)
    logs = covariance @ ties.T @ inverse @ np.log(found.values)
    return np.exp(logs)[:4], np.sqrt(np.diag(covariance))[:4]


def by_matrices(case, trips, vehicle, worn, ways):
    """Return the rows of the ways, {name: whether the parts of a kind are tied}."""
    start = time.process_time()
    bogie = commission_bogie(vehicle, trips[:N_HEALTHY])
    took = time.process_time() - start
    print(f"  commissioned in {took:.0f} s, misfit {bogie.misfit:.2f}", flush=True)
    rows = []
    for way, equal in ways.items():
        for truth, trip in zip(worn, trips[N_HEALTHY:], strict=True):
            start = time.process_time()
            found = fit_parts(bogie, trip, equal=equal)
            seconds = time.process_time() - start
            rows += rows_of(case, way, truth, *by_kind(found), seconds, took, found.misfit)
    return rows


def recordings_of(folder):
    """Return the recordings of a folder in the order of its trips."""
    paths = sorted(folder.glob("*.yaml"), key=lambda path: int(path.stem.partition("_")[2]))
    return [suspnet.load_recording(suspnet.read_manifest(path), 100.0) for path in paths]


def read_case(case, options, folder):
    """Return the rows of all ways that a case allows."""
    worn = written(case, options.trips, folder)
    rows: list[dict[str, str]] = []
    for way, parts in [TRANSFER[key] for key in options.ways if key in TRANSFER]:
        if case.layout != "four":  # it has no axle box
            rows += by_transfer_functions(case, folder, worn, way, parts)
            merged(rows, options.output)
    recordings = recordings_of(folder)
    is_of_three = case.layout in ("one side", "pairs")
    for way, parts in [TIED[key] for key in options.ways if is_of_three and key in TIED]:
        vehicle = middle_vehicle(case, parts)
        segment_s = options.segment_s or SEGMENTS_S[case.minutes < LONG]
        trips = [matrix_trip(one, vehicle, segment_s, options.spacing_hz) for one in recordings]
        rows += by_matrices(case, trips, vehicle, worn, {way: True})
        merged(rows, options.output)
    if case.layout != "one side" and "parts" in options.ways:
        manifests = [one.manifest for one in recordings]
        vehicle = bogie_vehicle(manifests, suspnet.VerticalVehicle(suspnet.read_vehicles()["am96"]))
        trips = [bogie_trip(one, vehicle) for one in recordings]
        ways = {"each part": False, "tied, all sensors": True}
        rows += by_matrices(case, trips, vehicle, worn, ways)
        merged(rows, options.output)
    return rows


# tables


def table(rows):
    """Return rms error, coverage and seconds of each case and way, over all its trains."""
    keys = dict.fromkeys((r["layout"], r["minutes"], r["speeds"], r["way"]) for r in rows)
    lines = []
    for key in keys:
        own = [r for r in rows if (r["layout"], r["minutes"], r["speeds"], r["way"]) == key]
        cells = []
        for kind in KINDS:
            of = [r for r in own if r["kind"] == kind]
            errors = np.log([float(r["estimate"]) / float(r["truth"]) for r in of])
            half = norm.ppf((1 + LEVEL) / 2) * np.array([float(r["deviation_percent"]) for r in of])
            held = 100 * np.mean(np.abs(100 * errors) <= half)
            cells.append(f"{100 * np.sqrt(np.mean(errors**2)):.2g} / {held:.0f}")
        seconds = [np.median([float(r[name]) for r in own]) for name in ("trip_s", "commission_s")]
        n_trains = len({r["seed"] for r in own})
        lines.append([*key, n_trains, len(own) // 4, *cells, *(f"{s:.2g}" for s in seconds)])
    headers = ["sensors", "minutes", "speeds", "way", "trains", "trips", *KINDS]
    headers += ["s a trip", "s to commission"]
    return tabulate(lines, headers, tablefmt="github", disable_numparse=True)


def merged(rows, path):
    """Write the rows in place of those of the same cases and ways, and return all."""
    if not rows:
        return rows
    keys = ("layout", "minutes", "speeds", "seed", "way")
    new = {tuple(r[key] for key in keys) for r in rows}
    before = []
    if path.exists():
        with path.open(newline="") as file:
            before = [r for r in csv.DictReader(file) if tuple(r[key] for key in keys) not in new]
    every = before + rows
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(every)
    return every


def main():
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="a train each")
    parser.add_argument("--minutes", nargs="+", type=float, default=[20.0, 5.0], help="of a trip")
    parser.add_argument("--speeds", nargs="+", choices=SPEEDS, default=["fast"])
    parser.add_argument("--trips", type=int, default=6, help="worn trips of each train")
    parser.add_argument(
        "--ways", nargs="+", default=["transfer", "transfer_yaw", "middle", "parts"]
    )
    parser.add_argument("--segment_s", type=float, help="of three channels")
    parser.add_argument("--spacing_hz", type=float, default=0.1, help="of three channels")
    parser.add_argument("--output", type=Path, default=RESULTS / "one_way.csv")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for layout in options.layouts:
        for minutes in options.minutes:
            for speeds in options.speeds:
                for seed in options.seeds:
                    case = Case(layout, minutes, speeds, seed)
                    print(case, flush=True)
                    with tempfile.TemporaryDirectory() as folder:
                        rows = read_case(case, options, Path(folder))
                    every = merged(rows, options.output)
    print(table(every))


if __name__ == "__main__":
    main()
