"""Information in recordings: naive matrices, the likelihood's curvature, and the IV estimate."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import reference
import torch
from trips_reference import pitching_numbers, pitching_transfer
from vehicles import AM96

from suspnet.bounds.information import cramer_rao, fisher_information
from suspnet.bounds.sensor_information import recording_information
from suspnet.curves.estimates import EstimateSettings
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle

DEGRADED = np.array([0.8, 1.4, 1.2, 0.9, 1.1])
SPEED = 70.0
SETTINGS = EstimateSettings(snr_db=30.0, minutes=10.0).bound(AM96)
QUARTER_CAR, PITCHING = QuarterCar(AM96), VerticalVehicle(AM96, speed_m_per_s=SPEED)
THREE = [1, 1, 1]
ON_BODY = (2,)
"""Places of sensors on the body, which are used up to `body_high_hz`."""


def observer(generator, **changes):
    """Return a source of estimates on eleven bins about the bogie's resonance."""
    options = {"snr_db": 30.0, "minutes": 10.0, "low_hz": 1.5, "high_hz": 2.0}
    return EstimateSettings(**(options | changes)).observer(generator)


def responses(generator, ratios, frequency_hz):
    """Return the response from the axle box to each place, written once more."""
    if isinstance(generator, QuarterCar):
        primary, secondary = reference.transfer(AM96, ratios, frequency_hz)
        return np.array([np.ones_like(primary), primary, primary * secondary])
    numbers = pitching_numbers(AM96, ratios, SPEED)
    own = pitching_transfer(numbers, frequency_hz)
    return np.array([1, own[0], own[0] * own[1]])


@cache
def healthy_gains(generator, rate_hz):
    grid = np.geomspace(0.1, rate_hz / 2, 4000)
    return grid, np.abs([responses(generator, np.ones(5), f) for f in grid]) ** 2


def noise_densities(source, rates_hz):
    """Return each place's noise: its healthy signal's power, spread over the sensor's band."""
    densities = {}
    for rate_hz in set(rates_hz):
        grid, gain = healthy_gains(source.generator, rate_hz)
        power = np.trapezoid(gain * source.mean.track_density(grid)[:, None], grid, axis=0)
        densities[rate_hz] = 10 ** (-source.settings.snr_db / 10) * power / (rate_hz / 2)
    return np.array([densities[rate_hz][place] for place, rate_hz in enumerate(rates_hz)])


def spectral_matrix(source, ratios, frequency_hz, level, noise, used):
    """Return S = S_w h h^H + diag(N) of the places used, at one frequency."""
    h = responses(source.generator, ratios, frequency_hz)[used]
    return level * np.outer(h, h.conj()) + np.diag(noise[used])


def places_used(source, used, frequency_hz):
    """Return the places whose sensors are used at a frequency."""
    end = source.settings.body_high_hz
    beyond = end is not None and frequency_hz > end + 1e-9
    return [place for place in used if not (beyond and place in ON_BODY)]


def naive_joint_information(source, rows, noise, used):
    """Return n / r sum of traces less the track's Schur complement, several inputs.

    Parameters
    ----------
    rows : array of shape (n_unknown, 2, n_columns)
        Vehicles half a step of 1e-5 of each unknown above and below the point.
    noise : array of shape (3,)
    """
    h = source.generator.channels(rows.reshape(-1, rows.shape[-1]), source.frequencies_hz).numpy()
    h = h.reshape(*rows.shape[:2], *h.shape[1:])
    levels = source.mean.track_density(source.frequencies_hz.numpy())
    total = np.zeros((len(rows),) * 2)
    for k, level in enumerate(levels):
        here = places_used(source, used, float(source.frequencies_hz[k]))
        seen = h[:, :, :, here, k]
        s = level * np.einsum("uwix,uwiy->uwxy", seen, seen.conj())
        track = s.mean(axis=(0, 1))
        inverse = np.linalg.inv(track + np.diag(noise[here]))
        slopes = [*(s[:, 0] - s[:, 1]) / 1e-5, track]
        all_of = np.array(
            [[np.trace(inverse @ a @ inverse @ b).real for b in slopes] for a in slopes]
        )
        total += all_of[:-1, :-1] - np.outer(all_of[:-1, -1], all_of[-1, :-1]) / all_of[-1, -1]
    # Hann: neighbours correlate by 4/9, next ones by 1/36
    return source.settings.n_averages / (1 + 2 * (4 / 9 + 1 / 36)) * total


def by_matrices(source, ratios, parameters, noise, count, step=1e-5):
    """Return n / r sum of traces less the track's Schur complement, one bin after the other."""
    noise = noise / np.maximum(count, 1)
    total = np.zeros((len(parameters),) * 2)
    for f in source.frequencies_hz.tolist():
        level = source.mean.track_density(np.array([f]))[0]
        used = places_used(source, np.flatnonzero(count), f)
        if not used:
            continue
        s = spectral_matrix(source, ratios, f, level, noise, used)
        slopes = []
        for name in parameters:
            up, down = ratios.copy(), ratios.copy()
            up[PARAMETERS.index(name)] += step
            down[PARAMETERS.index(name)] -= step
            pair = [spectral_matrix(source, x, f, level, noise, used) for x in (up, down)]
            slopes.append((pair[0] - pair[1]) / (2 * step))
        slopes.append(s - np.diag(noise[used]))  # with respect to the logarithm of the level
        inverse = np.linalg.inv(s)
        all_of = np.array(
            [[np.trace(inverse @ a @ inverse @ b).real for b in slopes] for a in slopes]
        )
        total += all_of[:-1, :-1] - np.outer(all_of[:-1, -1], all_of[-1, :-1]) / all_of[-1, -1]
    # Hann: neighbours correlate by 4/9, next ones by 1/36
    return source.settings.n_averages / (1 + 2 * (4 / 9 + 1 / 36)) * total


def assert_alike(found, expected, tolerance):
    """Compare two information matrices, each element relative to its diagonal."""
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert size.min() > 0.1
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=tolerance)


# reference


@pytest.mark.parametrize("parameters", [PARAMETERS, ("M_s", "c_p")], ids="-".join)
@pytest.mark.parametrize("count", [[1, 1, 1], [1, 1, 0], [0, 1, 1], [2, 1, 3]], ids=str)
def test_information_of_three_sensors_equals_naive_matrices(parameters, count):
    source = observer(QUARTER_CAR)
    noise = noise_densities(source, (5000, 2000, 2000))
    if count[0] == 0:
        parameters = tuple(name for name in parameters if name in ("k_s", "c_s", "M_s"))
    found = recording_information(source, DEGRADED[None], parameters, [count])[0, 0]
    # central differences with a step of 1e-5 are exact to about 1e-8
    assert_alike(found, by_matrices(source, DEGRADED, parameters, noise, np.array(count)), 1e-6)


@pytest.mark.parametrize(
    "body_high_hz", [1.7, *(pytest.param(f, marks=pytest.mark.slow) for f in (1.4, 2.0))]
)
def test_sensors_on_the_body_tell_nothing_beyond_its_band(body_high_hz):
    source = observer(PITCHING, body_high_hz=body_high_hz)
    noise = noise_densities(source, (5000, 2000, 2000))
    counts = [[1, 1, 1], [1, 0, 3]]
    found = recording_information(source, DEGRADED[None], PARAMETERS, counts)[:, 0]
    every = recording_information(observer(PITCHING), DEGRADED[None], PARAMETERS, counts)[:, 0]
    for matrix, whole, count in zip(found, every, counts, strict=True):
        expected = by_matrices(source, DEGRADED, PARAMETERS, noise, np.array(count))
        size = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
        assert size.min() > 0.1
        np.testing.assert_allclose(matrix / size, expected / size, rtol=0, atol=1e-6)
        less = np.linalg.eigvalsh((whole - matrix) / size).max() > 0.05
        assert less == (body_high_hz < 2.0)


def test_information_is_the_curvature_of_the_gaussian_log_likelihood():
    """E log L = -n sum of log det S + tr(S^-1 S_0); level and parameters are estimated together."""
    source = observer(QUARTER_CAR)
    bins = source.frequencies_hz.numpy()
    levels = source.mean.track_density(bins)
    noise = noise_densities(source, (5000, 2000, 2000))
    names = ("k_s", "c_p", "M_s")
    columns = [PARAMETERS.index(name) for name in names]

    def matrices(x):
        ratios = DEGRADED.copy()
        ratios[columns] = x[:3]
        h = responses(QUARTER_CAR, ratios, bins).T  # (n_freq, 3)
        outer = h[:, :, None] * h[:, None].conj()
        return (levels * np.exp(x[3:]))[:, None, None] * outer + np.diag(noise)

    start = np.concatenate([DEGRADED[columns], np.zeros(len(bins))])
    truth = matrices(start)

    def log_likelihood(x):
        s = matrices(x)
        fit = np.einsum("fij,fji->f", np.linalg.inv(s), truth).real
        return -float(np.sum(np.linalg.slogdet(s)[1] + fit))

    step, size = 1e-3, len(start)
    moves = step * np.eye(size)
    curvature = np.array(
        [
            [
                sum(
                    a * b * log_likelihood(start + a * moves[i] + b * moves[j])
                    for a in (1, -1)
                    for b in (1, -1)
                )
                for j in range(size)
            ]
            for i in range(size)
        ]
    ) / (-4 * step**2)
    covariance = np.linalg.inv(curvature)[:3, :3]
    per_bin = source.settings.n_averages / (1 + 2 * (4 / 9 + 1 / 36))
    found = recording_information(source, DEGRADED[None], names, [THREE])[0, 0]
    # differences with a step of 1e-3 of a function that bends on a scale of 0.1
    assert_alike(found, per_bin * np.linalg.inv(covariance), 2e-3)


@pytest.mark.parametrize(
    ("used", "body_high_hz"),
    [
        *(pytest.param(used, None, marks=pytest.mark.slow) for used in ([0, 1, 2], [0, 2], [1, 2])),
        ([0, 2], 1.7),
        pytest.param([0, 1, 2], 1.7, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_information_with_cross_level_and_uncertain_numbers_equals_naive_matrices(
    used, body_high_hz
):
    deviations = {"cross_level": 0.7, "body_lateral": 0.1, "half_wheelbase": 0.05}
    places_m = (1.0, 0.9, 1.1)
    rolling = VerticalVehicle(
        AM96, parts=("roll",), sensor_lateral_m=places_m, distribution=deviations
    )
    source = observer(rolling, body_high_hz=body_high_hz)
    noise = [
        10**-3 * np.trapezoid(power * source.mean.track_density(grid), grid) / grid[-1]
        for sensor, rate_hz in enumerate((5000, 2000, 2000))
        for grid in [np.geomspace(0.1, rate_hz / 2, 4000)]
        for power in [
            (rolling.channels(torch.ones(1, 5), grid).abs() ** 2).sum(dim=1)[0, sensor].numpy()
        ]
    ]
    point = rolling.complete(torch.as_tensor(DEGRADED[None])).numpy()
    steps = np.zeros((8, point.shape[1]))
    steps[:5, :5] = np.diag(1 / DEGRADED)  # of the logarithms
    columns = rolling.uncertain_columns
    steps[[5, 6, 7], columns] = list(deviations.values())
    rows = point * np.exp(np.stack([steps, -steps], axis=1) * 0.5e-5)
    joint = naive_joint_information(source, rows, np.array(noise), used)
    joint[5:, 5:] += np.eye(3)
    expected = np.linalg.inv(np.linalg.inv(joint)[:5, :5])
    counts = [[int(place in used) for place in range(3)]]
    found = recording_information(source, DEGRADED[None], PARAMETERS, counts)[0, 0]
    assert_alike(found, expected, 1e-6)
    certain = observer(replace(rolling, distribution=None), body_high_hz=body_high_hz)
    more = recording_information(certain, DEGRADED[None], PARAMETERS, counts)[0, 0]
    assert (np.diag(more) > 1.001 * np.diag(found)).any()


# limit


@pytest.mark.parametrize(
    "snr_db", [0.0, 34.0, *(pytest.param(snr, marks=pytest.mark.slow) for snr in (15.0, 60.0))]
)
@pytest.mark.parametrize("generator", [QUARTER_CAR, PITCHING], ids=["quarter_car", "pitching"])
def test_recordings_hold_at_least_what_their_iv_estimate_tells(generator, snr_db):
    source = EstimateSettings(snr_db=snr_db).bound(AM96).observer(generator)
    ratios = np.random.default_rng(1).uniform(0.6, 1.6, (6, 5))
    recordings = recording_information(source, ratios, PARAMETERS, [THREE])[0]
    estimates = fisher_information(source, ratios, PARAMETERS)
    for whole, part in zip(recordings, estimates, strict=True):
        size = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
        assert np.linalg.eigvalsh(whole / size).min() > 0
        # equal within rounding at least
        assert np.linalg.eigvalsh((whole - part) / size).min() > -1e-9


@pytest.mark.parametrize(("snr_db", "high_hz"), [(34.0, 9.9), (50.0, None)])
@pytest.mark.parametrize("generator", [QUARTER_CAR, PITCHING], ids=["quarter_car", "pitching"])
def test_without_leakage_the_iv_estimate_loses_nothing(generator, snr_db, high_hz):
    """A boxcar window leaks nothing into other bins of the model, and they do not correlate.

    Where the body hardly moves, at 20 Hz, it is an instrument of nothing in noise of 34 dB.
    """
    welch = {"window": "boxcar", "overlap": 0.0}
    source = EstimateSettings(minutes=60.0, snr_db=snr_db, high_hz=high_hz, **welch)
    source = source.bound(AM96).observer(generator)
    assert bool(source.beyond.any()) == (high_hz is None)
    recordings = cramer_rao(recording_information(source, DEGRADED[None], PARAMETERS, [THREE])[0])
    estimates = cramer_rao(fisher_information(source, DEGRADED[None], PARAMETERS))
    assert (recordings > 1e-6).all()
    # what is left is of the order of the noise relative to the signal in a bin
    np.testing.assert_allclose(estimates / recordings, 1.0, atol=0.02)
    assert (estimates >= recordings).all()


def test_without_the_axle_box_a_quarter_car_shows_ratios_only():
    source = SETTINGS.observer(QUARTER_CAR)
    information = recording_information(source, DEGRADED[None], PARAMETERS, [[0, 1, 1]])[0]
    assert (information[0, :2] == 0).all()
    assert np.isinf(cramer_rao(information)).all()
    pair = recording_information(source, DEGRADED[None], ("k_s", "c_s"), [[0, 1, 1]])[0]
    assert np.isfinite(cramer_rao(pair)).all()
    # the vector of values: all scaled alike
    scaled = information[0, 2:, 2:] * np.outer(DEGRADED[2:], DEGRADED[2:])
    np.testing.assert_allclose(scaled.sum(axis=1), 0, atol=1e-9 * np.abs(scaled).max())


# property


def test_two_sensors_at_each_place_halve_the_noise():
    quiet = EstimateSettings(snr_db=30.0 + 10 * math.log10(2), minutes=10.0).bound(AM96)
    twice = recording_information(
        SETTINGS.observer(QUARTER_CAR), DEGRADED[None], PARAMETERS, [[2, 2, 2]]
    )
    once = recording_information(quiet.observer(QUARTER_CAR), DEGRADED[None], PARAMETERS, [THREE])
    assert_alike(twice[0, 0], once[0, 0], 1e-9)


# failure


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ([[1, 1]], r"`counts` must have shape \(n_choices, 3\), got \(1, 2\)"),
        ([1, 1, 1], r"`counts` must have shape \(n_choices, 3\), got \(3,\)"),
        ([[0, 0, 0]], "each choice must have a sensor"),
        ([[1, 1, -1]], "`counts` must be >= 0"),
    ],
)
def test_counts_that_make_no_sense_are_rejected(counts, message):
    with pytest.raises(ValueError, match=message):
        recording_information(SETTINGS.observer(QUARTER_CAR), DEGRADED[None], PARAMETERS, counts)
