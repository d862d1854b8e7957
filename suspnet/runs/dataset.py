"""Data sets: the curves, features and bounds of a problem as one file, for any other software.

The test curves come with the Cramer-Rao bound of their outputs, so that a file is a benchmark: the
rms error of a method over the bound is 1 at best, whatever it learns from.
"""

import io
import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspnet._version import __version__
from suspnet.bounds.information import output_bounds, over_bound
from suspnet.curves.problem import BLOCK, CALIBRATE, TEST, TRAIN, Problem
from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.settings import check_choice
from suspnet.ground.storage import write_atomically
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.learning.metrics import check_estimates

SPLITS = {"train": TRAIN, "test": TEST, "calibrate": CALIBRATE}
"""Name of each split and its stream of curves."""
SUFFIX = ".npz"
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
        numbers = np.column_stack([error, least, over_bound(error, least)]).tolist()
        names = "rms_percent", "bound_percent", "ratio"
        scores = (dict(zip(names, row, strict=True)) for row in numbers)
        return dict(zip(self.about["outputs"], scores, strict=True))


ARRAYS = tuple(column.name for column in fields(DataSet)[:-1])  # names of the arrays of a data set


def make_dataset(problem: Problem) -> DataSet:
    """Return the training, test and calibration curves of a problem."""
    arrays: dict[str, list[Any]] = {name: [] for name in ARRAYS[:-1]}
    for name, stream in SPLITS.items():
        if stream == CALIBRATE and not problem.settings.n_calibrate:
            continue
        data = problem.features(stream)
        # block by block, as curves with noise are made that way
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
    """Write a data set, or that of a problem, to NAME.npz; return the path.

    ValueError if the suffix is another one, FileExistsError if the file exists.
    """
    path = Path(path)
    check_choice("suffix", path.suffix, (SUFFIX,))
    if path.exists():
        raise FileExistsError(f"{path} exists; name a new file")
    data = make_dataset(data) if isinstance(data, Problem) else data
    arrays: dict[str, Any] = {name: getattr(data, name) for name in ARRAYS}
    stream = io.BytesIO()
    np.savez(stream, **arrays, about=np.array(json.dumps(data.about)))
    return write_atomically(path, stream.getvalue())


def read_dataset(path: Path | str) -> DataSet:
    """Return the data set that `write_dataset` wrote; ValueError if a file is none.

    Nothing in the file is run: it holds numbers and text.
    """
    path = Path(path)
    check_choice("suffix", path.suffix, (SUFFIX,))
    try:
        with ZipFile(path) as packed:  # what is stored as it is takes no more memory than the file
            if any(part.compress_type != ZIP_STORED for part in packed.infolist()):
                raise ValueError("it is compressed; save the arrays by numpy.savez")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ARRAYS}
            return DataSet(**arrays, about=json.loads(str(file["about"])))
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise ValueError(f"{path} is no data set of suspnet: {error}") from error
