"""Damping at equal relative velocity: naive formulas, exponents that healthy trips show."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scipy.stats import norm
from trip_fixtures import model_at
from vehicles import AM96

from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.estimation.damping_laws import DampingNumbers
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.from_spectra import estimate_with_noise
from suspnet.estimation.relative_velocity import (
    NOTE,
    DampingByVelocity,
    linear,
    prior,
    relative_velocities,
)
from suspnet.trains.fits.commissioning import commission
from suspnet.trains.fits.healthy_misfit import HealthySpectra
from suspnet.vehicle import VerticalVehicle

COVARIANCE = np.diag([1e-4, 1e-4, 0.04, 1.0, 0.25])
COVARIANCE[1, 3] = COVARIANCE[3, 1] = 1e-3
LAW = DampingByVelocity(
    (0.05, 0.03),
    (0.04, 0.05, 0.7, 8.0, 16.0),
    (0.1, 0.1, 1.0, 20.0, 20.0),
    tuple(map(tuple, COVARIANCE.tolist())),
)
NAMES = ("k_p", "c_p", "k_s", "c_s")
SETTINGS = EstimateSettings(
    segment_s=5.0, rates_hz=(1000.0, 500.0, 500.0), high_hz=9.9, body_high_hz=9.0
).bound(AM96)
SOFT = replace(
    AM96, primary_friction_share=0.1, primary_blow_off_m_per_s=0.05, secondary_blow_off_m_per_s=0.05
)
GENERATOR = VerticalVehicle(SOFT, distribution={f"healthy_{name}": 0.3 for name in ("c_p", "c_s")})


def slope(y):
    """Return what is left of a damper's slope at y blow-off velocities, written out."""
    return 0.2 + 0.8 * math.erf(1 / (math.sqrt(2) * y)) if y else 1.0


def seen(ratio, share, inverse, own, healthy, spring=1.0, power=0.7):
    """Return the estimate relative to healthy of a damper at a ratio, written out."""
    whole = (1 - share) * slope(healthy * inverse) + share
    return (
        (1 - share) * ratio * slope(own * inverse) + share * spring * (healthy / own) ** power
    ) / whole


def read(ratios):
    """Return an estimate of one row with intervals of 2 to 5 %."""
    values = np.array([ratios])
    low, high = values * [0.98, 0.96, 0.99, 0.95], values * [1.02, 1.04, 1.01, 1.03]
    return Estimate(NAMES, values, low, high, 0.9, Flags.none(1))


# reference


@pytest.mark.parametrize("velocities", [(0.05, 0.03), (0.04, 0.02), (0.09, 0.06)])
def test_estimates_are_compared_as_the_formula_says(velocities):
    known = replace(LAW, covariance=np.zeros((5, 5)).tolist())
    ratios, numbers = (0.7, 1.2), ((0.05, 8.0), (0.0, 16.0))
    x_p, x_s = (
        seen(ratio, *own, v, healthy, 1.3)
        for ratio, own, v, healthy in zip(
            ratios, numbers, velocities, LAW.healthy_m_per_s, strict=True
        )
    )
    given = read([1.3 * (1 - 0.04 + 0.04 * 0.05 / velocities[0]), x_p, 0.97, x_s])
    found = known.compared(given, velocities)
    assert found.values[0] == pytest.approx([1.3, ratios[0], 0.97, ratios[1]])
    assert (found.low[0, 2], found.high[0, 2]) == (given.low[0, 2], given.high[0, 2])


def test_what_the_law_does_not_know_widens_the_interval():
    velocities = (0.09, 0.06)
    certain = np.array(COVARIANCE)
    certain[0] = 0.0
    given = read([1 - 0.04 + 0.04 * 0.05 / 0.09, 0.8, 1.0, 0.9])
    found = replace(LAW, covariance=certain.tolist()).compared(given, velocities)
    assert found.values[0, 0] == pytest.approx(1.0)
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(LAW.numbers, COVARIANCE, 20_000).clip(0, LAW.most)
    for j, own, i in ((1, (1, 3), 0), (3, (None, 4), 1)):
        share = drawn[:, 1] if own[0] else np.zeros(len(drawn))
        ends = LAW.healthy_m_per_s[i], velocities[i]
        at_0, at_1 = (
            [
                seen(r, s, u, ends[1], ends[0], 1.0, a)
                for s, a, u in zip(share, drawn[:, 2], drawn[:, own[1]], strict=True)
            ]
            for r in (0.0, 1.0)
        )
        gains = np.subtract(at_1, at_0)
        logs = np.log((given.values[0, j] - at_0) / gains)
        assert found.values[0, j] == pytest.approx(math.exp(logs.mean()), rel=2e-3)
        common = norm.ppf(0.95) * logs.std()
        gain = max(given.values[0, j] / gains.mean() / math.exp(logs.mean()), 1.0)
        for end, before in ((found.low, given.low), (found.high, given.high)):
            own_part = gain * math.log(before[0, j] / given.values[0, j])
            assert abs(math.log(end[0, j] / found.values[0, j])) == pytest.approx(
                math.hypot(own_part, common), rel=0.02
            )


@pytest.mark.parametrize("over", [0.3, 0.65, 2.0])
def test_the_slope_is_that_of_statistical_linearisation(over):
    # least squares of the force of a damper that blows off at 1, over normal velocities
    velocity = np.linspace(-12, 12, 400_001) * over
    density = norm.pdf(velocity, scale=over)
    force = np.where(
        np.abs(velocity) < 1, velocity, np.sign(velocity) * (1 + 0.2 * (np.abs(velocity) - 1))
    )
    best = (force * velocity * density).sum() / (velocity**2 * density).sum()
    found, _ = linear(
        torch.tensor([[0.0, 0.0, 1.0, 0.0, over]], dtype=torch.float64), "c_s", 1.0, 1e-6
    )
    assert float(found) == pytest.approx(best, rel=1e-4)


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
    draws = np.random.default_rng(0).uniform(0, [0.025, 0.1, 1.0, 20.0, 20.0], (200_000, 5))
    mean, deviation = prior(SOFT)
    np.testing.assert_allclose(mean, draws.mean(axis=0), rtol=0.01)
    np.testing.assert_allclose(deviation, draws.std(axis=0), rtol=0.01)


# property


def test_trips_that_are_alike_keep_the_prior():
    alike = np.array([[0.05, 0.03], [0.051, 0.03], [0.049, 0.031]])
    numbers = DampingNumbers(SOFT, [None] * 3, alike, range(3))
    assert len(numbers) == 0
    found = numbers.laws(np.zeros(0), np.zeros((0, 0))).velocity
    assert (found.numbers, found.most) == (
        (0.0125, 0.05, 0.5, 10.0, 10.0),
        (0.025, 0.1, 1.0, 20.0, 20.0),
    )
    np.testing.assert_allclose(np.diag(found.covariance), prior(SOFT)[1] ** 2)


def test_a_vehicle_file_of_linear_dampers_has_no_law():
    apart = np.array([[0.05, 0.03], [0.1, 0.06], [0.15, 0.09]])
    numbers = DampingNumbers(AM96, [None] * 3, apart, range(3))
    assert len(numbers) == 0
    assert numbers.laws(np.zeros(0), np.zeros((0, 0))).velocity is None
    in_part = replace(AM96, secondary_blow_off_m_per_s=0.1)
    assert len(DampingNumbers(in_part, [None] * 3, apart, range(3))) == 1


def test_friction_and_blow_off_are_learnt_from_rough_and_smooth_trips():
    groups, truth = [], (0.06, 12.0, 15.0)
    taps = moving_average_with(SETTINGS.welch.correlation().numpy())
    source, at = torch.Generator().manual_seed(0), Speeds((70.0,), (1.0,))
    observer = SETTINGS.observer(replace(GENERATOR, distribution=None, other_bogie="same")).at(at)
    bins = SETTINGS.frequencies_hz()

    def moving(amplitude, damping):
        """Return rows of ratios with this damping, and the velocities there."""
        rows = torch.tensor([[1.0, damping[0], 1.0, damping[1], 1.0]], dtype=torch.float64)
        mean = observer.expected(rows)
        one = CrossSpectra(mean.auto[0], mean.cross[0], mean.n_averages)
        return rows, amplitude * relative_velocities(one, bins)

    healthy = moving(1.0, (1.0, 1.0))[1]
    for i, amplitude in enumerate((0.4, 0.7, 1.2, 2.0)):
        rows, own = moving(amplitude, (1.0, 1.0))
        for _ in range(8):  # less damping is more motion is less damping
            each = zip((truth[0], 0.0), truth[1:], own, healthy, strict=True)
            rows, own = moving(amplitude, [seen(1.0, *one) for one in each])
        drawn, power = sample_spectra(observer.expected(rows), taps, source), amplitude**2
        spectra = CrossSpectra(power * drawn.auto[0], power * drawn.cross[0], drawn.n_averages)
        groups.append(HealthySpectra(i, f"trip_{i}", at, spectra))
    law = commission(GENERATOR, SETTINGS, groups).laws.velocity
    assert "are compared at" in str(law)
    # friction and blow-off both lose damping: what counts is the loss at other velocities
    for i, (share, u) in enumerate(zip((truth[0], 0.0), truth[1:], strict=True)):
        for faster in (0.7, 1.5):
            own, at_rest = faster * healthy[i], law.healthy_m_per_s[i]
            slope_of, offset = linear(law.draws(), NAMES[2 * i + 1], own, at_rest)
            left = (slope_of + offset).numpy()
            true, reference = (seen(1.0, share, u, v, healthy[i]) for v in (own, at_rest))
            assert abs(left.mean() - true / reference) < 0.03, (i, faster)
            assert left.std() < 0.02


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
        {"numbers": (0.1,)},
        {"numbers": (0.1, 0.1, 1.0, -2.0, 1.0)},
        {"most": (0.1, 0.1, 1.0, math.inf, 1.0)},
        {"covariance": ((1.0, 0.0), (0.0, 1.0))},
        {"covariance": (np.eye(5) + np.eye(5, k=1)).tolist()},
        {"covariance": np.diag([1.0, 1.0, 1.0, 1.0, -1.0]).tolist()},
        {"covariance": np.diag([1.0, 1.0, 1.0, 1.0, math.nan]).tolist()},
    ],
)
def test_a_law_of_foreign_numbers_is_refused(change):
    with pytest.raises(ValueError, match=NOTE):
        replace(LAW, **change)
