"""Curves to features, beside a scipy loop over single curves.

pytest benchmarks --benchmark-only
"""

import numpy as np
import pytest
import torch
from protocols import shipped_protocol
from scipy.optimize import curve_fit
from scipy.signal import find_peaks, savgol_filter
from vehicles import AM96

from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import BLOCK, TRAIN, Problem
from suspnet.vehicle import QuarterCar

PEAKS = ["secondary", "primary_lower", "primary_upper"]
WHOLE_GRID = 364_816


def source(n_curves):
    task = shipped_protocol("multi_location").task("primary")
    settings = CurveSettings(n_train=n_curves)
    return Problem(QuarterCar(AM96), task, settings, threads=torch.get_num_threads())


def lorentzian(f, height, position, width):
    return height / np.sqrt(1 + ((f - position) / (width / 2)) ** 2)


def fit_one_by_one(frequencies_hz, curves):
    """What a user would write with scipy: smooth, find peaks, fit a Lorentzian to each top."""
    features = []
    for curve in curves.reshape(-1, curves.shape[-1]):
        smoothed = savgol_filter(curve, 15, 2)
        peaks, _ = find_peaks(smoothed, prominence=0.05)
        for peak in peaks:
            rows = slice(max(peak - 20, 0), peak + 20)
            start = (curve[peak], frequencies_hz[peak], 0.5)
            fitted, _ = curve_fit(lorentzian, frequencies_hz[rows], curve[rows], start, maxfev=2000)
            features.append(fitted)
    return features


def report(benchmark, capsys, n_curves):
    """Print curves per second, and what the whole grid of a group would take."""
    seconds = benchmark.stats.stats.median / n_curves
    benchmark.extra_info["threads"] = torch.get_num_threads()
    benchmark.extra_info["curves_per_second"] = round(1 / seconds)
    benchmark.extra_info["seconds_for_364_816_curves"] = round(WHOLE_GRID * seconds, 1)
    with capsys.disabled():
        print(f"\n{benchmark.name}: {benchmark.extra_info}")


@pytest.mark.benchmark(group="curves to features, 12,800 curves (scipy: 128)")
def test_suspnet(benchmark, capsys):
    curves = source(100 * BLOCK)
    data = benchmark.pedantic(curves.features, args=(TRAIN,), rounds=3, warmup_rounds=1)
    assert data.valid.mean() > 0.99
    report(benchmark, capsys, 100 * BLOCK)


@pytest.mark.benchmark(group="curves to features, 12,800 curves (scipy: 128)")
def test_scipy_loop(benchmark, capsys):
    maker = source(BLOCK)
    frequencies_hz = maker.settings.frequencies_hz().numpy()

    def run():
        curves = maker.curves(maker.ratios(TRAIN), TRAIN, 0).numpy()
        return fit_one_by_one(frequencies_hz, curves)

    assert len(benchmark.pedantic(run, rounds=3, warmup_rounds=1)) >= 2 * BLOCK
    report(benchmark, capsys, BLOCK)
