"""Fisher information of features of noisy curves, as benchmarks/ablation.py compares it.

Features of noisy curves scatter about those of the noise-free curve with a covariance S. With J the
derivative of the noise-free features, their information is J^T S^-1 J; the excess of its bound over
that of the curves is the loss by the features.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.estimates import Observer
from suspnet.curves.extraction import FeatureSet
from suspnet.curves.protocols import columns_of
from suspnet.ground.tensors import as_tensor
from suspnet.ground.types import FloatArray
from suspnet.vehicle import PARAMETERS

FEATURE_ROWS = 1024
"""Number of curves whose features are extracted at once."""
N_DRAWS = 64
"""Smallest number of noisy curves of each vehicle for the covariance of features."""
FEATURE_STEP = 0.01
"""Half the step of the central differences of features, relative to the parameter."""
LEAST_FOUND = 0.5
"""Smallest fraction of a vehicle's noisy curves that must have every feature."""


def feature_information(
    observer: Observer,
    extractor: FeatureSet,
    ratios: FloatArray,
    parameters: Sequence[str] = PARAMETERS,
    *,
    n_draws: int = N_DRAWS,
    seed: int = 0,
) -> FloatArray:
    """Return the information of features of noisy curves on some parameters, the others known.

    With S estimated from n draws of p features, (J^T S^-1 J)^-1 for q parameters is a Wishart
    matrix, on average (n - 1 - p + q) / (n - 1) times the true one (Muirhead, Aspects of
    Multivariate Statistical Theory, theorem 3.2.11); the result is corrected for that. J is by
    central differences. The information in the dependence of S on the parameters is neglected.

    `extractor` is fitted; `ratios`: (n_vehicles, 5); `n_draws`: noisy curves of each vehicle,
    ValueError if too few for the number of features. The result (n_vehicles, n_parameters,
    n_parameters), with respect to ratios to healthy, is NaN where a feature is missing from the
    noise-free curve, from a neighbouring one or from too many of the noisy ones.
    """
    n_features = len(extractor.names)
    least = int(np.ceil((n_features + 2) / LEAST_FOUND))
    if n_draws < least:
        raise ValueError(f"`n_draws` must be >= {least} for {n_features} features, got {n_draws}")
    columns = columns_of(parameters)
    blocks = as_tensor(ratios).split(max(1, FEATURE_ROWS // n_draws))
    seeds = np.random.SeedSequence(seed).generate_state(len(blocks))
    information = [
        _of_features(observer, extractor, rows, columns, n_draws, int(block_seed))
        for rows, block_seed in zip(blocks, seeds, strict=True)
    ]
    return np.concatenate(information)


def _of_features(
    observer: Observer,
    extractor: FeatureSet,
    rows: Tensor,
    columns: Sequence[int],
    n_draws: int,
    seed: int,
) -> FloatArray:
    """Return the information on the parameters in `columns`, shape (n, q, q)."""
    bins = observer.frequencies_hz
    noisy = observer.observe(rows.repeat_interleave(n_draws, dim=0), seed)
    values = extractor.extract(noisy, bins.to(noisy.device)).values.unflatten(0, (-1, n_draws))
    covariance, n_found = _feature_covariance(values)
    jacobian = _feature_jacobian(observer, extractor, rows, columns).to(values)
    # features in units of their own scatter: the matrix to be inverted has a unit diagonal
    scatter = covariance.diagonal(dim1=1, dim2=2).sqrt()
    correlation = covariance / (scatter[:, :, None] * scatter[:, None, :])
    weighted = jacobian / scatter[:, :, None]
    usable = torch.isfinite(weighted).all(dim=(1, 2)) & (n_found >= LEAST_FOUND * n_draws)
    information = torch.full((len(rows), len(columns), len(columns)), torch.nan).to(values)
    J = weighted[usable]
    # correct the bias of the inverse of an estimated covariance
    freedom = n_found[usable, None, None] - 1.0
    shrinkage = (freedom - len(extractor.names) + len(columns)) / freedom
    information[usable] = shrinkage * (J.mT @ torch.linalg.solve(correlation[usable], J))
    return np.asarray(information.cpu().numpy())


def _feature_covariance(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the covariance (n, p, p) of draws (n, n_draws, p) without NaN, and their number."""
    complete = torch.isfinite(values).all(dim=2)
    n_complete = complete.sum(dim=1)
    filled = torch.where(complete[:, :, None], values, 0.0)
    mean = filled.sum(dim=1, keepdim=True) / n_complete[:, None, None]
    centred = torch.where(complete[:, :, None], values - mean, 0.0)
    return centred.mT @ centred / (n_complete - 1)[:, None, None], n_complete


def _feature_jacobian(
    observer: Observer, extractor: FeatureSet, rows: Tensor, columns: Sequence[int]
) -> Tensor:
    steps = torch.eye(len(PARAMETERS), dtype=rows.dtype)[list(columns)] * FEATURE_STEP
    moved = rows[:, None, None] * (1 + torch.stack([steps, -steps]))  # (n, 2, q, 5)
    curves = observer.noise_free(moved.flatten(0, 2))
    bins = observer.frequencies_hz
    values = extractor.extract(curves, bins.to(curves.device)).values
    above, below = values.unflatten(0, (len(rows), 2, len(columns))).unbind(1)
    size = (2 * FEATURE_STEP * rows[:, list(columns)]).to(values)
    slopes: Tensor = (above - below) / size[:, :, None]
    return slopes.mT  # (n, p, q)
