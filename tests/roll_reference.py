"""A vehicle with a left and a right side, written out corner by corner: bounce, pitch and roll.

Coordinates: z, pitch and roll of the body, then of the leading and of the trailing bogie. Only the
leading bogie's springs and dampers differ between left and right.
"""

import numpy as np
from vehicles import AM96

SPRINGS_M = {"p": 1.0, "s": 1.0}
ROLL_GYRATION_M = {"bogie": 0.75, "body": 1.3}
SIDES = {"left": 1.0, "right": -1.0}
CHANNELS = ("axle_box", "bogie", "body")


def sided_responses(
    frequencies_hz,
    speed_m_per_s,
    d=(0.0, 0.0, 0.0, 0.0),
    ratios=(1, 1, 1, 1, 1),
    bar=0.0,
    sensors_m=(1.0, 1.0, 1.0),
    bushings=(np.inf, np.inf),
):
    """Return displacements of left and right sensors for mean and cross level of the track.

    Complex, (3, 2, 2, n_freq): place, side, input. The frame's sensors are above the leading axle
    boxes, those of the body above the leading bogie; the unit of cross level is half the difference
    of the rails under the springs. `d` is of k_p, c_p, k_s, c_s; `bar` is relative to k_s;
    `bushings` are those in series with c_p and c_s of one side, [N/m].
    """
    v = AM96
    k_p, c_p, k_s, c_s, m_s = np.array(ratios) * v.healthy_values()
    a, half_pivot = v.half_wheelbase_m, v.half_pivot_distance_m
    m_bogie, m_body = 2 * v.bogie_mass_kg, 4 * m_s
    inertia = [m_body, m_body * v.body_gyration_m**2, m_body * ROLL_GYRATION_M["body"] ** 2]
    for _ in range(2):
        inertia += [m_bogie, m_bogie * v.bogie_gyration_m**2]
        inertia += [m_bogie * ROLL_GYRATION_M["bogie"] ** 2]
    out = np.zeros((3, 2, 2, len(frequencies_hz)), dtype=complex)
    for n, frequency in enumerate(frequencies_hz):
        omega = 2 * np.pi * frequency
        matrix = -(omega**2) * np.diag(inertia).astype(complex)
        drive = np.zeros((9, 2), dtype=complex)
        for i, ahead in enumerate((half_pivot, -half_pivot)):
            row = 3 + 3 * i
            for side in SIDES.values():
                k_d, c_d, ks_d, cs_d = (side * x if i == 0 else 0.0 for x in d)
                secondary = k_s * (1 + ks_d) + in_series(1j * omega * c_s * (1 + cs_d), bushings[1])
                stretch = np.zeros(9)
                stretch[[0, 1, 2]] = 1.0, ahead, side * SPRINGS_M["s"]
                stretch[[row, row + 2]] = -1.0, -side * SPRINGS_M["s"]
                matrix += secondary * np.outer(stretch, stretch)
                for axle in (a, -a):
                    # a bogie side's k_p and c_p are those of its two axle boxes together
                    damper = in_series(1j * omega * c_p * (1 + c_d), bushings[0])
                    primary = (k_p * (1 + k_d) + damper) / 2
                    lever = np.zeros(9)
                    lever[[row, row + 1, row + 2]] = 1.0, axle, side * SPRINGS_M["p"]
                    matrix += primary * np.outer(lever, lever)
                    behind_m = half_pivot + a - ahead - axle
                    phase = np.exp(-1j * omega * behind_m / speed_m_per_s)
                    drive += primary * np.outer(lever, [phase, side * phase])
            twist = np.zeros(9)
            twist[[2, row + 2]] = 1.0, -1.0
            matrix += 2 * bar * k_s * SPRINGS_M["s"] ** 2 * np.outer(twist, twist)
        q = np.linalg.solve(matrix, drive)
        for s, side in enumerate(SIDES.values()):
            box, frame, body = (side * lateral for lateral in sensors_m)
            out[0, s, :, n] = 1.0, box / SPRINGS_M["p"]
            out[1, s, :, n] = q[3] + a * q[4] + frame * q[5]
            out[2, s, :, n] = q[0] + half_pivot * q[1] + body * q[2]
    return out


def in_series(damper, bushing):
    """Return the dynamic stiffness of a damper behind a bushing."""
    return 1 / (1 / damper + 1 / bushing)


def track_amplitudes(frequencies_hz, speed_m_per_s):
    """Return root densities of the accelerations by mean and cross level, (2, n_freq).

    The shape of the German track (ERRI B176), in units of its own.
    """
    omega = 2 * np.pi * np.asarray(frequencies_hz) / speed_m_per_s
    mean = omega**2 / np.sqrt((omega**2 + 0.0206**2) * (omega**2 + 0.8246**2))
    return np.stack([mean, mean * omega / np.sqrt(omega**2 + 0.438**2)])
