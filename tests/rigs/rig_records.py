"""Records of a base-excited chain of two masses, integrated in time by scipy alone."""

import numpy as np
from scipy.signal import butter, lsim, sosfilt

OVERSAMPLING = 8
"""Steps of the integration in one of the record: its error at the highest mode is below 1e-3."""


def chain(k_p, c_p, k_s, c_s, m_s):
    """Return the state space (A, B, C, D) from base to base, frame and body accelerations.

    States are the displacements of both masses relative to the base and their rates; M_p = 1.
    """
    stiffness = np.array([[k_p + k_s, -k_s], [-k_s, k_s]])
    damping = np.array([[c_p + c_s, -c_s], [-c_s, c_s]])
    inverse = np.diag([1.0, 1 / m_s])
    forces = np.hstack([-inverse @ stiffness, -inverse @ damping])
    a = np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), forces])
    b = np.array([[0.0], [0.0], [-1.0], [-1.0]])
    c = np.vstack([np.zeros((1, 4)), forces])
    return a, b, c, np.array([[1.0], [0.0], [0.0]])


def record(numbers, rate_hz, seconds, seed, *, noise=0.003, base=None, start=True):
    """Return accelerations (3, n) of base, frame and body, [m/s2].

    `base` (n * ``OVERSAMPLING``,) is the base's acceleration, None: noise up to 0.45 of the rate.
    `noise` is the rms of the sensors' noise over that of the base. `start`: the record begins in
    the middle of the motion.
    """
    rng = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    before = n // 5 if start else 0
    fine = (n + before) * OVERSAMPLING
    if base is None:
        low_pass = butter(8, 0.45 * rate_hz, fs=OVERSAMPLING * rate_hz, output="sos")
        base = sosfilt(low_pass, rng.standard_normal(fine)) * np.sqrt(OVERSAMPLING)
    times = np.arange(len(base)) / (OVERSAMPLING * rate_hz)
    signals = lsim(chain(*numbers), base, times)[1].T[:, ::OVERSAMPLING][:, before:]
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
