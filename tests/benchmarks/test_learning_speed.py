"""Fitting time of MSVR beside what a user would pick instead; the test error is in extra_info.

pytest tests/benchmarks --benchmark-only
"""

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.kernel_approximation import Nystroem, RBFSampler
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge
from sklearn.metrics import root_mean_squared_error
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import make_pipeline

from suspnet.learning import MSVR, MVGPR, SVR

C, SIGMA, EPSILON, N = 10.0, 1.0, 1e-3, 4000
GAMMA, ALPHA = 1 / SIGMA**2, 1 / (2 * C)
METHODS = {
    "msvr rff 1024": MSVR(C, SIGMA, EPSILON),
    "msvr nystroem 512": MSVR(C, SIGMA, EPSILON, "nystroem", 512),
    "msvr exact": MSVR(C, SIGMA, EPSILON, "exact"),
    "SVR": SVR(C, SIGMA, EPSILON),
    "MVGPR": MVGPR(n_restarts=0),
    "RBFSampler + Ridge": make_pipeline(
        RBFSampler(gamma=GAMMA, n_components=1024, random_state=0), Ridge(ALPHA)
    ),
    "Nystroem + Ridge": make_pipeline(
        Nystroem(gamma=GAMMA, n_components=512, random_state=0), Ridge(ALPHA)
    ),
    "KernelRidge": KernelRidge(alpha=ALPHA, kernel="rbf", gamma=GAMMA),
    "gradient boosting": MultiOutputRegressor(HistGradientBoostingRegressor(max_iter=300)),
}


def samples(n, seed):
    random = np.random.default_rng(seed)
    X = random.standard_normal((n, 3))
    truth = np.column_stack(
        [np.sin(X[:, 0]) + 0.3 * X[:, 1] * X[:, 2], np.cos(X[:, 1]) * np.tanh(X[:, 2])]
    )
    return X, truth


@pytest.mark.benchmark(group=f"fit, 3 inputs, 2 outputs, n = {N}")
@pytest.mark.parametrize("name", METHODS)
def test_fit(benchmark, name):
    X, truth = samples(N, 0)
    Y = truth + 0.05 * np.random.default_rng(2).standard_normal(truth.shape)
    model = benchmark.pedantic(METHODS[name].fit, args=(X, Y), rounds=3, warmup_rounds=1)
    X_test, truth_test = samples(5000, 1)
    rmse = root_mean_squared_error(truth_test, model.predict(X_test))
    benchmark.extra_info["test RMSE"] = round(rmse, 5)
    assert rmse < 0.1
