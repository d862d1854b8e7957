"""What any source of training curves must offer: two frequency responses for degraded vehicles."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor


@runtime_checkable
class ResponseGenerator(Protocol):
    """Frequency responses of degraded vehicles: axle box to bogie (G_p), bogie to body (G_s)."""

    def responses(self, ratios: Tensor, frequencies_hz: Tensor) -> tuple[Tensor, Tensor]:
        """Return complex G_p and G_s.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5)
            k_p, c_p, k_s, c_s, M_s relative to healthy, [-].
        frequencies_hz : tensor of shape (n_freq,), [Hz]

        Returns
        -------
        tuple of complex tensors of shape (n_vehicles, n_freq), [-]
        """
        ...

    def magnitudes(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return abs(G_p) and abs(G_s) as one real tensor of shape (n_vehicles, 2, n_freq)."""
        ...


def sample_unmeasured(generator: ResponseGenerator, ratios: Tensor, seed: int) -> Tensor:
    """Return ratios with random columns for what a generator holds uncertain, or as they are."""
    sample = getattr(generator, "sample_unmeasured", None)
    return ratios if sample is None else sample(ratios, seed)


def check_device(device: str) -> None:
    """Raise ValueError if torch cannot use a device here."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"`device`={device!r} cannot be used here: {reason}") from error


def check_ratios(ratios: Tensor, n_parameters: int) -> None:
    """Raise ValueError unless `ratios` is a positive, finite (n_vehicles, n_parameters) tensor."""
    if ratios.ndim != 2 or ratios.shape[1] != n_parameters:
        shape = tuple(ratios.shape)
        raise ValueError(f"`ratios` must have shape (n_vehicles, {n_parameters}), got {shape}")
    if not bool((torch.isfinite(ratios) & (ratios > 0)).all()):
        raise ValueError("`ratios` must be positive and finite; 1 is healthy")


def check_choice(name: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise ValueError unless a setting is one of those allowed."""
    if value not in allowed:
        raise ValueError(f"`{name}` must be one of {allowed}, got {value!r}")


def check_range(
    name: str, value: object, low: float, high: float = math.inf, closed: bool = False
) -> None:
    """Raise TypeError or ValueError unless a setting is a number in low < value < high."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"`{name}` must be a number, got {value!r}")
    if not (low < value < high or (closed and value == low)):
        raise ValueError(f"`{name}` must lie between {low} and {high}, got {value}")
