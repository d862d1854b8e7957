"""Figures of the pages as SVG; pages import this, and matplotlib with it, when they draw."""

import functools
from collections.abc import Sequence

from matplotlib.figure import Figure

from suspnet.runs.figures import as_svg
from suspnet.trains.history.arrays import TripResponses
from suspnet.trains.maintenance.plan import Plan
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.maintenance_figures import plan_calendar
from suspnet.trains.pages.trend import health_trend, small_trends, trend_of_state
from suspnet.trains.pages.trip_figures import response_figure


@functools.lru_cache(maxsize=4)
def calendar(plan: Plan, language: str) -> bytes:
    """Return the calendar in the current `language`, an argument for the cache alone."""
    return as_svg(plan_calendar(plan))


@functools.lru_cache(maxsize=64)
def trend(state: State, part: str, language: str) -> bytes:
    """Return the trend of all parameters or one part; `language` is for the cache alone."""
    return as_svg(_small_trends(state)[part] if part else health_trend(trend_of_state(state)))


@functools.lru_cache(maxsize=4)
def _small_trends(state: State) -> dict[str, Figure]:
    return small_trends(trend_of_state(state))


def responses(stored: Sequence[TripResponses], language: str) -> bytes:
    """Return the frequency responses of trips."""
    return as_svg(response_figure([(curves.mileage_km, curves) for curves in stored]))
