"""Random elevation profiles of a track with a given spectrum, interpolated with derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len

from suspnet.dynamics.track_spectra import TrackSpectrum, check_band
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray

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

    def __post_init__(self) -> None:
        check_number("step_m", self.step_m, above=0)
        for field in fields(self)[1:]:
            values = getattr(self, field.name)
            if values.ndim != 1 or values.shape != self.elevation_m.shape or values.size < 2:
                raise ValueError(
                    f"profile array `{field.name}` must have the shape (n_points,) of the "
                    f"elevation, n_points >= 2, got {values.shape}"
                )
            if not np.isfinite(values).all():
                raise ValueError(f"profile array `{field.name}` must be finite; drop NaN and inf")

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
    normal with variance S(k dn) dn. Slope and curvature are the exact derivatives of this sum.
    The period 1 / dn is longer than the profile by at least `longest_m`, so that the ends of the
    profile are not correlated. Wavelengths up to two steps, or longer than `longest_m`, are absent.
    """
    check_number("length_m", length_m, above=0)
    check_number("step_m", step_m, above=0)
    check_band(2 * step_m, longest_m)
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
