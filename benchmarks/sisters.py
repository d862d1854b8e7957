"""False alarms and delays of the comparison of sister suspensions, and its time for a fleet.

    python benchmarks/sisters.py --cars 250 --trips 300

Four suspensions a car, trips every 2000 km, normal errors as correlated as allowed for, deviations
as of trips (k_p 0.06, c_p 0.3 % of healthy) with intervals that hold them.
"""

from __future__ import annotations

import math
import time
from argparse import ArgumentParser

import numpy as np
from scipy.signal import lfilter
from scipy.stats import chi2

from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance.sisters import CORRELATION, Sister, SisterSettings, sister_alarms

GAP_KM, N_SISTERS, Z = 2000.0, 4, 1.645
SPREAD = {"k_p": 0.0006, "c_p": 0.003}


def car(rng: np.random.Generator, change: FloatArray, spread: float) -> list[Sister]:
    """Return four suspensions of which the first changes by a factor at each trip."""
    n_trips = len(change)
    steps = math.sqrt(1 - CORRELATION**2) * rng.normal(size=(N_SISTERS, n_trips))
    steps[:, 0] /= math.sqrt(1 - CORRELATION**2)
    logs = spread * lfilter([1.0], [1.0, -CORRELATION], steps, axis=1)
    km, halves = GAP_KM * np.arange(1, n_trips + 1), np.full(n_trips, Z * spread)
    first = np.exp(logs[0]) * change
    return [Sister(km, values, halves) for values in (first, *np.exp(logs[1:]))]


def false_alarms(settings: SisterSettings, n_cars: int, n_trips: int, seed: int) -> str:
    """Return how many alarms healthy cars raise, over all parameters, with a 95 % interval."""
    rng, n = np.random.default_rng(seed), 0
    for _ in range(n_cars):
        for name in settings.least_percent:
            spread = SPREAD["k_p" if name.startswith("k") else "c_p"]
            found = sister_alarms(name, car(rng, np.ones(n_trips), spread), settings)
            n += sum(map(len, found))
    km = n_cars * N_SISTERS * n_trips * GAP_KM
    low, high = chi2.ppf(0.025, 2 * n) / 2 if n else 0.0, chi2.ppf(0.975, 2 * n + 2) / 2
    ends = ", ".join(f"{one / km * settings.km_per_false_alarm:.3g}" for one in (low, high))
    return (
        f"{n} alarms in {km:.3g} km of suspensions: "
        f"{n / km * settings.km_per_false_alarm:.3g} [{ends}] in {settings.km_per_false_alarm:g} km"
    )


def delays(name: str, change: FloatArray, begin: int, n_cars: int, seed: int) -> str:
    """Return after how many trips the first of four is told, and how often another one is."""
    rng, settings, found, wrong = np.random.default_rng(seed), SisterSettings(), [], 0
    for _ in range(n_cars):
        alarms = sister_alarms(name, car(rng, change, SPREAD[name]), settings)
        begins = [a.begin_km / GAP_KM - begin for a in alarms[0] if a.begin_km / GAP_KM > begin]
        found.append(min(begins, default=math.inf))
        wrong += any(alarms[1:])
    low, middle, high = np.quantile(found, [0.05, 0.5, 0.95], method="lower")
    return f"told after {middle:g} trips (5 to 95 %: {low:g} to {high:g}), others in {wrong} cars"


def main() -> None:
    """Print all of it."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=250)
    parser.add_argument("--trips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(f"{given.cars} cars of {N_SISTERS} suspensions, {given.trips} trips, seed {given.seed}")
    often = SisterSettings(1e6, dict.fromkeys(SisterSettings().least_percent, 0.0))
    for words, settings in (("no least difference", often), ("defaults", SisterSettings())):
        before = time.process_time()
        told = false_alarms(settings, given.cars, given.trips, given.seed)
        print(f"healthy, {words}: {told}; {time.process_time() - before:.1f} s of processor time")
    n, begin = 80, 40
    for name, percents in (("k_p", (-2.5, -3, -5, -10)), ("c_p", (-6, -8, -10, -20))):
        for percent in percents:
            step = np.where(np.arange(n) < begin, 1.0, 1 + percent / 100)
            print(f"{name} step {percent} %: {delays(name, step, begin, given.cars, given.seed)}")
    drift = 1 - 0.001 * np.maximum(np.arange(n) - begin, 0)
    print(f"k_p -0.1 % a trip: {delays('k_p', drift, begin, given.cars, given.seed)}")


if __name__ == "__main__":
    main()
