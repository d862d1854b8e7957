"""Limits: what lies beyond one is reported whatever was before, healthy series stay quiet."""

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from trip_records import SPREAD

from suspnet.ground.parameters import (
    BOGIE_PARTS,
    DEFAULT_LIMITS,
    ESTIMATED,
    Limits,
    Severity,
    kind_of,
    limits_words,
    read_limits,
)
from suspnet.trains.maintenance.judge import judge
from suspnet.trains.maintenance.series import N_LAST
from suspnet.trains.simulation.fleet import Scenario
from suspnet.vehicle import PARAMETERS

CONFIGS = Path(__file__).parents[2] / "configs"
SCENARIOS = yaml.safe_load((CONFIGS / "scenarios.yaml").read_text())
SCENARIOS = {name: one for name, one in SCENARIOS.items() if not one.get("by_part")}
ALARMING = {
    "damper_fade",
    "primary_damper_fade",
    "failed_air_spring",
    "flat_air_spring",
    "blocked_choke",
    "random",
}
Z = 1.645
"""Half-width of a 90 % interval over its standard deviation."""
JUDGED = PARAMETERS[:-1]
LIMITS = Limits((0.9, 1.1), (0.8, 1.25))
WINDOW = np.arange(-N_LAST, 0)


def scenario(name, begin_km=None):
    """Return a shipped scenario, with all that changes beginning at another mileage."""
    content = copy.deepcopy(SCENARIOS["healthy"] | SCENARIOS[name])
    content = {k: v for k, v in content.items() if not k.startswith("_")}
    if begin_km is not None and content["changes"]:
        first = min(change["from_km"] for change in content["changes"].values())
        for change in content["changes"].values():
            change["to_km"] += begin_km - first
            change["from_km"] += begin_km - first
    return Scenario(**content)


def series(name, n_trips, seed=0):
    """Return mileage and true values (n_places, n_trips, 5) of a failure at each place."""
    km = 308_000.0 * np.arange(1, n_trips + 1) / n_trips
    starts = [None, -1.0, *km]
    return km, np.stack([scenario(name, start).ratios(km, seed) for start in starts])


def measured(truth, rng, scale=1.0):
    """Return estimates and half-widths of one parameter after another, in the last axis."""
    sigma = scale * np.array([SPREAD[name] for name in PARAMETERS])
    return truth * np.exp(sigma * rng.normal(size=truth.shape)), Z * sigma


def newest(values):
    """Return the last trips along the last axis, filled up in front with NaN."""
    padded = np.concatenate([np.full((*values.shape[:-1], N_LAST), np.nan), values], axis=-1)
    return padded[..., WINDOW]


def judged(values, half, limits=LIMITS, flagged=False):
    last = newest(np.asarray(values, dtype=float))
    marks = np.broadcast_to(flagged, last.shape)
    return judge(last, last * np.exp(-half), last * np.exp(half), marks, limits)


# reference: what a person sees in the plot


@pytest.mark.parametrize("name", SCENARIOS)
def test_no_failure_at_the_end_is_missed_whatever_the_number_of_trips_and_the_place(name):
    """Three draws of noise, 1 to 30 trips, a failure at each of them and before the first."""
    rng = np.random.default_rng(5)
    n_beyond = 0
    for n_trips in range(1, 31):
        _, truth = series(name, n_trips)
        values, half_widths = measured(np.repeat(truth, 3, axis=0), rng)
        for i, parameter in enumerate(JUDGED):
            limits = DEFAULT_LIMITS[parameter]
            found = judged(values[:, :, i], half_widths[i], limits).severity
            last, half = values[:, -1, i], half_widths[i]
            for level, (lower, upper) in (
                (Severity.NOTICE, limits.notice),
                (Severity.ACT, limits.act),
            ):
                assert (found[(last < lower) | (last > upper)] >= Severity.UNKNOWN).all()
                wholly = (last * np.exp(half) < lower) | (last * np.exp(-half) > upper)
                assert (found[wholly] >= level).all()
                n_beyond += wholly.sum()
            quiet = (
                (values[:, :, i] > limits.notice[0]) & (values[:, :, i] < limits.notice[1])
            ).all(1)
            assert (found[quiet] == Severity.NONE).all()
    assert (n_beyond > 300) == (name in ALARMING)
    assert ALARMING < set(SCENARIOS)


# limit: healthy series


@pytest.mark.parametrize(
    ("half", "common", "stated"),
    [
        (0.03, 0.0, 1e-4),
        (0.1, 0.0, 0.0015),
        (0.4, 0.0, 0.06),
        # 80 % of the variance is common to the trips: it is not averaged out
        (0.1, 0.8, 0.0035),
    ],
)
def test_false_alarms_stay_below_the_stated_rate(half, common, stated):
    """The rates of the docstring of `judge`; 40,000 series, and three standard errors."""
    rng = np.random.default_rng(3)
    errors = np.sqrt(common) * rng.normal(size=(40_000, 1))
    errors = errors + np.sqrt(1 - common) * rng.normal(size=(40_000, N_LAST))
    values = 1 + half / Z * errors
    limits, nothing = Limits((0.9, 1.1), (0.8, 1.2)), np.zeros(values.shape)
    found = judge(values, values - half, values + half, nothing, limits)
    rate = (found.severity >= Severity.NOTICE).mean()
    assert rate <= stated + 3 * np.sqrt(stated / len(values))
    if half == 0.1:
        assert rate > 0.0005  # the bound is not idle


def test_interval_of_a_mean_is_that_written_naively():
    values, half = np.array([1.3, 1.24, 1.27, 1.33, 1.0]), 0.08
    logs = np.log(values[:4])
    noise = (1.645 * np.std(logs, ddof=1)) ** 2
    width = math.sqrt(half**2 - noise + noise / 4)
    inner = np.exp(logs.mean() - width)
    for limit, severity in ((inner - 0.001, Severity.ACT), (inner + 0.001, Severity.NOTICE)):
        limits = Limits((0.9, 1.1), (0.8, limit))
        assert judged(values, half, limits).severity == severity


# property: the rules one by one


@pytest.mark.parametrize(
    ("values", "half", "severity"),
    [
        ([1.0, 1.3], 0.01, Severity.ACT),
        ([1.0, 1.2], 0.01, Severity.NOTICE),
        ([1.0, 0.85], 0.01, Severity.NOTICE),
        ([1.0, 0.7], 0.01, Severity.ACT),
        ([1.0, 1.12], 0.05, Severity.UNKNOWN),  # its interval reaches back
        ([1.0, 1.28], 0.05, Severity.NOTICE),  # surely beyond notice only
        ([1.3, 1.12], 0.05, Severity.NOTICE),  # the trip before confirms it
        ([1.3, 1.3, 1.3, 1.0, 1.0], 0.01, Severity.ACT),  # repaired: two more trips clear it
        ([1.3, 1.3, 1.0, 1.0, 1.0], 0.01, Severity.NONE),
        ([1.22, 1.16, 1.19, 1.0, 1.17], 0.075, Severity.NOTICE),  # four that confirm each other
        ([1.15, 1.15, 1.15, 1.0, 1.15], 0.09, Severity.UNKNOWN),  # their error is in common
        ([1.15, 1.15, 1.15, 1.0, 1.15], 0.3, Severity.UNKNOWN),  # too wide to confirm anything
        ([1.3], np.nan, Severity.NOTICE),  # without an interval
        ([1.3, 1.3, 1.3], np.nan, Severity.ACT),
        ([1.3], np.inf, Severity.NOTICE),
        ([1.0], np.nan, Severity.NONE),
        ([0.7, 1.3], 0.01, Severity.ACT),
    ],
)
def test_rules(values, half, severity):
    with np.errstate(over="ignore", invalid="ignore"):
        assert judged(values, half).severity == severity


@pytest.mark.parametrize(
    ("values", "flagged", "severity", "side", "run", "count", "weak"),
    [
        ([1.0, 1.3, 1.15, 1.3, 1.3], [], Severity.ACT, 1, 2, 3, False),
        ([1.0, 1.0, 0.7], [], Severity.ACT, -1, 1, 1, False),
        # a flagged trip alone is a notice, three are taken at their word
        ([1.0, 1.0, 3.0], [4], Severity.NOTICE, 1, 1, 1, True),
        ([1.0, 3.0, 3.0, 3.0], [2, 3, 4], Severity.ACT, 1, 3, 3, False),
    ],
)
def test_side_run_and_count_are_those_of_the_limit_that_was_crossed(
    values, flagged, severity, side, run, count, weak
):
    found = judged(values, 0.01, flagged=np.isin(np.arange(N_LAST), flagged))
    numbers = found.severity, found.side, found.run, found.count, bool(found.weak)
    assert numbers == (severity, side, run, count, weak)


# failure


@pytest.mark.parametrize(
    ("notice", "act", "message"),
    [
        ((0.9,), (0.8, 1.2), "`notice` must be two numbers, lower and upper"),
        ((0.9, "x"), (0.8, 1.2), r"`notice\[1\]` must be a finite number > 1, got 'x'"),
        ((0.9, 1.1), (True, 1.2), r"`act\[0\]` must be a finite number >= 0 and < 1, got True"),
        ((1.1, 1.2), (0.8, 1.3), r"`notice\[0\]` must be a finite number >= 0 and < 1, got 1\.1"),
        ((0.9, 1.1), (0.8, np.nan), r"`act\[1\]` must be a finite number > 1, got nan"),
        ((0.7, 1.1), (0.8, 1.2), r"`notice` \(0\.7, 1\.1\) must lie within `act`"),
    ],
)
def test_limits_that_make_no_sense_are_refused(notice, act, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Limits(notice, act)
    with pytest.raises((TypeError, ValueError), match=f"`limits.k_p`: .*{message}"):
        read_limits({"k_p": {"notice": notice, "act": act}})


def with_parts(*kinds):
    """Return these parameters and all of their parts."""
    return {name for name in ESTIMATED if kind_of(name) in kinds}


def test_limits_are_read_from_plain_values():
    given = {"k_p": {"notice": [0.9, 1.1], "act": [0.8, 1.25]}, "c_p": None}
    assert read_limits(given) == dict.fromkeys(with_parts("k_p"), LIMITS)
    assert read_limits(DEFAULT_LIMITS) == DEFAULT_LIMITS
    assert Limits((0, 1.1), (0, np.inf)).act == (0, np.inf)


def test_limits_are_the_defaults_unless_others_are_given():
    settings = yaml.safe_load((CONFIGS / "base" / "alarms.yaml").read_text())["limits"]
    assert read_limits(settings, DEFAULT_LIMITS, "a setting") == DEFAULT_LIMITS
    given = {"k_p": None, "c_p": {"act": [0.5, None]}, "M_s": {"notice": None, "act": None}}
    found = read_limits(given, DEFAULT_LIMITS, "a setting")
    assert set(found) == with_parts("c_p", "k_s", "c_s")
    damper = Limits((0.8, 1.25), (0.5, np.inf), "a setting")
    assert {found[name] for name in with_parts("c_p")} == {damper}
    assert found["k_s"] is DEFAULT_LIMITS["k_s"]
    own = read_limits({"k_s": {"why": "our rule 7", "notice": [0.95, 1.05]}}, DEFAULT_LIMITS)
    assert own["k_s"] == Limits((0.95, 1.05), (0.8, 1.25), "our rule 7")


def test_limits_of_a_part_are_its_own_whatever_comes_first():
    given = {"k_s_left": {"act": [0.5, 2]}, "k_s": {"act": [0.6, 1.5]}, "c_s_right": None}
    found = read_limits(given, DEFAULT_LIMITS)
    assert set(found) == {*PARAMETERS[:-1], *BOGIE_PARTS} - {"c_s_right"}
    acts = [found[name].act for name in ("k_s", "k_s_left", "k_s_right")]
    assert acts == [(0.6, 1.5), (0.5, 2), (0.6, 1.5)]
    assert found["c_s_left"] == found["c_s"] == DEFAULT_LIMITS["c_s"]
    assert read_limits({"k_s": {"act": None}}, found) == found
    assert limits_words(found).count("k_s_left: ") == 1
    assert "k_s_right" not in limits_words(found)


def test_every_default_has_a_reason_and_words_give_it_once():
    assert all(one.why for one in DEFAULT_LIMITS.values())
    words = limits_words(DEFAULT_LIMITS)
    assert words.startswith("k_p, k_s: notice beyond 90 to 110 %, act beyond 80 to 125 % (")
    assert words.count("emergency spring") == words.count("; c_p, c_s: notice beyond 80 to") == 1
    assert limits_words({}) == "none"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "`limits` must map parameters to their limits"),
        ({"kp": None}, r"`limits` must be named as in .*, got 'kp'"),
        ({"k_p": {"act": [0.95, 1.2]}}, r"`limits.k_p`: limits `notice` .* must lie within `act`"),
        ({"k_p": {"why": 7}}, r"`limits.k_p`: `why` must be text, got 7"),
        ({"k_p": {"notice": 0.9}}, r"`limits.k_p`: `notice` must be two numbers, .* got 0.9"),
        ({"k_p": {"notices": [0.9, 1.1]}}, r"`limits\.k_p` must have `notice` and `act`"),
        ({"M_s": {"act": [0.5, 2]}}, r"`limits\.M_s` must be left out: the car-body mass varies"),
        ({"M_s": DEFAULT_LIMITS["k_p"]}, r"`limits\.M_s` must be left out"),
    ],
)
def test_limits_that_do_not_go_with_the_defaults_are_refused(given, message):
    with pytest.raises((TypeError, ValueError), match=message):
        read_limits(given, DEFAULT_LIMITS)
