"""Signals of a rig by frequency, in which its equations hold without leakage."""

from dataclasses import replace

import numpy as np
import pytest
from rig_records import OVERSAMPLING, numbers, record

from suspnet import NoEstimateError, Rig
from suspnet.trains.fits.rig_fit import RigMisfit
from suspnet.trains.spectra.rig_spectra import TAPS, RigSpectra

SHARP = numbers(20.0, 25.0, 0.8, 0.002, 0.002)
"""A resonance of 0.08 Hz, a third of a bin."""
RATE_HZ, SEGMENT_S, BAND_HZ = 200.0, 4.0, (4.0, 45.0)


def spectra(signals, **others):
    return RigSpectra.of(signals, RATE_HZ, SEGMENT_S, BAND_HZ, **others)


def rest(of):
    """Return what the true equations leave of the signals, relative to their terms, (n_freq,)."""
    fit = RigMisfit(of, np.zeros((len(of.frequencies_hz), 3)))
    weights = np.array([1.0, *SHARP])
    terms = weights[:, None, None] * fit._moved
    return np.abs(terms.sum(axis=0)).max(axis=1) / np.abs(terms).max(axis=(0, 2))


def test_equations_hold_at_a_resonance_within_a_bin_and_from_the_middle_of_a_vibration():
    of = spectra(record(SHARP, RATE_HZ, 60.0, 0, noise=1e-7))
    # the integration and the samples of a sharp resonance leave so much
    assert np.median(rest(of)) < 1e-3
    assert rest(of).max() < 0.02
    # the same signals leave more of the equations at the middle of each bin
    middle = replace(of, segment_s=1e9)
    assert rest(middle).max() > 3 * rest(of).max()


def test_taps_are_those_of_a_hann_window():
    signals = record(SHARP, RATE_HZ, 60.0, 0)
    of = spectra(signals)
    # all segments are of one direction: their power is that of the averaged spectra
    power = of.powers / 10
    length = int(SEGMENT_S * RATE_HZ)
    window = np.hanning(length + 1)[:-1]
    starts = range(0, signals.shape[1] - length + 1, length // 2)
    bins = np.round(of.frequencies_hz * SEGMENT_S).astype(int)
    segments = np.stack([np.fft.rfft(window * signals[:, i : i + length])[:, bins] for i in starts])
    density = 2 * np.abs(segments) ** 2 / (RATE_HZ * np.sum(window**2))
    ratio = power / density.mean(axis=0).T
    assert np.median(ratio.std(axis=1)) < 0.01 * ratio.mean()
    assert TAPS @ TAPS == pytest.approx(1.0)


def test_bins_without_power_have_no_weight():
    times = np.arange(60 * int(RATE_HZ) * OVERSAMPLING) / (OVERSAMPLING * RATE_HZ)
    sine = np.sin(2 * np.pi * 10.0 * times)
    of = spectra(record(SHARP, RATE_HZ, 60.0, 0, base=sine, noise=0.01, start=False))
    loud = np.abs(of.frequencies_hz - 10.0) < 0.6
    sizes = (of.powers / of.noise).max(axis=1)
    assert sizes[loud].max() > 1e3 * np.median(sizes[~loud])


def test_faults_are_left_out():
    signals = record(SHARP, RATE_HZ, 60.0, 0)
    usable = np.ones(signals.shape[1], bool)
    usable[4000:4100] = False
    broken = signals.copy()
    broken[1, 4000:4100] = 50.0
    assert np.median(rest(spectra(broken, usable=usable))) < 0.02
    assert np.median(rest(spectra(broken))) > 0.02


@pytest.mark.parametrize("seconds", [2.0, 9.0])
def test_short_records_have_no_estimate(seconds):
    with pytest.raises(NoEstimateError, match=r"too little of the record is free of faults: at"):
        spectra(record(SHARP, RATE_HZ, seconds, 0))


def test_band_of_a_rig_holds_its_modes_at_half_and_twice_its_stiffness():
    rig = Rig("bench", 20.0, 25.0, 0.8)
    (low, high), (first, second) = rig.band_hz, rig.modes_hz
    assert low < first / 2**0.5
    assert high > second * 2**0.5
