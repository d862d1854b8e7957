"""Manifests of trips: where each accelerometer is stored, in which unit and at which rate.

The fields of the dataclasses are the keys of the YAML file, documented by their metadata.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

from suspnet.ground.findings import Finding, of
from suspnet.ground.parameters import DIRECTIONS, ENDS, ESTIMATED, SIDES
from suspnet.ground.records import HIGHEST_KM, MOST_NAME, Place
from suspnet.trains.recordings import manifest_sources as check
from suspnet.trains.recordings.errors import TripError, all_of
from suspnet.trains.recordings.manifest_sources import (
    MIDDLE,
    OTHER_AXLE,
    SPEED_UNITS,
    FileSource,
    ManifestKey,
    Pair,
    SensorSource,
    Several,
    SpeedSource,
    Value,
    key,
    keys_of,
    optional,
    partner_of,
    required,
)
from suspnet.vehicle.quantities import LEAST_SENSORS

FORMAT = "suspnet-trip-1"
RECORD_FORMAT = "suspnet-record-1"  # format of a record of a rig, which does not travel
CHANNELS = ("axle_box", "bogie", "body")
"""The three vertical accelerometers, in the order of every array of signals."""
RIG_CHANNELS = ("base", "frame", "body")  # the three accelerometers of a rig, likewise
NAME = f"text, at most {MOST_NAME} characters"  # type of the names in a manifest
TEMPERATURES_C = (-60.0, 60.0)  # lowest and highest plausible outside temperature, [°C]
_CONSTANT_SPEED = re.compile(r"([1-9]\d{0,2}(?:\.\d+)?) *(m/s|km/h)")
"""Pattern of a constant speed with its unit, such as 252 km/h."""


def _speed(value: Value) -> float | SpeedSource:
    content = value.content
    if isinstance(content, str) and (match := _CONSTANT_SPEED.fullmatch(content.strip())):
        return float(match[1]) * SPEED_UNITS[match[2]]
    if isinstance(content, dict):
        return check.mapping_of(SpeedSource)(value)
    rule = "a number of m/s > 0, one with its unit (252 km/h), or a mapping with `file`"
    return check.number(rule, check.POSITIVE)(value)


def _sensor(value: Value) -> SensorSource:
    keys = keys_of(SensorSource)
    if value.name.startswith(f"channels.{CHANNELS[2]}"):
        del keys["axle"]
    return SensorSource(**value.read(keys))


def _sensors(value: Value) -> SensorSource | Several:
    if not isinstance(value.content, list):
        return _sensor(value)
    n = len(value.content)
    sensors: list[SensorSource] = all_of(partial(_sensor, value.at(i)) for i in range(n))
    if n == 1:
        return sensors[0]
    axles = [[i for i in range(n) if (sensors[i].axle or 1) == axle] for axle in (1, 2)]
    if not sensors or max(map(len, axles)) > 2:
        kind = "one-or-two-an-axle" if n > 2 and axles[1] else "one-or-two"
        raise TripError.at(value.path, kind, name=value.name, n=n)
    several: list[SensorSource] = []
    for places in axles:
        placed = [sensors[i] for i in places]
        several += placed if len(placed) < 2 else _pair(value, places, placed)
    return tuple(several)


def _pair(value: Value, places: Sequence[int], both: Sequence[SensorSource]) -> Pair:
    """Return two sensors, left first, whose missing sides are inferred: the first is left."""
    left, right = SIDES
    for place, sensor in zip(places, both, strict=True):
        if sensor.side == MIDDLE:
            check.one_of(SIDES)(value.at(place).at("side"))
    first, second = (sensor.side for sensor in both)
    first = first or (left if second != left else right)
    second = second or (left if first == right else right)
    if first == second:
        kind = "two-on-left" if first == left else "two-on-right"
        raise TripError.at(value.path, kind, name=value.name)
    pair = replace(both[0], side=first), replace(both[1], side=second)
    return pair if first == left else (pair[1], pair[0])


def _channels(value: Value) -> dict[str, SensorSource | Several]:
    """Return the sensors of each channel; one without any at axle 1 if the parts can be read."""
    channels = check.mapping_from(CHANNELS, _sensors, default="")(value)
    several = {name: _as_several(sources) for name, sources in channels.items()}
    if sum(map(len, several.values())) < LEAST_SENSORS:
        all_of(partial(_check_first_axle, value.at(name), several.get(name)) for name in CHANNELS)
    return channels


def _as_several(sources: SensorSource | Several) -> Several:
    return (sources,) if isinstance(sources, SensorSource) else sources


def _check_first_axle(value: Value, sources: Several | None) -> None:
    if sources is None:
        raise TripError.at(value.path, "channel-missing", name=value.name)
    if sources[0].is_elsewhere:
        raise TripError.at(value.path, "axle-2-only", name=value.name, least_sensors=LEAST_SENSORS)


_lowest, _highest = TEMPERATURES_C
_temperature = check.number(
    Finding("number-between", temperatures_c=_lowest, temperatures_c2=_highest), *TEMPERATURES_C
)


def _mileage(value: Value) -> float:
    mileage = check.number("a number >= 0", 0.0)(value)
    if mileage > HIGHEST_KM:
        raise value.refuse(Finding("mileage-rule", highest_km=HIGHEST_KM))
    return mileage


@dataclass(frozen=True, kw_only=True)
class TripManifest:
    """One trip: a recording of accelerometers at three places and the speed.

    Its keys are those of the table in docs/recordings.md. `path` is the YAML file, `name` its name
    without suffix. `start` is the zero of the trip's clock if only some sources have absolute
    times. A constant `speed` is in m/s. `channels` has one sensor or several for ``CHANNELS``.
    """

    shortest_s: ClassVar[float] = 60.0  # shortest length of a recording, [s]
    path: Path
    name: str
    vehicle: str = required(check.name, NAME, "name of the vehicle, as the model's")
    suspension: str = required(
        check.name, NAME, "name of the suspension; trips with the same name are of one suspension"
    )
    bogie: str | None = optional(
        check.one_of(ENDS),
        "`leading`, `trailing`",
        "bogie, as seen when the vehicle runs forward; chooses the models of that bogie",
        default="not given",
    )
    axle: str | None = optional(
        check.one_of(ENDS),
        "`leading`, `trailing`",
        "axle of that bogie which its sensors are at, likewise; those at the other one say "
        "`axle: 2`",
        default="not given",
    )
    side: str | None = optional(
        check.one_of(SIDES),
        "`left`, `right`",
        "side of the suspension, to distinguish suspensions of one name; single sensors are on "
        "it, too",
        default="not given",
    )
    direction: Literal["forward", "reverse"] | None = optional(
        check.one_of(DIRECTIONS),
        "`forward`, `reverse`",
        "direction of travel: forward if the leading bogie runs ahead",
        default="found from the phases, if they show it",
    )
    train: str | None = optional(
        check.name, NAME, "train, if several are monitored", default="not given"
    )
    car: str | None = optional(check.name, NAME, "car of the train", default="not given")
    mileage_km: float = required(
        _mileage, "number, 0 to 2e7", "mileage of the vehicle at this trip", "km"
    )
    start: datetime | None = optional(
        check.start,
        "time, `2015-08-03T08:00:00`",
        "date of the trip, from 1990 until today; also the start of sources without dates, see "
        "[clocks](#clocks)",
        default="by the files",
    )
    temperature_c: float | None = optional(
        _temperature,
        "number, -60 to 60",
        "outside air temperature; damping is compared at that of the healthy trips",
        "°C",
        "none",
    )
    wheel_diameter_m: float | None = optional(
        check.number("a number from 0.2 to 2", 0.2, 2.0),
        "number, 0.2 to 2",
        "diameter of the measured wheelset's wheels within 2 %, to find wheels out of round",
        "m",
        "searched from 0.76 to 0.92 m",
    )
    speed: float | SpeedSource = required(
        _speed,
        "number above 0, also with its unit (`252 km/h`), or a source",
        "the constant speed, or where it is stored",
        "m/s",
    )
    channels: Mapping[str, SensorSource | Several] = required(
        _channels, "mapping", "`axle_box`, `bogie` and `body`: each a source, or a list of them"
    )
    truth: dict[str, float] = field(
        default_factory=dict,
        metadata=key(
            check.mapping_from(ESTIMATED, check.positive, default=""),
            "mapping of numbers above 0",
            "of simulated trips: true `k_p`, `c_p`, `k_s`, `c_s`, `M_s`; errors are printed",
            "healthy = 1",
            "none",
        ),
    )

    @property
    def place(self) -> Place:
        """The suspension of the trip."""
        named = (self.bogie, self.side, self.train, self.car)
        return Place(self.suspension, *(name or "" for name in named))

    def side_of(self, channel: SensorSource) -> str | None:
        """Return the side of a single sensor: its own or else the suspension's; None if unknown."""
        return channel.side or self.side

    def is_pair(self, channel: str) -> bool:
        """Return whether a channel has a sensor left and right at axle 1."""
        sources = self.channels.get(channel)
        return isinstance(sources, tuple) and not any(sensor.is_elsewhere for sensor in sources[:2])

    @property
    def unplaced(self) -> tuple[str, ...]:
        """Names of the single sensors of unknown side, which are assumed to be in the middle."""
        return tuple(
            name
            for name, sensor in self.sensors().items()
            if not partner_of(name) and self.side_of(sensor) is None
        )

    def sensors(self) -> dict[str, SensorSource]:
        """Return all sensors by name.

        That of the channel is followed by ``OTHER_AXLE`` if the sensor is there, and by the side in
        a pair.
        """
        sensors: dict[str, SensorSource] = {}
        for channel, sources in self.channels.items():
            for is_elsewhere in (False, True):
                place = f"{channel} {OTHER_AXLE}" if is_elsewhere else channel
                both = [s for s in _as_several(sources) if s.is_elsewhere == is_elsewhere]
                if len(both) == 1:
                    sensors[place] = both[0]
                else:
                    sensors |= {f"{place} {sensor.side}": sensor for sensor in both}
        return sensors

    def sources(self) -> dict[str, FileSource]:
        """Return all sensors, and the speed if it is recorded, by name."""
        speed = {"speed": self.speed} if isinstance(self.speed, SpeedSource) else {}
        return {**self.sensors(), **speed}

    def where(self, name: str) -> str:
        """Return file and source, as errors name them."""
        return of(self.path, "`speed`" if name == "speed" else Finding("channel", name=repr(name)))

    def file_of(self, source: FileSource) -> Path:
        """Return the path of a channel's or the speed's data file."""
        return self.path.parent / source.file


_FORMAT = ManifestKey(check.one_of([FORMAT]), "text", f"`{FORMAT}`")
MANIFEST = {"format": _FORMAT} | keys_of(TripManifest)
"""All keys of a manifest, by name."""


@dataclass(frozen=True, kw_only=True)
class RecordManifest(TripManifest):
    """One record of a rig, which stands: its `channels` are a sensor for each ``RIG_CHANNELS``."""

    shortest_s: ClassVar[float] = 1.0
    suspension: str = "rig"
    mileage_km: float = float("nan")
    speed: float = 0.0


_SHARED = ("start", "temperature_c", "truth")
RECORD = {
    "format": ManifestKey(check.one_of([RECORD_FORMAT]), "text", f"`{RECORD_FORMAT}`"),
    "vehicle": ManifestKey(check.name, NAME, "name of the rig, as the model's"),
    "channels": ManifestKey(
        check.mapping_from(RIG_CHANNELS, check.mapping_of(SensorSource)),
        "mapping",
        "`base`, `frame` and `body`: the source of each",
    ),
} | {name: MANIFEST[name] for name in _SHARED}
"""All keys of the manifest of a record, by name."""
