"""The estimated parameters: names, units, and directions of travel, limits and severities."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any, Literal

import numpy as np

from suspnet.ground.findings import Finding, of, together
from suspnet.ground.settings import check_number

PARAMETERS = ("k_p", "c_p", "k_s", "c_s", "M_s")
"""The parameters that may vary, in the order of every array of parameter ratios (1 = healthy)."""
SIDES = ("left", "right")  # sides of a vehicle, as it runs forward
End = Literal["leading", "trailing"]
ENDS: tuple[End, ...] = ("leading", "trailing")
"""Bogies of a vehicle, as it runs forward, and axles of a bogie."""
CORNERS = tuple(f"axle{axle}_{side}" for axle in (1, 2) for side in SIDES)
"""Corners of the measured bogie: axle 1 is that of the sensors, left as seen in the direction
forward."""
COMPONENTS = (
    *(f"{name}_{corner}" for corner in CORNERS for name in ("k_p", "c_p")),
    *(f"{name}_{side}" for side in SIDES for name in ("k_s", "c_s")),
    "M_s",
)
"""Springs and dampers of the measured bogie one by one, and the car-body mass."""
BODY_MASS = "M_s"  # name of the car-body mass, which varies with the payload from trip to trip
BOGIE_PARTS = COMPONENTS[:-1]  # the springs and dampers alone
DAMPERS = tuple(p + name for p in ("", "other_") for name in BOGIE_PARTS if name[0] == "c")
"""The dampers of the measured bogie, then those of the other one."""
ALL_PARTS = "all twelve parts"  # text for all of ``BOGIE_PARTS``
ESTIMATED = (*PARAMETERS, *BOGIE_PARTS)
"""Everything that a trip may have an estimate of: of the parameters of both sides and axles as
equal, or of each part."""


def kind_of(name: str) -> str:
    """Return the parameter of which a part is one, "k_p" of "k_p_axle1_left"; others as given."""
    return name[:3] if name in BOGIE_PARTS else name


def place_words(part: str) -> str:
    """Return where a part is: "axle 1, left" of "k_p_axle1_left", "left" of "k_s_left"."""
    return part[4:].replace("axle", "axle ").replace("_", ", ")


def part_words(name: str) -> str:
    """Return a part as a depot calls it: "damper of axle 2, left" of "c_p_axle2_left".

    Any other name is returned as given.
    """
    if name not in BOGIE_PARTS:
        return name
    kind = "damper" if name[0] == "c" else "spring"
    where = place_words(name)
    return f"{kind} of {where}" if "axle" in name else f"secondary {kind}, {where}"


def condensed(names: Iterable[str]) -> list[str]:
    """Return names, with "all twelve parts" in place of the parts if all of them are there."""
    names = list(names)
    if not set(BOGIE_PARTS) <= set(names):
        return names
    return [*(name for name in names if name not in BOGIE_PARTS), ALL_PARTS]


SI_COLUMNS = {name: f"{name}_{'ns' if name[0] == 'c' else 'n'}_per_m" for name in ESTIMATED} | {
    BODY_MASS: f"{BODY_MASS}_kg"
}
"""Columns of the parameters in SI units."""
KIND_NAMES = {
    "k_p": "stiffness of the primary spring",
    "c_p": "damping of the primary damper",
    "k_s": "stiffness of the secondary spring",
    "c_s": "damping of the secondary damper",
    BODY_MASS: "mass of the car body",
}
NAMES = KIND_NAMES | {
    part: f"{KIND_NAMES[kind_of(part)]}, {place_words(part)}" for part in BOGIE_PARTS
}
UNITS = {name: "N s/m" if name[0] == "c" else "N/m" for name in ESTIMATED} | {BODY_MASS: "kg"}
"""SI unit of each parameter."""
Direction = Literal["forward", "reverse"]
FORWARD: Direction = "forward"
"""The direction of travel in which the leading end of the vehicle runs ahead."""
REVERSE: Direction = "reverse"
DIRECTIONS: tuple[Direction, ...] = (FORWARD, REVERSE)


def direction_words(direction: Direction | None) -> str:
    """Return how a train runs, as text: "forward" or "in reverse"."""
    return "in reverse" if direction == REVERSE else "forward"


class Severity(IntEnum):
    """Urgency of a finding; the larger, the worse."""

    NONE = 0
    UNKNOWN = 1  # no judgement is possible: no estimate, or one that is too uncertain
    NOTICE = 2  # inspect the suspension at the next opportunity
    ACT = 3  # the suspension needs work

    def __str__(self) -> str:
        """Return the name in lower case, as in tables."""
        return self.name.lower()


class Cause(StrEnum):
    """Cause of an alarm."""

    LIMIT = "limit"  # a parameter is beyond a limit
    CHANGE = "change"  # a parameter has changed from its reference trips
    SENSOR = "sensor"  # a sensor differs from its first trips; the alarm's parameter is its name


@dataclass(frozen=True)
class Limits:
    """Values between which a parameter raises no alarm.

    Parameters
    ----------
    notice, act : (lower, upper), [-]
        Relative to healthy; 1 is between them, and `notice` is within `act`. Lower 0, or upper
        infinity or None, means no limit on that side.
    why : str
        The reason for these limits.

    Raises
    ------
    TypeError, ValueError
        If the pairs are invalid.
    """

    notice: tuple[float, float]
    act: tuple[float, float]
    why: str = ""

    def __post_init__(self) -> None:
        for name in ("notice", "act"):
            value = getattr(self, name)
            pair = () if isinstance(value, str | float | int) else tuple(value)
            if len(pair) != 2:
                raise TypeError(f"`{name}` must be two numbers, lower and upper, got {value}")
            pair = (pair[0], np.inf if pair[1] is None else pair[1])
            check_number(f"{name}[0]", pair[0], low=0, below=1)
            if pair[1] != np.inf:
                check_number(f"{name}[1]", pair[1], above=1)
            object.__setattr__(self, name, pair)
        if not (self.act[0] <= self.notice[0] and self.notice[1] <= self.act[1]):
            raise ValueError(f"limits `notice` {self.notice} must lie within `act` {self.act}")
        if not isinstance(self.why, str):
            raise TypeError(f"`why` must be text, got {self.why!r}")

    def __str__(self) -> str:
        """Return both pairs in % of healthy."""
        notice, act = ([100 * end for end in pair] for pair in (self.notice, self.act))
        ends = {"notice_low": notice[0], "notice_high": notice[1]}
        return Finding("limit", **ends, act_low=act[0], act_high=act[1])

    def to_dict(self) -> dict[str, Any]:
        """Return the limits as JSON-able values, with None for infinity."""
        pairs = {"notice": self.notice, "act": self.act}
        plain = {k: [low, None if high == np.inf else high] for k, (low, high) in pairs.items()}
        return plain | {"why": self.why}


SPRING = Limits(
    notice=(0.9, 1.1),
    act=(0.8, 1.25),
    why="assumed: a spring does not wear, so that 10 % off asks for a look (a wrong part, a "
    "cracked coil, a wrong pressure of an air spring); 20 % less or a quarter more is what a "
    "broken coil gives, and an emergency spring gives more",
)
DAMPER = Limits(
    notice=(0.8, 1.25),
    act=(0.7, 1.4),
    why="assumed: a damper wears and is made to wider tolerances than a spring; below 70 % it no "
    "longer does its work",
)
DEFAULT_LIMITS = {
    name: DAMPER if name[0] == "c" else SPRING for name in ESTIMATED if name != BODY_MASS
}
"""Limits of a vehicle whose file gives none. The car-body mass varies by nature."""
TIGHTEST = Limits((np.nextafter(1.0, 0.0), np.nextafter(1.0, 2.0)), (0.0, np.inf))
"""Tightest notice and widest act limits: either one is consistent with any other limit."""


def read_limits(
    wanted: Mapping[str, Any], default: Mapping[str, Limits] | None = None, why: str = ""
) -> dict[str, Limits]:
    """Return the limits of each parameter of a configuration, and of each part.

    `wanted` maps a parameter to its `notice`, `act` and `why`, or to null for no limits. `default`
    applies to missing parameters and to missing or null entries; `why` is the default reason. Those
    of a parameter such as k_p are those of each of its parts that has none of its own. The
    car-body mass varies with the payload and has no limits.
    TypeError or ValueError, which names the parameter, is raised for an invalid entry.
    """
    if not isinstance(wanted, Mapping):
        raise TypeError(f"`limits` must map parameters to their limits, got {wanted!r}")
    limits = dict(default or {})
    for name in wanted:
        if name not in ESTIMATED:
            raise ValueError(f"`limits` must be named as in {ESTIMATED}, got {name!r}")
    for name in sorted(wanted, key=ESTIMATED.index):  # parameters come before their parts
        _set_limits(name, wanted[name], limits, why)
        if _is_empty(wanted[name]):
            continue
        for part in (part for part in BOGIE_PARTS if kind_of(part) == name):
            limits.pop(part, None)
            limits |= {part: limits[name]} if name in limits else {}
    return limits


def _set_limits(name: str, entry: Any, limits: dict[str, Limits], why: str) -> None:
    """Set the limits of one parameter or part from its entry; None removes them."""
    if entry is None:
        limits.pop(name, None)
        return
    if name == BODY_MASS and not _is_empty(entry):
        raise ValueError(
            f"`limits.{name}` must be left out: the car-body mass varies with the payload and "
            "does not wear"
        )
    if isinstance(entry, Limits):
        limits[name] = entry
        return
    before = limits.get(name)
    if not isinstance(entry, Mapping) or not set(entry) <= {"notice", "act", "why"}:
        raise ValueError(f"`limits.{name}` must have `notice` and `act`, or be null: {entry}")
    values = {key: value for key, value in entry.items() if value is not None}
    if not values:
        return
    if before is None and not {"notice", "act"} <= set(values):
        raise ValueError(f"`limits.{name}` must have `notice` and `act`, or be null: {entry}")
    try:
        base = {} if before is None else {"notice": before.notice, "act": before.act}
        limits[name] = Limits(**base | {"why": why} | values)
    except (TypeError, ValueError) as error:
        raise type(error)(f"`limits.{name}`: {error}") from None


def _is_empty(entry: Any) -> bool:
    return isinstance(entry, Mapping) and all(value is None for value in entry.values())


def limits_words(limits: Mapping[str, Limits]) -> str:
    """Return limits and their reasons as text, with parameters of equal limits grouped.

    A part is named only if its limits are not those of its parameter.
    """
    alike: dict[Limits, list[str]] = {}
    for name, of_part in limits.items():
        if name == kind_of(name) or of_part != limits.get(kind_of(name)):
            alike.setdefault(of_part, []).append(name)
    parts = [
        of(
            ", ".join(names),
            Finding("with-reason", words=str(shared), reason=shared.why)
            if shared.why
            else str(shared),
        )
        for shared, names in alike.items()
    ]
    return together(parts) or "none"
