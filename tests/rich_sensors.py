"""What a rough train's sensors add to the acceleration that they read.

Numbers without a source are assumed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.constants import g

NOISE, CORNER_HZ = (2e-3, 5e-4, 2.5e-4), 2.0
"""White noise of axle box, frame and body, [m/s^2 per root Hz], and the frequency below which 1/f
noise exceeds it. Data sheets of MEMS accelerometers have 25 ug per root Hz for ranges of a few g;
those of wider ranges have more. It takes the place of a fleet's noise, which follows the signal."""
MAINS_HZ, MAINS = (50 / 3, 50.0), (2e-2, 1e-2, 5e-3)
"""Frequencies of the overhead line and of the supply, and the largest amplitude that each sensor of
a kind picks up, [m/s^2]."""
RANGES_G, BITS = (50.0, 10.0, 2.0), 16
"""Ranges of axle box, frame and body."""


def own_sensor(train, sensor, name):
    """Return the `Sensor` at one of a train's places, with its own gain and delay."""
    if "coloured_noise" in train.effects:
        sensor = replace(sensor, snr_db=None)
    if "sensors" not in train.effects:
        return sensor
    gain, late_s = train.of_sensor("sensitivity", name), train.of_sensor("late_s", name)
    return replace(sensor, gain=gain * sensor.gain, clock_offset_s=late_s + sensor.clock_offset_s)


def recorded(effects, channel, signal, rate_hz, rng):
    """Return a signal [m/s^2] with the noise of its amplifier, mains and the converter's steps.

    `channel` is 0 for axle box, 1 for frame, 2 for body, `rng` that of the trip and the sensor.
    """
    coloured, mains = rng.spawn(2)
    if "coloured_noise" in effects:
        signal = signal + pink_noise(len(signal), rate_hz, NOISE[channel], coloured)
    if "mains" in effects:
        times = np.arange(len(signal)) / rate_hz
        for hz in MAINS_HZ:
            size, off, phase = mains.uniform([0.0, -0.05, 0.0], [1.0, 0.05, 2 * math.pi])
            wave = np.cos(2 * math.pi * (hz + off) * times + phase)
            signal = signal + MAINS[channel] * size * wave
    if "resolution" in effects:
        full = g * RANGES_G[channel]
        step = 2 * full / 2**BITS
        signal = np.clip(np.round(signal / step) * step, -full, full - step)
    return signal


def pink_noise(n_samples, rate_hz, density, rng):
    """Return noise with the one-sided spectrum density^2 (1 + CORNER_HZ / f)."""
    f = np.fft.rfftfreq(n_samples, 1 / rate_hz)
    shape = np.zeros(len(f))
    shape[1:] = np.sqrt(1 + CORNER_HZ / f[1:])
    white = rng.standard_normal(n_samples) * density * math.sqrt(rate_hz / 2)
    return np.fft.irfft(np.fft.rfft(white) * shape, n_samples)
