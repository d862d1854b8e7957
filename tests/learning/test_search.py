"""The grid search against scikit-learn's."""

import numpy as np
import pytest
from learning_reference import smooth_data
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.metrics import make_scorer, root_mean_squared_error
from sklearn.model_selection import GridSearchCV, KFold, ParameterGrid, cross_val_score

from suspnet.learning import MSVR, LinearRegression, Scaling
from suspnet.learning.search import GridSearch

GRID = {"C": [0.1, 10.0], "sigma": [0.2, 1.0, 5.0]}
IDENTITY = Scaling(np.zeros(2), np.ones(2), log=False)


class Fussy(RegressorMixin, BaseEstimator):
    """Predicts its level; cannot be fitted at a negative one."""

    def __init__(self, level=0.0):
        self.level = level

    def fit(self, X, y):
        if self.level < 0:
            raise ValueError(f"level {self.level} is too low")
        self.shape_ = y.shape[1:]
        return self

    def predict(self, X):
        return np.full((len(X), *self.shape_), self.level)


class Flat(Fussy):
    """Predicts a vector whatever it has learnt."""

    def predict(self, X):
        return np.full(len(X), self.level)


def problem(log):
    X, Y = smooth_data(0, n_samples=80)
    positive = np.exp(0.3 * Y)
    scaling = Scaling.of(positive, log)
    return X, scaling.apply(positive), scaling


@pytest.mark.parametrize("log", [True, False])
def test_search_is_that_of_scikit_learn_with_the_same_folds_and_metric(log):
    X, Y, scaling = problem(log)
    estimator = MSVR(n_components=32)
    found = GridSearch({"msvr": GRID}, n_folds=4, seed=3).run("msvr", estimator, X, Y, scaling)

    def metric(actual, predicted):
        return root_mean_squared_error(scaling.undo(actual), scaling.undo(predicted))

    other = GridSearchCV(
        estimator,
        GRID,
        scoring=make_scorer(metric, greater_is_better=False),
        cv=KFold(4, shuffle=True, random_state=3),
        refit=False,
    ).fit(X, Y)
    assert found.settings == other.cv_results_["params"]
    np.testing.assert_allclose(found.rmse, -other.cv_results_["mean_test_score"], rtol=1e-12)
    assert found.best == other.best_params_
    assert not found.failures
    # The grid has something to choose from.
    assert max(found.rmse) > 2 * min(found.rmse) > 0


def test_predictions_of_another_shape_are_not_scored():
    X, Y, scaling = problem(log=False)
    with pytest.raises(ValueError, match=r"predict of Flat .* shape \(20, 2\), got shape \(20,\)"):
        GridSearch({"fussy": {"level": [0.5]}}, n_folds=4).run("fussy", Flat(), X, Y, scaling)


def test_listener_hears_of_each_setting_and_the_estimator_stays():
    X, Y, _ = problem(log=False)
    heard, estimator = [], Fussy(level=7.0)
    search = GridSearch({"fussy": {"level": [0.0, 1.0]}}, n_folds=2)
    found = search.run(
        "fussy", estimator, X, Y, IDENTITY, on_setting=lambda *told: heard.append(told)
    )
    assert heard == list(zip(found.settings, found.rmse, strict=True))
    assert estimator.get_params() == {"level": 7.0}
    assert not hasattr(estimator, "shape_")
    assert search.settings_of("fussy") == [{"level": 0.0}, {"level": 1.0}]


def test_settings_that_fail_count_as_infinitely_bad():
    X, Y, _ = problem(log=False)
    found = GridSearch({"fussy": {"level": [-1.0, 0.0, 2.0]}}).run("fussy", Fussy(), X, Y, IDENTITY)
    assert found.rmse[0] == np.inf
    assert np.isfinite(found.rmse[1:]).all()
    assert found.best == {"level": 0.0}
    assert len(found.failures) == 1
    assert "level -1.0 is too low" in found.failures[0]


def test_no_setting_that_can_be_fitted_is_an_error():
    X, Y, _ = problem(log=False)
    search = GridSearch({"fussy": {"level": [-1.0, -2.0]}})
    with pytest.raises(ValueError, match=r"no setting .* could be fitted; first: .*level"):
        search.run("fussy", Fussy(), X, Y, IDENTITY)


def test_unknown_method_is_an_error():
    X, Y, _ = problem(log=False)
    search = GridSearch({"msvr": GRID})
    with pytest.raises(ValueError, match=r"no grid for 'forest', only for \['msvr'\]"):
        search.run("forest", Fussy(), X, Y, IDENTITY)
    with pytest.raises(ValueError, match="no grid for 'forest'"):
        search.settings_of("forest")


SHARING = {"C": [1.0, 100.0], "epsilon": [0.0], "sigma": [0.5, 2.0]}
IDENTITY_METRIC = make_scorer(root_mean_squared_error, greater_is_better=False)


@pytest.mark.parametrize(
    ("estimator", "grid"),
    [
        (MSVR(n_components=32, tol=1e-12), SHARING),
        pytest.param(
            MSVR(n_components=32, feature_map="orf", tol=1e-12), SHARING, marks=pytest.mark.slow
        ),
        (MSVR(n_components=20, feature_map="nystroem"), {"C": [1.0, 10.0], "epsilon": [1e-3]}),
        (MSVR(n_components=32), {"n_components": [8, 33], "C": [1.0, 10.0]}),
        (MSVR(n_components=32), {"feature_map": ["nystroem", "rff"], "C": [1.0]}),
        (LinearRegression(), {}),
    ],
    ids=["rff", "orf", "nystroem", "components", "maps", "linear"],
)
def test_search_is_cross_validation_of_clones(estimator, grid):
    X, Y = smooth_data(1, n_samples=60)
    folds, heard = KFold(4, shuffle=True, random_state=5), []
    found = GridSearch({"m": grid}, n_folds=4, seed=5).run(
        "m", estimator, X, Y, IDENTITY, on_setting=lambda *told: heard.append(told)
    )
    assert found.settings == list(ParameterGrid(grid))
    assert not found.failures
    assert heard == list(zip(found.settings, found.rmse, strict=True))
    for setting, rmse in zip(found.settings, found.rmse, strict=True):
        candidate = clone(estimator).set_params(**setting)
        scores = cross_val_score(candidate, X, Y, cv=folds, scoring=IDENTITY_METRIC)
        assert rmse == pytest.approx(-scores.mean(), rel=1e-8)
    assert len(found.rmse) == 1 or max(found.rmse) > min(found.rmse)


def test_setting_that_is_singular_leaves_the_others():
    X, Y = smooth_data(1, n_samples=60)
    huge = 1e20  # 200 features of 60 samples: singular but for 1 / C
    for values in ([1.0, huge, 10.0], [huge, 1.0, 10.0]):
        grid, heard = {"C": values, "epsilon": [1e-3]}, []
        found = GridSearch({"m": grid}).run(
            "m",
            MSVR(n_components=200),
            X,
            Y,
            IDENTITY,
            on_setting=lambda *told, heard=heard: heard.append(told),
        )
        alone = GridSearch({"m": grid | {"C": [1.0, 10.0]}}).run(
            "m", MSVR(n_components=200), X, Y, IDENTITY
        )
        assert [np.isinf(rmse) for rmse in found.rmse] == [C == huge for C in values]
        assert [rmse for rmse in found.rmse if np.isfinite(rmse)] == alone.rmse
        assert len(heard) == 3
        assert len(found.failures) == 1
        assert "singular to working precision" in found.failures[0]


# edges


class Slope(Fussy):
    """Errs by 1 less the slope times log10 of its level, with scatter if asked for."""

    def __init__(self, level=1.0, slope=1.0, scatter=0.0):
        super().__init__(level)
        self.slope = slope
        self.scatter = scatter

    def predict(self, X):
        noise = np.random.default_rng(int(self.level)).standard_normal(1000)
        rows = np.array([noise[int(row)] for row in X[:, 0]])
        error = 5 - self.slope * np.log10(self.level) + self.scatter * rows
        return np.tile(error[:, None], self.shape_)


@pytest.mark.parametrize(
    ("slope", "scatter", "is_flat"),
    [(0.0, 0.0, True), (0.01, 0.0, True), (0.1, 0.0, False), (0.02, 0.5, True)],
    ids=["no slope", "slope below 0.5 %", "slope", "slope within the scatter of folds"],
)
def test_flat_edge_is_no_edge(slope, scatter, is_flat):
    X, Y = np.arange(40.0)[:, None], np.zeros((40, 2))
    search = GridSearch({"slope": {"level": [10.0, 1000.0, 100.0], "slope": [slope]}})
    found = search.run("slope", Slope(scatter=scatter), X, Y, IDENTITY)
    assert found.edges == (
        {} if is_flat else {"level": "the best level, 1000, is on the edge of the values tried"}
    )
