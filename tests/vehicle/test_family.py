"""Every part of the vertical vehicle against point springs on rigid bodies, solved naively."""

import cmath
import math

import numpy as np
import pytest
import torch
from vehicles import AM96

from suspnet.vehicle import PARAMETERS, VerticalVehicle
from suspnet.vehicle.quantities import PARTS, QUANTITIES, UNMEASURED
from suspnet.vehicle.vertical_motion import LOSS_HZ, LOSS_SHARES

FREQUENCIES = torch.tensor([0.3, 0.9, 1.31, 1.9, 3.3, 5.4, 7.7, 11.0]).double()
RNG = np.random.default_rng(11)
NAMES = (*PARAMETERS, *UNMEASURED)
ALL = torch.as_tensor(RNG.uniform(0.7, 1.4, (3, len(NAMES))))
SENSORS = (1.0, 0.95, -1.1)
COMBINATIONS = [(part,) for part in PARTS] + [PARTS, PARTS[:-1]]


def numbers(generator, ratios):
    """Return every number of one vehicle in SI units, from the tables rather than the class."""
    p = dict(zip(NAMES, [float(r) for r in ratios], strict=True))
    v = generator.vehicle
    nominal = {
        "M_s": v.body_mass_kg,
        "speed": generator.speed_m_per_s,
        "bogie_mass": v.bogie_mass_kg,
        "half_wheelbase": v.half_wheelbase_m,
        "half_pivot_distance": v.half_pivot_distance_m,
        "bogie_gyration": v.bogie_gyration_m,
        "body_gyration": v.body_gyration_m,
        "healthy_k_p": v.primary_stiffness_n_per_m,
        "healthy_c_p": v.primary_damping_ns_per_m,
        "healthy_k_s": v.secondary_stiffness_n_per_m,
        "healthy_c_s": v.secondary_damping_ns_per_m,
        "axle_box_lateral": generator.sensor_lateral_m[0],
        "frame_lateral": generator.sensor_lateral_m[1],
        "body_lateral": generator.sensor_lateral_m[2],
    }
    nominal |= {q.name: q.nominal for q in QUANTITIES if q.nominal is not None}
    n = {name: value * nominal.get(name, 1.0) for name, value in p.items()}
    if generator.direction == "reverse":  # the same vehicle and track, other delays
        n["speed"] = -n["speed"]
    if "payload" in generator.parts:
        mass = n["M_s"] / v.body_mass_kg
        n["healthy_k_s"] *= mass ** n["stiffness_exponent"]
        n["healthy_c_s"] *= mass ** n["damping_exponent"]
        n["body_gyration"] *= mass ** n["gyration_exponent"]
        # frequency over mass ^ -exponent, of a bending whose modal mass is laden
        n["bending_frequency"] *= math.sqrt(mass) / mass ** n["bending_exponent"]
    return n


def ladder(s):
    """Return the loss of rubber per stiffness and loss factor, branch by branch."""
    total = 0.0
    for share, hertz in zip(LOSS_SHARES, LOSS_HZ, strict=True):
        damper = share / (2 * math.pi * hertz)
        reference = 2j * math.pi * 2.7 * damper
        total += 1 / (1 / share + 1 / (damper * s)) - (1 / (1 / share + 1 / reference)).real
    return total


def kappas(n, which, parts, s):
    """Return the primary and secondary dynamic stiffness of one bogie's side."""
    k_p, c_p, k_s, c_s = (
        n[which + name] * n[f"healthy_{name}"] for name in ("k_p", "c_p", "k_s", "c_s")
    )
    damper_p, damper_s = c_p * s, c_s * s
    if "bushings" in parts:  # in series: compliances add
        damper_p = 1 / (1 / damper_p + 1 / n["primary_bushing"])
        damper_s = 1 / (1 / damper_s + 1 / n["secondary_bushing"])
    spring_p = k_p
    if "rubber" in parts:
        branch, rate = n["rubber_share"] * k_p, 2 * math.pi * n["rubber_frequency"]
        spring_p += 1 / (1 / branch + 1 / (branch / rate * s)) + n["rubber_loss"] * k_p * ladder(s)
    secondary = k_s + damper_s
    if "air_spring" in parts:
        ratio = n["volume_ratio"]
        k_3 = n["area_share"] * k_s
        k_2 = (k_s - k_3) * (1 + ratio) / ratio
        k_1 = ratio * k_2
        orifice = c_s / (k_1 / (k_1 + k_2)) ** 2
        secondary = k_3 + 1 / (1 / k_1 + 1 / (k_2 + orifice * s))
    return spring_p + damper_p, secondary


def naive(generator, ratios, frequency_hz):
    """Return axle box, frame and body for each input, (n_inputs, 3), one system of equations.

    The inputs are the mean of both rails, each wheelset alone if there are wheelsets, cross level.

    Coordinates: z, pitch, roll [rad] and bending of the body, then z, pitch, roll of both bogies,
    then the body's way aside, positive where the roll lowers it there above its centre;
    every spring acts between two points, left and right, all of the vehicle and not of a side.
    """
    n, parts = numbers(generator, ratios), generator.parts
    s = 2j * math.pi * frequency_hz
    a, pivot = n["half_wheelbase"], n["half_pivot_distance"]
    leading, reverse = generator.bogie == "leading", generator.direction == "reverse"
    system = np.zeros((11, 11), dtype=complex)
    body, bogie = 4 * n["M_s"], 2 * n["bogie_mass"]
    inertias = [body, body * n["body_gyration"] ** 2, body * n["body_roll_gyration"] ** 2]
    system[:3, :3] = np.diag(inertias) * s**2
    empty = 2 * AM96.body_mass_kg
    own = 2 * math.pi * n["bending_frequency"]
    # the shape is given per modal mass of a quarter: both sides have two
    modal = 2 * n["M_s"] * s**2 + empty * own**2 + 2 * n["bending_damping"] * empty * own * s
    system[3, 3] = modal
    system[10, 10] = body * s**2
    shape = n["bending_at_pivot"] if "bending" in parts else 0.0
    drive = np.zeros((11, 6), dtype=complex)
    b_p, b_s = n["primary_lateral"], n["secondary_lateral"]
    for i, place in enumerate((pivot, -pivot)):
        which = "" if (i == 0) == leading else "other_"
        kappa_p, kappa_s = kappas(n, which, parts, s)
        first = 4 + 3 * i
        rows = np.eye(11)[first : first + 3]
        gyrations = (1.0, n["bogie_gyration"] ** 2, n["bogie_roll_gyration"] ** 2)
        for row, square in zip(rows, gyrations, strict=True):
            system += bogie * square * s**2 * np.outer(row, row)
        for side in (1.0, -1.0):
            stretch = -(rows[0] + side * b_s * rows[2])
            stretch[[0, 1, 2, 3]] += 1.0, place, side * b_s, shape
            system += kappa_s * np.outer(stretch, stretch)
            for x in (a, -a):
                stretch = rows[0] + x * rows[1] + side * b_p * rows[2]
                system += kappa_p / 2 * np.outer(stretch, stretch)
                delay = cmath.exp(s * (place + x - reference(generator, n)) / n["speed"])
                # the rails are 0.75 m off the middle; the rigid axle continues their slope
                wheelset = 2 * ((i == 0) != leading) + ((x < 0) != reverse)
                own = math.sqrt(abs(n["wheelset_share"])) * np.eye(4)[wheelset]
                track = np.array([delay, *own, delay * side * b_p / 0.75])
                drive += kappa_p / 2 * np.outer(stretch, track)
            damper, bushing = n["yaw_damping"] * s, n["yaw_bushing"]
            along = {
                "longitudinal": (n["longitudinal_stiffness"] + n["longitudinal_damping"] * s, 0.0),
                "yaw_dampers": (damper * bushing / (damper + bushing), n["yaw_height"]),
            }
            for kappa_x, height in (along[part] for part in parts if part in along):
                link = np.zeros(11)
                link[1], link[first + 1] = n["body_lever"] - height, n["bogie_lever"] + height
                if "bending" in parts:
                    link[3] = link[1] * n["bending_slope"] / place
                system += kappa_x * np.outer(link, link)
        if "guidance" in parts:
            gamma = n["guidance_stiffness"] * n["healthy_k_p"]
            gamma += n["guidance_damping"] * n["healthy_c_p"] * s
            system += 2 * gamma * a**2 * np.outer(rows[1], rows[1])
        if "roll" in parts:
            # between a point of the body below its centre and one of the bogie above its own
            aside = np.zeros(11)
            aside[10], aside[2], aside[first + 2] = 1.0, n["body_lever"], n["bogie_lever"]
            kappa_y = n["lateral_stiffness"] + n["lateral_damping"] * s
            system += 2 * kappa_y * np.outer(aside, aside)
        bar = rows[2].copy()
        bar[2] = -1.0
        system += n["anti_roll_bar"] * np.outer(bar, bar)
    motion = np.linalg.solve(system, drive)
    frame, body_sensor = np.zeros(11), np.zeros(11)
    row = 4 if leading else 7
    offset = a if generator.axle == "leading" else -a
    frame[row : row + 3] = 1.0, offset * (generator.frame_sensor == "axle"), n["frame_lateral"]
    place = (pivot if leading else -pivot) + generator.body_sensor_m
    at_sensor = n["bending_at_sensor"] if "bending" in parts else 0.0
    body_sensor[:4] = 1.0, place, n["body_lateral"], at_sensor
    own = (
        math.sqrt(abs(n["wheelset_share"]))
        * np.eye(4)[int((generator.axle == "trailing") != reverse)]
    )
    box = np.array([1.0, *own, n["axle_box_lateral"] / 0.75])
    waves = (2 * math.pi * frequency_hz / n["speed"]) ** 2
    share = n["cross_level"] * waves / (waves + 0.438**2)
    if "axle_box_arm" in parts:  # from the axle box to the point of the frame above it
        above = np.zeros(11)
        above[row : row + 3] = 1.0, offset, n["axle_box_lateral"]
        box = (1 - n["arm_share"]) * box + n["arm_share"] * (above @ motion)
    found = np.stack([box, frame @ motion, body_sensor @ motion])
    if "sensors" in parts:
        for row, name in enumerate(("frame", "body"), start=1):
            found[row] *= n[f"{name}_gain"] * cmath.exp(-s * n[f"{name}_delay"])
    found[:, 5] *= math.sqrt(share)
    chosen = [0, *(range(1, 5) if "wheelsets" in parts else ()), *([5] if generator.rolls else [])]
    return found[:, chosen].T


def reference(generator, n):
    """Return the place of the measured axle, ahead of the body's centre."""
    pivot = n["half_pivot_distance"] if generator.bogie == "leading" else -n["half_pivot_distance"]
    offset = n["half_wheelbase"] if generator.axle == "leading" else -n["half_wheelbase"]
    return pivot + offset


@pytest.mark.parametrize("parts", COMBINATIONS, ids="+".join)
@pytest.mark.parametrize(
    ("bogie", "axle", "frame_sensor", "body_sensor_m", "direction"),
    [
        ("leading", "leading", "axle", 0.0, "forward"),
        ("trailing", "leading", "centre", 1.7, "forward"),
        ("leading", "trailing", "axle", 1.7, "reverse"),
    ],
)
def test_channels_solve_the_equations_of_point_springs(
    parts, bogie, axle, frame_sensor, body_sensor_m, direction
):
    generator = VerticalVehicle(
        AM96,
        speed_m_per_s=52.0,
        direction=direction,
        bogie=bogie,
        axle=axle,
        frame_sensor=frame_sensor,
        body_sensor_m=body_sensor_m,
        parts=parts,
        sensor_lateral_m=SENSORS,
    )
    found = generator.channels(ALL, FREQUENCIES).numpy()
    n_inputs = 1 + 4 * ("wheelsets" in parts) + ("roll" in parts)
    assert found.shape == (3, n_inputs, 3, len(FREQUENCIES))
    for row, ratios in enumerate(ALL):
        for column, frequency in enumerate(FREQUENCIES.tolist()):
            expected = naive(generator, ratios, frequency)
            np.testing.assert_allclose(found[row, :, :, column], expected, rtol=1e-9)


def test_numbers_that_may_be_absent_may_be_slightly_negative():
    absent = [quantity.name for quantity in QUANTITIES if quantity.may_be_absent]
    generator = VerticalVehicle(AM96, parts=PARTS, distribution=dict.fromkeys(absent, 0.5))
    assert generator.distribution.names == tuple(absent)
    values = torch.as_tensor(np.random.default_rng(5).uniform(-0.5, 0.0, (3, len(absent))))
    ratios = generator.with_uncertain(ALL[:, :5], values)
    columns = [NAMES.index(name) for name in absent]
    assert torch.equal(ratios[:, columns], values)
    found = generator.channels(ratios, FREQUENCIES).numpy()
    positive = generator.channels(ALL[:, :5], FREQUENCIES).numpy()
    assert np.abs(found - positive).max() > 1e-3
    for row, one in enumerate(ratios):
        for column, frequency in enumerate(FREQUENCIES.tolist()):
            expected = naive(generator, one, frequency)
            np.testing.assert_allclose(found[row, :, :, column], expected, rtol=1e-9)


def test_averaged_sensors_do_not_see_roll():
    pair = VerticalVehicle(AM96, parts=PARTS).channels(ALL, FREQUENCIES)
    one = VerticalVehicle(AM96, parts=PARTS, sensor_lateral_m=SENSORS)
    found = one.channels(ALL, FREQUENCIES)
    assert found.shape[1] == pair.shape[1] + 1
    torch.testing.assert_close(pair, found[:, :-1])


def test_every_quantity_of_a_full_vehicle_changes_its_channels():
    options = {"sensor_lateral_m": SENSORS}
    vehicles = [VerticalVehicle(AM96, parts=p, **options) for p in (PARTS, PARTS[:-1])]
    for column, name in enumerate(NAMES):
        ratios = torch.ones(2, len(NAMES), dtype=torch.float64)
        ratios[:, PARAMETERS.index("M_s")] = 1.1  # the payload of what depends on it
        ratios[1, column] = 1.2
        changes = []
        for vehicle in vehicles:
            before, after = vehicle.channels(ratios, FREQUENCIES)
            changes.append(float((after - before).abs().max()))
        assert max(changes) > 1e-6, name


def test_derivatives_are_finite_where_no_wheelset_is_excited_alone():
    generator = VerticalVehicle(AM96, parts=("wheelsets",))
    row = generator.complete(torch.as_tensor(np.full((1, 5), 0.9)))
    row[0, 5 + UNMEASURED.index("wheelset_share")] = 0.0
    row.requires_grad_()
    bins = torch.linspace(0.5, 20, 9, dtype=torch.float64)
    every = generator.channels(row, bins).abs().square()
    (alone,) = torch.autograd.grad(every[:, 1:].sum(), row, retain_graph=True)
    (slope,) = torch.autograd.grad(every.sum(), row)
    assert (every[:, 1:] == 0).all()
    assert (alone == 0).all()
    assert bool(torch.isfinite(slope).all())
    assert bool((slope[0, :4].abs() > 0.01).all())
