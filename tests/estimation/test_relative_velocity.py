"""Damping at equal relative velocity: naive formulas, exponents that healthy trips show."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scipy.stats import norm
from trip_fixtures import model_at
from vehicles import AM96

from suspnet.dynamics import VerticalVehicle
from suspnet.estimation.commissioning import commission
from suspnet.estimation.damping_laws import DampingSlopes
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.from_spectra import estimate_with_noise
from suspnet.estimation.healthy_trips import HealthySpectra
from suspnet.estimation.relative_velocity import (
    NOTE,
    DampingByVelocity,
    prior,
    relative_velocities,
)
from suspnet.spectra.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.segments import Speeds

LAW = DampingByVelocity((0.05, 0.03), (0.08, 0.3), (0.01, 0.05))
NAMES = ("k_p", "c_p", "k_s", "c_s")
SETTINGS = EstimateSettings(
    segment_s=5.0, rates_hz=(1000.0, 500.0, 500.0), high_hz=9.9, body_high_hz=9.0
).bound(AM96)
SOFT = replace(AM96, primary_friction_share=0.1, secondary_degression=0.4)
GENERATOR = VerticalVehicle(SOFT, distribution={f"healthy_{name}": 0.3 for name in ("c_p", "c_s")})


def read(ratios):
    """Return an estimate of one row with intervals of 2 to 5 %."""
    values = np.array([ratios])
    low, high = values * [0.98, 0.96, 0.99, 0.95], values * [1.02, 1.04, 1.01, 1.03]
    return Estimate(NAMES, values, low, high, 0.9, Flags.none(1))


# reference


@pytest.mark.parametrize("velocities", [(0.05, 0.03), (0.04, 0.02), (0.09, 0.06)])
def test_estimates_are_compared_as_the_formula_says(velocities):
    c_p, c_s = 0.7, 1.2
    x_p = (1 - 0.08) * c_p + 0.08 * 0.05 / velocities[0]
    x_s = c_s * (velocities[1] / 0.03) ** -0.3
    given = read([1.01, x_p, 0.97, x_s])
    found = LAW.compared(given, velocities)
    np.testing.assert_array_equal(found.values[:, ::2], given.values[:, ::2])  # springs
    np.testing.assert_array_equal(found.low[:, ::2], given.low[:, ::2])
    assert found.values[0, [1, 3]] == pytest.approx([c_p, c_s])

    def ratios(x, d):
        slower = 0.05 / velocities[0], 0.03 / velocities[1]
        return (x[0] - d[0] * slower[0]) / (1 - d[0]), x[1] * slower[1] ** -d[1]

    z, step = norm.ppf(0.95), 1e-5
    for i, j in ((0, 1), (1, 3)):
        # differences of the formula by d and by the logarithm of the estimate
        up, down = np.array(LAW.exponents), np.array(LAW.exponents)
        up[i], down[i] = up[i] + step, down[i] - step
        by_d = math.log(ratios((x_p, x_s), up)[i] / ratios((x_p, x_s), down)[i]) / (2 * step)
        grown = [x * math.exp(step * (k == i)) for k, x in enumerate((x_p, x_s))]
        shrunk = [x * math.exp(-step * (k == i)) for k, x in enumerate((x_p, x_s))]
        gain = math.log(ratios(grown, LAW.exponents)[i] / ratios(shrunk, LAW.exponents)[i])
        gain /= 2 * step
        common = z * LAW.deviations[i] * by_d
        below = math.hypot(gain * math.log(given.values[0, j] / given.low[0, j]), common)
        above = math.hypot(gain * math.log(given.high[0, j] / given.values[0, j]), common)
        assert found.low[0, j] == pytest.approx(found.values[0, j] * math.exp(-below), rel=1e-6)
        assert found.high[0, j] == pytest.approx(found.values[0, j] * math.exp(above), rel=1e-6)


def test_relative_velocities_are_those_of_signals():
    rng, rate_hz, n = np.random.default_rng(0), 50.0, 5000
    frequencies = np.arange(1, 400) * rate_hz / n
    amplitudes = rng.standard_normal((3, len(frequencies))) + 1j * rng.standard_normal(
        (3, len(frequencies))
    )
    # |X|^2 / 2 per line: density over the spacing of the lines
    spacing = frequencies[0]
    auto = np.abs(amplitudes) ** 2 / 2 / spacing
    pairs = ((0, 1), (0, 2), (1, 2))
    cross = np.array([amplitudes[x].conj() * amplitudes[y] for x, y in pairs]) / 2 / spacing
    spectra = CrossSpectra(torch.as_tensor(auto), torch.as_tensor(cross), 100.0)
    found = relative_velocities(spectra, torch.as_tensor(frequencies))
    times = np.arange(n) / rate_hz
    for i, (x, y) in enumerate(((0, 1), (1, 2))):
        lines = (amplitudes[x] - amplitudes[y]) / (2j * np.pi * frequencies)
        velocity = (lines[:, None] * np.exp(2j * np.pi * frequencies[:, None] * times)).real
        # the trapezoid counts the first and the last line half
        halves = (np.abs(lines[[0, -1]]) ** 2).sum() / 4
        naive = math.sqrt(np.mean(velocity.sum(axis=0) ** 2) - halves)
        assert found[i] == pytest.approx(naive, rel=1e-6)


def test_the_prior_is_uniform_up_to_what_the_vehicle_file_allows():
    draws = np.random.default_rng(0).uniform(0, [0.1, 0.4], (200_000, 2))
    mean, deviation = prior(SOFT)
    np.testing.assert_allclose(mean, draws.mean(axis=0), rtol=0.01)
    np.testing.assert_allclose(deviation, draws.std(axis=0), rtol=0.01)


# property


def test_alike_trips_keep_the_prior_and_a_stiff_vehicle_file_has_no_law():
    alike = np.array([[0.05, 0.03], [0.051, 0.03], [0.049, 0.031]])
    slopes = DampingSlopes(SOFT, [None] * 3, alike, range(3))
    found = slopes.laws(np.zeros(0), np.zeros(0)).velocity
    assert len(slopes) == 0
    assert (found.exponents, found.deviations) == tuple(tuple(one.tolist()) for one in prior(SOFT))
    stiff = DampingSlopes(replace(SOFT, primary_friction_share=0.0), [None] * 3, alike, range(3))
    half = stiff.laws(np.zeros(0), np.zeros(0)).velocity
    assert (half.exponents[0], half.deviations[0]) == (0.0, 0.0)
    assert DampingSlopes(AM96, [None] * 3, alike, range(3)).laws(np.zeros(0), np.zeros(0)) == (
        type(slopes.laws(np.zeros(0), np.zeros(0)))()
    )


def test_exponents_of_damping_are_learnt_from_rough_and_smooth_trips():
    groups, amplitudes, truth = [], (0.6, 0.95, 1.5), (0.06, 0.25)
    taps = moving_average_with(SETTINGS.welch.correlation().numpy())
    source, at = torch.Generator().manual_seed(0), Speeds((70.0,), (1.0,))
    bogies = replace(GENERATOR, distribution=None, other_bogie="same")
    for i, amplitude in enumerate(amplitudes):
        # velocities grow with the amplitude, less a little of what the damping loses
        c_p, c_s = (amplitude**-d for d in truth)
        rows = torch.tensor([[1.0, c_p, 1.0, c_s, 1.0]], dtype=torch.float64)
        drawn = sample_spectra(SETTINGS.observer(bogies).at(at).expected(rows), taps, source)
        power = amplitude**2
        spectra = CrossSpectra(power * drawn.auto[0], power * drawn.cross[0], drawn.n_averages)
        groups.append(HealthySpectra(i, f"trip_{i}", at, spectra))
    law = commission(GENERATOR, SETTINGS, groups).laws.velocity
    for d, deviation, wide, true in zip(
        law.exponents, law.deviations, prior(SOFT)[1], truth, strict=True
    ):
        assert abs(d - true) < 4 * deviation + 0.03  # the velocities' own change
        assert deviation < wide
    assert "power" in str(law)


def test_a_trip_is_compared_at_the_noted_velocities():
    model = model_at(70.0)
    mean = model.settings.observer(model.generator).expected(
        torch.full((1, 5), 0.9, dtype=torch.float64)
    )
    spectra = CrossSpectra(mean.auto[0], mean.cross[0], mean.n_averages)
    plain = estimate_with_noise(model, spectra, 0.9)[0]
    noted = replace(model, training=model.training | {"commissioned": {NOTE: asdict(LAW)}})
    own = relative_velocities(spectra, model.observer.frequencies_hz).tolist()
    expected = LAW.compared(plain, own)
    found = estimate_with_noise(noted, spectra, 0.9)[0]
    np.testing.assert_allclose(found.values, expected.values)
    np.testing.assert_allclose(found.high, expected.high)


# error


@pytest.mark.parametrize(
    "change",
    [
        {"healthy_m_per_s": (0.0, 0.1)},
        {"exponents": (0.1,)},
        {"exponents": (0.1, 2.0)},
        {"deviations": (-0.1, 0.1)},
        {"deviations": (math.nan, 0.1)},
    ],
)
def test_a_law_of_foreign_numbers_is_refused(change):
    with pytest.raises(ValueError, match=NOTE):
        replace(LAW, **change)
