"""Noisy training curves: noise of the stated size, reproducible blocks, a cache to lose."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from suspnet.curves.components import FLOOR
from suspnet.curves.curves import CurveSettings, add_noise, noise_rms
from suspnet.curves.extraction import PeakFeatures
from suspnet.curves.problem import BLOCK, CALIBRATE, TEST, TRAIN, FeatureData, Problem

SMALL = CurveSettings(n_train=300, n_test=40, n_calibrate=150)


@pytest.fixture
def source(quarter_car, task):
    """Build a source without cache, with changes."""

    def build(settings=SMALL, problem=None, **changes):
        return Problem(quarter_car, problem or task(), settings, **changes)

    return build


# reference


@pytest.mark.parametrize(("snr_db", "fraction"), [(26.0, 0.0501), (34.0, 0.02), (54.0, 0.002)])
def test_noise_rms_is_the_stated_fraction_of_the_curve(quarter_car, snr_db, fraction):
    frequencies = SMALL.frequencies_hz()
    curves = quarter_car.magnitudes(torch.ones(BLOCK, 5), frequencies)
    noise = add_noise(curves, snr_db, seed=3) - curves
    curve_rms = curves.square().mean(dim=(0, 2)).sqrt()
    found = noise.square().mean(dim=(0, 2)).sqrt() / curve_rms
    # 128 x 996 values: the rms is known to 1 / sqrt(2 n) = 0.2 %; four of those
    assert found.tolist() == pytest.approx([10 ** (-snr_db / 20)] * 2, rel=0.008)
    # 34 dB is the 2 % sensor precision of section III-E, 26 dB 5 %, 54 dB 0.2 %
    assert found.tolist() == pytest.approx([fraction] * 2, rel=0.012)


def test_noise_on_decibels_is_a_share_of_their_rms(quarter_car):
    settings = CurveSettings(snr_db=34.0, noise_on="decibel")
    observer, ratios = settings.observer(quarter_car), torch.ones(400, 5).double()
    levels = 20 * torch.log10(observer.noise_free(ratios))
    noise = 20 * torch.log10(observer.observe(ratios, 0)) - levels
    assert float(noise.mean()) == pytest.approx(0, abs=0.01)
    expected = 10 ** (-34 / 20) * levels.square().mean(dim=2).sqrt()[0]
    torch.testing.assert_close(noise.square().mean(dim=(0, 2)).sqrt(), expected, rtol=0.01, atol=0)
    misfit = observer.misfit(observer.observe(ratios, 1), ratios)(ratios, torch.arange(400))
    assert float(misfit.square().mean()) == pytest.approx(1, rel=0.02)


def test_noise_is_white_gaussian_and_independent_between_curves(quarter_car):
    curves = quarter_car.magnitudes(torch.ones(BLOCK, 5), SMALL.frequencies_hz())
    unit = (add_noise(curves, 34.0, seed=0) - curves) / noise_rms(curves, 34.0)
    n = unit.numel()
    assert abs(unit.mean().item()) < 4 / math.sqrt(n)
    assert (unit**4).mean().item() == pytest.approx(3.0, abs=4 * math.sqrt(96 / n))
    between_bins = (unit[..., 1:] * unit[..., :-1]).mean().item()
    between_curves = (unit[:, 0] * unit[:, 1]).mean().item()
    assert abs(between_bins) < 4 / math.sqrt(n)
    assert abs(between_curves) < 4 / math.sqrt(n / 2)


def test_default_bins_are_those_of_the_paper():
    frequencies = CurveSettings().frequencies_hz()
    assert len(frequencies) == 996
    assert frequencies[[0, 1, -1]].tolist() == pytest.approx([0.1, 0.12, 20.0], rel=1e-12)


def test_features_are_those_of_the_curves_relative_to_healthy(source, task):
    made = source()
    data = made.features(TRAIN)
    frequencies = SMALL.frequencies_hz()
    healthy = made.generator.magnitudes(torch.ones(1, 5), frequencies)
    extractor = task().extractor
    reference = extractor.extract(healthy, frequencies).values[0].numpy()
    np.testing.assert_allclose(made.healthy_features(), reference, rtol=1e-12)
    for block in range(3):
        rows = slice(block * BLOCK, (block + 1) * BLOCK)
        table = extractor.extract(made.curves(data.ratios, TRAIN, block), frequencies)
        np.testing.assert_allclose(data.inputs[rows] * reference, table.values, rtol=1e-12)
        np.testing.assert_array_equal(data.reasons[rows], table.reasons)


def test_whole_curves_become_features_learnt_from_training_magnitudes(source, task):
    problem = task(feature_set="curve", curve={"n_components": 5, "high_hz": 15.0})
    made = source(problem=problem)
    data = made.features(TRAIN)
    assert data.inputs.shape == (300, 5)
    assert data.valid.all()
    basis = made.extractor.basis
    noisy = torch.cat([made.curves(data.ratios, TRAIN, block) for block in range(3)])
    noise = noisy - made.noise_free(data.ratios)
    inside = SMALL.frequencies_hz() <= 15.0 + 1e-9
    rms = noise[..., inside].square().mean(dim=(0, 2)).sqrt()
    torch.testing.assert_close(basis.floor, FLOOR * rms, rtol=1e-9, atol=0)
    assert basis.healthy.shape == (2, int(inside.sum()))
    table = made.extractor.extract(noisy, SMALL.frequencies_hz())
    np.testing.assert_allclose(
        data.inputs, table.values.numpy() - made.healthy_features(), rtol=0, atol=1e-9
    )
    # the components stand out of their noise, which is about 1
    assert (data.inputs.std(axis=0) > 20).all()


# property


def test_noise_of_a_block_depends_on_seed_stream_and_block_only(source):
    made = source()
    ratios = np.ones((300, 5))
    noise = made.curves(ratios, TRAIN, 1) - made.noise_free(ratios[BLOCK : 2 * BLOCK])
    assert noise.std() > 0
    # not on the vehicles of other blocks, nor on how many there are, nor on the task
    longer = np.ones((700, 5))
    longer[:BLOCK] = 1.5
    other = source(dataclasses.replace(SMALL, n_train=700), threads=2)
    torch.testing.assert_close(
        other.curves(longer, TRAIN, 1), made.curves(ratios, TRAIN, 1), rtol=0, atol=0
    )
    for changed in (
        source(seed=1).curves(ratios, TRAIN, 1),
        made.curves(ratios, TEST, 1),
        made.curves(ratios, CALIBRATE, 1),
        made.curves(ratios, TRAIN, 0),
    ):
        changed_noise = changed - made.noise_free(ratios[:BLOCK])
        correlation = (noise * changed_noise).mean() / (noise.std() * changed_noise.std())
        assert abs(correlation) < 4 / math.sqrt(noise.numel())


def test_complete_drops_rows_without_a_feature():
    inputs = np.array([[1.0, 2.0], [np.nan, 2.0], [3.0, 4.0], [5.0, np.inf]])
    column = np.arange(4.0)[:, None]
    data = FeatureData(inputs, column, column.repeat(5, axis=1), np.array([[0], [2], [0], [0]]))
    kept = data.complete()
    assert data.valid.tolist() == [True, False, True, False]
    assert kept.inputs.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert kept.outputs.tolist() == [[0.0], [2.0]]
    assert kept.ratios[:, 0].tolist() == [0.0, 2.0]
    assert kept.reasons.tolist() == [[0], [0]]


# failure


@pytest.mark.parametrize(
    ("setting", "error", "message"),
    [
        ({"snr_db": "abc"}, TypeError, "`data.snr_db` must be a finite number >= -20 and <= 200"),
        ({"snr_db": math.nan}, ValueError, "`data.snr_db` must be a finite number"),
        ({"n_train": 0}, ValueError, "`data.n_train` must be a whole number >= 1, got 0"),
        ({"n_test": True}, TypeError, "`data.n_test` must be a whole number >= 1"),
        ({"n_train": "many"}, TypeError, "`data.n_train` must be a whole number >= 1"),
        ({"n_calibrate": 99}, ValueError, "`data.n_calibrate` must be a whole number >= 100 or"),
        ({"n_calibrate": "all"}, TypeError, "`data.n_calibrate` must be a whole number >= 100"),
        ({"step_hz": 0.2}, ValueError, "need data.step_hz <= data.low_hz .*got 0.2"),
        ({"low_hz": 30.0}, ValueError, "data.low_hz < data.high_hz"),
    ],
)
def test_settings_out_of_range_are_rejected(setting, error, message):
    with pytest.raises(error, match=message):
        CurveSettings(**setting)


def test_healthy_vehicle_without_a_peak_is_rejected(source):
    settings = dataclasses.replace(SMALL, low_hz=2.5)  # above the body's resonance
    made = source(settings)
    with pytest.raises(
        ValueError, match=r"of the healthy vehicle is missing, between 2\.5 .*: secondary \("
    ):
        made.features(TEST)


def test_no_complete_curve_is_named():
    missing = np.full((3, 2), math.nan)
    data = FeatureData(missing, np.ones((3, 1)), np.ones((3, 5)), np.ones((3, 1), dtype=int))
    with pytest.raises(ValueError, match=r"none of the 3 curves has every feature$"):
        data.complete()
    with pytest.raises(ValueError, match=r"has every feature: secondary \(not finite\)$"):
        data.complete(PeakFeatures(["secondary"]))
