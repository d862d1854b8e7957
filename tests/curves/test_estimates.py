"""Draws of estimated transfer functions against estimates from simulated stationary records."""

import dataclasses
import itertools
import math
from functools import cache

import numpy as np
import pytest
import reference
import torch
import trips_reference
from vehicles import AM96

from suspnet.curves.cross_spectra import PAIRS, CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.estimates import SPEED_HALF_WIDTH, EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.curves.welch import Welch, segment_spectra
from suspnet.vehicle import QuarterCar, VerticalVehicle

METHODS = ["H1", "H2", "Hv", "IV"]
RATE_HZ, N_RECORDS, N_DRAWS = 32.0, 400, 2000
SETTINGS = EstimateSettings(
    segment_s=20.0,
    minutes=5.0,
    rates_hz=(RATE_HZ,) * 3,
    snr_db=20.0,
    high_hz=9.9,  # well below the Nyquist frequency; G_s is used on all bins
).bound(AM96)
DEGRADED = (0.8, 1.6, 1.2, 0.8, 1.1)
RATIOS = torch.tensor([DEGRADED], dtype=torch.float64)


def observer(method="IV", generator=None, **changes):
    settings = dataclasses.replace(SETTINGS, method=method, **changes)
    return settings.observer(generator or QuarterCar(AM96))


def track_acceleration(frequencies_hz, speed=70.0):
    """Return the axle box's density on the German track of low unevenness, from rad/m."""
    f = np.asarray(frequencies_hz)
    w = 2 * math.pi * f / speed
    elevation = 4.032e-7 * 0.8246**2 / ((w**2 + 0.0206**2) * (w**2 + 0.8246**2))
    return (2 * math.pi * f) ** 4 * elevation * 2 * math.pi / speed


def gains(ratios, frequencies_hz):
    """Return the gain from the axle box to each of the three sensors."""
    g_p, g_s = reference.transfer(AM96, ratios, np.asarray(frequencies_hz))
    return [np.ones_like(g_p), g_p, g_p * g_s]


def noise_densities(snr_db, rate_hz=RATE_HZ):
    """Return each sensor's noise density: the healthy signal's power spread over its band."""
    grid = np.linspace(0.1, rate_hz / 2, 40_001)
    densities = []
    for gain in gains((1.0,) * 5, grid):
        power = np.trapezoid(abs(gain) ** 2 * track_acceleration(grid), grid)
        densities.append(power * 10 ** (-snr_db / 10) / (rate_hz / 2))
    return np.array(densities)


def expected_spectra(ratios, frequencies_hz, snr_db=20.0, segment_s=20.0, speed=70.0):
    """Return auto and cross spectra, smeared by Hann's 1/6, 2/3, 1/6, auto with noise."""
    step = 1 / segment_s
    bins = np.concatenate([[frequencies_hz[0] - step], frequencies_hz, [frequencies_hz[-1] + step]])
    chain, track = gains(ratios, bins), track_acceleration(bins, speed)
    taps = [1 / 6, 2 / 3, 1 / 6]
    noise = noise_densities(snr_db) if math.isfinite(snr_db) else np.zeros(3)
    auto = [trips_reference.smeared(abs(g) ** 2 * track, taps) for g in chain]
    auto = [density + n for density, n in zip(auto, noise, strict=True)]
    cross = [trips_reference.smeared(chain[x].conj() * chain[y] * track, taps) for x, y in PAIRS]
    return auto, cross


def by_method(auto, cross, method):
    """Return G_p and G_s from spectra of axle box, bogie, body; `cross` is 01, 02, 12."""
    axle, bogie, body = auto
    axle_bogie, axle_body, bogie_body = cross
    return {
        "H1": [axle_bogie / axle, bogie_body / bogie],
        "H2": [bogie / axle_bogie.conj(), body / bogie_body.conj()],
        "Hv": [
            np.sqrt(bogie / axle) * axle_bogie / abs(axle_bogie),
            np.sqrt(body / bogie) * bogie_body / abs(bogie_body),
        ],
        # the body is the instrument of G_p, the axle box that of G_s
        "IV": [bogie_body.conj() / axle_body.conj(), axle_body / axle_bogie],
    }[method]


BIASED_AND_NOT = pytest.mark.parametrize(
    "method", ["H1", "IV", *(pytest.param(name, marks=pytest.mark.slow) for name in ("H2", "Hv"))]
)


@pytest.fixture(scope="module")
def recorded():
    """Spectra of many records made by inverse FFT, estimated as any recording is."""
    rng = np.random.default_rng(20)
    n, n_period = round(300 * RATE_HZ), 10_240
    frequencies = np.arange(n_period // 2 + 1) * RATE_HZ / n_period
    frequencies[0] = frequencies[1]
    size = np.sqrt(track_acceleration(frequencies) * RATE_HZ * n_period / 4)
    size[[0, -1]] = 0.0
    source = rng.standard_normal((N_RECORDS, len(size), 2)) @ [1, 1j] * size
    deviation = np.sqrt(noise_densities(20.0) * RATE_HZ / 2)
    records = np.empty((N_RECORDS, 3, n))
    for channel, gain in enumerate(gains(DEGRADED, frequencies)):
        records[:, channel] = np.fft.irfft(source * gain, n_period)[:, :n]
        records[:, channel] += deviation[channel] * rng.standard_normal((N_RECORDS, n))
    bins = SETTINGS.frequencies_hz()
    segments = segment_spectra(
        torch.as_tensor(records.reshape(-1, n)),
        RATE_HZ,
        SETTINGS.welch,
        float(bins[0]),
        float(bins[-1]),
    )
    torch.testing.assert_close(segments.frequencies_hz, bins)
    values = segments.values.reshape(len(segments.values), N_RECORDS, 3, -1)
    auto = values.abs().square().mean(dim=0)
    cross = torch.stack([(values[:, :, x].conj() * values[:, :, y]).mean(0) for x, y in PAIRS], 1)
    return CrossSpectra(auto, cross, SETTINGS.welch.n_averages(len(values)))


def relative_logs(recorded, method):
    """Return log-magnitude and phase of recorded and drawn estimates, relative to noise-free."""
    return (recorded.responses(method) / observer(method).noise_free(RATIOS)).log(), drawn_logs(
        method
    )


@cache
def drawn_logs(method):
    source = observer(method)
    drawn = source.observe(RATIOS.expand(N_DRAWS, 5), seed=9)
    return (drawn / source.noise_free(RATIOS)).log()


# reference


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ratios", [(1.0,) * 5, DEGRADED])
def test_noise_free_curves_are_those_of_the_naive_spectra(method, ratios):
    found = observer(method).noise_free(torch.tensor([ratios], dtype=torch.float64))[0].numpy()
    bins = SETTINGS.frequencies_hz().numpy()
    expected = by_method(*expected_spectra(ratios, bins), method)
    # the power of a channel is integrated on 4000 points
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    exact = gains(ratios, bins)
    bias = np.abs(found[0] / exact[1]) - 1
    # noise biases all but IV, where only the leakage near the dip of G_p is left
    assert (np.median(np.abs(bias)) > 2e-3) == (method != "IV")


@BIASED_AND_NOT
def test_mean_of_draws_is_that_of_recorded_estimates(recorded, method):
    simulated, drawn = relative_logs(recorded, method)
    for part in (lambda z: z.real, lambda z: z.imag):
        a, b = part(simulated), part(drawn)
        error = torch.sqrt(a.var(dim=0) / len(a) + b.var(dim=0) / len(b))
        z = (a.mean(dim=0) - b.mean(dim=0)) / error
        assert z.abs().max() < 5
        # some 180 bins, neighbours correlated: the mean square is known to about 15 %
        assert 0.5 < z.square().mean() < 1.7


@BIASED_AND_NOT
def test_scatter_of_draws_is_that_of_recorded_estimates(recorded, method):
    simulated, drawn = relative_logs(recorded, method)
    for part in (lambda z: z.real, lambda z: z.imag):
        a, b = part(simulated).std(dim=0), part(drawn).std(dim=0)
        assert b.min() > 0.003
        # 400 records give a standard deviation to 3.5 %, more in the heavy tails
        assert float((a / b).mean()) == pytest.approx(1.0, abs=0.03)
        np.testing.assert_allclose(a / b, 1.0, atol=0.2)


@pytest.mark.parametrize("method", [pytest.param("H1", marks=pytest.mark.slow), "IV"])
def test_stated_covariance_is_that_of_the_draws(method):
    longer = {"minutes": 60.0, "snr_db": 30.0}  # small noise: the formula is of first order
    source = observer(method, **longer)
    stated = source.covariance(RATIOS)[0]
    errors = (source.observe(RATIOS.expand(N_DRAWS, 5), seed=1) / source.noise_free(RATIOS)).log()
    errors = errors - errors.mean(dim=0)
    found = (errors[:, :, None] * errors[:, None].conj()).mean(dim=0)
    deviation = torch.stack([stated[0, 0].real, stated[1, 1].real]).sqrt()
    size = deviation[:, None] * deviation
    # 3000 draws: 1.8 % each
    assert ((found - stated) / size).abs().max() < 0.09
    assert ((found - stated) / size).abs().mean() < 0.02


def test_mean_and_variance_of_drawn_spectra_are_wisharts():
    source = observer(low_hz=2.0, high_hz=2.9)
    n = 20_000
    mean = source.expected(RATIOS)
    many = CrossSpectra(mean.auto.expand(n, -1, -1), mean.cross.expand(n, -1, -1), mean.n_averages)
    drawn = sample_spectra(
        many,
        moving_average_with(SETTINGS.welch.correlation().numpy()),
        torch.Generator().manual_seed(0),
    )
    averages = mean.n_averages
    assert averages == pytest.approx(29 * 18 / 19, abs=0.1)
    for x, y in itertools.combinations_with_replacement(range(3), 2):
        true, found = mean.between(x, y)[0], drawn.between(x, y)
        power = mean.auto[0, x] * mean.auto[0, y]
        # standard error of the mean 1 / sqrt(n averages) = 0.13 %, of the variance about 1.1 %
        error = (found.mean(dim=0) - true).abs() / power.sqrt()
        assert error.max() < 0.006
        spread = (found - true).abs().square().mean(dim=0) / (power / averages)
        np.testing.assert_allclose(spread, 1.0, atol=0.06)
    # a covariance of two different entries, E[dS_01 conj(dS_02)] = S_21 S_00 / n
    changes = [drawn.between(0, k) - mean.between(0, k)[0] for k in (1, 2)]
    found = (changes[0] * changes[1].conj()).mean(dim=0) * averages
    size = mean.auto[0, 0] * torch.sqrt(mean.auto[0, 1] * mean.auto[0, 2])
    expected = mean.between(2, 1)[0] * mean.auto[0, 0]
    assert (expected / size).abs().min() > 0.5
    assert ((found - expected) / size).abs().max() < 0.06
    # one draw is a covariance matrix: no coherence above 1
    for x, y in PAIRS:
        assert drawn.coherence(x, y).max() <= 1 + 1e-12


@pytest.mark.parametrize("window", ["hann", "hamming", "blackman", "flattop", "cosine"])
def test_moving_average_has_the_correlation_asked_for(window):
    correlation = Welch(window=window).correlation().numpy()
    taps = moving_average_with(correlation)
    assert len(taps) == len(correlation) > 1
    for lag, expected in enumerate(correlation):
        found = sum(taps[i] * taps[i + lag] for i in range(len(taps) - lag))
        assert found == pytest.approx(expected, abs=1e-12)


# property


@pytest.mark.parametrize(("ratio", "high_hz"), [(0.6, None), (1.0, None), (1.5, 25.0)])
def test_band_follows_from_the_vehicle(ratio, high_hz):
    vehicle = AM96.degraded(k_p=ratio**2, k_s=ratio**2, c_p=ratio, c_s=ratio)
    bound = EstimateSettings().bound(vehicle)
    modes, _ = QuarterCar(vehicle).natural_modes()
    assert bound.low_hz == pytest.approx(0.45 * modes[0])
    assert (3.8 * modes[1] > 25) == (high_hz is not None)
    assert bound.high_hz == pytest.approx(high_hz or 3.8 * modes[1])
    assert bound.body_high_hz == pytest.approx(2.4 * modes[1])
    bins = bound.frequencies_hz().numpy()
    np.testing.assert_allclose(bins * 20, np.rint(bins * 20), atol=1e-9)
    assert bound.low_hz <= bins[0] < bound.low_hz + 0.05
    assert bound.high_hz - 0.05 < bins[-1] <= bound.high_hz
    np.testing.assert_allclose(np.diff(bins), 0.05, rtol=1e-9)
    assert bound.speed_half_width == SPEED_HALF_WIDTH
    ends = dict.fromkeys(("low_hz", "high_hz", "body_high_hz", "speed_half_width"))
    assert dataclasses.replace(bound, **ends) == EstimateSettings()


def test_what_is_uncertain_is_drawn_with_every_curve():
    certain = VerticalVehicle(AM96)
    uncertain = VerticalVehicle(AM96, distribution={"body_gyration": 0.3, "other_c_s": 0.5})
    many = RATIOS.expand(300, 5)
    quiet = {"snr_db": 100.0, "minutes": 9e4}
    spread = [
        observer(generator=generator, **quiet).observe(many, seed=2).abs().log().std(dim=0).max()
        for generator in (certain, uncertain)
    ]
    assert spread[0] < 0.01
    assert spread[1] > 0.05
    for generator in (certain, uncertain):
        source = observer(generator=generator, **quiet)
        free = source.noise_free(RATIOS)
        torch.testing.assert_close(free, observer(generator=certain, **quiet).noise_free(RATIOS))


# failure


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_train": 0}, r"`data\.n_train` must be a whole number >= 1, got 0"),
        ({"n_test": -1}, r"`data\.n_test` must be a whole number >= 1, got -1"),
        ({"n_calibrate": 99}, r"`data\.n_calibrate` must be a whole number >= 100 or null, got 99"),
        ({"method": "H3"}, r"`data\.method` must be one of .*'H3'"),
        ({"rates_hz": (5000.0, 2000.0)}, r"`data\.rates_hz` must be three rates > 0"),
        ({"rates_hz": (5000.0, 2000.0, 0.0)}, r"`data\.rates_hz\[2\]` must be .* > 0, got 0.0"),
        ({"track": "moon"}, r"`track` must be one of .*'moon'"),
        (
            {"minutes": 0.8},
            r"`data\.minutes`=0\.8 is too short: \d\.\d averages of 20 s; at least 4",
        ),
    ],
)
def test_settings_out_of_range_are_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        EstimateSettings(**changes)


def test_band_must_be_bound_and_hold_bins():
    with pytest.raises(ValueError, match="call `bound` first"):
        EstimateSettings().frequencies_hz()
    with pytest.raises(ValueError, match="call `bound` first"):
        EstimateSettings(low_hz=1.0).observer(QuarterCar(AM96))
    with pytest.raises(ValueError, match=r"data\.high_hz=1\.3 Hz lie 7 bins; at least 8"):
        EstimateSettings(low_hz=1.0, high_hz=1.3).bound(AM96)
    assert len(EstimateSettings(low_hz=1.0, high_hz=1.35).bound(AM96).frequencies_hz()) == 8
    with pytest.raises(ValueError, match=r"data\.body_high_hz=1\.3 Hz lie 7 bins; at least 8"):
        EstimateSettings(low_hz=1.0, body_high_hz=1.3).bound(AM96)
    bound = EstimateSettings(low_hz=1.0, body_high_hz=1.35).bound(AM96)
    assert int((~bound.observer(QuarterCar(AM96)).beyond[1]).sum()) == 8


@pytest.mark.parametrize("method", METHODS)
def test_strength_of_instruments_is_the_f_statistic_of_their_regression(method):
    n, rng = 12, np.random.default_rng(2)
    signals = rng.standard_normal((3, n, 4)) + 1j * rng.standard_normal((3, n, 4))
    signals[1] += signals[0]
    spectra = CrossSpectra(
        torch.as_tensor(np.mean(np.abs(signals) ** 2, axis=1))[None],
        torch.as_tensor(np.stack([(signals[a].conj() * signals[b]).mean(0) for a, b in PAIRS]))[
            None
        ],
        float(n),
    )
    found = spectra.instrument_strength(method)[0]
    for i, (x, y, third) in enumerate(((0, 1, 2), (1, 2, 0))):
        z = {"H1": x, "Hv": x, "H2": y, "IV": third}[method]
        for k in range(4):
            instrument, own = signals[z, :, k], signals[x, :, k]
            slope = np.vdot(instrument, own) / np.vdot(instrument, instrument)
            explained = np.sum(np.abs(slope * instrument) ** 2)
            left = np.sum(np.abs(own - slope * instrument) ** 2)
            if z == x:
                assert found[i, k] > 1e12
            else:
                assert float(found[i, k]) == pytest.approx((n - 1) * explained / left, rel=1e-9)


def test_bins_whose_instrument_is_weak_on_a_trip_are_not_used():
    at = observer("IV")
    drawn = at.expected(RATIOS)
    spectra = CrossSpectra(drawn.auto[0], drawn.cross[0].clone(), 50.0)
    used = torch.isfinite(at.measured_misfit(spectra).covariance[0, 0, 0].real)
    k = int(used.nonzero()[20])
    spectra.cross[PAIRS.index((0, 2)), k] *= 0.01
    covariance = at.measured_misfit(spectra).covariance[0]
    assert torch.isinf(covariance[0, 0, k].real)
    assert covariance[0, 1, k] == 0
    others = torch.isfinite(covariance[0, 0].real)
    assert int(used.sum() - others.sum()) == 1


def test_thinned_misfit_has_every_nth_bin_at_the_mean_speed_without_leakage():
    vehicle = VerticalVehicle(AM96, parts=("roll",), sensor_lateral_m=(1.0, 1.0, 1.0))
    at = observer(generator=vehicle).at(Speeds((60.0, 80.0), (0.5, 0.5)))
    drawn = at.expected(RATIOS)
    misfit = at.measured_misfit(CrossSpectra(drawn.auto[0], drawn.cross[0], 20.0))
    thin = misfit.thinned()
    bins = SETTINGS.frequencies_hz()[::4]  # 0.2 Hz apart
    torch.testing.assert_close(thin.observer.frequencies_hz, bins)
    torch.testing.assert_close(thin.observed, misfit.observed[..., ::4], rtol=0, atol=0)
    torch.testing.assert_close(thin.covariance, misfit.covariance[..., ::4], rtol=0, atol=0)
    w, z, y = vehicle.channels(RATIOS, bins)[0].unbind(dim=1)  # each input, at 70 m/s
    expected = [(y.conj() * z).sum(0) / (y.conj() * w).sum(0)]
    expected.append((w.conj() * y).sum(0) / (w.conj() * z).sum(0))
    torch.testing.assert_close(thin.observer.noise_free(RATIOS)[0], torch.stack(expected))
    rows = torch.zeros(1, dtype=torch.int64)
    far = torch.full((1, 5), 1.3, dtype=torch.float64)
    sums = [float(one(far, rows).square().sum()) for one in (misfit, thin)]
    assert sums[1] == pytest.approx(sums[0], rel=0.05)
