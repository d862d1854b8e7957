"""A learning problem and its training data, which follow from the vehicle alone.

Degraded vehicles -> noisy curves -> features, block by block.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.estimates import Observation, Observer
from suspnet.curves.extraction import FeatureSet, FeatureTable, PeakFeatures
from suspnet.curves.protocols import BODY_MASS_COLUMN, RESPONSES, TEST_STREAM, Task
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.settings import check_number
from suspnet.ground.tensors import as_tensor, threads
from suspnet.ground.types import BoolArray, FloatArray, IntArray
from suspnet.vehicle import PARAMETERS, ResponseGenerator, Vehicle

LEARN_FROM = 4096  # number of training curves to which a feature set is fitted
BLOCK = 128
"""Number of curves generated at once: they fit into the CPU cache and share one noise seed."""
BATCH = 2 * BLOCK
"""Number of curves whose features are extracted at once; larger arrays need Python's lock less
often."""
TRAIN, TEST, CALIBRATE = 0, TEST_STREAM, 2
"""Streams of independent curves: for training, for scores, for the calibration of intervals."""
STREAM_NAMES = ("training", "test", "calibration")  # names of the streams


@dataclass(frozen=True)
class Problem:
    """A learning problem, and the source of its noisy curves and their features.

    `settings` say how curves are observed; missing ends of the band follow from the generator's
    vehicle. `seed` is that of vehicles and noise: block b of stream s draws its noise from (seed,
    s, b) alone. `threads` blocks of curves are generated in parallel. TypeError or ValueError if
    generator or task are none, a number is not whole, or the vehicle leaves no band.
    """

    generator: ResponseGenerator
    task: Task
    settings: Observation
    seed: int = 0
    threads: int = 1
    progress: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.generator, ResponseGenerator):
            got = type(self.generator).__name__
            raise TypeError(f"`generator` must be one such as QuarterCar(vehicle), got {got}")
        if not isinstance(self.task, Task):
            got = type(self.task).__name__
            raise TypeError(f"`task` must be that of a protocol's group, got {got}")
        check_number("seed", self.seed, low=0, whole=True)
        check_number("threads", self.threads, low=1, most=1024, whole=True)
        bound = self.settings.bound(self.vehicle).counted(self.is_uncertain)
        object.__setattr__(self, "settings", bound)

    @property
    def vehicle(self) -> Vehicle:
        """The healthy vehicle."""
        return self.generator.vehicle

    @property
    def is_uncertain(self) -> bool:
        """Whether numbers of the vehicle are uncertain, so that fits of the curve read trips."""
        return bool(self.generator.distribution and self.generator.distribution.names)

    @cached_property
    def observer(self) -> Observer:
        """The observer that generates the curves."""
        return self.settings.observer(self.generator)

    @cached_property
    def extractor(self) -> FeatureSet:
        """The task's feature set, fitted to training curves if necessary."""
        extractor = self.task.extractor
        if extractor.is_fitted:
            return extractor
        ratios = self.ratios(TRAIN)[:LEARN_FROM]
        blocks = range(self.n_blocks(len(ratios)))
        healthy = self.noise_free(np.ones((1, len(PARAMETERS))))[0]

        def make(block: int) -> tuple[Tensor, Tensor]:
            rows = ratios[block * BLOCK : (block + 1) * BLOCK]
            noisy, clean = self.curves(ratios, TRAIN, block), self.noise_free(rows)
            return self.observer.for_features(noisy), self.observer.for_features(clean)

        name = f"{self.task.protocol}/{self.task.group} features"
        bar = progress_bar(name, len(blocks), unit="block", shown=self.progress)
        made = []
        with bar, pool_of(self.threads) as pool:
            for pair in pool.map(make, blocks):
                made.append(pair)
                bar.update()
        noisy, clean = map(torch.cat, zip(*made, strict=True))
        bins = self.observer.frequencies_hz.to(healthy.device)
        return extractor.fitted(clean, noisy, healthy, bins)

    def ratios(self, stream: int) -> FloatArray:
        """Return the parameter ratios of a stream's vehicles, shape (n_curves, 5), [-]."""
        settings = self.settings
        assert settings.n_train is not None  # filled in above
        wanted = (settings.n_train, settings.n_test, settings.n_calibrate or 0)[stream]
        return self.task.sample(None if wanted == "all" else int(wanted), self.seed, stream)

    def curves(self, ratios: FloatArray, stream: int, block: int) -> Tensor:
        """Return the noisy curves of one block of vehicles, shape (<= BLOCK, 2, n_freq)."""
        rows = as_tensor(ratios[block * BLOCK : (block + 1) * BLOCK])
        noise_seed = np.random.SeedSequence([self.seed, stream, block]).generate_state(1, np.uint64)
        return self.observer.observe(rows, int(noise_seed[0] >> np.uint64(1)))

    def noise_free(self, ratios: FloatArray) -> Tensor:
        """Return curves without noise, shape (n_curves, 2, n_freq)."""
        return self.observer.noise_free(as_tensor(ratios))

    def healthy_features(self) -> FloatArray:
        """Return the healthy vehicle's features, (n_features,); ValueError if one is missing."""
        curves = self.noise_free(np.ones((1, len(PARAMETERS))))
        table = self._extracted(curves)
        if table.reasons[0].any():
            missing = self.extractor.missing(table.reasons[0].cpu().numpy())
            raise ValueError(
                f"of the healthy vehicle is missing, between {self.settings.low_hz} and "
                f"{self.settings.high_hz} Hz: {missing}; {self._remedy(curves[0])}"
            )
        return np.asarray(table.values[0].cpu().numpy())

    def _remedy(self, healthy: Tensor) -> str:
        """Return where features of the healthy curves (2, n_freq) were searched, and what to do."""
        bounds = "check the vehicle, data.low_hz and data.high_hz"
        if not isinstance(self.extractor, PeakFeatures):
            return bounds
        searched = self.extractor.where_searched(healthy, self.observer.frequencies_hz)
        other = "" if len(self.task.responses) == len(RESPONSES) else "protocol=multi_location "
        return f"{searched}; {bounds}, or take {other}protocol.feature_set=curve: it has no peaks"

    def _extracted(self, curves: Tensor) -> FeatureTable:
        """Return the features of curves; ValueError if the table is not as wide as it should be."""
        extractor = self.extractor
        table = extractor.extract(curves, self.observer.frequencies_hz.to(curves.device))
        for array, part in (("values", "names"), ("reasons", "parts")):
            shape = tuple(getattr(table, array).shape)
            expected = (len(curves), len(getattr(extractor, part)))
            if shape != expected:
                raise ValueError(
                    f"`{array}` of the feature set {extractor.kind!r} must have a row for each "
                    f"curve and a column for each of its `{part}`, {expected}, got {shape}"
                )
        return table

    def n_blocks(self, n_curves: int) -> int:
        """Return the number of blocks that hold `n_curves`."""
        return -(-n_curves // BLOCK)

    def features(self, stream: int, n_first: int | None = None) -> FeatureData:
        """Return the features of a stream's curves, computed in threads; NaN where one is missing.

        `stream` is ``TRAIN``, ``TEST`` or ``CALIBRATE``; `n_first`: of so many curves only.
        ValueError if the grid has fewer curves, or the healthy vehicle lacks a peak.
        """
        ratios = self.ratios(stream)
        computed = slice(0, len(ratios) if n_first is None else -(-n_first // BLOCK) * BLOCK)
        ratios = ratios[computed]
        healthy = self.healthy_features()
        values = np.empty((len(ratios), len(healthy)))
        extractor = self.extractor
        reasons = np.empty((len(ratios), len(extractor.parts)), dtype=np.int64)

        def make(start: int) -> int:
            rows = slice(start, min(start + BATCH, len(ratios)))
            blocks = range(rows.start // BLOCK, self.n_blocks(rows.stop))
            noisy = torch.cat([self.curves(ratios, stream, block) for block in blocks])
            table = self._extracted(self.observer.for_features(noisy))
            values[rows] = extractor.relative(table.values.cpu().numpy(), healthy)
            reasons[rows] = table.reasons.cpu().numpy()
            return len(noisy)

        name = f"{self.task.protocol}/{self.task.group} {STREAM_NAMES[stream]} curves"
        bar = progress_bar(name, len(ratios), unit="curve", shown=self.progress)
        with bar, pool_of(self.threads) as pool:
            for n_made in pool.map(make, range(0, len(ratios), BATCH)):
                bar.update(n_made)
        mass = [ratios[:, BODY_MASS_COLUMN]] if self.task.mass_known else []
        inputs = np.column_stack([values, *mass])
        outputs = ratios[:, self.task.output_indices]
        data = FeatureData(inputs, outputs, ratios, reasons)
        return data if n_first is None else data.first(n_first)


@dataclass(frozen=True)
class FeatureData:
    """Inputs and outputs of a learning problem, one row per curve.

    `inputs` (n_curves, n_inputs) are features relative to the healthy vehicle's (and the mass ratio
    where it is known), NaN where a peak is missing; `outputs` (n_curves, n_outputs) parameters
    relative to healthy; `ratios` (n_curves, 5) all parameters, in the order of ``PARAMETERS``;
    `reasons` (n_curves, n_peaks) a ``PeakReason`` for each peak.
    """

    inputs: FloatArray
    outputs: FloatArray
    ratios: FloatArray
    reasons: IntArray

    @property
    def valid(self) -> BoolArray:
        """True where every feature was found, shape (n_curves,)."""
        return np.asarray(np.isfinite(self.inputs).all(axis=1))

    def complete(self, extractor: FeatureSet | None = None) -> FeatureData:
        """Return the curves with every feature; ValueError if there is none.

        The message says what is missing if the feature set is given as `extractor`.
        """
        is_complete = self.valid
        if not is_complete.any():
            texts = Counter(map(extractor.missing, self.reasons) if extractor is not None else ())
            usual = max(texts, key=texts.__getitem__, default="")  # what is missing most often
            missing = f": {usual}" if usual else ""
            raise ValueError(f"none of the {len(is_complete)} curves has every feature{missing}")
        return self.subset(is_complete)

    def first(self, n_curves: int) -> FeatureData:
        """Return the first curves."""
        return self.subset(np.arange(len(self.inputs)) < n_curves)

    def subset(self, rows: BoolArray) -> FeatureData:
        """Return the curves for which `rows` is true, possibly none."""
        return FeatureData(*(array[rows] for array in vars(self).values()))


@contextmanager
def pool_of(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a pool of threads; torch uses one thread in each if there are several.

    The arrays of a block are too small to split, so blocks run in parallel rather than operations.
    Waiting blocks are cancelled when the pool is left by an error or Ctrl-C.
    """
    pool = ThreadPoolExecutor(workers)
    with threads(1 if workers > 1 else torch.get_num_threads()):
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
