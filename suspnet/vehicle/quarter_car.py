"""The quarter-car model of section II-A: transfer functions, natural modes, state space.

With w, z_p, z_s the vertical displacements of wheel, bogie and car body::

    M_p z_p'' + (c_p + c_s) z_p' - c_s z_s' + (k_p + k_s) z_p - k_s z_s = c_p w' + k_p w    (1)
    M_s z_s'' - c_s (z_p' - z_s') - k_s (z_p - z_s) = 0                                     (2)

The paper prints the last term of (1) as k_p w' and swaps the names of z_p and z_s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.linalg import eigh
from torch import Tensor

from suspnet.ground.tensors import as_tensor, check_device
from suspnet.ground.types import FloatArray
from suspnet.vehicle.motion import LinearSystem
from suspnet.vehicle.vehicle import (
    PARAMETERS,
    ResponseGenerator,
    Vehicle,
    angular,
    check_ratios,
    check_vehicle,
)


@dataclass(frozen=True)
class QuarterCar(ResponseGenerator):
    """Frequency responses of a vehicle's quarter-car model, batched over parameter ratios.

    `vehicle` is the healthy one, `device` the torch device of the returned tensors.

    Examples
    --------
    >>> am96 = Vehicle("am96", 1725.0, 6300.0, 1.30e6, 3.7e3, 0.69e6, 22.6e3)
    >>> curves = QuarterCar(am96).magnitudes(torch.ones(1, 5), torch.tensor([0.001]))
    >>> [round(gain, 3) for gain in curves.flatten().tolist()]
    [1.0, 1.0]
    """

    vehicle: Vehicle
    device: str = "cpu"

    def __post_init__(self) -> None:
        check_vehicle(self.vehicle)
        check_device(self.device)

    def parameters(self, ratios: ArrayLike) -> Tensor:
        """Return (k_p, c_p, k_s, c_s, M_s) in SI units, shape (5, n_vehicles, 1).

        ValueError unless `ratios` is positive and finite, (n_vehicles, 5), or 6 with the speed.
        """
        ratios = as_tensor(ratios)
        if ratios.ndim == 2 and ratios.shape[1] == len(PARAMETERS) + 1:
            ratios = ratios[:, : len(PARAMETERS)]  # the responses do not depend on the speed
        check_ratios(ratios, len(PARAMETERS))
        healthy = torch.tensor(self.vehicle.healthy_values(), dtype=torch.float64)
        return (ratios.to(self.device, torch.float64) * healthy.to(self.device)).T.unsqueeze(-1)

    def transfer_coefficients(self, ratios: ArrayLike) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return numerator and denominator of G_P and of G_S, ascending powers of s.

        G_P = num_p / den_p (Eq. 3 cleared of its inner fraction), G_S = num_s / den_s (Eq. 4), of
        shape (n_vehicles, 4), (.., 5), (.., 2), (.., 3).
        """
        k_p, c_p, k_s, c_s, m_s = self.parameters(ratios)
        m_p = self.vehicle.bogie_mass_kg
        num_s = torch.cat([k_s, c_s], dim=1)
        den_s = torch.cat([k_s, c_s, m_s], dim=1)
        num_p = torch.cat([k_p * k_s, k_p * c_s + c_p * k_s, k_p * m_s + c_p * c_s, c_p * m_s], 1)
        den_p = torch.cat(
            [
                k_p * k_s,
                k_p * c_s + c_p * k_s,
                m_p * k_s + m_s * (k_p + k_s) + c_p * c_s,
                m_p * c_s + m_s * (c_p + c_s),
                m_p * m_s,
            ],
            dim=1,
        )
        return num_p, den_p, num_s, den_s

    def responses(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> tuple[Tensor, Tensor]:
        """Return complex G_p and G_s at s = 2 pi j f, Eqs. (3) and (4), each (n_vehicles, n_freq).

        `ratios`: (n_vehicles, 5); `frequencies_hz`: (n_freq,).
        """
        s = 1j * angular(frequencies_hz, self.device)
        num_p, den_p, num_s, den_s = (
            _powers(s, c.shape[1], c.to(torch.complex128))
            for c in self.transfer_coefficients(ratios)
        )
        return num_p / den_p, num_s / den_s

    def channels(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return axle box, frame and body for the one input, (n_vehicles, 1, 3, n_freq), [-]."""
        primary, secondary = self.responses(ratios, frequencies_hz)
        return torch.stack([torch.ones_like(primary), primary, primary * secondary], 1)[:, None]

    def magnitudes(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return abs(G_p) and abs(G_s) from real polynomials in omega^2, (n_vehicles, 2, n_freq).

        For p(s) = sum_k a_k s^k, abs(p(j omega))^2 is a polynomial in x = omega^2 with real
        coefficients, which avoids complex arithmetic on the grid.
        """
        x = angular(frequencies_hz, self.device) ** 2
        num_p, den_p, num_s, den_s = (
            _powers(x, c.shape[1], _squared_magnitude(c))
            for c in self.transfer_coefficients(ratios)
        )
        # torch's rsqrt takes half the time of its sqrt
        return torch.stack([den_p.div_(num_p), den_s.div_(num_s)], dim=1).rsqrt_()

    def natural_modes(self) -> tuple[FloatArray, FloatArray]:
        """Return natural frequencies [Hz], ascending, and mode shapes of the undamped vehicle.

        Solves K v = omega^2 M v for (z_p, z_s). Column j of the shapes is mode j, mass-normalised.
        """
        system = self.motion_system(torch.ones(len(PARAMETERS)))
        eigenvalues, shapes = eigh(system.stiffness, system.mass)
        return np.sqrt(eigenvalues) / (2 * math.pi), shapes

    def motion_system(self, ratios: ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, ratios (5,), for simulation in time."""
        k_p, c_p, k_s, c_s, m_s = self.parameters(as_tensor(ratios)[None]).flatten().tolist()
        return LinearSystem(
            mass=np.diag([self.vehicle.bogie_mass_kg, m_s]),
            damping=np.array([[c_p + c_s, -c_s], [-c_s, c_s]]),
            stiffness=np.array([[k_p + k_s, -k_s], [-k_s, k_s]]),
            input_damping=np.array([[c_p], [0.0]]),
            input_stiffness=np.array([[k_p], [0.0]]),
            sensors=np.eye(2),
            behind_m=(0.0,),
        )


def _powers(x: Tensor, n_terms: int, coefficients: Tensor) -> Tensor:
    """Evaluate polynomials of ascending `coefficients` (n, n_terms) at x, as one product."""
    return coefficients @ torch.stack([x**power for power in range(n_terms)])


def _squared_magnitude(coefficients: Tensor) -> Tensor:
    """Return the coefficients in x = omega^2 of abs(sum_k a_k (j omega)^k)^2, same shape.

    The even powers give the real part, the odd ones the imaginary part; the coefficient of x^m
    is sum over i + j = 2 m of (-1)^((i - j) / 2) a_i a_j.
    """
    n_terms = coefficients.shape[1]
    squared = torch.zeros_like(coefficients)
    for i in range(n_terms):
        for j in range(i % 2, n_terms, 2):
            sign = -1.0 if (i - j) // 2 % 2 else 1.0
            squared[:, (i + j) // 2] += sign * coefficients[:, i] * coefficients[:, j]
    return squared
