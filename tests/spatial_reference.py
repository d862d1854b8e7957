"""A vehicle of twelve separate parts as rigid bodies in space, one vehicle and frequency at a time.

Axes are fixed to the vehicle: x ahead in the direction forward, y to the left, z up. Each spring
joins a point of one body to a point of another one and acts along one axis; bodies turn by small
angles about their axes. In reverse the speed is negative.
"""

import cmath
import math

import numpy as np

from suspnet.vehicle.quantities import QUANTITIES, SPATIAL_QUANTITIES
from suspnet.vehicle.vertical_motion import LOSS_HZ, LOSS_SHARES

X, Y, Z = np.eye(3)
RAIL_M = 0.75
TORSION_MASS = 0.2  # over the frame's
BODY, FRAMES, WHEELSETS = 0, (1, 2), (3, 4, 5, 6)
ON_BODY = ("body_left", "body_right", "body_middle")  # places of sensors, with or without floor
FREE = ("q", "tau_1", "tau_2", "q_b", "tau_b", "z_e", *ON_BODY)
SIZE = 7 * 6 + len(FREE)
INPUTS = 12  # height, angle and lateral place of the track under wheelsets 1 to 4


def numbers(vehicle, ratios):
    """Return every number of one vehicle in SI units from the tables of quantities."""
    v = vehicle.vehicle
    nominal = {q.name: q.nominal for q in (*QUANTITIES, *SPATIAL_QUANTITIES) if q.nominal}
    nominal |= {"M_s": v.body_mass_kg, "bogie_mass": v.bogie_mass_kg}
    nominal |= {"speed": vehicle.speed_m_per_s * (-1 if vehicle.direction == "reverse" else 1)}
    nominal |= {
        "half_wheelbase": v.half_wheelbase_m,
        "half_pivot_distance": v.half_pivot_distance_m,
        "bogie_gyration": v.bogie_gyration_m,
        "body_gyration": v.body_gyration_m,
        "healthy_k_p": v.primary_stiffness_n_per_m,
        "healthy_c_p": v.primary_damping_ns_per_m,
        "healthy_k_s": v.secondary_stiffness_n_per_m,
        "healthy_c_s": v.secondary_damping_ns_per_m,
    }
    places = zip(("axle_box", "frame", "body"), vehicle.sensor_lateral_m, strict=True)
    nominal |= {f"{name}_lateral": place for name, place in places}
    columns = zip(vehicle.columns, np.asarray(ratios, dtype=float), strict=True)
    n = {name: ratio * nominal.get(name, 1.0) for name, ratio in columns}
    mass = n["M_s"] / v.body_mass_kg if "payload" in vehicle.parts else 1.0
    n["dry_friction"] = n["secondary_loss"] * n["healthy_k_s"]  # of any load
    n["healthy_k_s"] *= mass ** n["stiffness_exponent"]
    n["healthy_c_s"] *= mass ** n["damping_exponent"]
    n["body_gyration"] *= mass ** n["gyration_exponent"]
    n["bending_frequency"] *= mass ** (0.5 - n["bending_exponent"])
    n["empty"] = v.body_mass_kg
    return n


def in_series(*stiffnesses):
    return 1 / sum(1 / one for one in stiffnesses)


def ladder(n, k, s):
    """Return what the loss factor n of a spring k adds to its dynamic stiffness."""
    found = 0
    for share, hertz in zip(LOSS_SHARES, LOSS_HZ, strict=True):
        share = share * n * k
        middle = in_series(share, share / (2 * math.pi * hertz) * 2j * math.pi * 2.7)
        found += in_series(share, share / (2 * math.pi * hertz) * s) - middle.real
    return found


def primary(n, parts, k, c, s):
    """Return the dynamic stiffness of a corner: half a bogie side's."""
    damper = in_series(c * s, n["primary_bushing"]) if "bushings" in parts else c * s
    if "rubber" not in parts:
        return (k + damper) / 2
    branch = n["rubber_share"] * k
    spring = k + in_series(branch, branch / (2 * math.pi * n["rubber_frequency"]) * s)
    return (spring + ladder(n["rubber_loss"], k, s) + damper) / 2


def secondary(n, parts, k, c, s):
    """Return the dynamic stiffness of a side."""
    lossy = 0
    if "nonlinear_dampers" in parts:
        lossy = ladder(1, n["dry_friction"], s) - ladder(1, n["dry_friction"], 1j * math.pi).real
    if "air_spring" in parts:
        volume = (1 - n["area_share"]) * k  # k_1 k_2 / (k_1 + k_2)
        k_2 = volume * (1 + n["volume_ratio"]) / n["volume_ratio"]
        k_1 = n["volume_ratio"] * k_2
        orifice = c * ((k_1 + k_2) / k_1) ** 2
        return n["area_share"] * k + in_series(k_1, k_2 + orifice * s) + lossy
    return k + lossy + (in_series(c * s, n["secondary_bushing"]) if "bushings" in parts else c * s)


def moved(body, place, axis):
    """Return the motion along an axis of a point of a body, over all coordinates."""
    row = np.zeros(SIZE)
    row[6 * body : 6 * body + 6] = np.hstack([axis, np.cross(place, axis)])
    return row


def sign_of(place):
    """Return 1 of a place on the left, -1 on the right, 0 in the middle."""
    return {"left": 1.0, "right": -1.0, "middle": 0.0}[place.split("_")[-1]]


class Train:
    """One vehicle at s = j omega: `system` maps its motion to forces, `drive` the track's."""

    def __init__(self, vehicle, ratios, s):
        n = self.n = numbers(vehicle, ratios)
        self.vehicle, self.parts, self.s = vehicle, vehicle.parts, s
        a, pivot = n["half_wheelbase"], n["half_pivot_distance"]
        self.ahead = 1.0 if vehicle.bogie == "leading" else -1.0
        self.toward = 1.0 if vehicle.axle == "leading" else -1.0
        self.centres = self.ahead * pivot, -self.ahead * pivot
        self.axles = [self.toward * a * sign for sign in (1, -1, 1, -1)]
        self.floors = [p for p in vehicle.sensors if p in ON_BODY and "floors" in self.parts]
        self.system = np.zeros((SIZE, SIZE), dtype=complex)
        self.drive = np.zeros((SIZE, INPUTS), dtype=complex)
        # the body's motion is that of its centre of mass
        self.centre = np.zeros(3)
        if "load" in self.parts:
            self.centre[:2] += self.ahead * n["load_ahead"], n["load_aside"]
        if "equipment" in self.parts:  # it balances with the rest of the body about the middle
            hung = np.array([self.ahead * n["equipment_ahead"], n["equipment_aside"]])
            self.centre[:2] -= n["equipment_share"] * hung
        # what wheelsets are made to do: rows of coordinates that follow the track
        self.led = np.zeros((SIZE, INPUTS))
        self.slaved = np.zeros((SIZE, SIZE))  # what follows other coordinates
        for wheel, body in enumerate(WHEELSETS):
            if "track" not in self.parts:
                self.led[6 * body + 2, wheel] = self.led[6 * body + 3, 4 + wheel] = 1.0
            if "creep" not in self.parts:
                self.led[6 * body + 1, 8 + wheel] = 1.0
                if "track" in self.parts:
                    self.slaved[6 * body + 1, 6 * body + 3] = -n["wheel_radius"]
                else:
                    self.led[6 * body + 1, 4 + wheel] = -n["wheel_radius"]
        self.masses()
        self.springs()
        if "creep" in self.parts:
            self.creep()
        if "track" in self.parts:
            self.carry()

    def carry(self):
        """Add the track under each rail, between a point of the wheelset and the rail's height."""
        n = self.n
        kappa = (1 + n["track_time"] * self.s) / n["track_compliance"] / 2
        for wheel, body in enumerate(WHEELSETS):
            for y in (RAIL_M, -RAIL_M):
                at, rail = moved(body, [0, y, 0], Z), np.zeros(INPUTS)
                rail[wheel], rail[4 + wheel] = 1.0, y
                self.system += kappa * np.outer(at, at)
                self.drive += kappa * np.outer(at, rail)

    def body(self, place, axis, end, heights=(0.0, 0.0)):
        """Return the motion of a point of the body above a bogie, the measured one at `end` 1.

        `heights` are those of the first and second bending there; torsion turns the body about x.
        """
        row = moved(BODY, place - self.centre, axis)
        row[42] = heights[0] * axis[2]
        row[45] = heights[1] * axis[2]
        row[46] = end * self.n["twist_at_pivot"] * np.cross(place, axis)[0]
        return row

    def mode(self, name, mass):
        """Return the dynamic stiffness of a mode without its mass."""
        own = 2 * math.pi * self.n[f"{name}_frequency"]
        return mass * (own**2 + 2 * self.n[f"{name}_damping"] * own * self.s)

    def frame(self, i, place, axis):
        """Return the motion of a point of a frame, its torsion included."""
        row = moved(FRAMES[i], place, axis)
        n = self.n
        twist = (
            n["torsion_rise"]
            * place[0]
            * self.toward
            / n["half_wheelbase"]
            * place[1]
            / n["primary_lateral"]
        )
        row[6 * 7 + 1 + i] = twist * axis[2]
        return row

    def add(self, kappa, one, other=None):
        """Join two points by an element."""
        stretch = one if other is None else one - other
        self.system += kappa * np.outer(stretch, stretch)

    def masses(self):
        n, s, squares = self.n, self.s, np.zeros(SIZE)
        body, frame = 4 * n["M_s"], 2 * n["bogie_mass"]
        yaw = n["body_gyration"] * n["body_yaw"]
        squares[:6] = np.array([1, 1, 1, n["body_roll_gyration"], n["body_gyration"], yaw])
        squares[:6] = body * squares[:6] ** 2
        yaw = n["bogie_gyration"] * n["bogie_yaw"]
        own = np.array([1, 1, 1, n["bogie_roll_gyration"], n["bogie_gyration"], yaw])
        squares[6:18] = np.tile(frame * own**2, 2)
        # a wheelset held on its rails has no mass of its own where its motion is the track's
        aside, up = "creep" in self.parts, "track" in self.parts
        gyration = n["wheelset_yaw_gyration"]
        own = np.array([0, aside, up, up * gyration, 0, gyration])
        squares[18:42] = np.tile(n["wheelset_mass"] * own**2, 4)
        squares[42:45] = body / 2, *[frame * TORSION_MASS] * 2
        hung = 4 * n["empty"] * (1 - 1 / (1 + n["equipment_share"]))
        squares[45:48] = body / 2, body * n["body_roll_gyration"] ** 2, hung
        if "equipment" in self.parts:
            squares[2] -= hung
        self.system += np.diag(squares) * s**2
        torsion = self.mode("torsion", frame * TORSION_MASS)
        modal = [self.mode("bending", 2 * n["empty"]), torsion, torsion]
        modal.append(self.mode("second", 2 * n["empty"]))
        modal.append(self.mode("twist", 4 * n["empty"] * n["body_roll_gyration"] ** 2))
        self.system += np.diag([0] * 42 + modal + [0] * 4)
        if "equipment" in self.parts:
            at = [self.ahead * n["equipment_ahead"], n["equipment_aside"], 0]
            above, below = moved(BODY, at - self.centre, Z), np.zeros(SIZE)
            above[42], below[47] = n["equipment_at_bending"], 1.0
            above[45] = n["equipment_at_second"]
            above[46] = n["equipment_at_twist"] * n["equipment_aside"]
            self.add(self.mode("equipment", hung), above, below)
        for place in self.floors:
            at, mass = 42 + FREE.index(place), n[f"floor_mass_{place}"]
            self.system[at, at] += mass * s**2
            spring = 1 / n[f"floor_softness_{place}"] + n[f"floor_damping_{place}"] * s
            self.add(mass * spring, np.eye(SIZE)[at], self.rise(place))

    def springs(self):
        n, parts, s = self.n, self.parts, self.s
        for i, centre in enumerate(self.centres):
            section = np.zeros(SIZE)  # the slope of the bent body, its front up
            section[42] = n["bending_slope"] / centre
            section[45] = self.ahead * n["second_slope"] / n["half_pivot_distance"]
            end = 1 - 2 * i
            heights = n["bending_at_pivot"], end * n["second_at_pivot"]
            for side, y in (("left", 1.0), ("right", -1.0)):
                beside = y * n["secondary_lateral"]
                k, c = self.own(i, "s", side)
                over = self.body([centre, beside, 0], Z, end, heights)
                under = self.frame(i, np.array([0, beside, 0]), Z)
                self.add(secondary(n, parts, k, c, s), over, under)
                if "longitudinal" in parts:
                    low = self.body([centre, beside, -n["body_lever"]], X, end)
                    high = self.frame(i, np.array([0, beside, n["bogie_lever"]]), X)
                    kappa = n["longitudinal_stiffness"] + n["longitudinal_damping"] * s
                    self.add(kappa, low + n["body_lever"] * section, high)
                if "yaw_dampers" in parts:
                    arm, far = n["body_lever"] - n["yaw_height"], y * n["yaw_lateral"]
                    low = self.body([centre, far, -arm], X, end) + arm * section
                    high = self.frame(i, np.array([0, far, n["bogie_lever"] + n["yaw_height"]]), X)
                    self.add(in_series(n["yaw_damping"] * s, n["yaw_bushing"]), low, high)
                low = self.body([centre, beside, -n["body_lever"]], Y, end)
                high = self.frame(i, np.array([0, beside, n["bogie_lever"]]), Y)
                self.add(n["lateral_stiffness"] + n["lateral_damping"] * s, low, high)
                for axle in (1, 2):
                    self.corner(i, axle, side, y * n["primary_lateral"])
            if "guidance" in parts:
                gamma = n["guidance_stiffness"] * n["healthy_k_p"]
                gamma += n["guidance_damping"] * n["healthy_c_p"] * s
                pitch = np.zeros(SIZE)
                pitch[6 * FRAMES[i] + 4] = n["half_wheelbase"]
                self.add(2 * gamma, pitch)
            roll, over = np.zeros(SIZE), np.zeros(SIZE)
            roll[6 * FRAMES[i] + 3] = over[3] = 1.0
            over[46] = end * n["twist_at_pivot"]
            self.add(n["anti_roll_bar"], over, roll)

    def corner(self, i, axle, side, beside):
        n, wheel = self.n, 2 * i + axle - 1
        ahead, body = self.axles[wheel], WHEELSETS[wheel]
        kappa = primary(n, self.parts, *self.own(i, "p", f"axle{axle}_{side}"), self.s)
        low, end = np.array([0, beside, 0.0]), np.array([ahead, beside, 0.0])
        self.add(kappa, self.frame(i, end, Z), moved(body, low, Z))
        if {"frame_sway", "frame_yaw", "creep"} & set(self.parts):
            kappa = n["guide_stiffness"] + n["guide_damping"] * self.s
            at_axle = self.frame(i, end - n["guide_lever"] * Z, Y)
            self.add(kappa, at_axle, moved(body, low, Y))
        if "creep" in self.parts:
            kappa = n["axle_box_stiffness"] + n["axle_box_damping"] * self.s
            self.add(kappa, self.frame(i, end, X), moved(body, low, X))

    def own(self, i, suspension, place):
        """Return stiffness and damping of a part in SI units."""
        n, names = self.n, (f"k_{suspension}", f"c_{suspension}")
        if i == 1:
            common = [n[f"other_{name}"] * n[f"healthy_{name}"] for name in names]
            return [n[f"other_{name}_{place}"] * v for name, v in zip(names, common, strict=True)]
        ratios = [n[f"{name}_{place}"] * n[f"healthy_{name}_{place}"] for name in names]
        return [r * n[f"healthy_{name}"] for r, name in zip(ratios, names, strict=True)]

    def creep(self):
        """Add the forces of both wheels from the motion of their contacts against the rails."""
        n, s, r = self.n, self.s, self.n["wheel_radius"]
        v, c, size = n["speed"], n["creep_coefficient"], abs(n["speed"])
        for wheel, body in enumerate(WHEELSETS):
            # over all coordinates, then the inputs of the track
            place = np.hstack([moved(body, [0, 0, -r], Y), np.zeros(INPUTS)])
            rails = np.hstack([np.zeros(SIZE), np.eye(INPUTS)[8 + wheel]])
            yaw = np.hstack([moved(body, [0, 1.0, 0], -X), np.zeros(INPUTS)])
            for y in (RAIL_M, -RAIL_M):
                aside = s * place / size - v / size * yaw
                rolled = r + n["conicity"] * y / RAIL_M * (place - rails)  # without its constant
                along = (-s * y * yaw - v / r * (rolled - r)) / size
                for creepage, axis, size_of in ((aside, Y, n["creep_ratio"]), (along, X, 1.0)):
                    at = moved(body, [0, y, -r], axis)
                    force = size_of * c * np.outer(at, creepage)
                    self.system += force[:, :SIZE]
                    self.drive -= force[:, SIZE:]

    def motion(self):
        """Return all coordinates for each input of the wheelsets."""
        led = np.abs(self.led).any(axis=1)
        keep = np.zeros(SIZE, dtype=bool)
        keep[[1, 2, 3, 4]] = True
        keep[5] = "body_yaw" in self.parts
        keep[42] = "bending" in self.parts
        for i, body in enumerate(FRAMES):
            keep[6 * body + 2 : 6 * body + 5] = True
            keep[6 * body + 1] = "frame_sway" in self.parts
            keep[6 * body + 5] = "frame_yaw" in self.parts
            keep[43 + i] = "torsion" in self.parts
        modes = "second_bending", "body_torsion", "equipment"
        keep[45:48] = [part in self.parts for part in modes]
        keep[48:] = [place in self.floors for place in ON_BODY]
        for body in WHEELSETS:
            keep[6 * body + 1] = keep[6 * body + 5] = "creep" in self.parts
            keep[6 * body + 2] = keep[6 * body + 3] = "track" in self.parts
        keep &= ~led
        # wheelset coordinates led by the track are known, all others are locked
        free = (np.eye(SIZE) + self.slaved)[:, keep]
        forces = free.T @ (self.drive - self.system @ self.led)
        return free @ np.linalg.solve(free.T @ self.system @ free, forces) + self.led

    def seen(self, place):
        """Return what a sensor sees over all coordinates."""
        up = self.upwards(place)
        if "cross_axis" not in self.parts:
            return up
        return up + self.n[f"cross_axis_{place}"] * self.aside(place)

    def aside(self, place):
        """Return the motion to the left: of the body's floor, a frame's centre line, an axle."""
        if place.startswith("body"):
            ahead = self.centres[0] + self.vehicle.body_sensor_m
            return self.body([ahead, 0, -self.n["body_lever"]], Y, 1)
        axle = 1 if "axle1" in place else 2
        if place.startswith("frame"):
            ahead = 0.0 if "centre" in place else self.axles[axle - 1]
            return moved(FRAMES[0], [ahead, 0, 0], Y)
        return moved(WHEELSETS[axle - 1], [0, 0, 0], Y)

    def rise(self, place):
        """Return the rise of the body where a sensor is, of its local floor none."""
        n = self.n
        at = [self.centres[0] + self.vehicle.body_sensor_m, sign_of(place) * n["body_lateral"], 0]
        return self.body(at, Z, 1, (n["bending_at_sensor"], n["second_at_sensor"]))

    def upwards(self, place):
        n, y = self.n, sign_of(place)
        if place.startswith("body"):
            is_floor = place in self.floors
            return np.eye(SIZE)[42 + FREE.index(place)] if is_floor else self.rise(place)
        axle = 1 if "axle1" in place else 2
        if place.startswith("frame"):
            ahead = 0.0 if "centre" in place else self.axles[axle - 1]
            return self.frame(0, np.array([ahead, y * n["frame_lateral"], 0]), Z)
        beside = y * n["axle_box_lateral"]
        box = moved(WHEELSETS[axle - 1], [0, beside, 0], Z)
        arm = n["arm_share"] if "axle_box_arm" in self.parts else 0.0
        above = self.frame(0, np.array([self.axles[axle - 1], beside, 0]), Z)
        return (1 - arm) * box + arm * above


def measured(vehicle, train):
    """Return what sensors show of height, angle and lateral place of each wheelset, (m, 12)."""
    n, motion, rows = train.n, train.motion(), []
    for i, place in enumerate(vehicle.sensors):
        row = train.seen(place) @ motion
        if i and "sensors" in vehicle.parts:
            row = row * n[f"gain_{place}"] * cmath.exp(-train.s * n[f"delay_{place}"])
        rows.append(row)
    return np.array(rows)


def sizes(n, s):
    """Return height, angle and lateral place of the track of each input."""
    wave = abs(s / n["speed"]) ** 2
    cross = math.sqrt(n["cross_level"] * wave / (wave + 0.438**2)) / RAIL_M
    return np.array([1.0, cross, math.sqrt(n["alignment"])])


def alone(vehicle, ratios, frequency_hz):
    """Return the responses to each input under one wheelset, (3, 4, n_sensors)."""
    s = 2j * math.pi * frequency_hz
    train = Train(vehicle, ratios, s)
    rows = measured(vehicle, train).T.reshape(3, 4, -1)
    return sizes(train.n, s)[:, None, None] * rows


def channels(vehicle, ratios, frequency_hz):
    """Return the response of each sensor to each input, (n_inputs, n_sensors)."""
    s = 2j * math.pi * frequency_hz
    train = Train(vehicle, ratios, s)
    n, rows = train.n, measured(vehicle, train)
    places = [train.centres[i // 2] + ahead for i, ahead in enumerate(train.axles)]
    delays = np.array([cmath.exp(-s * (places[0] - place) / n["speed"]) for place in places])
    level, cross, aside = sizes(n, s)
    found = [level * rows[:, :4] @ delays, cross * rows[:, 4:8] @ delays]
    if {"frame_sway", "frame_yaw", "creep"} & set(vehicle.parts):
        found.append(aside * rows[:, 8:] @ delays)
    if "wheelsets" in vehicle.parts:
        found += list(math.sqrt(n["wheelset_share"]) * rows[:, :4].T)
        found += list(math.sqrt(n["wheelset_roll_share"]) / RAIL_M * rows[:, 4:8].T)
    return np.array(found)
