"""Columns of MAT files before version 7.3, and of arrays: vectors, columns of matrices, fields."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat
from scipy.io.matlab import MatlabFunction, mat_struct

from suspnet.ground.findings import Finding
from suspnet.trains.recordings.columns import (
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
"""Names of values that state rate [Hz], unit and start of the arrays next to them; compared in
lower case, without blanks and underscores."""
NUMERIC = ("single", "double", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)))
"""Classes of variables that hold numbers."""
MOST_COLUMNS = 1000  # largest number of columns of a matrix, and of cells of a variable
MOST_NOTE_BYTES = 2**12  # largest size of a text that may be a unit or a date
_OTHER_KIND = re.compile(r"(.*[./])?(t|v|[^./]*(time|zeit|speed|geschw|veloc)[^./]*)")
"""Names of times and speeds, in lower case."""


@contextmanager
def open_mat_5(path: Path) -> Iterator[OpenFile]:
    """Open a MAT file before version 7.3; its variables are read whole.

    Raises NotImplementedError if it is of version 7.3.
    """
    try:
        variables = [row for row in whosmat(path, appendmat=False) if not row[0].startswith("__")]
    except TypeError as error:  # an object of MATLAB has no shape
        raise TripError.at(path, "matlab-objects") from error
    # variables of numbers are loaded when read; all others now, as they may hold or state something
    columns: dict[str, Any] = {}
    refused: dict[str, str] = {}
    loaded = []
    for name, shape, kind in variables:
        is_number = kind in NUMERIC
        is_nested = kind in ("struct", "cell", "object")
        if is_nested or math.prod(shape) <= (MOST_NOTE_BYTES if kind == "char" else is_number):
            loaded.append(name)
        if is_number:
            columns[name] = _Variable(path, name, shape)
        elif not is_nested and kind != "char":
            refused[name] = f"holds {kind}, not numbers"
    # the contents of structs and cells are columns of their own, by their path
    how = {"appendmat": False, "struct_as_record": False, "squeeze_me": True}
    content = loadmat(path, variable_names=loaded, **how) if loaded else {}
    names = [name for name in loaded if name in content]
    leaves = {place: leaf for name in names for place, leaf in _leaves(name, content[name])}
    columns |= {
        name: np.atleast_1d(leaf)
        for name, leaf in leaves.items()
        if np.asarray(leaf).dtype.kind not in "OSU"
    }
    refused |= {name: why for name, array in columns.items() if (why := too_wide(array.shape))}
    columns = {name: array for name, array in columns.items() if name not in refused}
    # values next to an array state its rate, unit and start
    notes = {name: stated_nearby(name, siblings(name, leaves, ".")) for name in columns}
    yield array_file(path, columns, notes, refused)


def too_wide(shape: tuple[int, ...]) -> str:
    """Return why an array is no vector, nor a matrix of a few columns; empty if it is."""
    if is_vector(shape) or (len(shape) <= 2 and min(shape) <= MOST_COLUMNS):
        return ""
    return Finding("is-an-array", shape=" x ".join(map(str, shape)))


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, mat_struct):
        for field in value._fieldnames:
            yield from _leaves(f"{name}.{field}", getattr(value, field))
    elif isinstance(value, np.ndarray) and value.dtype == object:
        cells = () if isinstance(value, MatlabFunction) else value.ravel()[:MOST_COLUMNS]
        for i, cell in enumerate(cells):
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


def array_file(
    path: Path, arrays: dict[str, Any], notes: dict[str, dict[str, Any]], refused: dict[str, str]
) -> OpenFile:
    """Return arrays by name as a file; a matrix has a column ``name[i]`` for each of its own."""
    columns = [Column(name, unread=why) for name, why in refused.items()]
    takes: dict[str, tuple[int, Take]] = {}
    for name, array in arrays.items():
        shape = array.shape
        is_rate = max(shape) == 1 and plain_key(re.split("[./]", name)[-1]) in RATE_NAMES
        if is_rate or min(shape) == 0:
            continue
        axis = int(np.argmax(shape))  # time is the longest axis
        places = {name: 0}
        if not is_vector(shape):
            places = {f"{name}[{i}]": i for i in range(min(shape))}
        for place, i in places.items():
            columns.append(Column(place, **notes[name]))
            takes[place] = (max(shape), _take(array, axis, i))

    def read(names: Sequence[str]) -> Iterator[Block]:
        # check the size first: the type of a variable may be known only once it is loaded
        check_samples(path, max(takes[name][0] for name in names))
        for name in names:
            kind = arrays[name if name in arrays else name.rpartition("[")[0]].dtype
            if kind.kind not in "iuf":
                raise TripError.at(path, "column-not-real", name=repr(name), value=kind)
        return slices(path, names, takes)

    return OpenFile(tuple(columns), read)


def _take(array: Any, axis: int, i: int) -> Take:
    before, after = (i,) * axis, (i,) * (len(array.shape) - axis - 1)
    return lambda rows: array[(*before, rows, *after)]


def plain_key(key: str) -> str:
    """Return a name as those of rates, units and dates are compared."""
    return re.sub(r"[\s_]", "", key).lower()


def siblings(name: str, values: Mapping[str, Any], separator: str) -> dict[str, Any]:
    """Return the values of the same struct, group or file as an array, by their names in it."""
    parent = name.rpartition(separator)[0]
    split = ((place.rpartition(separator), value) for place, value in values.items())
    return {last: value for (first, _, last), value in split if first == parent}


def stated(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate, unit and date among named values, as arguments of `Column`."""
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        array, plain = np.asarray(value), plain_key(key)
        if array.size != 1:
            continue
        content = array.item()
        if plain in RATE_NAMES and array.dtype.kind in "iuf" and 0 < content < 1e9:
            arguments["rate_hz"] = float(content)
        elif plain in (*UNIT_NAMES, *DATE_NAMES):
            text = content.decode("utf-8", "replace") if isinstance(content, bytes) else content
            if isinstance(text, str) and text.strip():
                arguments["unit" if plain in UNIT_NAMES else "date"] = text.strip()
    return arguments


def stated_nearby(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return what values next to an array state; times and speeds have no unit of acceleration."""
    arguments = stated(values)
    if _OTHER_KIND.fullmatch(name.lower()) and size_of("acceleration", arguments.get("unit")):
        arguments.pop("unit")
    return arguments
