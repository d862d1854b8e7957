"""Sources in the manifest of a trip: where accelerometers and the speed are stored, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from suspnet.ground.parameters import SIDES
from suspnet.trains.recordings import manifest_keys as check
from suspnet.trains.recordings.manifest_keys import CsvDialect, key, optional, required

ACCELERATION_UNITS = {"m/s2": 1.0, "g": 9.80665}
"""Size of each unit in m/s2."""
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6}
"""Size of each unit in m/s."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Size of each unit in s."""
UNITS = {"acceleration": ACCELERATION_UNITS, "speed": SPEED_UNITS, "time": TIME_UNITS}
"""Units of each kind, the SI unit first."""
MIDDLE = "middle"
"""Side of a single sensor midway between left and right, or of the mean of both."""
OTHER_AXLE = "axle2"
"""Word in the names of sensors at the other axle of the bogie."""
_IN_FILE = "from the file"


def _unit(units: Mapping[str, float]) -> Any:
    return optional(
        check.one_of(list(units)),
        "`m/s2`, `g`; of the speed `m/s`, `km/h`",
        "unit of the values",
        default=_IN_FILE,
    )


@dataclass(frozen=True)
class FileSource:
    """Where and how one measured quantity is stored; `kind` is one of ``UNITS``."""

    kind: ClassVar[str] = "acceleration"
    file: str = required(check.text, "text", "a file of one of the [formats](#files)")
    unit: str | None = _unit(ACCELERATION_UNITS | SPEED_UNITS)
    column: str | None = optional(
        check.text, "text", "column, variable or channel of the file", default="the only one"
    )
    rate_hz: float | None = optional(
        check.positive,
        "number above 0",
        "sampling rate; with `time`, both must agree within 1 %",
        "Hz",
        _IN_FILE,
    )
    time: str | None = optional(
        check.text, "text", "column of times, instead of `rate_hz` or as well", default=_IN_FILE
    )
    start_s: float = field(
        default=0.0,
        metadata=key(
            check.number(),
            "number",
            "time of the first sample on the trip's clock; with `time`, an offset added to it",
            "s",
            "0",
        ),
    )
    time_unit: str | None = optional(
        check.one_of(list(TIME_UNITS)),
        "`s`, `ms`, `us`, `ns`",
        "unit of times that are numbers",
        default="from the file, else detected",
    )
    time_zone: str | None = optional(
        check.zone,
        "text",
        'zone of time stamps without one: `UTC`, `"+02:00"`, `Europe/Berlin`',
        default="unknown",
    )
    csv: CsvDialect | None = optional(
        check.mapping_of(CsvDialect),
        "mapping",
        "how a CSV file is written, below",
        default="detected",
    )

    @property
    def si_size(self) -> float:
        """Size of the stated unit in the SI unit, which is assumed without one."""
        return 1.0 if self.unit is None else UNITS[self.kind][self.unit]


@dataclass(frozen=True)
class SpeedSource(FileSource):
    """Where the speed of the train is stored."""

    kind: ClassVar[str] = "speed"
    unit: str | None = _unit(SPEED_UNITS)


@dataclass(frozen=True)
class SensorSource(FileSource):
    """Where one accelerometer is stored."""

    unit: str | None = _unit(ACCELERATION_UNITS)
    sign: int = field(
        default=1,
        metadata=key(
            check.either(1, -1),
            "1 or -1",
            "-1 for a sensor that is mounted upside down",
            default="1",
        ),
    )
    range: float | None = optional(
        check.positive,
        "number above 0",
        "largest magnitude that the sensor can measure, to detect saturation",
        "the channel's",
        "unknown",
    )
    side: str | None = optional(
        check.one_of([*SIDES, MIDDLE]),
        "`left`, `right`; `middle` for a single sensor",
        "side of a sensor",
        default="the first is left; the suspension's",
    )
    axle: int | None = optional(
        check.either(1, 2),
        "1 or 2",
        "axle of a sensor on `axle_box` or `bogie`; [each part](parts.md) is read with those of "
        "the bogie's other axle, 2, too",
        default="1",
    )

    @property
    def is_elsewhere(self) -> bool:
        """Whether the sensor is at the other axle of the bogie."""
        return self.axle == 2


Several = tuple[SensorSource, ...]
"""Accelerometers of one channel, those of axle 1 first, the left one of a pair first."""
Pair = tuple[SensorSource, SensorSource]
"""Two accelerometers at one place, the left one first."""


def partner_of(name: str) -> str:
    """Return the name of the other sensor of a pair; empty for a single sensor.

    >>> partner_of("bogie left"), partner_of("axle_box axle2 right"), partner_of("bogie axle2")
    ('bogie right', 'axle_box axle2 left', '')
    """
    place, _, side = name.rpartition(" ")
    return f"{place} {SIDES[side == SIDES[0]]}" if side in SIDES else ""


def channel_of(name: str) -> str:
    """Return the channel to which a sensor belongs; empty for one at the bogie's other axle.

    >>> channel_of("bogie left"), channel_of("bogie axle2")
    ('bogie', '')
    """
    channel, *where = name.split()
    return "" if OTHER_AXLE in where else channel
