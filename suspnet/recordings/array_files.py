"""Columns of MAT and HDF5 files: vectors, columns of matrices, fields of structs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat

from suspnet.ground.extras import import_extra
from suspnet.recordings.columns import (
    MOST_CHUNK_BYTES,
    Block,
    Column,
    OpenFile,
    Take,
    check_samples,
    is_vector,
    slices,
)
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest_keys import CsvDialect

RATE_NAMES = ("rate_hz", "fs", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")
UNIT_NAMES = ("unit", "units")
DATE_NAMES = ("start", "starttime", "startdate", "date", "datetime", "timestamp", "startzeit")
"""Names of fields and attributes that state rate [Hz], unit and start of the data next to them;
compared in lower case, without blanks and underscores."""
NUMERIC = ("single", "double", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)))
"""Classes of MAT file variables that hold numbers."""
MOST_PARTS = 1000
"""Largest number of columns of a matrix."""
FILTERS = (1, 2, 3, 4, 5, 6, 32000)
"""Filters of the HDF5 library and h5py: deflate, shuffle, fletcher32, szip, nbit, scaleoffset and
LZF. Any other is a plug-in, that is, foreign code to load."""
MOST_NOTE_BYTES = 2**12
"""Largest size of a value that may be a rate, a unit or a date."""


@contextmanager
def open_hdf5(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open an HDF5 file; data sets that need other files or plug-ins are refused when read."""
    h5py = import_extra("h5py", "hdf5", f"{path}: an HDF5 file", TripError)
    with h5py.File(path, "r", rdcc_nbytes=MOST_CHUNK_BYTES) as file:
        arrays: dict[str, Any] = {}
        datasets: dict[str, Any] = {}
        refused: dict[str, str] = {}

        def collect(name: str, item: Any) -> None:  # h5py calls it for hard links only
            if not isinstance(item, h5py.Dataset):
                return
            if why := foreign(item):  # first, as reading the shape may open other files
                refused[name] = why
                return
            if item.dtype.kind in "iuf" and item.size > 1 and len(item.shape) <= 2:
                if "MATLAB_empty" not in item.attrs and "MATLAB_int_decode" not in item.attrs:
                    arrays[name] = item
            datasets[name] = item

        # single values follow the vectors, as most describe one of them and are no signals
        file.visititems(collect)
        arrays |= {
            name: item
            for name, item in datasets.items()
            if item.size <= 1 and item.dtype.kind in "iuf" and is_vector(item.shape)
        }
        whole = {key: one for key, one in _stated(dict(file.attrs)).items() if key == "date"}
        descriptions = {name: whole | _described(name, datasets) for name in arrays}
        with _opened(path, arrays, descriptions) as found:
            yield _refusing(path, found, refused)


def foreign(dataset: Any) -> str:
    """Return which other files, plug-in or excess of memory a data set needs; "" if none."""
    if dataset.is_virtual:
        return "is virtual, which takes samples from other files"
    plan = dataset.id.get_create_plist()
    if plan.get_external_count():
        return "is stored in other files"
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    others = [number for number in filters if number not in FILTERS]
    if others:
        return f"is packed by filter {others[0]}, which is a plug-in"
    piece = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if filters and piece > MOST_CHUNK_BYTES:
        return f"is packed in pieces of {piece} bytes, more than {MOST_CHUNK_BYTES}"
    return ""


def _refusing(path: Path, file: OpenFile, refused: Mapping[str, str]) -> OpenFile:
    """Return the file with its refused data sets as columns that raise their reason when read."""

    def read(names: Sequence[str]) -> Iterator[Block]:
        for name in names:
            if name in refused:
                raise TripError(
                    f"{path}: column {name!r} {refused[name]}; export it as plain numbers into one "
                    "file"
                )
        return file.read(names)

    columns = (*file.columns, *(Column(name) for name in refused))
    return replace(file, columns=columns, read=read)


@contextmanager
def open_mat(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a MAT file; before version 7.3 its variables are read whole."""
    try:
        variables = whosmat(path, appendmat=False)
    except NotImplementedError:  # version 7.3 is HDF5
        with open_hdf5(path) as file:
            yield file
        return
    arrays: dict[str, Any] = {
        name: _Variable(path, name, shape)
        for name, shape, kind in variables
        if kind in NUMERIC and len(shape) <= 2
    }
    structs = [name for name, _, kind in variables if kind == "struct"]
    content = _loaded(path, structs, simplify_cells=True) if structs else {}
    leaves = dict(_leaves({name: content[name] for name in structs if name in content}))
    arrays |= {
        name: np.atleast_1d(leaf)
        for name, leaf in leaves.items()
        if isinstance(leaf, np.ndarray | np.number | float | int)
        and np.asarray(leaf).dtype.kind in "iufc"
        and not isinstance(leaf, bool)
        and np.ndim(leaf) <= 2
    }
    descriptions = {name: _stated(_siblings(name, ".", leaves)) for name in arrays}
    with _opened(path, arrays, descriptions) as found:
        yield found


def _loaded(path: Path, names: Sequence[str], **how: bool) -> dict[str, Any]:
    """Load variables of a MAT file before version 7.3, by name."""
    found: dict[str, Any] = loadmat(path, variable_names=names, appendmat=False, **how)
    return found


@dataclass(frozen=True)
class _Variable:
    path: Path
    name: str
    shape: tuple[int, ...]

    @cached_property
    def values(self) -> Any:
        return _loaded(self.path, [self.name])[self.name]

    @property
    def dtype(self) -> Any:
        return self.values.dtype

    def __getitem__(self, part: Any) -> Any:
        return self.values[part]


@contextmanager
def _opened(
    path: Path, arrays: Mapping[str, Any], descriptions: Mapping[str, Mapping[str, Any]]
) -> Iterator[OpenFile]:
    """Open arrays by name; a matrix has one column ``name[i]`` for each of its columns."""
    columns: list[Column] = []
    takes: dict[str, tuple[int, Take]] = {}
    matrices = []
    for name, array in arrays.items():
        shape = array.shape
        if is_vector(shape):
            columns.append(Column(name, **descriptions[name]))
            takes[name] = (max(shape), _take(array, int(np.argmax(shape)), 0))
        elif 0 < min(shape) <= MOST_PARTS:
            axis = int(np.argmax(shape))  # time is the longer axis
            matrices.append(f"{name!r} has columns '{name}[0]' to '{name}[{min(shape) - 1}]'")
            for i in range(min(shape)):
                columns.append(Column(f"{name}[{i}]", is_part=True, **descriptions[name]))
                takes[f"{name}[{i}]"] = (max(shape), _take(array, axis, i))

    def read(names: Sequence[str]) -> Iterator[Block]:
        # check the size first: the type of a variable may be known only once it is loaded
        check_samples(path, max(takes[name][0] for name in names))
        for name in names:
            kind = arrays[name if name in arrays else re.sub(r"\[\d+\]$", "", name)].dtype
            if kind.kind not in "iuf":
                raise TripError(f"{path}: column {name!r} holds {kind}, not real numbers")
        chosen = [takes[name] for name in names]
        return slices(path, names, [n for n, _ in chosen], [take for _, take in chosen])

    hint = f"; the matrix {'; '.join(matrices[:3])}" if matrices else ""
    yield OpenFile(tuple(columns), read, hint=hint)


def _take(array: Any, axis: int, i: int) -> Take:
    before, after = (i,) * axis, (i,) * (len(array.shape) - axis - 1)
    return lambda part: array[(*before, part, *after)]


def _leaves(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _siblings(name: str, separator: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the same struct or group by their names in it; none at the top level."""
    parent, _, _ = name.rpartition(separator)
    if not parent:
        return {}
    split = ((key.rpartition(separator), value) for key, value in values.items())
    return {last: value for (first, _, last), value in split if first == parent}


def _described(name: str, datasets: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate, unit and date from a data set's attributes, or else from its group."""
    siblings = _siblings(name, "/", datasets)
    small = {key: _value(one) for key, one in siblings.items() if one.nbytes <= MOST_NOTE_BYTES}
    return _stated(small) | _stated(_attributes(datasets[name]))


def _attributes(dataset: Any) -> dict[str, Any]:
    """Return the small attributes of a data set."""
    sizes = {key: dataset.attrs.get_id(key).get_storage_size() for key in dataset.attrs}
    return {key: dataset.attrs[key] for key, size in sizes.items() if size <= MOST_NOTE_BYTES}


def _value(dataset: Any) -> Any:
    """Return the content of a data set, a text if MATLAB 7.3 stored its character codes."""
    content = dataset[()]
    if dataset.dtype != np.uint16 or dataset.attrs.get("MATLAB_class") != b"char":
        return content
    return "".join(chr(code) for code in np.asarray(content).ravel())


def _stated(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate, unit and date among named values, as arguments of `Column`."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        plain = re.sub(r"[\s_]", "", key).lower()
        array = np.asarray(value)
        if plain in [name.replace("_", "") for name in RATE_NAMES]:
            if array.size == 1 and array.dtype.kind in "iuf" and 0 < array.item() < 1e9:
                found["rate_hz"] = float(array.item())
        elif plain in (*UNIT_NAMES, *DATE_NAMES) and array.size == 1:
            text = array.item()
            text = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
            if isinstance(text, str) and text.strip():
                found["unit" if plain in UNIT_NAMES else "date"] = text.strip()
    return found
