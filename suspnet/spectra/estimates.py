"""Settings of estimates from trips: how trips are recorded, and which frequencies are used."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from suspnet.dynamics import QuarterCar, ResponseGenerator, Vehicle
from suspnet.dynamics.track import track_spectrum
from suspnet.ground.settings import check_settings, setting
from suspnet.spectra.cross_spectra import Method
from suspnet.spectra.curves import CurveSettings
from suspnet.spectra.estimate_observer import EstimateObserver
from suspnet.spectra.observation import check_counts
from suspnet.spectra.welch import Welch

SPEED_HALF_WIDTH = 0.08
"""Half width of the speeds that one model reads; measured, errors of corrected estimates were up to
about twice those at the speed of the training at 0.1 beside it."""
LOWEST_MODE, HIGHEST_MODE, HIGHEST_OF_BODY = 0.45, 3.8, 2.4
"""Ends of the band, and of what is used of G_s: multiples of the first natural frequency, then of
the second. Between the last two the primary damper parts from its bushing and the axle guidance;
the body sounds there with modes of its structure, of which the model holds the first."""
HIGHEST_HZ = 25.0
"""Highest end of a band that follows from the vehicle: recordings are read up to a quarter of their
rate, which is 100 Hz unless told otherwise; [Hz]."""
MOST_BINS = 100_000
"""Largest number of frequency bins of a curve; a band up to 25 Hz has 500."""


@dataclass(frozen=True)
class EstimateSettings:
    """How trips are recorded and their transfer functions estimated.

    Parameters
    ----------
    segment_s, overlap, window
        Of ``Welch``. A segment must be long against the ringing of the body: with 20 s the
        leakage modelled here is that of recordings, with 10 s no more (AM96, c_s at 80 %).

    Raises
    ------
    TypeError, ValueError
        If a setting has the wrong type or is out of range.
    """

    kind: ClassVar[str] = "trips"

    n_train: int | str = setting(
        20_000,
        "Number of training curves, or all for the whole grid of the protocol",
        rule="whole number; 1 to 1e8",
    )
    n_test: int | str = setting(
        4_000, "Number of test curves, or all", rule="whole number; 1 to 1e8"
    )
    n_calibrate: int | None = setting(
        30_000,
        "Number of fresh curves that intervals and thresholds are learnt from; null gives the "
        "model neither",
        low=100,
        high=1e8,
    )
    speed_m_per_s: float = setting(
        70.0, "Speed of the trips that the model reads, as the line's", "m/s", above=0.1, below=200
    )
    speed_half_width: float = setting(
        SPEED_HALF_WIDTH,
        "Half width of the range of speeds that one model reads, relative to its middle",
        low=0,
        below=0.5,
    )
    track: str = setting("german_low", "Roughness of the track, as the line's", rule="as track")
    short_waves: bool = setting(
        False,
        "Whether to add the short waves of a rail head to the track, below 2.5 m; not on roads",
    )
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
    overlap: float = setting(0.5, "Share of a segment that the next one has too", low=0, below=1)
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
    cache_dir: str | None = setting(
        ".cache/suspnet",
        "Folder where features of curves are kept between runs; null keeps none",
        rule="path",
    )

    def __post_init__(self) -> None:
        check_counts(self)
        check_settings(self, "data")
        if len(self.rates_hz) != 3:
            raise ValueError(f"`data.rates_hz` must be three rates > 0, got {self.rates_hz}")
        track_spectrum(self.track, self.short_waves)
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

    @property
    def welch(self) -> Welch:
        """Settings by which recordings are cut into segments."""
        return Welch(self.segment_s, self.overlap, self.window)

    @property
    def n_averages(self) -> float:
        """Independent averages of a trip."""
        welch = self.welch
        step_s = welch.segment_s * (1 - welch.overlap)
        n_segments = max(0.0, (self.minutes * 60 - welch.segment_s) / step_s + 1)
        return welch.n_averages(n_segments) if n_segments >= 1 else 0.0

    def bound(self, vehicle: Vehicle) -> EstimateSettings:
        """Return the settings with a band in Hz: an end that is None follows from the vehicle."""
        modes, _ = QuarterCar(vehicle).natural_modes()
        low = LOWEST_MODE * float(modes[0]) if self.low_hz is None else self.low_hz
        high = min(HIGHEST_MODE * float(modes[1]), HIGHEST_HZ)
        if self.high_hz is not None:
            high = self.high_hz
        body_high = min(high, HIGHEST_OF_BODY * float(modes[1]))
        if self.body_high_hz is not None:
            body_high = self.body_high_hz
        bound = replace(self, low_hz=low, high_hz=high, body_high_hz=body_high)
        bins = bound.frequencies_hz()
        for name, end, n_bins in (
            ("high_hz", high, len(bins)),
            ("body_high_hz", body_high, int((bins <= body_high + 1e-9).sum())),
        ):
            if n_bins < 8:
                raise ValueError(
                    f"between data.low_hz={low:.3g} and data.{name}={end:.3g} Hz lie "
                    f"{n_bins} bins; at least 8 are needed"
                )
        return bound

    def beyond(self, frequencies_hz: Tensor) -> Tensor:
        """Return which bins (n_freq,) lie beyond `body_high_hz`, bool (2, n_freq): G_s alone."""
        end = math.inf if self.body_high_hz is None else self.body_high_hz
        beyond = frequencies_hz > end + 1e-9
        return torch.stack([torch.zeros_like(beyond), beyond])

    def frequencies_hz(self) -> Tensor:
        """Return the bins of the estimate, multiples of 1 / segment_s, shape (n_freq,), [Hz].

        Raises
        ------
        ValueError
            If the band is not bound to a vehicle yet.
        """
        if self.low_hz is None or self.high_hz is None:
            raise ValueError("the band follows from the vehicle: call `bound` first")
        first = max(
            math.ceil(self.low_hz * self.segment_s - 1e-9), 1 + len(self.welch.smear()) // 2
        )
        last = math.floor(self.high_hz * self.segment_s + 1e-9)
        return torch.arange(first, last + 1, dtype=torch.float64) / self.segment_s

    def observer(self, generator: ResponseGenerator) -> EstimateObserver:
        """Return the source of estimates of a generator's vehicles."""
        return EstimateObserver(self, generator)

    def words(self) -> str:
        """Return in words what is observed, with which noise."""
        band = "" if self.low_hz is None else f", {self.low_hz:.3g} to {self.high_hz:.3g} Hz"
        bias = "" if self.method == "IV" else f" The bias of {self.method} in noise is known."
        return (
            f"Trips of {self.minutes:g} minutes at {self.speed_m_per_s:g} m/s, track "
            f"{self.track}{band}. White noise of each sensor: {self.snr_db:g} dB over its whole "
            f"band. All three sensors are used, whichever curves the protocol names.{bias}"
        )


OBSERVATIONS: dict[str, Any] = {kind.kind: kind for kind in (CurveSettings, EstimateSettings)}
"""Settings of every observation by the name of their file in configs/data/."""
