"""Alarms of a suspension, from made-up estimates."""

import numpy as np
import pytest
from drifting_series import autoregressive

from suspnet.ground.findings import parts_of
from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Severity
from suspnet.trains.maintenance.alarms import detector_words, watch
from suspnet.trains.maintenance.change import Changes, ChangeSettings
from suspnet.trains.maintenance.judge import level_words
from suspnet.trains.maintenance.series import Event, make_series

PARAMETERS = ("k_p", "c_p", "k_s", "c_s")
SPREAD = np.array([0.0005, 0.003, 0.0006, 0.001])
N_TRIPS = 100
KM = 2000.0 * np.arange(N_TRIPS)
SETTINGS = ChangeSettings()


def made_up(seed=0):
    """Return healthy estimates of shape (n_trips, n_parameters)."""
    noise = np.random.default_rng(seed).standard_normal((N_TRIPS, 4))
    return np.exp(autoregressive(noise, 0.3) * SPREAD)


def watched(estimates, *, flagged=(), order=slice(None), maintenance_km=(), settings=SETTINGS):
    """Return what the trips raise."""
    marks = np.isin(np.arange(len(estimates)), flagged)
    widths = np.tile(3 * SPREAD, (len(estimates), 1))
    series = make_series(
        KM[: len(estimates)][order],
        dict(zip(PARAMETERS, estimates[order].T, strict=True)),
        dict(zip(PARAMETERS, widths.T, strict=True)),
        marks[order],
        map(Event, maintenance_km),
        speed_m_per_s=70 + np.random.default_rng(1).standard_normal(len(estimates))[order],
    )
    return watch(series, DEFAULT_LIMITS, settings)


def of_limits(found):
    return [alarm for alarm in found.alarms if alarm.cause == Cause.LIMIT]


def test_healthy_trips_raise_nothing():
    found = watched(made_up())
    assert (found.alarms, found.passed, found.changes.why_not) == ([], set(), "")
    armed = detector_words(found.changes, SETTINGS)
    assert (armed.kind, armed.values["km"]) == ("armed", 1e6)


def test_one_percent_of_a_spring_is_a_notice_within_four_trips():
    """The paper's story; nothing else raises an alarm."""
    estimates = made_up()
    estimates[60:, 0] *= 0.99
    found = watched(estimates)
    (alarm,) = found.alarms
    assert (alarm.parameter, alarm.cause, alarm.is_open) == ("k_p", Cause.CHANGE, True)
    assert alarm.severity == Severity.NOTICE
    assert KM[60] < alarm.begin_km <= KM[63]
    assert (alarm.words.kind, alarm.words.values["km"]) == ("fell", 119_000)
    assert found.changes.by_parameter["k_p"][0].percent == pytest.approx(-1, abs=0.2)
    # the order of the trips does not matter; the smallest size that counts does
    order = np.random.default_rng(0).permutation(N_TRIPS)
    assert watched(estimates, order=order).alarms == found.alarms
    assert watched(estimates, settings=ChangeSettings(least_percent=2.0)).alarms == []


def test_failed_air_spring_acts_at_once():
    estimates = made_up()
    estimates[80:, 2] *= 1.5
    found = watched(estimates)
    (alarm,) = found.alarms  # the change is redundant
    assert (alarm.cause, alarm.severity, alarm.begin_km) == (Cause.LIMIT, Severity.ACT, KM[80])
    assert alarm.words.values["beyond"].kind == "above-act-limit"
    assert found.passed == {"k_s"}


def test_alarm_of_a_limit_ends_after_three_quiet_trips_and_does_not_flap():
    estimates = made_up()
    estimates[50:70, 3] *= 0.75
    estimates[[55, 56, 60], 3] = 1.0  # two quiet trips in a row are too few
    (alarm,) = of_limits(watched(estimates))
    assert (alarm.begin_km, alarm.severity) == (KM[50], Severity.NOTICE)
    # three of the last five trips confirm each other until the third trip within the limits
    assert KM[72] <= alarm.end_km <= KM[76]


def test_worst_severity_is_kept():
    estimates = made_up()
    estimates[50:55, 3] *= 0.6
    estimates[55:, 3] *= 0.75
    (alarm,) = of_limits(watched(estimates))
    assert (alarm.severity, alarm.is_open) == (Severity.ACT, True)


def test_words_say_how_far_a_change_has_gone_on():
    estimates = made_up()
    estimates[60:, 3] *= np.linspace(1, 0.85, 40)
    (alarm,) = watched(estimates).alarms
    assert alarm.words.kind == "change-goes-on"
    assert alarm.words.values["percent"] == pytest.approx(14, abs=0.5)


def test_maintenance_ends_alarms_and_reference():
    estimates = made_up()
    estimates[40:60, 0] *= 0.98
    estimates[70:, 3] *= 1.03  # a new damper, which is usual from then on
    found = watched(estimates, maintenance_km=[KM[60], KM[70]])
    (alarm,) = found.alarms
    assert (alarm.parameter, alarm.end_km) == ("k_p", KM[60])
    assert found.changes.n_reference == 30


def test_flags_do_not_silence_trips_that_agree():
    estimates = made_up()
    estimates[:, 2] *= 1.5
    (alarm,) = watched(estimates, flagged=range(N_TRIPS)).alarms
    assert alarm.severity == Severity.ACT
    (first,) = watched(estimates[:2], flagged=range(2)).alarms
    assert first.severity == Severity.NOTICE  # too few to confirm each other


def test_trips_without_mileage_or_estimate_count_for_nothing():
    estimates = made_up()
    estimates[[3, 50]] = np.nan
    assert watched(estimates).alarms == []
    assert watch(make_series([], {}), DEFAULT_LIMITS, SETTINGS).alarms == []
    few = watched(made_up()[:12])
    assert few.alarms == []
    assert detector_words(few.changes, SETTINGS).kind == "not-armed"
    nothing = watched(np.full((30, 4), np.nan))
    assert nothing.alarms == []
    assert nothing.changes.why_not


@pytest.mark.parametrize(
    ("value", "limit", "words"),
    [
        (0.6, 0.7, "at 60 %"),
        (0.6996, 0.7, "at 69.96 %"),
        (0.7, 0.7, "at 70.000 %"),
        (3.65, 1.25, "at 365 %"),
        (1.52e6, 1.25, "at over 1000 %"),  # no suspension has this level
    ],
)
def test_level_is_distinguished_from_its_limit(value, limit, words):
    assert level_words(value, limit) == words


def test_detector_names_what_it_takes_into_account():
    changes = Changes(covariates=("speed",), n_reference=30, n_needed=20, n_unlike=2)
    words = parts_of(detector_words(changes, SETTINGS))
    assert [one.kind for one in words] == ["armed", "covariates", "unlike-first"]
    assert (words[0].values["n_needed"], words[2].values["n"]) == (20, 2)


@pytest.mark.parametrize(
    ("last", "kinds", "level"),
    [
        ([0.795, 0.795, 0.795, 0.6], ["last-trip-beyond"], "at 60 %"),
        ([0.78, 0.77, 0.76, 0.6], ["last-trip-beyond", "act-since"], "at 60 %"),
        ([0.6, 0.6, 0.6, 0.85], ["was-beyond", "last-trip-level"], "at 60 %"),
    ],
)
def test_words_of_an_alarm_of_a_limit_give_the_present_value(last, kinds, level):
    values = np.array([1.0] * 10 + last)
    km, widths = 1e4 * np.arange(1, len(values) + 1), np.full(len(values), 0.01)
    limits = {"c_s": DEFAULT_LIMITS["c_s"]}
    (alarm,) = of_limits(watch(make_series(km, {"c_s": values}, {"c_s": widths}), limits, SETTINGS))
    assert alarm.is_open
    words = parts_of(alarm.words)
    assert [one.kind for one in words] == kinds
    assert words[0].values["level"] == level
    assert words[0].values["beyond"].values == {"limit": 70}
    if kinds[1:] == ["act-since"]:  # it began as a notice
        assert words[1].values == {"km": 140_000}
    if kinds[0] == "was-beyond":
        assert (words[0].values["km"], words[1].values["level"]) == (130_000, "at 85 %")
