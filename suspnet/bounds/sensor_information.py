"""Fisher information of recordings by sensors at given places.

The responses of the sensors to the track are the columns of H, one for each independent input (the
mean of both rails and, where sensors measure roll, the cross level). In each frequency bin the
sensors record a complex normal vector with the spectral matrix::

    S = S_w H H^H + diag(N),    S_w the track's level, N the sensors' noise densities

The information in n averages of it is, by Whittle's likelihood (P. Whittle, The analysis of
multiple stationary time series, Journal of the Royal Statistical Society B 15, 1953)::

    I_ij = n / r sum over bins of Re tr(S^-1 dS_i S^-1 dS_j)

with r from the correlation of the bins, ``Welch.correlated_bins``. N is known; S_w is one more
unknown of each bin, eliminated by its Schur complement. After division of each sensor by the root
of its noise, S is the identity plus A A^H, A = sqrt(S_w / N) H.

Sensors on the body do not count above ``body_high_hz``, where G_s is not used: A is 0 there.

A generator's uncertain numbers are further unknowns, about the median of their distribution, which
is the prior: see `without_uncertain`.

Recordings hold more information than their IV estimate, in which neighbouring bins leak into each
other. H1, H2 and Hv may seem to hold more in strong noise: their bias depends on the track's level,
which `fisher_information` takes as known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.bounds.information import derivative_of_rows, without_uncertain
from suspnet.curves.curves import Directions, every_direction
from suspnet.curves.estimate_observer import EstimateObserver
from suspnet.curves.protocols import columns_of
from suspnet.ground.tensors import as_tensor
from suspnet.ground.types import FloatArray
from suspnet.vehicle import PARAMETERS, ResponseGenerator

ROWS = 32
ROUNDING = 1e-24
"""Fraction of a slope's square that rounding leaves where the slope is parallel to a."""
THREE_SENSORS = ("axle box", "bogie", "body")


def sensor_places(generator: ResponseGenerator) -> tuple[str, ...]:
    """Return the names of the places whose sensors `recording_information` counts."""
    return THREE_SENSORS


def recording_information(
    observer: EstimateObserver, ratios: FloatArray, parameters: Sequence[str], counts: ArrayLike
) -> FloatArray:
    """Return the information of recordings on some parameters, for each choice of sensors.

    By Whittle's likelihood, with the track's level unknown in each bin; the formulae are in the
    docstring of the module ``suspnet.bounds.sensor_information``. `observer` has length, track,
    noise and bins of the trip; `ratios`: (n_vehicles, 5), [-]; `parameters` are from
    ``PARAMETERS``, the others known; `counts` (n_choices, n_places): number of sensors at each of
    ``sensor_places``, where two have half the noise density of one. ValueError if the counts have
    another shape or a choice has no sensor. The result (n_choices, n_vehicles, n_parameters,
    n_parameters) is with respect to ratios to healthy.
    """
    generator, settings = observer.generator, observer.settings
    numbers = _checked(counts, len(THREE_SENSORS))
    bins = observer.frequencies_hz
    noise = observer.noise
    track = torch.as_tensor(observer.mean.track_density(bins.numpy()))
    level = (track / noise[:, None]).sqrt()  # (n_places, n_freq)
    level[2, observer.beyond[1]] = 0.0
    per_bin = settings.n_averages / settings.welch.correlated_bins
    uncertain = every_direction(generator)
    blocks = []
    for rows in as_tensor(ratios).split(ROWS):
        seen = generator.channels(rows, bins)
        slopes = _slopes(generator, rows, bins, parameters, uncertain)
        seen, slopes = seen * level.to(seen.device), slopes * level.to(seen.device)
        per_choice = [_without_track(seen, slopes, choice.to(seen.device)) for choice in numbers]
        blocks.append(per_bin * torch.stack(per_choice).cpu().numpy())
    return without_uncertain(np.concatenate(blocks, axis=1), len(parameters))


def _slopes(
    generator: ResponseGenerator,
    rows: Tensor,
    frequencies_hz: Tensor,
    parameters: Sequence[str],
    uncertain: Directions,
) -> Tensor:
    """Return the derivative of each place, (n, n_unknown, n_inputs, n_places, n_freq).

    The unknowns are the parameters, then the coordinates of the uncertain numbers.
    """
    n_columns = len(PARAMETERS)
    start = torch.cat([rows, rows.new_zeros(len(rows), uncertain.n)], dim=1)

    def parts(x: Tensor) -> Tensor:
        """Return real and imaginary parts of each place, for numbers of the vehicles."""
        vehicles = uncertain.vehicles(x[:, :n_columns], x[:, n_columns:])
        return torch.view_as_real(generator.channels(vehicles, frequencies_hz))

    columns = [*columns_of(parameters), *range(n_columns, n_columns + uncertain.n)]
    return torch.view_as_complex(derivative_of_rows(parts, start, columns).contiguous())


def _without_track(a: Tensor, da: Tensor, count: Tensor) -> Tensor:
    """Return the sum over bins of one average's information, the track's level eliminated.

    That is Re tr(X_i X_j) - Re tr(X_i X_s) Re tr(X_s X_j) / tr(X_s X_s), X_i = L^-1 dS_i L^-H with
    L L^H = S = 1 + A A^H; X_s belongs to the level's logarithm.

    `a`: (n, n_inputs, n_places, n_freq) for one sensor at each place; `da`: its derivatives,
    (n, n_unknown, n_inputs, n_places, n_freq); `count`: (n_places,).
    """
    used = count > 0
    many = count[used].sqrt()[:, None]
    a, da = a[:, :, used] * many, da[:, :, :, used] * many
    a, da = a.movedim(-1, 1).mT, da.movedim(-1, 2).mT  # (n, [n_unknown,] n_freq, places, inputs)
    identity = torch.eye(a.shape[-2]).to(a)
    whitening = torch.linalg.solve_triangular(
        torch.linalg.cholesky(identity + a @ a.mH), identity, upper=False
    )
    a, da = (whitening @ a)[:, None], whitening[:, None] @ da
    level, half = a @ a.mH, da @ a.mH
    x = half + half.mH
    along = (x * level.conj()).sum(dim=(-2, -1), keepdim=True).real
    size = level.abs().square().sum(dim=(-2, -1), keepdim=True)
    u = x - along / size.where(size > 0, 1.0) * level
    u[u.abs().square().sum(dim=(2, 3, 4)) <= ROUNDING * x.abs().square().sum(dim=(2, 3, 4))] = 0
    flat = torch.view_as_real(u).flatten(2)
    return flat @ flat.transpose(1, 2)


def _checked(counts: ArrayLike, n_places: int) -> Tensor:
    numbers = as_tensor(counts)
    if numbers.ndim != 2 or numbers.shape[1] != n_places:
        raise ValueError(
            f"`counts` must have shape (n_choices, {n_places}), got {tuple(numbers.shape)}"
        )
    if not bool((numbers >= 0).all() and (numbers.sum(dim=1) > 0).all()):
        raise ValueError("`counts` must be >= 0 and each choice must have a sensor")
    return numbers
