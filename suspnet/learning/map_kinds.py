"""The feature maps that MSVR may use, by name, each with its design matrix."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
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
from suspnet.learning.ranks import AllReduce
from suspnet.learning.toeplitz import EquispacedDesign

MOST_EXACT = 5000
"""Number of samples above which `exact` warns: its kernel takes 0.2 GB, a factor of it as much."""
EASY_WAVES, SAMPLES_PER_WAVE = 1000, 100
"""`equispaced` costs less than `rff` up to so many waves, which its preconditioner inverts, or with
so many samples for each of its waves."""


@dataclass(frozen=True)
class MapKind:
    """A kind of feature map: its constructor, its class and its design matrix.

    ``make(X, sigma, n_components, seed, kernel_tol)`` returns the map for samples X, `holds` is the
    class that `restore` rebuilds from its tensors. `of_data`: the map depends on the samples;
    `float32`: its Gram matrix may be summed in single precision; `on_gpu`: it runs on other devices
    than the CPU.
    """

    make: Callable[[Tensor, float, int, int, float], FeatureMap]
    holds: Callable[..., FeatureMap]
    design: Callable[[Any, Tensor, AllReduce], Design] = DenseDesign
    of_data: bool = True
    float32: bool = False
    on_gpu: bool = True


MAPS = {
    "rff": MapKind(random_fourier, FourierFeatures, of_data=False, float32=True),
    "orf": MapKind(orthogonal_fourier, FourierFeatures, of_data=False, float32=True),
    "nystroem": MapKind(nystroem, LandmarkFeatures),
    "equispaced": MapKind(equispaced_fourier, EquispacedFeatures, EquispacedDesign, on_gpu=False),
    "exact": MapKind(exact, KernelColumns, KernelDesign),
}
"""Every feature map by name; a new one is added here."""


def automatic(
    X: Tensor,
    sigma: float,
    n_components: int,
    kernel_tol: float,
    *,
    is_plain: bool,
    is_narrow: bool,
) -> tuple[str, FeatureMap | None]:
    """Return the name of the map for samples `X` under ``feature_map="auto"``, and it if made.

    `exact` up to twice `n_components` samples, up to `MOST_EXACT` if the tube may hold samples,
    where it takes no longer than `rff`. Beyond, `equispaced` where finufft is installed and the
    modes are few, else `rff`. `is_plain`: this process has all samples, on the CPU, in float64, as
    `equispaced` needs them; `is_narrow`: few samples lie within the tube, for which the solver of
    `equispaced` takes few iterations.
    """
    if not is_plain:
        return "rff", None
    if len(X) <= (min(2 * n_components, MOST_EXACT) if is_narrow else MOST_EXACT):
        return "exact", None
    if is_narrow and importlib.util.find_spec("finufft") is not None:
        try:
            modes = equispaced_fourier(X, sigma, 0, 0, kernel_tol)
        except ValueError:  # more inputs or modes than it takes
            return "rff", None
        if len(modes.strengths) <= max(EASY_WAVES, len(X) / SAMPLES_PER_WAVE):
            return "equispaced", modes
    return "rff", None


def name_of(tensors: Collection[str]) -> str:
    """Return the name of the map that ``feature_map="auto"`` chose, from those of its tensors."""
    for name in ("exact", "equispaced"):
        if {field.name for field in fields(MAPS[name].holds)} == set(tensors):  # type: ignore[arg-type]
            return name
    return "rff"
