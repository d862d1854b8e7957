"""Fitting time of MSVR beside what a user would pick instead; the test error is in extra_info.

pytest benchmarks --benchmark-only

The same data and methods against the number of samples, each in a process of its own:
``against_n.py``.
"""

import importlib.util

import pytest
from against_n import EPSILON, METHODS, SIGMA, C, samples, training_set
from sklearn.metrics import root_mean_squared_error

from suspnet.learning import MVGPR, SVR

N = 4000
FITTED = {name: method.make for name, method in METHODS.items() if method.device == "cpu"}
FITTED |= {
    "suspnet's SVR": lambda epsilon: SVR(C, SIGMA, epsilon),
    "MVGPR": lambda epsilon: MVGPR(n_restarts=0),
}


@pytest.mark.benchmark(group=f"fit, 3 inputs, 2 outputs, n = {N}")
@pytest.mark.parametrize("name", FITTED)
def test_fit(benchmark, name):
    needs = METHODS[name].needs if name in METHODS else "sklearn"
    if importlib.util.find_spec(needs) is None:
        pytest.skip(f"{needs} is not installed")
    X, Y = training_set(N)
    model = benchmark.pedantic(FITTED[name](EPSILON).fit, args=(X, Y), rounds=3, warmup_rounds=1)
    X_test, truth = samples(5000, 1)
    rmse = root_mean_squared_error(truth, model.predict(X_test))
    benchmark.extra_info["test RMSE"] = round(rmse, 5)
    assert rmse < 0.2
