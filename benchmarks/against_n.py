"""Fit time, peak memory and test error of MSVR and what a user would pick instead, against n.

python benchmarks/against_n.py

Three inputs, uniform with variance 1, two smooth outputs, scaled, with noise 0.1 on the training
targets; the error is that against the truth on 5,000 points. All have the same kernel and C; the
tube is as narrow as in Table V of the paper, or 0.3. Writes against_n.csv and against_n.png, shown
in docs/speed.md.
"""

import csv
import importlib.util
import json
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cells import WARM_UP, Parser, Row, at_least, machine, measured
from picture import draw

C, SIGMA, EPSILON, TUBE, NOISE = 10.0, 1.0, 1e-3, 0.3, 0.1
GAMMA, ALPHA = 1 / SIGMA**2, 1 / (2 * C)
SIZES = [1000, 2000, 5000, 22_801, 91_204, 364_816]
QUICK = 5000
"""Largest n of a quick run."""
DENSE: dict[str, Any] = {"largest": 22_801, "order": 3}
"""Of methods that hold the kernel matrix of all samples, at most 4.2 GB each time."""
RESULTS = Path(__file__).parent / "results"
NUMBERS = {"n": int, "threads": int} | dict.fromkeys(
    ["epsilon", "seconds", "peak_mib", "fit_mib", "gpu_mib", "rmse"], float
)
COLUMNS = ["method", *NUMBERS, "warning", "failed"]


def samples(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (n, 3) and the two outputs (n, 2) without noise."""
    X = np.random.default_rng(seed).uniform(-math.sqrt(3), math.sqrt(3), (n, 3))
    truth = np.column_stack(
        [np.sin(X[:, 0]) + 0.3 * X[:, 1] * X[:, 2], np.cos(X[:, 1]) * np.tanh(X[:, 2])]
    )
    return X, truth / [0.77, 0.38]  # their deviations


def training_set(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (n, 3) and noisy outputs (n, 2)."""
    X, truth = samples(n, 0)
    return X, truth + NOISE * np.random.default_rng(2).standard_normal(truth.shape)


# Libraries are imported where they are used: a process holds only what its method needs.
def msvr(feature_map: str, **options: Any) -> Callable[[float], Any]:
    def make(epsilon: float) -> Any:
        from suspnet.learning import MSVR

        return MSVR(C, SIGMA, epsilon, feature_map, 1024, **options)

    return make


def sklearn_svr(epsilon: float) -> Any:
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.svm import SVR

    return MultiOutputRegressor(SVR(C=C, gamma=GAMMA, epsilon=epsilon, cache_size=500))


def sampler_ridge(epsilon: float) -> Any:
    from sklearn.kernel_approximation import RBFSampler
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline

    sampler = RBFSampler(gamma=GAMMA, n_components=1024, random_state=0)
    return make_pipeline(sampler, Ridge(ALPHA, copy_X=False))


def nystroem_ridge(epsilon: float) -> Any:
    from sklearn.kernel_approximation import Nystroem
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline

    landmarks = Nystroem(gamma=GAMMA, n_components=500, random_state=0)
    return make_pipeline(landmarks, Ridge(ALPHA, copy_X=False))


def kernel_ridge(epsilon: float) -> Any:
    from sklearn.kernel_ridge import KernelRidge

    return KernelRidge(alpha=ALPHA, kernel="rbf", gamma=GAMMA)


class PublicMSVR:
    """The algorithm of the public MSVR codes: IRWLS in the dual, without an intercept.

    Each iteration solves (K + 1 / a) beta = Y on the samples outside the tube, with the weights a
    of Eq. (10), and moves there by a step that is divided by ten until the functional falls.
    """

    def __init__(
        self, C: float, sigma: float, epsilon: float, tol: float = 1e-8, max_iter: int = 1000
    ) -> None:
        self.C, self.sigma, self.epsilon = C, sigma, epsilon
        self.tol, self.max_iter = tol, max_iter

    def kernel(self, X: np.ndarray) -> np.ndarray:
        from sklearn.metrics.pairwise import rbf_kernel

        return rbf_kernel(X, self.X, gamma=1 / self.sigma**2)

    def fit(self, X: np.ndarray, Y: np.ndarray) -> "PublicMSVR":
        self.X, self.beta = X, np.zeros_like(Y)
        K = self.kernel(X)
        size, value = self._at(K, Y, self.beta)
        for _ in range(self.max_iter):
            outside = size > self.epsilon
            if not outside.any():
                break
            weights = 2 * self.C * (1 - self.epsilon / size[outside])
            system = K[np.ix_(outside, outside)] + np.diag(1 / weights)
            target, step, before = np.zeros_like(Y), 1.0, value
            target[outside] = np.linalg.solve(system, Y[outside])
            while True:
                beta = self.beta + step * (target - self.beta)
                size, value = self._at(K, Y, beta)
                if value <= before or step < 1e-16:
                    break
                step /= 10
            if step < 1e-16:
                break
            self.beta = beta
            if before - value <= self.tol * before:
                break
        return self

    def _at(self, K: np.ndarray, Y: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the norm of each residual, and the functional of Eq. (7)."""
        predicted = K @ beta
        size = np.linalg.norm(Y - predicted, axis=1)
        losses = np.square(np.maximum(size - self.epsilon, 0)).sum()
        return size, 0.5 * (beta * predicted).sum() + self.C * losses

    def predict(self, X: np.ndarray) -> np.ndarray:
        return self.kernel(X) @ self.beta


@dataclass(frozen=True)
class Method:
    """A line of the plot.

    Attributes
    ----------
    title : str
    make : callable
        Returns the estimator for an epsilon.
    colour, marker : str
    needs : str
        Module without which it is skipped.
    largest : int
        Largest n it is tried at.
    order : int
        Power of n with which its time grows at most.
    has_tube : bool
        Whether epsilon changes it.
    is_for_wide : bool
        Whether it is tried with a wide tube.
    device : {"cpu", "cuda"}
    kind : {"suspnet", "peer"}
    """

    title: str
    make: Callable[[float], Any]
    colour: str
    marker: str = "o"
    needs: str = "sklearn"
    largest: int = SIZES[-1]
    order: int = 1
    has_tube: bool = True
    is_for_wide: bool = True
    device: str = "cpu"
    kind: str = "suspnet"


def peer(
    title: str, make: Callable[[float], Any], marker: str, has_tube: bool = False, **options: Any
) -> Method:
    return Method(title, make, "0.45", marker, has_tube=has_tube, kind="peer", **options)


def on_gpu(**options: Any) -> Callable[[float], Any]:
    return msvr("rff", device="cuda", **options)


METHODS = {
    "exact": Method("MSVR, exact", msvr("exact"), "black", **DENSE),
    "equispaced": Method(
        "MSVR, equispaced", msvr("equispaced"), "#d55e00", needs="finufft", is_for_wide=False
    ),
    "rff": Method("MSVR, rff", msvr("rff"), "#56b4e9"),
    "rff_cuda": Method("MSVR, rff, cuda", on_gpu(), "#cc79a7", "s", device="cuda"),
    "svr": peer("SVR", sklearn_svr, "s", has_tube=True, order=2),
    "public_msvr": peer(
        "public MSVR",
        lambda epsilon: PublicMSVR(C, SIGMA, epsilon),
        "X",
        has_tube=True,
        **DENSE,
    ),
    "kernel_ridge": peer("KernelRidge", kernel_ridge, "P", **DENSE),
    "sampler_ridge": peer("RBFSampler 1024 + Ridge", sampler_ridge, "^"),
    "nystroem_ridge": peer("Nystroem 500 + Ridge", nystroem_ridge, "v"),
}


def serve(cell: Row) -> None:
    """Print the measurements of one method at each n, as long as a fit stays within the limit."""
    from sklearn.metrics import root_mean_squared_error

    method = METHODS[cell["method"]]
    X_test, truth = samples(5000, 1)
    before: Row = {}
    for n in cell["sizes"]:
        if before and before["seconds"] * (n / before["n"]) ** method.order > cell["limit_s"]:
            break
        X, Y = training_set(n)
        model = method.make(cell["epsilon"])
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            row = {"n": n, **measured_anew(model, X, Y, cell["repeats"], method.device)}
        notes = {str(w.message) for w in told if "Convergence" in w.category.__name__}
        row["rmse"] = float(root_mean_squared_error(truth, model.predict(X_test)))
        row["warning"] = "; ".join(sorted(notes))
        print(json.dumps(row), flush=True)
        before = row


def measured_anew(model: Any, X: Any, Y: Any, repeats: int, device: str) -> Row:
    """Return seconds and memory of a fit, the peak being that since this call."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    except OSError:
        pass  # then the peak is that of all n up to this one
    if device == "cpu":
        return measured(model, X, Y, repeats)
    import torch

    torch.cuda.reset_peak_memory_stats()
    row = measured(model, X, Y, repeats)
    return {**row, "gpu_mib": torch.cuda.max_memory_allocated() / 2**20}


def run_series(cell: Row, threads: int) -> list[Row]:
    """Return what `serve` printed in a process of its own, one row for each n."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(threads))}
    patience = 3 * cell["limit_s"] + 60
    command = [sys.executable, __file__, "cell", json.dumps(cell)]
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    failed = ""
    try:
        out, errors = process.communicate(timeout=patience)
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
        failed = f"ended after {patience:.0f} s"
    else:
        if process.returncode:
            last = errors.strip().splitlines()[-1:] or ["out of memory?"]
            failed = f"exit code {process.returncode}: {last[0]}"
    given = {"method": cell["method"], "epsilon": cell["epsilon"], "threads": threads}
    rows = [{**given, **json.loads(line)} for line in out.splitlines() if line.startswith("{")]
    if failed:
        left = [n for n in cell["sizes"] if n > max((row["n"] for row in rows), default=0)]
        rows.append({**given, "n": (left or cell["sizes"])[0], "failed": failed})
    return rows


def run_all(options: Any) -> list[Row]:
    """Measure every method; the CSV is complete up to the last one at any time."""
    rows: list[Row] = []
    for name in options.methods:
        method = METHODS[name]
        if importlib.util.find_spec(method.needs) is None:
            print(f"{method.title}: skipped, {method.needs} is not installed")
            continue
        if method.device != "cpu" and method.device != options.device:
            continue
        sizes = [n for n in sorted(options.n) if n <= min(method.largest, options.max_n)]
        for epsilon in options.epsilon if method.has_tube else options.epsilon[:1]:
            if epsilon > EPSILON and not method.is_for_wide:
                continue
            for threads in options.threads:
                cell = {"method": name, "epsilon": epsilon, "sizes": sizes}
                cell |= {"repeats": options.repeats, "limit_s": options.limit_s}
                rows += run_series(cell, threads)
                write(rows, options.out)
                print(f"{method.title}, epsilon {epsilon:g}, {threads} threads", file=sys.stderr)
    return rows


def write(rows: Sequence[Row], out: Path) -> None:
    """Write the rows so far to against_n.csv."""
    with (out / "against_n.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def read(out: Path) -> list[Row]:
    """Return the rows of against_n.csv."""
    with (out / "against_n.csv").open(newline="") as file:
        return [
            {key: NUMBERS.get(key, str)(text) for key, text in row.items() if text}
            for row in csv.DictReader(file)
        ]


def lines(rows: Sequence[Row]) -> list[str]:
    """Return a line of text for each row."""
    found = []
    for row in rows:
        told = row.get("failed") or (
            f"{row['seconds']:8.3f} s {row['peak_mib']:7.0f} MiB ({row['fit_mib']:.0f}) "
            + (f"{row['gpu_mib']:.0f} MiB of the GPU " if row.get("gpu_mib") else "")
            + f"rmse {row['rmse']:.5f} {row.get('warning', '')}"
        )
        start = f"{METHODS[row['method']].title:26} epsilon {row['epsilon']:<6g}"
        found.append(f"{start} threads {row['threads']:2} n {row['n']:7,} {told}")
    return found


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", nargs="+", type=at_least(WARM_UP), default=SIZES, help="samples")
    parser.add_argument("--max-n", type=at_least(WARM_UP), default=SIZES[-1], help="no n above")
    parser.add_argument("--quick", action="store_true", help=f"n up to {QUICK:,}, one fit each")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--epsilon", nargs="+", type=at_least(0, float), default=[EPSILON, TUBE])
    parser.add_argument(
        "--threads", nargs="+", type=at_least(1), default=[os.cpu_count() or 1], help="in turn"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="cuda: as well")
    parser.add_argument(
        "--limit-s", type=at_least(0.1, float), default=60.0, help="no larger n above this"
    )
    parser.add_argument("--repeats", type=at_least(1), default=3, help="fits, of which the median")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of CSV and figure")
    parser.add_argument("--redraw", action="store_true", help="from the CSV, without measuring")
    options = parser.parse_args()
    if options.quick:
        options.max_n, options.repeats = min(options.max_n, QUICK), 1
    try:
        if options.redraw:
            rows = read(options.out)
        else:
            options.out.mkdir(parents=True, exist_ok=True)
            print(machine(), f"in use: {options.threads}", sep="; ")
            rows = run_all(options)
    except OSError as error:
        parser.error(f"{error}")
    print(*lines(rows), sep="\n")
    print("MiB: of the whole process (of it, the fit)")
    draw(rows, METHODS, options.out / "against_n.png")


if __name__ == "__main__":
    if sys.argv[1:2] == ["cell"]:
        serve(json.loads(sys.argv[2]))
    else:
        main()
