"""Channels of MDF files with their arithmetic conversions; formulas are not evaluated."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib import import_module
from io import BytesIO
from logging import CRITICAL, getLogger
from pathlib import Path
from traceback import walk_tb
from typing import Any, BinaryIO, NoReturn

import numpy as np

from suspnet.ground.extras import import_extra
from suspnet.ground.findings import Finding
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.columns import Block, Column, OpenFile, Take, slices
from suspnet.trains.recordings.dates import nanoseconds
from suspnet.trains.recordings.errors import TripError

RATIONAL = {"4": 2, "3": 9}
RANGES = {"4": 6}
APPLIED = {"4": (0, 1, 2, 4, 5, 6), "3": (65535, 0, 1, 2, 9)}
"""Numbers of the conversions that are applied, in MDF 4, and in MDF 2 and 3: none, linear,
rational, a table with and without interpolation, and a table of ranges."""
REFUSED = {
    "4": {
        **{3: "algebraic (a formula)", 7: "value-to-text", 8: "range-to-text"},
        **{9: "text-to-value", 10: "text-to-text", 11: "bit-field-to-text"},
    },
    "3": {
        **{6: "polynomial", 7: "exponential", 8: "logarithmic", 10: "algebraic (a formula)"},
        **{11: "value-to-text", 12: "range-to-text", 132: "date", 133: "time"},
    },
}
"""Names of unsupported conversions by their numbers in MDF 4, and in MDF 2 and 3."""
VIRTUAL = (3, 6)
"""Types of MDF 4 channels whose raw values are the record numbers."""
TIME = 1
"""Kind of MDF 4 masters that are times."""
NO_TIMES = {2: "angle", 3: "distance"}
"""Kinds of MDF 4 masters along which channels are not sampled in time."""
ALL_INVALID = 1
"""Flag of MDF 4 channels without a valid sample."""


@contextmanager
def open_mdf(path: Path) -> Iterator[OpenFile]:
    """Open an MDF file; each channel group has its own times."""
    asammdf = import_extra("asammdf", "mdf", f"{path}: an MDF file", TripError)
    _disarm()
    with path.open("rb") as stream, _opened_mdf(asammdf, stream) as file:
        places: dict[str, tuple[int, int]] = {}
        columns: list[Column] = []
        n_of_name = Counter(channel.name for group in file.groups for channel in group.channels)
        for g, group in enumerate(file.groups):
            names = [
                f"group_{g}/{channel.name}" if n_of_name[channel.name] > 1 else channel.name
                for channel in group.channels
            ]
            places |= {name: (g, c) for c, name in enumerate(names)}
            columns += _columns(file, g, names)

        def read(names: Sequence[str]) -> Iterator[Block]:
            groups = {places[name][0] for name in names}
            if len(groups) > 1:
                raise TripError.at(path, "several-groups", names=list(names))
            n_samples = int(file.groups[groups.pop()].channel_group.cycles_nr)
            takes = {name: (n_samples, _take(path, file, name, *places[name])) for name in names}
            return slices(path, names, takes)

        yield OpenFile(tuple(columns), read, notes=_notes(file.header))


def _columns(file: Any, g: int, names: Sequence[str]) -> Iterator[Column]:
    """Yield the channels of a group as the file describes them."""
    start = _start(file)
    master, kind = file.masters_db.get(g), TIME
    if master is not None and file.version >= "4":
        kind = file.groups[g].channels[master].sync_type or TIME
    for c, (name, channel) in enumerate(zip(names, file.groups[g].channels, strict=True)):
        unit, refused = _unit(file.version, channel), _refused(file.version, channel)
        if c == master:
            unit = unit or ("s" if kind == TIME else None)
            yield Column(name, unit=unit, unread=refused, is_local=start.get("is_local", False))
            continue
        if by := NO_TIMES.get(kind):
            refused = Finding("not-along-time", by=by, names=repr(names[master]))
        time = names[master] if master is not None and kind == TIME else None
        yield Column(name, unit=unit, time=time, unread=refused, **start)


def _start(file: Any) -> dict[str, Any]:
    """Return the start of a file, and whether it is local, as arguments of `Column`, if stated."""
    start = None
    if file.version >= "4" or getattr(file.header, "abs_time", 0):
        start = file.start_time
    else:
        with suppress(ValueError):  # asammdf takes the present, and this computer's zone
            text = f"{file.header.date.decode('ascii')} {file.header.time.decode('ascii')}"
            start = datetime.strptime(text, "%d:%m:%Y %H:%M:%S")
    if start is None or (start_ns := nanoseconds(start)) <= 0:
        return {}
    return {"start_ns": start_ns, "is_local": start.tzinfo is None}


def _unit(version: str, channel: Any) -> str | None:
    """Return the unit of a channel, or else, where it refers to none, that of its conversion."""
    is_open = version < "4" or channel.unit_addr == 0
    return channel.unit or (getattr(channel.conversion, "unit", None) if is_open else None) or None


def _major(version: str) -> str:
    return "4" if version >= "4" else "3"


def _refused(version: str, channel: Any) -> str:
    """Return why the conversion of a channel is not applied; empty if it is."""
    if channel.conversion is None:  # asammdf also leaves out one that it cannot read
        return Finding("damaged-conversion") if channel.conversion_addr else ""
    major, number = _major(version), int(channel.conversion.conversion_type)
    if number in APPLIED[major]:
        return ""
    what = REFUSED[major].get(number, Finding("number-of-kind", n=number))
    return Finding("conversion-not-applied", what=what)


def _notes(header: Any) -> tuple[str, ...]:
    """Return the comment and the properties of a file's header as lines."""
    properties = getattr(header, "_common_properties", None) or {}
    properties = {"vehicle": getattr(header, "subject", "")} | properties
    lines = [f"{name}: {value}" for name, value in properties.items() if value]
    comment = str(getattr(header, "comment", "") or getattr(header, "description", ""))
    return (*lines, *re.sub(r"<[^<>]*>", "\n", comment).splitlines())


def _disarm() -> None:
    """Disable evaluation of formulas, logging and temporary files in asammdf.

    It would open an unused temporary file for each file that it reads.
    """

    def refuse(*_: Any, **__: Any) -> NoReturn:
        raise ValueError("a formula in the file is not evaluated")

    getLogger("asammdf").setLevel(CRITICAL)  # it logs what it raises or repairs
    replaced = {"evaluate": refuse, "lambdify": refuse}
    for name in ("NamedTemporaryFile", "TemporaryFile"):
        replaced[name] = lambda *_, **__: BytesIO()  # type: ignore[assignment]
    for part in ("mdf_v3", "mdf_v4", "v2_v3_blocks", "v4_blocks"):
        module = import_module(f"asammdf.blocks.{part}")
        for name in replaced.keys() & vars(module).keys():
            setattr(module, name, replaced[name])


def _opened_mdf(asammdf: Any, stream: BinaryIO) -> Any:
    """Open an MDF file; asammdf raises any error if it is damaged."""
    try:
        return asammdf.MDF(stream, process_bus_logging=False)
    except Exception as error:
        # Close the partly opened file: otherwise its destructor prints a traceback.
        for frame, _ in walk_tb(error.__traceback__):
            opened = frame.f_locals.get("self")
            if opened is not None and not getattr(opened, "_closed", True):
                with suppress(AttributeError):
                    opened._tempfile.close()
                opened._closed = True
        raise


def _take(path: Path, file: Any, name: str, group: int, index: int) -> Take:
    """Return the function that takes physical values of a channel; NaN where they are invalid."""
    channel = file.groups[group].channels[index]
    is_newer = file.version >= "4"

    def take(rows: slice) -> FloatArray:
        numbers = np.arange(rows.start, rows.stop, dtype=np.float64)
        if not is_newer and index == file.masters_db.get(group) and channel.bit_count == 0:
            return numbers * (channel.sampling_rate or 1)
        # raw values, and the mask of invalid ones, which would otherwise be left out
        how = {"samples_only": True, "raw": True, "ignore_invalidation_bits": True}
        records = {"record_offset": rows.start, "record_count": rows.stop - rows.start}
        values, invalid = file.get(group=group, index=index, **how, **records)
        if values.dtype.kind not in "iufb" or values.ndim != 1:
            raise TripError.at(path, "column-not-numbers", name=repr(name), dtype=values.dtype)
        is_virtual = is_newer and channel.channel_type in VIRTUAL
        values = _converted(numbers if is_virtual else values, channel.conversion, file.version)
        if is_newer and channel.flags & ALL_INVALID:
            values[:] = np.nan
        elif invalid is not None:
            values[np.asarray(invalid, dtype=np.bool_)] = np.nan
        return values

    return take


def _converted(values: Any, conversion: Any, version: str) -> FloatArray:
    """Return the physical values of raw ones.

    Those that asammdf evaluates as formulas, or wrongly for integers, are computed here.
    """
    numbers = np.array(values, dtype=np.float64)
    if conversion is None:
        return numbers
    kind = int(conversion.conversion_type)
    if kind == RATIONAL[_major(version)]:
        p = [float(getattr(conversion, f"P{i}")) for i in range(1, 7)]
        with np.errstate(all="ignore"):  # NaN or infinite where the divisor is 0
            above, below = (a * numbers**2 + b * numbers + c for a, b, c in (p[:3], p[3:]))
            return np.asarray(above / below)
    if kind == RANGES.get(_major(version)):
        return _in_ranges(conversion, values)
    return np.asarray(conversion.convert(numbers))


def _in_ranges(conversion: Any, x: Any) -> FloatArray:
    """Return the value of the range that contains x; for integers, including its upper end."""
    n = (int(conversion.val_param_nr) - 1) // 3
    lower, upper, values = (
        np.array([float(conversion[f"{key}_{i}"]) for i in range(n)])
        for key in ("lower", "upper", "phys")
    )
    i = np.searchsorted(lower, x, side="right") - 1
    inside = (i >= 0) & ((x <= upper[i]) if x.dtype.kind in "iub" else (x < upper[i]))
    return np.where(inside, values[i], float(conversion.default))
