"""Track spectra against naive formulas, profiles against their spectra and derivatives."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import welch

from suspnet.vehicle.track import (
    TRACKS,
    TrackProfile,
    TrackSpectrum,
    acceleration_density,
    make_profile,
    track_spectrum,
)

FREQUENCIES = [0.001, 0.0186, 0.0187, 0.03, 0.0474, 0.1, 0.1533, 0.5, 3.0, 36.0]  # cycles/m


def naive_german(n, amplitude):
    """Return S(n) from the usual form in rad/m: S(n) dn = S(w) dw, w = 2 pi n."""
    w, wc, wr = 2 * math.pi * n, 0.8246, 0.0206
    return 2 * math.pi * amplitude * wc**2 / ((w * w + wr * wr) * (w * w + wc * wc))


def naive_chinese(n):
    if n < 0.0187:
        mm2_m = 1.0544e-5 / n**3.3891
    elif n < 0.0474:
        mm2_m = 3.5588e-3 / n**1.9271
    elif n < 0.1533:
        mm2_m = 1.9784e-2 / n**1.3643
    else:
        mm2_m = 3.9488e-4 / n**3.4516
    return mm2_m / 1e6


NAIVE = {
    "german_low": lambda n: naive_german(n, 4.032e-7),
    "german_high": lambda n: naive_german(n, 1.08e-6),
    "chinese_ballastless": naive_chinese,
    "iso8608_a": lambda n: 16e-6 * 0.01 / n**2,
    "iso8608_b": lambda n: 64e-6 * 0.01 / n**2,
    "iso8608_c": lambda n: 256e-6 * 0.01 / n**2,
    "iso8608_d": lambda n: 1024e-6 * 0.01 / n**2,
    "iso8608_e": lambda n: 4096e-6 * 0.01 / n**2,
}
RAILS = ["german_low", "german_high", "chinese_ballastless"]


def wave(step_m, wavelength_m, n_points=400):
    k = 2 * np.pi / wavelength_m
    x = step_m * np.arange(n_points)
    return TrackProfile(step_m, np.cos(k * x), -k * np.sin(k * x), -(k**2) * np.cos(k * x))


def smooth(spectrum, shortest_m):
    """Return the spectrum without wavelengths below `shortest_m`."""
    return TrackSpectrum("smooth", lambda n: spectrum.density(n) * (n <= 1 / shortest_m), "test")


def band_rms(spectrum, shortest_m, longest_m):
    """Return the RMS elevation of all wavelengths between two bounds, integrated over log n."""
    variance, _ = quad(
        lambda log_n: float(spectrum.density(np.array([math.exp(log_n)]))[0]) * math.exp(log_n),
        *(-math.log(longest_m), -math.log(shortest_m)),
        **{"epsabs": 0.0, "epsrel": 1e-9, "limit": 500},
    )
    return math.sqrt(variance)


# reference


@pytest.mark.parametrize("name", sorted(TRACKS))
def test_density_is_the_formula(name):
    expected = [NAIVE[name](n) for n in FREQUENCIES]
    np.testing.assert_allclose(
        TRACKS[name].density(np.array(FREQUENCIES)), expected, rtol=1e-12, atol=0
    )
    assert TRACKS[name].name == name
    assert "at hand" in TRACKS[name].source  # no source claims to be the standard itself


@pytest.mark.parametrize(("name", "rms_mm"), [*zip(RAILS, (0.98, 1.61, 0.29), strict=True)])
def test_band_rms_is_the_published_one(name, rms_mm):
    assert round(1e3 * band_rms(track_spectrum(name), 3.0, 25.0), 2) == rms_mm


def test_band_rms_of_a_road_is_the_closed_form():
    rms = band_rms(track_spectrum("iso8608_a"), 0.5, 100.0)
    assert rms == pytest.approx(math.sqrt(16e-8 * (100.0 - 0.5)), rel=1e-9, abs=0)


@pytest.mark.parametrize("name", ["german_low", "chinese_ballastless", "iso8608_c"])
def test_acceleration_density_is_the_formula_and_zero_at_rest(name):
    frequencies, speed = [0.0, 0.5, 2.0, 20.0, 300.0], 70.0
    expected = [0.0] + [(2 * math.pi * f) ** 4 * NAIVE[name](f / speed) / speed for f in (0.5, 2.0)]
    expected += [(2 * math.pi * f) ** 4 * NAIVE[name](f / speed) / speed for f in (20.0, 300.0)]
    got = acceleration_density(track_spectrum(name), frequencies, speed)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", ["german_low", "chinese_ballastless"])
def test_profile_has_the_spectrum_it_was_made_of(name):
    length, step, speed = 40e3, 0.25, 70.0
    profile = make_profile(track_spectrum(name), length, step, seed=3)
    spectra = [
        (profile.elevation_m, lambda n: TRACKS[name].density(n)),
        (profile.slope, lambda n: (2 * np.pi * n) ** 2 * TRACKS[name].density(n)),
        # What the axle box feels, back in space: S_a(f) v / v^4 with f = n v.
        (
            profile.curvature_per_m,
            lambda n: acceleration_density(TRACKS[name], n * speed, speed) / speed**3,
        ),
    ]
    for values, density in spectra:
        n, estimate = welch(values, 1 / step, nperseg=8192, detrend=False)
        for low in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0):
            band = (n >= low) & (n < 1.9 * low)
            ratio = np.mean(estimate[band] / density(n[band]))
            # Averaging a bandwidth over a length has relative variance 1 / (bandwidth length);
            # Hann segments that overlap by half cost some 10 %.
            assert abs(ratio - 1) < 4 * math.sqrt(1.1 / (0.9 * low * length))


# limit


@pytest.mark.parametrize("points_per_wave", [8, 20])
def test_interpolation_error_of_a_wave_stays_within_its_bound(points_per_wave):
    step = 0.25
    k = 2 * np.pi / (points_per_wave * step)
    profile = wave(step, points_per_wave * step)
    x = np.random.default_rng(0).uniform(0, profile.length_m, 20_000)
    elevation, slope, curvature = profile.at(x)
    p = 2 * np.pi / points_per_wave
    assert np.abs(elevation - np.cos(k * x)).max() < p**6 / 46080 + 1e-12
    assert np.abs(slope / k + np.sin(k * x)).max() < 1e-3 * p**2
    assert np.abs(curvature / k**2 + np.cos(k * x)).max() < p**4 / 1920 + 1e-9


def test_interpolation_gives_the_grid_values_at_the_grid():
    profile = make_profile(track_spectrum("german_low"), 100.0, 0.1, seed=0)
    x = 0.1 * np.arange(profile.elevation_m.size)
    for got, expected in zip(
        profile.at(x), (profile.elevation_m, profile.slope, profile.curvature_per_m), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_wavelengths_out_of_the_band_are_absent():
    length, step = 4000.0, 0.5
    white = TrackSpectrum("white", np.ones_like, "test")
    profile = make_profile(white, length, step, seed=1, longest_m=20.0)
    # Variance of a band: its width, here 0.05 to 1 cycles/m; a Gaussian's scatters with 1/(B L).
    assert profile.elevation_m.var() == pytest.approx(0.95, rel=4 / math.sqrt(0.95 * length))
    n, estimate = welch(profile.elevation_m, 1 / step, nperseg=2048, detrend=False)
    assert estimate[n < 0.045].max() < 1e-5  # sidelobes of the Hann window
    assert estimate[n > 0.055].mean() == pytest.approx(1.0, abs=0.1)


# property


@pytest.mark.parametrize("name", ["german_high", "chinese_ballastless"])
def test_curvature_is_the_acceleration_at_unit_speed(name):
    # Band below a quarter of Nyquist; v = 60 m/s, fourth-order differences over a fifth of a step.
    step, speed = 0.05, 60.0
    profile = make_profile(smooth(track_spectrum(name), 8 * step), 200.0, step, seed=2)
    dt = step / speed / 5
    t = np.arange(2.0, 3.0, dt)
    z = profile.at(speed * t)[0]
    velocity = (-z[4:] + 8 * z[3:-1] - 8 * z[1:-3] + z[:-4]) / (12 * dt)
    acceleration = (-z[4:] + 16 * z[3:-1] - 30 * z[2:-2] + 16 * z[1:-3] - z[:-4]) / (12 * dt**2)
    _, slope, curvature = profile.at(speed * t[2:-2])
    for difference, derivative in ((velocity, speed * slope), (acceleration, speed**2 * curvature)):
        rms = np.sqrt(np.mean(derivative**2))
        assert rms > 0
        assert np.abs(difference - derivative).max() < 1e-3 * rms


def test_profile_is_set_by_its_seed():
    def profile(seed):
        return make_profile(track_spectrum("chinese_ballastless"), 300.0, 0.1, seed)

    first, again, other = profile(1), profile(1), profile(2)
    np.testing.assert_array_equal(first.elevation_m, again.elevation_m)
    np.testing.assert_array_equal(first.curvature_per_m, again.curvature_per_m)
    assert abs(np.corrcoef(first.curvature_per_m, other.curvature_per_m)[0, 1]) < 0.1


@pytest.mark.parametrize(("length", "step", "n_points"), [(100.0, 0.1, 1001), (1.0, 0.3, 5)])
def test_profile_reaches_its_length(length, step, n_points):
    profile = make_profile(track_spectrum("german_low"), length, step, seed=0)
    assert profile.elevation_m.shape == profile.slope.shape == (n_points,)
    assert profile.length_m >= length - 1e-9


# failure


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: track_spectrum("swiss"), r"one of \('chinese_ballastless', .*got 'swiss'"),
        (lambda: acceleration_density(TRACKS["german_low"], [1.0], 0.0), "`speed_m_per_s` must"),
        (lambda: acceleration_density(TRACKS["german_low"], [math.nan], 70.0), "`frequencies_hz`"),
        (lambda: make_profile(TRACKS["german_low"], 0.05, 0.1, 0), "`length_m` must be at least"),
        (lambda: make_profile(TRACKS["german_low"], 10, 0.1, 0, 0.2001), "no wave of the period"),
        (lambda: wave(0.1, 1.0, n_points=101).at([1.0, 10.01]), "must lie in 0 to 10 m"),
        (lambda: wave(0.1, 1.0, n_points=101).at(math.nan), "must lie in 0 to 10 m"),
    ],
)
def test_what_is_out_of_range_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
