"""A model reads trips at speeds beside its own, at several speeds, and where the bogie is still."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import norm
from trip_fixtures import OUTPUTS, model_at
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.expected_spectra import SPEED
from suspnet.curves.speeds import Speeds
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.from_curves import corrected
from suspnet.trains.spectra.steady_parts import combined, same_speed
from suspnet.vehicle import PARAMETERS, VerticalVehicle

ORDER = [PARAMETERS.index(name) for name in OUTPUTS]
STILL = 44.0
"""Speed [m/s] at which the bogie's axles move against each other at 8.15 Hz."""


@pytest.fixture(scope="module")
def model():
    return model_at()


def settings_at(speed, **changes):
    return EstimateSettings(speed_m_per_s=speed, **changes).bound(AM96)


def observer_at(speed, **changes):
    generator = VerticalVehicle(AM96, speed_m_per_s=speed)
    return settings_at(speed, **changes).observer(generator)


def worn(n, seed=0):
    return torch.as_tensor(np.random.default_rng(seed).uniform(0.7, 1.2, (n, 5)))


# reference


def test_observer_at_another_speed_is_that_of_a_generator_at_it():
    # the noise stays that of the speed trained for
    found = observer_at(70.0).at(Speeds.of(66.0, 0.0))
    other = observer_at(66.0)
    other.noise = found.noise
    expected = other.expected(worn(3))
    actual = found.expected(worn(3))
    torch.testing.assert_close(actual.auto, expected.auto, rtol=1e-9, atol=0)
    torch.testing.assert_close(actual.cross, expected.cross, rtol=1e-9, atol=0)


def test_spectra_of_several_speeds_are_their_weighted_mean():
    speeds = Speeds.of(70.0, 0.7)
    observer = observer_at(70.0)
    noise = observer.noise[:, None]
    parts = [observer.at(Speeds((v,), (1.0,))).expected(worn(2)) for v in speeds.m_per_s]
    found = observer.at(speeds).expected(worn(2))
    autos = [w * (part.auto - noise) for w, part in zip(speeds.weights, parts, strict=True)]
    torch.testing.assert_close(found.auto - noise, sum(autos), rtol=1e-6, atol=1e-9)
    crosses = [w * part.cross for w, part in zip(speeds.weights, parts, strict=True)]
    torch.testing.assert_close(found.cross, sum(crosses), rtol=1e-9, atol=0)


@pytest.mark.parametrize("power", range(6))
def test_quadrature_has_the_moments_of_a_normal(power):
    speeds = Speeds.of(70.0, 0.7)
    moment = sum(
        w * ((v - 70.0) / 0.7) ** power for v, w in zip(speeds.m_per_s, speeds.weights, strict=True)
    )
    assert moment == pytest.approx((1, 0, 1, 0, 3, 0)[power], abs=1e-9)


def test_speed_of_the_rows_multiplies_that_of_the_trip():
    rows = torch.cat([worn(2), torch.tensor([[1.02], [0.97]])], dim=1)
    found = observer_at(70.0).at(Speeds.of(66.0, 0.0)).noise_free(rows)
    for i, row in enumerate(rows):
        single = observer_at(70.0).at(Speeds.of(66.0 * float(row[SPEED]), 0.0))
        # the track's density stays that of the trip: it cancels but for leakage
        torch.testing.assert_close(found[i], single.noise_free(row[None, :5])[0], rtol=0.02, atol=0)


def test_noise_free_estimates_are_corrected_to_the_truth(model):
    truth = worn(20)
    observer = model.settings.observer(model.generator).at(Speeds.of(66.0, 0.3))
    curves = observer.for_features(observer.noise_free(truth))
    first = model.predict(model.features(curves, observer.frequencies_hz)[0])
    known = truth.numpy()[:, ORDER]
    errors = [
        np.abs(np.log(corrected(replace(model, corrected=True), observer, first, n) / known))
        for n in (0, 1, 3)
    ]
    medians, largest = (np.array([f(e) for e in errors]) for f in (np.median, np.max))
    assert medians[0] > 0.005
    assert largest[0] > 0.05
    assert (medians[1:] < [0.5 * medians[0], 0.01 * medians[0]]).all()
    # of 20 vehicles one lies where the regression is far off
    assert (largest[1:] < 0.5 * largest[0]).all()


# limit


# property


def test_bins_where_the_bogie_does_not_bounce_are_weak():
    observer = observer_at(STILL)
    still_hz = STILL / (4 * AM96.half_wheelbase_m)
    weak = observer.frequencies_hz[observer.weak.any(dim=0)]
    assert 1 <= len(weak) < 15
    assert float((weak - still_hz).abs().min()) <= 0.05
    covariance = observer.without_unused(observer.covariance(worn(1)))
    for i in (0, 1):
        assert bool(covariance[0, i, i][observer.weak[i]].real.isinf().all())
        assert bool((covariance[0, i, 1 - i][observer.weak[i]] == 0).all())


def test_weak_bins_are_bridged_by_straight_lines_relative_to_healthy():
    observer = observer_at(STILL)
    healthy = observer.noise_free(torch.ones(1, 5, dtype=torch.float64))
    ramp = torch.linspace(1.0, 2.0, len(observer.frequencies_hz), dtype=torch.float64)
    spoilt = healthy * torch.where(observer.weak, torch.tensor(50.0), ramp)
    found = observer.for_features(spoilt) / healthy
    inner = (observer.weak.cumsum(1) < observer.weak.sum(1, keepdim=True)).all(0)
    inner &= observer.frequencies_hz > 2.0
    expected = ramp.to(found.dtype).expand_as(found)
    torch.testing.assert_close(found[..., inner], expected[..., inner])


def test_segments_are_grouped_by_their_speed():
    means = torch.tensor([70.0, 50.0, 70.5, 69.5, 51.0, 60.0, 80.0])
    within = torch.tensor([True] * 6 + [False])
    groups = same_speed(means[:, None].expand(-1, 3), within, 0.02)
    assert [group.nonzero()[:, 0].tolist() for group in groups] == [[0, 2, 3], [1, 4], [5]]
    assert same_speed(means[:, None], torch.zeros(7, dtype=torch.bool), 0.02) == []


def part(values, half, noise_share, averages=10.0, words=""):
    values, half = np.array([values]), np.array([half])
    flags = Flags(((("missing", words),) if words else (),))
    ends = values * np.exp(-half), values * np.exp(half)
    estimate = Estimate(("k_p", "c_p"), values, *ends, 0.9, flags)
    return SimpleNamespace(
        estimate=estimate,
        noise_share=np.array(noise_share),
        spectra=SimpleNamespace(n_averages=averages),
        speed_m_per_s=70.0,
    )


def test_noise_of_several_speeds_averages_out_and_the_rest_does_not():
    parts = [part([0.99, 1.0], [0.02, 0.1], [1.0, 0.0]), part([1.0, 1.1], [0.02, 0.2], [1.0, 0.0])]
    found = combined(parts)
    np.testing.assert_allclose(found.half_widths[0, 0], 0.02 / math.sqrt(2))
    np.testing.assert_allclose(found.half_widths[0, 1], 0.8 * 0.1 + 0.2 * 0.2)
    np.testing.assert_allclose(found.values[0], [math.sqrt(0.99), 1.1**0.2])


def test_speeds_that_differ_by_more_than_their_noise_widen_the_interval():
    values, half = ([0.9, 1.0], [1.0, 1.0], [1.1, 1.0]), [0.02, 0.05]
    found = combined([part(pair, half, [0.5, 1.0]) for pair in values])
    spread = np.var(np.log([0.9, 1.0, 1.1]), ddof=1)
    lasting = norm.ppf(0.95) ** 2 * spread - 0.5 * 0.02**2
    expected = math.sqrt(0.5 * 0.02**2 / 3 + lasting)
    np.testing.assert_allclose(found.half_widths[0, 0], expected)
    np.testing.assert_allclose(found.half_widths[0, 1], 0.05 / math.sqrt(3))


def test_groups_without_intervals_are_weighed_by_their_averages():
    parts = [
        part([0.9, 1.0], [np.nan] * 2, [1.0, 1.0], 30.0),
        part([1.0, 1.0], [np.nan] * 2, [1.0, 1.0], 10.0),
    ]
    found = combined(parts)
    np.testing.assert_allclose(found.values[0], [0.9**0.75, 1.0])
    assert np.isnan(found.half_widths).all()
