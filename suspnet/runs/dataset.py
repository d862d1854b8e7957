"""Data sets: the curves, features and bounds of a problem as one file, for any other software.

The test curves come with the Cramer-Rao bound of their outputs, so that a file is a benchmark: the
rms error of a method over the bound is 1 at best, whatever it learns from.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspnet._version import __version__
from suspnet.estimation.information import output_bounds, over_bound
from suspnet.estimation.problem import BLOCK, CALIBRATE, TEST, TRAIN, Problem
from suspnet.ground.extras import import_extra
from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.settings import check_choice
from suspnet.ground.storage import write_atomically
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.learning.metrics import check_estimates

SPLITS = {"train": TRAIN, "test": TEST, "calibrate": CALIBRATE}
"""Name of each split and its stream of curves."""
ABOUT = "about"
"""Name of the JSON text that describes a file's columns."""
UNREADABLE = (KeyError, MemoryError, OSError, TypeError, ValueError, BadZipFile)
"""Errors of the libraries on a file that is no data set."""


@dataclass(frozen=True, repr=False)
class DataSet(ShortRepr):
    """Curves of a problem, one row per curve, with their features, their truth and their bound.

    Attributes
    ----------
    X : array of shape (n_curves, n_inputs), [-]
        Features relative to the healthy vehicle's; NaN where a peak is missing.
    Y : array of shape (n_curves, n_outputs), [-]
        Parameters relative to healthy: the truth.
    curves : array of shape (n_curves, 2, n_freq)
        G_p and G_s with noise: magnitudes, or complex for a problem of trips.
    noise : array of shape (n_curves, 2, n_freq)
        What was added to the noise-free curves.
    ratios : array of shape (n_curves, 5), [-]
        All parameters, in the order of ``PARAMETERS``.
    bound : array of shape (n_curves, n_outputs), [-]
        Cramer-Rao standard deviation of each output; NaN except for test curves.
    split : array of shape (n_curves,)
        "train", "test" or "calibrate".
    frequencies_hz : array of shape (n_freq,), [Hz]
    about : dict
        Names of inputs and outputs, vehicle, protocol, noise, seed and version.
    """

    X: FloatArray
    Y: FloatArray
    curves: NDArray[Any]
    noise: NDArray[Any]
    ratios: FloatArray
    bound: FloatArray
    split: NDArray[Any]
    frequencies_hz: FloatArray
    about: dict[str, Any]

    def rows(self, split: str) -> BoolArray:
        """Return where a split's curves with every feature are, shape (n_curves,)."""
        check_choice("split", split, tuple(SPLITS))
        return np.asarray((self.split == split) & np.isfinite(self.X).all(axis=1))

    def score(self, predicted: ArrayLike) -> dict[str, dict[str, float]]:
        """Return rms error [%], bound [%] and their ratio of each output.

        `predicted` (n_rows, n_outputs) are estimates of ``Y[rows("test")]``. ValueError if the
        shape differs or an estimate is not finite.
        """
        rows = self.rows("test")
        truth, bound = self.Y[rows], self.bound[rows]
        rule = '`predicted` must hold finite estimates of Y[rows("test")]'
        estimates = check_estimates(rule, predicted, (len(truth), truth.shape[1]))
        error = 100 * np.sqrt(np.mean((estimates / truth - 1) ** 2, axis=0))
        least = 100 * np.sqrt(np.mean((bound / truth) ** 2, axis=0))
        return {
            name: dict(zip(("rms_percent", "bound_percent", "ratio"), numbers, strict=True))
            for name, *numbers in zip(
                self.about["outputs"],
                error.tolist(),
                least.tolist(),
                over_bound(error, least).tolist(),
                strict=True,
            )
        }


def make_dataset(problem: Problem) -> DataSet:
    """Return the training, test and calibration curves of a problem."""
    arrays: dict[str, list[Any]] = {column.name: [] for column in fields(DataSet)[:7]}
    for name, stream in SPLITS.items():
        if stream == CALIBRATE and not problem.settings.n_calibrate:
            continue
        data = problem.features(stream)
        for block in range(problem.n_blocks(len(data.ratios))):
            curves = problem.observer.for_features(problem.curves(data.ratios, stream, block))
            clean = problem.noise_free(data.ratios[block * BLOCK : (block + 1) * BLOCK])
            arrays["curves"].append(curves.cpu().numpy())
            arrays["noise"].append((curves - clean).cpu().numpy())
        bound = np.full_like(data.outputs, np.nan)
        if stream == TEST:
            bound = output_bounds(problem.task, problem.observer, data.ratios)
        arrays["X"].append(data.inputs)
        arrays["Y"].append(data.outputs)
        arrays["ratios"].append(data.ratios)
        arrays["bound"].append(bound)
        arrays["split"].append(np.full(len(bound), name))
    return DataSet(
        **{name: np.concatenate(several) for name, several in arrays.items()},
        frequencies_hz=problem.observer.frequencies_hz.cpu().numpy(),
        about={
            "suspnet_version": __version__,
            "inputs": list(replace(problem.task, extractor=problem.extractor).inputs),
            "outputs": list(problem.task.outputs),
            "parameters": list(PARAMETERS),
            "vehicle": problem.vehicle.name,
            "protocol": problem.task.protocol,
            "group": problem.task.group,
            "generator": type(problem.generator).__name__,
            "snr_db": problem.settings.snr_db,
            "seed": problem.seed,
        },
    )


def write_dataset(data: DataSet | Problem, path: Path | str) -> Path:
    """Write a data set, or that of a problem, to NAME.npz or NAME.h5; return the path.

    Raises
    ------
    ValueError
        If the suffix is another one, or h5py is needed and not installed.
    FileExistsError
        If the file exists: nothing is replaced.
    """
    path = Path(path)
    check_choice("suffix", path.suffix, tuple(WRITERS))
    if path.exists():
        raise FileExistsError(f"{path} exists; name a new file")
    data = make_dataset(data) if isinstance(data, Problem) else data
    return write_atomically(path, WRITERS[path.suffix](data))


def read_dataset(path: Path | str) -> DataSet:
    """Return the data set that `write_dataset` wrote; ValueError if a file is none.

    Nothing in the file is run: it holds numbers and text.
    """
    path = Path(path)
    check_choice("suffix", path.suffix, tuple(READERS))
    try:
        arrays = READERS[path.suffix](path)
        about = json.loads(str(arrays.pop(ABOUT)))
        arrays["split"] = np.asarray(arrays["split"]).astype(str)
        return DataSet(**arrays, about=about)
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise ValueError(f"{path} is no data set of suspnet: {error}") from error


def _arrays(data: DataSet) -> dict[str, NDArray[Any]]:
    return {column.name: getattr(data, column.name) for column in fields(DataSet)[:-1]}


def _npz(data: DataSet) -> bytes:
    stream = io.BytesIO()
    arrays: dict[str, Any] = _arrays(data) | {ABOUT: np.array(json.dumps(data.about))}
    np.savez(stream, **arrays)
    return stream.getvalue()


def _read_npz(path: Path) -> dict[str, Any]:
    with ZipFile(path) as packed:  # what is stored as it is takes no more memory than the file
        if any(part.compress_type != ZIP_STORED for part in packed.infolist()):
            raise ValueError("it is compressed; save the arrays by numpy.savez")
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in (column.name for column in fields(DataSet))}


def _hdf5(data: DataSet) -> bytes:
    h5py = import_extra("h5py", "hdf5", "a file NAME.h5")
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name, array in _arrays(data).items():
            text = array.dtype.kind == "U"
            file[name] = array.astype("S") if text else array
        file.attrs[ABOUT] = json.dumps(data.about)
    return stream.getvalue()


def _read_hdf5(path: Path) -> dict[str, Any]:
    from suspnet.recordings.array_files import foreign

    h5py = import_extra("h5py", "hdf5", "a file NAME.h5")
    arrays: dict[str, Any] = {}
    with h5py.File(path, "r") as file:
        for name in (column.name for column in fields(DataSet)[:-1]):
            # links and data sets may lead to any other file of the reader's
            if name in file and not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{name} is a link")
            if words := foreign(file[name]):
                raise ValueError(f"{name} {words}")
            if file[name].nbytes > file[name].id.get_storage_size():
                raise ValueError(f"{name} is compressed or declares more than it holds")
            arrays[name] = file[name][()]
        return arrays | {ABOUT: file.attrs[ABOUT]}


WRITERS: Mapping[str, Callable[[DataSet], bytes]] = {".npz": _npz, ".h5": _hdf5}
READERS: Mapping[str, Callable[[Path], dict[str, Any]]] = {".npz": _read_npz, ".h5": _read_hdf5}
