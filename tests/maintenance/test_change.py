"""Changes along the mileage: known answers, false alarms of healthy histories, any input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from suspnet.maintenance.change import N_BACK, ChangeSettings, find_changes
from suspnet.maintenance.cusum import autoregressive, threshold

SETTINGS = ChangeSettings(least_percent=0.0)
NAMES = ("k_p", "c_p", "k_s", "c_s")
SPREADS = np.array([0.0005, 0.005, 0.0006, 0.003])
"""Standard deviations of the logarithms, as trips of the AM96 have them."""
KM_PER_TRIP = 2000.0


def healthy(n_trips=120, seed=0, correlation=0.3, spreads=SPREADS):
    """Return logarithms of the parameters, (n_trips, 4)."""
    noise = np.random.default_rng(seed).standard_normal((n_trips, len(NAMES)))
    return autoregressive(noise, correlation) * spreads


def changes(logs, covariates=None, settings=SETTINGS, km=None, **given):
    values = dict(zip(NAMES, np.exp(logs).T, strict=True))
    km = KM_PER_TRIP * np.arange(len(logs)) if km is None else km
    return find_changes(km, values, covariates or {}, settings, **given)


def only(found, name):
    """Return the changes of one parameter, when no other has one."""
    assert all(not one for other, one in found.by_parameter.items() if other != name), found
    return found.by_parameter[name]


# reference


def test_limits_are_thresholds_of_the_mileage_per_trip():
    """Of the last 20 trips: 19 gaps; shared by the parameters; rounded down by 5 % at most."""
    found = changes(healthy())
    rate = KM_PER_TRIP / SETTINGS.km_per_false_alarm / len(NAMES)
    assert threshold(rate, 20) - 0.02 <= found.threshold <= threshold(rate / 1.06, 20)
    assert (found.n_reference, found.n_needed, found.n_unlike, found.why_not) == (120, 20, 0, "")


def test_a_step_is_found_at_once_with_its_onset_and_size():
    logs = healthy()
    logs[60:, 1] += math.log(0.9)
    (change,) = only(changes(logs), "c_p")
    assert (change.onset, change.end) == (60, None)
    assert 61 <= change.begin <= 63
    assert change.percent == pytest.approx(-10, abs=0.5)


def test_onset_and_size_are_those_of_the_docstrings():
    """Without covariates and with a long quiet reference: the plain largest (sum z)^2 / n."""
    logs = healthy(correlation=0.0, seed=3)
    logs[70:, 3] += 0.006
    (change,) = only(changes(logs), "c_s")
    z = (logs[:, 3] - logs[:60, 3].mean()) / logs[:60, 3].std()
    last = range(40, change.begin + 1)
    scores = [sum(z[i : change.begin + 1]) ** 2 / (change.begin + 1 - i) for i in last]
    assert change.onset == last[int(np.argmax(scores))]
    size = np.median(logs[change.onset : change.begin + 1, 3]) - logs[:60, 3].mean()
    assert change.percent == pytest.approx(100 * math.expm1(size), abs=0.1)


def test_a_step_that_returns_ends():
    logs = healthy(160)
    logs[60:90, 0] += 0.01
    (change,) = only(changes(logs), "k_p")
    assert change.onset == 60
    assert 90 <= change.end <= 90 + N_BACK


def test_two_changes_are_two():
    logs = healthy(200)
    logs[60:90, 0] += 0.01
    logs[140:170, 0] -= 0.005
    first, second = only(changes(logs), "k_p")
    assert (first.onset, second.onset) == (60, 140)
    assert first.end < second.begin
    assert first.percent == pytest.approx(1, abs=0.1)
    assert second.percent == pytest.approx(-0.5, abs=0.1)


def test_a_drift_is_found_with_its_sign_and_lasts():
    """k_p falls by 1 % in 250,000 km: 0.16 standard deviations a trip."""
    logs = healthy(200)
    logs[60:, 0] -= 0.01 * np.arange(140) * KM_PER_TRIP / 250_000
    (change,) = only(changes(logs), "k_p")
    assert 62 <= change.begin <= 90
    assert change.end is None
    assert -0.5 < change.percent < -0.05


@pytest.mark.parametrize("place", [21, 60, 119])
@pytest.mark.parametrize("size", [-50, 50, 5000])
def test_one_outlier_raises_nothing(place, size):
    logs = healthy()
    logs[place, 2] += size * SPREADS[2]
    assert not any(changes(logs).by_parameter.values())


def test_one_outlier_hides_no_later_step():
    logs = healthy(200)
    logs[60:, 1] += 4 * SPREADS[1]
    plain = only(changes(logs), "c_p")[0].begin
    logs[35, 1] += 50 * SPREADS[1]
    assert only(changes(logs), "c_p")[0].begin <= plain + 2


def test_one_outlier_delays_no_end():
    logs = healthy(200)
    logs[35, 1] += 50 * SPREADS[1]
    logs[60:100, 1] += 5 * SPREADS[1]
    (change,) = only(changes(logs), "c_p")
    assert 100 <= change.end <= 110


def test_a_lasting_step_does_not_flap():
    n_found = []
    for seed in range(10):
        logs = healthy(300, seed)
        logs[60:] += 2 * SPREADS
        n_found += [len(found) for found in changes(logs).by_parameter.values()]
    assert np.mean(n_found) > 0.9
    assert sum(n > 1 for n in n_found) <= 4


def test_a_step_of_a_covariate_with_its_effect_raises_nothing():
    random = np.random.default_rng(4)
    load = random.uniform(0, 1, 160)
    load[60:] = random.uniform(0.5, 1.2, 100)
    logs = healthy(160)
    logs[:, 1] += 0.05 * load
    told = changes(logs, {"load": load})
    assert told.covariates == ("load",)
    assert not any(told.by_parameter.values())
    assert changes(logs).by_parameter["c_p"]


def test_speeds_unlike_the_reference_are_not_judged_but_counted():
    random = np.random.default_rng(5)
    speed = random.normal(120, 5, 120)
    speed[80:84] = 300.0
    logs = healthy()
    logs[80:84, 1] += 0.2
    found = changes(logs, {"speed": speed})
    assert found.n_unlike == 5  # and the trip after them, which is compared with its predecessor
    assert not any(found.by_parameter.values())


def test_a_trip_that_lacks_a_covariate_is_not_judged_but_counted():
    logs = healthy()
    temperature = np.random.default_rng(6).normal(10, 8, 120)
    logs[:, 1] += 0.003 * temperature
    temperature[[70, 90]] = np.nan
    found = changes(logs, {"temperature": temperature})
    assert (found.covariates, found.n_unlike) == (("temperature",), 2)
    assert not any(found.by_parameter.values())


def test_covariates_that_say_nothing_are_left_out():
    celsius = np.random.default_rng(7).normal(10, 8, 120)
    given = {
        "constant": np.full(120, 3.0),
        "celsius": celsius,
        "fahrenheit": 32 + 1.8 * celsius,
        "late": np.where(np.arange(120) < 5, np.nan, celsius),
    }
    assert changes(healthy(), given).covariates == ("celsius",)


def test_wider_intervals_count_less():
    logs = healthy(100)
    logs[60:, 0] += 0.004
    usual = np.full(100, 0.001)
    wide = np.where(np.arange(100) < 60, 0.001, 0.002)

    def begin(widths):
        return only(changes(logs, widths={"k_p": widths}), "k_p")[0].begin

    unknown = np.where(np.arange(100) < 60, 0.001, np.nan)
    assert begin(usual) == begin(unknown) == begin(usual / 7) < begin(wide)
    assert not any(changes(logs, widths={"k_p": 1e6 * wide**2}).by_parameter.values())


def test_changes_below_the_least_are_none():
    logs = healthy()
    logs[60:, 0] += 0.01
    assert only(changes(logs, settings=replace(SETTINGS, least_percent=0.5)), "k_p")
    assert not any(
        changes(logs, settings=replace(SETTINGS, least_percent=2.0)).by_parameter.values()
    )


@pytest.mark.parametrize("n_trips", [0, 1, 19])
def test_unarmed_says_why(n_trips):
    found = changes(healthy()[:n_trips])
    assert found.why_not == f"{n_trips} of 20 trips for the reference so far"
    assert math.isnan(found.threshold)
    assert not found.by_parameter


def test_flagged_trips_do_not_count():
    logs = healthy()
    usable = np.ones(120, dtype=bool)
    usable[60:80] = False
    logs[60:80] += 1
    found = changes(logs, usable=usable)
    assert not any(found.by_parameter.values())
    assert found.n_reference == 100
    assert changes(logs, usable=np.arange(120) < 19).why_not


# limit


def test_the_last_trip_of_the_reference_arms():
    found = changes(healthy()[:20])
    assert (found.why_not, found.n_reference) == ("", 20)
    assert found.threshold > 6
    assert not any(found.by_parameter.values())


def test_trips_of_one_mileage_allow_no_false_alarm():
    assert changes(healthy(), km=np.zeros(120)).threshold > changes(healthy()).threshold + 5


def test_a_pause_allows_no_false_alarm():
    """A million km without trips is no budget for the first trips thereafter."""
    km = KM_PER_TRIP * np.arange(120) + 1e6 * (np.arange(120) >= 60)
    assert changes(healthy()[:61], km=km[:61]).threshold > changes(healthy()).threshold - 1


# property


def test_later_trips_change_no_alarm_of_the_past():
    random = np.random.default_rng(8)
    logs = healthy(160, seed=8)
    logs[60:90, 0] += 0.004
    logs[110:, 1] += 0.03
    covariates = {"load": random.uniform(0, 1, 160), "speed": random.normal(160, 10, 160)}
    km = np.cumsum(random.exponential(2000, 160))
    whole = changes(logs, covariates, km=km)
    assert sum(map(len, whole.by_parameter.values())) == 2
    for n_trips in range(20, 160, 7):
        known = {name: one[:n_trips] for name, one in covariates.items()}
        part = changes(logs[:n_trips], known, km=km[:n_trips])
        for name in NAMES:
            past = [
                replace(one, end=None if one.end is None or one.end >= n_trips else one.end)
                for one in whole.by_parameter[name]
                if one.begin < n_trips
            ]
            assert part.by_parameter[name] == past


def test_level_scale_and_units_change_nothing():
    random = np.random.default_rng(9)
    logs = healthy()
    logs[60:, 2] += 0.003
    load = random.uniform(0, 1, 120)
    expected = changes(logs, {"load": load}).by_parameter
    for turned in (
        changes(logs + np.log([0.5, 2, 3, 100]), {"load": load}).by_parameter,
        changes(logs, {"load": 2 - 1e5 * load}).by_parameter,
    ):
        for name in NAMES:
            for one, other in zip(expected[name], turned[name], strict=True):
                assert (one.onset, one.begin, one.end) == (other.onset, other.begin, other.end)
                assert one.percent == pytest.approx(other.percent, rel=1e-6)
    scaled = changes(3 * logs, {"load": load}).by_parameter
    assert [one.begin for one in scaled["k_s"]] == [one.begin for one in expected["k_s"]]


def test_false_alarms_stay_in_the_budget():
    """150 healthy suspensions, each of 200 trips after its reference, covariates with effects."""
    random = np.random.default_rng(10)
    n_alarms, n_histories, n_trips = 0, 150, 220
    for seed in range(n_histories):
        logs = healthy(n_trips, seed, random.uniform(0, 0.5))
        load, speed = random.uniform(0, 1, n_trips), random.normal(160, 10, n_trips)
        effect = (load - 0.5)[:, None] * 2 + 0.1 * (speed - 160)[:, None]
        found = changes(logs + SPREADS * effect, {"load": load, "speed": speed})
        n_alarms += sum(map(len, found.by_parameter.values()))
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
def test_any_numbers_give_places_in_order(data):
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


@pytest.mark.parametrize("what", ["values", "covariates", "widths", "usable"])
def test_arrays_of_another_length_are_refused(what):
    given = {"values": {"k_p": np.ones(30)}, "covariates": {}, "settings": SETTINGS}
    given[what] = np.ones(29, bool) if what == "usable" else {"k_p": np.ones(29)}
    with pytest.raises(ValueError, match=rf"`{what}` must have 30 trips each, got \(29,\) for"):
        find_changes(np.arange(30.0), **given)


@pytest.mark.parametrize("km", [3.0, np.ones((30, 1))])
def test_mileage_of_another_dimension_is_refused(km):
    with pytest.raises(ValueError, match="`mileage_km` must have one dimension"):
        find_changes(km, {"k_p": np.ones(30)}, {}, SETTINGS)


def test_no_parameter_is_refused():
    with pytest.raises(ValueError, match="one parameter at least"):
        find_changes(np.arange(30.0), {}, {}, SETTINGS)


def test_mileage_that_falls_is_refused():
    with pytest.raises(ValueError, match="`mileage_km` must ascend"):
        changes(healthy(), km=-np.arange(120.0))


def test_more_covariates_than_the_reference_tells_are_refused():
    random = np.random.default_rng(11)
    given = {str(i): random.standard_normal(120) for i in range(17)}
    with pytest.raises(ValueError, match="`n_reference` must be"):
        changes(healthy(), given)
