"""Remaining life: exact crossings, honest intervals, and clear errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import kstest, norm

from benchmarks.prognostics import alpha_lambda, cumulative_relative_accuracy
from benchmarks.wear_histories import make_histories
from suspnet.trains.maintenance.degradation import MODELS
from suspnet.trains.maintenance.life import (
    FUTURE,
    HORIZON_KM,
    MIN_TRIPS,
    N_SAMPLES,
    Life,
    changing_passage_km,
    first_passage_km,
    predict_life,
)
from suspnet.trains.maintenance.noise import UNIT_KM

LIMITS = (0.7, 1.4)
KM = 2_000.0 * np.arange(150)
HALF = np.full(150, 0.005)


def noise(seed=0, n=150):
    return np.exp(0.003 * np.random.default_rng(seed).normal(size=n))


# reference: known answers


@pytest.mark.parametrize("limit", [0.7, 1.4])
@pytest.mark.parametrize("onset", [0.0, 91_000.0])
@pytest.mark.parametrize("model", ["linear", "exponential"])
def test_noise_free_drift_crosses_where_it_does(model, limit, onset):
    share = np.maximum(KM - onset, 0) / (500_000 - onset)
    course = 1 + (limit - 1) * share if model == "linear" else np.exp(np.log(limit) * share)
    life = predict_life(KM, course, HALF, LIMITS)
    assert life.model == model
    to_go = 500_000 - KM[-1]
    assert life.quantile_km(0.5) == pytest.approx(to_go, rel=0.01)
    low, high = life.interval_km()
    assert 0 < high - low < 0.1 * to_go


def test_measures_are_those_of_progpy():
    """Values of progpy 1.9.0: ToEPredictionProfile of UnweightedSamples, truth 1,000."""
    predictions = {
        500.0: [905.0, 962.0, 1041.0, 1090.0, 1180.0, 1300.0],
        750.0: [940.0, 955.0, 1010.0, 1052.0, 1080.0, 1120.0],
        875.0: [890.0, 970.0, 985.0, 1001.0, 1012.0, 1030.0],
    }
    centres = [np.mean(samples) for samples in predictions.values()]
    assert cumulative_relative_accuracy(centres, 1000.0) == pytest.approx(0.9585, rel=1e-9)
    for alpha, beta, known in (
        (0.2, 0.5, [True, False, True]),
        (0.2, 0.7, [False, False, False]),
        (0.1, 0.3, [True, False, True]),
        (0.1, 0.6, [False, False, False]),
    ):
        found = [alpha_lambda(s, t, 1000.0, alpha, beta) for t, s in predictions.items()]
        assert found == known


def inverse_gaussian_cdf(t, distance, rate, variance):
    """Return the probability that a limit is passed by `t`; the closed form (Chhikara, Folks)."""
    root = np.sqrt(variance * t)
    return norm.cdf((rate * t - distance) / root) + np.exp(
        2 * rate * distance / variance
    ) * norm.cdf(-(rate * t + distance) / root)


@pytest.mark.parametrize("rate", [-0.02, 0.001, 0.05, 0.5])
def test_first_passage_has_the_law_of_the_wiener_process(rate):
    n, distance, variance = 20_000, 0.2, 0.03**2
    rng = np.random.default_rng(4)
    km = first_passage_km(np.full(n, distance), np.full(n, rate), np.full(n, variance), rng)
    reached = np.exp(2 * rate * distance / variance) if rate < 0 else 1.0
    share = np.isfinite(km).mean()
    assert share == pytest.approx(reached, abs=4 * np.sqrt(reached * (1 - reached) / n) + 1e-12)
    if share > 0:
        sample = km[np.isfinite(km)] / UNIT_KM

        def cdf(t):
            return inverse_gaussian_cdf(t, distance, rate, variance) / reached

        assert kstest(sample, cdf).pvalue > 1e-3


def test_first_passage_without_diffusion_is_distance_over_rate():
    distance = np.array([0.2, 0.2, 0.0, -0.1, np.inf])
    rate = np.array([0.05, -0.05, 0.05, -0.05, 0.05])
    km = first_passage_km(distance, rate, np.zeros(5), np.random.default_rng(0))
    np.testing.assert_allclose(km, np.array([4, np.inf, 0, 0, np.inf]) * UNIT_KM)


def test_passage_of_a_changing_rate_is_that_of_small_steps():
    """Medians of 4,000 draws and of paths of 2,000 small steps; 4 standard errors are 7 %."""
    n, rate, spread, upper = 4_000, 0.04, 0.02, 0.3
    rng = np.random.default_rng(6)
    mean = np.broadcast_to(rate * FUTURE, (n, FUTURE.size))
    found = changing_passage_km(mean, -np.inf, upper, np.full(n, spread), rng)
    dt = 0.01
    rates = rate + spread * np.sqrt(dt) * np.cumsum(rng.normal(size=(1_000, 2_000)), axis=1)
    values = np.cumsum(rates, axis=1) * dt
    passed = values >= upper
    naive = np.where(passed.any(axis=1), passed.argmax(axis=1) * dt, np.inf) * UNIT_KM
    for q in (0.2, 0.5):
        known = np.quantile(naive, q, method="inverted_cdf")
        assert np.quantile(found, q, method="inverted_cdf") == pytest.approx(known, rel=0.07)


# property: intervals hold the truth


def test_intervals_hold_the_truth_on_simulated_wear():
    """40 histories, every other at half and at three quarters of its life."""
    held = []
    for i, history in enumerate(make_histories(40, seed=21)):
        share = (0.5, 0.75)[i % 2]
        mileage, values, half_widths = history.until(share * history.crossing_km)
        life = predict_life(mileage, values, half_widths, history.limits)
        low, high = life.interval_km()
        held.append(low <= history.crossing_km - mileage[-1] <= high)
    # of 40 with 80 % each, fewer are 3.6 standard deviations off; all have a chance of 1e-4
    assert 0.57 < np.mean(held) < 1


def test_healthy_parameters_have_no_trend_and_no_crossing():
    for history in make_histories(12, seed=22, kinds=("healthy",)):
        life = predict_life(*history.until(400_000), history.limits)
        assert life.model == "no trend"
        assert life.probability(500_000) < 0.1
        assert np.isinf(life.quantile_km(0.5))


def test_correlated_noise_makes_intervals_wider():
    """Correlation 0.5 makes the standard deviation of means of noise 1.7 times as large."""
    rng = np.random.default_rng(12)
    km = 2_000.0 * np.arange(300)
    line, half = 1 - 0.25 * km / km[-1], np.full(300, 0.005)
    ratios = []
    for white in 0.003 * rng.normal(size=(10, 301)):
        # a moving average with correlation 0.5 and the same variance
        correlated = (white[1:] + white[:-1]) / np.sqrt(2)
        widths = [
            np.subtract(*predict_life(km, line * np.exp(one), half, LIMITS).interval_km())
            for one in (white[1:], correlated)
        ]
        ratios.append(widths[1] / widths[0])
    assert 1.2 < np.median(ratios) < 2.5


def test_models_found_are_those_simulated():
    rng = np.random.default_rng(8)
    path = 1 - 0.2 * KM / KM[-1] + 0.02 * np.cumsum(rng.normal(size=150)) / np.sqrt(150)
    assert predict_life(KM, path * noise() ** 0.1, HALF / 10, LIMITS).model == "wiener"
    slowing = 1 - 0.2 * np.sqrt(KM / KM[-1])
    assert predict_life(KM, slowing * noise(), HALF, LIMITS).model == "changing rate"
    assert predict_life(KM, noise(), HALF, LIMITS).model == "no trend"


@pytest.mark.parametrize(("n", "at"), [(16, 10), (16, 13), (150, 80), (150, 140)])
def test_after_a_step_nothing_goes_on(n, at):
    """Two trips after a spring leaf broke, a rate was read out of it: an end within 4,000 km."""
    values = np.where(np.arange(n) < at, 1.0, 0.88) * noise(2, n)
    life = predict_life(KM[:n], values, HALF[:n], (0.8, 1.25))
    assert life.model == "step"
    assert life.probability(1_000_000) < 0.05
    # what steps below the limit has passed it; a fade that begins as late is none
    assert (predict_life(KM[:n], 0.9 * values, HALF[:n], (0.8, 1.25)).samples_km == 0).all()
    fade = 1 - 0.01 * np.maximum(np.arange(n) - at, 0)
    assert predict_life(KM[:n], fade * noise(2, n), HALF[:n], (0.5, 1.25)).model != "step"


def test_limits_that_are_passed_or_missing_and_single_outliers():
    passed = predict_life(KM, 0.65 * noise(), HALF, LIMITS)
    assert (passed.samples_km == 0).all()
    assert str(passed).startswith("no trend: 0 km")
    falling = (1 - 0.25 * KM / KM[-1]) * noise()
    assert predict_life(KM, falling, HALF, LIMITS).probability(200_000) > 0.95
    for limits in ((0.0, 1.4), (0.0, np.inf)):
        assert predict_life(KM, falling, HALF, limits).probability(200_000) < 0.05
    values = noise()
    values[[20, 75, 149]] = [1.5, 0.5, 0.6]
    assert predict_life(KM, values, HALF, LIMITS).model == "no trend"


def test_missing_estimates_and_half_widths_are_left_out():
    values, half = (1 - 0.2 * KM / KM[-1]) * noise(), HALF.copy()
    full = predict_life(KM, values, half, LIMITS)
    values[::7], half[3::5] = np.nan, np.nan
    found = predict_life(KM, values, half, LIMITS)
    assert found.quantile_km(0.5) == pytest.approx(full.quantile_km(0.5), rel=0.05)
    found = predict_life(KM, values, np.full(150, np.nan), LIMITS)
    assert found.quantile_km(0.5) == pytest.approx(full.quantile_km(0.5), rel=0.05)


def test_same_seed_gives_the_same_samples_and_no_input_changes():
    values, half = (1 - 0.2 * KM / KM[-1]) * noise(), HALF.copy()
    before = values.copy()
    one, two, three = (predict_life(KM, values, half, LIMITS, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.samples_km, two.samples_km)
    assert not np.array_equal(one.samples_km, three.samples_km)
    np.testing.assert_array_equal(values, before)


@settings(max_examples=6, deadline=None)
@given(st.data())
def test_any_history_gives_a_distribution(data):
    n = data.draw(st.integers(MIN_TRIPS, 60))
    steps = data.draw(arrays(float, n, elements=st.floats(1, 50_000)))
    values = data.draw(arrays(float, n, elements=st.floats(0.01, 10)))
    half = data.draw(arrays(float, n, elements=st.floats(0, 1) | st.just(np.nan)))
    life = predict_life(np.cumsum(steps), values, half, LIMITS)
    assert life.samples_km.shape == (N_SAMPLES,)
    assert (life.samples_km >= 0).all()
    assert ((life.samples_km <= HORIZON_KM) | np.isinf(life.samples_km)).all()
    assert life.model in MODELS
    low, high = life.interval_km()
    assert low <= life.quantile_km(0.5) <= high
    assert str(life).startswith(life.model)


# the distribution


def test_life_gives_quantiles_and_probabilities_in_words():
    life = Life("linear", np.concatenate([np.arange(1, 91) * 1_000.0, np.full(10, np.inf)]))
    assert life.quantile_km(0.5) == 50_000
    assert life.interval_km(0.8) == (10_000, 90_000)
    assert life.interval_km(0.9)[1] == np.inf
    assert life.probability(20_000) == pytest.approx(0.2)
    assert str(life) == "linear: 50,000 km to go (80 %: 10,000 to 90,000)"


# failure


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"values": np.full(150, np.nan)}, ValueError, "at least 5 trips with an estimate.*got 0"),
        ({"values": np.where(KM < 8_000, 1, np.nan)}, ValueError, "got 4"),
        ({"values": np.full(150, -1.0)}, ValueError, "`values` must be above 0"),
        ({"values": np.full(150, np.inf)}, ValueError, "`values` must be above 0 and finite"),
        ({"values": np.ones(149)}, ValueError, "one and the same length"),
        ({"values": np.ones((150, 1))}, ValueError, "one and the same length"),
        ({"mileage_km": KM[::-1]}, ValueError, "`mileage_km` must be finite and ascending"),
        ({"mileage_km": np.full(150, np.nan)}, ValueError, "`mileage_km` must be finite"),
        ({"mileage_km": np.ones(150)}, ValueError, "at different mileages"),
        ({"half_widths": -HALF}, ValueError, "`half_widths` must be at least 0"),
        ({"half_widths": np.full(150, np.inf)}, ValueError, "`half_widths` must be at least 0"),
        ({"limits_pair": (1.0, 1.4)}, ValueError, r"`limits_pair\[0\]` must be"),
        ({"limits_pair": (0.7, 1.0)}, ValueError, r"`limits_pair\[1\]` must be"),
        ({"limits_pair": (0.7, np.nan)}, ValueError, r"`limits_pair\[1\]` must be"),
        ({"seed": 0.5}, TypeError, "`seed` must be"),
    ],
)
def test_bad_input_is_refused(change, error, message):
    given_ = {"mileage_km": KM, "values": np.ones(150), "half_widths": HALF, "limits_pair": LIMITS}
    with pytest.raises(error, match=message):
        predict_life(**given_ | change)


@pytest.mark.parametrize(
    ("method", "value"), [("quantile_km", 1.5), ("interval_km", 0.0), ("probability", -1.0)]
)
def test_what_is_no_probability_or_mileage_is_refused(method, value):
    life = Life("linear", np.ones(3))
    with pytest.raises(ValueError, match="must be a finite number"):
        getattr(life, method)(value)
