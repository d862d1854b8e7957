"""Types of the API's requests and answers, of which its description is made."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
)

from suspnet.ground.parameters import Cause
from suspnet.report.work_order import WorkOrder
from suspnet.web.access import is_plain

MOST_ITEMS, USUAL_ITEMS = 500, 100
"""Largest number of items of one answer, and the number unless another one is asked for."""
HIGHEST_OFFSET = 10**9
SeverityName = Literal["act", "notice", "unknown", "none"]
ID = r"^[0-9a-f]{12}$"
"""Pattern of the name of a suspension in addresses."""


def _number(value: Any) -> Any:
    """Return a number of a query; ValueError for what is none in JSON, as 1_000 or NaN."""
    if isinstance(value, str) and not re.fullmatch(r"-?\d+(\.\d+)?([eE][+-]?\d+)?", value, re.A):
        raise ValueError("must be a number")
    return value


def _whole(value: Any) -> Any:
    """Return a whole number of a query; ValueError for what is none, as 1.0."""
    if isinstance(value, str) and not re.fullmatch(r"-?\d{1,10}", value, re.A):
        raise ValueError("must be a whole number")
    return value


def _plain(value: str) -> str:
    if not is_plain(value):
        raise ValueError("must have no control characters")
    return value


def _plain_lines(value: str) -> str:
    if not is_plain(value, "\n\t"):
        raise ValueError("must have no control characters but newlines")
    return value


Km = Annotated[float, Field(allow_inf_nan=False), BeforeValidator(_number)]


class Model(BaseModel):
    """Base of all: unknown names are errors, and docstrings are descriptions."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        use_attribute_docstrings=True,
        json_schema_serialization_defaults_required=True,
    )


class Paged(Model):
    """Which part of a long list is asked for."""

    limit: Annotated[int, Field(ge=1, le=MOST_ITEMS), BeforeValidator(_whole)] = USUAL_ITEMS
    """Largest number of items."""
    offset: Annotated[int, Field(ge=0, le=HIGHEST_OFFSET), BeforeValidator(_whole)] = 0
    """Number of items that are left out at the start."""


class OfFleet(Paged):
    """Which suspensions are asked for."""

    train: str | None = None
    """Name of the train; all if it is missing."""
    severity: SeverityName | None = None
    """Severity of the suspension, or of the alarm or work order; all if it is missing."""


class OfAlarms(OfFleet):
    """Which alarms are asked for."""

    acknowledged: Literal["true", "false"] | None = None
    """Whether the alarm is acknowledged; all if it is missing."""
    active: Literal["true", "false"] | None = None
    """Whether the alarm is active; all, also cleared ones, if it is missing."""


class OfTrips(Paged):
    """Which trips are asked for."""

    from_km: Km | None = None
    """Lowest mileage [km]."""
    to_km: Km | None = None
    """Highest mileage [km]."""


class Nothing(Model):
    """A request without a query."""


class FoundAnswer(Model):
    """One thing that was found, as data and as a sentence."""

    kind: str
    """Which sentence it is; empty for one that an earlier version stored as text."""
    values: dict[str, Any]
    """What the sentence is about: numbers, names, and things found in turn."""
    text: str


class PlaceAnswer(Model):
    """Where a suspension is; texts are as in the manifests, empty if not given there."""

    id: Annotated[str, StringConstraints(pattern=ID)]
    """Name of the suspension in addresses; it stays the same."""
    vehicle: str
    train: str
    car: str
    suspension: str
    bogie: str
    side: str


class SuspensionAnswer(PlaceAnswer):
    """A suspension with its verdict."""

    severity: SeverityName
    parameters: list[str]
    """Parameters of the worst severity."""
    findings: list[FoundAnswer]
    """What `reason` says."""
    reason: str
    sensors: str
    """Sensors that are dead on the newest trip, and those with an alarm; empty if none."""
    n_alarms: int
    """Number of active alarms."""
    life_parameter: str
    """Parameter that may pass its act limit first; empty if none is known."""
    life_low_km: float | None
    """10 % quantile of the mileage until the act limit [km]; null: unknown, or no end in sight."""
    life_median_km: float | None
    """Median of it [km]."""
    life_high_km: float | None
    """90 % quantile of it [km]."""
    last_mileage_km: float | None
    """Mileage of the newest trip with an estimate [km]."""
    n_trips: int
    n_estimated: int
    n_flagged: int


class PartAnswer(Model):
    """A parameter, or a part of a bogie where each is read; values are in % of healthy."""

    parameter: str
    part: str
    """The part as a depot calls it."""
    severity: SeverityName
    findings: list[FoundAnswer]
    """What `reason` says."""
    reason: str
    value_percent: float | None
    """Median of the last trips; null without an estimate."""
    notice_percent: list[float] | None
    """Lower and upper limit of a notice; null without limits."""
    act_percent: list[float] | None
    """Lower and upper limit of an act; null without limits."""
    life_low_km: float | None
    """10 % quantile of the mileage until the act limit [km]; null: unknown, or no end in sight."""
    life_median_km: float | None
    """Median of it [km]."""
    life_high_km: float | None
    """90 % quantile of it [km]."""
    life_unknown: str
    """Why the remaining life is unknown; empty if it is known."""


class AlarmAnswer(PlaceAnswer):
    """An alarm, and who acknowledged it."""

    parameter: str
    cause: str
    severity: SeverityName
    active: bool
    begin_km: float
    """Mileage of the trip that raised it [km]."""
    end_km: float | None
    """Mileage of the trip that cleared it [km]; null while it is active."""
    findings: list[FoundAnswer]
    """What `reason` says."""
    reason: str
    acknowledged_by: str
    """Empty if it is not acknowledged as it is now."""
    acknowledged_at: str | None
    action: str
    """What that person is doing about it."""


class TripAnswer(Model):
    """A trip and its estimate."""

    trip: str
    start: str
    """ISO 8601; empty if unknown."""
    mileage_km: float | None
    status: str
    """ok, no estimate, or error."""
    findings: list[FoundAnswer]
    """What `reason`, `flags` and `worn` say."""
    reason: str
    """Why there is no estimate."""
    flags: str
    """Why the estimate may be wrong; empty if nothing is known against it."""
    estimates: dict[str, float]
    """Parameters relative to healthy."""
    half_widths: dict[str, float]
    """An interval is from estimate * exp(-half width) to estimate * exp(half width)."""
    worn: str
    """Which parts have worn, with odds."""
    speed_m_per_s: float | None
    temperature_c: float | None


class JobAnswer(Model):
    """Work on one part at a visit, or why a part has none."""

    train: str
    car: str
    suspension: str
    parameter: str
    part: str
    what: str
    """replace, inspect, plan again or unknown."""
    urgency: str
    severity: SeverityName
    unknown: str
    """Why its remaining life is unknown; empty if it is known."""
    day: str | None
    """Day of the visit; null without one."""
    latest: str | None
    """Last day on which the extra cost is small."""
    decide_by: str | None
    mileage_km: float | None
    """Mileage of the train at the visit [km]."""
    probability: float | None
    """Probability that the act limit is passed before the visit."""


class Listed(Model):
    """A part of a list, and how new it is."""

    read_at: str
    """When the store was read, ISO 8601."""
    complete: bool
    """Whether alarms, remaining lives and plan cover all stored trips."""
    fault: str
    """Why the answer may be out of date; empty if it is not."""
    total: int
    """Number of items without `limit` and `offset`."""
    next_offset: int | None
    """Offset of the following items; null if there are none."""


class Suspensions(Listed):
    """Suspensions, the worst first."""

    items: list[SuspensionAnswer]


class Parts(Listed):
    """Parameters or parts of a suspension."""

    items: list[PartAnswer]


class Alarms(Listed):
    """Alarms, the worst first."""

    items: list[AlarmAnswer]


class Trips(Listed):
    """Trips by mileage."""

    items: list[TripAnswer]


class Jobs(Listed):
    """Jobs of the plan."""

    items: list[JobAnswer]


class WorkOrders(Listed):
    """Work orders, those of the worst suspensions first."""

    items: list[WorkOrder]


class AcknowledgementRequest(Model):
    """An acknowledgement of an alarm as the person saw it."""

    parameter: Annotated[str, StringConstraints(min_length=1, max_length=200)]
    cause: Cause
    severity: SeverityName
    """Severity that the person saw; an alarm that is worse by now is not acknowledged."""
    by: Annotated[
        str,
        StringConstraints(min_length=1, max_length=80, pattern=r"\S"),
        AfterValidator(_plain),
    ]
    """Name of the person."""
    words: Annotated[str, StringConstraints(max_length=500), AfterValidator(_plain_lines)] = ""
    """What the person is doing about it."""


class AcknowledgementAnswer(Model):
    """What was stored."""

    parameter: str
    cause: str
    severity: SeverityName
    at_km: float
    """Mileage of the newest trip [km]."""
    by: str
    at: str
    """ISO 8601 with its zone."""
    words: str


class Problem(Model):
    """Why a request was not answered."""

    status: int
    title: str
    detail: str
