"""Columns of HDF5 files, of which MAT files of version 7.3 are: data sets and fields of tables."""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from suspnet.ground.extras import import_extra
from suspnet.ground.findings import Finding, at
from suspnet.trains.recordings import mat_files as mat
from suspnet.trains.recordings.columns import OpenFile, size_of
from suspnet.trains.recordings.dates import nanoseconds, read_date
from suspnet.trains.recordings.errors import TripError

MOST_CHUNK_BYTES = 2**28  # largest packed chunk, which is unpacked whole to read a single sample
MOST_CELLS = 4  # largest number of cells within cells
MISSING_NAMES = ("_FillValue", "missing_value")
PACKING = (*MISSING_NAMES, *("scale_factor", "add_offset", "valid_min", "valid_max", "valid_range"))
"""Attributes of netCDF on missing samples, scale, offset and valid limits of stored numbers."""
UNAPPLIED = (
    *map(mat.plain_key, PACKING),
    *("gain", "scale", "scaling", "scalingfactor", "multiplier", "slope", "lsb", "sensitivity"),
    *("offset", "intercept", "calibration", "calibrationfactor"),
)
"""Attributes of no convention, as `plain_key` writes them: the stored numbers may or may not have
been multiplied by them. Those of `PACKING` are applied only as they stand there."""
_SINCE = re.compile(r"(\w+)\s+since\s+(.+?)(\s+UTC|\s+Z)?$")
"""Unit of times of netCDF: a unit and the date from which times are counted, in UTC."""
FILTERS = (1, 2, 3, 4, 5, 6, 32000)
"""Filters of the HDF5 library and h5py: deflate, shuffle, fletcher32, szip, nbit, scaleoffset and
LZF. Any other is a plug-in, that is, foreign code to load."""


@contextmanager
def open_mat(path: Path) -> Iterator[OpenFile]:
    """Open a MAT file of any version; version 7.3 is HDF5."""
    with ExitStack() as stack:
        try:
            file = stack.enter_context(mat.open_mat_5(path))
        except NotImplementedError:
            file = stack.enter_context(open_hdf5(path))
        yield file


@contextmanager
def open_hdf5(path: Path) -> Iterator[OpenFile]:
    """Open an HDF5 file; data sets that need other files or plug-ins are refused by name."""
    h5py = import_extra("h5py", "hdf5", "an HDF5 file", TripError)
    with h5py.File(path, "r", rdcc_nbytes=MOST_CHUNK_BYTES) as file:
        content = _Content(h5py, file)
        file.visititems(content.collect)  # h5py calls it for hard links only
        date = {k: value for k, value in mat.stated(_attributes(file)).items() if k == "date"}
        notes = {name: date | content.described(name) for name in content.arrays}
        opened = mat.array_file(path, content.arrays, notes, content.unread)
        unapplied = ", ".join(content.unapplied)
        words = at(path.name, "attributes-not-applied", unapplied=unapplied)
        yield replace(opened, words=words if unapplied else "")


class _Content:
    """Data sets of an HDF5 file by name: arrays of numbers, all, and why others are not read."""

    def __init__(self, h5py: Any, file: Any) -> None:
        self.h5py, self.file = h5py, file
        self.arrays: dict[str, Any] = {}
        self.datasets: dict[str, Any] = {}
        self.unread: dict[str, str] = {}
        self.unapplied: list[str] = []

    def collect(self, name: str, item: Any) -> None:
        """Add an object of the file; a name with # is that of MATLAB's content of cells."""
        if not isinstance(item, self.h5py.Dataset) or name.startswith("#"):
            return
        try:
            if words := _foreign(item):
                self.unread[name] = Finding("as-plain-numbers", words=words)
            elif why := _empty(item):
                self.unread[name] = why
            elif self.h5py.check_ref_dtype(item.dtype) is self.h5py.Reference:
                self._collect_cells(name, item)
            else:
                self._collect_data(name, item)
        except Exception as error:  # types without an equivalent; HDF5 raises any error
            words = Finding("unreadable-as", reason=" ".join(str(error).split())[:100])
            self.unread[name] = Finding("as-plain-numbers", words=words)

    def _collect_data(self, name: str, item: Any) -> None:
        self.datasets[name] = item
        applied = () if item.dtype.names else PACKING
        unapplied = (k for k in item.attrs if k not in applied and mat.plain_key(k) in UNAPPLIED)
        self.unapplied += [repr(f"{name}.{key}") for key in unapplied]
        if "MATLAB_empty" in item.attrs or "MATLAB_int_decode" in item.attrs:
            return
        fields = {f"{name}.{field}": _field(item, field) for field in item.dtype.names or ()}
        for place, array in (fields or {name: item}).items():
            self.datasets[place] = item
            if array.dtype.kind in "OSU" or len(array.shape) == 0:
                continue  # a text or a single number describes something else
            if why := mat.too_wide(array.shape):
                self.unread[place] = why
            elif array.dtype.kind not in "iuf":
                self.unread[place] = Finding("not-real", kind=array.dtype)
            else:
                self.arrays[place] = array if fields else _packed(item, self.h5py)

    def _collect_cells(self, name: str, item: Any) -> None:
        if item.size > mat.MOST_COLUMNS or name.count("[") >= MOST_CELLS:
            raise ValueError("nested references")
        for i, reference in enumerate(item[()].ravel()):
            content = self.file[reference] if reference else None
            if content is None or not content.name.startswith("/#"):
                continue
            self.collect(f"{name}[{i}]", content)
            if isinstance(content, self.h5py.Group):
                content.visititems(lambda end, item, i=i: self.collect(f"{name}[{i}]/{end}", item))

    def described(self, name: str) -> dict[str, Any]:
        """Return rate, unit and start by a data set's attributes, or else by its group."""
        attributes = mat.stated(_attributes(self.datasets[name]))
        if self.datasets[name].dtype.names is not None:
            attributes.pop("unit", None)  # a table has columns of several units
        small = {
            key: _value(dataset)
            for key, dataset in mat.siblings(name, self.datasets, "/").items()
            if dataset.nbytes <= mat.MOST_NOTE_BYTES
        }
        arguments = mat.stated_nearby(name, small) | self._times(name) | attributes
        since = _SINCE.match(arguments.get("unit", ""))
        if since and (start := read_date(since[2])):
            arguments |= {"unit": since[1], "start_ns": nanoseconds(start)}
        return arguments

    def _times(self, name: str) -> dict[str, str]:
        """Return the data set of times that netCDF attaches to the dimension of another one."""
        item = self.datasets[name]
        with suppress(Exception):
            scales = item.dims[int(np.argmax(item.shape))]
            times = scales[0].name.lstrip("/") if len(scales) else name
            unit = str(mat.stated(_attributes(self.datasets[times])).get("unit"))
            is_time = size_of("time", unit.partition(" since ")[0])
            if times != name and times in self.arrays and is_time:
                return {"time": times}
        return {}


def _foreign(dataset: Any) -> Finding | None:
    """Return which other files, plug-in or excess of memory a data set needs."""
    plan = dataset.id.get_create_plist()
    if dataset.is_virtual:
        return Finding("virtual")
    if plan.get_external_count():
        return Finding("in-other-files")
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    if others := [number for number in filters if number not in FILTERS]:
        return Finding("packed-by-filter", number=others[0])
    n_bytes = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if filters and n_bytes > MOST_CHUNK_BYTES:
        return Finding("packed-in-pieces", n_bytes=n_bytes, most=MOST_CHUNK_BYTES)
    return None


def _empty(dataset: Any) -> str:
    if dataset.shape is None:
        return Finding("null-space")
    if "MATLAB_object_decode" in dataset.attrs:
        kind = bytes(dataset.attrs.get("MATLAB_class", b"")).decode("latin-1")
        example = "t = x.Time; a = x.Data; save('trip.mat', 't', 'a')"
        return Finding("matlab-object", kind=kind, example=example)
    return ""


def _attributes(dataset: Any) -> dict[str, Any]:
    attributes: dict[str, Any] = {}
    for key in dataset.attrs:
        # a type without an equivalent matters where it is the scale
        with suppress(*([] if key in PACKING else [Exception])):
            if dataset.attrs.get_id(key).get_storage_size() <= mat.MOST_NOTE_BYTES:
                attributes[key] = dataset.attrs[key]
    return attributes


def _value(dataset: Any) -> Any:
    """Return the content of a data set, a text if MATLAB 7.3 stored its character codes."""
    content = None
    with suppress(Exception):  # one that cannot be read states nothing
        content = dataset[()]
    if dataset.dtype != np.uint16 or dataset.attrs.get("MATLAB_class") != b"char":
        return content
    return "".join(chr(code) for code in np.asarray(content).ravel())


@dataclass(frozen=True)
class _View:
    shape: tuple[int, ...]
    dtype: Any
    take: Callable[[Any], Any]

    def __getitem__(self, rows: Any) -> Any:
        return self.take(rows)


def _field(dataset: Any, name: str) -> _View:
    kind, n = dataset.dtype[name], len(dataset.shape)

    def take(rows: Any) -> Any:
        return dataset.fields(name)[rows[:n]][(slice(None), *rows[n:])]

    return _View((*dataset.shape, *kind.shape), kind.base, take)


def _packed(dataset: Any, h5py: Any) -> Any:
    """Return a data set with scale, offset and missing samples as its attributes mean them."""
    attributes = _attributes(dataset)
    numbers = {
        key: np.array(attributes[key], np.float64, ndmin=1) for key in PACKING if key in attributes
    }
    missing = [numbers[name] for name in MISSING_NAMES if name in numbers]
    chosen = dataset.id.get_create_plist().fill_value_defined()
    if chosen == h5py.h5d.FILL_VALUE_USER_DEFINED and dataset.fillvalue != 0:  # 0 may be a sample
        missing.append(np.array([dataset.fillvalue], dtype=np.float64))
    is_unsigned = dataset.dtype.kind == "i" and str(attributes.get("_Unsigned")).lower() == "true"
    if not numbers and not missing and not is_unsigned:
        return dataset
    scale, offset = numbers.get("scale_factor", np.ones(1)), numbers.get("add_offset", np.zeros(1))
    for name, value in (("scale_factor", scale), ("add_offset", offset)):
        is_right = value.shape == (1,) and np.isfinite(value[0])
        if not is_right or (name == "scale_factor" and value[0] == 0):
            raise ValueError(f"its {name} is {value}")

    def as_stored(values: Any) -> Any:
        """Return values that samples are compared with, rounded and with the sign of these."""
        if is_unsigned:
            return np.where(values < 0, values + 2.0 ** (8 * dataset.dtype.itemsize), values)
        kind = dataset.dtype if dataset.dtype.kind == "f" else np.float64
        with np.errstate(over="ignore"):
            return values.astype(kind).astype(np.float64)

    # limits and missing values are those of stored numbers; infinite limits have no sign to change
    limits = numbers.get("valid_range", np.array([-np.inf, np.inf]))
    ends = numbers.get("valid_min", limits)[0], numbers.get("valid_max", limits)[-1]
    lower, upper = (as_stored(np.array([end]))[0] if np.isfinite(end) else end for end in ends)
    left_out = np.concatenate([[np.nan], *map(as_stored, missing)])

    def take(rows: Any) -> Any:
        stored = np.asarray(dataset[rows])
        values = as_stored(stored.astype(np.float64))
        is_valid = (values >= lower) & (values <= upper) & ~np.isin(values, left_out)
        return np.where(is_valid, values * scale[0] + offset[0], np.nan)

    return _View(dataset.shape, dataset.dtype, take)
