"""Columns of MAT files before version 7.3: vectors, columns of matrices, fields of structs."""

from __future__ import annotations

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
MOST_COLUMNS = 1000
"""Largest number of columns of a matrix, and of cells of a variable."""
MOST_NOTE_BYTES = 2**12
"""Largest size of a text that may be a unit or a date."""
_OTHER_KIND = re.compile(r"(.*\.)?(t|v|[^.]*(time|zeit|speed|geschw|veloc)[^.]*)")
"""Names of times and speeds, in lower case."""


@contextmanager
def open_mat(path: Path) -> Iterator[OpenFile]:
    """Open a MAT file; its variables are read whole."""
    try:
        variables = [row for row in whosmat(path, appendmat=False) if not row[0].startswith("__")]
    except NotImplementedError as error:
        raise TripError.at(path, "mat-too-new") from error
    except TypeError as error:  # an object of MATLAB has no shape
        raise TripError.at(path, "matlab-objects") from error
    # variables of numbers are loaded when read; all others now, as they may hold or state something
    columns: dict[str, Any] = {}
    refused: dict[str, str] = {}
    loaded = []
    for name, shape, kind in variables:
        is_number = kind in NUMERIC
        if kind in ("struct", "cell", "object"):
            loaded.append(name)
        elif math.prod(shape) <= (MOST_NOTE_BYTES if kind == "char" else is_number):
            loaded.append(name)
        if is_number:
            columns[name] = _Variable(path, name, shape)
        elif kind not in ("struct", "cell", "object", "char"):
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
    too_wide = [name for name, array in columns.items() if not _is_table(array.shape)]
    for name in too_wide:
        refused[name] = Finding("is-an-array", shape=" x ".join(map(str, columns.pop(name).shape)))
    # values next to an array state its rate, unit and start
    notes = {name: _stated_nearby(name, leaves) for name in columns}
    yield _opened(path, columns, notes, refused)


def _is_table(shape: tuple[int, ...]) -> bool:
    return is_vector(shape) or (len(shape) <= 2 and min(shape) <= MOST_COLUMNS)


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


def _opened(
    path: Path,
    arrays: Mapping[str, Any],
    notes: Mapping[str, Mapping[str, Any]],
    refused: Mapping[str, str],
) -> OpenFile:
    """Return arrays by name as a file; a matrix has a column ``name[i]`` for each of its own."""
    columns = [Column(name, unread=why) for name, why in refused.items()]
    takes: dict[str, tuple[int, Take]] = {}
    for name, array in arrays.items():
        shape = array.shape
        is_rate = max(shape) == 1 and _plain(name.rpartition(".")[2]) in RATE_NAMES
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


def _plain(key: str) -> str:
    return re.sub(r"[\s_]", "", key).lower()


def _stated_nearby(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return rate, unit and date in the struct or file of an array, as arguments of `Column`."""
    stated: dict[str, Any] = {}
    for place, value in values.items():
        array, plain = np.asarray(value), _plain(place.rpartition(".")[2])
        if place.rpartition(".")[0] != name.rpartition(".")[0] or array.size != 1:
            continue
        if plain in RATE_NAMES and array.dtype.kind in "iuf" and 0 < array.item() < 1e9:
            stated["rate_hz"] = float(array.item())
        elif plain in (*UNIT_NAMES, *DATE_NAMES) and str(array.item()).strip():
            stated["unit" if plain in UNIT_NAMES else "date"] = str(array.item()).strip()
    # times and speeds have no unit of acceleration
    if _OTHER_KIND.fullmatch(name.lower()) and size_of("acceleration", stated.get("unit")):
        stated.pop("unit")
    return stated
