"""Records of universal files (UFF 58) and of WAV files, with rates, units and dates they state."""

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.io import wavfile

from suspnet.ground.extras import import_extra
from suspnet.ground.findings import Finding
from suspnet.trains.recordings.columns import Block, Column, OpenFile, Take, size_of, slices
from suspnet.trains.recordings.errors import TripError

BEXT_DATE = slice(320, 338)
"""Bytes of the chunk `bext` that hold date and time of day, yyyy-mm-dd and hh:mm:ss."""
TIME_RESPONSE = 1  # function type of a time record in a data set 58 of a universal file
ACCELERATION, TIME = 12, 17  # kinds of ordinate and abscissa of a data set 58
LENGTHS = {1: "m", 2: "ft", 3: "m", 4: "ft", 5: "mm", 6: "cm", 7: "in", 8: "mm", 10: "mm"}
"""Unit of lengths by the code of a data set 164, which holds where a data set 58 names no unit."""


@contextmanager
def open_uff(path: Path) -> Iterator[OpenFile]:
    """Open a universal file; each time record of type 58 is a column, which is read whole."""
    pyuff = import_extra("pyuff", "uff", "a universal file", TripError)
    file = pyuff.UFF(str(path))
    columns, records = _uff_columns(file)

    def read(names: Sequence[str]) -> Iterator[Block]:
        takes: dict[str, tuple[int, Take]] = {}
        for name in names:
            is_times = name not in records
            record = file.read_sets(records[name.removesuffix(": times")])
            values = np.asarray(record["x" if is_times else "data"]).ravel()
            n = int(record["num_pts"])
            if len(values) < n:
                sizes = {"n_declared": n, "n_values": len(values)}
                raise TripError.at(path, "column-cut-off", name=repr(name), **sizes)
            takes[name] = n, values.__getitem__  # what follows fills up a line
        return slices(path, names, takes)

    yield OpenFile(tuple(columns), read)


def _uff_columns(file: Any) -> tuple[list[Column], dict[str, int]]:
    records: dict[str, int] = {}
    columns: list[Column] = []
    length = None
    for i, kind in enumerate(file.get_set_types()):
        if kind == 164:
            length = LENGTHS.get(int(file.read_sets(i)["units_code"]))
        header = file.read_sets(i, header_only=True) if kind == 58 else {}
        if header.get("func_type") != TIME_RESPONSE:
            continue
        name = _text(header, "id1")
        if not name or name in records:
            name = f"record_{i + 1}"
        records[name] = i
        columns += _uff_record(name, header, length)
    return columns, records


def _uff_record(name: str, header: Mapping[str, Any], length: str | None) -> Iterator[Column]:
    """Yield the column of a time record, and that of its times if they are not even from 0 on."""
    unit, along = (_text(header, f"{axis}_axis_units_lab") for axis in ("ordinate", "abscissa"))
    if not unit and length and header.get("ordinate_spec_data_type") == ACCELERATION:
        unit = f"{length}/s2"
    about: dict[str, Any] = {"unit": unit or None, "date": _text(header, "id3") or None}
    if header.get("abscissa_spec_data_type") not in (None, 0, 1, TIME):  # 0, 1: unknown, general
        about["unread"] = Finding("not-of-time")
    elif header.get("ord_data_type") in (5, 6):
        about["unread"] = Finding("not-real", kind=np.dtype(complex))
    step_s = float(header.get("abscissa_inc") or 0.0) * (size_of("time", along or "s") or 0.0)
    if header.get("abscissa_spacing") == 1 and not float(header.get("abscissa_min") or 0.0):
        yield Column(name, rate_hz=1 / step_s if step_s > 0 else None, **about)
    else:
        yield Column(name, time=f"{name}: times", **about)
        yield Column(f"{name}: times", unit=along or "s")


def _text(header: Mapping[str, Any], key: str) -> str:
    text = str(header.get(key, "")).strip()
    return "" if text.upper() == "NONE" else text


@contextmanager
def open_wav(path: Path) -> Iterator[OpenFile]:
    """Open a WAV file; columns are "channel_1" etc., integers are fractions of full scale."""
    with warnings.catch_warnings(), path.open("rb") as stream:
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # of unknown chunks
        warnings.filterwarnings("error", "Reached EOF", wavfile.WavFileWarning)
        try:
            rate_hz, data = wavfile.read(stream, mmap=True)
        except ValueError as error:
            if "not compatible" not in str(error):
                raise
            stream.seek(0)
            rate_hz, data = wavfile.read(stream)  # 24 bits cannot be mapped to memory
    data = data[:, None] if data.ndim == 1 else data
    is_fraction = data.dtype.kind in "iu"
    zero = 128.0 if data.dtype.kind == "u" else 0.0
    full_scale = 2.0 ** (8 * data.dtype.itemsize - 1) if is_fraction else 1.0
    about: dict[str, Any] = {"is_fraction": is_fraction, "date": _checked_date(path)}
    columns, takes = [], dict[str, tuple[int, Take]]()
    for i, values in enumerate(data.T):
        name = f"channel_{i + 1}"
        columns.append(Column(name, rate_hz=float(rate_hz), is_whole_rate=True, **about))
        takes[name] = len(data), partial(_scaled, values, zero, full_scale)
    yield OpenFile(tuple(columns), lambda names: slices(path, names, takes))


def _scaled(values: Any, zero: float, full_scale: float, rows: slice) -> Any:
    return (values[rows].astype(np.float64) - zero) / full_scale


def _checked_date(path: Path) -> str | None:
    """Return the date of a broadcast WAV file's chunk `bext`; ValueError if the data are cut off.

    scipy does not say if data of 24 bits are.
    """
    date = None
    with path.open("rb") as stream:
        n_bytes = stream.seek(0, 2)
        stream.seek(0)
        order: Literal["big", "little"] = "big" if stream.read(12)[:4] == b"RIFX" else "little"
        while len(head := stream.read(8)) == 8:  # ends: each round advances
            size, start = int.from_bytes(head[4:], order), stream.tell()
            if head[:4] == b"data" and n_bytes - start < size < 2**32 - 1:  # RF64 writes that
                raise ValueError("its data are cut off")
            if head[:4] == b"bext":
                text = stream.read(min(size, BEXT_DATE.stop))[BEXT_DATE].decode("ascii", "replace")
                date = f"{re.sub('[_:. ]', '-', text[:10])} {text[10:].strip()}"
            stream.seek(start + size + size % 2)
    return date
