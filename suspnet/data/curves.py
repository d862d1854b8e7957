"""Training data from a vehicle alone: degraded vehicles -> noisy curves -> features."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

import suspnet
from suspnet.data.noise import add_noise
from suspnet.data.protocols import RESPONSES, Task
from suspnet.data.storage import (
    DamagedFileError,
    content_hash,
    dump_arrays,
    read_arrays,
    write_atomically,
)
from suspnet.dynamics import PARAMETERS, ResponseGenerator

BLOCK = 128
"""Curves made at once: small enough to stay in cache, and the unit of reproducible noise."""
TRAIN, TEST = 0, 1
log = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class CurveSettings:
    """Frequency bins, noise and numbers of curves.

    Parameters
    ----------
    n_train, n_test : int or "all"
        Curves for training and testing; "all" is the whole grid of the protocol.
    snr_db : float, [dB]
        Signal-to-noise ratio of each curve.
    low_hz, high_hz, step_hz : float, [Hz]
        Frequency bins from low_hz up to high_hz.
    cache_dir : str or None
        Where feature tables are kept between runs; None keeps none.

    Raises
    ------
    TypeError, ValueError
        If a setting has the wrong type or is out of range.
    """

    n_train: int | str = 20_000
    n_test: int | str = 4_000
    snr_db: float = 34.0
    low_hz: float = 0.1
    high_hz: float = 20.0
    step_hz: float = 0.02
    cache_dir: str | None = ".cache/suspnet"

    def __post_init__(self) -> None:
        for name in ("n_train", "n_test"):
            _check_count(name, getattr(self, name))
        for name in ("snr_db", "low_hz", "high_hz", "step_hz"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise TypeError(f"`data.{name}` must be a number, got {value!r}")
        if not -20 <= self.snr_db <= 200:
            raise ValueError(f"`data.snr_db` must lie in -20 to 200 dB, got {self.snr_db}")
        if not 0 < self.step_hz <= self.low_hz < self.high_hz:
            raise ValueError(
                "need 0 < data.step_hz <= data.low_hz < data.high_hz, got "
                f"{self.step_hz}, {self.low_hz}, {self.high_hz}"
            )

    def frequencies_hz(self) -> Tensor:
        """Return the frequency bins, shape (n_freq,), [Hz]."""
        n_bins = math.floor((self.high_hz - self.low_hz) / self.step_hz + 1e-9) + 1
        return self.low_hz + self.step_hz * torch.arange(n_bins, dtype=torch.float64)


@dataclass(frozen=True)
class FeatureData:
    """Inputs and outputs of a learning problem, one row a curve.

    Attributes
    ----------
    inputs : array of shape (n_curves, n_inputs), [-]
        Features relative to the healthy vehicle's (and the mass ratio where it is known); NaN
        where a peak is missing.
    outputs : array of shape (n_curves, n_outputs), [-]
        Parameters relative to healthy.
    ratios : array of shape (n_curves, 5), [-]
        All parameters relative to healthy, in the order of ``PARAMETERS``.
    reasons : array of shape (n_curves, n_peaks)
        A ``PeakReason`` for each peak.
    """

    inputs: FloatArray
    outputs: FloatArray
    ratios: FloatArray
    reasons: NDArray[np.int64]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where every feature was found, shape (n_curves,)."""
        return np.asarray(np.isfinite(self.inputs).all(axis=1))

    def complete(self) -> FeatureData:
        """Return the curves on which every feature was found.

        Raises
        ------
        ValueError
            If there is none.
        """
        kept = self.valid
        if not kept.any():
            raise ValueError(f"none of the {len(kept)} curves has all of its peaks")
        return FeatureData(
            self.inputs[kept], self.outputs[kept], self.ratios[kept], self.reasons[kept]
        )


@dataclass(frozen=True)
class CurveSource:
    """Noisy curves of a task's degraded vehicles, and their features.

    Parameters
    ----------
    generator : ResponseGenerator
    task : Task
    settings : CurveSettings
    seed : int
        Chooses vehicles and noise; block b of stream s draws its noise from (seed, s, b) alone.
    threads : int
        Blocks made at the same time.
    progress : bool
        Show a progress bar.
    """

    generator: ResponseGenerator
    task: Task
    settings: CurveSettings
    seed: int = 0
    threads: int = 1
    progress: bool = False

    def features(self, stream: int) -> FeatureData:
        """Return training (stream 0) or test (stream 1) features, from the cache if it has them.

        Raises
        ------
        ValueError
            If more curves are asked for than there are, or the healthy vehicle lacks a peak.
        """
        path = self._cache_path(stream)
        if path is not None:
            cached = _read_cache(path)
            if cached is not None:
                return cached
        data = self._make_features(stream)
        if path is not None:
            write_atomically(path, dump_arrays(asdict(data)))
        return data

    def ratios(self, stream: int) -> FloatArray:
        """Return the parameter ratios of a stream's vehicles, shape (n_curves, 5), [-]."""
        wanted = self.settings.n_test if stream == TEST else self.settings.n_train
        n_curves = None if wanted == "all" else int(wanted)
        return self.task.sample(n_curves, self.seed, stream)

    def curves(self, ratios: FloatArray, stream: int, block: int) -> Tensor:
        """Return the noisy magnitudes of one block of vehicles, shape (<= BLOCK, 2, n_freq)."""
        rows = torch.as_tensor(ratios[block * BLOCK : (block + 1) * BLOCK])
        magnitudes = self.generator.magnitudes(rows, self.settings.frequencies_hz())
        noise_seed = np.random.SeedSequence([self.seed, stream, block]).generate_state(1, np.uint64)
        return add_noise(magnitudes, self.settings.snr_db, int(noise_seed[0] >> np.uint64(1)))

    def noise_free(self, ratios: FloatArray) -> Tensor:
        """Return magnitudes without noise, shape (n_curves, 2, n_freq)."""
        return self.generator.magnitudes(torch.as_tensor(ratios), self.settings.frequencies_hz())

    def healthy_features(self) -> FloatArray:
        """Return the healthy vehicle's features, shape (n_features,).

        Raises
        ------
        ValueError
            If one of its peaks is missing.
        """
        frequencies_hz = self.settings.frequencies_hz()
        magnitudes = self.noise_free(np.ones((1, len(PARAMETERS))))
        table = self.task.extractor.extract(magnitudes, frequencies_hz.to(magnitudes.device))
        missing = [
            name
            for name, reason in zip(self.task.extractor.peaks, table.reasons[0], strict=True)
            if reason
        ]
        if missing:
            raise ValueError(
                f"the healthy vehicle has no peak {missing} between {self.settings.low_hz} and "
                f"{self.settings.high_hz} Hz; check the vehicle, data.low_hz and data.high_hz"
            )
        return np.asarray(table.values[0].cpu().numpy())

    def n_blocks(self, n_curves: int) -> int:
        """Return the number of blocks that hold `n_curves`."""
        return -(-n_curves // BLOCK)

    def _make_features(self, stream: int) -> FeatureData:
        ratios = self.ratios(stream)
        healthy = self.healthy_features()
        values = np.empty((len(ratios), len(healthy)))
        reasons = np.empty((len(ratios), len(self.task.extractor.peaks)), dtype=np.int64)

        def make(block: int) -> None:
            rows = slice(block * BLOCK, (block + 1) * BLOCK)
            magnitudes = self.curves(ratios, stream, block)
            frequencies_hz = self.settings.frequencies_hz().to(magnitudes.device)
            table = self.task.extractor.extract(magnitudes, frequencies_hz)
            values[rows] = table.values.cpu().numpy() / healthy
            reasons[rows] = table.reasons.cpu().numpy()

        name = f"{self.task.protocol}/{self.task.group} {'test' if stream else 'training'} curves"
        bar = tqdm(total=len(ratios), desc=name, unit="curve", disable=quiet(self.progress))
        with bar, _single_threaded_torch(self.threads), _pool(self.threads) as pool:
            for _ in pool.map(make, range(self.n_blocks(len(ratios)))):
                bar.update(min(BLOCK, len(ratios) - bar.n))
        mass = [ratios[:, PARAMETERS.index("M_s")]] if self.task.mass_known else []
        inputs = np.column_stack([values, *mass])
        return FeatureData(inputs, ratios[:, self.task.output_indices], ratios, reasons)

    def _cache_path(self, stream: int) -> Path | None:
        if self.settings.cache_dir is None:
            return None
        name = content_hash(self.describe(stream))
        return Path(self.settings.cache_dir) / f"features-{name[:32]}.safetensors"

    def describe(self, stream: int) -> dict[str, Any]:
        """Return everything that the features depend on, as JSON-able values."""
        settings = asdict(self.settings)
        del settings["cache_dir"], settings["n_train"], settings["n_test"]
        wanted = self.settings.n_test if stream == TEST else self.settings.n_train
        description = {
            "generator": [type(self.generator).__name__, asdict(self.generator)],  # type: ignore[call-overload]
            "task": asdict(self.task),
            "settings": settings,
            "n_curves": wanted,
            "seed": self.seed,
            "stream": stream,
            "version": suspnet.__version__,
            "code": _code_hash(),
        }
        plain: dict[str, Any] = json.loads(json.dumps(description))
        return plain


def quiet(progress: bool) -> bool | None:
    """Return tqdm's `disable`: no bar if not wanted, nor where there is no terminal to draw on."""
    return None if progress else True


def used_responses(task: Task) -> list[int]:
    """Return which of the two responses a task may use, as indices."""
    return [RESPONSES.index(name) for name in task.responses]


def _check_count(name: str, value: int | str) -> None:
    if value == "all":
        return
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"`data.{name}` must be a whole number or 'all', got {value!r}")
    if value < 1:
        raise ValueError(f"`data.{name}` must be >= 1, got {value}")


def _read_cache(path: Path) -> FeatureData | None:
    try:
        return FeatureData(**read_arrays(path))
    except FileNotFoundError:
        return None
    except (DamagedFileError, TypeError) as error:
        log.warning("ignoring a damaged cache file: %s", error)
        return None


def _code_hash() -> str:
    package = Path(suspnet.__file__).parent
    files = sorted(
        f for part in ("dynamics", "features", "data") for f in (package / part).glob("*.py")
    )
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@contextmanager
def _single_threaded_torch(workers: int) -> Iterator[None]:
    """Let blocks, not operations, share the cores: the arrays of a block are too small to split."""
    before = torch.get_num_threads()
    torch.set_num_threads(1 if workers > 1 else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _pool(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a pool that drops what is still waiting when it is left by an error or Ctrl-C."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
