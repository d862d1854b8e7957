"""Slow, naive oracles: the paper's equations written once more, without the package's code."""

import math

import numpy as np


def si_values(vehicle, ratios):
    """Return M_p, k_p, c_p, k_s, c_s, M_s in SI units; `ratios` ordered as ``PARAMETERS``."""
    return (
        vehicle.bogie_mass_kg,
        vehicle.primary_stiffness_n_per_m * ratios[0],
        vehicle.primary_damping_ns_per_m * ratios[1],
        vehicle.secondary_stiffness_n_per_m * ratios[2],
        vehicle.secondary_damping_ns_per_m * ratios[3],
        vehicle.body_mass_kg * ratios[4],
    )


def transfer(vehicle, ratios, frequency_hz):
    """Return complex G_p and G_s, Eqs. (3) and (4), for one vehicle; frequency scalar or array."""
    m_p, k_p, c_p, k_s, c_s, m_s = si_values(vehicle, ratios)
    s = 2j * math.pi * frequency_hz
    link = c_s * s + k_s
    body = m_s * s**2 + link
    g_s = link / body
    g_p = (c_p * s + k_p) / (m_p * s**2 + (c_p + c_s) * s + k_p + k_s - link**2 / body)
    return g_p, g_s


def magnitudes(vehicle, ratios, frequencies_hz):
    """Return abs(G_p) and abs(G_s) of one vehicle, shape (2, n_freq)."""
    return np.abs(np.stack(transfer(vehicle, ratios, np.asarray(frequencies_hz))))


def transfer_by_solving(vehicle, ratios, frequency_hz):
    """Return G_p and G_s from Eqs. (1) and (2) as a 2 x 2 system in z_p / w and z_s / w."""
    m_p, k_p, c_p, k_s, c_s, m_s = si_values(vehicle, ratios)
    s = 2j * math.pi * frequency_hz
    link = c_s * s + k_s
    system = np.array(
        [[m_p * s**2 + (c_p + c_s) * s + k_p + k_s, -link], [-link, m_s * s**2 + link]]
    )
    z_p, z_s = np.linalg.solve(system, np.array([c_p * s + k_p, 0]))
    return z_p, z_s / z_p


def moving_average(values, length):
    """Return the centred moving average over `length` (odd) values, shorter at the ends."""
    half = length // 2
    return np.array([np.mean(values[max(0, i - half) : i + half + 1]) for i in range(len(values))])


def peak_by_polyfit(values, frequencies_hz, shape, length, below, above):
    """Return position, height and half-power width of the largest peak, fitted once."""
    smoothed = moving_average(values, length)
    centre = frequencies_hz[np.argmax(smoothed)]
    distance = np.log(frequencies_hz / centre)
    half_width = np.where(distance < 0, below, above)
    window = np.exp(-((distance / half_width) ** 4) / 2)
    if shape == "lorentzian":
        target, weight = values**-2.0, window * smoothed**6
    else:
        target, weight = np.log(values), window * smoothed**2
    # polyfit multiplies residuals, not their squares, by w
    c2, c1, c0 = np.polyfit(frequencies_hz - centre, target, 2, w=np.sqrt(weight))
    position, top = centre - c1 / (2 * c2), c0 - c1**2 / (4 * c2)
    if shape == "lorentzian":
        return position, top**-0.5, 2 * math.sqrt(top / c2)
    return position, math.exp(top), 2 * math.sqrt(0.5 * math.log(2) / -c2)


def mape_percent(actual, predicted):
    """Return Eq. (14) on ratios to healthy."""
    return 100 / len(actual) * sum(abs((a - f) / a) for a, f in zip(actual, predicted, strict=True))


def rmse(actual, predicted):
    """Return Eq. (15) on ratios to healthy."""
    return math.sqrt(
        sum((a - f) ** 2 for a, f in zip(actual, predicted, strict=True)) / len(actual)
    )


def fisher_by_differences(vehicle, ratios, frequencies_hz, snr_db, columns, rows, step=1e-5):
    """Return J^T J / rms^2 summed over the chosen curves, J by central differences."""
    curves = magnitudes(vehicle, ratios, frequencies_hz)
    total = np.zeros((len(columns), len(columns)))
    for row in rows:
        rms = math.sqrt(np.mean(curves[row] ** 2)) * 10 ** (-snr_db / 20)
        slopes = []
        for column in columns:
            up, down = np.array(ratios, float), np.array(ratios, float)
            up[column] += step
            down[column] -= step
            change = magnitudes(vehicle, up, frequencies_hz) - magnitudes(
                vehicle, down, frequencies_hz
            )
            slopes.append(change[row] / (2 * step))
        jacobian = np.array(slopes)
        total += jacobian @ jacobian.T / rms**2
    return total


def complex_normal(rng, *shape):
    """Return complex standard normal numbers."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / math.sqrt(2)


def phasors(signals, times, frequencies_hz):
    """Return the complex amplitudes of signals (n_signals, n), (n_frequencies, n_signals)."""
    columns = [f(2 * math.pi * w * times) for w in frequencies_hz for f in (np.cos, np.sin)]
    fits, *_ = np.linalg.lstsq(np.array(columns).T, signals.T)
    return fits[0::2] - 1j * fits[1::2]
