"""Channels of TDMS, MDF, UFF and WAV files, with the rates, units and times that they state."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from logging import CRITICAL, getLogger
from pathlib import Path
from threading import Lock
from traceback import walk_tb
from typing import Any, BinaryIO

import numpy as np
from scipy.io import wavfile

from suspnet.recordings.checked_mapping import TripError
from suspnet.recordings.columns import (
    BLOCK,
    Block,
    Column,
    OpenFile,
    Take,
    as_block,
    needed,
    slices,
)
from suspnet.recordings.manifest import CsvDialect

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_WAV = Lock()
"""Filters of warnings are of the process; sensors are read in threads."""

BEXT_DATE = slice(320, 338)
"""Bytes of the chunk `bext` with date and time of day, yyyy-mm-dd and hh:mm:ss."""
TIME_RESPONSE = 1
"""Function type of a time record in a data set 58 of a universal file."""


@contextmanager
def open_tdms(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a TDMS file; columns are named "group/channel"."""
    nptdms = needed(path, "nptdms", "tdms", "a TDMS file")
    getLogger("nptdms").setLevel(CRITICAL)  # it prints what it raises or mends
    # Opened here because npTDMS does not close what it fails to read.
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise TripError(f"{path} is cut off: its last segment is incomplete")
        channels = {
            f"{group.name}/{channel.name}": channel
            for group in file.groups()
            for channel in group.channels()
        }

        def read(names: Sequence[str]) -> Iterator[Block]:
            for name in names:
                kind = np.dtype(channels[name].dtype)
                if kind.kind not in "iufM":
                    raise TripError(f"{path}: column {name!r} holds {kind}, not numbers")
            takes: list[Take] = [channels[name].__getitem__ for name in names]
            return slices(path, names, [len(channels[name]) for name in names], takes)

        yield OpenFile(tuple(_tdms_column(*item) for item in channels.items()), read)


def _tdms_column(name: str, channel: Any) -> Column:
    """Return what the properties of a TDMS channel say of it."""
    properties = channel.properties
    step_s = properties.get("wf_increment")
    unit = properties.get("unit_string") or properties.get("NI_UnitDescription")
    start = properties.get("wf_start_time")
    is_time = np.dtype(channel.dtype).kind == "M"
    has_rate = isinstance(step_s, float | int) and 1e-9 < step_s < 1e9
    start_ns = None
    if has_rate and isinstance(start, np.datetime64) and not np.isnat(start):
        offset_s = float(properties.get("wf_start_offset", 0.0))
        start_ns = int(start.astype("datetime64[ns]").astype(np.int64)) + round(1e9 * offset_s)
    return Column(
        name,
        unit=str(unit) if unit else None,
        rate_hz=1 / step_s if has_rate and step_s is not None else None,
        start_ns=start_ns,
        is_time=is_time,
        is_zoned=is_time,  # LabVIEW writes time stamps in UTC
    )


@contextmanager
def open_mdf(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open an MDF file; each channel group has its own times."""
    asammdf = needed(path, "asammdf", "mdf", "an MDF file")
    getLogger("asammdf").setLevel(CRITICAL)  # it prints what it raises or mends
    with path.open("rb") as stream, _opened_mdf(asammdf, stream) as file:
        places: dict[str, tuple[int, int]] = {}
        columns: list[Column] = []
        start = file.start_time
        start = start if start.tzinfo else start.replace(tzinfo=UTC)
        start_ns = (start - EPOCH) // timedelta(microseconds=1) * 1000 if start > EPOCH else None
        repeated = _repeated(file)
        for g, group in enumerate(file.groups):
            master = file.masters_db.get(g)
            for c, channel in enumerate(group.channels):
                name = f"group_{g}/{channel.name}" if channel.name in repeated else channel.name
                places[name] = (g, c)
                time = None
                if master is not None and c != master:
                    time = group.channels[master].name
                    time = f"group_{g}/{time}" if time in repeated else time
                columns.append(
                    Column(
                        name,
                        unit=channel.unit or None,
                        time=time,
                        start_ns=start_ns if c != master else None,
                    )
                )

        def read(names: Sequence[str]) -> Iterator[Block]:
            groups = {places[name][0] for name in names}
            if len(groups) > 1:
                raise TripError(f"{path}: columns {list(names)} are not of one channel group")
            n_samples = int(file.groups[groups.pop()].channel_group.cycles_nr)
            takes = [_mdf_take(path, file, name, *places[name]) for name in names]
            return slices(path, names, [n_samples] * len(names), takes)

        yield OpenFile(tuple(columns), read)


def _opened_mdf(asammdf: Any, stream: BinaryIO) -> Any:
    """Return an MDF file that is open; ValueError if it is damaged."""
    try:
        return asammdf.MDF(stream)
    except Exception as error:
        # The destructor of what could not be opened would print a traceback.
        for frame, _ in walk_tb(error.__traceback__):
            opened = frame.f_locals.get("self")
            if opened is not None and not getattr(opened, "_closed", True):
                opened._tempfile.close()
                opened._closed = True
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _repeated(file: Any) -> set[str]:
    """Return the names that more than one channel of an MDF file has."""
    names = [channel.name for group in file.groups for channel in group.channels]
    return {name for name in names if names.count(name) > 1}


def _mdf_take(path: Path, file: Any, name: str, group: int, index: int) -> Take:
    """Return a function that reads a slice of a channel of an MDF file."""

    def take(part: slice) -> Any:
        count = part.stop - part.start
        at: dict[str, Any] = {"record_offset": part.start, "record_count": count}
        if index == file.masters_db.get(group):
            return _call(file.get_master, group, **at)
        values, invalid = _call(file.get, group=group, index=index, samples_only=True, **at)
        if values.dtype.kind not in "iufb" or values.ndim != 1:
            raise TripError(f"{path}: column {name!r} holds {values.dtype}, not numbers")
        values = values.astype(np.float64)
        if invalid is not None:
            values[np.asarray(invalid, dtype=np.bool_)] = np.nan
        return values

    return take


@contextmanager
def open_uff(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a universal file; each time record of type 58 is a column, read whole."""
    pyuff = needed(path, "pyuff", "uff", "a universal file")
    file = _call(pyuff.UFF, str(path))
    records: dict[str, int] = {}
    columns = []
    for i, kind in enumerate(_call(file.get_set_types)):
        if kind != 58:
            continue
        header = _call(file.read_sets, i, header_only=True)
        if header.get("func_type") != TIME_RESPONSE:
            continue
        name = str(header.get("id1", "")).strip()
        if not name or name.upper() == "NONE" or name in records:
            name = f"record_{i + 1}"
        records[name] = i
        step_s = float(header.get("abscissa_inc") or 0.0)
        even = header.get("abscissa_spacing") == 1 and step_s > 0
        unit = str(header.get("ordinate_axis_units_lab", "")).strip()
        date = str(header.get("id3", "")).strip() or None
        columns.append(
            Column(
                name,
                unit=None if unit.upper() in ("", "NONE") else unit,
                rate_hz=1 / step_s if even else None,
                time=None if even else f"{name}: times",
                date=date,
            )
        )
        if not even:
            columns.append(Column(f"{name}: times", is_part=True))

    def read(names: Sequence[str]) -> Iterator[Block]:
        arrays = []
        for name in names:
            is_times = name not in records
            record = _call(file.read_sets, records[name.removesuffix(": times")])
            values = np.asarray(record["x" if is_times else "data"])
            if values.dtype.kind not in "iuf":
                raise TripError(f"{path}: column {name!r} holds {values.dtype}, not real numbers")
            arrays.append(values.ravel())
        takes: list[Take] = [array.__getitem__ for array in arrays]
        return slices(path, names, [len(array) for array in arrays], takes)

    yield OpenFile(tuple(columns), read)


@contextmanager
def open_wav(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a WAV file; columns are "channel_1" and so on.

    Integers are returned as fractions of full scale.
    """
    with _WAV, warnings.catch_warnings(), path.open("rb") as stream:
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # chunks that are not of interest
        warnings.filterwarnings("error", "Reached EOF", wavfile.WavFileWarning)
        try:
            rate_hz, data = _call(wavfile.read, stream, mmap=True)
        except ValueError as error:
            if "not compatible" not in str(error):
                raise
            stream.seek(0)
            rate_hz, data = _call(wavfile.read, stream)  # 24 bits cannot be mapped to memory
    data = data[:, None] if data.ndim == 1 else data
    names = [f"channel_{i + 1}" for i in range(data.shape[1])]
    full_scale, zero = None, 0.0
    if data.dtype.kind in "iu":
        zero = 128.0 if data.dtype.kind == "u" else 0.0
        full_scale = 2.0 ** (8 * data.dtype.itemsize - 1)
    about: dict[str, Any] = {"full_scale": full_scale, "date": _bext_date(path)}
    columns = [Column(n, rate_hz=float(rate_hz), is_whole_rate=True, **about) for n in names]

    def read(chosen: Sequence[str]) -> Iterator[Block]:
        places = [names.index(name) for name in chosen]
        for start in range(0, len(data), BLOCK):
            block = as_block(data[start : start + BLOCK])
            block = block if full_scale is None else (block - zero) / full_scale
            yield tuple(np.ascontiguousarray(block[:, i]) for i in places)

    yield OpenFile(tuple(columns), read)


def _bext_date(path: Path) -> str | None:
    """Return the date of origin in a broadcast WAV file's chunk `bext`; None without one."""
    with path.open("rb") as stream:
        stream.seek(12)  # behind RIFF, size and WAVE
        while len(head := stream.read(8)) == 8:  # ends: each round reads on
            size = int.from_bytes(head[4:], "little")
            if head[:4] == b"bext":
                text = stream.read(min(size, BEXT_DATE.stop))[BEXT_DATE].decode("ascii", "replace")
                return f"{re.sub('[_:. ]', '-', text[:10])} {text[10:].strip()}"
            stream.seek(size + size % 2, 1)
    return None


def _call(read: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return what a function of a package returns that may raise any error on damaged files."""
    try:
        return read(*arguments, **named)
    except Exception as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
