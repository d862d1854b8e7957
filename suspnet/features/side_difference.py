r"""How much weaker one side of a suspension is: the roll of the frame that bounce leaks into.

With a sensor on the left and one on the right of each place there are averages, w of the axle box,
v of the frame, y of the body, and half differences (left - right) / 2: w_d, u_f, u_b. Left and
right springs and dampers are kappa (1 + d) and kappa (1 - d), kappa = k + j omega c. The moments on
the frame, over the springs' half distance and of one side's share, are in balance::

    - omega^2 M_f u_f + kappa_p (u_f - lambda P w_d) + (kappa_s + rho) (u_f - u_b)
        + kappa_p d_p (v - P w) + kappa_s d_s (v - y) = 0,                        (1)

with M_f the roll inertia over the square of the springs' half distance, rho the anti-roll bar,
lambda how far apart the frame's sensors are relative to the axle box's, and P = (1 + Z) / 2 of both
wheelsets, Z the phase of the second one. What the springs carry follows from the bounce,
kappa_p (v - P w) = omega^2 M_p v - kappa_s (v - y), v at the bogie's centre. Neither the other
bogie, nor sway and roll of the body, nor an eccentric load are in (1) otherwise than by u_b, which
is measured.

A track's mean and cross level are independent processes. So the response F of a difference to v,
with w_d held fixed (two inputs v and w_d, one regression for each bin), is 0 in a symmetric
vehicle, and (1) leaves::

    (D F_f - (kappa_s + rho) F_b) = - (kappa_p d_p sigma_p + kappa_s d_s sigma_s),
    D = kappa_p + kappa_s + rho - omega^2 M_f,                                    (2)

sigma_p = (v - P w) / v and sigma_s = (v - y) / v from the model of the bounce. It is linear in d of
k_p, c_p, k_s and c_s. Sensors of a pair whose sensitivities differ by 2 g add g v to u_f, g y to
u_b, g w to w_d; these three g are estimated along, with a narrow prior. M_f, rho and lambda come
from (1) correlated with u_f after what v explains has been taken away: there d is of second order.

The variance of F is that of a regression with two inputs (Bendat and Piersol, Random Data, 2010,
section 9.2), S_ee / (n S_vv.w_d), with S_ee the part of the difference that neither input explains.
A noisy w_d explains less of the difference and makes F less certain, not biased.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspnet.types import ComplexArray, FloatArray

SIDE_PARAMETERS = ("k_p", "c_p", "k_s", "c_s")
"""Parameters with a left and a right part, in the order of every array of d."""
ROLL_PRIOR = ((1.0, 0.1), (0.6, 0.3), (0.0, 1.0))
"""Prior mean and standard deviation of 1 / lambda, M_f / M_p and rho / k_s, each of the last two
over lambda: a frame's radius of gyration in roll is about 0.8 of the springs' half distance."""
ROLL_MODEL_ERROR = 0.05
"""Standard deviation of (1), relative to k_p, by which motions that it does not hold are allowed
for when M_f, rho and lambda are estimated."""
D_DEVIATION, GAIN_DEVIATION = 0.5, 0.02
"""Prior standard deviation of d and of g."""


@dataclass(frozen=True)
class Bounce:
    """The bogie side's bounce by the model, at the parameters of the trip.

    Attributes
    ----------
    k_p, c_p, k_s, c_s, bogie_mass : float
        SI units, M_p the mass over one side's springs.
    box, centre, body : complex arrays of shape (n_freq,), [-]
        w, v at the bogie's centre and y, relative to v under the frame's sensors.
    wheelsets : complex array of shape (n_freq,), [-]
        P.
    """

    k_p: float
    c_p: float
    k_s: float
    c_s: float
    bogie_mass: float
    box: ComplexArray
    centre: ComplexArray
    body: ComplexArray
    wheelsets: ComplexArray


@dataclass(frozen=True)
class SideDifference:
    """Difference of both sides, d = (left - right) / (left + right) of ``SIDE_PARAMETERS``.

    Attributes
    ----------
    d, deviations : arrays of shape (4,), [-]
        d > 0: the right side is the weaker one.
    misfit : float, [-]
        Chi-square per degree of freedom; where above 1 it is in the deviations.
    """

    d: FloatArray
    deviations: FloatArray
    misfit: float

    @property
    def weaker_by(self) -> FloatArray:
        """How much less the weaker side has than the other one, shape (4,), [-]."""
        size = np.abs(self.d)
        return np.asarray(2 * size / (1 + size))


def side_difference(
    frequencies_hz: FloatArray,
    values: ComplexArray,
    bounce: Bounce,
    n_averages: float,
    correlated_bins: float = 1.0,
) -> SideDifference:
    """Return how the left side differs from the right one, by the equations of this module.

    Parameters
    ----------
    frequencies_hz : array of shape (n_freq,), [Hz]
    values : complex array of shape (n_segments, 4, n_freq)
        Spectra of v, w_d, u_f and u_b in each segment, in one unit.
    bounce : Bounce
    n_averages : float
        Independent averages, more than 2.
    correlated_bins : float
        Number of neighbouring bins with the information of one.

    Raises
    ------
    ValueError
        If there are 2 averages or fewer.
    """
    if not n_averages > 2:
        raise ValueError(f"`n_averages` must be > 2, got {n_averages:g}")
    # E[conj(x) y] of all pairs, (4, 4, n_freq)
    spectra = np.einsum("sif,sjf->ijf", values.conj(), values) / len(values)
    omega = 2 * np.pi * frequencies_hz
    kappa_p = bounce.k_p + 1j * omega * bounce.c_p
    kappa_s = bounce.k_s + 1j * omega * bounce.c_s
    partial = _without(spectra, 0)
    inertia, bar, sensors = _roll(omega, partial, kappa_p, kappa_s, bounce, n_averages)
    to_body = kappa_s + bar
    own = kappa_p + to_body - omega**2 * inertia
    f, covariance = _responses(spectra, partial, n_averages)
    target = own * f[0] - to_body * f[1]
    weights = np.stack([own, -to_body])
    variance = np.einsum("if,ijf,jf->f", weights, covariance, weights.conj()).real
    stretch_s = bounce.centre - bounce.body
    carried_p = omega**2 * bounce.bogie_mass * bounce.centre - kappa_s * stretch_s
    columns = [
        -carried_p * bounce.k_p / kappa_p,
        -carried_p * 1j * omega * bounce.c_p / kappa_p,
        -bounce.k_s * stretch_s,
        -1j * omega * bounce.c_s * stretch_s,
        own,
        -to_body * bounce.body,
        -kappa_p * sensors * bounce.wheelsets * bounce.box,
    ]
    deviations = np.array([D_DEVIATION] * 4 + [GAIN_DEVIATION] * 3)
    mean, covariance_d, misfit = _regression(
        np.stack(columns), target, variance * correlated_bins, np.zeros(7), deviations
    )
    misfit *= correlated_bins
    spread = np.sqrt(np.diagonal(covariance_d)[:4] * max(misfit, 1.0))
    return SideDifference(mean[:4], spread, misfit)


def _without(spectra: ComplexArray, i: int) -> ComplexArray:
    """Return the spectra of what signal i does not explain, of its own shape."""
    explained = spectra[:, i, None] * spectra[None, i, :] / spectra[i, i].real
    return np.asarray(spectra - explained)


def _responses(
    spectra: ComplexArray, partial: ComplexArray, n_averages: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return F of u_f and u_b, (2, n_freq), and its covariance E[F_i conj(F_j)], (2, 2, n_freq).

    `partial` is without v; two inputs take two of the averages.
    """
    given_box = _without(spectra, 1)
    f = given_box[0, 2:] / given_box[0, 0].real
    rest = _without(partial, 1)[2:, 2:]  # E[conj(e_i) e_j]
    freedom = n_averages * given_box[0, 0].real * (1 - 2 / n_averages)
    return f, np.asarray(rest.transpose(1, 0, 2) / freedom)


def _roll(
    omega: FloatArray,
    partial: ComplexArray,
    kappa_p: ComplexArray,
    kappa_s: ComplexArray,
    bounce: Bounce,
    n_averages: float,
) -> tuple[float, float, float]:
    """Return M_f, rho and lambda from (1) correlated with u_f, divided by S_ff and lambda."""
    power = partial[2, 2].real
    box, body = partial[2, 1] / power, partial[2, 3] / power
    coherence = np.abs(partial[2, 1]) ** 2 / (power * partial[1, 1].real)
    scale = kappa_p * bounce.wheelsets
    noise = (1 - coherence) * partial[1, 1].real / (n_averages * power * coherence)
    variance = np.abs(scale) ** 2 * noise + (ROLL_MODEL_ERROR * bounce.k_p) ** 2
    columns = [
        kappa_p + kappa_s * (1 - body),
        -(omega**2) * bounce.bogie_mass + 0j,
        bounce.k_s * (1 - body),
    ]
    prior, deviations = np.array(ROLL_PRIOR).T
    mean, _, _ = _regression(np.stack(columns), scale * box, variance, prior, deviations)
    apart, inertia, bar = mean
    return bounce.bogie_mass * inertia / apart, bounce.k_s * bar / apart, 1 / apart


def _regression(
    columns: ComplexArray,
    target: ComplexArray,
    variance: FloatArray,
    prior: FloatArray,
    deviations: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Return mean and covariance of real coefficients with a normal prior, and the misfit.

    Parameters
    ----------
    columns : array of shape (n_coefficients, n_freq)
    target, variance : arrays of shape (n_freq,)
        The complex target and its variance, half of it along either axis.
    prior, deviations : arrays of shape (n_coefficients,)
    """
    weight = np.sqrt(2 / variance)
    rows = np.concatenate([(weight * columns).real, (weight * columns).imag], axis=1)
    weighted = weight * (target - prior @ columns)
    aim = np.concatenate([weighted.real, weighted.imag])
    # in units of the prior, so that the matrix is well-conditioned
    scaled = deviations[:, None] * rows
    inverse = np.linalg.inv(scaled @ scaled.T + np.eye(len(prior)))
    change = inverse @ (scaled @ aim)
    left = aim - change @ scaled
    covariance = inverse * np.outer(deviations, deviations)
    return prior + deviations * change, covariance, float(left @ left / len(left))
