"""The feature maps by name, with their constructors, designs and abilities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from suspnet.learning.design import DenseDesign
from suspnet.learning.equispaced import EquispacedFeatures, equispaced_fourier
from suspnet.learning.feature_maps import FourierFeatures, orthogonal_fourier, random_fourier
from suspnet.learning.landmarks import LandmarkFeatures, exact, nystroem
from suspnet.learning.toeplitz import EquispacedDesign


@dataclass(frozen=True)
class MapKind:
    """A kind of feature map: how it is made, what it is, and the design matrix it gives.

    Attributes
    ----------
    make : callable
        ``make(X, sigma, n_components, seed, kernel_tol)`` gives the map for samples X.
    holds : type
        What the map is, made again from its tensors.
    design : type
    of_data : bool
        Whether the map depends on the samples.
    float32 : bool
        Whether its Gram matrix may be summed in single precision.
    on_gpu : bool
        Whether it runs on other devices than the CPU.
    """

    make: Callable[[Tensor, float, int, int, float], Any]
    holds: type[Any]
    design: type[Any] = DenseDesign
    of_data: bool = True
    float32: bool = False
    on_gpu: bool = True


MAPS = {
    "rff": MapKind(random_fourier, FourierFeatures, of_data=False, float32=True),
    "orf": MapKind(orthogonal_fourier, FourierFeatures, of_data=False, float32=True),
    "nystroem": MapKind(nystroem, LandmarkFeatures),
    "equispaced": MapKind(equispaced_fourier, EquispacedFeatures, EquispacedDesign, on_gpu=False),
    "exact": MapKind(exact, LandmarkFeatures),
}
"""The feature maps by name. To add one, write it beside these and enter it here."""
