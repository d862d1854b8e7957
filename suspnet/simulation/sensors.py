"""Models of accelerometers and their faults: Tables II and VII of the paper, and worse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from suspnet.ground.checks import check_number
from suspnet.ground.types import FloatArray

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class Sensor:
    """One accelerometer and its data logger.

    Parameters
    ----------
    rate_hz : float, [Hz]
        Sampling rate; Table II: 5000 at the axle box, 2000 elsewhere.
    snr_db : float, optional, [dB]
        White noise relative to the rms of the signal; 34 dB is 2 % (section III-E).
    range_g : float, optional, [g]
        The signal is cut off beyond; Table VII: 2. None never saturates.
    precision : float, [-]
        White noise relative to the range; Table VII: 0.001.
    offset_m_per_s2 : float, [m/s^2]
    drift_m_per_s2_per_h : float, [m/s^2/h]
    dropouts_per_h : float, [1/h]
        Drop-outs of `dropout_s` each: the logger holds the last value or gives NaN, in turn.
    dropout_s : float, [s]
    clock_offset_s : float, [s]
        Delay of the logger's clock, which the manifest does not state.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    rate_hz: float
    snr_db: float | None = 34.0
    range_g: float | None = None
    precision: float = 0.0
    offset_m_per_s2: float = 0.0
    drift_m_per_s2_per_h: float = 0.0
    dropouts_per_h: float = 0.0
    dropout_s: float = 2.0
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rate_hz", "dropout_s"):
            check_number(f"sensor.{name}", getattr(self, name), above=0, most=1e6)
        for name in ("precision", "dropouts_per_h"):
            check_number(f"sensor.{name}", getattr(self, name), low=0, most=1e5)
        check_number("sensor.range_g", self.range_g, above=0, most=1e6, optional=True)
        check_number("sensor.snr_db", self.snr_db, low=-20, high=200, optional=True)
        for name in ("offset_m_per_s2", "drift_m_per_s2_per_h", "clock_offset_s"):
            check_number(f"sensor.{name}", getattr(self, name), most=1e6)
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
