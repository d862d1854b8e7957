"""Fit time, peak memory and test error of MSVR and what a user would pick instead, against n.

python tests/benchmarks/against_n.py

Three inputs, uniform with variance 1, two smooth outputs, noise 0.05 on the training targets; the
error is that against the truth on 5,000 points. C = 10, sigma = 1, epsilon = 1e-3. Writes
against_n.csv and against_n.png, shown in docs/speed.md.
"""

import csv
import importlib.util
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cells import PATIENCE, WARM_UP, Parser, Row, at_least, machine, measured, run_cell, serve
from picture import draw
from tabulate import tabulate

C, SIGMA, EPSILON, NOISE = 10.0, 1.0, 1e-3, 0.05
GAMMA, ALPHA = 1 / SIGMA**2, 1 / (2 * C)
SIZES = [2000, 8000, 22_801, 91_204, 364_816]
LARGE = 22_801
"""Exponents are fitted from here on."""
RESULTS = Path(__file__).parent / "results"
COLUMNS = ["method", "n", "seconds", "peak_mib", "fit_mib", "rmse", "warning", "failed"]


def samples(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (n, 3) and the two outputs (n, 2) without noise."""
    X = np.random.default_rng(seed).uniform(-math.sqrt(3), math.sqrt(3), (n, 3))
    truth = np.column_stack(
        [np.sin(X[:, 0]) + 0.3 * X[:, 1] * X[:, 2], np.cos(X[:, 1]) * np.tanh(X[:, 2])]
    )
    return X, truth


def training_set(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (n, 3) and noisy outputs (n, 2)."""
    X, truth = samples(n, 0)
    return X, truth + NOISE * np.random.default_rng(2).standard_normal(truth.shape)


# Libraries are imported where they are used: a process holds only what its method needs.
def msvr(feature_map: str = "rff", **options: Any) -> Any:
    from suspnet.learning import MSVR

    return MSVR(C, SIGMA, EPSILON, feature_map, 1024, **options)


# epsilon = 0.05 and C = 1. Test RMSE and seconds, n = 8,000: epsilon 1e-3 and C 10 (MSVR's):
# 0.0135, 14 s; epsilon 0.05 and C 0.3, 1, 3, 10, 100: 0.0120, 0.0108, 0.0112, 0.0122, 0.0149 in
# 0.7, 1.2, 1.1, 2.4, 41 s; epsilon 0.1 and C 3: 0.0172. At n = 2,000 the order is the same:
# 0.0255 (epsilon 1e-3); 0.0241, 0.0197, 0.0204, 0.0233, 0.0309; 0.0297.
SVR_SETTINGS = {"C": 1.0, "gamma": GAMMA, "epsilon": NOISE, "cache_size": 500}


def sklearn_svr() -> Any:
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.svm import SVR

    return MultiOutputRegressor(SVR(**SVR_SETTINGS), n_jobs=2)


def intel_svr() -> Any:
    from sklearn.multioutput import MultiOutputRegressor
    from sklearnex.svm import SVR

    return MultiOutputRegressor(SVR(**SVR_SETTINGS), n_jobs=2)


def sampler_ridge() -> Any:
    from sklearn.kernel_approximation import RBFSampler
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline

    # alpha 1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.1, 1 at n = 8,000: RMSE 0.0115, 0.0098, 0.0090, 0.0085,
    # 0.0088, 0.0095, 0.0176
    return make_pipeline(
        RBFSampler(gamma=GAMMA, n_components=1024, random_state=0), Ridge(0.01, copy_X=False)
    )


def nystroem_ridge() -> Any:
    from sklearn.kernel_approximation import Nystroem
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline

    # alpha 1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.1, 1 at n = 8,000: RMSE 0.0133, 0.0131, 0.0122, 0.0107,
    # 0.0101, 0.0102, 0.0157
    return make_pipeline(
        Nystroem(gamma=GAMMA, n_components=500, random_state=0), Ridge(ALPHA, copy_X=False)
    )


def kernel_ridge() -> Any:
    from sklearn.kernel_ridge import KernelRidge

    # alpha 0.01, 0.05, 0.1, 0.3 at n = 2,000: RMSE 0.0202, 0.0179, 0.0181, 0.0214
    return KernelRidge(alpha=ALPHA, kernel="rbf", gamma=GAMMA)


def boosting() -> Any:
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.multioutput import MultiOutputRegressor

    # n = 8,000: RMSE 0.0262; without the l2 0.0280; learning rate 0.05 or 0.2: 0.0276, 0.0323;
    # 15 or 63 leaves: 0.0267, 0.0293
    return MultiOutputRegressor(
        HistGradientBoostingRegressor(
            max_iter=500, early_stopping=True, l2_regularization=5.0, random_state=0
        )
    )


def mlp() -> Any:
    from sklearn.compose import TransformedTargetRegressor
    from sklearn.neural_network import MLPRegressor
    from sklearn.preprocessing import StandardScaler

    # n = 8,000 and 22,801: RMSE 0.0056 and 0.0039 in 2.5 and 9.9 s on one thread, 11.7 and 31 s on
    # two. 300 iterations: 0.0095 and 0.0084; (64, 64), 300 iterations: 0.0091 and 0.0081. Adam with
    # early stopping, (128, 128), relu: batches of 1,000 0.0121 and 0.0090, of 200 0.0139 and 0.0110
    network = MLPRegressor(
        hidden_layer_sizes=(32, 32),
        activation="tanh",
        solver="lbfgs",
        alpha=0.01,
        max_iter=1000,
        random_state=0,
    )
    return TransformedTargetRegressor(network, transformer=StandardScaler())


class GramProduct:
    """phi^T phi of float32 features, added up over blocks: what no random-feature fit can skip.

    Parameters
    ----------
    with_features : bool
        Make each block from the samples; else it is the same block of random numbers again.
    """

    def __init__(self, with_features: bool) -> None:
        self.with_features = with_features

    def fit(self, X: np.ndarray, Y: np.ndarray) -> None:
        import torch

        samples = torch.tensor(X, dtype=torch.float32)
        frequencies = torch.randn(X.shape[1], 512) * math.sqrt(2) / SIGMA
        phi, gram = torch.randn(8192, 1024), torch.zeros(1024, 1024)
        for block in samples.split(len(phi)):
            rows = phi[: len(block)]
            if self.with_features:
                angles = block @ frequencies
                torch.cos(angles, out=rows[:, :512])
                torch.sin(angles, out=rows[:, 512:])
            gram.addmm_(rows.T, rows)


@dataclass(frozen=True)
class Method:
    """A line of the plot.

    Attributes
    ----------
    title : str
    make : callable
        Returns the estimator.
    colour, marker : str
    needs : str
        Module without which it is skipped.
    threads : int, optional
        Where fewer than all are faster.
    largest : int, optional
        Largest n it is tried at; beyond, its matrix of n x n takes too much memory.
    kind : {"suspnet", "peer", "bound"}
    """

    title: str
    make: Callable[[], Any]
    colour: str
    marker: str = "o"
    needs: str = "sklearn"
    threads: int | None = None
    largest: int | None = None
    kind: str = "suspnet"


def peer(title: str, make: Callable[[], Any], colour: str, marker: str, **options: Any) -> Method:
    return Method(title, make, colour, marker, kind="peer", **options)


METHODS = {
    "equispaced": Method("MSVR equispaced", lambda: msvr("equispaced"), "#d55e00", needs="finufft"),
    "equispaced_1e-4": Method(
        "MSVR equispaced, 1e-4",
        lambda: msvr("equispaced", kernel_tol=1e-4),
        "#e69f00",
        needs="finufft",
    ),
    "rff_float32": Method("MSVR rff, float32", lambda: msvr(dtype="float32"), "#0072b2"),
    "rff": Method("MSVR rff, float64", lambda: msvr(), "#56b4e9"),
    "orf": Method("MSVR orf, float64", lambda: msvr("orf"), "#009e73"),
    "nystroem": Method("MSVR nystroem", lambda: msvr("nystroem"), "#cc79a7"),
    "exact": Method("MSVR exact", lambda: msvr("exact"), "black", largest=8000),
    "svr": peer("SVR", sklearn_svr, "0.35", "s"),
    "svr_intel": peer("SVR, intelex", intel_svr, "0.55", "D", needs="sklearnex"),
    "sampler_ridge": peer("RBFSampler 1024 + Ridge", sampler_ridge, "0.45", "^"),
    "nystroem_ridge": peer("Nystroem 500 + Ridge", nystroem_ridge, "0.45", "v"),
    "kernel_ridge": peer("KernelRidge", kernel_ridge, "0.45", "P", largest=22_801),
    "boosting": peer("gradient boosting", boosting, "0.6", "X"),
    "mlp": peer("MLP 32, 32", mlp, "0.45", "*", threads=1),
    "gram": Method(
        "Gram product alone", lambda: GramProduct(False), "0.25", "", "torch", kind="bound"
    ),
    "features_gram": Method(
        "features and Gram product", lambda: GramProduct(True), "0.25", "", "torch", kind="bound"
    ),
}


def measure(cell: Row) -> Row:
    """Return the measurements of one method at one n."""
    from joblib import parallel_config
    from sklearn.metrics import root_mean_squared_error

    X, Y = training_set(cell["n"])
    model = METHODS[cell["method"]].make()
    with parallel_config(backend="threading"):
        found = measured(model, X, Y, cell["repeats"])
    if METHODS[cell["method"]].kind != "bound":
        X_test, truth = samples(5000, 1)
        found["rmse"] = float(root_mean_squared_error(truth, model.predict(X_test)))
    return found


def run_all(
    names: Sequence[str], sizes: Sequence[int], limit_s: float, repeats: int, output: Path
) -> list[Row]:
    """Measure every cell, by growing n; the CSV is complete up to the last cell at any time."""
    rows: list[Row] = []
    ended = set()
    for name in names:
        if importlib.util.find_spec(METHODS[name].needs) is None:
            print(f"{METHODS[name].title}: skipped, {METHODS[name].needs} is not installed")
            ended.add(name)
    for n in sorted(sizes):
        for name in names:
            if name in ended or n > (METHODS[name].largest or n):
                continue
            cell = {"method": name, "n": n, "repeats": repeats}
            found = run_cell(__file__, cell, PATIENCE * limit_s, METHODS[name].threads)
            row = {"method": name, "n": n, **found}
            if "failed" in row or row["seconds"] > limit_s:
                ended.add(name)
            rows.append(row)
            write(rows, output)
            print(f"n={n} {name}: {row.get('failed') or describe(row)}", file=sys.stderr)
    return rows


def describe(row: Row) -> str:
    """Return the seconds, memory and error of a cell."""
    rmse = f"{row['rmse']:.5f}" if row.get("rmse") else ""
    return f"{row['seconds']:.3g} s  {row['peak_mib']:.0f} ({row['fit_mib']:.0f}) MiB  {rmse}"


def write(rows: Sequence[Row], output: Path) -> None:
    """Write the cells so far to against_n.csv."""
    with (output / "against_n.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def read(output: Path) -> list[Row]:
    """Return the cells of against_n.csv."""
    numbers = {"n": int} | dict.fromkeys(["seconds", "peak_mib", "fit_mib", "rmse"], float)
    with (output / "against_n.csv").open(newline="") as file:
        return [
            {key: numbers.get(key, str)(text) for key, text in row.items() if text}
            for row in csv.DictReader(file)
        ]


def table(rows: Sequence[Row]) -> str:
    """Return one line for each method, and three columns for each n."""
    sizes = sorted({row["n"] for row in rows})
    found = {(row["method"], row["n"]): row for row in rows}
    names = [name for name in METHODS if any(row["method"] == name for row in rows)]
    lines = []
    for name in names:
        line = [METHODS[name].title]
        for n in sizes:
            row = found.get((name, n), {})
            line += [short(row, "seconds"), short(row, "peak_mib"), short(row, "rmse")]
        lines.append(line)
    headers = ["method"]
    for n in sizes:
        headers += [f"s, n={n}", "MiB", "RMSE"]
    return tabulate(lines, headers, tablefmt="pipe", disable_numparse=True)


def short(row: Row, key: str) -> str:
    """Return an entry of the table; the memory with the fit's own part."""
    if "failed" in row:
        return "failed"
    if key not in row:
        return "-"
    if key == "peak_mib":
        return f"{row[key]:.0f} ({row['fit_mib']:.0f})"
    return f"{row[key]:.5f}" if key == "rmse" else f"{row[key]:#.3g}".rstrip(".")


def summary(rows: Sequence[Row]) -> list[str]:
    """Return how time grows with n, and how far the peers are at the largest n."""
    ok = [row for row in rows if "failed" not in row]
    lines = []
    for row in rows:
        method = METHODS[row["method"]]
        told = row.get("failed") or (method.kind == "suspnet" and row.get("warning"))
        if told:
            lines.append(f"{method.title}, n = {row['n']:,}: {told}")
    for name, method in METHODS.items():
        points = [r for r in ok if r["method"] == name and r["n"] >= LARGE]
        if method.kind == "suspnet" and len(points) > 1:
            x, y = (np.log([r[key] for r in points]) for key in ("n", "seconds"))
            slope = np.polyfit(x, y, 1)[0]
            lines.append(f"{method.title}: time grows as n^{slope:.2f} from n = {LARGE:,}")
    n = max((row["n"] for row in ok), default=0)
    largest = {row["method"]: row for row in ok if row["n"] == n}
    if "equispaced" in largest:
        lines.append(f"n = {n:,}: " + against_peers(largest))
    for bound in ("gram", "features_gram"):
        if bound in largest and "rff_float32" in largest:
            ratio = largest["rff_float32"]["seconds"] / largest[bound]["seconds"]
            lines.append(f"n = {n:,}: MSVR rff, float32 / {METHODS[bound].title} = {ratio:.2f}")
    return lines


def against_peers(largest: dict[str, Row]) -> str:
    """Compare equispaced with the fastest peer that is as accurate, or the most accurate one."""
    ours = largest["equispaced"]
    peers = [row for name, row in largest.items() if METHODS[name].kind == "peer"]
    if not peers:
        return "no peer was measured"
    equal = [row for row in peers if row["rmse"] <= ours["rmse"]]
    if equal:
        other, words = min(equal, key=lambda row: row["seconds"]), "fastest peer of no larger RMSE"
    else:
        other, words = min(peers, key=lambda row: row["rmse"]), "no peer is as accurate; the best"
    return (
        f"{words}: {METHODS[other['method']].title}, RMSE {other['rmse']:.5f} (MSVR equispaced "
        f"{ours['rmse']:.5f}), takes {other['seconds'] / ours['seconds']:.1f} times as long"
    )


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--n", nargs="+", type=at_least(WARM_UP), default=SIZES, help="numbers of samples"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument(
        "--limit-s",
        type=at_least(1, float),
        default=90.0,
        help="no larger n for a method above this",
    )
    parser.add_argument("--repeats", type=at_least(1), default=3, help="fits, of which the median")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of CSV and figure")
    parser.add_argument("--redraw", action="store_true", help="from the CSV, without measuring")
    options = parser.parse_args()
    try:
        if options.redraw:
            rows = read(options.output)
        else:
            options.output.mkdir(parents=True, exist_ok=True)
            print(machine())
            rows = run_all(
                options.methods, options.n, options.limit_s, options.repeats, options.output
            )
    except OSError as error:
        parser.error(f"{error}")
    print(table(rows))
    print("MiB: of the whole process (of it, the fit). -: not tried.", *summary(rows), sep="\n- ")
    draw(rows, METHODS, options.output / "against_n.png")


if __name__ == "__main__":
    serve(measure) or main()
