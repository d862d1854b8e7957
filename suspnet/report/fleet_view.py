"""The fleet at one time as a depot looks at it: states, rows, sisters side by side, plan."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field
from datetime import UTC, datetime
from typing import Any

from suspnet.history.rows import BadRow
from suspnet.maintenance.alarms import Acknowledgement
from suspnet.maintenance.car_sisters import Key, of_same_car
from suspnet.maintenance.limits import Limits
from suspnet.maintenance.schedule import Plan
from suspnet.maintenance.state import State
from suspnet.report.fleet_overview import overview_rows

ID_DIGITS = 12
"""Number of hexadecimal digits of a suspension's name in an address."""


@dataclass(frozen=True, eq=False)
class FleetView:
    """The fleet at one time; nothing of it changes.

    Attributes
    ----------
    version : int
        Grows with each view of a board; 0 is the one before anything was read.
    at : datetime
        When it was made, in UTC.
    states : tuple of State
        The most severe first, then the shortest life.
    rows : list of dict
        Of ``overview_rows``, in the order of `states`.
    plan : Plan, optional
        None until remaining lives are worked out.
    cars : list of lists of int
        Places in `states` of the suspensions of each car that has several.
    keys : dict of int
        Place in `states` of each suspension by its ``address``.
    limits : mapping from vehicle to mapping from parameter to Limits
    acknowledged : mapping from vehicle and place to acknowledgements
    is_complete : bool
        Whether alarms, lives and plan are of all trips in `states`; if not, some are those of
        before, or not worked out yet.
    trouble : str
        Why the store could not be read when this was to be made anew; empty if it could.
    bad_rows : tuple of BadRow
        Rows of the store that cannot be read and are left out.
    """

    version: int = 0
    at: datetime = field(default_factory=lambda: datetime.now(UTC))
    states: tuple[State, ...] = ()
    rows: list[dict[str, Any]] = field(default_factory=list)
    plan: Plan | None = None
    cars: list[list[int]] = field(default_factory=list)
    keys: dict[str, int] = field(default_factory=dict)
    limits: Mapping[str, Mapping[str, Limits]] = field(default_factory=dict)
    acknowledged: Mapping[Key, Sequence[Acknowledgement]] = field(default_factory=dict)
    is_complete: bool = False
    trouble: str = ""
    bad_rows: tuple[BadRow, ...] = ()


def fleet_view(
    states: Sequence[State],
    limits: Mapping[str, Mapping[str, Limits]],
    acknowledged: Mapping[Key, Sequence[Acknowledgement]],
    plan: Plan | None,
    *,
    version: int = 1,
    is_complete: bool = True,
    bad_rows: Sequence[BadRow] = (),
) -> FleetView:
    """Return the view of a fleet.

    Parameters
    ----------
    states : sequence of State
        The most severe first.
    limits, acknowledged, plan, version, is_complete, bad_rows
        As in ``FleetView``.
    """
    places = {id(state.series): i for i, state in enumerate(states)}
    cars = of_same_car([state.series for state in states])
    return FleetView(
        version=version,
        states=tuple(states),
        rows=overview_rows(states, acknowledged),
        plan=plan,
        cars=[[places[id(one)] for one in car] for car in cars],
        keys={address(state.key): i for i, state in enumerate(states)},
        limits=limits,
        acknowledged=acknowledged,
        is_complete=is_complete,
        bad_rows=tuple(bad_rows),
    )


def address(key: Key) -> str:
    """Return the name of a suspension in an address: a part of a hash of vehicle and place."""
    vehicle, place = key
    content = json.dumps([vehicle, *astuple(place)])
    return hashlib.sha256(content.encode()).hexdigest()[:ID_DIGITS]
