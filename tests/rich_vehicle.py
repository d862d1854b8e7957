"""A vehicle richer than the one that suspnet is trained for, as equations of motion.

Coordinates: heave z [m] and pitch times half pivot distance of the half body, heave and pitch times
half wheelbase of the measured (leading) and of the other bogie; then, where switched on, the body's
bending and the four wheelsets. Springs and dampers are elements with a stretch s = G q - T r over
coordinates q and track r. Dampers with a bushing and rubber have a force F of their own::

    M q'' + C q' + K q = G^T (k T r + c T r') - G^T F - G^T F_friction,
    F' = k_series (s' - F / c - e(F)),   e(F) = (1 / c_after - 1 / c) (F - F_blow_off) beyond it

All but the friction and the excess velocity e is linear; rich_motion.py steps it in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from trips_reference import pitching_numbers
from vehicles import AM96

N_WHEELS = 4
SECONDARY, PRIMARY = slice(0, 2), slice(2, 6)
"""Elements: two secondary suspensions, four primary ones; four contacts may follow."""


@dataclass(frozen=True)
class RichVehicle:
    """What the vehicle has beyond body, bogies, springs and viscous dampers.

    The ratios of k_p scale all parts of the rubber, those of c the damper's law but not its
    bushing. "Assumed" marks what has no source.
    """

    bending: bool = False
    dampers: bool = False
    rubber: bool = False
    contact: bool = False
    # First bending of the body: 6 to 12 Hz for long light bodies (Dumitriu et al., Appl. Sci. 14,
    # 2024, 4687), damping 1.5 to 2 % (Zhou et al., Proc. IMechE F 223, 2009).
    bending_hz: float = 9.0  # of the free body without payload
    bending_damping: float = 0.015
    body_length_m: float = 26.6  # a CRH1A's middle car, assumed
    # Bushings: the Manchester benchmark (Iwnicki, Veh. Syst. Dyn. 30, 1998), one damper each.
    secondary_series_n_per_m: float = 6e6
    primary_series_n_per_m: float = 1e6
    blow_off_m_per_s: float = 0.1  # assumed; the rms is 0.04 (secondary) and 0.08 (primary)
    slope_after: float = 0.2  # assumed; of the damper's law beyond blow-off
    # Rubber, shares of the primary spring's stiffness, its elastic part: Maxwell branch and Berg's
    # friction (Veh. Syst. Dyn. 30, 1998). Assumed: loss factor 0.05 and more, 5 to 15 % stiffer.
    maxwell_share: float = 0.1
    maxwell_hz: float = 5.0
    friction_share: float = 0.1  # stiffness at a reversal, F_max / x_2
    friction_half_m: float = 1e-3  # x_2, the stretch at which half of F_max is reached
    # Half a wheelset on one rail: 1400 to 1844 kg in public models, contact with damping 990e6 N/m
    # and 100e3 N s/m (DLR-SR AdvancedNoise); 1.0 to 1.4e9 N/m is usual for a wheel.
    wheel_mass_kg: float = 800.0
    contact_n_per_m: float = 1.2e9
    contact_ns_per_m: float = 1e5

    def build(self, ratios):
        """Return the equations of one AM96; see `build`."""
        return build(ratios, self)


@dataclass(frozen=True)
class RichSystem:
    """x' = A x + B_r r + B_v r' + E n, accelerations S x' + S_w r'' of box, frame and body.

    x = (q, q', F of the rubber, F of the dampers), n = (friction, excess velocity). Several systems
    stacked have a leading axis.
    """

    a: np.ndarray  # (n_states, n_states)
    b_r: np.ndarray  # (n_states, 4)
    b_v: np.ndarray
    e: np.ndarray  # (n_states, n_nonlinear)
    s: np.ndarray  # (3, n_states)
    s_w: np.ndarray  # (3, 4)
    lift: np.ndarray  # x of a vehicle that rises by 1 m, or at 1 m/s, (2, n_states)
    rubber_x: np.ndarray  # stretch of the rubber springs from x, (n_friction, n_states)
    rubber_r: np.ndarray  # and from r, (n_friction, 4)
    friction_n: np.ndarray  # F_max, (n_friction,)
    damping: np.ndarray  # c of each damper, (n_dampers,)
    blow_off_n: np.ndarray  # (n_dampers,)
    friction_half_m: np.ndarray  # x_2, (n_friction,)
    rebound: np.ndarray  # how much stronger a damper is in rebound, weaker in compression
    exponent: np.ndarray  # of a damper's velocity in its force, (n_dampers,)


def bending_shape(x_m, length_m):
    """Return the first bending of a free uniform beam at x from its centre; its mean square is 1.

    With this the modal mass is the body's.
    """
    root = brentq(lambda v: math.cosh(v) * math.cos(v) - 1, 4.5, 5.0)
    place = root * np.asarray(x_m) / length_m  # symmetric: hyperbolic and trigonometric cosine
    return np.cos(place) / math.cos(root / 2) + np.cosh(place) / math.cosh(root / 2)


def build(ratios, rich):
    """Return the equations of one AM96.

    Parameters
    ----------
    ratios : sequence of 5 or 15 floats, [-]
        ``PARAMETERS`` and, if given, ``UNMEASURED``.
    rich : RichVehicle
    """
    numbers = pitching_numbers(AM96, ratios, 1.0)  # the speed plays no part
    stretch, ground, stiffness, damping = _elements(numbers, rich)
    mass, modal_stiffness, modal_damping = _modes(numbers, rich)
    dampers = damping[:6] * rich.dampers
    damping[:6] -= dampers
    elements, series, rates = _forces(stiffness, dampers, rich)
    size = len(mass)
    # rows that pick q, q' and F from x
    q, v, f = np.split(np.eye(2 * size + len(series)), [size, 2 * size])
    push = stretch.T / mass[:, None]  # accelerations from the elements' forces
    a = q.T @ v
    a -= v.T @ (push @ (stiffness[:, None] * stretch) + np.diag(modal_stiffness / mass)) @ q
    a -= v.T @ (push @ (damping[:, None] * stretch) + np.diag(modal_damping / mass)) @ v
    a -= v.T @ push[:, elements] @ f
    a += f.T @ (series[:, None] * stretch[elements] @ v - rates[:, None] * f)
    n_friction, n_dampers = N_WHEELS * rich.rubber, 6 * rich.dampers
    friction = -v.T @ push[:, PRIMARY][:, :n_friction]
    excess = (-f.T * series)[:, n_friction:]
    s, s_w = _sensors(stretch, v, rich)
    heave = np.isin(np.arange(size), [0, 2, 4, *range(size - N_WHEELS * rich.contact, size)])
    f_max = rich.friction_share * rich.friction_half_m * stiffness[PRIMARY]
    return RichSystem(
        a=a,
        b_r=v.T @ push @ (stiffness[:, None] * ground),
        b_v=v.T @ push @ (damping[:, None] * ground) - f.T @ (series[:, None] * ground[elements]),
        e=np.hstack([friction, excess]),
        s=s,
        s_w=s_w,
        lift=np.stack([heave @ q, heave @ v]),
        rubber_x=stretch[PRIMARY][:n_friction] @ q,
        rubber_r=ground[PRIMARY][:n_friction],
        friction_n=f_max[:n_friction],
        damping=dampers[:n_dampers],
        blow_off_n=rich.blow_off_m_per_s * dampers[:n_dampers],
        friction_half_m=np.full(n_friction, rich.friction_half_m),
        rebound=np.zeros(n_dampers),
        exponent=np.ones(n_dampers),
    )


def _elements(numbers, rich):
    """Return G, T, k and c of the suspensions and, if there are any, of the contacts."""
    size = 6 + rich.bending + N_WHEELS * rich.contact
    stretch, ground = np.zeros((6, size)), np.zeros((6, N_WHEELS))
    stiffness, damping = np.zeros(6), np.zeros(6)
    for side, (name, row, sign) in enumerate((("measured", 2, 1.0), ("other", 4, -1.0))):
        k_p, c_p, k_s, c_s = numbers[name]
        stretch[side, [0, 1, row]] = 1.0, sign, -1.0
        stiffness[side], damping[side] = k_s, c_s
        for axle, arm in enumerate((1.0, -1.0)):
            wheel = 2 * side + axle
            stretch[2 + wheel, [row, row + 1]] = 1.0, arm
            ground[2 + wheel, wheel] = 1.0
            stiffness[2 + wheel], damping[2 + wheel] = k_p / 2, c_p / 2
    if rich.bending:
        stretch[SECONDARY, 6] = bending_shape(numbers["L"], rich.body_length_m)
    if rich.contact:
        stretch[PRIMARY, -N_WHEELS:], ground[PRIMARY] = -np.eye(N_WHEELS), 0.0
        stretch = np.vstack([stretch, np.eye(N_WHEELS, size, size - N_WHEELS)])
        ground = np.vstack([ground, np.eye(N_WHEELS)])
        stiffness = np.append(stiffness, [rich.contact_n_per_m] * N_WHEELS)
        damping = np.append(damping, [rich.contact_ns_per_m] * N_WHEELS)
    return stretch, ground, stiffness, damping


def _modes(numbers, rich):
    """Return mass, stiffness and damping of each coordinate by itself."""
    body, bogie = numbers["half_body_kg"], numbers["bogie_kg"]
    pitch = bogie * (numbers["bogie_gyration"] / numbers["a"]) ** 2
    mass = [body, body * (numbers["body_gyration"] / numbers["L"]) ** 2, *[bogie, pitch] * 2]
    omega, empty = 2 * math.pi * rich.bending_hz, 2 * AM96.body_mass_kg
    # payload adds mass, not stiffness
    bending = [(body, empty * omega**2, 2 * rich.bending_damping * empty * omega)] * rich.bending
    wheels = [(rich.wheel_mass_kg, 0.0, 0.0)] * (N_WHEELS * rich.contact)
    return np.array([*((m, 0.0, 0.0) for m in mass), *bending, *wheels]).T


def _forces(stiffness, dampers, rich):
    """Return the elements with a force of their own, its series stiffness and k_series / c."""
    elements, series, rates = [], [], []
    if rich.rubber:
        elements += range(2, 6)
        series += (rich.maxwell_share * stiffness[PRIMARY]).tolist()
        rates += [2 * math.pi * rich.maxwell_hz] * N_WHEELS
    if rich.dampers:
        bushings = [rich.secondary_series_n_per_m] * 2 + [rich.primary_series_n_per_m] * 4
        elements += range(6)
        series += bushings
        rates += (bushings / dampers).tolist()
    return np.array(elements, dtype=int), np.array(series), np.array(rates)


def _sensors(stretch, v, rich):
    """Return S and S_w: the box on the wheelset or track, the frame above it, the body above."""
    box, frame, body = np.zeros((3, stretch.shape[1]))
    frame[[2, 3]] = 1.0
    body[:] = stretch[0]
    body[2] = 0.0
    s_w = np.zeros((3, N_WHEELS))
    if rich.contact:
        box[-N_WHEELS] = 1.0
    else:
        s_w[0, 0] = 1.0
    return np.stack([box, frame, body]) @ v, s_w
