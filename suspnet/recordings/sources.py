"""One source of a trip, open for reading: unit, rate and times by its file and the manifest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.ground.types import FloatArray
from suspnet.recordings.checked_mapping import TripError
from suspnet.recordings.clocks import Times, Zero, header_date
from suspnet.recordings.columns import Column, OpenFile, choose
from suspnet.recordings.formats import open_file, read_columns
from suspnet.recordings.manifest import Channel, Source, TripManifest
from suspnet.recordings.units import agreed_size, size_of

RATE_TOLERANCE = 1e-4
"""Largest relative difference of a stated rate from that in the header of a file."""

WHOLE_HZ = 0.5
"""Largest difference [Hz] from a rate that the format keeps as a whole number."""


@dataclass(frozen=True)
class OpenSource:
    """A source that is open for reading.

    Attributes
    ----------
    size : float
        Of its unit in SI; -1 turns a sensor. Of integers that are fractions of full scale, what
        full scale is.
    rate_hz : float or None, [Hz]
        As stated; None if only its times say it.
    times : Times or None
        Those of its blocks; None if it is evenly sampled from `zero` on.
    zero : Zero
        With `times`, known after the first block.
    full_scale : float or None, [m/s2]
        Largest magnitude of an acceleration.
    words : str
        How its file is read.
    """

    path: Path
    file: OpenFile
    names: tuple[str, ...]
    size: float
    rate_hz: float | None
    times: Times | None
    stated: Zero
    full_scale: float | None
    words: str

    @property
    def zero(self) -> Zero:
        """What its times are counted from."""
        if self.times is None:
            return self.stated
        return replace(self.times.zero, date=self.stated.date)

    def blocks(self) -> Iterator[tuple[FloatArray, ...]]:
        """Yield times [s], if it has any, and values in its own unit."""
        for block in read_columns(self.path, self.file, self.names):
            if self.times is None:
                yield block
            else:
                yield self.times.seconds(block[0]), block[1]


@contextmanager
def open_source(
    manifest: TripManifest, source: Source, where: str, kind: str
) -> Iterator[OpenSource]:
    """Open a channel or the speed of a trip.

    Parameters
    ----------
    manifest : TripManifest
    source : Source
    where : str
        Named in errors.
    kind : {"acceleration", "speed"}

    Raises
    ------
    TripError
        If its file cannot be read or contradicts the manifest, or unit or rate are not known.
    """
    path = manifest.file_of(source)
    with open_file(path, source.csv) as file:
        name = _value_column(path, file, source)
        column = file.column(name)
        if column.is_time:
            raise TripError(f"{path}: column {name!r} holds time stamps, not numbers")
        rate_hz = _agreed_rate(where, source.rate_hz, column)
        time = source.time or column.time
        if time is None and rate_hz is None:
            stamps = [one.name for one in file.columns if one.is_time]
            time = stamps[0] if len(stamps) == 1 else None
        if time is None and rate_hz is None:
            raise TripError(
                f"{where} needs `rate_hz` or `time` (a column): {path.name} does not say the rate"
            )
        size, words = _size(where, kind, source, column)
        full_scale = getattr(source, "range", None)
        if full_scale is not None:
            full_scale = abs(size) * (1.0 if column.full_scale is not None else full_scale)
        times = None
        if time is not None:
            choose(path, file, [time])
            times = Times(where, source, file.column(time), column.start_ns)
        elif source.time_unit is not None or source.time_zone is not None:
            raise TripError(f"{where}: `time_unit` and `time_zone` are for a column of `time`")
        yield OpenSource(
            path,
            file,
            (name,) if time is None else (time, name),
            size,
            rate_hz,
            times,
            Zero(column.start_ns, is_stated=True, date=header_date(column)),
            full_scale,
            "; ".join(part for part in (file.words, words) if part),
        )


def _value_column(path: Path, file: OpenFile, source: Source) -> str:
    """Return the name of the column of values."""
    if source.time is None:
        return choose(path, file, [source.column])[0]
    return choose(path, file, [source.time, source.column])[1]


def _agreed_rate(where: str, stated_hz: float | None, column: Column) -> float | None:
    """Return the rate by the manifest or else by the file; TripError if they differ."""
    found_hz = column.rate_hz
    if stated_hz is None or found_hz is None:
        return stated_hz or found_hz
    most = max(RATE_TOLERANCE * found_hz, WHOLE_HZ if column.is_whole_rate else 0)
    if abs(stated_hz - found_hz) > most:
        raise TripError(
            f"{where}: `rate_hz` says {stated_hz:.9g} Hz, its file says {found_hz:.9g} Hz; correct "
            "it, or leave `rate_hz` out to take the file's"
        )
    return stated_hz


def _size(where: str, kind: str, source: Source, column: Column) -> tuple[float, str]:
    """Return what values are multiplied with, and words where the file's unit is not known."""
    size = agreed_size(where, kind, source.unit, column.unit)
    words = ""
    if column.unit and size_of(kind, column.unit) is None:
        words = f"{column.name!r} is taken in {source.unit}, its file says {column.unit!r}"
    if column.full_scale is not None:
        if not isinstance(source, Channel) or source.range is None:
            raise TripError(
                f"{where}: {column.name!r} holds integers, which are fractions of full scale; give "
                "`range`, what full scale is in its `unit`, or write the file as floats"
            )
        size *= source.range
    return size * (source.sign if isinstance(source, Channel) else 1), words


def zero_of(manifest: TripManifest, source: Source, where: str, kind: str = "acceleration") -> Zero:
    """Return what the times of a source are counted from; TripError if it cannot be read."""
    with open_source(manifest, source, where, kind) as opened:
        if opened.times is not None:
            for times in read_columns(opened.path, opened.file, opened.names[:1]):
                opened.times.seconds(times[0])
                break
        return opened.zero
