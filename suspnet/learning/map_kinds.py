"""The feature maps that MSVR may use, by name, each with its design matrix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from suspnet.learning.design import DenseDesign, Design
from suspnet.learning.equispaced import EquispacedFeatures, equispaced_fourier
from suspnet.learning.feature_maps import (
    FeatureMap,
    FourierFeatures,
    KernelColumns,
    LandmarkFeatures,
    exact,
    nystroem,
    orthogonal_fourier,
    random_fourier,
)
from suspnet.learning.kernel_design import KernelDesign
from suspnet.learning.toeplitz import EquispacedDesign

MOST_EXACT = 5000
"""Number of samples above which `exact` warns: its kernel takes 0.2 GB, a factor of it as much."""


@dataclass(frozen=True)
class MapKind:
    """A kind of feature map: its constructor, its class and its design matrix.

    ``make(X, sigma, n_components, seed, kernel_tol)`` returns the map for samples X, `holds` is the
    class that `restore` rebuilds from its tensors. `on_gpu`: it runs on other devices than
    the CPU.
    """

    make: Callable[[Tensor, float, int, int, float], FeatureMap]
    holds: Callable[..., FeatureMap]
    design: Callable[[Any, Tensor], Design] = DenseDesign
    on_gpu: bool = True


MAPS = {
    "rff": MapKind(random_fourier, FourierFeatures),
    "orf": MapKind(orthogonal_fourier, FourierFeatures),
    "nystroem": MapKind(nystroem, LandmarkFeatures),
    "equispaced": MapKind(equispaced_fourier, EquispacedFeatures, EquispacedDesign, on_gpu=False),
    "exact": MapKind(exact, KernelColumns, KernelDesign),
}
"""Every feature map by name; a new one is added here."""
