"""Units as files write them, and zones and units of time."""

from __future__ import annotations

import re
from collections.abc import Mapping

from suspnet.recordings.checked_mapping import TripError
from suspnet.recordings.manifest import ACCELERATION_UNITS, SPEED_UNITS, TIME_UNITS

GRAVITY = ACCELERATION_UNITS["g"]

_SPELLINGS = {
    "acceleration": {
        1.0: ("m/s2", "m/s^2", "m/s**2", "m/s/s", "ms-2", "ms^-2", "m*s^-2", "m*s-2", "m.s-2"),
        1e-3: ("mm/s2", "mm/s^2"),
        1e-2: ("cm/s2", "cm/s^2", "gal"),
        GRAVITY: ("g", "gn", "g0", "g_n"),
        GRAVITY / 1e3: ("mg",),
    },
    "speed": {
        1.0: ("m/s", "ms-1", "m*s^-1", "mps"),
        SPEED_UNITS["km/h"]: ("km/h", "kmh", "kph", "kmph", "kmh-1", "km*h^-1"),
        0.44704: ("mph", "mi/h"),
        1852 / 3600: ("kn", "kt", "knots", "knot"),
    },
    "time": {
        1.0: ("s", "sec", "second", "seconds"),
        1e-3: ("ms", "msec", "milliseconds"),
        1e-6: ("us", "usec", "microseconds"),
        1e-9: ("ns", "nsec", "nanoseconds"),
    },
}
_SIZES = {
    kind: {spelling: size for size, names in sizes.items() for spelling in names}
    for kind, sizes in _SPELLINGS.items()
}
_STATED: Mapping[str, Mapping[str, float]] = {
    "acceleration": ACCELERATION_UNITS,
    "speed": SPEED_UNITS,
    "time": TIME_UNITS,
}


def size_of(kind: str, text: str | None) -> float | None:
    """Return the size of a unit of a file in SI; None if it is empty or not known.

    Parameters
    ----------
    kind : {"acceleration", "speed", "time"}
    text : str or None
    """
    plain = re.sub(r"[\s\[\]()]", "", text or "").replace("²", "2").replace("·", "*")
    plain = plain.replace("µ", "u").replace("μ", "u").replace("⁻", "-").replace("¹", "1")
    sizes = _SIZES[kind]
    return sizes.get(plain, sizes.get(plain.lower()))


def is_unit(text: str) -> bool:
    """Return whether a text is a known unit of acceleration, speed or time."""
    return any(size_of(kind, text) is not None for kind in _SIZES)


def unit_in_name(name: str) -> str:
    """Return the unit in the brackets at the end of a column's name; empty if there is none."""
    match = re.search(r"[\[(]([^\[\]()]+)[\])]\s*$", name)
    return match.group(1).strip() if match and is_unit(match.group(1)) else ""


def agreed_size(where: str, kind: str, stated: str | None, written: str | None) -> float:
    """Return the size in SI of the unit of a column, by the manifest or by its file.

    Raises
    ------
    TripError
        If they contradict each other, or neither says a unit that is known.
    """
    found = size_of(kind, written)
    known = _STATED[kind]
    if stated is None:
        if found is None:
            says = f"says {written!r}, which is not known" if written else "does not say it"
            raise TripError(f"{where}: `unit` is missing, and the file {says}; give {list(known)}")
        return found
    if found is not None and abs(found / known[stated] - 1) > 1e-9:
        raise TripError(
            f"{where}: `unit` says {stated!r}, its file says {written!r}; correct one, or leave "
            "`unit` out to take the file's"
        )
    return known[stated]
