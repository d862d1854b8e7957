"""Spectra of track and road unevenness in space, and of the axle box's acceleration on them.

S(n) [m^3] is one-sided in the spatial frequency n [cycles/m]: the integral of S over n > 0 is the
variance of the elevation in m^2. The standards' texts were not available; each spectrum follows the
code of a public simulator, which its `source` names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import quad

from suspnet.ground.settings import check_choice, check_number
from suspnet.ground.types import FloatArray

MM2_IN_M2 = 1e-6
CROSS_LEVEL_RAD_PER_M = 0.4380
"""Wave number below which the German cross level falls off against the mean [rad/m]."""
_VTCM = (
    "as the open simulator VTCM_simulation (github.com/2099193635) codes it; no standard's text "
    "was at hand. Its inverse FFT doubles the density, so its profiles are sqrt(2) higher"
)
_ISO = "ISO 8608 as public road simulators code it; the standard's text was not at hand"


@dataclass(frozen=True)
class TrackSpectrum:
    """One-sided power spectral density of the vertical unevenness of a rail or a road.

    `density` maps n > 0 [cycles/m] to S(n) [m^3] of the same shape; `source` is the origin of
    formula and numbers. Short waves of the rail head can be added only if `surface` is "rail".
    """

    name: str
    density: Callable[[FloatArray], FloatArray]
    source: str
    surface: str = "rail"


def german_density(n: FloatArray, amplitude: float) -> FloatArray:
    """Return the German spectrum of vertical unevenness, [m^3].

    ``S(n) = A / (2 pi) * nc^2 / ((n^2 + nr^2) (n^2 + nc^2))`` with nc = 0.8246 / (2 pi) and
    nr = 0.0206 / (2 pi): the usual form in rad/m, A wc^2 / ((w^2 + wr^2) (w^2 + wc^2)), written
    for cycles/m. `amplitude`: A = 4.032e-7 (low) or 1.08e-6 (high) [m rad].
    """
    nc, nr = 0.8246 / (2 * math.pi), 0.0206 / (2 * math.pi)
    return amplitude / (2 * math.pi) * nc**2 / ((n**2 + nr**2) * (n**2 + nc**2))


def chinese_ballastless_density(n: FloatArray) -> FloatArray:
    """Return the spectrum of Chinese high-speed ballastless track, [m^3].

    ``S(n) = A n^-k`` mm^2 m in four pieces that meet at n = 0.0187, 0.0474 and 0.1533 cycles/m,
    with A = 1.0544e-5, 3.5588e-3, 1.9784e-2, 3.9488e-4 and k = 3.3891, 1.9271, 1.3643, 3.4516.
    """
    amplitudes = np.array([1.0544e-5, 3.5588e-3, 1.9784e-2, 3.9488e-4])
    exponents = np.array([3.3891, 1.9271, 1.3643, 3.4516])
    piece = np.searchsorted([0.0187, 0.0474, 0.1533], n, side="right")
    density: FloatArray = amplitudes[piece] * n ** -exponents[piece] * MM2_IN_M2
    return density


def short_wave_density(n: FloatArray) -> FloatArray:
    """Return the short-wave spectrum of the rail head, 0.036 n^-3.15 mm^2 m, in [m^3]."""
    return 0.036 * MM2_IN_M2 * n**-3.15


def iso8608_density(n: FloatArray, roughness: float) -> FloatArray:
    """Return the road spectrum G0 (n / n0)^-2 with n0 = 0.1 cycles/m, [m^3].

    `roughness`: G0, the density at n0 [m^3]: 16e-6 for class A, four times as much for each further
    class.
    """
    return roughness * (n / 0.1) ** -2.0


def cross_level_spectrum(mean: TrackSpectrum) -> TrackSpectrum:
    """Return the spectrum of a cross level, S(n) n^2 / (n^2 + n_0^2) [m^3], for a fraction of 1.

    As in the German spectra, n_0 = 0.4380 / (2 pi); see ``CROSS_LEVEL_RAD_PER_M``.
    """
    return replace(mean, density=partial(_cross_level_density, mean=mean.density))


def _cross_level_density(n: FloatArray, mean: Callable[[FloatArray], FloatArray]) -> FloatArray:
    return mean(n) * n**2 / (n**2 + (CROSS_LEVEL_RAD_PER_M / (2 * math.pi)) ** 2)


def _with_short_waves(
    n: FloatArray, density: Callable[[FloatArray], FloatArray], short_wave_from_m: float
) -> FloatArray:
    """Return a density in which the rail's short waves replace the spectrum, [m^3]."""
    return np.where(n > 1 / short_wave_from_m, short_wave_density(n), density(n))


TRACKS: dict[str, TrackSpectrum] = {
    "german_low": TrackSpectrum(
        "german_low", partial(german_density, amplitude=4.032e-7), f"German, low: {_VTCM}"
    ),
    "german_high": TrackSpectrum(
        "german_high", partial(german_density, amplitude=1.08e-6), f"German, high: {_VTCM}"
    ),
    "chinese_ballastless": TrackSpectrum(
        "chinese_ballastless", chinese_ballastless_density, f"Chinese, ballastless: {_VTCM}"
    ),
    **{
        f"iso8608_{letter}": TrackSpectrum(
            f"iso8608_{letter}",
            partial(iso8608_density, roughness=16e-6 * 4**step),
            f"class {letter.upper()} of {_ISO}",
            "road",
        )
        for step, letter in enumerate("abcde")
    },
}
"""Every track and road spectrum by its name in configurations."""


def track_spectrum(
    name: str, short_waves: bool = False, short_wave_from_m: float = 2.5
) -> TrackSpectrum:
    """Return the spectrum called `name`, optionally with the short waves of the rail head.

    Below the wavelength `short_wave_from_m`, 0.036 n^-3.15 mm^2 m replaces the spectrum. The two
    spectra are discontinuous there: at 2.5 m the density jumps up by a factor of 16.6
    (german_low), 6.2 (german_high) or 69 (chinese_ballastless), at 1 m still by 33, 12 or 91. The
    jump is not smoothed, as in the simulator that the numbers come from; neither side is rescaled.

    Examples
    --------
    >>> round(1e3 * band_rms(track_spectrum("german_low"), 3.0, 25.0), 2)
    0.98
    """
    check_choice("track", name, sorted(TRACKS))
    check_number("short_wave_from_m", short_wave_from_m, above=0)
    spectrum = TRACKS[name]
    if not short_waves:
        return spectrum
    if spectrum.surface != "rail":
        raise ValueError(
            f"`short_waves` are those of a rail head, got {name!r}, a road; leave them off"
        )
    return replace(
        spectrum,
        name=f"{name}_short_waves",
        density=partial(
            _with_short_waves, density=spectrum.density, short_wave_from_m=short_wave_from_m
        ),
        source=f"{spectrum.source}; below {short_wave_from_m:g} m: 0.036 n^-3.15 mm^2 m",
    )


def band_rms(spectrum: TrackSpectrum, shortest_m: float, longest_m: float) -> float:
    """Return the RMS elevation of all wavelengths between two bounds, [m].

    ``sqrt(integral of S(n) dn from 1 / longest_m to 1 / shortest_m)``, integrated over log n.
    """
    check_band(shortest_m, longest_m)
    variance, _ = quad(
        lambda log_n: float(spectrum.density(np.array([math.exp(log_n)]))[0]) * math.exp(log_n),
        -math.log(longest_m),
        -math.log(shortest_m),
        epsabs=0.0,
        epsrel=1e-9,
        limit=500,
    )
    return math.sqrt(variance)


def acceleration_density(
    spectrum: TrackSpectrum, frequencies_hz: ArrayLike, speed_m_per_s: float
) -> FloatArray:
    """Return the spectrum of an axle box's vertical acceleration on a rigid track.

    ``(2 pi f)^4 S(f / v) / v`` [(m/s^2)^2/Hz], one-sided, of the shape of `frequencies_hz`; 0 at
    f = 0, as every S here grows more slowly than n^-4.
    """
    check_number("speed_m_per_s", speed_m_per_s, above=0)
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    if not (np.isfinite(frequencies) & (frequencies >= 0)).all():
        raise ValueError("`frequencies_hz` must be finite and >= 0, got a negative one, inf or NaN")
    density = np.zeros(frequencies.shape)
    moving = frequencies > 0
    f = frequencies[moving]
    density[moving] = (2 * np.pi * f) ** 4 * spectrum.density(f / speed_m_per_s) / speed_m_per_s
    return density


def check_band(shortest_m: float, longest_m: float) -> None:
    """Raise ValueError unless 0 < shortest_m < longest_m < infinity."""
    check_number("shortest_m", shortest_m, above=0)
    check_number("longest_m", longest_m, above=shortest_m)
