"""Maintenance from a history of trips: limits, alarms, remaining life and a plan."""

from suspnet.ground.parameters import DEFAULT_LIMITS, Limits, Severity
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, watch
from suspnet.trains.maintenance.change import ChangeSettings, find_changes
from suspnet.trains.maintenance.cusum import cusum, residuals, threshold
from suspnet.trains.maintenance.life import Life, predict_life
from suspnet.trains.maintenance.plan import Part, Plan, PlanSettings, Train, make_plan
from suspnet.trains.maintenance.series import make_series
from suspnet.trains.maintenance.state import State, with_lives

__all__ = [
    "DEFAULT_LIMITS",
    "Acknowledgement",
    "Alarm",
    "ChangeSettings",
    "Life",
    "Limits",
    "Part",
    "Plan",
    "PlanSettings",
    "Severity",
    "State",
    "Train",
    "cusum",
    "find_changes",
    "make_plan",
    "make_series",
    "predict_life",
    "residuals",
    "threshold",
    "watch",
    "with_lives",
]
