"""Spectra of track and road unevenness, and random profiles with these spectra.

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
from scipy.fft import irfft, next_fast_len

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
BLOCK = 1 << 15  # positions interpolated at once: the working arrays stay in the cache


@dataclass(frozen=True, eq=False)
class TrackProfile:
    """Elevation of a track and its first two derivatives along it, on a regular grid from x = 0.

    `elevation_m`: z, positive upwards, `slope`: dz/dx [-], `curvature_per_m`: d^2z/dx^2; each
    (n_points,). At a constant speed v the vertical acceleration is v^2 times the curvature.
    """

    step_m: float
    elevation_m: FloatArray
    slope: FloatArray
    curvature_per_m: FloatArray

    @property
    def length_m(self) -> float:
        """Position of the last grid point, [m]."""
        return self.step_m * (self.elevation_m.size - 1)

    def at(self, x: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return elevation [m], slope [-] and curvature [1/m] at positions `x` [m], shape of `x`.

        Between two grid points the elevation is the polynomial of degree five that has the
        elevation, slope and curvature of both (quintic Hermite); slope and curvature are its exact
        derivatives, so the three are consistent everywhere. For a wave sampled p times per length,
        p >= 8, the error of the elevation is at most (2 pi / p)^6 / 46080, that of the curvature
        (2 pi / p)^4 / 1920. Monotone positions are fastest. Raises ValueError if a position is
        outside the profile (by more than a millionth of a step) or NaN.
        """
        positions = np.asarray(x, dtype=np.float64)
        slack = 1e-6 * self.step_m
        if positions.size and not (
            positions.min() >= -slack and positions.max() <= self.length_m + slack
        ):
            raise ValueError(
                f"positions `x` must lie in 0 to {self.length_m:g} m, got {positions.min():g} to "
                f"{positions.max():g} m; make a longer profile"
            )
        flat = positions.ravel()
        values = np.empty((3, flat.size))
        for start in range(0, flat.size, BLOCK):
            block = slice(start, start + BLOCK)
            values[:, block] = self._interpolate(flat[block])
        elevation, slope, curvature = values.reshape(3, *positions.shape)
        return elevation, slope, curvature

    def _interpolate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Evaluate ``z0 + t (d0 + t (w0/2 + t (a3 + t (a4 + t a5))))`` and its derivatives."""
        h = self.step_m
        cell = np.clip((x / h).astype(np.intp), 0, self.elevation_m.size - 2)
        t = x / h - cell
        z0, d0, w0 = self.elevation_m[cell], h * self.slope[cell], h**2 * self.curvature_per_m[cell]
        cell += 1
        d1, w1 = h * self.slope[cell], h**2 * self.curvature_per_m[cell]
        # Errors of the left point's parabola at the right point.
        rise = self.elevation_m[cell] - z0 - d0 - w0 / 2
        turn = d1 - d0 - w0
        bend = w1 - w0
        a3 = 10 * rise - 4 * turn + bend / 2
        a4 = -15 * rise + 7 * turn - bend
        a5 = 6 * rise - 3 * turn + bend / 2
        elevation = z0 + t * (d0 + t * (w0 / 2 + t * (a3 + t * (a4 + t * a5))))
        slope = (d0 + t * (w0 + t * (3 * a3 + t * (4 * a4 + t * 5 * a5)))) / h
        curvature = (w0 + t * (6 * a3 + t * (12 * a4 + t * 20 * a5))) / h**2
        return elevation, slope, curvature


def make_profile(
    spectrum: TrackSpectrum, length_m: float, step_m: float, seed: int, longest_m: float = 500.0
) -> TrackProfile:
    """Return a Gaussian random profile with the spectrum's density, made by inverse FFT.

    ``z(x) = sum_k a_k cos(2 pi k dn x) + b_k sin(2 pi k dn x)`` with a_k and b_k independent and
    normal with variance S(k dn) dn. The period 1 / dn is longer than the profile by at least
    `longest_m`, so that its ends are not correlated. Waves up to two steps, or longer than
    `longest_m`, are absent.
    """
    check_number("length_m", length_m, above=0)
    check_number("step_m", step_m, above=0)
    check_number("longest_m", longest_m, above=2 * step_m)
    if length_m < step_m:
        raise ValueError(f"`length_m` must be at least one step of {step_m} m, got {length_m}")
    n_points = math.ceil(length_m / step_m - 1e-6) + 1
    n_period = next_fast_len(n_points + math.ceil(longest_m / step_m), real=True)
    dn = 1 / (n_period * step_m)
    first, last = math.ceil(1 / (longest_m * dn) - 1e-9), (n_period - 1) // 2
    if first > last:
        raise ValueError(
            f"no wave of the period {n_period * step_m:g} m lies between {2 * step_m} and "
            f"{longest_m} m; raise `longest_m` or `length_m`"
        )
    n = dn * np.arange(first, last + 1)
    scale = 0.5 * np.sqrt(spectrum.density(n) * dn)  # half: the other half lies at -n
    draws = np.random.default_rng(seed).standard_normal((n.size, 2))
    amplitudes = np.zeros(n_period // 2 + 1, dtype=np.complex128)
    band = amplitudes[first : last + 1]
    band[:] = draws.view(np.complex128)[:, 0] * scale
    # Each derivative is a factor j 2 pi n in the spectrum.
    derivatives = []
    for _ in range(3):
        wave: FloatArray = irfft(amplitudes, n_period, norm="forward")
        derivatives.append(wave[:n_points].copy())
        band *= 2j * np.pi * n
    return TrackProfile(step_m, *derivatives)


@dataclass(frozen=True)
class TrackSpectrum:
    """One-sided power spectral density of the vertical unevenness of a rail or a road.

    `density` maps n > 0 [cycles/m] to S(n) [m^3] of the same shape; `source` is the origin of
    formula and numbers.
    """

    name: str
    density: Callable[[FloatArray], FloatArray]
    source: str


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
        )
        for step, letter in enumerate("abcde")
    },
}
"""Every track and road spectrum by its name in configurations."""


def track_spectrum(name: str) -> TrackSpectrum:
    """Return the spectrum called `name`.

    Examples
    --------
    >>> float(track_spectrum("german_low").density(np.array([0.1]))[0].round(9))
    4.056e-06
    """
    check_choice("track", name, sorted(TRACKS))
    return TRACKS[name]


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
