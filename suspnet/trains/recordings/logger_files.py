"""Channels of MDF 4 and TDMS files, with their arithmetic conversions; no formula is evaluated."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from suspnet.ground.extras import import_extra
from suspnet.ground.findings import Finding
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.columns import MOST_DRIFT, Block, Column, OpenFile, Take, slices
from suspnet.trains.recordings.dates import nanoseconds
from suspnet.trains.recordings.errors import TripError

APPLIED = (0, 1)  # numbers of the conversions that are applied: none and linear
REFUSED = {
    **{2: "rational", 3: "algebraic (a formula)", 4: "table", 5: "table", 6: "table of ranges"},
    **{7: "value-to-text", 8: "range-to-text", 9: "text-to-value", 10: "text-to-text"},
    11: "bit-field-to-text",
}
"""Names of the other conversions by their numbers."""
VIRTUAL = (3, 6)  # types of channels whose raw values are the record numbers
TIME = 1  # kind of masters that are times
NO_TIMES = {2: "angle", 3: "distance"}
"""Kinds of masters along which channels are not sampled in time."""
ALL_INVALID = 1  # flag of channels without a valid sample


@contextmanager
def open_mdf(path: Path) -> Iterator[OpenFile]:
    """Open an MDF file; each channel group has its own times."""
    asammdf = import_extra("asammdf", "mdf", "an MDF file", TripError)
    _disarm()
    with path.open("rb") as stream:
        version = stream.read(12)[8:].decode("latin-1")
    if "0" < version < "4":
        raise TripError.at(path, "mdf-too-old", version=version)
    with asammdf.MDF(path, process_bus_logging=False) as file:
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
    if (start_ns := nanoseconds(file.start_time)) <= 0:
        return {}
    return {"start_ns": start_ns, "is_local": file.start_time.tzinfo is None}


def _unit(channel: Any) -> str | None:
    other = getattr(channel.conversion, "unit", None) if channel.unit_addr == 0 else None
    return channel.unit or other or None


def _refused(channel: Any) -> str:
    if channel.conversion is None:  # asammdf also leaves out one that it cannot read
        return Finding("damaged-conversion") if channel.conversion_addr else ""
    number = int(channel.conversion.conversion_type)
    if number in APPLIED:
        return ""
    conversion = REFUSED.get(number, Finding("number-of-kind", n=number))
    return Finding("conversion-not-applied", what=conversion)


def _notes(header: Any) -> tuple[str, ...]:
    properties = getattr(header, "_common_properties", None) or {}
    properties = {"vehicle": getattr(header, "subject", "")} | properties
    lines = [f"{name}: {value}" for name, value in properties.items() if value]
    comment = str(getattr(header, "comment", "") or getattr(header, "description", ""))
    return (*lines, *re.sub(r"<[^<>]*>", "\n", comment).splitlines())


def _disarm() -> None:
    """Disable evaluation of formulas and temporary files in asammdf.

    It would open an unused temporary file for each file that it reads.
    """

    def refuse(*_: Any, **__: Any) -> NoReturn:
        raise ValueError("a formula in the file is not evaluated")

    replaced = {"evaluate": refuse, "lambdify": refuse}
    for name in ("NamedTemporaryFile", "TemporaryFile"):
        replaced[name] = lambda *_, **__: BytesIO()  # type: ignore[assignment]
    for part in ("mdf_v3", "mdf_v4", "v2_v3_blocks", "v4_blocks"):
        module = import_module(f"asammdf.blocks.{part}")
        for name in replaced.keys() & vars(module).keys():
            setattr(module, name, replaced[name])


def _take(path: Path, file: Any, name: str, group: int, index: int) -> Take:
    channel = file.groups[group].channels[index]

    def take(rows: slice) -> FloatArray:
        # raw values, and the mask of invalid ones, which would otherwise be left out
        how = {"samples_only": True, "raw": True, "ignore_invalidation_bits": True}
        records = {"record_offset": rows.start, "record_count": rows.stop - rows.start}
        values, invalid = file.get(group=group, index=index, **how, **records)
        if values.dtype.kind not in "iufb" or values.ndim != 1:
            raise TripError.at(path, "column-not-numbers", name=repr(name), value=values.dtype)
        if channel.channel_type in VIRTUAL:
            values = np.arange(rows.start, rows.stop, dtype=np.float64)
        values = np.array(values, dtype=np.float64)
        if channel.conversion is not None:
            values = np.asarray(channel.conversion.convert(values))
        if channel.flags & ALL_INVALID:
            values[:] = np.nan
        elif invalid is not None:
            values[np.asarray(invalid, dtype=np.bool_)] = np.nan
        return values

    return take


LEAST_GAP_S = 1e-3
"""Least time between the end of a segment of a TDMS file and the start of the next that is a gap,
[s]: less is inexact time stamps."""
_FIXED = re.compile("wf_increment|unit_string|NI_(Scal|Unit|Number_Of_S)")
"""Properties of a TDMS channel that must be the same in all segments: rate, unit and scales."""
Stated = list[tuple[int, dict[str, Any]]]
"""Properties that segments of a TDMS file give a channel, by the number of its samples before."""


@contextmanager
def open_tdms(path: Path) -> Iterator[OpenFile]:
    """Open a TDMS file; columns are named "group/channel"."""
    nptdms = import_extra("nptdms", "tdms", "a TDMS file", TripError)
    # Open the stream here because npTDMS does not close files that it fails to read.
    with path.open("rb") as stream, ExitStack() as stack:
        with _properties_of_segments() as stated:
            file = stack.enter_context(nptdms.TdmsFile.open(stream))
        if file.file_status.incomplete_final_segment:
            raise TripError(Finding("segment-cut-off", path=path))
        channels = [channel for group in file.groups() for channel in group.channels()]
        names = [f"{channel.group_name}/{channel.name}" for channel in channels]
        n_of_name = Counter(names)
        columns: list[Column] = []
        takes: dict[str, tuple[int, Take]] = {}
        for name, channel in zip(names, channels, strict=True):
            # "a/b" and "c" are called as "a" and "b/c": TDMS itself writes these as paths
            name = channel.path if n_of_name[name] > 1 else name
            columns.append(_tdms_column(name, channel, stated.get(channel.path, [])))
            takes[name] = len(channel), channel.__getitem__
        notes = tuple(f"{name}: {value}" for name, value in file.properties.items())
        yield OpenFile(tuple(columns), lambda names: slices(path, names, takes), notes=notes)


@contextmanager
def _properties_of_segments() -> Iterator[dict[str, Stated]]:
    """Collect the properties of each segment by channel, of which npTDMS keeps the last."""
    reader = import_module("nptdms.reader").TdmsReader
    stated: dict[str, Stated] = {}

    def read(self: Any, *arguments: Any) -> Any:
        segment, properties = original(self, *arguments)
        for path, values in (properties or {}).items():
            before = self.object_metadata.get(path)
            stated.setdefault(path, []).append((before.num_values if before else 0, dict(values)))
        return segment, properties

    original, reader._read_segment_metadata = reader._read_segment_metadata, read
    try:
        yield stated
    finally:
        reader._read_segment_metadata = original


def _tdms_column(name: str, channel: Any, stated: Stated) -> Column:
    properties = channel.properties
    step_s = properties.get("wf_increment")
    unit = properties.get("unit_string") or properties.get("NI_UnitDescription")
    kind = np.dtype(channel.dtype)
    has_rate = isinstance(step_s, float | int) and 1e-9 < step_s < 1e9
    starts_ns = _starts_ns(stated, len(channel))
    unread = _changed(stated) or (_interrupted(starts_ns, step_s) if has_rate else "")
    return Column(
        name,
        unit=str(unit) if unit else None,
        rate_hz=1 / step_s if has_rate else None,
        start_ns=starts_ns[0][1] if starts_ns else None,
        is_time=kind.kind == "M",
        is_zoned=kind.kind == "M",  # LabVIEW writes time stamps in UTC
        unread=unread if kind.kind in "iufM" else f"holds {kind}, not numbers",
    )


def _changed(stated: Stated) -> str:
    first: dict[str, str] = {}
    for _, properties in stated:
        for key, value in properties.items():
            if _FIXED.match(key) and first.setdefault(key, str(value)) != str(value):
                return Finding("segments-differ", key=repr(key), value=value, first=first[key])
    return ""


def _interrupted(starts_ns: Sequence[tuple[int, int]], step_s: float) -> str:
    """Return where a segment does not follow the one before it, nor the first; empty if all do."""
    for previous, (n_next, next_ns) in pairwise(starts_ns):
        for n, ns in (previous, starts_ns[0]):  # short pauses add up
            length_s = (n_next - n) * step_s
            late_s = (next_ns - ns) / 1e9 - length_s
            if abs(late_s) > max(LEAST_GAP_S, step_s / 2) + MOST_DRIFT * length_s:
                end_ns = next_ns - round(1e9 * late_s)
                before, after = (np.datetime64(round(at / 1000), "us") for at in (end_ns, next_ns))
                return Finding("segments-interrupted", before=before, after=after)
    return ""


def _starts_ns(stated: Stated, n_samples: int) -> list[tuple[int, int]]:
    """Return the starts that a channel states, each with the number of samples before it, [ns]."""
    starts: list[tuple[int, int]] = []
    offset_s = 0.0
    for n, values in stated:
        offset_s = float(values.get("wf_start_offset", offset_s))
        start = values.get("wf_start_time")
        if start is None or not hasattr(start, "as_datetime64"):
            continue
        ns = int(start.as_datetime64("ns").astype(np.int64)) + round(1e9 * offset_s)
        # LabVIEW writes 1904 where there is none, and may write the same start in each segment
        if ns <= 0 or (starts and (ns == starts[-1][1] or n >= n_samples)):
            continue
        if starts and starts[-1][0] == n:  # a later segment without samples in between
            starts.pop()
        starts.append((n if starts else 0, ns))
    return starts
