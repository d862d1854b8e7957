"""A train in three dimensions, richer than the family of vehicles that suspnet is trained for.

Body and two bogies move along y and z, roll, pitch and yaw; four wheelsets move along y and yaw,
and along z and in roll where the contact is elastic; the body bends. 32 degrees of freedom, 47
with all effects of rich_effects.py, from elements between points in space (rich_structure.py),
about the centres of gravity.

Numbers without a source are assumed. Those of the Manchester benchmark's size (Iwnicki, Veh. Syst.
Dyn. 30, 1998; its text was not at hand) say so; masses, suspensions and lengths are the AM96's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from rich_effects import EFFECTS, FAMILY, LAWS, SCATTER, SHIFTS, UNEQUAL
from rich_structure import ALL_SENSORS, PARTS, PROCESSES, SENSORS, Structure
from vehicles import AM96


@dataclass(frozen=True)
class RichTrain:
    """The true numbers of one train; ratios of wear are relative to them.

    Suspensions, masses and lengths of the AM96 are factors, all else is in SI units.
    """

    effects: frozenset = frozenset()
    sensors: tuple = SENSORS
    speed_m_per_s: float = 70.0
    reverse: bool = False

    k_p: float = 1.0
    c_p: float = 1.0
    k_s: float = 1.0
    c_s: float = 1.0
    bogie_mass: float = 1.0
    body_gyration: float = 1.0
    bogie_gyration: float = 1.0
    half_wheelbase: float = 1.0
    half_pivot_distance: float = 1.0
    # One damper a primary spring, one a secondary one; Manchester benchmark
    primary_bushing_n_per_m: float = 1e6
    secondary_bushing_n_per_m: float = 6e6
    # Share of the primary spring; loss factor 0.05 at 5 Hz
    maxwell_share: float = 0.1
    maxwell_hz: float = 5.0
    # Bushing of each axle box along x, below the bogie's centre: 0.1 of k_p a^2 and of c_p a^2
    guidance_n_per_m: float = 1e7
    guidance_ns_per_m: float = 2.9e4
    guidance_height_m: float = 0.108
    # Secondary spring and yaw damper of a side along x, below the body's, above the bogie's centre
    longitudinal_n_per_m: float = 1.6e5
    longitudinal_ns_per_m: float = 1e4
    body_arm_m: float = 0.75
    bogie_arm_m: float = 0.42
    # Free body without payload: 6 to 12 Hz (Dumitriu et al., Appl. Sci. 14, 2024, 4687), damping
    # 1.5 to 2 % (Zhou et al., Proc. IMechE F 223, 2009)
    bending_hz: float = 10.0
    bending_damping: float = 0.015
    body_length_m: float = 26.6
    # A uniform beam has it at 2.76 times the first, with nodes 0.3 m from the pivots; real bodies,
    # with doors and equipment, are no such beams: lower, the shape of a shorter one
    second_bending_hz: float = 13.0
    second_bending_damping: float = 0.02
    second_bending_length_m: float = 22.0
    # Across the train; Manchester benchmark's size
    primary_half_m: float = 1.0
    secondary_half_m: float = 1.0
    sensor_half_m: float = 1.0
    body_roll_gyration_m: float = 1.33
    bogie_roll_gyration_m: float = 0.8
    yaw_gyration_m: float = 1.1  # bogie; the body's is that of its pitch
    anti_roll_nm: float = 0.94e6  # a bogie
    lateral_n_per_m: float = 1.6e5  # a side
    lateral_ns_per_m: float = 1.6e4
    primary_lateral_n_per_m: float = 3.9e6  # an axle box
    axle_below_m: float = 0.14  # the wheelset's centre below the bogie's
    # Wheelset of two wheels; linear creep and conicity, a spring for gravity
    wheelset_kg: float = 1600.0
    wheelset_gyration_m: float = 0.79
    wheel_radius_m: float = 0.46
    contact_half_m: float = 0.75
    creep_n: float = 8e6
    conicity: float = 0.05
    gravity_n_per_m: float = 2e5
    # Of a wheel: 1.0 to 1.4e9 N/m is usual; 100e3 N s/m in DLR-SR AdvancedNoise
    contact_n_per_m: float = 1.2e9
    contact_ns_per_m: float = 1e5
    # Processes of the track, as factors of the German spectra
    cross_level: float = 1.0
    alignment: float = 1.0
    # Exponents of the mass of the laden body over that of the empty one
    bending_exponent: float = 0.5  # of the frequency, downwards: the payload stiffens nothing
    gyration_exponent: float = 0.0
    stiffness_exponent: float = 0.0  # secondary; 0.7 of air springs
    damping_exponent: float = 0.0
    # Sensors, in the order of rich_structure.ALL_SENSORS: gain, and how late each is
    sensitivity_0: float = 1.0
    sensitivity_1: float = 1.0
    sensitivity_2: float = 1.0
    sensitivity_3: float = 1.0
    sensitivity_4: float = 1.0
    sensitivity_5: float = 1.0
    sensitivity_6: float = 1.0
    sensitivity_7: float = 1.0
    sensitivity_8: float = 1.0
    late_s_0: float = 0.0
    late_s_1: float = 0.0
    late_s_2: float = 0.0
    late_s_3: float = 0.0
    late_s_4: float = 0.0
    late_s_5: float = 0.0
    late_s_6: float = 0.0
    late_s_7: float = 0.0
    late_s_8: float = 0.0
    # Excitation of each wheelset alone, as a share of the mean track's density
    wheelset_share: float = 0.0
    # Axle boxes' sensors on their arms: at the axle (0), at the frame above (1), beyond (below 0)
    sensor_on_arm: float = 0.0
    # Secondary suspension of the bogie that is not measured
    other_k_s: float = 1.0
    other_c_s: float = 1.0
    # Each spring and damper of both bogies, in the order of rich_structure.PARTS; none: equal ones
    parts: tuple = ()
    # Laws of rich_motion.py
    blow_off_m_per_s: float = 0.1
    slope_after: float = 0.2
    friction_share: float = 0.1
    friction_half_m: float = 1e-3
    # A vertical damper's force in rebound is stronger, in compression weaker by this share
    rebound_share: float = 0.15
    # Dry friction beside each secondary spring: seals of its damper and joints of the anti-roll bar
    secondary_friction_n: float = 120.0
    secondary_friction_half_m: float = 5e-4
    # Air spring (Berg, Veh. Syst. Dyn. 33 suppl., 1999): with its reservoir it has k_s, with a
    # closed choke that much more; the choke, F ~ v^1.8, takes the place of the damper and has c_s
    # at 0.05 m/s. A reservoir as large as the bag: 1
    closed_choke: float = 1.2
    choke_exponent: float = 1.8
    # First torsion of the body: 8 to 13 Hz, near the first bending
    torsion_hz: float = 10.0
    torsion_damping: float = 0.02
    # Converter or transformer hung below the floor, as a vibration absorber of the first bending
    # (Gong et al., J. Mech. Eng. 52/18, 2016); its place is relative to the body's middle
    equipment_kg: float = 3000.0
    equipment_hz: float = 7.0
    equipment_damping: float = 0.06
    equipment_x_m: float = 2.0
    equipment_y_m: float = 0.2
    # Twist of the frame, z ~ x y: 5 to 20 % of that of the primary springs below it
    frame_torsion_hz: float = 30.0
    frame_torsion_damping: float = 0.02
    # Floor on elastic supports below each sensor of the body: stiff ones amplify 20 to 50 Hz
    # (Gong et al., J. Tongji Univ. 45, 2017); floating floors, which are meant here, are softer
    floors_kg: float = 40.0
    floors_hz: float = 14.0
    floors_right_hz: float = 14.0
    floors_damping: float = 0.06
    floor_below_m: float = 0.6  # below the body's centre: Manchester benchmark's size
    # Under a wheelset: the track of TTB-2D (Cantero, SoftwareX 20, 2022) yields so; the mass
    # that moves along is 3 / (2 beta) of rails and sleepers, 653 kg/m on Zimmermann's beam with
    # beta = (K / (8 E I))^(1/3) = 0.96 per m
    ballast_n_per_m: float = 9e7
    ballast_ns_per_m: float = 2e5
    track_kg: float = 1000.0
    # Share of the lateral acceleration that each sensor reads: transverse sensitivity of 1 to 5 %
    # in data sheets, 1.7 % a degree of tilt
    cross_axis_0: float = 0.0
    cross_axis_1: float = 0.0
    cross_axis_2: float = 0.0
    cross_axis_3: float = 0.0
    cross_axis_4: float = 0.0
    cross_axis_5: float = 0.0
    cross_axis_6: float = 0.0
    cross_axis_7: float = 0.0
    cross_axis_8: float = 0.0
    # Wheels out of round (rich_line.py) are drawn from it
    wheels_seed: int = 0
    # The laden body's centre of gravity, of one trip
    load_x_m: float = 0.0
    load_y_m: float = 0.0

    def __post_init__(self):
        unknown = sorted(set(self.effects) - set(EFFECTS))
        if unknown:
            raise ValueError(f"`effects` must be some of {EFFECTS}, got {unknown}")
        object.__setattr__(self, "effects", frozenset(self.effects))

    @classmethod
    def scattered(cls, seed, effects=FAMILY, **changes):
        """Return a train with true numbers of its own for the effects that it has.

        Each number depends on the seed and its name alone, whatever the effects.
        """
        plain = cls()
        rng = np.random.default_rng([seed, 12])
        draws = {
            name: (group, getattr(plain, name) * math.exp(width * rng.uniform(-1, 1)))
            for group, widths in SCATTER.items()
            for name, width in widths.items()
        }
        for group, ranges in SHIFTS.items():
            own = np.random.default_rng([seed, 13, *group.encode()])
            draws |= {name: (group, own.uniform(*ends)) for name, ends in ranges.items()}
        found = {name: value for name, (group, value) in draws.items() if group in effects}
        if "unequal" in effects:
            own = np.random.default_rng([seed, 14])
            found["parts"] = tuple(np.exp(UNEQUAL * own.standard_normal(2 * len(PARTS))).tolist())
        if "out_of_round" in effects:
            found["wheels_seed"] = seed
        return cls(effects=frozenset(effects), **(found | changes))

    def unequal(self):
        """Return (words, ratio) of each part over what it should be."""
        words = [(name, bogie, *where) for bogie in "12" for name, *where in PARTS]
        return list(zip(words, self.parts or [1.0] * len(words), strict=True))

    def at(self, speed_m_per_s):
        """Return the train at another speed."""
        return replace(self, speed_m_per_s=float(speed_m_per_s))

    def numbers(self):
        """Return every number by its name."""
        return {f.name: getattr(self, f.name) for f in fields(self)[4:]}

    @property
    def n_processes(self):
        """Return how many processes of the track drive the train."""
        return len(PROCESSES) if "roll" in self.effects else 1

    @cached_property
    def half_wheelbase_m(self):
        """Return half the wheelbase, [m]."""
        return self.half_wheelbase * AM96.half_wheelbase_m

    @cached_property
    def half_pivot_m(self):
        """Return half the distance of the pivots, [m]."""
        return self.half_pivot_distance * AM96.half_pivot_distance_m

    @property
    def behind_m(self):
        """Return how far each wheelset runs behind the first, the measured one, (4,) [m].

        In reverse the others run ahead.
        """
        a, pivot = self.half_wheelbase_m, self.half_pivot_m
        behind = np.array([0.0, 2 * a, 2 * pivot, 2 * pivot + 2 * a])
        return -behind if self.reverse else behind

    def phasors(self, frequencies_hz):
        """Return the inputs r of each process of unit size at the first wheelset.

        Complex of shape (n_freq, 4 n_processes, n_processes).
        """
        delay = self.behind_m / self.speed_m_per_s
        late = np.exp(-2j * np.pi * np.asarray(frequencies_hz)[:, None] * delay)
        eye = np.eye(self.n_processes)
        return (eye[:, None, :] * late[:, None, :, None]).reshape(len(late), -1, len(eye))

    def alone(self, frequencies_hz):
        """Return the inputs of each wheelset's own excitation, (n_freq, 4 n_processes, 4)."""
        return np.tile(np.eye(4 * self.n_processes, 4), (len(frequencies_hz), 1, 1))

    def gains(self, frequencies_hz):
        """Return what each sensor makes of the acceleration under it, complex (n_freq, n)."""
        size = np.array([self.of_sensor("sensitivity", sensor) for sensor in self.sensors])
        late_s = np.array([self.of_sensor("late_s", sensor) for sensor in self.sensors])
        return size * np.exp(-2j * np.pi * np.outer(frequencies_hz, late_s))

    def of_sensor(self, name, sensor):
        """Return a number of one sensor."""
        return getattr(self, f"{name}_{ALL_SENSORS.index(sensor)}")

    def matrices(self, ratios):
        """Return the equations of motion with a worn first bogie.

        Parameters
        ----------
        ratios : array of shape (5,) or (13,), [-]
            k_p, c_p, k_s, c_s relative to the train's own, or each of rich_structure.PARTS; M_s
            relative to nominal.
        """
        return self._structure.matrices(np.asarray(ratios, dtype=float))

    def build(self, ratios):
        """Return the equations of motion with the laws of rich_motion.py, a `RichSystem`."""
        return self._structure.system(np.asarray(ratios, dtype=float))

    @property
    def is_linear(self):
        """Return whether spectra and modes hold all that the train has."""
        return not self.effects & set(LAWS)

    @cached_property
    def _structure(self):
        return Structure(self)
