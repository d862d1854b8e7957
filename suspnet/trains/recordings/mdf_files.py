"""Channels of MDF 4 files with their arithmetic conversions; formulas are not evaluated."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
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

APPLIED = (0, 1, 2, 4, 5, 6)
"""Numbers of the conversions that are applied: none, linear, rational, a table with and without
interpolation, and a table of ranges."""
RATIONAL, RANGES = 2, 6
REFUSED = {
    **{3: "algebraic (a formula)", 7: "value-to-text", 8: "range-to-text"},
    **{9: "text-to-value", 10: "text-to-text", 11: "bit-field-to-text"},
}
"""Names of unsupported conversions by their numbers."""
VIRTUAL = (3, 6)
"""Types of channels whose raw values are the record numbers."""
TIME = 1
"""Kind of masters that are times."""
NO_TIMES = {2: "angle", 3: "distance"}
"""Kinds of masters along which channels are not sampled in time."""
ALL_INVALID = 1
"""Flag of channels without a valid sample."""


@contextmanager
def open_mdf(path: Path) -> Iterator[OpenFile]:
    """Open an MDF file; each channel group has its own times."""
    asammdf = import_extra("asammdf", "mdf", f"{path}: an MDF file", TripError)
    _disarm()
    with path.open("rb") as stream:
        version = stream.read(12)[8:].decode("latin-1")
    if "0" < version < "4":
        raise TripError.at(path, "mdf-too-old", version=version)
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
    start = _start(file)
    master, kind = file.masters_db.get(g), TIME
    if master is not None:
        kind = file.groups[g].channels[master].sync_type or TIME
    for c, (name, channel) in enumerate(zip(names, file.groups[g].channels, strict=True)):
        unit, refused = _unit(channel), _refused(channel)
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
    if (start_ns := nanoseconds(file.start_time)) <= 0:
        return {}
    return {"start_ns": start_ns, "is_local": file.start_time.tzinfo is None}


def _unit(channel: Any) -> str | None:
    other = getattr(channel.conversion, "unit", None) if channel.unit_addr == 0 else None
    return channel.unit or other or None


def _refused(channel: Any) -> str:
    """Return why the conversion of a channel is not applied; empty if it is."""
    if channel.conversion is None:  # asammdf also leaves out one that it cannot read
        return Finding("damaged-conversion") if channel.conversion_addr else ""
    number = int(channel.conversion.conversion_type)
    if number in APPLIED:
        return ""
    what = REFUSED.get(number, Finding("number-of-kind", n=number))
    return Finding("conversion-not-applied", what=what)


def _notes(header: Any) -> tuple[str, ...]:
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

    def take(rows: slice) -> FloatArray:
        # raw values, and the mask of invalid ones, which would otherwise be left out
        how = {"samples_only": True, "raw": True, "ignore_invalidation_bits": True}
        records = {"record_offset": rows.start, "record_count": rows.stop - rows.start}
        values, invalid = file.get(group=group, index=index, **how, **records)
        if values.dtype.kind not in "iufb" or values.ndim != 1:
            raise TripError.at(path, "column-not-numbers", name=repr(name), dtype=values.dtype)
        if channel.channel_type in VIRTUAL:
            values = np.arange(rows.start, rows.stop, dtype=np.float64)
        values = _converted(values, channel.conversion)
        if channel.flags & ALL_INVALID:
            values[:] = np.nan
        elif invalid is not None:
            values[np.asarray(invalid, dtype=np.bool_)] = np.nan
        return values

    return take


def _converted(values: Any, conversion: Any) -> FloatArray:
    """Return the physical values of raw ones.

    Those that asammdf evaluates as formulas, or wrongly for integers, are computed here.
    """
    numbers = np.array(values, dtype=np.float64)
    if conversion is None:
        return numbers
    kind = int(conversion.conversion_type)
    if kind == RATIONAL:
        p = [float(getattr(conversion, f"P{i}")) for i in range(1, 7)]
        with np.errstate(all="ignore"):  # NaN or infinite where the divisor is 0
            above, below = (a * numbers**2 + b * numbers + c for a, b, c in (p[:3], p[3:]))
            return np.asarray(above / below)
    if kind == RANGES:
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
