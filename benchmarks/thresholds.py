"""Thresholds of the CUSUM of changes: the table THRESHOLDS of suspnet/trains/maintenance/cusum.py.

python benchmarks/thresholds.py [--histories 8000] [--seed 0]

Healthy histories, each with a reference of its own, are drawn from a normal autoregressive process
with the largest correlation that the promise holds for: a parametric bootstrap for any suspension,
as standardised residuals depend on neither level nor spread.
"""

import numpy as np
from cells import Parser, at_least
from numpy.typing import NDArray

from suspnet.ground.types import FloatArray
from suspnet.trains.maintenance.cusum import CLIP, N_REFERENCE, cusum, residuals

CORRELATION = 0.5
"""Largest correlation of successive trips for which the thresholds hold: the least favourable one,
because the trips of a reference do not determine their own well enough."""
N_MONITORED = 200
"""Number of simulated trips after the reference."""
HORIZONS = (10, 20, 50, 100, 200)
"""The false-alarm rate holds over each of these numbers of trips after the reference."""
RATES = np.geomspace(0.01, 1.25e-5, 13)


def autoregressive(noise: FloatArray, correlation: float | FloatArray) -> FloatArray:
    """Return a stationary series of unit variance from white noise e of unit variance.

    y_t = phi y_(t-1) + sqrt(1 - phi^2) e_t along the first axis, and y_0 = e_0.
    """
    values = np.array(noise, dtype=float)
    spread = np.sqrt(1 - np.square(correlation))
    for t in range(1, len(values)):
        values[t] = correlation * values[t - 1] + spread * noise[t]
    return values


def false_alarm_rate(peaks: NDArray[np.float32], threshold: float) -> float:
    """Return the largest rate of first alarms over the horizons; `peaks` of ``healthy_peaks``."""
    quiet = (peaks <= threshold).sum(axis=0)  # trips before the first alarm
    return max(
        float((quiet < trips).mean() / np.minimum(quiet + 1, trips).mean()) for trips in HORIZONS
    )


def healthy_peaks(n_histories: int, seed: int = 0) -> NDArray[np.float32]:
    """Return the largest CUSUM up to each trip, (``N_MONITORED``, `n_histories`)."""
    random = np.random.default_rng(seed)
    peaks = np.empty((N_MONITORED, n_histories), np.float32)
    chunk = 500  # histories at once, which bounds the memory
    for begin in range(0, n_histories, chunk):
        size = min(chunk, n_histories - begin)
        noise = random.standard_normal((N_REFERENCE + N_MONITORED, size))
        values = autoregressive(noise, CORRELATION)
        standard = residuals(values, np.empty((*values.shape, 0))).standard
        largest = cusum(standard).max(axis=0)
        peaks[:, begin : begin + size] = np.maximum.accumulate(largest, axis=0)
    return peaks


def least(peaks: NDArray[np.float32], rate: float) -> float:
    """Return the least threshold, at least ``CLIP``, whose rate is at most `rate`."""
    low, high = CLIP, float(peaks[-1].max())
    for _ in range(24):  # the rate falls with the threshold: bisection to 1e-7 of the range
        middle = (low + high) / 2
        low, high = (middle, high) if false_alarm_rate(peaks, middle) > rate else (low, middle)
    return high


def main() -> None:
    """Print the table."""
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--histories", type=at_least(1000), default=8000)
    parser.add_argument("--seed", type=at_least(0), default=0)
    given = parser.parse_args()
    peaks = healthy_peaks(given.histories, given.seed)
    for rate in RATES:
        print(f"    ({rate:.4g}, {least(peaks, rate):.3f}),", flush=True)


if __name__ == "__main__":
    main()
