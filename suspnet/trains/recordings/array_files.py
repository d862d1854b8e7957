"""Columns of MAT and HDF5 files: vectors, columns of matrices, fields of structs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat
from scipy.io.matlab import MatlabFunction, MatlabOpaque, mat_struct, varmats_from_mat

from suspnet.ground.extras import import_extra
from suspnet.ground.findings import Finding, at, together
from suspnet.trains.recordings.columns import (
    MOST_CHUNK_BYTES,
    Block,
    Column,
    OpenFile,
    Take,
    check_samples,
    is_vector,
    size_of,
    slices,
)
from suspnet.trains.recordings.errors import TripError

RATE_NAMES = ("ratehz", "fs", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")
UNIT_NAMES = ("unit", "units")
DATE_NAMES = ("start", "starttime", "startdate", "date", "datetime", "timestamp", "startzeit")
"""Names of fields and attributes that state rate [Hz], unit and start of the data next to them;
compared in lower case, without blanks and underscores."""
NUMERIC = ("single", "double", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)))
"""Classes of MAT file variables that hold numbers."""
MOST_COLUMNS = 1000
"""Largest number of columns of a matrix, and of cells of a variable of MATLAB."""
FILL_NAMES = ("_FillValue", "missing_value")
"""Attributes that state which stored number means a missing sample."""
UNAPPLIED = (
    *("scalefactor", "addoffset", "unsigned", "validmin", "validmax", "validrange"),
    *("gain", "scale", "scaling", "scalingfactor", "multiplier", "slope", "lsb", "sensitivity"),
    *("offset", "intercept", "calibration", "calibrationfactor"),
)
"""Attributes that change what stored numbers mean, compared as `RATE_NAMES`. The first six are of
netCDF and refused; the others are of no convention: numbers may have been multiplied by them."""
_OTHER_KIND = re.compile(r"(.*[./])?(t|v|[^./]*(time|zeit|speed|geschw|veloc)[^./]*)")
"""Names of times and speeds, in lower case."""
FILTERS = (1, 2, 3, 4, 5, 6, 32000)
"""Filters of the HDF5 library and h5py: deflate, shuffle, fletcher32, szip, nbit, scaleoffset and
LZF. Any other is a plug-in, that is, foreign code to load."""
MOST_NOTE_BYTES = 2**12
"""Largest size of a value that may be a rate, a unit or a date."""


@contextmanager
def open_hdf5(path: Path) -> Iterator[OpenFile]:
    """Open an HDF5 file; data sets that need other files or plug-ins are refused when read."""
    h5py = import_extra("h5py", "hdf5", f"{path}: an HDF5 file", TripError)
    with h5py.File(path, "r", rdcc_nbytes=MOST_CHUNK_BYTES) as file:
        content = _Content(h5py, file)
        file.visititems(content.collect)  # h5py calls it for hard links only
        # single values follow the vectors, as most describe one of them and are no signals
        arrays = dict(sorted(content.arrays.items(), key=lambda item: max(item[1].shape) <= 1))
        date = {k: value for k, value in _stated(_attributes(file)).items() if k == "date"}
        descriptions = {name: date | content.described(name) for name in arrays}
        opened = _opened(path, arrays, descriptions, content.unread)
        if content.unapplied:
            unapplied = together(content.unapplied, ", ")
            opened = replace(
                opened, words=at(path.name, "attributes-not-applied", unapplied=unapplied)
            )
        yield opened


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
            if why := foreign(item) or _no_data(item):
                self.unread[name] = why
            elif self.h5py.check_ref_dtype(item.dtype) is self.h5py.Reference:
                raise ValueError("references")
            else:
                self._collect_data(name, item)
        except Exception as error:  # types without an equivalent; HDF5 raises any error
            reason = " ".join(str(error).split())[:100]
            self.unread[name] = _as_numbers(Finding("unreadable-as", reason=reason))

    def _collect_data(self, name: str, item: Any) -> None:
        self.datasets[name] = item
        stated = {_plain(key): key for key in item.attrs}
        if refused := [stated[key] for key in UNAPPLIED[:6] if key in stated]:
            raise ValueError(f"{name} with the attribute {refused[0]}")
        self.unapplied += [repr(f"{name}.{stated[key]}") for key in UNAPPLIED if key in stated]
        if "MATLAB_empty" in item.attrs or "MATLAB_int_decode" in item.attrs:
            return
        if not (why := _no_numbers(item)):
            self.arrays[name] = _filled(item, self.h5py)
        elif why.strip():
            self.unread[name] = why

    def described(self, name: str) -> dict[str, Any]:
        """Return rate, unit and start by a data set's attributes, or else by its group."""
        own = _stated(_attributes(self.datasets[name]))
        small = {
            key: _value(dataset)
            for key, dataset in _siblings(name, "/", self.datasets).items()
            if dataset.nbytes <= MOST_NOTE_BYTES
        }
        return _stated_nearby(name, small) | own


def _no_data(dataset: Any) -> str:
    """Return why a data set holds neither data nor references to it; empty if it does."""
    if dataset.shape is None:
        return Finding("null-space")
    if "MATLAB_object_decode" in dataset.attrs:
        return _matlab_object(bytes(dataset.attrs.get("MATLAB_class", b"")))
    return ""


def _matlab_object(kind: bytes) -> str:
    example = "t = x.Time; a = x.Data; save('trip.mat', 't', 'a')"
    return Finding("matlab-object", kind=kind.decode("latin-1"), example=example)


def _no_numbers(item: Any) -> str:
    """Return why an array is no column or matrix of numbers; a blank if it is a text or scalar."""
    if item.dtype.kind in "OSU" or len(item.shape) == 0:
        return " "
    if item.dtype.kind not in "iuf":
        return Finding("not-real", kind=item.dtype)
    return _of_shape(item.shape)


def _as_numbers(words: Finding) -> Finding:
    return Finding("as-plain-numbers", words=words)


def _of_shape(shape: tuple[int, ...]) -> str:
    if is_vector(shape) or (len(shape) <= 2 and min(shape) <= MOST_COLUMNS):
        return ""
    return Finding("is-an-array", shape=" x ".join(map(str, shape)))


@dataclass(frozen=True)
class _View:
    """An array whose values are computed as they are read."""

    shape: tuple[int, ...]
    dtype: Any
    take: Callable[[Any], Any]

    def __getitem__(self, rows: Any) -> Any:
        return self.take(rows)


def _filled(dataset: Any, h5py: Any) -> Any:
    """Return a data set with NaN in place of the values that its attributes call missing."""
    own = _attributes(dataset)
    missing = [np.array(own[name], dataset.dtype, ndmin=1) for name in FILL_NAMES if name in own]
    chosen = dataset.id.get_create_plist().fill_value_defined()
    # 0 may be a sample as well
    if chosen == h5py.h5d.FILL_VALUE_USER_DEFINED and dataset.fillvalue != 0:
        missing.append(np.array([dataset.fillvalue]))
    if not missing:
        return dataset
    left_out = np.concatenate(missing)

    def take(rows: Any) -> Any:
        stored = np.asarray(dataset[rows])
        return np.where(np.isin(stored, left_out), np.nan, stored.astype(np.float64))

    return _View(dataset.shape, dataset.dtype, take)


def foreign(dataset: Any) -> str:
    """Return which other files, plug-in or excess of memory a data set needs; "" if none."""
    if dataset.is_virtual:
        return _as_numbers(Finding("virtual"))
    plan = dataset.id.get_create_plist()
    if plan.get_external_count():
        return _as_numbers(Finding("in-other-files"))
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    others = [number for number in filters if number not in FILTERS]
    if others:
        return _as_numbers(Finding("packed-by-filter", number=others[0]))
    n_bytes = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if filters and n_bytes > MOST_CHUNK_BYTES:
        return _as_numbers(Finding("packed-in-pieces", n_bytes=n_bytes, most=MOST_CHUNK_BYTES))
    return ""


@contextmanager
def open_mat(path: Path) -> Iterator[OpenFile]:
    """Open a MAT file; before version 7.3 its variables are read whole."""
    try:
        variables, refused = _variables(path)
    except NotImplementedError:  # version 7.3 is HDF5
        with open_hdf5(path) as file:
            yield file
        return
    # variables of numbers are loaded when read; all others now, as they may hold or state something
    arrays: dict[str, Any] = {}
    loaded = []
    for name, shape, kind in variables:
        is_number = kind in NUMERIC
        if kind in ("struct", "cell", "object"):
            loaded.append(name)
        elif math.prod(shape) <= (MOST_NOTE_BYTES if kind == "char" else is_number):
            loaded.append(name)
        if is_number and (why := _of_shape(shape)):
            refused[name] = why
        elif is_number:
            arrays[name] = _Variable(path, name, shape)
        elif kind not in ("struct", "cell", "object", "char"):
            refused[name] = f"holds {kind}, not numbers"
    # the contents of structs and cells are columns of their own, by their path
    how = {"appendmat": False, "struct_as_record": False, "squeeze_me": True}
    content = loadmat(path, variable_names=loaded, **how) if loaded else {}
    leaves = {
        place: leaf
        for name in loaded
        if name in content
        for place, leaf in _leaves(name, content[name])
    }
    for name, leaf in leaves.items():
        array = np.atleast_1d(leaf)
        if isinstance(leaf, MatlabOpaque):
            refused[name] = _matlab_object(leaf["s2"].item())
        elif not (why := _no_numbers(array)):
            arrays[name] = array
        elif why.strip():
            refused[name] = why
    # values next to an array state its rate, unit and start
    descriptions = {name: _stated_nearby(name, _siblings(name, ".", leaves)) for name in arrays}
    yield _opened(path, arrays, descriptions, refused)


def _variables(path: Path) -> tuple[list[tuple[str, tuple[int, ...], str]], dict[str, str]]:
    """Return name, shape and class of the variables of a file, and why its objects are refused."""
    with suppress(TypeError):  # an object of MATLAB has no shape
        return [row for row in whosmat(path, appendmat=False) if not row[0].startswith("__")], {}
    rows, refused = [], {}
    with path.open("rb") as stream:
        for name, part in varmats_from_mat(stream):
            if name == "None":
                record = loadmat(part)[name]
                own = record["s0"].item().decode("latin-1")
                refused[own] = _matlab_object(record["s2"].item())
            elif not name.startswith("__"):
                rows += whosmat(part)
    return rows, refused


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the content of structs and cells of MATLAB, by its path."""
    if isinstance(value, mat_struct):
        for field in value._fieldnames:
            yield from _leaves(f"{name}.{field}", getattr(value, field))
    elif (
        isinstance(value, np.ndarray)
        and value.dtype == object
        and not isinstance(value, MatlabOpaque | MatlabFunction)
    ):
        for i, cell in enumerate(value.ravel()[:MOST_COLUMNS]):
            yield from _leaves(f"{name}[{i}]", cell)
    else:
        yield name, value


@dataclass(frozen=True)
class _Variable:
    path: Path
    name: str
    shape: tuple[int, ...]

    @cached_property
    def values(self) -> Any:
        return loadmat(self.path, variable_names=[self.name], appendmat=False)[self.name]

    @property
    def dtype(self) -> Any:
        return self.values.dtype

    def __getitem__(self, rows: Any) -> Any:
        return self.values[rows]


def _opened(
    path: Path,
    arrays: Mapping[str, Any],
    descriptions: Mapping[str, Mapping[str, Any]],
    refused: Mapping[str, str],
) -> OpenFile:
    """Return arrays by name as a file; a matrix has a column ``name[i]`` for each of its own."""
    columns = [Column(name, unread=why) for name, why in refused.items()]
    takes: dict[str, tuple[int, Take]] = {}
    matrices = []
    for name, array in arrays.items():
        shape = array.shape
        if not is_vector(shape) and not 0 < min(shape) <= MOST_COLUMNS:
            continue
        is_rate = max(shape) == 1 and _plain(re.split("[./]", name)[-1]) in RATE_NAMES
        axis = int(np.argmax(shape))  # time is the longest axis
        places = {name: 0}
        if not is_vector(shape):
            places = {f"{name}[{i}]": i for i in range(min(shape))}
            first, last = (repr(f"{name}[{i}]") for i in (0, min(shape) - 1))
            matrices.append(Finding("matrix-columns", name=repr(name), first=first, last=last))
        for place, i in places.items():
            columns.append(Column(place, is_by_name=is_rate or place != name, **descriptions[name]))
            takes[place] = (max(shape), _take(array, axis, i))

    def read(names: Sequence[str]) -> Iterator[Block]:
        # check the size first: the type of a variable may be known only once it is loaded
        check_samples(path, max(takes[name][0] for name in names))
        for name in names:
            kind = arrays[name if name in arrays else name.rpartition("[")[0]].dtype
            if kind.kind not in "iuf":
                raise TripError.at(path, "column-not-real", name=repr(name), value=kind)
        return slices(path, names, takes)

    return OpenFile(tuple(columns), read, hint=together(matrices[:3]))


def _take(array: Any, axis: int, i: int) -> Take:
    before, after = (i,) * axis, (i,) * (len(array.shape) - axis - 1)
    return lambda rows: array[(*before, rows, *after)]


def _siblings(name: str, separator: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the same struct, group or file by their names in it."""
    parent, _, _ = name.rpartition(separator)
    split = ((key.rpartition(separator), value) for key, value in values.items())
    return {last: value for (first, _, last), value in split if first == parent}


def _attributes(dataset: Any) -> dict[str, Any]:
    attributes: dict[str, Any] = {}
    for key in dataset.attrs:
        with suppress(*([] if key in FILL_NAMES else [Exception])):  # of types without equivalent
            if dataset.attrs.get_id(key).get_storage_size() <= MOST_NOTE_BYTES:
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


def _plain(key: str) -> str:
    return re.sub(r"[\s_]", "", key).lower()


def _stated_nearby(name: str, siblings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what siblings state of an array; times and speeds have no unit of acceleration."""
    stated = _stated(siblings)
    if _OTHER_KIND.fullmatch(name.lower()) and size_of("acceleration", stated.get("unit")):
        stated.pop("unit")
    return stated


def _stated(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate, unit and date among named values, as arguments of `Column`."""
    stated: dict[str, Any] = {}
    for key, value in values.items():
        plain, array = _plain(key), np.asarray(value)
        if plain in RATE_NAMES:
            if array.size == 1 and array.dtype.kind in "iuf" and 0 < array.item() < 1e9:
                stated["rate_hz"] = float(array.item())
        elif plain in (*UNIT_NAMES, *DATE_NAMES) and array.size == 1:
            text = array.item()
            text = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
            if isinstance(text, str) and text.strip():
                stated["unit" if plain in UNIT_NAMES else "date"] = text.strip()
    return stated
