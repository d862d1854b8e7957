"""Settings of trips whose transfer functions are estimated: recording, estimator, band."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from suspnet.curves.cross_spectra import Method
from suspnet.curves.curves import MOST_BINS, Counts, CurveMisfit, CurveObserver, CurveSettings
from suspnet.curves.estimate_observer import EstimateObserver
from suspnet.curves.expected_spectra import EstimateMisfit
from suspnet.curves.welch import Welch
from suspnet.ground.settings import setting
from suspnet.vehicle import QuarterCar, ResponseGenerator, Vehicle
from suspnet.vehicle.track import track_spectrum

SPEED_HALF_WIDTH = 0.08
"""Relative half width of the speed range of one model: at 0.1 from the training speed errors of
corrected estimates are up to twice as large."""
LOWEST_MODE, HIGHEST_MODE, HIGHEST_OF_BODY = 0.45, 3.8, 2.4
"""Default band ends as multiples of natural frequencies: start of the band (first mode), end of the
band and end of G_s (second mode). Between the last two the primary damper separates from its
bushing and the axle guidance, but the body has structural modes there; the model has only one."""
HIGHEST_HZ = 25.0
"""Highest default end of the band, [Hz]: a quarter of the default sampling rate of 100 Hz."""


@dataclass(frozen=True)
class EstimateSettings(Counts):
    """How trips are recorded and their transfer functions estimated.

    A segment must be long compared with the decay time of the body: with 20 s the modelled leakage
    matches that of recordings, with 10 s it does not.
    """

    kind: ClassVar[str] = "trips"

    # fewer than of other curves: their bounds with all numbers of a vehicle took half of a training
    n_test: int | str = setting(
        1_000, "Number of test curves, or all", rule="whole number; 1 to 1e8"
    )
    speed_m_per_s: float = setting(
        70.0, "Speed of the trips that the model reads, as the line's", "m/s", above=0.1, below=200
    )
    speed_half_width: float | None = setting(
        None,
        "Half width of the range of speeds that one model reads, relative to its middle; null is "
        f"{SPEED_HALF_WIDTH:g}",
        low=0,
        below=0.5,
    )
    track: str = setting("german_low", "Roughness of the track, as the line's", rule="as track")
    snr_db: float = setting(
        34.0,
        "Noise of each sensor, relative to the healthy vehicle's signal over the sensor's whole "
        "band",
        "dB",
        above=-20,
        below=200,
    )
    minutes: float = setting(
        20.0,
        "Usable recording of a trip; at least four independent averages of segment_s",
        "min",
        above=0,
        below=100000,
    )
    method: Method = setting(
        "IV",
        "Estimator of the transfer functions; IV, with the third sensor as instrument, has no "
        "bias by independent noise",
        rule="IV, H1, H2 or Hv",
    )
    segment_s: float = setting(
        20.0,
        "Length of a segment of Welch's method, the inverse of the distance of the bins, of "
        "which there are at most 100,000",
        "s",
        above=0,
    )
    overlap: float = setting(0.5, "Fraction of a segment shared with the next one", low=0, below=1)
    window: str = setting(
        "hann", "Window of a segment, by its name in scipy.signal.get_window", rule="name"
    )
    low_hz: float | None = setting(
        None,
        "Lower end of the band; null is 0.45 times the vehicle's first natural frequency",
        "Hz",
        above=0,
        below=10000,
    )
    high_hz: float | None = setting(
        None,
        "Upper end of the band; null is 3.8 times the second natural frequency, at most 25 Hz",
        "Hz",
        above=0,
        below=10000,
    )
    body_high_hz: float | None = setting(
        None,
        "Frequency up to which G_s is used; null is 2.4 times the second natural frequency, at "
        "most high_hz",
        "Hz",
        above=0,
        below=10000,
    )
    rates_hz: tuple[float, float, float] = setting(
        (5000.0, 2000.0, 2000.0),
        "Sampling rates of axle box, bogie and body",
        "Hz",
        above=0,
        most=1e6,
    )

    def __post_init__(self) -> None:
        self.check()
        if len(self.rates_hz) != 3:
            raise ValueError(f"`data.rates_hz` must be three rates > 0, got {self.rates_hz}")
        track_spectrum(self.track)
        highest = HIGHEST_HZ if self.high_hz is None else self.high_hz
        if highest * self.segment_s > MOST_BINS:
            raise ValueError(
                f"segments of {self.segment_s:g} s make more than {MOST_BINS} bins up to "
                f"{highest:g} Hz; take shorter ones or a narrower band"
            )
        if self.n_averages < 4:
            raise ValueError(
                f"`data.minutes`={self.minutes:g} is too short: {self.n_averages:.1f} averages of "
                f"{self.segment_s:g} s; at least 4 are needed"
            )

    @cached_property
    def welch(self) -> Welch:
        """Segment length, overlap and window as ``Welch`` settings."""
        return Welch(self.segment_s, self.overlap, self.window)

    @cached_property
    def n_averages(self) -> float:
        """Number of independent averages of a trip; 0 if it is shorter than a segment."""
        welch = self.welch
        step_s = welch.segment_s * (1 - welch.overlap)
        n_segments = max(0.0, (self.minutes * 60 - welch.segment_s) / step_s + 1)
        return welch.n_averages(n_segments) if n_segments >= 1 else 0.0

    def bound(self, vehicle: Vehicle) -> Self:
        """Return the settings with missing ends of the band filled in from the vehicle."""
        first, second = (float(mode) for mode in QuarterCar(vehicle).natural_modes()[0])
        high = min(HIGHEST_MODE * second, HIGHEST_HZ) if self.high_hz is None else self.high_hz
        usual: dict[str, Any] = {
            "low_hz": LOWEST_MODE * first,
            "high_hz": high,
            "body_high_hz": min(high, HIGHEST_OF_BODY * second),
            "speed_half_width": SPEED_HALF_WIDTH,
        }
        missing = {name: value for name, value in usual.items() if getattr(self, name) is None}
        bound = replace(self, **missing)
        bins = bound.frequencies_hz()
        for name in ("high_hz", "body_high_hz"):
            end = getattr(bound, name)
            n_bins = int((bins <= end + 1e-9).sum())
            if n_bins < 8:
                raise ValueError(
                    f"between data.low_hz={bound.low_hz:.3g} and data.{name}={end:.3g} Hz lie "
                    f"{n_bins} bins; at least 8 are needed"
                )
        return bound

    def beyond(self, frequencies_hz: Tensor) -> Tensor:
        """Return which bins (n_freq,) lie above `body_high_hz`, bool (2, n_freq): G_s only."""
        end = math.inf if self.body_high_hz is None else self.body_high_hz
        beyond = frequencies_hz > end + 1e-9
        return torch.stack([torch.zeros_like(beyond), beyond])

    def frequencies_hz(self) -> Tensor:
        """Return the bins of the estimate, multiples of 1 / segment_s, shape (n_freq,), [Hz].

        ValueError if an end of the band is still None: `bound` fills them in.
        """
        if self.low_hz is None or self.high_hz is None:
            raise ValueError("the band follows from the vehicle: call `bound` first")
        lowest = math.ceil(self.low_hz * self.segment_s - 1e-9)
        first = max(lowest, 1 + len(self.welch.smear()) // 2)
        last = math.floor(self.high_hz * self.segment_s + 1e-9)
        return torch.arange(first, last + 1, dtype=torch.float64) / self.segment_s

    def observer(self, generator: ResponseGenerator) -> EstimateObserver:
        """Return the observer that draws estimates for a generator's vehicles."""
        return EstimateObserver(self, generator)


Observation = CurveSettings | EstimateSettings
"""Settings of an observation. `kind` is its name in model files."""
Observer = CurveObserver | EstimateObserver
"""Makes curves (n_curves, 2, n_freq) of a generator's vehicles as they would be observed."""
Misfit = CurveMisfit | EstimateMisfit
"""Residuals of observed curves in units of their noise, for vehicles `ratios` and curves `rows`.

Their sum of squares is -2 log likelihood; with J the derivative, J^T J is the Fisher information.
`expected` is the mean square of a residual if the model is true.
"""
OBSERVATIONS: dict[str, Any] = {kind.kind: kind for kind in (CurveSettings, EstimateSettings)}
"""Settings class of each kind of observation, by the `kind` that model files store."""
