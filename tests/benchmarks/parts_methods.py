"""Which regression starts the fit of a bogie's parts best, at equal time of training.

python tests/benchmarks/parts_methods.py [--seeds 0 1 2] [--trips 12]

Each seed is a vehicle with numbers drawn from the prior. Spectral matrices of its trips are drawn
from its own model: 20 minutes at 70 m/s, 34 dB, an unknown track. It is commissioned on five
healthy trips; then each method is trained on as many drawn trips as it takes about 10 s with, and
reads worn trips: one part at 10, 30, 62 or 80 %, two at 30 to 130 %, all twelve at 50 to 130 %.
Errors are those before and after the fit that starts from its ratios; without a method, the fit
starts from the healthy vehicle. Seconds are those of one processor. Writes
parts_methods.csv and parts_methods.md.
"""

import time
from pathlib import Path

import numpy as np
import torch
from cells import Parser, at_least
from foreign_trains import TESTS
from joblib import Parallel, delayed
from mismatch import short, write
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neural_network import MLPRegressor
from tabulate import tabulate
from vehicles import AM96

from suspnet.dynamics import SpatialVehicle
from suspnet.dynamics.track import acceleration_density, track_spectrum
from suspnet.estimation.bogie_fit import commission_bogie
from suspnet.estimation.bogie_trips import HIGH_HZ, LOW_HZ, PARTS_OF_BOGIE, SEGMENT_S, SPACING_HZ
from suspnet.estimation.layouts import _noise
from suspnet.estimation.parts_regression import N_FEATURES, N_TRAIN, default_msvr, train_parts
from suspnet.ground.parameters import COMPONENTS
from suspnet.learning import MVGPR, SVR, LinearRegression
from suspnet.spectra.bogie_trip import BogieTrip
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.subspace import SpectralMatrix
from suspnet.spectra.welch import Welch

RESULTS = TESTS / "benchmarks" / "results"
BINS = torch.arange(LOW_HZ, HIGH_HZ + 1e-9, SPACING_HZ, dtype=torch.float64)
ALONE = (0.1, 0.3, 0.62, 0.8)
KINDS = (*ALONE, "two", "all")
WIDTH = N_FEATURES**0.5
METHODS = {
    "MSVR": (N_TRAIN, default_msvr),
    "SVR": (3000, lambda: SVR(C=10.0, sigma=4 * WIDTH, epsilon=0.03, n_jobs=1)),
    "GP": (
        4000,
        lambda: MVGPR(3 * WIDTH, 1.0, 1e-3, n_restarts=0, n_optimize=600, max_iter=100),
    ),
    "linear": (6000, LinearRegression),
    "MLP": (
        4000,
        lambda: MLPRegressor(
            hidden_layer_sizes=(256, 256), max_iter=100, early_stopping=True, random_state=0
        ),
    ),
    "boosting": (
        1000,
        lambda: MultiOutputRegressor(HistGradientBoostingRegressor(max_iter=60, random_state=0)),
    ),
}
"""Number of training trips of each method, and the method."""
HEALTHY = "none: the healthy vehicle"
OF_VALLEY = 1.005
"""A fit has found the valley if its misfit is at most this multiple of the lowest of all."""


class Drawn:
    """A vehicle with numbers of its own, and spectral matrices of its trips."""

    def __init__(self, seed):
        self.rng = np.random.default_rng([seed, 30])
        self.vehicle = SpatialVehicle(AM96, parts=PARTS_OF_BOGIE, distribution="prior")
        numbers = self.vehicle.distribution
        self.numbers = numbers.ratios(self.rng.standard_normal((1, len(numbers.names))))
        settings = EstimateSettings()
        track = track_spectrum(settings.track, settings.short_waves)
        speed = self.vehicle.speed_m_per_s
        self.density = torch.as_tensor(acceleration_density(track, BINS.numpy(), speed))
        medians = self.vehicle.complete(torch.ones(1, len(COMPONENTS), dtype=torch.float64))
        self.noise = _noise(self.vehicle, medians, track, settings)
        self.n_averages = Welch(SEGMENT_S).n_averages(2 * 60 * settings.minutes / SEGMENT_S - 1)

    def trip(self, ratios):
        """Return a trip with the ratios (13,) of its parts."""
        numbers = torch.as_tensor(self.numbers)
        rows = self.vehicle.with_uncertain(torch.as_tensor(ratios)[None], numbers)
        a = self.vehicle.channels(rows, BINS)[0].permute(2, 1, 0)
        a = a * self.density.sqrt()[:, None, None]
        n = round(self.n_averages)
        shape = a.shape[0], a.shape[1] + a.shape[2], n, 2
        drawn = torch.view_as_complex(torch.as_tensor(self.rng.standard_normal(shape) / 2**0.5))
        p = a.shape[2]
        signals = a @ drawn[:, :p] + self.noise.sqrt()[:, None] * drawn[:, p:]
        matrix = SpectralMatrix(signals @ signals.mH / n, self.n_averages)
        return BogieTrip(BINS, matrix, self.vehicle.speed_m_per_s)

    def ratios(self, n_trips):
        """Return the ratios of worn trips, (n_trips, 13)."""
        ratios = np.ones((n_trips, len(COMPONENTS)))
        for i, row in enumerate(ratios):
            kind = KINDS[i % len(KINDS)]
            if kind == "all":
                row[:-1] = self.rng.uniform(0.5, 1.3, len(row) - 1)
            elif kind == "two":
                row[self.rng.choice(12, 2, replace=False)] = self.rng.uniform(0.3, 1.3, 2)
            else:
                row[self.rng.integers(12)] = kind
        ratios[:, -1] = self.rng.uniform(1.0, 1.15, n_trips)
        return ratios


def timed(function, *given, **named):
    """Return what a function returns and the seconds of the processor that it took."""
    start = time.process_time()
    return function(*given, **named), time.process_time() - start


def read(seed, options):
    """Return rows of one vehicle: each method, each kind of part."""
    torch.set_num_threads(1)
    drawn = Drawn(seed)
    masses = drawn.rng.uniform(1.0, 1.15, 5)
    healthy = [drawn.trip(np.r_[np.ones(12), mass]) for mass in masses]
    bogie = commission_bogie(drawn.vehicle, healthy)
    truth = drawn.ratios(options.trips)
    trips = [drawn.trip(row) for row in truth]
    found = {}
    for name in (HEALTHY, *options.methods):
        starts, times = [None] * len(trips), (0.0, 0.0)
        n_train = 0
        if name != HEALTHY:
            n_train, make = METHODS[name]
            regression, train_s = timed(train_parts, bogie, healthy, make(), n_train, seed)
            starts, read_s = timed(lambda r: [r(trip) for trip in trips], regression)
            times = train_s, read_s / len(trips)
        fits, refine_s = timed(
            lambda s: [bogie.estimate(t, start=x) for t, x in zip(trips, s, strict=True)], starts
        )
        head = {"seed": seed, "method": name, "n_train": n_train, "train_s": times[0]}
        head |= {"read_s": times[1], "refine_s": refine_s / len(trips), "n_trips": len(trips)}
        found[name] = head, starts, fits
        print(head, flush=True)
    misfits = np.array([[one.misfit for one in fits] for _, _, fits in found.values()])
    lowest = misfits.min(axis=0)
    rows = []
    for (head, starts, fits), own in zip(found.values(), misfits, strict=True):
        head["n_valley"] = int(np.sum(own <= OF_VALLEY * lowest))
        for output in ("k_p", "c_p", "k_s", "c_s", "M_s"):
            columns = [name.startswith(output) for name in COMPONENTS]
            row = head | {"output": output}
            if starts[0] is not None:
                row["before_percent"] = rms(np.array(starts), truth, columns)
            row["after_percent"] = rms(np.array([one.values for one in fits]), truth, columns)
            rows.append(row)
    return rows


def rms(values, truth, columns):
    """Return the rms of the errors of logarithms, %."""
    return float(100 * np.sqrt(np.mean(np.log(values / truth)[:, columns] ** 2)))


def table(rows):
    """Return one line for each method, over all vehicles."""
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        some = [row for row in rows if row["method"] == method]
        each = [row for row in some if row["output"] == "k_p"]
        lines.append(
            [
                method,
                str(each[0]["n_train"] or "-"),
                *(short(np.mean([row[name] for row in each])) for name in ("train_s", "read_s")),
                *errors(some),
                short(np.mean([row["refine_s"] for row in each])),
                f"{sum(row['n_valley'] for row in each)} of {sum(row['n_trips'] for row in each)}",
            ]
        )
    headers = ["method", "trips of training", "training, s", "reading, s"]
    headers += ["k_p", "c_p", "k_s", "c_s", "fit, s", "valley found"]
    return tabulate(lines, headers, tablefmt="github", disable_numparse=True)


def errors(rows):
    """Return rms errors before and after the fit of each kind of spring and damper."""
    cells = []
    for output in ("k_p", "c_p", "k_s", "c_s"):
        of = [row for row in rows if row["output"] == output]
        both = [
            [row[name] for row in of if row.get(name) not in (None, "")]
            for name in ("before_percent", "after_percent")
        ]
        cells.append(" / ".join(short(np.sqrt(np.mean(np.square(x)))) if x else "-" for x in both))
    return cells


def main():
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="a vehicle each")
    parser.add_argument("--trips", type=at_least(1), default=12, help="worn trips of each vehicle")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--jobs", type=at_least(1), default=2, help="vehicles at the same time")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the tables")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    parallel = Parallel(options.jobs, return_as="generator")
    rows = []
    for some in parallel(delayed(read)(seed, options) for seed in options.seeds):
        rows += some
        write(rows, options.output / "parts_methods.csv")
        (options.output / "parts_methods.md").write_text(f"{table(rows)}\n")
        print(table(rows), flush=True)


if __name__ == "__main__":
    main()
