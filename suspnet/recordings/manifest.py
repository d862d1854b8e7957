"""Manifests of trips: where each accelerometer is stored, in which unit and at which rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from suspnet.ground.records import Place
from suspnet.recordings.checked_mapping import TripError

__all__ = [
    "ACCELERATION_UNITS",
    "BOGIES",
    "CHANNELS",
    "DELIMITERS",
    "FORMAT",
    "MIDDLE",
    "SIDES",
    "SPEED_UNITS",
    "TIME_UNITS",
    "Channel",
    "CsvDialect",
    "Pair",
    "Source",
    "SpeedSource",
    "TripError",
    "TripManifest",
]

FORMAT = "suspnet-trip-1"

CHANNELS = ("axle_box", "bogie", "body")
"""The three vertical accelerometers, in the order of every array of signals."""

ACCELERATION_UNITS = {"m/s2": 1.0, "g": 9.80665}
"""Size of each unit in m/s2."""

SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6}
"""Size of each unit in m/s."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Size of each unit in s."""

DELIMITERS = {",": ",", ";": ";", "tab": "\t", "space": " ", "|": "|"}
"""Delimiters of CSV files by their names in manifests; "space" is any number of blanks."""

BOGIES = ("leading", "trailing")
"""Bogies of a vehicle, in the direction of travel."""

SIDES = ("left", "right")
"""Sides of a vehicle, in the direction of travel."""

MIDDLE = "middle"
"""Side of a single sensor between left and right, or of the mean of both."""


TEMPERATURES_C = (-60.0, 60.0)
"""Temperatures outside that a train meets [°C]."""


@dataclass(frozen=True)
class CsvDialect:
    """How a CSV file is written; None is found out.

    Parameters
    ----------
    delimiter : str, optional
        One of the values of ``DELIMITERS``.
    decimal : {".", ","}, optional
    header_line : int, optional
        Line of the names of the columns, counted from 1; 0 if there are none, and the columns are
        "column_1" and so on.
    encoding : str, optional
        As Python names it.
    """

    delimiter: str | None = None
    decimal: str | None = None
    header_line: int | None = None
    encoding: str | None = None


@dataclass(frozen=True)
class Source:
    """Where one measured quantity is stored.

    Parameters
    ----------
    file : str
        Absolute, or relative to the manifest's folder.
    unit : str, optional
        One of ``ACCELERATION_UNITS``, or for the speed of ``SPEED_UNITS``; None: the file says it.
    column : str, optional
        Column, MAT or HDF5 variable, or TDMS "group/channel"; None if the file has only one.
    rate_hz : float, optional, [Hz]
        Sampling rate. If `time` is given too, the two must agree within 1 %. Without both, the
        file says the rate.
    time : str, optional
        Name of a column of times: numbers, or time stamps; a time step may be missing there, and
        is then a gap.
    start_s : float, [s]
        Time of the first sample on the trip's clock; with `time`, what is added to those times.
    time_unit : str, optional
        Unit of the numbers in `time`, one of ``TIME_UNITS``; None: the file says it, or they are
        so large that they must be counted from 1970, or they are seconds.
    time_zone : str, optional
        Zone of time stamps that name none: "UTC", "+02:00" or "Europe/Berlin".
    csv : CsvDialect, optional
    """

    file: str
    unit: str | None = None
    column: str | None = None
    rate_hz: float | None = None
    time: str | None = None
    start_s: float = 0.0
    time_unit: str | None = None
    time_zone: str | None = None
    csv: CsvDialect | None = None


@dataclass(frozen=True)
class SpeedSource(Source):
    """Place where the speed of the train is stored."""


@dataclass(frozen=True)
class Channel(Source):
    """Where one accelerometer is stored.

    Parameters
    ----------
    sign : int
        -1 turns a sensor that was mounted upside down.
    range : float, optional, [unit]
        Largest magnitude that the sensor can give.
    side : str, optional
        One of ``SIDES``; each sensor of a pair has one. A single sensor may be in the ``MIDDLE``.
    """

    sign: int = 1
    range: float | None = None
    side: str | None = None


Pair = tuple[Channel, Channel]
"""Two accelerometers at one place, the left one first."""


@dataclass(frozen=True)
class TripManifest:
    """One trip: a recording of accelerometers at three places and the speed.

    Parameters
    ----------
    path : Path
        The YAML file.
    name : str
        The file's name without its suffix.
    vehicle, suspension : str
        Which vehicle, and which of its suspensions, in free text.
    mileage_km : float, [km]
    start : datetime or None
        Zero of the trip's clock, where some sources have absolute times and others have not.
    speed : float, [m/s], or SpeedSource
    channels : dict of Channel, or of Pair
        One sensor, or one on the left and one on the right, for each of ``CHANNELS``.
    truth : dict of float, [-]
        Known values of a simulated trip relative to healthy; keys from ``PARAMETERS``.
    bogie, side : str, optional
        One of ``BOGIES`` and one of ``SIDES``; None where it is not said.
    train, car : str, optional
        In free text.
    temperature_c : float, optional, [°C]
        Of the air outside, along the trip.
    """

    path: Path
    name: str
    vehicle: str
    suspension: str
    mileage_km: float
    start: datetime | None
    speed: float | SpeedSource
    channels: Mapping[str, Channel | Pair]
    truth: dict[str, float] = field(default_factory=dict)
    bogie: str | None = None
    side: str | None = None
    train: str | None = None
    car: str | None = None
    temperature_c: float | None = None

    @property
    def place(self) -> Place:
        """Which suspension the trip is of."""
        named = (self.bogie, self.side, self.train, self.car)
        return Place(self.suspension.strip(), *(one or "" for one in named))

    def side_of(self, channel: Channel) -> str | None:
        """Return the side of a single sensor: its own or else the suspension's, if one is said."""
        return channel.side or self.side

    @property
    def unplaced(self) -> tuple[str, ...]:
        """Names of the single sensors whose side is not said; they are taken as in the middle."""
        singles = {n: one for n, one in self.channels.items() if isinstance(one, Channel)}
        return tuple(name for name, one in singles.items() if self.side_of(one) is None)

    def sensors(self) -> dict[str, Channel]:
        """Return every sensor by its name: the channel's, followed by the side in a pair."""
        found: dict[str, Channel] = {}
        for name, channel in self.channels.items():
            if isinstance(channel, Channel):
                found[name] = channel
            else:
                found |= {f"{name} {one.side}": one for one in channel}
        return found

    def file_of(self, source: Source) -> Path:
        """Return the path of a channel's or the speed's data file."""
        return self.path.parent / source.file
