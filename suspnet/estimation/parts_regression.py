"""A regression that reads the parts of a commissioned bogie: the start of their fit.

Training trips are drawn from the bogie's own vehicle: parts worn as in `drawn_wear`, its uncertain
numbers from their posterior, the inputs' spectra those of its healthy trips, and signals of as many
averages as a trip has. Inputs of the regression are `suspnet.spectra.subspace_features`, each
divided by the root of its standard deviation: strong components come first, weak ones that dampers
show in are not lost. Outputs are the logarithms of ``COMPONENTS``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from suspnet.dynamics import SpatialVehicle
from suspnet.dynamics.quantities import MASS_DEVIATION, MASS_MEAN
from suspnet.estimation.bogie_fit import CommissionedBogie
from suspnet.estimation.bogie_search import ROUGH_SPACING_HZ
from suspnet.ground.parameters import COMPONENTS, Direction
from suspnet.ground.types import FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.learning import MSVR, Scaling
from suspnet.spectra.bogie_trip import BogieTrip
from suspnet.spectra.subspace_features import SubspaceCoordinates, SubspaceFeatures, input_spectra

N_TRAIN, N_FEATURES = 2500, 150
"""Training trips and features: 12 s of one processor for one vehicle and speed."""
LOW, HIGH = math.log(0.08), math.log(2.0)
"""Range of the logarithm of a part that has worn alone or with another one."""
ALL_LOW, ALL_HIGH = math.log(0.4), math.log(1.6)
"""Range of the logarithms of parts that have all worn."""
N_WORN, HEALTHY_SPREAD = 2, 0.05
"""Most parts that wear together unless all do, and standard deviation of the other logarithms."""
SHARE_OF_ALL = 0.5
"""Share of training trips on which all parts have worn."""
BLOCK = 64
"""Training trips drawn at once."""
SPEED_TOLERANCE = 0.01
"""Largest relative difference of a trip's speed from that of the training."""


@dataclass(frozen=True, repr=False)
class PartsRegression(ShortRepr):
    """A fitted regression with what it needs to read a trip of its bogie.

    `input_scale` (n_features,) divides the features, `outputs` are the ratios' scaling; `every` is
    the distance of its bins among those of trips, `frequencies_hz` (n_freq,).
    """

    estimator: Any
    features: SubspaceFeatures
    input_scale: FloatArray
    outputs: Scaling
    frequencies_hz: Tensor
    every: int
    speed_m_per_s: float
    direction: Direction

    def reads(self, trip: BogieTrip) -> bool:
        """Whether a trip has the sensors, bins, speed and direction of the training."""
        is_near = abs(trip.speed_m_per_s / self.speed_m_per_s - 1) <= SPEED_TOLERANCE
        same_bins = torch.equal(trip.frequencies_hz, self.frequencies_hz)
        is_alike = same_bins and trip.direction == self.direction and not trip.lost
        return is_near and is_alike

    def __call__(self, trip: BogieTrip) -> FloatArray:
        """Return the ratio to healthy of ``COMPONENTS``, M_s to nominal, (13,).

        Ratios beyond those of the training are set to its limits.
        """
        rows = self.features(trip.spectra.values[None, :: self.every]).numpy()
        found = self.outputs.undo(np.asarray(self.estimator.predict(rows / self.input_scale)))
        return np.asarray(found[0].clip(math.exp(LOW), math.exp(HIGH)))


@dataclass(frozen=True)
class TrainingTrips:
    """Drawn trips of a bogie: `inputs` (n_trips, n_features) scaled, `ratios` (n_trips, 13)."""

    features: SubspaceFeatures
    input_scale: FloatArray
    inputs: FloatArray
    ratios: FloatArray


def train_parts(
    bogie: CommissionedBogie,
    healthy: Sequence[BogieTrip],
    estimator: Any = None,
    n_trips: int = N_TRAIN,
    seed: int = 0,
) -> PartsRegression:
    """Return a regression for trips at the speed, the direction and the length of healthy ones.

    Parameters
    ----------
    bogie : CommissionedBogie
    healthy : sequence of BogieTrip
        The trips that it was commissioned on.
    estimator : scikit-learn regressor, optional
        A method for 13 outputs, by default MSVR with the exact kernel.
    n_trips : int
        Number of training trips.
    seed : int

    Raises
    ------
    ValueError
        If the layout has not more sensors than inputs, or the trips are fewer than features.
    """
    drawn = training_trips(bogie, healthy, n_trips, seed)
    outputs = Scaling.of(drawn.ratios)
    estimator = default_msvr() if estimator is None else estimator
    estimator.fit(drawn.inputs, outputs.apply(drawn.ratios))
    one = healthy[0]
    return PartsRegression(
        estimator,
        drawn.features,
        drawn.input_scale,
        outputs,
        one.frequencies_hz,
        _every(one),
        one.speed_m_per_s,
        one.direction,
    )


def default_msvr() -> MSVR:
    """Return the MSVR that reads parts, in scaled features."""
    sigma = 4 * math.sqrt(N_FEATURES)
    return MSVR(C=1e3, sigma=sigma, epsilon=0.01, feature_map="exact", tol=1e-3)


def training_trips(
    bogie: CommissionedBogie, healthy: Sequence[BogieTrip], n_trips: int, seed: int
) -> TrainingTrips:
    """Return trips drawn from a commissioned bogie, with the features fitted to them."""
    rng = np.random.default_rng(seed)
    source = _Source.of(bogie, healthy)
    ratios = drawn_wear(n_trips, rng)
    blocks = [source.drawn(rows, rng) for rows in np.array_split(ratios, -(-n_trips // BLOCK))]
    clean, noisy = (torch.cat(rows) for rows in zip(*blocks, strict=True))
    features = SubspaceFeatures.fitted(source.coordinates, clean, noisy, N_FEATURES)
    inputs = features.components(noisy).numpy()
    scale = np.sqrt(inputs.std(axis=0))
    scale *= math.sqrt(np.mean((inputs / scale) ** 2))
    return TrainingTrips(features, scale, inputs / scale, ratios)


def drawn_wear(n: int, rng: np.random.Generator) -> FloatArray:
    """Return ratios of ``COMPONENTS``: all parts worn, or one or two of them, (n, 13)."""
    logs = rng.uniform(ALL_LOW, ALL_HIGH, (n, len(COMPONENTS)))
    few = logs[round(SHARE_OF_ALL * n) :]
    few[:] = HEALTHY_SPREAD * rng.standard_normal(few.shape)
    for _ in range(N_WORN):
        worn = rng.integers(len(COMPONENTS) - 1, size=len(few))
        few[np.arange(len(few)), worn] = rng.uniform(LOW, HIGH, len(few))
    logs[:, -1] = MASS_MEAN + MASS_DEVIATION * rng.standard_normal(n).clip(-2, 2)
    return np.exp(logs)


@dataclass(frozen=True)
class _Source:
    """A bogie at a speed, the square root of its inputs' spectra (n_freq, p, p), its averages."""

    vehicle: SpatialVehicle
    noise: Tensor
    frequencies_hz: Tensor
    root: Tensor
    n_averages: int
    coordinates: SubspaceCoordinates

    @classmethod
    def of(cls, bogie: CommissionedBogie, healthy: Sequence[BogieTrip]) -> _Source:
        one = healthy[0]
        vehicle = replace(bogie.generator, speed_m_per_s=one.speed_m_per_s, direction=one.direction)
        bins = one.frequencies_hz[:: _every(one)]
        nothing_worn = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
        responses = vehicle.channels(nothing_worn, bins)[0]
        mean = torch.stack([trip.spectra.values for trip in healthy]).mean(dim=0)
        density = input_spectra(mean[:: _every(one)], responses, bogie.noise)
        power, vectors = torch.linalg.eigh(density)
        root = vectors * power.clamp(min=0.0).sqrt()[:, None]
        coordinates = SubspaceCoordinates.of(responses, bogie.noise)
        return cls(vehicle, bogie.noise, bins, root, round(one.spectra.n_averages), coordinates)

    def drawn(self, ratios: FloatArray, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Return the coordinates of trips without and with the noise of their averages."""
        noise = self.noise
        rows = self.vehicle.sample_unmeasured(ratios, int(rng.integers(2**32)))
        responses = self.vehicle.channels(rows, self.frequencies_hz).permute(0, 3, 2, 1)
        a = responses @ self.root
        shape = (*a.shape[:2], self.n_averages)
        signals = a @ _normal(rng, shape[0], shape[1], a.shape[3], shape[2])
        signals += noise.sqrt()[:, None] * _normal(rng, shape[0], shape[1], len(noise), shape[2])
        exact = a @ a.mH + torch.diag(noise)
        return self.coordinates(exact), self.coordinates(signals @ signals.mH / self.n_averages)


def _every(trip: BogieTrip) -> int:
    return max(1, round(ROUGH_SPACING_HZ / float(trip.frequencies_hz[:2].diff())))


def _normal(rng: np.random.Generator, *shape: int) -> Tensor:
    """Return complex standard normal numbers."""
    halves = rng.standard_normal((*shape, 2)) / math.sqrt(2)
    return torch.view_as_complex(torch.as_tensor(halves))
