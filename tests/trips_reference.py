"""Slow, naive oracles of what is simulated and estimated in time, without the package's code."""

import cmath
import math

import numpy as np


def pitching_numbers(vehicle, ratios, speed_m_per_s, other_bogie="healthy"):
    """Return every number of a pitching vehicle by name, from 5 or at least 15 ratios."""
    ratios = [float(r) for r in ratios]
    if len(ratios) == 5:
        other = ratios[:4] if other_bogie == "same" else [1.0] * 4
        ratios = ratios + [1.0] + other + [1.0] * 5
    k_p, c_p = vehicle.primary_stiffness_n_per_m, vehicle.primary_damping_ns_per_m
    k_s, c_s = vehicle.secondary_stiffness_n_per_m, vehicle.secondary_damping_ns_per_m
    return {
        "measured": (k_p * ratios[0], c_p * ratios[1], k_s * ratios[2], c_s * ratios[3]),
        "other": (k_p * ratios[6], c_p * ratios[7], k_s * ratios[8], c_s * ratios[9]),
        "half_body_kg": 2 * vehicle.body_mass_kg * ratios[4],
        "bogie_kg": vehicle.bogie_mass_kg * ratios[10],
        "a": vehicle.half_wheelbase_m * ratios[11],
        "L": vehicle.half_pivot_distance_m * ratios[12],
        "bogie_gyration": vehicle.bogie_gyration_m * ratios[13],
        "body_gyration": vehicle.body_gyration_m * ratios[14],
        "speed": speed_m_per_s * ratios[5],
    }


def pitching_matrices(n, bogie="leading"):
    """Return M, D, K (6, 6) and D_w, K_w (6, 4) by Newton's law, spring by spring.

    Coordinates: heave z [m] and pitch theta [rad, nose up] of the half body, then of the leading
    and of the trailing bogie. Wheelsets from the front to the rear of the train.
    """
    leading, trailing = ("measured", "other") if bogie == "leading" else ("other", "measured")
    mass = np.diag(
        [
            n["half_body_kg"],
            n["half_body_kg"] * n["body_gyration"] ** 2,
            n["bogie_kg"],
            n["bogie_kg"] * n["bogie_gyration"] ** 2,
            n["bogie_kg"],
            n["bogie_kg"] * n["bogie_gyration"] ** 2,
        ]
    )
    systems = []
    for kind in (1, 0):  # dampers, springs
        inner, outer = np.zeros((6, 6)), np.zeros((6, 4))
        for which, name in enumerate((leading, trailing)):
            primary, secondary = n[name][kind], n[name][2 + kind]
            z, theta, place = 2 + 2 * which, 3 + 2 * which, (n["L"], -n["L"])[which]
            for axle, x in enumerate((n["a"], -n["a"])):  # half of k_p, c_p at each axle
                for row, arm in ((z, 1.0), (theta, x)):
                    inner[row, z] += arm * primary / 2
                    inner[row, theta] += arm * x * primary / 2
                    outer[row, 2 * which + axle] += arm * primary / 2
            for row, arm in ((0, 1.0), (1, place)):  # on the body
                inner[row, 0] += arm * secondary
                inner[row, 1] += arm * place * secondary
                inner[row, z] -= arm * secondary
            inner[z, z] += secondary  # on the bogie's centre
            inner[z, 0] -= secondary
            inner[z, 1] -= place * secondary
        systems.append((inner, outer))
    (damping, input_damping), (stiffness, input_stiffness) = systems
    return mass, damping, stiffness, input_damping, input_stiffness


def pitching_transfer(
    n, frequency_hz, bogie="leading", axle="leading", frame_sensor="axle", body_sensor_m=0.0
):
    """Return complex G_p and G_s at one frequency: a 6 x 6 system solved."""
    mass, damping, stiffness, input_damping, input_stiffness = pitching_matrices(n, bogie)
    s = 2j * math.pi * frequency_hz
    pivot = n["L"] if bogie == "leading" else -n["L"]
    offset = n["a"] if axle == "leading" else -n["a"]
    places = [n["L"] + n["a"], n["L"] - n["a"], -n["L"] + n["a"], -n["L"] - n["a"]]
    # what is further ahead met the same place of the track earlier
    wheels = [cmath.exp(s * (x - pivot - offset) / n["speed"]) for x in places]
    motion = np.linalg.solve(
        mass * s**2 + damping * s + stiffness, (input_damping * s + input_stiffness) @ wheels
    )
    z = 2 if bogie == "leading" else 4
    frame = motion[z] + (offset * motion[z + 1] if frame_sensor == "axle" else 0.0)
    body = motion[0] + (pivot + body_sensor_m) * motion[1]
    return frame, body / frame


def smeared(density, taps):
    """Return sum_j taps[j] density[k + j], one bin after the other."""
    n_inner = len(density) - len(taps) + 1
    return np.array([sum(w * density[k + j] for j, w in enumerate(taps)) for k in range(n_inner)])


def n_averages(window, step, n_segments, n_bins=1):
    """Return Welch's number of independent averages, segments and neighbouring bins one by one."""
    length, total = len(window), 0.0
    for j in range(1 - n_segments, n_segments):
        for k in range(1 - n_bins, n_bins):
            shared = sum(
                window[t] * window[t + abs(j) * step] * cmath.exp(-2j * math.pi * k * t / length)
                for t in range(length - abs(j) * step)
            )
            rho = abs(shared / sum(w * w for w in window)) ** 2
            total += (1 - abs(j) / n_segments) * (1 - abs(k) / n_bins) * rho
    return n_segments * n_bins / total


def relative_rows(responses, healthy):
    """Return log-magnitude and unwrapped phase of G_p, then of G_s, relative to healthy."""
    rows = []
    for curve in responses:
        row = []
        for g, h in zip(curve, healthy, strict=True):
            row += [np.log(np.abs(g) / np.abs(h)), np.unwrap(np.angle(g / h))]
        rows.append(np.concatenate(row))
    return np.array(rows)


def degraded_ratios(mileages_km, changes, names):
    """Return ratios to healthy, trip by trip: 1, a straight line, the last ratio."""
    table = []
    for mileage in mileages_km:
        row = []
        for name in names:
            ratio = 1.0
            if name in changes:
                begin, end = changes[name]["from_km"], changes[name]["to_km"]
                last = changes[name]["ratio"]
                if mileage > end:
                    ratio = last
                elif mileage > begin:
                    ratio = 1 + (last - 1) * (mileage - begin) / (end - begin)
            row.append(ratio)
        table.append(row)
    return np.array(table)
