"""Rich vehicles stepped in time: many trips together, one exact linear step after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from rich_vehicle import RichSystem
from scipy.linalg import expm

BLOCK = 2048
"""Samples whose inputs and outputs are computed at once."""
CHOKE_M_PER_S = 0.05
"""Velocity at which a choke has the damping c; the rms of a secondary damper is 0.04 [m/s]."""
DAMPER_STEPS, CHOKE_STEPS = 2, 5
"""Newton steps of each step in time: two end at the solution where the law has straight pieces."""


def simulate(ratios, rich, tracks, rate_hz, n_samples, n_lead=0):
    """Return the accelerations under the sensors, shape (n_trips, n_sensors, n_samples).

    Parameters
    ----------
    ratios : array of shape (n_trips, 5) or (n_trips, 15), [-]
    rich : RichVehicle or RichTrain, or one for each trip with laws of the first
    tracks : sequence of callables
        From times [s] to elevation, velocity and acceleration of each input, (3, n_r, n_times).
        The first input lifts the vehicle.
    rate_hz : float, [Hz]
    n_samples : int
    n_lead : int
        Samples before time 0; the vehicle starts there, lifted to the track and moving with it.
    """
    signals = None
    for first, _, accelerations in march(ratios, rich, tracks, rate_hz, n_samples, n_lead):
        if signals is None:
            signals = np.empty((*accelerations.shape[:2], n_samples))
        kept = accelerations[..., max(0, -first) :]
        begin = max(0, first)
        signals[..., begin : begin + kept.shape[-1]] = kept
    return signals


def march(ratios, rich, tracks, rate_hz, n_samples, n_lead=0):
    """Yield block by block the first sample's index, the states x and the accelerations.

    With x~ = x - H_1 n and u = (r, r', r'', r''') of all wheels, n linear and r cubic between
    samples, through r and r' at both::

        x~[k+1] = Phi x~[k] + (Phi H_1 + H_0 - H_1) n[k] + Gamma u[k],   n[k+1] = law(x~[k+1])

    H_0 and H_1 are the weights of n held and of its change over a step. The arguments are those of
    `simulate`; x has the shape (n_trips, n_states, n_block).
    """
    riches = rich if isinstance(rich, Sequence) else [rich] * len(ratios)
    systems = [one.build(row) for one, row in zip(riches, ratios, strict=True)]
    system = RichSystem(
        *(np.stack([getattr(s, f.name) for s in systems]) for f in fields(RichSystem))
    )
    phi, gamma, held, change = _discretised(system, 1 / rate_hz)
    step = np.concatenate([phi, phi @ change + held - change], axis=2)
    # further rows: the stretch of the rubber springs, for the law
    step = np.concatenate([step, system.rubber_x @ step], axis=1)
    drive = np.concatenate([gamma, system.rubber_x @ gamma], axis=1)
    n_states = phi.shape[1]
    law, state = Law(system, riches[0], change), None
    for first in range(-n_lead, n_samples, BLOCK):
        times = np.arange(first, min(first + BLOCK, n_samples) + 1) / rate_hz
        r, v, a = np.stack([track(times) for track in tracks], axis=1)  # (n_trips, 4, n_times)
        if state is None:
            start = np.stack([r[:, 0, 0], v[:, 0, 0]], axis=1)[:, None] @ system.lift
            state = np.pad(start[:, 0], ((0, 0), (0, law.n_nonlinear)))
        now = slice(0, len(times) - 1)
        forcing = drive @ _cubic(r, v, rate_hz)
        forcing[:, n_states:] -= system.rubber_r @ r[..., 1:]
        states, state = _stepped(step, forcing, state, law)
        n = states[:, n_states:]
        x = states[:, :n_states] + change @ n
        rates = system.a @ x + system.b_r @ r[..., now] + system.b_v @ v[..., now] + system.e @ n
        yield first, x, system.s @ rates + system.s_w @ a[..., now]


def _cubic(r, v, rate_hz):
    """Return elevation and its three derivatives at the beginning of each step, one after another.

    Of the polynomial that has r and r' at both ends of the step.
    """
    steps = [v[..., :-1] / rate_hz, np.diff(v) / rate_hz, np.diff(r)]
    bend = 6 * (steps[2] - steps[0]) - 2 * steps[1]
    twist = 12 * (steps[0] - steps[2]) + 6 * steps[1]
    return np.concatenate([r[..., :-1], v[..., :-1], bend * rate_hz**2, twist * rate_hz**3], axis=1)


def _discretised(system, step_s):
    """Return Phi, Gamma, H_0 and H_1 of each trip: blocks of one matrix exponential."""
    n, n_r, m = system.a.shape[1], system.b_r.shape[2], system.e.shape[2]
    r, n_0, n_1 = n, n + 4 * n_r, n + 4 * n_r + m
    size = n_1 + m
    whole = np.zeros((len(system.a), size, size))
    whole[:, :n, :n] = system.a
    whole[:, :n, r : r + n_r] = system.b_r
    whole[:, :n, r + n_r : r + 2 * n_r] = system.b_v
    whole[:, r : r + 3 * n_r, r + n_r : n_0] = np.eye(3 * n_r)
    whole[:, :n, n_0:n_1] = system.e
    whole[:, n_0:n_1, n_1:] = np.eye(m) / step_s
    found = expm(whole * step_s)[:, :n]
    return found[:, :, :n], found[:, :, r:n_0], found[:, :, n_0:n_1], found[:, :, n_1:]


def _stepped(step, forcing, state, law):
    """Return (x~, n) at the beginning of each step, (n_trips, n_states + n_nonlinear, n_steps).

    And the one after the last step.
    """
    n_states = step.shape[2] - law.n_nonlinear
    forcing = np.ascontiguousarray(np.moveaxis(forcing, 2, 0))[..., None]
    history = np.empty((len(forcing) + 1, *state.shape, 1))
    history[0, ..., 0] = state
    for before, after, force in zip(history[:-1], history[1:], forcing, strict=True):
        found = step @ before
        found += force
        after[:, :n_states] = found[:, :n_states]
        if law.n_nonlinear:
            law(found[..., 0], after[:, n_states:, 0])
    return np.moveaxis(history[:-1, ..., 0], 0, 2), history[-1, ..., 0]


class Law:
    """Friction of the springs and excess velocity of the dampers, which have a memory.

    Parameters
    ----------
    system : RichSystem
        Of all trips.
    rich : RichVehicle or RichTrain
    change : array of shape (n_trips, n_states, n_nonlinear)
        H_1: a damper's own force follows its excess velocity at the end of a step.
    """

    def __init__(self, system, rich, change):
        self.n_friction, self.n_dampers = system.friction_n.shape[1], system.damping.shape[1]
        self.n_nonlinear = self.n_friction + self.n_dampers
        self._friction = BergFriction(system.friction_n, system.friction_half_m)
        own = change[:, change.shape[1] - self.n_dampers :, self.n_friction :]
        own = np.diagonal(own, axis1=1, axis2=2)
        is_bent = system.rebound.any() or (system.exponent != 1).any()
        self._excess = (BentDampers if is_bent else BlowOff)(system, rich.slope_after, own)

    def __call__(self, found, n):
        """Fill n from (x~, stretch of the springs)."""
        end = found.shape[1] - self.n_friction
        if self.n_friction:
            n[:, : self.n_friction] = self._friction(found[:, end:])
        if self.n_dampers:
            self._excess(found[:, end - self.n_dampers : end], n[:, self.n_friction :])


class BlowOff:
    """Dampers that are softer beyond a force: their excess velocity in closed form.

    Parameters
    ----------
    system : RichSystem
    slope_after : float, [-]
        Damping beyond the force of blow-off, over that below.
    own : array of shape (n_trips, n_dampers)
        How a damper's force follows its excess velocity at the end of a step.
    """

    def __init__(self, system, slope_after, own):
        softer = (1 / slope_after - 1) / system.damping
        self._gain, self._blow_off = softer / (1 - softer * own), system.blow_off_n

    def __call__(self, force, out):
        """Fill the excess velocity from the force without any."""
        # implicit: force + H_1 n is what the law is to hold for
        within = np.minimum(np.maximum(force, -self._blow_off), self._blow_off)
        np.multiply(force - within, self._gain, out=out)


class BentDampers:
    """Dampers whose force is any rising function of their velocity, by Newton steps.

    ``L = c (1 +- rebound) v_0 (v / v_0)^p``, + in rebound; beyond blow-off ``slope_after`` of it.
    With the excess n = v - F / c at the end of a step, F = F~ + H_1 n becomes
    ``F(v) (1 + H_1 / c) - H_1 v = F~``, whose left side rises with v. The arguments are those of
    `BlowOff`.
    """

    def __init__(self, system, slope_after, own):
        self._c, self._rebound, self._p = system.damping, system.rebound, system.exponent
        self._blow_off, self._slope = system.blow_off_n, slope_after
        self._kept, self._own = 1 + own / system.damping, -own
        self._has_choke = (self._p != 1).any()

    def force(self, v, sign):
        """Return the force at a velocity v >= 0 of a direction and its derivative."""
        strength = self._c * (1 + self._rebound * sign)
        secant = strength * (v / CHOKE_M_PER_S) ** (self._p - 1) if self._has_choke else strength
        whole, rise = secant * v, self._p * secant
        within = np.minimum(whole, self._blow_off)
        soft = np.where(whole > within, self._slope, 1.0)
        return within + self._slope * (whole - within), soft * rise

    def __call__(self, force, out):
        """Fill the excess velocity from the force without any."""
        sign, size = np.sign(force), np.abs(force)
        v = np.zeros_like(size)
        # Newton steps are monotone from 0 where the law is concave, from above where it is convex
        if self._has_choke:
            whole = CHOKE_M_PER_S * (size / (self._kept * self._c * CHOKE_M_PER_S)) ** (1 / self._p)
            v = np.where(self._p > 1, np.minimum(size / self._own, whole), 0.0)
        for _ in range(CHOKE_STEPS if self._has_choke else DAMPER_STEPS):
            found, rise = self.force(v, sign)
            left = self._kept * found + self._own * v - size
            v = np.maximum(v - left / (self._kept * rise + self._own), 0.0)
        held = (size - self._own * v) / self._kept
        np.multiply(sign, v - held / self._c, out=out)


class BergFriction:
    """Berg's friction force: from each reversal (x_s, F_s) towards F_max, steeply at first.

    ``F = F_s + e (F_end - F_s) / (x_2 (1 - F_s / F_end) + e)``, e = abs(x - x_s) and F_end = F_max
    in the direction of motion (Berg, Veh. Syst. Dyn. 30, 1998).

    Parameters
    ----------
    limit_n : array, [N]
        F_max.
    half_m : float, [m]
        x_2.
    """

    def __init__(self, limit_n, half_m):
        self._limit, self._half = limit_n, half_m
        self._x, self._force, self._turn_x, self._turn_force = np.zeros((4, *limit_n.shape))
        self._end = limit_n.copy()

    def __call__(self, x):
        """Return the force at the next stretch."""
        end = np.copysign(self._limit, x - self._x)
        turned = end != self._end
        self._turn_x = np.where(turned, self._x, self._turn_x)
        self._turn_force = np.where(turned, self._force, self._turn_force)
        way, left = np.abs(x - self._turn_x), end - self._turn_force
        self._force = self._turn_force + way * left / (self._half * left / end + way)
        self._x, self._end = x.copy(), end
        return self._force
