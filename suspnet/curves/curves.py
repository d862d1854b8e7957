"""Observations of curves: what all of them share, and the paper's magnitudes with white noise.

An observation is a set of three classes: settings with the values of a YAML file, the observer that
they create for a generator, and its misfit to observed curves. Those here are of section III-B: the
rms of the noise is the curve's own rms times 10^(-SNR/20), so 34 dB is the 2 % sensor precision of
section III-E, 26 dB 5 % and 54 dB 0.2 %. `estimates` has those of trips (transfer functions
estimated from recordings), and the types of what may be either.

Directions: the logarithms of a generator's uncertain numbers (of 1 + number for those that may be
absent) are normal, mean + F z with z standard normal. Many directions of z hardly change the
curves. With J the derivative of the curves in units of their noise, the eigenvectors of the mean of
J^T J over vehicles (the active subspace; Constantine, Active subspaces, 2015) are directions of
decreasing effect, with the root of the eigenvalue as rms effect. Directions of negligible effect
are fixed at the median.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from suspnet.ground.settings import check_number, check_settings, setting
from suspnet.vehicle import PARAMETERS, ResponseGenerator, Vehicle

if TYPE_CHECKING:  # it has directions, too
    from suspnet.curves.estimate_observer import EstimateObserver

LEAST_CALIBRATION = 100
"""Smallest number of calibration curves; the coverage of a 90 % interval then scatters by 3 %."""
MOST_BINS = 100_000
"""Largest number of frequency bins of a curve; the paper has 1,000, a band up to 25 Hz 500."""
MOST_CURVES = 100_000_000  # largest number of curves; their parameters alone then take 4 GB
LEAST_EFFECT = 0.1
"""Smallest rms effect of a direction that is retained, in standard deviations of the noise; each
neglected one would widen a parameter's deviation by about 0.5 % at most."""
N_VEHICLES = 24  # number of vehicles over which the effect is averaged
FURTHEST = 2.0  # largest factor, up or down, between the parameters of these vehicles and healthy
STEP = 1e-4  # step of the central differences, in standard deviations of the numbers
N_TRAIN, N_UNCERTAIN_TRAIN = 20_000, 4_000
"""Default numbers of training curves; the second for a vehicle with uncertain numbers, where the
regression is only the start of the fit that reads a trip: with 20,000 its results are the same."""


@dataclass(frozen=True)
class Counts:
    """Numbers of curves, which the settings of every observation start with."""

    n_train: int | str | None = setting(
        None,
        "Number of training curves, or all for the whole grid of the protocol; null is "
        f"{N_TRAIN}, and {N_UNCERTAIN_TRAIN} of a vehicle with uncertain numbers",
        rule="whole number; 1 to 1e8",
    )
    n_test: int | str = setting(
        4_000, "Number of test curves, or all", rule="whole number; 1 to 1e8"
    )
    n_calibrate: int | None = setting(
        30_000,
        "Number of fresh curves that intervals and thresholds are learnt from; null gives the "
        "model neither",
        low=LEAST_CALIBRATION,
        most=MOST_CURVES,
    )

    def counted(self, uncertain: bool) -> Self:
        """Return the settings with `n_train` filled in, for a vehicle with `uncertain` numbers."""
        usual = N_UNCERTAIN_TRAIN if uncertain else N_TRAIN
        return self if self.n_train is not None else replace(self, n_train=usual)

    def check(self) -> None:
        """Raise TypeError or ValueError unless the settings of an observation are valid."""
        for name in ("n_train", "n_test"):
            value = getattr(self, name)
            if value != "all" and not (value is None and name == "n_train"):
                check_number(f"data.{name}", value, low=1, most=MOST_CURVES, whole=True)
        check_settings(self, "data")


@dataclass(frozen=True)
class Directions:
    """A few standard normal coordinates that replace all the uncertain numbers.

    `factor` (n_names, n) is the change of the logarithms of the distribution's numbers for a
    coordinate of 1; `strongest` is the rms effect of the strongest direction, in standard
    deviations of the noise.
    """

    generator: ResponseGenerator
    factor: Tensor
    strongest: float = 0.0

    @property
    def n(self) -> int:
        """Number of directions."""
        return self.factor.shape[1]

    def vehicles(self, ratios: Tensor, coordinates: Tensor) -> Tensor:
        """Return ratios with the columns of the uncertain numbers added, if there are any.

        `ratios`: (n_vehicles, n_columns); `coordinates`: (n_vehicles, n), 0 is the median.
        """
        distribution = self.generator.distribution
        if not self.n or distribution is None:
            return ratios
        mean = torch.tensor(distribution.mean, dtype=torch.float64).to(coordinates)
        exponentials = (mean + coordinates @ self.factor.to(coordinates).T).exp()
        offsets = torch.as_tensor(distribution.offsets).to(coordinates)
        return self.generator.with_uncertain(ratios, exponentials - offsets)


def every_direction(generator: ResponseGenerator) -> Directions:
    """Return directions that span all uncertain numbers of a generator."""
    distribution = generator.distribution
    if distribution is None or not distribution.names:
        return Directions(generator, torch.zeros(0, 0, dtype=torch.float64))
    return Directions(generator, torch.as_tensor(distribution.factor.copy()))


def directions(observer: CurveObserver | EstimateObserver) -> Directions:
    """Return the directions of the uncertain numbers that affect an observer's curves."""
    every = every_direction(observer.generator)
    if not every.n:
        return every
    points = torch.quasirandom.SobolEngine(len(PARAMETERS)).draw(N_VEHICLES, dtype=torch.float64)
    ratios = torch.exp(math.log(FURTHEST) * (2 * points - 1))
    standard = np.random.default_rng(0).standard_normal((N_VEHICLES, every.n))
    jacobian = _jacobian(observer, every, ratios, torch.as_tensor(standard))
    values, vectors = torch.linalg.eigh((jacobian @ jacobian.mT).mean(dim=0))
    effects = values.clamp(min=0).sqrt()
    is_strong = effects >= LEAST_EFFECT
    factor = (every.factor.to(vectors) @ vectors)[:, is_strong].flip(1)
    return Directions(every.generator, factor, float(effects[-1]))


def _jacobian(
    observer: CurveObserver | EstimateObserver, every: Directions, ratios: Tensor, standard: Tensor
) -> Tensor:
    """Return the derivative of the misfit with respect to z, (n, n_names, n_points)."""
    rows = torch.arange(len(ratios))
    vehicles = every.vehicles(ratios, standard)
    misfit = observer.misfit(observer.noise_free(vehicles), vehicles)
    columns = []
    for step in STEP * torch.eye(every.n, dtype=standard.dtype):
        above, below = (every.vehicles(ratios, standard + way * step) for way in (1, -1))
        columns.append(misfit(above, rows) - misfit(below, rows))
    return torch.stack(columns, dim=1) / (2 * STEP)


@dataclass(frozen=True)
class CurveSettings(Counts):
    """Frequency bins, noise and numbers of curves."""

    kind: ClassVar[str] = "curves"

    snr_db: float = setting(
        34.0,
        "Signal-to-noise ratio of each curve; 34 dB is noise of 2 % of its rms",
        "dB",
        low=-20,
        high=200,
    )
    noise_on: Literal["magnitude", "decibel"] = setting(
        "magnitude",
        "What the noise is added to: the magnitudes, or their decibels, of which it is a share "
        "then",
    )
    low_hz: float = setting(0.1, "First frequency bin, at least step_hz", "Hz", above=0, most=10000)
    high_hz: float = setting(20.0, "Upper end of the bins, above low_hz", "Hz", above=0, most=10000)
    step_hz: float = setting(
        0.02,
        "Distance of the bins; at most 100,000 of them up to high_hz",
        "Hz",
        above=0,
        most=10000,
    )

    def __post_init__(self) -> None:
        self.check()
        if not self.step_hz <= self.low_hz < self.high_hz:
            raise ValueError(
                "need data.step_hz <= data.low_hz < data.high_hz, got "
                f"{self.step_hz}, {self.low_hz}, {self.high_hz}"
            )
        if self.high_hz > MOST_BINS * self.step_hz:
            raise ValueError(
                f"data.step_hz={self.step_hz} makes more than {MOST_BINS} bins up to "
                f"data.high_hz={self.high_hz}; take wider ones"
            )

    def bound(self, vehicle: Vehicle) -> CurveSettings:
        """Return the same settings: none of them depends on the vehicle."""
        return self

    def observer(self, generator: ResponseGenerator) -> CurveObserver:
        """Return the observer that draws noisy magnitudes of a generator's vehicles."""
        return CurveObserver(self, generator)

    def frequencies_hz(self) -> Tensor:
        """Return the frequency bins, shape (n_freq,), [Hz]."""
        n_bins = math.floor((self.high_hz - self.low_hz) / self.step_hz + 1e-9) + 1
        return self.low_hz + self.step_hz * torch.arange(n_bins, dtype=torch.float64)


@dataclass(frozen=True)
class CurveObserver:
    """The observation of section III-B of the paper: magnitudes with white noise."""

    settings: CurveSettings
    generator: ResponseGenerator

    @property
    def frequencies_hz(self) -> Tensor:
        """Bins, shape (n_freq,), [Hz]."""
        return self.settings.frequencies_hz()

    @cached_property
    def directions(self) -> Directions:
        """Directions of the generator's uncertain numbers that affect its curves."""
        return directions(self)

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return abs(G_p) and abs(G_s), shape (n_vehicles, 2, n_freq), [-]."""
        return self.generator.magnitudes(ratios, self.frequencies_hz)

    def observe(self, ratios: Tensor, seed: int) -> Tensor:
        """Return noisy magnitudes, with the generator's uncertain quantities drawn as well."""
        rows = self.generator.sample_unmeasured(ratios, seed)
        clean, snr_db = self.noise_free(rows), self.settings.snr_db
        if self.settings.noise_on == "decibel":
            return 10 ** (add_noise(decibels(clean), snr_db, seed) / 20)
        return add_noise(clean, snr_db, seed)

    def for_features(self, curves: Tensor) -> Tensor:
        """Return magnitudes unchanged."""
        return curves

    def thinned(self) -> CurveObserver:
        """Return the observer itself: there is no quicker one."""
        return self

    def misfit(self, curves: Tensor, near: Tensor, used: Sequence[int] = (0, 1)) -> CurveMisfit:
        """Return the misfit of observed magnitudes; the noise follows from their own rms."""
        return CurveMisfit(self, curves, tuple(used))


@dataclass(frozen=True)
class CurveMisfit:
    """Misfit of magnitudes with white noise, its rms relative to that of each observed curve.

    `observed`: (n_rows, 2, n_freq); `used` lists which of G_p (0) and G_s (1) enter.
    """

    observer: CurveObserver
    observed: Tensor
    used: Sequence[int] = (0, 1)
    expected: float = 1.0  # mean square of a residual if the model is true

    def thinned(self) -> CurveMisfit:
        """Return the misfit itself: there is no quicker one."""
        return self

    def __call__(self, ratios: Tensor, rows: Tensor) -> Tensor:
        """Return residuals (n, n_points) of the vehicles `ratios` (n, 5) to the curves `rows`."""
        observed = self.observed[rows][:, list(self.used)]
        expected = self.observer.noise_free(ratios)[:, list(self.used)]
        if self.observer.settings.noise_on == "decibel":
            observed, expected = decibels(observed), decibels(expected)
        rms = noise_rms(observed, self.observer.settings.snr_db)
        return ((observed - expected) / rms).flatten(1)


def decibels(magnitudes: Tensor) -> Tensor:
    """Return 20 log10 of magnitudes, [dB]."""
    return 20 * magnitudes.log10()


def add_noise(magnitudes: Tensor, snr_db: float, seed: int) -> Tensor:
    """Return curves (..., n_freq) plus white Gaussian noise of rms = rms(curve) 10^(-SNR/20).

    The same seed on the same kind of device gives the same noise.
    """
    source = torch.Generator(magnitudes.device).manual_seed(seed)
    noise = torch.empty_like(magnitudes).normal_(generator=source)
    return noise.mul_(noise_rms(magnitudes, snr_db)).add_(magnitudes)


def noise_rms(magnitudes: Tensor, snr_db: float) -> Tensor:
    """Return the rms of the noise of each curve, shape (..., 1)."""
    return magnitudes.square().mean(dim=-1, keepdim=True).sqrt() * 10 ** (-snr_db / 20)
