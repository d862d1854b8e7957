"""Bodies, points and elements in space: mass, damping and stiffness without any closed form.

A body moves along y and z and turns about x (roll), y (pitch) and z (yaw), to first order, so that
a point p of it moves by t + theta x p; x points ahead, y to the left, z upwards. A spring or damper
joins two points; its stretch is a row over u = (q, r), coordinates and track. Together, with F of
those elements that have a series stiffness::

    M q'' + G_q^T (k G u + c G u') + K_c u + C_c u' + G_qF^T F = 0,
    F' = k_series (G_F u' - F / c),   G = (G_q, G_r) over (q, r)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse.csgraph import connected_components

FREEDOMS = ("y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Body:
    """A rigid body, or a beam: rows over u of its motions, and shapes that bend it in the plane.

    Attributes
    ----------
    rows : mapping
        From a name of ``FREEDOMS`` to its row over u; what is missing is zero.
    shapes : sequence of (row over u, function of x)
        The function returns deflection and slope at x.
    warps : sequence of (row over u, function of the point)
        The function returns the motion along x, y and z: torsion of a body or of a frame.
    centre : tuple of float, [m]
        The centre of gravity, about which the body turns.
    """

    rows: Mapping[str, np.ndarray]
    shapes: tuple = ()
    warps: tuple = ()
    centre: tuple = (0.0, 0.0, 0.0)

    def motion(self, point):
        """Return the motion of a point along x, y and z, (3, n_u)."""
        x, y, z = np.subtract(point, self.centre)
        none = np.zeros_like(next(iter(self.rows.values())))
        t_y, t_z, roll, pitch, yaw = (self.rows.get(name, none) for name in FREEDOMS)
        moved = np.stack(
            [pitch * z - yaw * y, t_y + yaw * x - roll * z, t_z + roll * y - pitch * x]
        )
        for row, shape in self.shapes:
            deflection, slope = shape(point[0])
            moved += np.outer([-slope * z, 0.0, deflection], row)
        for row, warp in self.warps:
            moved += np.outer(warp(point), row)
        return moved


@dataclass
class Elements:
    """Springs and dampers side by side, or in series: their stretches and what wears them.

    Attributes
    ----------
    n_u : int
    stretches : list of rows over u
    stiffness, damping : list of float, [N/m] and [N s/m]
    labels : list of str
        A name for each.
    """

    n_u: int
    stretches: list = field(default_factory=list)
    stiffness: list = field(default_factory=list)
    damping: list = field(default_factory=list)
    labels: list = field(default_factory=list)

    def add(self, stretch, stiffness, damping, label):
        """Add one element by its stretch."""
        self.stretches.append(stretch)
        self.stiffness.append(stiffness)
        self.damping.append(damping)
        self.labels.append(label)

    def where(self, *words):
        """Return the indices of the elements whose label holds all words."""
        found = [all(w in label.split() for w in words) for label in self.labels]
        return np.flatnonzero(found)

    def sort(self, last):
        """Move the elements whose label holds a word behind the others."""
        order = sorted(range(len(self.labels)), key=lambda i: last in self.labels[i].split())
        for values in (self.stretches, self.stiffness, self.damping, self.labels):
            values[:] = [values[i] for i in order]

    @property
    def rows(self):
        """Return the stretches, (n_elements, n_u)."""
        return np.reshape(self.stretches, (-1, self.n_u)).astype(float)


def between(one, its_point, other, other_point, direction):
    """Return the stretch along a direction between points of two bodies, a row over u."""
    return np.asarray(direction, float) @ (one.motion(its_point) - other.motion(other_point))


@dataclass(frozen=True)
class Matrices:
    """The equations of the module's docstring, of one train.

    Attributes
    ----------
    mass : array of shape (n_q,)
    stiffness, damping : arrays of shape (n_q, n_u)
        G_q^T k G + K_c and G_q^T c G + C_c.
    series : array of shape (n_series, n_u)
        G of the elements in series.
    series_stiffness, series_damping : arrays of shape (n_series,)
    sensors : array of shape (n_sensors, n_u)
    """

    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    series: np.ndarray
    series_stiffness: np.ndarray
    series_damping: np.ndarray
    sensors: np.ndarray

    def state_space(self):
        """Return A, B_r, B_v of x' = A x + B_r r + B_v r' with x = (q, q', F)."""
        n, n_f = len(self.mass), len(self.series)
        push = -1 / self.mass[:, None]
        k, c = push * self.stiffness, push * self.damping
        from_f = push * self.series[:, :n].T
        grown = self.series_stiffness[:, None] * self.series
        fading = np.diag(-self.series_stiffness / self.series_damping)
        none = np.zeros
        a = np.block(
            [
                [none((n, n)), np.eye(n), none((n, n_f))],
                [k[:, :n], c[:, :n], from_f],
                [none((n_f, n)), grown[:, :n], fading],
            ]
        )
        n_r = k.shape[1] - n
        b_r = np.vstack([none((n, n_r)), k[:, n:], none((n_f, n_r))])
        b_v = np.vstack([none((n, n_r)), c[:, n:], grown[:, n:]])
        return a, b_r, b_v

    def responses(self, frequencies_hz, inputs, sensors=None):
        """Return the motion under the sensors of given inputs, (n_freq, n_sensors, n_inputs).

        Coordinates that do not move each other (vertical and lateral ones, of a train whose left
        and right are alike) are solved apart, and only as far as the sensors feel them.

        Parameters
        ----------
        frequencies_hz : array of shape (n_freq,), [Hz]
        inputs : complex array of shape (n_freq, n_r, n_inputs)
        sensors : array of shape (n_sensors, n_u), optional
            Combinations of the train's own.
        """
        n = len(self.mass)
        sensors = self.sensors if sensors is None else sensors
        s = 2j * np.pi * np.asarray(frequencies_hz)[:, None, None]
        rates, which = np.unique(self.series_stiffness / self.series_damping, return_inverse=True)
        fading = np.zeros((len(rates), *self.stiffness.shape))
        for rate, k, row in zip(which, self.series_stiffness, self.series, strict=True):
            fading[rate] += k * np.outer(row[:n], row)

        def dynamic(s, rows, columns):
            part = np.ix_(rows, columns)
            found = self.stiffness[part] + s * self.damping[part]
            for rate, matrix in zip(rates, fading, strict=True):
                found = found + s / (s + rate) * matrix[part]
            return found + s**2 * (self.mass[rows, None] * (rows[:, None] == columns))

        motion = sensors[:, n:] @ inputs
        everything, track = np.arange(n), np.arange(n, self.stiffness.shape[1])
        for group in _coupled(dynamic(s[len(s) // 2], everything, everything)):
            if np.abs(sensors[:, group]).max() > 1e-10:
                load = dynamic(s, group, track) @ inputs
                q = np.linalg.solve(dynamic(s, group, group), -load)
                motion = motion + sensors[:, group] @ q
        return motion


def _coupled(dynamic):
    """Return the groups of coordinates that a dynamic stiffness couples."""
    size = np.sqrt(np.abs(np.diag(dynamic)))
    tied = np.abs(dynamic) > 1e-11 * size * size[:, None]
    n_groups, label = connected_components(tied, directed=False)
    return [np.flatnonzero(label == group) for group in range(n_groups)]
