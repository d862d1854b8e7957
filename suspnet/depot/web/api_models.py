"""Types of the API's requests and answers, of which its description is made."""

from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from suspnet.ground.storage import finite_or_none

MOST_ITEMS, USUAL_ITEMS = 500, 100
"""Largest number of items of one answer, and the number unless another one is asked for."""
HIGHEST_OFFSET = 10**9
Item = TypeVar("Item")
SeverityName = Literal["act", "notice", "unknown", "none"]
ID = r"^[0-9a-f]{12}$"
"""Pattern of the name of a suspension in addresses."""


Number = Annotated[float | None, BeforeValidator(finite_or_none)]
"""A number of an answer, null where it is unknown or infinite."""
Day = Annotated[str | None, BeforeValidator(lambda text: text or None)]
"""A day of an answer, null where there is none."""


class Model(BaseModel):
    """Base of queries: unknown names are errors, and docstrings are descriptions."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Answer(BaseModel):
    """Base of answers, which take their fields from rows of more columns."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)


class Paged(Model):
    """Which part of a long list is asked for."""

    limit: Annotated[int, Field(ge=1, le=MOST_ITEMS)] = USUAL_ITEMS
    """Largest number of items."""
    offset: Annotated[int, Field(ge=0, le=HIGHEST_OFFSET)] = 0
    """Number of items that are left out at the start."""


class OfFleet(Paged):
    """Which suspensions are asked for."""

    train: str | None = None
    """Name of the train; all if it is missing."""
    severity: SeverityName | None = None
    """Severity of the suspension, of the alarm or of the part of a job; all if it is missing."""


class OfAlarms(OfFleet):
    """Which alarms are asked for."""

    acknowledged: Literal["true", "false"] | None = None
    """Whether the alarm is acknowledged; all if it is missing."""
    active: Literal["true", "false"] | None = None
    """Whether the alarm is active; all, also cleared ones, if it is missing."""


class FindingAnswer(Answer):
    """A finding, as data and as a sentence."""

    kind: str
    """Kind of the finding; empty for one that an earlier version stored as text."""
    values: dict[str, Any]
    """Values in the sentence: numbers, names, and findings in turn."""
    text: str


class PlaceAnswer(Answer):
    """Where a suspension is; texts are as in the manifests, empty if not given there."""

    id: Annotated[str, StringConstraints(pattern=ID)]
    """Name of the suspension in addresses; it stays the same."""
    vehicle: str
    train: str
    car: str
    suspension: str
    bogie: str
    side: str


class LifeAnswer(Answer):
    """Mileage until the act limit of a parameter is passed."""

    life_low_km: Number
    """10 % quantile of the mileage until the act limit [km]; null: unknown, or no end in sight."""
    life_median_km: Number
    """Median of it [km]."""
    life_high_km: Number
    """90 % quantile of it [km]."""


class SuspensionAnswer(PlaceAnswer, LifeAnswer):
    """A suspension with its verdict."""

    severity: SeverityName
    parameters: list[str]
    """Parameters of the worst severity."""
    findings: list[FindingAnswer]
    """`reason` as data."""
    reason: str
    sensors: str
    """Sensors that are dead on the newest trip, and those with an alarm; empty if none."""
    n_alarms: int
    """Number of active alarms."""
    life_parameter: str
    """Parameter that may pass its act limit first; empty if none is known."""
    last_mileage_km: Number
    """Mileage of the newest trip with an estimate [km]."""
    n_trips: int
    n_estimated: int
    n_flagged: int


class PartAnswer(LifeAnswer):
    """A parameter, or a part of a bogie where each is read; values are in % of healthy."""

    parameter: str
    part: str
    """The part as a depot calls it."""
    severity: SeverityName
    findings: list[FindingAnswer]
    """`reason` as data."""
    reason: str
    value_percent: Number
    """Median of the last trips; null without an estimate."""
    notice_percent: list[float] | None
    """Lower and upper limit of a notice; null without limits."""
    act_percent: list[float] | None
    """Lower and upper limit of an act; null without limits."""
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
    end_km: Number
    """Mileage of the trip that cleared it [km]; null while it is active."""
    findings: list[FindingAnswer]
    """`reason` as data."""
    reason: str
    acknowledged_by: str
    """Empty if it is not acknowledged as it is now."""
    acknowledged_at: str | None
    action: str
    """What that person is doing about it."""


class TripAnswer(Answer):
    """A trip and its estimate."""

    trip: str
    start: str
    """ISO 8601; empty if unknown."""
    mileage_km: Number
    status: str
    """ok, no estimate, or error."""
    findings: list[FindingAnswer]
    """`reason`, `flags` and `worn` as data."""
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
    speed_m_per_s: Number
    temperature_c: Number


class JobAnswer(Answer):
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
    day: Day
    """Latest day of the visit; null without one."""
    decide_by: Day
    mileage_km: Number
    """Mileage of the train at the visit [km]."""
    probability: Number
    """Probability that the act limit is passed before the visit."""


class Listed(BaseModel, Generic[Item]):
    """Some items of a list, and how new they are.

    Its fields have no docstrings: pydantic would parse them again for each kind of item.
    """

    model_config = ConfigDict(frozen=True)

    read_at: str = Field(description="When the store was read, ISO 8601.")
    complete: bool = Field(
        description="Whether alarms, remaining lives and plan cover all stored trips."
    )
    fault: str = Field(description="Why the answer may be out of date; empty if it is not.")
    total: int = Field(description="Number of items without `limit` and `offset`.")
    next_offset: int | None = Field(
        description="Offset of the following items; null if there are none."
    )
    items: list[Item]


class Problem(Answer):
    """Why a request was not answered."""

    status: int
    title: str
    detail: str
