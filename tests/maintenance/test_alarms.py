"""Alarms and acknowledgements: which one is of which, and what is refused."""

import math

import pytest

from suspnet.ground.parameters import Cause, Severity
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, newest_of

AT = "2026-11-22T13:00:00+00:00"


def seen(at_km=5e4, severity=Severity.NOTICE, **fields):
    fields = {"parameter": "k_p", "cause": Cause.CHANGE, "by": "Kim", "at": AT} | fields
    return Acknowledgement(severity=severity, at_km=at_km, **fields)


def alarm(begin_km=4e4, end_km=math.nan, severity=Severity.NOTICE):
    return Alarm("k_p", Cause.CHANGE, severity, begin_km, end_km)


def test_values_of_a_store_become_those_of_the_types():
    stored = Alarm("k_p", "limit", 3, 1.0)
    assert (stored.cause, stored.severity, stored.is_open) == (Cause.LIMIT, Severity.ACT, True)
    assert not alarm(end_km=4e4).is_open


@pytest.mark.parametrize(
    ("acknowledgement", "of_alarm", "expected"),
    [
        (seen(), alarm(), True),
        (seen(4e4), alarm(), True),
        (seen(), alarm(5.1e4), False),
        (seen(), alarm(end_km=5e4), True),
        (seen(), alarm(end_km=4.9e4), False),
        (seen(), alarm(severity=Severity.ACT), False),
        (seen(severity=Severity.ACT), alarm(), True),
        (seen(parameter="c_p"), alarm(), False),
        (seen(cause=Cause.LIMIT), alarm(), False),
    ],
)
def test_an_acknowledgement_covers_its_alarm_until_it_is_worse(acknowledgement, of_alarm, expected):
    assert acknowledgement.covers(of_alarm) is expected


def test_the_newest_acknowledgement_of_an_alarm_is_found_across_zones():
    first = seen(at="2026-11-22T13:00:00+02:00")
    later = seen(at="2026-11-22T12:00:00+00:00")
    other = seen(at="2026-11-23T12:00:00+00:00", parameter="c_p")
    assert newest_of(alarm(), [first, later, other]) is later
    assert newest_of(alarm(severity=Severity.ACT), [first, later, other]) is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"at_km": math.nan}, "needs a mileage"),
        ({"by": " "}, "name of a person"),
        ({"at": "yesterday"}, "ISO 8601 with its zone, got 'yesterday'"),
        ({"at": "2026-11-22T13:00:00"}, "with its zone"),
    ],
)
def test_an_incomplete_acknowledgement_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        seen(**fields)


@pytest.mark.parametrize(
    ("km", "message"), [((math.inf,), "mileage"), ((2.0, 1.0), "must not end before")]
)
def test_an_impossible_alarm_is_refused(km, message):
    with pytest.raises(ValueError, match=message):
        alarm(*km)
