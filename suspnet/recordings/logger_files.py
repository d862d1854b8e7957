"""Channels of TDMS, UFF and WAV files, with the rates, units and times that they state."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from logging import CRITICAL, getLogger
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from scipy.io import wavfile

from suspnet.ground.extras import import_extra
from suspnet.recordings.columns import (
    BLOCK,
    Block,
    Column,
    OpenFile,
    Take,
    as_block,
    check_samples,
    slices,
)
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest_keys import CsvDialect

_WAV = Lock()
"""Lock for warning filters, which are global to the process, while sensors are read in threads."""
BEXT_DATE = slice(320, 338)
"""Bytes of the chunk `bext` that hold date and time of day, yyyy-mm-dd and hh:mm:ss."""
TIME_RESPONSE = 1
"""Function type of a time record in a data set 58 of a universal file."""


@contextmanager
def open_tdms(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a TDMS file; columns are named "group/channel"."""
    nptdms = import_extra("nptdms", "tdms", f"{path}: a TDMS file", TripError)
    getLogger("nptdms").setLevel(CRITICAL)  # it logs what it raises or repairs
    # Open the stream here because npTDMS does not close files that it fails to read.
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

        notes = tuple(f"{name}: {value}" for name, value in file.properties.items())
        yield OpenFile(tuple(_tdms_column(*item) for item in channels.items()), read, notes=notes)


def _tdms_column(name: str, channel: Any) -> Column:
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
def open_uff(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a universal file; each time record of type 58 is a column, which is read whole."""
    pyuff = import_extra("pyuff", "uff", f"{path}: a universal file", TripError)
    file = pyuff.UFF(str(path))
    columns, records = _uff_columns(file)

    def read(names: Sequence[str]) -> Iterator[Block]:
        arrays = []
        for name in names:
            is_times = name not in records
            record = file.read_sets(records[name.removesuffix(": times")])
            values = np.asarray(record["x" if is_times else "data"])
            if values.dtype.kind not in "iuf":
                raise TripError(f"{path}: column {name!r} holds {values.dtype}, not real numbers")
            arrays.append(values.ravel())
        takes: list[Take] = [array.__getitem__ for array in arrays]
        return slices(path, names, [len(array) for array in arrays], takes)

    yield OpenFile(tuple(columns), read)


def _uff_columns(file: Any) -> tuple[list[Column], dict[str, int]]:
    """Return the columns of a universal file, and their record numbers by name."""
    records: dict[str, int] = {}
    columns = []
    for i, kind in enumerate(file.get_set_types()):
        if kind != 58:
            continue
        header = file.read_sets(i, header_only=True)
        if header.get("func_type") != TIME_RESPONSE:
            continue
        name = str(header.get("id1", "")).strip()
        if not name or name.upper() == "NONE" or name in records:
            name = f"record_{i + 1}"
        records[name] = i
        step_s = float(header.get("abscissa_inc") or 0.0)
        even = header.get("abscissa_spacing") == 1 and step_s > 0
        unit = str(header.get("ordinate_axis_units_lab", "")).strip()
        about: dict[str, Any] = {
            "unit": None if unit.upper() in ("", "NONE") else unit,
            "date": str(header.get("id3", "")).strip() or None,
        }
        if even:
            columns.append(Column(name, rate_hz=1 / step_s, **about))
        else:
            times = f"{name}: times"
            columns += [Column(name, time=times, **about), Column(times, is_part=True)]
    return columns, records


@contextmanager
def open_wav(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a WAV file; columns are "channel_1" etc., integers are fractions of full scale."""
    with _WAV, warnings.catch_warnings(), path.open("rb") as stream:
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # of unknown chunks
        warnings.filterwarnings("error", "Reached EOF", wavfile.WavFileWarning)
        try:
            rate_hz, data = wavfile.read(stream, mmap=True)
        except ValueError as error:
            if "not compatible" not in str(error):
                raise
            stream.seek(0)
            rate_hz, data = wavfile.read(stream)  # 24 bits cannot be mapped to memory
    check_samples(path, len(data))
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
        stream.seek(12)  # after RIFF, size and WAVE
        while len(head := stream.read(8)) == 8:  # ends: each round advances
            size = int.from_bytes(head[4:], "little")
            if head[:4] == b"bext":
                text = stream.read(min(size, BEXT_DATE.stop))[BEXT_DATE].decode("ascii", "replace")
                return f"{re.sub('[_:. ]', '-', text[:10])} {text[10:].strip()}"
            stream.seek(size + size % 2, 1)
    return None
