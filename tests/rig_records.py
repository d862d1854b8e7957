"""Records of a base-excited chain of two masses, integrated in time by scipy alone."""

import numpy as np
from scipy.signal import butter, cont2discrete, lfilter, sosfilt

OVERSAMPLING = 8
"""Steps of the integration in one of the record: its error at the highest mode is below 1e-3."""


def chain(k_p, c_p, k_s, c_s, m_s, hung=None):
    """Return the state space (A, B, C, D) from base to base, frame and body accelerations.

    States are the displacements of the masses relative to the base and their rates; M_p = 1.
    `hung`: mass over M_p, frequency [Hz] and damping ratio of what hangs on the body, if anything.
    """
    springs, dampers, masses = [(k_p, -1, 0), (k_s, 0, 1)], [(c_p, -1, 0), (c_s, 0, 1)], [1, m_s]
    if hung is not None:
        mass, hz, ratio = hung
        omega = 2 * np.pi * hz
        springs.append((mass * omega**2, 1, 2))
        dampers.append((2 * ratio * mass * omega, 1, 2))
        masses.append(mass)
    n = len(masses)
    inverse = np.diag(1 / np.array(masses))
    forces = np.hstack([-inverse @ _assembled(springs, n), -inverse @ _assembled(dampers, n)])
    a = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), forces])
    b = np.concatenate([np.zeros(n), -np.ones(n)])[:, None]
    c = np.vstack([np.zeros((1, 2 * n)), forces[:2]])
    return a, b, c, np.array([[1.0], [0.0], [0.0]])


def moved_by(system, base, step_s):
    """Return accelerations (3, n) of a chain that was at rest one step before `base` starts.

    They are those of `scipy.signal.lsim`, many times faster: each mode is a filter of first order.
    """
    a, b, c, d, _ = cont2discrete(system, step_s, "foh")
    poles, modes = np.linalg.eig(a)
    pairs = zip(np.linalg.solve(modes, b.astype(complex))[:, 0], poles, strict=True)
    motion = [lfilter([0, force], [1, -pole], base) for force, pole in pairs]
    return (c @ modes @ motion).real + d * base


def _assembled(links, n):
    """Return the matrix of links (size, first, second) between masses; -1 is the base."""
    matrix = np.zeros((n, n))
    for size, first, second in links:
        pull = np.zeros(n)
        pull[second] = 1.0
        if first >= 0:
            pull[first] = -1.0
        matrix += size * np.outer(pull, pull)
    return matrix


def record(numbers, rate_hz, seconds, seed, *, noise=0.003, base=None, start=True, hung=None):
    """Return accelerations (3, n) of base, frame and body, [m/s2].

    `hung` is as of `chain`. `base` (n * ``OVERSAMPLING``,) is the base's acceleration, None: noise
    up to 0.45 of the rate.
    `noise` is the rms of the sensors' noise over that of the base. `start`: the record starts in
    the middle of the motion.
    """
    rng = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    before = n // 5 if start else 0
    fine = (n + before) * OVERSAMPLING
    if base is None:
        low_pass = butter(8, 0.45 * rate_hz, fs=OVERSAMPLING * rate_hz, output="sos")
        base = sosfilt(low_pass, rng.standard_normal(fine)) * np.sqrt(OVERSAMPLING)
    moved = moved_by(chain(*numbers, hung), base, 1 / (OVERSAMPLING * rate_hz))
    signals = moved[:, ::OVERSAMPLING][:, before:]
    return signals + noise * signals[0].std() * rng.standard_normal(signals.shape)


def numbers(primary_hz, secondary_hz, mass_ratio, primary_damping, secondary_damping):
    """Return (k_p, c_p, k_s, c_s, M_s) over M_p, SI units."""
    p, s = 2 * np.pi * primary_hz, 2 * np.pi * secondary_hz
    return np.array(
        [
            p**2,
            2 * primary_damping * p,
            mass_ratio * s**2,
            2 * secondary_damping * s * mass_ratio,
            mass_ratio,
        ]
    )
