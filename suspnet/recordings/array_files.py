"""Columns of MAT and HDF5 files: vectors, columns of matrices, fields of structs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat

from suspnet.recordings.checked_mapping import TripError
from suspnet.recordings.columns import (
    Block,
    Column,
    OpenFile,
    Take,
    is_vector,
    needed,
    slices,
)
from suspnet.recordings.manifest import CsvDialect

RATE_NAMES = ("rate_hz", "fs", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")
UNIT_NAMES = ("unit", "units")
DATE_NAMES = ("start", "starttime", "startdate", "date", "datetime", "timestamp", "startzeit")
"""Names of fields and attributes, in lower case and without blanks and underscores, that say the
rate [Hz], the unit and the start of the data beside them."""

NUMERIC = (
    "single",
    "double",
    *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)),
)
"""Classes of the variables of a MAT file that hold numbers."""

MOST_PARTS = 1000
"""Largest number of columns of a matrix."""


@contextmanager
def open_hdf5(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open an HDF5 file."""
    h5py = needed(path, "h5py", "hdf5", "an HDF5 file")
    with h5py.File(path, "r") as file:
        arrays: dict[str, Any] = {}
        said: dict[str, Any] = {}

        def collect(name: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset):
                return
            if item.dtype.kind in "iuf" and item.size > 1 and len(item.shape) <= 2:
                if "MATLAB_empty" not in item.attrs and "MATLAB_int_decode" not in item.attrs:
                    arrays[name] = item
            said[name] = item

        file.visititems(collect)
        arrays |= {
            name: item
            for name, item in said.items()
            if item.size <= 1 and item.dtype.kind in "iuf" and is_vector(item.shape)
        }
        whole = {key: one for key, one in _stated(dict(file.attrs)).items() if key == "date"}
        notes = {name: whole | _notes(name, arrays[name], said) for name in arrays}
        with _opened(path, arrays, notes) as found:
            yield found


@contextmanager
def open_mat(path: Path, _: CsvDialect | None = None) -> Iterator[OpenFile]:
    """Open a MAT file; before version 7.3 its variables are read whole."""
    try:
        variables = whosmat(path)
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
    content = loadmat(path, variable_names=structs, simplify_cells=True) if structs else {}
    leaves = dict(_leaves({name: content[name] for name in structs if name in content}))
    arrays |= {
        name: np.atleast_1d(leaf)
        for name, leaf in leaves.items()
        if isinstance(leaf, np.ndarray | np.number | float | int)
        and np.asarray(leaf).dtype.kind in "iufc"
        and not isinstance(leaf, bool)
        and np.ndim(leaf) <= 2
    }
    with _opened(path, arrays, {name: _beside(name, leaves) for name in arrays}) as found:
        yield found


@dataclass(frozen=True)
class _Variable:
    """A numeric variable of a MAT file, which is read when it is asked for."""

    path: Path
    name: str
    shape: tuple[int, ...]

    @cached_property
    def values(self) -> Any:
        return loadmat(self.path, variable_names=[self.name])[self.name]

    @property
    def dtype(self) -> Any:
        return self.values.dtype

    def __getitem__(self, part: Any) -> Any:
        return self.values[part]


@contextmanager
def _opened(
    path: Path, arrays: Mapping[str, Any], notes: Mapping[str, Mapping[str, Any]]
) -> Iterator[OpenFile]:
    """Open arrays by their names; a matrix has a column ``name[i]`` for each of its columns."""
    columns: list[Column] = []
    takes: dict[str, tuple[int, Take]] = {}
    matrices = []
    for name, array in arrays.items():
        shape = array.shape
        if is_vector(shape):
            columns.append(Column(name, **notes[name]))
            takes[name] = (max(shape), _take(array, int(np.argmax(shape)), 0))
        elif 0 < min(shape) <= MOST_PARTS:
            axis = int(np.argmax(shape))  # time is the longer axis
            matrices.append(f"{name!r} has columns '{name}[0]' to '{name}[{min(shape) - 1}]'")
            for i in range(min(shape)):
                columns.append(Column(f"{name}[{i}]", is_part=True, **notes[name]))
                takes[f"{name}[{i}]"] = (max(shape), _take(array, axis, i))

    def read(names: Sequence[str]) -> Iterator[Block]:
        for name in names:
            kind = arrays[name if name in arrays else re.sub(r"\[\d+\]$", "", name)].dtype
            if kind.kind not in "iuf":
                raise TripError(f"{path}: column {name!r} holds {kind}, not real numbers")
        chosen = [takes[name] for name in names]
        return slices(path, names, [n for n, _ in chosen], [take for _, take in chosen])

    hint = f"; the matrix {'; '.join(matrices[:3])}" if matrices else ""
    yield OpenFile(tuple(columns), read, hint=hint)


def _take(array: Any, axis: int, i: int) -> Take:
    """Return a function that reads a slice along an axis of a vector, or of row i of a matrix."""
    before, after = (i,) * axis, (i,) * (len(array.shape) - axis - 1)
    return lambda part: array[(*before, part, *after)]


def _leaves(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the fields of structs in structs by their names, joined by dots."""
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _beside(name: str, leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate and unit of a field of a struct by the fields beside it."""
    struct, dot, _ = name.rpartition(".")
    if not dot:
        return {}
    beside = {key.rpartition(".")[2]: value for key, value in leaves.items()
              if key.rpartition(".")[0] == struct}  # fmt: skip
    return _stated(beside)


def _notes(name: str, dataset: Any, said: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate and unit of a data set by its attributes, or by the data sets of its group."""
    group, slash, _ = name.rpartition("/")
    beside = {}
    if slash:
        for key, item in said.items():
            if key.rpartition("/")[0] == group and item.size < 100:
                is_text = item.dtype == np.uint16 and item.attrs.get("MATLAB_class") == b"char"
                beside[key.rpartition("/")[2]] = _text(item[()]) if is_text else item[()]
    return _stated(beside) | _stated(dict(dataset.attrs))


def _text(codes: Any) -> str:
    """Return the text that MATLAB 7.3 stores as codes of its characters."""
    return "".join(chr(code) for code in np.asarray(codes).ravel())


def _stated(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rate and the unit among named values, as fields of a Column."""
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
