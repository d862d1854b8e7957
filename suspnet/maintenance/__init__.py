"""Maintenance from a history of trips: limits, alarms, remaining life and a plan."""

from __future__ import annotations

from suspnet.ground.parameters import DEFAULT_LIMITS, Cause, Limits, Severity
from suspnet.maintenance.alarms import Acknowledgement, Alarm, Watched, alarm_table, watch
from suspnet.maintenance.change import Change, Changes, ChangeSettings, find_changes
from suspnet.maintenance.cusum import cusum, residuals, threshold
from suspnet.maintenance.forecast import remaining_lives
from suspnet.maintenance.life import Life, learn_fleet, predict_life
from suspnet.maintenance.plan import make_plan
from suspnet.maintenance.plan_inputs import Part, PlanSettings, Train
from suspnet.maintenance.schedule import Plan
from suspnet.maintenance.series import Event, Series, make_series
from suspnet.maintenance.sisters import Sister, SisterSettings, sister_alarms
from suspnet.maintenance.state import State
from suspnet.maintenance.visit_costs import Costs

__all__ = [
    "DEFAULT_LIMITS",
    "Acknowledgement",
    "Alarm",
    "Cause",
    "Change",
    "ChangeSettings",
    "Changes",
    "Costs",
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
