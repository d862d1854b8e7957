"""Channels of TDMS files, with the rates, units and times that they state."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from itertools import pairwise
from logging import CRITICAL, getLogger
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.ground.extras import import_extra
from suspnet.ground.findings import Finding
from suspnet.trains.recordings.columns import MOST_DRIFT, Column, OpenFile, Take, slices
from suspnet.trains.recordings.errors import TripError

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
    nptdms = import_extra("nptdms", "tdms", f"{path}: a TDMS file", TripError)
    getLogger("nptdms").setLevel(CRITICAL)  # it logs what it raises or repairs
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
