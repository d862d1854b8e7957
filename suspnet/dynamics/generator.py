"""The interface of generators: sources of the two frequency responses of degraded vehicles."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor

from suspnet.dynamics.distribution import LogNormal
from suspnet.dynamics.motion import LinearSystem
from suspnet.dynamics.vehicle import Vehicle


@runtime_checkable
class ResponseGenerator(Protocol):
    """Frequency responses of degraded vehicles: axle box to bogie (G_p), bogie to body (G_s).

    Attributes
    ----------
    vehicle : Vehicle
        The healthy vehicle.
    device : str
        Torch device of the tensors that come back.
    speed_m_per_s : float or None, [m/s]
        The speed that the responses belong to; None if they do not depend on it.
    bogie : str or None
        The bogie that is measured, "leading" or "trailing"; None if the model suits both.
    distribution : LogNormal or None
        Of the generator's uncertain numbers; None if there are none.
    further_places : tuple of str
        Names of places for sensors besides axle box, bogie and body: one on the frame, one on the
        body, and the second axle box; or none.
    sensor_lateral_m : tuple of 3 floats, [m]
        Lateral place of the sensors on axle box, frame and body; 0 for the mean of a left and a
        right one.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def vehicle(self) -> Vehicle: ...  # noqa: D102

    @property
    def device(self) -> str: ...  # noqa: D102

    @property
    def speed_m_per_s(self) -> float | None: ...  # noqa: D102

    @property
    def bogie(self) -> str | None: ...  # noqa: D102

    @property
    def distribution(self) -> LogNormal | None: ...  # noqa: D102

    @property
    def further_places(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def sensor_lateral_m(self) -> tuple[float, float, float]: ...  # noqa: D102

    def responses(self, ratios: Tensor, frequencies_hz: Tensor) -> tuple[Tensor, Tensor]:
        """Return complex G_p and G_s.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5) or (n_vehicles, 6)
            k_p, c_p, k_s, c_s, M_s relative to healthy, [-]; then the speed relative to
            ``speed_m_per_s``.
        frequencies_hz : tensor of shape (n_freq,), [Hz]

        Returns
        -------
        tuple of complex tensors of shape (n_vehicles, n_freq), [-]
        """
        ...

    def channels(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return axle box, frame and body for each independent input of the track.

        Returns
        -------
        complex tensor of shape (n_vehicles, n_inputs, 3, n_freq), [-]
            Each input is scaled to the density of the first, the mean of both rails: expected
            spectra are sums over inputs.
        """
        ...

    def magnitudes(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return abs(G_p) and abs(G_s) as one real tensor of shape (n_vehicles, 2, n_freq)."""
        ...

    def further_channels(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return ``further_places`` for each input, (n_vehicles, n_inputs, n_places, n_freq)."""
        ...

    def with_uncertain(self, ratios: Tensor, numbers: Tensor) -> Tensor:
        """Return ratios with further columns: those with a distribution have values `numbers`."""
        ...

    def sample_unmeasured(self, ratios: Tensor, seed: int) -> Tensor:
        """Return ratios with further columns: draws of the generator's uncertain quantities."""
        ...

    def dynamic_stiffness(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return kappa_p and kappa_s of a bogie side, complex (n_vehicles, 2, n_freq), [N/m]."""
        ...

    def motion_system(self, ratios: Tensor) -> LinearSystem:
        """Return the equations of motion of one vehicle, ratios (5,), for simulation in time."""
        ...

    def of(self, vehicle: Vehicle) -> ResponseGenerator:
        """Return the generator for another vehicle, a simpler one where the geometry is missing."""
        ...

    def on(self, device: str) -> ResponseGenerator:
        """Return the same generator on another device."""
        ...

    def assumptions(self) -> str:
        """Return a sentence on the assumptions of the generator."""
        ...


def check_ratios(ratios: Tensor, n_parameters: int) -> None:
    """Raise ValueError unless `ratios` is a positive, finite (n_vehicles, n_parameters) tensor."""
    if ratios.ndim != 2 or ratios.shape[1] != n_parameters:
        shape = tuple(ratios.shape)
        raise ValueError(f"`ratios` must have shape (n_vehicles, {n_parameters}), got {shape}")
    if not bool((torch.isfinite(ratios) & (ratios > 0)).all()):
        raise ValueError("`ratios` must be positive and finite; 1 is healthy")
