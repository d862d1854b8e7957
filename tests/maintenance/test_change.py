"""Changes along the mileage: known answers, false alarms of healthy histories, any input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from drifting_series import autoregressive
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from suspnet.trains.maintenance.change import N_BACK, ChangeSettings, _limits, find_changes
from suspnet.trains.maintenance.cusum import threshold

SETTINGS = ChangeSettings(least_percent=0.0)
NAMES = ("k_p", "c_p", "k_s", "c_s")
SPREADS = np.array([0.0005, 0.005, 0.0006, 0.003])
"""Standard deviations of the logarithms, as trips of the AM96 have them."""
KM_PER_TRIP = 2000.0


def healthy(n_trips=120, seed=0, correlation=0.3):
    """Return logarithms of the parameters, (n_trips, 4)."""
    noise = np.random.default_rng(seed).standard_normal((n_trips, len(NAMES)))
    return autoregressive(noise, correlation) * SPREADS


def stepped(steps, n_trips=120, seed=0, correlation=0.3):
    """Return healthy logarithms with steps of (parameter, first trip, last trip + 1, size)."""
    logs = healthy(n_trips, seed, correlation)
    for name, begin, end, size in steps:
        logs[begin:end, NAMES.index(name)] += size
    return logs


def changes(logs, covariates=None, settings=SETTINGS, km=None, **others):
    values = dict(zip(NAMES, np.exp(logs).T, strict=True))
    km = KM_PER_TRIP * np.arange(len(logs)) if km is None else km
    return find_changes(km, values, covariates or {}, settings, **others)


def only(found, name):
    """Return the changes of one parameter, when no other has one."""
    assert all(not own for other, own in found.by_parameter.items() if other != name), found
    return found.by_parameter[name]


def n_changes(found):
    return sum(map(len, found.by_parameter.values()))


# reference


def test_limits_are_thresholds_of_the_mileage_per_trip():
    """Of the last 20 trips: 19 gaps; shared by the parameters."""
    found = changes(healthy())
    rate = KM_PER_TRIP / SETTINGS.km_per_false_alarm / len(NAMES)
    limits = _limits(KM_PER_TRIP * np.arange(120), len(NAMES), SETTINGS)
    np.testing.assert_allclose(limits, threshold(rate))
    assert len(limits) == 120 - 19
    assert (found.n_reference, found.n_needed, found.n_unlike, found.why_not) == (120, 20, 0, "")


def test_onset_and_size_are_those_of_the_docstrings():
    """Without covariates and with a long quiet reference: the plain largest (sum z)^2 / n."""
    logs = stepped([("c_s", 70, 120, 0.006)], seed=3, correlation=0.0)
    (change,) = only(changes(logs), "c_s")
    z = (logs[:, 3] - logs[:60, 3].mean()) / logs[:60, 3].std()
    last = range(40, change.begin + 1)
    scores = [sum(z[i : change.begin + 1]) ** 2 / (change.begin + 1 - i) for i in last]
    assert change.onset == last[int(np.argmax(scores))]
    size = np.median(logs[change.onset : change.begin + 1, 3]) - logs[:60, 3].mean()
    assert change.percent == pytest.approx(100 * math.expm1(size), abs=0.1)


@pytest.mark.parametrize(
    ("steps", "n_trips", "begins", "ends", "percents"),
    [
        # a step is detected at once and lasts, or ends
        ([("c_p", 60, 120, math.log(0.9))], 120, [(61, 63)], [None], [-10]),
        ([("k_p", 60, 90, 0.01)], 160, [(60, 63)], [(90, 90 + N_BACK)], [1]),
        # two changes are two
        (
            [("k_p", 60, 90, 0.01), ("k_p", 140, 170, -0.005)],
            200,
            [(60, 63), (140, 143)],
            [(90, 139), (170, 199)],
            [1, -0.5],
        ),
        # an outlier before it delays neither its start nor its end
        (
            [("c_p", 35, 36, 50 * SPREADS[1]), ("c_p", 60, 100, 5 * SPREADS[1])],
            200,
            [(60, 64)],
            [(100, 110)],
            [2.5],
        ),
    ],
)
def test_steps_are_detected_with_onset_size_and_end(steps, n_trips, begins, ends, percents):
    found = only(changes(stepped(steps, n_trips)), steps[0][0])
    assert [change.onset for change in found] == [begin for _, begin, *_ in steps[-len(found) :]]
    for change, begin, end, percent in zip(found, begins, ends, percents, strict=True):
        assert begin[0] <= change.begin <= begin[1]
        assert change.end is None if end is None else end[0] <= change.end <= end[1]
        spread = 100 * SPREADS[NAMES.index(steps[0][0])]
        assert change.percent == pytest.approx(percent, abs=max(0.1, spread))


def test_a_drift_is_detected_with_its_sign_and_lasts():
    """k_p falls by 1 % in 250,000 km: 0.16 standard deviations a trip."""
    logs = healthy(200)
    logs[60:, 0] -= 0.01 * np.arange(140) * KM_PER_TRIP / 250_000
    (change,) = only(changes(logs), "k_p")
    assert 62 <= change.begin <= 90
    assert change.end is None
    assert -0.5 < change.percent < -0.05


@pytest.mark.parametrize(("trip", "size"), [(21, -50), (60, 50), (119, 5000)])
def test_one_outlier_raises_nothing(trip, size):
    assert not n_changes(changes(stepped([("k_s", trip, trip + 1, size * SPREADS[2])])))


def test_a_lasting_step_does_not_flap():
    n_found = []
    for seed in range(6):
        logs = healthy(200, seed)
        logs[60:] += 2 * SPREADS
        n_found += [len(own) for own in changes(logs).by_parameter.values()]
    assert np.mean(n_found) > 0.9
    assert sum(n > 1 for n in n_found) <= 3


def test_a_step_of_a_covariate_with_its_effect_raises_nothing():
    random = np.random.default_rng(4)
    load = random.uniform(0, 1, 160)
    load[60:] = random.uniform(0.5, 1.2, 100)
    logs = healthy(160)
    logs[:, 1] += 0.05 * load
    found = changes(logs, {"load": load})
    assert found.covariates == ("load",)
    assert not n_changes(found)
    assert changes(logs).by_parameter["c_p"]


def test_trips_that_lack_a_covariate_or_are_unlike_the_reference_are_not_judged_but_counted():
    speed = np.random.default_rng(5).normal(120, 5, 120)
    speed[80:84] = 300.0
    found = changes(stepped([("c_p", 80, 84, 0.2)]), {"speed": speed})
    assert found.n_unlike == 5  # and the trip after them, which is compared with its predecessor
    assert not n_changes(found)
    temperature = np.random.default_rng(6).normal(10, 8, 120)
    logs = healthy()
    logs[:, 1] += 0.003 * temperature
    temperature[[70, 90]] = np.nan
    found = changes(logs, {"temperature": temperature})
    assert (found.covariates, found.n_unlike) == (("temperature",), 2)
    assert not n_changes(found)


def test_covariates_without_information_are_left_out():
    celsius = np.random.default_rng(7).normal(10, 8, 120)
    covariates = {
        "constant": np.full(120, 3.0),
        "celsius": celsius,
        "fahrenheit": 32 + 1.8 * celsius,
        "late": np.where(np.arange(120) < 5, np.nan, celsius),
    }
    assert changes(healthy(), covariates).covariates == ("celsius",)


def test_changes_below_the_least_size_are_none():
    logs = stepped([("k_p", 60, 120, 0.01)])
    assert only(changes(logs, settings=replace(SETTINGS, least_percent=0.5)), "k_p")
    assert not n_changes(changes(logs, settings=replace(SETTINGS, least_percent=2.0)))


def test_flagged_trips_do_not_count():
    logs, usable = healthy(), np.ones(120, dtype=bool)
    usable[60:80] = False
    logs[60:80] += 1
    found = changes(logs, usable=usable)
    assert (n_changes(found), found.n_reference) == (0, 100)
    assert changes(logs, usable=np.arange(120) < 19).why_not


# limit


@pytest.mark.parametrize("n_trips", [0, 1, 19, 20])
def test_the_last_trip_of_the_reference_arms(n_trips):
    found = changes(healthy()[:n_trips])
    assert not n_changes(found)
    assert found.n_reference == n_trips
    if n_trips == 20:
        assert found.why_not == ""
    else:
        assert found.why_not.values == {"n_trips": n_trips, "needed": 20}


# property


def test_later_trips_change_no_alarm_of_the_past():
    random = np.random.default_rng(8)
    logs = stepped([("k_p", 60, 90, 0.004), ("c_p", 110, 160, 0.03)], 160, seed=8)
    covariates = {"load": random.uniform(0, 1, 160), "speed": random.normal(160, 10, 160)}
    km = np.cumsum(random.exponential(2000, 160))
    whole = changes(logs, covariates, km=km)
    assert n_changes(whole) == 2
    for n_trips in range(20, 160, 14):
        known = {name: column[:n_trips] for name, column in covariates.items()}
        early = changes(logs[:n_trips], known, km=km[:n_trips])
        for name in NAMES:
            past = [
                replace(one, end=None if one.end is None or one.end >= n_trips else one.end)
                for one in whole.by_parameter[name]
                if one.begin < n_trips
            ]
            assert early.by_parameter[name] == past


def test_false_alarms_stay_in_the_budget():
    """150 healthy suspensions, each of 200 trips after its reference, covariates with effects."""
    random = np.random.default_rng(10)
    n_alarms, n_histories, n_trips = 0, 150, 220
    for seed in range(n_histories):
        logs = healthy(n_trips, seed, random.uniform(0, 0.5))
        load, speed = random.uniform(0, 1, n_trips), random.normal(160, 10, n_trips)
        effect = (load - 0.5)[:, None] * 2 + 0.1 * (speed - 160)[:, None]
        n_alarms += n_changes(changes(logs + SPREADS * effect, {"load": load, "speed": speed}))
    km = n_histories * 200 * KM_PER_TRIP
    assert n_alarms <= stats.poisson.ppf(0.999, km / SETTINGS.km_per_false_alarm)


ANY_VALUE = st.one_of(
    st.floats(0.5, 2),
    st.just(1.0),
    st.floats(min_value=5e-324, allow_infinity=False, allow_nan=False, exclude_min=False),
    st.sampled_from([math.nan, math.inf, -1.0, 0.0, 1e300, 1e-300]),
)
ANY_COVARIATE = st.one_of(
    st.floats(-1, 1), st.floats(), st.sampled_from([0.0, 1.0, 1e19, 1e300, math.nan])
)


@given(st.data())
def test_any_numbers_give_trips_in_order(data):
    """No exception, no warning, whatever the numbers."""
    n_trips = data.draw(st.integers(20, 60))
    some = st.integers(0, n_trips - 1)
    random = np.random.default_rng(data.draw(st.integers(0, 9)))
    values = np.exp(0.01 * random.standard_normal((2, n_trips)))
    covariate = random.standard_normal(n_trips)
    for array, element in ((values[0], ANY_VALUE), (covariate, ANY_COVARIATE)):
        for place, value in data.draw(st.dictionaries(some, element, max_size=12)).items():
            array[place:] = value if place % 3 == 0 else array[place:]
            array[place] = value
    km = np.cumsum(data.draw(arrays(float, n_trips, elements=st.floats(1e3, 1e5))))
    km[list(data.draw(st.sets(some, max_size=3)))] = np.nan
    found = find_changes(
        km,
        dict(zip("ab", values, strict=True)),
        {"x": covariate},
        ChangeSettings(km_per_false_alarm=1e3),  # one threshold, and a low one
        usable=data.draw(arrays(bool, n_trips, elements=st.booleans() | st.just(True))),
        widths={"a": data.draw(arrays(float, n_trips, elements=ANY_VALUE))},
    )
    assert found.n_unlike <= n_trips
    assert bool(found.why_not) == (not found.by_parameter)
    for several in found.by_parameter.values():
        for one in several:
            assert 0 <= one.onset <= one.begin <= (n_trips if one.end is None else one.end)
            assert one.begin < n_trips
            assert not math.isnan(one.percent)


# failure


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"values": {"k_p": np.ones(29)}}, r"`values` must have 30 trips each, got \(29,\)"),
        ({"covariates": {"x": np.ones(29)}}, r"`covariates` must have 30 trips each"),
        ({"widths": {"k_p": np.ones(29)}}, r"`widths` must have 30 trips each"),
        ({"usable": np.ones(29, bool)}, r"`usable` must have 30 trips each"),
        ({"values": {}}, "one parameter at least"),
        ({"mileage_km": 3.0}, "`mileage_km` one dimension"),
        ({"mileage_km": np.ones((30, 1))}, "`mileage_km` one dimension"),
        ({"mileage_km": -np.arange(30.0)}, "`mileage_km` must ascend"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(fields, message):
    whole = {"mileage_km": np.arange(30.0), "values": {"k_p": np.ones(30)}, "covariates": {}}
    with pytest.raises(ValueError, match=message):
        find_changes(**whole | {"settings": SETTINGS} | fields)


def test_more_covariates_than_the_reference_determines_are_refused():
    random = np.random.default_rng(11)
    covariates = {str(i): random.standard_normal(120) for i in range(17)}
    with pytest.raises(ValueError, match="`n_reference` must be"):
        changes(healthy(), covariates)
