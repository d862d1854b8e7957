"""False alarms of healthy suspensions and delays of changes, beside what else a user would pick.

python benchmarks/alarms.py [--histories 2000] [--changed 200] [--seed 0]

A history has a reference of 20 trips, then 300 trips, one each 2,000 km unless said otherwise, of
four parameters, whose logarithms follow an autoregressive process with the scatter of the AM96's
estimates. Pay-load, speed and temperature change them, and are given. Prints tables, and
writes alarms.csv, alarms_methods.csv and alarms_delays.csv.

Competitors see the same histories without the effects of the covariates, which favours them:

- a two-sided CUSUM, k = 0.5, with level and spread of the 20 reference trips and no pre-whitening;
  h = 5 and the values that keep the budget on just these healthy histories;
- PELT of ruptures, run again after each trip, with the penalty log(n) sigma^2 of its guide, sigma
  that of the reference, and with six times that penalty;
- the simple jumper of crepes on conformal p-values, which rank a trip among those before it,
  against 1 / rate (Ville), and its ratio to its smallest value so far (its CUSUM).

ruptures and crepes (0.9.1) may be absent; the tables say so.
"""

import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cells import Parser, at_least
from scipy.stats import chi2
from tabulate import tabulate
from thresholds import autoregressive

from suspnet.trains.maintenance.change import ChangeSettings, find_changes
from suspnet.trains.maintenance.cusum import N_REFERENCE as REFERENCE

NAMES = ("k_p", "c_p", "k_s", "c_s")
SCATTER = np.array([0.0005, 0.005, 0.0006, 0.003])
"""Standard deviations of the logarithms."""
EFFECTS = np.array(
    [
        [0.002, 0.0, 0.01, 0.005],  # of the payload, 0 to 1
        [0.0, -2e-4, 0.0, 2e-4],  # per km/h
        [-1e-4, -4e-3, -2e-4, -3e-3],  # per K
    ]
)
RESULTS = Path(__file__).parent / "results"
SETTINGS = ChangeSettings()
N_REFERENCE, N_LATER, CHANGED_AT = REFERENCE, 300, 60
N_TRIPS = N_REFERENCE + N_LATER
WITHIN = 50
PER_TRIP = 2000 / SETTINGS.km_per_false_alarm / len(NAMES)
"""Rate of false alarms that each parameter may have, at 2,000 km a trip."""
CHANGES = {
    "step -1 %": lambda t: np.log1p(-0.01) * (t >= 0),
    "step -2 %": lambda t: np.log1p(-0.02) * (t >= 0),
    "step -5 %": lambda t: np.log1p(-0.05) * (t >= 0),
    "step -10 %": lambda t: np.log1p(-0.1) * (t >= 0),
    "drift -0.4 % / 100,000 km": lambda t: -0.004 * np.maximum(t + 1, 0) / 50,
    "drift -1 % / 100,000 km": lambda t: -0.01 * np.maximum(t + 1, 0) / 50,
    "drift -5 % / 100,000 km": lambda t: -0.05 * np.maximum(t + 1, 0) / 50,
}
"""Logarithm of a parameter, by trips since the change."""


@dataclass(frozen=True)
class Histories:
    """Scatter and effects of shape (n, n_trips, 4), covariates (n, n_trips, 3), km (n, n_trips)."""

    scatter: np.ndarray
    effects: np.ndarray
    covariates: np.ndarray
    km: np.ndarray


def histories(
    n: int,
    seed: int,
    correlation: float | None = None,
    spacing_km: float = 2000.0,
    degrees: int | None = None,
    season: int | None = None,
    curved: bool = False,
    uneven: bool = False,
) -> Histories:
    """Return healthy histories; correlation None: uniform on 0 to 0.5, of each history.

    `season` is a period in trips; `curved` makes c_p a parabola of the temperature.
    """
    random = np.random.default_rng(seed)
    shape = (N_TRIPS, n, len(NAMES))
    noise = random.standard_normal(shape)
    if degrees:
        noise = random.standard_t(degrees, shape) * np.sqrt((degrees - 2) / degrees)
    phi = random.uniform(0, 0.5, (n, 1)) if correlation is None else correlation
    scatter = autoregressive(noise, phi).swapaxes(0, 1) * SCATTER
    load, speed = random.uniform(0, 1, (n, N_TRIPS)), random.normal(160, 10, (n, N_TRIPS))
    temperature = random.normal(10, 8, (n, N_TRIPS))
    if season:
        turns = np.arange(N_TRIPS) / season + random.uniform(size=(n, 1))
        temperature = 10 + 12 * np.sin(2 * np.pi * turns) + random.normal(0, 3, (n, N_TRIPS))
    covariates = np.stack([load, speed, temperature], axis=-1)
    gaps = np.full((n, N_TRIPS), spacing_km)
    if uneven:  # five trips 200 km apart, then a pause, and ever more trips
        gaps = np.where(np.arange(N_TRIPS) % 5, 200.0, 9200.0) * np.linspace(1.8, 0.2, N_TRIPS)
        gaps = np.broadcast_to(gaps, (n, N_TRIPS))
    effects = (covariates - [0.5, 160, 10]) @ EFFECTS
    if curved:
        effects[..., NAMES.index("c_p")] += 4e-5 * (temperature - 10) ** 2
    return Histories(scatter, effects, covariates, np.cumsum(gaps, axis=1))


def found_by_us(given: Histories) -> list[dict[str, list[Any]]]:
    """Return the changes of each parameter of each history."""
    found = []
    for km, logs, x in zip(given.km, given.scatter + given.effects, given.covariates, strict=True):
        values = dict(zip(NAMES, np.exp(logs).T, strict=True))
        covariates = dict(zip(("load", "speed", "temperature"), x.T, strict=True))
        found.append(find_changes(km, values, covariates, SETTINGS).by_parameter)
    return found


def alarms_row(name: str, given: Histories) -> list[Any]:
    """Return all false alarms, their rate with its 95 % interval, and that of first alarms."""
    begin = time.process_time()
    found = found_by_us(given)
    seconds = time.process_time() - begin
    n_alarms = sum(len(one) for several in found for one in several.values())
    first = np.array([[first_of(several[name]) for name in NAMES] for several in found])
    km = (given.km[:, -1] - given.km[:, N_REFERENCE - 1]).sum()
    low, high = poisson(n_alarms)
    return [
        name,
        len(found),
        n_alarms,
        f"{n_alarms / km * 1e6:.3f}",
        f"{low / km * 1e6:.3f} to {high / km * 1e6:.3f}",
        f"{rate_of_first(first, given.km):.3f}",
        verdict(low, high, km / SETTINGS.km_per_false_alarm),
        f"{1e3 * seconds / len(found):.1f}",
    ]


def verdict(low: float, high: float, allowed: float) -> str:
    """Return whether the interval is below what is allowed."""
    return "yes" if high <= allowed else "NO" if low > allowed else "open"


def poisson(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a Poisson mean."""
    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return float(low), float(chi2.ppf(0.975, 2 * count + 2) / 2)


def first_of(changes: list[Any], since: int = 0) -> int:
    """Return the trip of the first alarm, ``N_TRIPS`` if there is none."""
    return min((one.begin for one in changes if one.begin >= since), default=N_TRIPS)


def rate_of_first(first: np.ndarray, km: np.ndarray) -> float:
    """Return first alarms per 1e6 km monitored until then, of four parameters together."""
    until = np.take_along_axis(km, np.minimum(first, N_TRIPS - 1), axis=1)
    monitored = (until - km[:, [N_REFERENCE - 1]]).sum() / len(NAMES)
    return float((first < N_TRIPS).sum() / monitored * 1e6)


def first_beyond(paths: np.ndarray, limit: float) -> np.ndarray:
    """Return the first trip of paths (n, n_later, 4) beyond a limit, ``N_TRIPS`` if none."""
    beyond = paths > limit
    return np.where(beyond.any(axis=1), beyond.argmax(axis=1) + N_REFERENCE, N_TRIPS)


def plain_cusum(scatter: np.ndarray) -> np.ndarray:
    """Return the larger of both CUSUMs after the reference, (n, n_later, 4)."""
    reference = scatter[:, :N_REFERENCE]
    z = (scatter - reference.mean(axis=1, keepdims=True)) / reference.std(
        axis=1, keepdims=True, ddof=1
    )
    up = down = np.zeros(z[:, 0].shape)
    paths = []
    for t in range(N_REFERENCE, N_TRIPS):
        up, down = np.maximum(0, up + z[:, t] - 0.5), np.maximum(0, down - z[:, t] - 0.5)
        paths.append(np.maximum(up, down))
    return np.stack(paths, axis=1)


def each_series(alarm: Callable[[np.ndarray], int], scatter: np.ndarray) -> np.ndarray:
    """Return the first alarm of each series alone."""
    return np.array([[alarm(series) for series in one.T] for one in scatter])


def pelt_alarm(factor: float) -> Callable[[np.ndarray], int]:
    from ruptures import KernelCPD

    def alarm(series: np.ndarray) -> int:
        variance = series[:N_REFERENCE].var(ddof=1)
        for n in range(N_REFERENCE + 1, N_TRIPS + 1):
            penalty = factor * variance * np.log(n)
            if len(KernelCPD(kernel="linear").fit(series[:n, None]).predict(pen=penalty)) > 1:
                return n - 1
        return N_TRIPS

    return alarm


def martingale_alarm(from_smallest: bool) -> Callable[[np.ndarray], int]:
    from crepes.base import p_values_online_regression
    from crepes.martingales import SimpleJumper

    def alarm(series: np.ndarray) -> int:
        p_values = p_values_online_regression(
            series[N_REFERENCE:], alphas_cal=series[:N_REFERENCE], seed=0
        )
        path = SimpleJumper().apply(p_values)
        if from_smallest:
            path = path / np.minimum.accumulate(np.concatenate([[1.0], path[:-1]]))
        beyond = np.flatnonzero(path >= 1 / PER_TRIP)
        return int(beyond[0]) + N_REFERENCE if len(beyond) else N_TRIPS

    return alarm


def calibrated(healthy: Histories) -> float:
    """Return the threshold at which the plain CUSUM just keeps the budget."""
    low, high = 5.0, 500.0
    paths = plain_cusum(healthy.scatter)
    for _ in range(20):  # bisection
        middle = (low + high) / 2
        much = rate_of_first(first_beyond(paths, middle), healthy.km) > 1
        low, high = (middle, high) if much else (low, middle)
    return high


def competitors(
    healthy: Histories, correlated: Histories
) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Return what finds the first alarms, (n, 4), in series of shape (n, n_trips, 4)."""
    methods: dict[str, Callable[[np.ndarray], np.ndarray]] = {}
    for limit in (5.0, calibrated(healthy), calibrated(correlated)):
        methods[f"CUSUM, h = {limit:.1f}"] = lambda series, limit=limit: first_beyond(
            plain_cusum(series), limit
        )
    for name, build, option in (
        ("PELT (ruptures)", pelt_alarm, 1),
        ("PELT, 6 x penalty", pelt_alarm, 6),
        ("martingale (crepes)", martingale_alarm, False),
        ("CUSUM of martingale", martingale_alarm, True),
    ):
        try:
            alarm = build(option)
        except ImportError as error:
            print(f"{name}: absent, {error}")
            continue
        methods[name] = lambda series, alarm=alarm: each_series(alarm, series)
    return methods


def delays(first: np.ndarray) -> list[str]:
    """Return median, 90 % quantile and share within ``WITHIN`` trips, of each parameter."""
    cells = []
    for one in first.T:
        late = np.sort(one[one >= CHANGED_AT]).astype(float)
        if len(late) < len(one) / 4:
            cells.append("-")
            continue
        late[late == N_TRIPS] = np.inf
        late -= CHANGED_AT - 1
        median, upper = (late[int(np.ceil(q * len(late))) - 1] for q in (0.5, 0.9))
        cells.append(f"{median:.0f} / {upper:.0f} / {(late <= WITHIN).mean():.0%}")
    return cells


def show(rows: list[list[Any]], head: list[str], file: Path) -> None:
    """Print a table and write it."""
    print(tabulate(rows, head, disable_numparse=True), "\n")
    with file.open("w", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([head, *rows])


def print_false_alarms(n: int, seed: int, output: Path) -> None:
    cases: list[tuple[str, dict[str, Any]]] = [
        ("correlation 0 to 0.5", {}),
        ("correlation 0", {"correlation": 0.0}),
        ("correlation 0.25", {"correlation": 0.25}),
        ("correlation 0.5", {"correlation": 0.5}),
        ("each 500 km", {"spacing_km": 500.0}),
        ("each 500 km, correlation 0.5", {"spacing_km": 500.0, "correlation": 0.5}),
        ("each 10,000 km", {"spacing_km": 1e4}),
        ("each 10,000 km, correlation 0.5", {"spacing_km": 1e4, "correlation": 0.5}),
        ("uneven spacing, correlation 0.5", {"uneven": True, "correlation": 0.5}),
        ("Student's t of 5", {"degrees": 5}),
        ("Student's t of 5, correlation 0.5", {"degrees": 5, "correlation": 0.5}),
        ("season of 50 trips", {"season": 50}),
        ("season of 50 trips, correlation 0.5", {"season": 50, "correlation": 0.5}),
        ("season of 150 trips", {"season": 150}),
        ("season of 150 trips, correlation 0.5", {"season": 150, "correlation": 0.5}),
        ("season of 50 trips, curved effect", {"season": 50, "curved": True}),
        ("correlation 0.7, above the setting", {"correlation": 0.7}),
    ]
    find_changes(*warm_up())
    rows = [
        alarms_row(name, histories(n // 2 if i else n, seed + i, **options))
        for i, (name, options) in enumerate(cases)
    ]
    print(
        "False alarms of suspnet per 1e6 km of a suspension: all, with the exact 95 % interval of\n"
        "Poisson, and first ones per km until then; ms: CPU of a history; seeds "
        f"{seed} to {seed + len(cases) - 1}\n"
    )
    head = ["healthy", "n", "alarms", "per 1e6 km", "95 %", "first ones", "in budget", "ms"]
    show(rows, head, output / "alarms.csv")


def first_of_us(given: Histories) -> np.ndarray:
    """Return our first alarms, (n, 4)."""
    found = found_by_us(given)
    return np.array([[first_of(several[name]) for name in NAMES] for several in found])


def print_others(n: int, seed: int, output: Path) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Print false alarms beside those of the competitors, which are given back."""
    healthy, correlated = histories(n, seed), histories(n, seed + 1, 0.5)
    methods = competitors(healthy, correlated)
    spoilt = healthy.scatter.copy()
    spoilt[:, CHANGED_AT] += 10 * SCATTER
    with_outlier = Histories(spoilt, healthy.effects, healthy.covariates, healthy.km)
    both = (healthy, correlated, with_outlier)

    def row(name: str, firsts: list[np.ndarray]) -> list[str]:
        rates = [rate_of_first(one, healthy.km) for one in firsts[:2]]
        quiet = firsts[2][firsts[2] >= CHANGED_AT]
        raised = f"{(quiet == CHANGED_AT).mean():.0%}" if len(quiet) else "-"
        return [name, *(f"{rate:.2f}" for rate in rates), raised]

    rows = [row("suspnet", [first_of_us(one) for one in both])]
    rows += [row(name, [method(one.scatter) for one in both]) for name, method in methods.items()]
    print(
        "First false alarms per 1e6 km of a suspension, and share of parameters in which one\n"
        "outlier of 10 standard deviations raises an alarm at once; "
        f"n = {n}, seeds {seed} and {seed + 1}\n"
    )
    head = ["method", "correlation 0 to 0.5", "correlation 0.5", "one outlier"]
    show(rows, head, output / "alarms_methods.csv")
    return methods


def print_delays(
    n: int, seed: int, methods: dict[str, Callable[[np.ndarray], np.ndarray]], output: Path
) -> None:
    since = np.arange(N_TRIPS) - CHANGED_AT
    rows = []
    for i, (name, change) in enumerate(CHANGES.items()):
        changed = histories(n, seed + i, 0.3)
        changed.scatter[...] += change(since)[:, None]
        cells = [delays(first_of_us(changed))]
        cells += [delays(method(changed.scatter)) for method in methods.values()]
        rows += [[name, one, *(cell[j] for cell in cells)] for j, one in enumerate(NAMES)]
    print(
        f"Delay in trips: median / 90 % quantile / share within {WITHIN} trips, of histories "
        f"without an alarm before the change\nat trip {CHANGED_AT}; correlation 0.3, n = {n}, "
        f"seeds {seed} to {seed + len(CHANGES) - 1}; -: fewer than one in four had none\n"
    )
    show(rows, ["change", "of", "suspnet", *methods], output / "alarms_delays.csv")


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--histories", type=at_least(40), default=2000)
    parser.add_argument("--changed", type=at_least(10), default=200, help="of each change")
    parser.add_argument("--seed", type=at_least(0), default=0)
    parser.add_argument("--output", type=Path, default=RESULTS)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    seed = 1000 * given.seed
    print(
        f"python benchmarks/alarms.py --histories {given.histories} "
        f"--changed {given.changed} --seed {given.seed}\n"
        f"budget: 1 false alarm per {SETTINGS.km_per_false_alarm:,.0f} km of a suspension\n"
    )
    begin = time.process_time()
    print_false_alarms(given.histories, seed, given.output)
    methods = print_others(given.histories // 10, seed + 100, given.output)
    print_delays(given.changed, seed + 200, methods, given.output)
    print(f"\n{time.process_time() - begin:.0f} s of CPU")


def warm_up() -> tuple[Any, ...]:
    """Return arguments of ``find_changes`` that simulate the thresholds, which are not timed."""
    one = histories(1, 0)
    return one.km[0], dict(zip(NAMES, np.exp(one.scatter[0]).T, strict=True)), {}, SETTINGS


if __name__ == "__main__":
    main()
