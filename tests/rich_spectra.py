"""Spectra of a rich train's sensors, exact, and trips drawn from them without any motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from rich_structure import SENSORS

from suspnet.curves.cross_spectra import PAIRS, CrossSpectra, moving_average_with, sample_spectra
from suspnet.vehicle.track import acceleration_density, track_spectrum

GERMAN_ALIGNMENT = 2.119e-7 / 4.032e-7
"""Alignment over vertical unevenness of the German track of low disturbance, a constant."""
GERMAN_CROSS_LEVEL_RAD_PER_M = 0.4380
"""w_s of the German cross level."""
SIDES = {
    "mean": np.kron(np.eye(3), [0.5, 0.5]),
    "left": np.kron(np.eye(3), [1.0, 0.0]),
    "right": np.kron(np.eye(3), [0.0, 1.0]),
    "difference": np.kron(np.eye(3), [1.0, -1.0]),
    "both": np.eye(len(SENSORS)),
}
"""Combinations of the sensors at axle box, frame and body."""
ALL_NOISE = {"mean": 0.5, "difference": 2.0}
"""Noise power of a combination, relative to that of one sensor."""


def process_spectra(train, track="german_low"):
    """Return a `TrackSpectrum` of each process that drives a train.

    Mean of both rails; cross level as half of their difference; alignment. The German cross level
    is the mean's density times w^2 / (w^2 + w_s^2) with w_s = 0.4380 rad/m, its alignment a
    constant share; of any track both are taken so from its mean, times the train's factors.
    No standard's text was at hand for these two.
    """
    mean = track_spectrum(track)

    def cross_level(n):
        omega_2 = (2 * math.pi * n) ** 2
        share = omega_2 / (omega_2 + GERMAN_CROSS_LEVEL_RAD_PER_M**2)
        return train.cross_level * share * mean.density(n)

    def alignment(n):
        return train.alignment * GERMAN_ALIGNMENT * mean.density(n)

    found = [mean]
    for name, density in (("cross level", cross_level), ("alignment", alignment)):
        found.append(replace(mean, name=f"{mean.name} {name}", density=density))
    return found[: train.n_processes]


def spectra(train, ratios, frequencies_hz, sides="mean", track="german_low"):
    """Return E[X Y*] of the accelerations X, Y of axle box, frame and body: H S H^H.

    Parameters
    ----------
    train : RichTrain
    ratios : array of shape (n_vehicles, 5), [-]
    frequencies_hz : array of shape (n_freq,), [Hz]
        Above 0.
    sides : str
        A key of ``SIDES``; "both" gives six sensors.
    track : str

    Returns
    -------
    complex array of shape (n_vehicles, 3, 3, n_freq), one-sided, [(m/s^2)^2/Hz]

    Raises
    ------
    ValueError
        If the train is not linear.
    """
    if not train.is_linear:
        raise ValueError("a nonlinear train has no exact spectra: simulate trips")
    frequencies_hz = np.asarray(frequencies_hz, dtype=float)
    density = np.stack(
        [
            acceleration_density(one, frequencies_hz, train.speed_m_per_s)
            for one in process_spectra(train, track)
        ]
    )
    found = []
    for row in np.asarray(ratios, dtype=float):
        responses = responses_of(train, row, frequencies_hz, sides)
        found.append(np.einsum("fip,pf,fjp->ijf", responses, density, responses.conj()))
        if train.wheelset_share:
            alone = responses_of(train, row, frequencies_hz, sides, train.alone(frequencies_hz))
            own = train.wheelset_share * density[0]
            found[-1] += np.einsum("fip,f,fjp->ijf", alone, own, alone.conj())
    return np.stack(found)


def responses_of(train, ratios, frequencies_hz, sides="both", inputs=None):
    """Return the responses from the processes at the first wheelset, (n_freq, n, n_processes).

    Parameters
    ----------
    train : RichTrain
    ratios : array of shape (5,), [-]
    frequencies_hz : array of shape (n_freq,), [Hz]
    sides : str
    inputs : complex array of shape (n_freq, 4 n_processes, n), optional
        Under all wheelsets, in place of the processes'.
    """
    matrices = train.matrices(ratios)
    inputs = train.phasors(frequencies_hz) if inputs is None else inputs
    found = matrices.responses(frequencies_hz, inputs, matrices.sensors)
    return np.einsum("ij,fj,fjp->fip", SIDES[sides], train.gains(frequencies_hz), found)


def noise_densities(train, settings, sides="mean"):
    """Return the noise of each channel as `EstimateSettings` has it, (3,) [(m/s^2)^2/Hz].

    Each sensor's lies `snr_db` below its own signal on the healthy train, over its whole band.
    """
    single = "left" if sides in ALL_NOISE else sides
    found = []
    for channel, rate_hz in enumerate(settings.rates_hz):
        grid = np.geomspace(0.1, rate_hz / 2, 1000)
        found_here = spectra(train, np.ones((1, 5)), grid, single, settings.track)
        power = np.trapezoid(found_here[0, channel, channel].real, grid)
        found.append(10 ** (-settings.snr_db / 10) * power / (rate_hz / 2))
    return ALL_NOISE.get(sides, 1.0) * np.array(found)


def expected_estimates(train, ratios, settings, sides="mean"):
    """Return the mean of the spectra estimated from trips, `CrossSpectra` (n_vehicles, 3, n_freq).

    Parameters
    ----------
    train : RichTrain
        At its own speed; the settings' speed is not looked at.
    ratios : array of shape (n_vehicles, 5), [-]
    settings : EstimateSettings
        Bound to a vehicle: bins, leakage, track, averages and noise.
    sides : str
        "mean", "left", "right" or "difference".
    """
    taps, segment_s = settings.welch.smear().numpy(), settings.welch.segment_s
    bins, more = settings.frequencies_hz().numpy(), np.arange(1, len(taps) // 2 + 1) / segment_s
    wide = np.concatenate([bins[0] - more[::-1], bins, bins[-1] + more])
    found = spectra(train, ratios, wide, sides, settings.track)
    n = len(bins)
    found = sum(tap * found[..., k : k + n] for k, tap in enumerate(taps))
    noise = noise_densities(train, settings, sides)
    auto = np.stack([found[:, i, i].real for i in range(3)], 1) + noise[:, None]
    cross = np.stack([found[:, y, x] for x, y in PAIRS], 1)  # E[conj(X) Y]
    return CrossSpectra(torch.as_tensor(auto), torch.as_tensor(cross), settings.n_averages)


def drawn_estimates(train, ratios, settings, seed, sides="mean"):
    """Return the spectra estimated from one trip of each vehicle: Wishart matrices.

    Parameters
    ----------
    train, ratios, settings, sides
        As for `expected_estimates`.
    seed : int
    """
    taps = moving_average_with(settings.welch.correlation().numpy())
    expected = expected_estimates(train, ratios, settings, sides)
    return sample_spectra(expected, taps, torch.Generator().manual_seed(seed))
