"""Models of accelerometers and their faults: Tables II and VII of the paper, and worse."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from suspnet.ground.settings import Setting, check_settings, setting
from suspnet.ground.types import FloatArray

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class Sensor:
    """One accelerometer and its data logger.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    rate_hz: Annotated[
        float, Setting("Sampling rate of the axle box's sensor", "Hz", above=0, most=1e6)
    ]
    snr_db: float | None = setting(
        34.0, "White noise relative to the signal; null is none", "dB", low=-20, high=200
    )
    range_g: float | None = setting(
        None,
        "Acceleration beyond which the signal is cut off, 2 in Table VII; null is no limit",
        "g",
        above=0,
        most=1e6,
    )
    precision: float = setting(
        0.0, "White noise relative to range_g, 0.001 in Table VII", low=0, most=100000
    )
    offset_m_per_s2: float = setting(0.0, "Constant offset", "m/s²", low=-1e6, most=1e6)
    drift_m_per_s2_per_h: float = setting(
        0.0, "Drift of the offset", "m/s² per h", low=-1e6, most=1e6
    )
    dropouts_per_h: float = setting(
        0.0,
        "Mean number of drop-outs, in which the last value is held or is NaN, in turn",
        "per h",
        low=0,
        most=100000,
    )
    dropout_s: float = setting(2.0, "Length of a drop-out", "s", above=0, most=1e6)
    clock_offset_s: float = setting(
        0.0,
        "Delay of the sensor's clock, which the manifest does not tell",
        "s",
        low=-1e6,
        most=1e6,
    )

    def __post_init__(self) -> None:
        check_settings(self, "sensor")
        if self.precision > 0 and self.range_g is None:
            raise ValueError("sensor `precision` is relative to `range_g`, which is not given")

    @property
    def range_m_per_s2(self) -> float | None:
        """The largest acceleration that can be recorded, [m/s^2]."""
        return None if self.range_g is None else self.range_g * STANDARD_GRAVITY

    def record(self, signal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return what is recorded of an acceleration sampled at `rate_hz`, [m/s^2].

        Parameters
        ----------
        signal : array of shape (n_samples,), [m/s^2]
        rng : numpy.random.Generator

        Returns
        -------
        array of shape (n_samples,), [m/s^2]
        """
        noise = 0.0
        if self.snr_db is not None:
            noise = float(np.sqrt(np.mean(signal**2))) * 10 ** (-self.snr_db / 20)
        full_scale = self.range_m_per_s2 or math.inf
        if self.precision > 0:
            noise = math.hypot(noise, self.precision * full_scale)
        late = np.arange(len(signal)) - round(self.clock_offset_s * self.rate_hz)
        recorded = signal[late.clip(0, len(signal) - 1)]
        recorded += noise * rng.standard_normal(len(signal))
        hours = np.arange(len(signal)) / (self.rate_hz * 3600)
        recorded += self.offset_m_per_s2 + self.drift_m_per_s2_per_h * hours
        np.clip(recorded, -full_scale, full_scale, out=recorded)
        return self._dropped(recorded, rng)

    def _dropped(self, recorded: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return a recording with drop-outs at random times: held values and NaN in turn."""
        length = round(self.dropout_s * self.rate_hz)
        hours = len(recorded) / (self.rate_hz * 3600)
        for i in range(rng.poisson(self.dropouts_per_h * hours)):
            first = int(rng.integers(1, max(2, len(recorded) - length)))
            recorded[first : first + length] = np.nan if i % 2 else recorded[first - 1]
        return recorded
