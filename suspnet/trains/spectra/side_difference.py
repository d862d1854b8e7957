"""Left-right asymmetry of a suspension, identified from the roll of the frame that bounce excites.

With a sensor on the left and one on the right of each place there are averages, w of the axle box,
v of the frame, y of the body, and half differences (left - right) / 2: w_d, u_f, u_b. Left and
right springs and dampers are k (1 + d) and k (1 - d), c (1 + d) and c (1 - d). The dynamic
stiffness of one side's suspension, bushings and rubber included, is then kappa +- delta, with delta
the sum of d dkappa / dlog(k) and d dkappa / dlog(c). The moment balance of the frame, divided by
the springs' half distance and for one side's share, is::

    - omega^2 M_f u_f + kappa_p (u_f - lambda P w_d) + (kappa_s + rho) (u_f - u_b)
        + delta_p (z - P w) + delta_s (z - y) = 0,                                (1)

with M_f the roll inertia over the square of the springs' half distance, rho the anti-roll bar,
lambda the distance of the frame's sensors relative to the axle box's, P = (1 + Z) / 2 of both
wheelsets, Z the phase of the second one, and z the mean of the frame at its centre. The balance of
the frame's bounce gives z from w and y, wherever v is measured::

    (kappa_p + kappa_s - omega^2 M_p) z = kappa_p P w + kappa_s y.                (2)

The bogie's pitch, the other bogie, sway, roll and bending of the body, and an eccentric load enter
(1) and (2) only through the measured motions.

A track's mean and cross level are independent processes. The response F of a difference to v with
w_d held fixed (two inputs v and w_d, one regression for each bin) is therefore 0 in a symmetric
vehicle, and (1) becomes::

    (D F_f - (kappa_s + rho) F_b) = - (delta_p sigma_p + delta_s sigma_s),
    D = kappa_p + kappa_s + rho - omega^2 M_f,                                    (3)

with sigma_p = (z - P w) / v and sigma_s = (z - y) / v. It is linear in d of k_p, c_p, k_s and c_s.
Sensors of a pair whose sensitivities differ by 2 g add g v to u_f, g y to u_b, g w to w_d; these
three g are estimated as well, with a narrow prior. M_f, rho and lambda are estimated from (1),
correlated with u_f after removing the part that v explains: there the effect of d is second order.
Their posterior is their prior in the regression on (3).

The variance of F is that of a regression with two inputs (Bendat and Piersol, Random Data, 2010,
section 9.2), S_ee / (n S_vv.w_d), with S_ee the part of the difference that neither input explains.
A noisy w_d explains less of the difference, which makes F less certain but does not bias it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspnet.ground.types import ComplexArray, FloatArray

SIDE_PARAMETERS = ("k_p", "c_p", "k_s", "c_s")
"""Parameters with a left and a right part, in the order of every array of d."""
ROLL_PRIOR = ((1.0, 0.1), (0.6, 0.3), (0.0, 1.0))
"""Prior mean and standard deviation of 1 / lambda, (M_f / M_p) / lambda and (rho / k_s) / lambda; a
frame's radius of gyration in roll is about 0.8 of the springs' half distance."""
ROLL_MODEL_ERROR = 0.05
"""Standard deviation of the model error of (1), relative to k_p, in the estimate of M_f, rho and
lambda."""
CHANCE = 5.0
"""Unrelated signals have a coherence above CHANCE / n_averages in exp(-5) = 0.7 % of the bins."""
FLOOR = 1e-10
"""Noise added to the differences, relative to the power of v: the difference of equal sensors is 0.
"""
D_DEVIATION, GAIN_DEVIATION = 0.5, 0.02
"""Prior standard deviation of d and of g."""


@dataclass(frozen=True)
class Bounce:
    """Parameters and measured motion of the mean of left and right, for one side of a bogie.

    `k_p`, `k_s`, `bogie_mass` are in SI units, the mass M_p over one side's springs; `kappas` (2,
    n_freq): kappa_p and kappa_s, and `slopes` (4, n_freq): dkappa / dlog of ``SIDE_PARAMETERS``,
    [N/m]; `box`, `body`, `wheelsets` (n_freq,): w / v, y / v and P.
    """

    k_p: float
    k_s: float
    bogie_mass: float
    kappas: ComplexArray
    slopes: ComplexArray
    box: ComplexArray
    body: ComplexArray
    wheelsets: ComplexArray

    def stretches(self, omega: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return sigma_p and sigma_s, each (n_freq,), at the bins `omega` [rad/s] of the arrays."""
        kappa_p, kappa_s = self.kappas
        rail = self.wheelsets * self.box
        inertia = omega**2 * self.bogie_mass
        centre = (kappa_p * rail + kappa_s * self.body) / (kappa_p + kappa_s - inertia)
        return centre - rail, centre - self.body


@dataclass(frozen=True)
class SideDifference:
    """Asymmetry of both sides, d = (left - right) / (left + right) of ``SIDE_PARAMETERS``.

    `d` and `deviations`: (4,), [-]; d > 0 means that the right side is weaker. `misfit` is
    chi-square per degree of freedom; where it exceeds 1 the deviations include it.
    """

    d: FloatArray
    deviations: FloatArray
    misfit: float

    @property
    def weaker_by(self) -> FloatArray:
        """Relative deficit of the weaker side against the other one, shape (4,), [-]."""
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

    `frequencies_hz`: (n_freq,); `values` (n_segments, 4, n_freq): spectra of v, w_d, u_f and u_b in
    each segment, in one unit; `n_averages`: independent averages, ValueError unless more than 2;
    `correlated_bins`: number of neighbouring bins with the information of one.
    """
    if not n_averages > 2:
        raise ValueError(f"`n_averages` must be > 2, got {n_averages:g}")
    # E[conj(x) y] of all pairs, (4, 4, n_freq)
    spectra = np.einsum("sif,sjf->ijf", values.conj(), values) / len(values)
    spectra[[1, 2, 3], [1, 2, 3]] += FLOOR * spectra[0, 0]
    omega = 2 * np.pi * frequencies_hz
    # roll parameters first, from (1) without the part that v explains: d hardly affects them
    partial = unexplained(spectra, 0)
    roll, roll_covariance = _roll(omega, partial, bounce, n_averages)
    # left side of (3) from the responses F to v, and its variance
    f, covariance = responses_to_bounce(spectra, partial, n_averages)
    distance, moved = roll[0], np.array([1.0, roll[1], roll[2]])
    terms = _roll_terms(omega, bounce, f[0], f[1])
    weights = np.einsum("k,kif->if", moved, _roll_terms(omega, bounce, *np.eye(2)[:, :, None]))
    variance = np.einsum("if,ijf,jf->f", weights, covariance, weights.conj()).real
    # unknowns of (3): d, the three g, and the changes of M_f and rho from their estimates
    stretch_p, stretch_s = bounce.stretches(omega)
    columns = [
        *(-bounce.slopes * np.stack([stretch_p, stretch_p, stretch_s, stretch_s])),
        weights[0],
        weights[1] * bounce.body,
        -distance * bounce.kappas[0] * bounce.wheelsets * bounce.box,
    ]
    prior = np.diag([D_DEVIATION] * 4 + [GAIN_DEVIATION] * 3 + [0.0] * 2) ** 2
    prior[7:, 7:] = roll_covariance[1:, 1:]
    mean, covariance_d, misfit = _regression(
        np.concatenate([columns, -terms[1:]]),
        moved @ terms,
        variance * correlated_bins,
        np.zeros(len(prior)),
        prior,
    )
    # correlated bins hold less information: variances were scaled up, the misfit is scaled back
    misfit *= correlated_bins
    spread = np.sqrt(np.diagonal(covariance_d)[:4] * max(misfit, 1.0))
    return SideDifference(mean[:4], spread, misfit)


def _roll_terms(
    omega: FloatArray, bounce: Bounce, frame: ComplexArray, body: ComplexArray
) -> ComplexArray:
    """Return the factors of 1, M_f / M_p and rho / k_s on the left of (3), (3, ..., n_freq).

    `frame` and `body` are half differences or their responses.
    """
    kappa_p, kappa_s = bounce.kappas
    stiffness = (kappa_p + kappa_s) * frame - kappa_s * body
    inertia = -(omega**2) * bounce.bogie_mass * frame
    return np.stack([stiffness, inertia, bounce.k_s * (frame - body) + 0 * stiffness])


def unexplained(spectra: ComplexArray, i: int) -> ComplexArray:
    """Return the spectra of the residuals that signal i does not explain, same shape."""
    explained = spectra[:, i, None] * spectra[None, i, :] / spectra[i, i].real
    return np.asarray(spectra - explained)


def responses_to_bounce(
    spectra: ComplexArray, partial: ComplexArray, n_averages: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return F of u_f and u_b, (2, n_freq), and its covariance E[F_i conj(F_j)], (2, 2, n_freq).

    `partial` are the spectra without v; two inputs use up two of the averages.
    """
    given_box = unexplained(spectra, 1)
    f = given_box[0, 2:] / given_box[0, 0].real
    residuals = unexplained(partial, 1)[2:, 2:]  # E[conj(e_i) e_j]
    freedom = n_averages * given_box[0, 0].real * (1 - 2 / n_averages)
    return f, np.asarray(residuals.transpose(1, 0, 2) / freedom)


def _roll(
    omega: FloatArray, partial: ComplexArray, bounce: Bounce, n_averages: float
) -> tuple[FloatArray, FloatArray]:
    """Return lambda, M_f / M_p and rho / k_s with their covariance.

    Equation (1) over lambda, correlated with u_f and divided by S_ff, is linear in 1 / lambda,
    M_f / lambda and rho / lambda. Only bins where w_d and u_f are significantly coherent are used.
    """
    power = partial[2, 2].real
    box, body = partial[2, 1] / power, partial[2, 3] / power
    coherence = np.abs(partial[2, 1]) ** 2 / (power * partial[1, 1].real)
    coherent = coherence > CHANCE / n_averages
    scale = bounce.kappas[0] * bounce.wheelsets
    unexplained = (
        (1 - coherence[coherent]) / coherence[coherent] * (partial[1, 1].real / power)[coherent]
    )
    variance = np.abs(scale[coherent]) ** 2 * unexplained / n_averages
    variance += (ROLL_MODEL_ERROR * bounce.k_p) ** 2
    columns = _roll_terms(omega, bounce, np.ones_like(body), body)[:, coherent]
    prior, deviations = np.array(ROLL_PRIOR).T
    mean, covariance, _ = _regression(
        columns, (scale * box)[coherent], variance, prior, np.diag(deviations**2)
    )
    roll = np.array([1.0, mean[1], mean[2]]) / mean[0]
    jacobian = np.eye(3) / mean[0]
    jacobian[:, 0] = -roll / mean[0]
    return roll, jacobian @ covariance @ jacobian.T


def _regression(
    columns: ComplexArray,
    target: ComplexArray,
    variance: FloatArray,
    prior: FloatArray,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Return mean and covariance of real coefficients with a normal prior, and the misfit.

    `columns`: (n_coefficients, n_freq); `target`, `variance`: (n_freq,), the variance of the
    complex target, half of it along either axis. The misfit is chi-square per real number of the
    target, 0 without any.
    """
    weight = np.sqrt(2 / variance)
    rows = np.concatenate([(weight * columns).real, (weight * columns).imag], axis=1)
    weighted = weight * (target - prior @ columns)
    aim = np.concatenate([weighted.real, weighted.imag])
    root = np.linalg.cholesky(prior_covariance)  # coefficients = prior + root @ change
    scaled = root.T @ rows
    inverse = np.linalg.inv(scaled @ scaled.T + np.eye(len(prior)))
    change = inverse @ (scaled @ aim)
    left = aim - change @ scaled
    covariance = root @ inverse @ root.T
    return prior + root @ change, covariance, float(left @ left / max(len(left), 1))
