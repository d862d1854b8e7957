"""The elements of a rich train: what joins body, bogies, wheelsets and rails, and what wears."""

from __future__ import annotations

import math

import numpy as np
from rich_elements import FREEDOMS, Body, Elements, Matrices, between
from rich_vehicle import RichSystem, bending_shape
from scipy.optimize import approx_fprime, brentq
from vehicles import AM96

N_WHEELS = 4
PROCESSES = ("mean", "cross level", "alignment")
"""Of the track: (left + right) / 2, (left - right) / 2 at the wheels, and aside."""
SENSORS = (
    "axle_box left",
    "axle_box right",
    "bogie left",
    "bogie right",
    "body left",
    "body right",
)
SEVEN = (*SENSORS[:2], "axle_box2 left", "axle_box2 right", *SENSORS[2:4], "body middle")
"""Four axle boxes, two on the frame, one on the body."""
ALL_SENSORS = (*SENSORS, "axle_box2 left", "axle_box2 right", "body middle")

ADDED = (
    *(("ballast", f"track {i}", f) for i in range(N_WHEELS) for f in ("z", "roll")),
    ("torsion", "body", "torsion"),
    *(("frame_torsion", f"bogie {i}", "torsion") for i in (1, 2)),
    ("equipment", "equipment", "z"),
    *(("floors", f"floor {side}", "z") for side in ("left", "middle", "right")),
)
"""Effects with coordinates of their own: effect, body and name of the motion; floors are below the
sensors of the body alone."""
PARTS = (
    *(
        (f"{kind}_p", side, f"axle{axle}")
        for axle in "12"
        for side in ("left", "right")
        for kind in "kc"
    ),
    *((f"{kind}_s", side) for side in ("left", "right") for kind in "kc"),
)
"""Words that tell each of the twelve parts of a bogie."""


def wear(ratios, one_side=False):
    """Return (words, ratio) of the parts of the first bogie for ratios (5,) or (13,)."""
    if len(ratios) == len(PARTS) + 1:
        return [((name, "1", *where), r) for (name, *where), r in zip(PARTS, ratios, strict=False)]
    side = ("left",) if one_side else ()
    names = ("k_p", "c_p", "k_s", "c_s")
    return [((name, "1", *side), ratio) for name, ratio in zip(names, ratios, strict=False)]


class Structure:
    """The elements of a healthy train, worn and laden on demand.

    Parameters
    ----------
    train : RichTrain
    """

    def __init__(self, train):
        self.train, self.effects = train, train.effects
        self.is_elastic = bool(train.effects & {"contact", "ballast"})
        self._name_coordinates()
        self._bodies()
        self.parallel, self.series = Elements(self.n_u), Elements(self.n_u)
        own = np.zeros((2, len(self.mass), self.n_u))
        self._own_stiffness, self._own_damping = own
        for bogie, sign in (("1", 1.0), ("2", -1.0)):
            self._secondary(bogie, sign * train.half_pivot_m)
            for axle, x in (("1", train.half_wheelbase_m), ("2", -train.half_wheelbase_m)):
                self._primary(bogie, axle, x, 2 * (int(bogie) - 1) + int(axle) - 1)
        for wheelset in range(N_WHEELS):
            self._rail(wheelset)
        self._bend()
        self._hang()
        self.series.sort("damper")  # rich_motion.py has them last
        self.sensors = self._sensors()

    def matrices(self, ratios):
        """Return `Matrices` of ratios (5,) or (13,)."""
        mass = self.mass.copy()
        mass[self.laden] *= ratios[-1]
        turning = np.array([one in (("body", "pitch"), ("body", "yaw")) for one in self.names])
        mass[turning] *= ratios[-1] ** (2 * self.train.gyration_exponent)
        if "equipment" in self.effects:  # it hangs below the rest of the body
            mass[self.names.index(("body", "z"))] -= self.train.equipment_kg
        rows, series = self.parallel.rows, self.series.rows
        k, c, k_f, c_f = self.worn(ratios)
        n = len(mass)
        return Matrices(
            mass,
            rows[:, :n].T @ (k[:, None] * rows) + self._own_stiffness,
            rows[:, :n].T @ (c[:, None] * rows) + self._own_damping,
            series,
            k_f,
            c_f,
            self.sensors,
        )

    def worn(self, ratios):
        """Return stiffness and damping of the elements, then of those in series."""
        changes = [*wear(ratios, "one_side" in self.effects), *self.train.unequal()]
        found = []
        for elements in (self.parallel, self.series):
            for kind, values in enumerate((elements.stiffness, elements.damping)):
                values = np.array(values, dtype=float)
                for (name, *where), ratio in changes:
                    # rubber keeps its frequency: its damping follows k_p
                    if kind == "kc".index(name[0]) or (name == "k_p" and elements is self.series):
                        values[elements.where(name, *where)] *= ratio
                self._load(elements, kind, values, ratios[-1])
                found.append(values)
        return found

    def _load(self, elements, kind, values, mass):
        """Let the payload change what depends on it, and the other bogie wear, in place."""
        t = self.train
        other = t.other_k_s, t.other_c_s
        laws = t.stiffness_exponent, t.damping_exponent
        is_damper = elements is self.series  # its stiffness is that of its bushing
        if kind == 1 or not is_damper:
            name = ("k_s", "c_s")[kind]
            values[elements.where(name)] *= mass ** laws[kind]
            values[elements.where(name, "2")] *= other[kind]
        if elements is self.parallel and kind == 0:  # it takes all the body's mass to bend it
            values[elements.where("bending")] *= mass ** (1 - 2 * t.bending_exponent)

    def system(self, ratios):
        """Return the `RichSystem` of ratios (5,): linear equations, and what the laws act on."""
        matrices = self.matrices(ratios)
        stiffness, *_ = self.worn(ratios)
        n, n_f = len(matrices.mass), len(matrices.series)
        a, b_r, b_v = matrices.state_space()
        t = self.train
        springs, friction_n, friction_half_m = [], [], []
        if "friction" in self.effects:
            springs += self.parallel.where("spring").tolist()
            friction_n += (t.friction_share * t.friction_half_m * stiffness[springs]).tolist()
            friction_half_m += [t.friction_half_m] * len(springs)
        if "secondary_friction" in self.effects:
            beside = self.parallel.where("k_s").tolist()
            springs += beside
            friction_n += [t.secondary_friction_n] * len(beside)
            friction_half_m += [t.secondary_friction_half_m] * len(beside)
        rubber = self.parallel.rows[springs]
        has_laws = self.effects & {"blow_off", "rebound", "air_spring"}
        dampers = self.series.where("damper") if has_laws else []
        n_dampers = len(dampers)
        e = np.zeros((len(a), len(rubber) + n_dampers))
        e[n : 2 * n, : len(rubber)] = -rubber[:, :n].T / matrices.mass[:, None]
        e[len(a) - n_dampers :, len(rubber) :] = -np.diag(
            matrices.series_stiffness[n_f - n_dampers :]
        )
        lift = np.zeros((2, len(a)))
        heave = np.array([f == "z" and not body.startswith("track") for body, f in self.names])
        lift[0, :n], lift[1, n : 2 * n] = heave, heave
        damping = matrices.series_damping[n_f - n_dampers :]
        is_choke = np.isin(dampers, self.series.where("choke"))
        rebound = t.rebound_share if "rebound" in self.effects else 0.0
        blow_off = t.blow_off_m_per_s if "blow_off" in self.effects else math.inf
        return RichSystem(
            a,
            b_r,
            b_v,
            e,
            s=np.pad(matrices.sensors[:, :n], ((0, 0), (n, n_f))),
            s_w=matrices.sensors[:, n:],
            lift=lift,
            rubber_x=np.pad(rubber[:, :n], ((0, 0), (0, len(a) - n))),
            rubber_r=-rubber[:, n:],
            friction_n=np.array(friction_n),
            damping=damping,
            blow_off_n=np.where(is_choke, math.inf, blow_off * damping),
            friction_half_m=np.array(friction_half_m),
            rebound=np.where(is_choke, 0.0, rebound),
            exponent=np.where(is_choke, t.choke_exponent, 1.0),
        )

    def _sensors(self):
        """Return what the sensors read, (n, n_u): vertical motion, and a share of the lateral."""
        t, a, arm = self.train, self.train.half_wheelbase_m, self.train.sensor_on_arm
        # an arm is a rigid rod between two points: along it the motion changes evenly
        places = {
            "axle_box": {("wheelset 0", 0.0, 0.0): 1 - arm, ("bogie 1", a, 0.0): arm},
            "axle_box2": {("wheelset 1", 0.0, 0.0): 1 - arm, ("bogie 1", -a, 0.0): arm},
            "bogie": {("bogie 1", a, 0.0): 1.0},
            "body": {("body", t.half_pivot_m, -t.floor_below_m): 1.0},
        }
        rows = []
        for sensor in t.sensors:
            name, side = sensor.split()
            y = {"left": 1, "middle": 0, "right": -1}[side] * t.sensor_half_m
            moved = sum(
                share * self.bodies[body].motion((x, y, z))
                for (body, x, z), share in places[name].items()
            )
            found, aside = moved[2], moved[1]
            if name == "body" and "floors" in self.effects:
                found = self.row[f"floor {side}", "z"]
            rows.append(found + t.of_sensor("cross_axis", sensor) * aside)
        return np.array(rows)

    def _has(self, effect, body):
        """Return whether the train has an effect, a floor only where there is a sensor."""
        is_below = body.replace("floor", "body") in self.train.sensors
        return effect in self.effects and (effect != "floors" or is_below)

    def _name_coordinates(self):
        """Give each motion its column of u."""
        moving = FREEDOMS if self.is_elastic else ("y", "yaw")
        moving = [name for name in moving if name != "pitch"]
        names = [(body, f) for body in ("body", "bogie 1", "bogie 2") for f in FREEDOMS]
        names += [(f"wheelset {i}", f) for i in range(N_WHEELS) for f in moving]
        names += [("body", b) for b in ("bending", "second_bending") if b in self.effects]
        names += [(one, f) for effect, one, f in ADDED if self._has(effect, one)]
        self.names = names
        self.n_u = len(names) + N_WHEELS * self.train.n_processes
        self.row = dict(zip(names, np.eye(self.n_u), strict=False))
        for i in range(N_WHEELS):
            for p, (name, scale) in enumerate(
                (("z", 1.0), ("roll", 1 / self.train.contact_half_m), ("y", 1.0))
            ):
                column = len(names) + N_WHEELS * p + i
                held = p < self.train.n_processes
                row = scale * np.eye(self.n_u)[column] if held else np.zeros(self.n_u)
                self.row[f"rail {i}", name] = row
                if not self.is_elastic and name != "y":
                    self.row[f"wheelset {i}", name] = row

    def _bodies(self):
        """Set bodies, masses, and which of the masses carry the payload."""
        t = self.train
        shapes = []
        if "bending" in self.effects:
            shapes.append((self.row["body", "bending"], beam(t.body_length_m, bending_shape)))
        if "second_bending" in self.effects:
            shape = beam(t.second_bending_length_m, second_bending_shape)
            shapes.append((self.row["body", "second_bending"], shape))
        body, bogie = 4 * AM96.body_mass_kg, 2 * t.bogie_mass * AM96.bogie_mass_kg
        centre = np.array([t.load_x_m, t.load_y_m, 0.0])
        if "equipment" in self.effects:  # body and equipment balance about the middle of the body
            share = t.equipment_kg / (body - t.equipment_kg)
            centre -= share * np.array([t.equipment_x_m, t.equipment_y_m, 0.0])
        names = dict.fromkeys(body for body, _ in self.row)
        self.bodies = {
            name: Body(
                {f: self.row[name, f] for f in FREEDOMS if (name, f) in self.row},
                tuple(shapes) if name == "body" else (),
                self._warps(name),
                tuple(centre.tolist()) if name == "body" else (0.0, 0.0, 0.0),
            )
            for name in names
        }
        pitch = t.body_gyration * AM96.body_gyration_m
        bogie_pitch = t.bogie_gyration * AM96.bogie_gyration_m
        gyrations = {
            "body": {"roll": t.body_roll_gyration_m, "pitch": pitch, "yaw": pitch},
            "bogie": {
                "roll": t.bogie_roll_gyration_m,
                "pitch": bogie_pitch,
                "yaw": t.yaw_gyration_m,
            },
            "wheelset": {"roll": t.wheelset_gyration_m, "yaw": t.wheelset_gyration_m},
            "track": {"roll": t.contact_half_m},
        }
        gyrations["body"]["torsion"] = t.body_roll_gyration_m
        # the shape of a frame's twist is 1 at the springs
        turned = bogie_pitch * t.bogie_roll_gyration_m
        gyrations["bogie"]["torsion"] = turned / (t.half_wheelbase_m * t.primary_half_m)
        masses = {"body": body, "bogie": bogie, "wheelset": t.wheelset_kg, "track": t.track_kg}
        masses |= {"equipment": t.equipment_kg, "floor": t.floors_kg}
        kinds = [(name.split()[0], freedom) for name, freedom in self.names]
        self.mass = np.array([masses[k] * gyrations.get(k, {}).get(f, 1.0) ** 2 for k, f in kinds])
        self.laden = np.array([kind == "body" for kind, _ in kinds])

    def _warps(self, name):
        """Return how torsion moves the points of a body or a frame."""
        if (name, "torsion") not in self.row:
            return ()
        t = self.train
        corner = t.half_wheelbase_m * t.primary_half_m

        def twisted(point):
            twist = torsion_shape(point[0], t.body_length_m)
            return np.array([0.0, -twist * point[2], twist * point[1]])

        def warped(point):
            return np.array([0.0, 0.0, point[0] * point[1] / corner])

        return ((self.row[name, "torsion"], twisted if name == "body" else warped),)

    def _join(self, one, its_point, other, other_point, direction, k, c, label):
        """Add a spring with a damper beside it."""
        stretch = between(self.bodies[one], its_point, self.bodies[other], other_point, direction)
        self.parallel.add(stretch, k, c, label)
        return stretch

    def _damper(self, stretch, c, bushing, label):
        """Add a damper, in series with its bushing where there are any."""
        if self.effects & {"bushings", "blow_off", "rebound", "air_spring"}:
            self.series.add(stretch, bushing, c, f"{label} damper")
        else:
            self.parallel.add(stretch, 0.0, c, label)

    def _secondary(self, bogie, x):
        """Add springs and dampers between body and bogie."""
        t, frame = self.train, f"bogie {bogie}"
        down, up = (t.body_arm_m, t.bogie_arm_m) if "longitudinal" in self.effects else (0.0, 0.0)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            y = sign * t.secondary_half_m
            where = f"{bogie} {side}"
            top, bottom = (x, y, -t.body_arm_m), (0.0, y, t.bogie_arm_m)
            k_s = t.k_s * AM96.secondary_stiffness_n_per_m
            stretch = self._join("body", top, frame, bottom, (0, 0, 1), k_s, 0.0, f"k_s {where}")
            c_s = t.c_s * AM96.secondary_damping_ns_per_m
            series, what = t.secondary_bushing_n_per_m, ""
            if "air_spring" in self.effects:
                series, what = t.closed_choke * k_s, " choke"
            self._damper(stretch, c_s, series, f"c_s {where}{what}")
            lateral = t.lateral_n_per_m, t.lateral_ns_per_m, "lateral"
            self._join("body", top, frame, bottom, (0, 1, 0), *lateral)
            along = t.longitudinal_n_per_m, t.longitudinal_ns_per_m, "longitudinal"
            self._join("body", (x, y, -down), frame, (0.0, y, up), (1, 0, 0), *along)
        twist = self.row["body", "roll"] - self.row[frame, "roll"]
        if "torsion" in self.effects:
            twist = twist + torsion_shape(x, t.body_length_m) * self.row["body", "torsion"]
        self.parallel.add(twist, t.anti_roll_nm, 0.0, "anti-roll bar")

    def _primary(self, bogie, its_axle, x, wheelset):
        """Add springs and dampers between bogie and one of its wheelsets."""
        t, frame, axle = self.train, f"bogie {bogie}", f"wheelset {wheelset}"
        height = -t.guidance_height_m if "guidance" in self.effects else 0.0
        for side, sign in (("left", 1.0), ("right", -1.0)):
            y = sign * t.primary_half_m
            where, box = f"{bogie} {side} axle{its_axle}", (0.0, y, 0.0)
            k_p = 0.5 * t.k_p * AM96.primary_stiffness_n_per_m
            top = (x, y, -t.axle_below_m)
            stretch = self._join(frame, top, axle, box, (0, 0, 1), k_p, 0.0, f"k_p {where} spring")
            c_p = 0.5 * t.c_p * AM96.primary_damping_ns_per_m
            self._damper(stretch, c_p, t.primary_bushing_n_per_m, f"c_p {where}")
            if "rubber" in self.effects:
                k = t.maxwell_share * k_p
                c = k / (2 * math.pi * t.maxwell_hz)
                self.series.add(stretch, k, c, f"k_p {where}")
            lateral = t.primary_lateral_n_per_m, 0.0, "guidance"
            self._join(frame, top, axle, box, (0, 1, 0), *lateral)
            along = t.guidance_n_per_m, t.guidance_ns_per_m, "guidance"
            self._join(frame, (x, y, height), axle, box, (1, 0, 0), *along)

    def _rail(self, wheelset):
        """Let a wheelset run on the rails: creep, conicity, gravity, contact."""
        t, name, rail = self.train, f"wheelset {wheelset}", f"rail {wheelset}"
        yaw, half = self.row[name, "yaw"], t.contact_half_m
        # of the contacts, which lie a wheel's radius below the axle
        low = self.bodies[name].motion((0.0, 0.0, -t.wheel_radius_m))[1]
        aside = low - self.row[rail, "y"]
        self.parallel.add(aside, t.gravity_n_per_m, 0.0, "gravity")
        n, j = len(self.names), self.names.index((name, "yaw"))
        # creepages of two wheels: y' / v - psi aside, l psi' / v + conicity (y - y_r) / r_0 ahead;
        # in reverse psi and conicity act the other way, as v is negative and forces oppose slip
        ahead = -2 * t.creep_n if t.reverse else 2 * t.creep_n
        self._own_damping += 2 * t.creep_n / t.speed_m_per_s * np.outer(low[:n], low)
        self._own_stiffness -= ahead * np.outer(low[:n], yaw)
        self._own_damping[j] += 2 * t.creep_n * half**2 / t.speed_m_per_s * yaw
        self._own_stiffness[j] += ahead * t.conicity * half / t.wheel_radius_m * aside
        if self.is_elastic:
            for sign in (1.0, -1.0):
                point = (0.0, sign * half, 0.0)
                values = t.contact_n_per_m, t.contact_ns_per_m, "contact"
                if "ballast" not in self.effects:
                    self._join(name, point, rail, point, (0, 0, 1), *values)
                    continue
                # unevenness lies between wheel and rail; the rail moves on the ballast by itself
                sunk = self.bodies[f"track {wheelset}"].motion(point)[2]
                above = self.bodies[name].motion(point)[2] - self.bodies[rail].motion(point)[2]
                self.parallel.add(above - sunk, *values)
                bed = t.ballast_n_per_m / 2, t.ballast_ns_per_m / 2, "ballast"
                self.parallel.add(sunk, *bed)

    def _bend(self):
        """Give the bendings of the body their own stiffness and damping."""
        t, empty = self.train, 4 * AM96.body_mass_kg
        for name in ("bending", "second_bending"):
            if name in self.effects:  # payload adds mass, not stiffness
                omega = 2 * math.pi * getattr(t, f"{name}_hz")
                damping = 2 * getattr(t, f"{name}_damping") * empty * omega
                self.parallel.add(self.row["body", name], empty * omega**2, damping, name)

    def _hang(self):
        """Give torsions, equipment and floors their springs and dampers."""
        t, masses = self.train, dict(zip(self.names, self.mass, strict=True))
        places = {"equipment": (t.equipment_x_m, t.equipment_y_m)}
        for side, sign in (("left", 1.0), ("middle", 0.0), ("right", -1.0)):
            places[f"floor {side}"] = (t.half_pivot_m, sign * t.sensor_half_m)
        for effect, name, freedom in ADDED:
            if effect == "ballast" or not self._has(effect, name):
                continue
            row, mass = self.row[name, freedom], masses[name, freedom]
            if name in places:
                row = self.bodies["body"].motion((*places[name], -t.floor_below_m))[2] - row
            hz = t.floors_right_hz if name == "floor right" else getattr(t, f"{effect}_hz")
            omega, damping = 2 * math.pi * hz, getattr(t, f"{effect}_damping")
            self.parallel.add(row, mass * omega**2, 2 * damping * mass * omega, effect)


def torsion_shape(x_m, length_m):
    """Return the first torsion of a free uniform bar at x from its centre; its mean square is 1."""
    return math.sqrt(2) * math.sin(math.pi * x_m / length_m)


def second_bending_shape(x_m, length_m):
    """Return a free beam's second bending at x from its centre; see `bending_shape`."""
    root = brentq(lambda v: math.cosh(v) * math.cos(v) - 1, 7.5, 8.2)
    place = root * np.asarray(x_m) / length_m
    return np.sin(place) / math.sin(root / 2) + np.sinh(place) / math.sinh(root / 2)


def beam(length_m, shape):
    """Return what gives deflection and slope of a shape at x."""

    def at(x):
        slope = approx_fprime(np.array([x]), lambda v: float(shape(v[0], length_m)), 1e-5)[0]
        return float(shape(x, length_m)), slope

    return at
