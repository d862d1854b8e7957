"""Maintenance from a history of trips: limits, alarms, remaining life and a plan."""

from __future__ import annotations

from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Limits, Severity
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, Watched, alarm_table, watch
from suspnet.trains.maintenance.change import Change, Changes, ChangeSettings, find_changes
from suspnet.trains.maintenance.cusum import cusum, residuals, threshold
from suspnet.trains.maintenance.fleet import learn_fleet
from suspnet.trains.maintenance.life import Life, predict_life
from suspnet.trains.maintenance.plan import PlanSettings, make_plan
from suspnet.trains.maintenance.schedule import Part, Plan, Train
from suspnet.trains.maintenance.series import Event, Series, make_series
from suspnet.trains.maintenance.sisters import Sister, SisterSettings, sister_alarms
from suspnet.trains.maintenance.state import State, remaining_lives

__all__ = [
    "DEFAULT_LIMITS",
    "Acknowledgement",
    "Alarm",
    "Cause",
    "Change",
    "ChangeSettings",
    "Changes",
    "Event",
    "Life",
    "Limits",
    "Part",
    "Plan",
    "PlanSettings",
    "Series",
    "Severity",
    "Sister",
    "SisterSettings",
    "State",
    "Train",
    "Watched",
    "alarm_table",
    "cusum",
    "find_changes",
    "learn_fleet",
    "make_plan",
    "make_series",
    "predict_life",
    "remaining_lives",
    "residuals",
    "sister_alarms",
    "threshold",
    "watch",
]
