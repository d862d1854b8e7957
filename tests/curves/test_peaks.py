"""Peaks of known shape, noise and the reasons why a curve has no peak."""

import math

import numpy as np
import pytest
import reference
import torch
from scipy.signal import peak_widths

from suspnet.curves.peaks import PeakFit, PeakReason, findpeaks, smooth

GRID = 0.1 + 0.02 * torch.arange(996, dtype=torch.float64)
HEIGHT, CENTRE_HZ, HALF_WIDTH_HZ = 3.0, 4.1234, 0.3


def lorentzian(frequencies_hz=GRID, centre_hz=CENTRE_HZ):
    """Return abs(G) with abs(G)^2 a Lorentzian whose half width is HALF_WIDTH_HZ."""
    return HEIGHT / torch.sqrt(1 + ((frequencies_hz - centre_hz) / HALF_WIDTH_HZ) ** 2)


def gaussian(frequencies_hz=GRID):
    """Return a Gaussian abs(G) of standard deviation 1 Hz, above 0 on the whole grid."""
    return HEIGHT * torch.exp(-0.5 * (frequencies_hz - CENTRE_HZ) ** 2)


def one_mode(frequencies_hz, natural_hz, damping_ratio):
    r = frequencies_hz / natural_hz
    return 1 / torch.sqrt((1 - r**2) ** 2 + (2 * damping_ratio * r) ** 2)


def with_noise(curve, n_curves, fraction, seed=0):
    """Return `n_curves` copies with noise of rms `fraction` of the curve's rms."""
    source = torch.Generator().manual_seed(seed)
    noise = torch.randn(n_curves, len(curve), generator=source, dtype=torch.float64)
    return curve + fraction * curve.square().mean().sqrt() * noise


def measures(peaks):
    return torch.stack([peaks.position_hz, peaks.height, peaks.width_hz])


# reference


def test_lorentzian_is_recovered_exactly():
    peak = findpeaks(lorentzian()[None], GRID)
    assert peak.reason.tolist() == [PeakReason.FOUND]
    expected = torch.tensor([[CENTRE_HZ], [HEIGHT], [2 * HALF_WIDTH_HZ]]).double()
    torch.testing.assert_close(measures(peak), expected.double(), rtol=1e-6, atol=0)
    assert peak.position_hz.item() == pytest.approx(CENTRE_HZ, rel=1e-10)


def test_half_prominence_is_that_of_scipy():
    rng = np.random.default_rng(0)
    curves = np.stack([rng.normal(size=len(GRID)).cumsum() for _ in range(20)])
    curves = np.concatenate([curves - curves.min() + 0.1, lorentzian()[None].numpy()])
    for low_hz in (0.0, 8.0):  # with higher points beyond the band, which end a base
        found = findpeaks(curves, GRID, low_hz=low_hz, fit=PeakFit("half_prominence"))
        smoothed = smooth(torch.tensor(curves), GRID, PeakFit().smoothing_hz).numpy()
        n_compared = 0
        for row, curve in enumerate(smoothed):
            if found.reason[row]:
                continue
            index = int(np.abs(GRID.numpy() - found.position_hz[row].item()).argmin())
            inside = GRID.numpy() >= low_hz
            assert curve[index] == found.height[row].item() == curve[inside].max()
            (width,), *_ = peak_widths(curve, [index], rel_height=0.5)
            assert found.width_hz[row].item() == pytest.approx(0.02 * width, rel=1e-9)
            n_compared += 1
        assert n_compared > 10


def test_gaussian_is_recovered_exactly():
    peak = findpeaks(gaussian()[None], GRID, fit=PeakFit("gaussian"))
    assert peak.reason.tolist() == [PeakReason.FOUND]
    # half power at exp(-d^2) = 1/2
    full_width = 2 * math.sqrt(math.log(2))
    found = [peak.position_hz.item(), peak.height.item(), peak.width_hz.item()]
    assert found == pytest.approx([CENTRE_HZ, HEIGHT, full_width], rel=1e-10)


@pytest.mark.parametrize("shape", ["lorentzian", "gaussian"])
def test_fit_equals_weighted_polyfit(shape):
    # a mode is neither shape, so weights and window decide where the fit ends up
    curve = one_mode(GRID, 3.0, 0.08)
    curve = curve * (1 + 0.01 * torch.sin(40 * GRID))
    fit = PeakFit(shape, smoothing_hz=0.3, window_below=0.2, window_above=0.35, n_fits=1)
    peak = findpeaks(curve[None], GRID, fit=fit)
    expected = reference.peak_by_polyfit(curve.numpy(), GRID.numpy(), shape, 15, 0.2, 0.35)
    found = [peak.position_hz.item(), peak.height.item(), peak.width_hz.item()]
    assert found == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("length", [3, 5, 9, 15, 17, 31, 63, 101])
def test_smooth_equals_naive_moving_average_with_shortened_ends(length):
    values = np.random.default_rng(0).uniform(0.5, 1.5, (3, 101))
    grid = 0.02 * torch.arange(1, 102, dtype=torch.float64)
    found = smooth(torch.as_tensor(values), grid, 0.02 * length).numpy()
    expected = np.stack([reference.moving_average(row, length) for row in values])
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert np.abs(expected - values).max() > 0.1


@pytest.mark.parametrize("damping_ratio", [0.01, 0.02, 0.04])
def test_frequency_and_damping_of_one_lightly_damped_mode_come_back(damping_ratio):
    natural_hz = 4.03
    grid = 0.005 * torch.arange(1, 4001, dtype=torch.float64)
    fit = PeakFit(smoothing_hz=0.02, window_below=0.05, window_above=0.05)
    peak = findpeaks(one_mode(grid, natural_hz, damping_ratio)[None], grid, fit=fit)
    # 1/abs(G)^2 is a parabola up to terms of the order of the damping ratio
    assert peak.position_hz.item() == pytest.approx(natural_hz, rel=2.5 * damping_ratio**2)
    assert peak.width_hz.item() / (2 * natural_hz) == pytest.approx(damping_ratio, rel=0.005)
    assert peak.height.item() == pytest.approx(1 / (2 * damping_ratio), rel=0.005)


# property


@pytest.mark.parametrize("shape", ["lorentzian", "gaussian"])
def test_amplitude_scales_the_height_only(shape):
    curve = one_mode(GRID, 2.0, 0.1)[None]
    fit = PeakFit(shape)
    once, tenfold = findpeaks(curve, GRID, fit=fit), findpeaks(10 * curve, GRID, fit=fit)
    assert once.valid.all()
    expected = measures(once) * torch.tensor([[1.0], [10.0], [1.0]])
    torch.testing.assert_close(measures(tenfold), expected, rtol=1e-9, atol=0)


def test_batch_equals_one_by_one():
    curves = torch.stack([one_mode(GRID, f, z) for f in (1.0, 2.5, 6.0) for z in (0.02, 0.1, 0.3)])
    curves[4, 100] = math.nan
    curves[5] = 1 / GRID
    together = findpeaks(curves, GRID)
    alone = [findpeaks(curve[None], GRID) for curve in curves]
    assert together.reason.tolist() == [peak.reason.item() for peak in alone]
    # the sums begin at another bin: the first that any curve of the batch needs
    torch.testing.assert_close(
        measures(together),
        torch.cat([measures(peak) for peak in alone], dim=1),
        rtol=1e-12,
        atol=0,
        equal_nan=True,
    )
    assert together.valid.sum() == 7


def test_band_chooses_between_two_peaks():
    curve = lorentzian(centre_hz=2.0) + 0.5 * lorentzian(centre_hz=8.0)
    low, high = torch.tensor([0.0, 5.0]), torch.tensor([5.0, 20.0])
    peaks = findpeaks(curve.expand(2, -1), GRID, low_hz=low, high_hz=high)
    # the flank of the other peak shifts each of them a little
    assert peaks.position_hz.tolist() == pytest.approx([2.0, 8.0], abs=0.15)
    assert findpeaks(curve[None], GRID).position_hz.item() == peaks.position_hz[0].item()


def test_tilt_keeps_a_flattened_peak_in_sight():
    # beside the flank of a low peak the second one is only a shoulder
    curve = 20 * one_mode(GRID, 0.4, 0.3) + 0.6 * one_mode(GRID, 5.0, 0.2)
    plain = findpeaks(curve[None], GRID, low_hz=1.5, fit=PeakFit())
    tilted = findpeaks(curve[None], GRID, low_hz=1.5, fit=PeakFit(tilt=1.5))
    assert plain.reason.tolist() == [PeakReason.NO_MAXIMUM]
    assert tilted.valid.all()
    # the fit is to the untilted curve, whose flank pulls it down from 5 Hz
    assert 3.0 < tilted.position_hz.item() < 5.0


def test_estimates_under_noise_scatter_about_the_truth():
    peaks = findpeaks(with_noise(lorentzian(), 400, 0.02), GRID)
    assert peaks.valid.all()
    found = measures(peaks)
    truth = torch.tensor([CENTRE_HZ, HEIGHT, 2 * HALF_WIDTH_HZ], dtype=torch.float64)
    deviation, spread = found.mean(dim=1) - truth, found.std(dim=1)
    # four standard errors, and the bias of 1/noise^2, below a tenth of the spread
    assert (deviation.abs() < (4 / math.sqrt(400) + 0.1) * spread).all()
    assert (spread / truth < 0.01).all()
    assert (spread > 0).all()


# failure


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_curve_that_is_not_finite_has_no_peak_and_spoils_no_other(value):
    curves = lorentzian().repeat(3, 1)
    curves[1, 500] = value
    peaks = findpeaks(curves, GRID)
    assert peaks.reason.tolist() == [0, PeakReason.NOT_FINITE, 0]
    assert measures(peaks).isnan().all(dim=0).tolist() == [False, True, False]
    assert peaks.position_hz[[0, 2]].tolist() == pytest.approx([CENTRE_HZ] * 2, rel=1e-9)


@pytest.mark.parametrize(
    "curve",
    [
        pytest.param(1 / GRID, id="falling"),
        pytest.param(GRID.clone(), id="rising"),
        pytest.param(torch.ones_like(GRID), id="flat"),
        pytest.param(torch.zeros_like(GRID), id="zero"),
        pytest.param(1 + 0.5 * (GRID - 5) ** 2, id="valley"),
    ],
)
@pytest.mark.parametrize(
    ("band", "shape"), [((0.0, math.inf), "lorentzian"), ((3.0, 3.01), "gaussian")]
)
def test_curve_without_a_maximum_gives_a_reason_and_no_number(curve, band, shape):
    low, high = band
    peak = findpeaks(curve[None], GRID, low_hz=low, high_hz=high, fit=PeakFit(shape))
    assert peak.reason.tolist() == [PeakReason.NO_MAXIMUM]
    assert measures(peak).isnan().all()


@pytest.mark.parametrize("shape", ["lorentzian", "gaussian"])
@pytest.mark.parametrize("n_fits", [1, 2, 3])
def test_bump_in_a_valley_has_the_wrong_curvature(shape, n_fits):
    curve = 1 + 0.5 * (GRID - 5) ** 2 + 0.02 * torch.exp(-(((GRID - 5) / 0.03) ** 2))
    fit = PeakFit(shape, 0.06, window_below=0.05, window_above=0.05, n_fits=n_fits)
    peak = findpeaks(curve[None], GRID, low_hz=4.9, high_hz=5.1, fit=fit)
    assert peak.reason.tolist() == [PeakReason.WRONG_CURVATURE]
    assert measures(peak).isnan().all()


def test_fit_that_ends_far_from_its_maximum_is_outside_the_window():
    curve = GRID + 0.5 * torch.exp(-(((GRID - 3) / 0.1) ** 2))  # a bump on a slope
    fit = PeakFit("gaussian", smoothing_hz=0.1)
    peak = findpeaks(curve[None], GRID, low_hz=2.8, high_hz=3.1, fit=fit)
    assert peak.reason.tolist() == [PeakReason.OUTSIDE_WINDOW]
    assert measures(peak).isnan().all()


@pytest.mark.parametrize(
    "grid",
    [
        pytest.param(GRID**1.01, id="uneven"),
        pytest.param(GRID.flip(0), id="descending"),
        pytest.param(GRID - 0.1, id="from zero"),
        pytest.param(torch.full_like(GRID, 1.0), id="constant"),
    ],
)
def test_grid_must_be_positive_ascending_and_even(grid):
    with pytest.raises(ValueError, match="positive, ascending and evenly spaced"):
        findpeaks(lorentzian()[None], grid)


@pytest.mark.parametrize("curve", [lorentzian(), lorentzian()[None, :-1], lorentzian()[None, None]])
def test_curves_of_the_wrong_shape_are_rejected(curve):
    with pytest.raises(ValueError, match=r"`magnitude` must have shape \(n_curves, 996\)"):
        findpeaks(curve, GRID)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"shape": "triangle"}, "`shape` must be"),
        ({"smoothing_hz": 0.0}, "`smoothing_hz` must be a finite number > 0"),
        ({"window_below": -1.0}, "`window_below` must be a finite number > 0"),
        ({"window_above": math.nan}, "`window_above` must be a finite number > 0"),
        ({"n_fits": 0}, "`n_fits` must be a whole number >= 1"),
    ],
)
def test_fit_settings_out_of_range_are_rejected(setting, message):
    with pytest.raises(ValueError, match=message):
        PeakFit(**setting)
