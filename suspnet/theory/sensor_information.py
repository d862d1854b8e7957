"""Fisher information of recordings by sensors at given places.

Sensors whose responses from the axle box are h = (1, G_p, G_p G_s, ...) record, in each frequency
bin, a complex normal vector with the spectral matrix::

    S = S_w h h^H + diag(N),    S_w the track's level, N the sensors' noise densities

The information in n averages of it is, by Whittle's likelihood (P. Whittle, The analysis of
multiple stationary time series, Journal of the Royal Statistical Society B 15, 1953)::

    I_ij = n / r sum over bins of Re tr(S^-1 dS_i S^-1 dS_j)

with r from the correlation of the bins, ``Welch.correlated_bins``. N is known, S_w
is not: it is one more unknown of each bin, eliminated by its Schur complement. S is the identity
plus a rank of one, once each sensor is divided by its noise, so that both steps have a closed form.
With a = sqrt(S_w / N) h, q = |a|^2 and u_i the part of da_i that is perpendicular to a::

    I_ij - I_is I_sj / I_ss = n / r sum over bins of 2 q / (1 + q) Re(u_i^H u_j)

What moves all sensors alike, in size or in phase, cannot be told from the track: no part of u.

The recordings hold more information than their IV estimate, in which neighbouring bins leak into
each other. H1, H2 and Hv may seem to hold more in strong noise: they are biased by an amount that
depends on the track's level, and `fisher_information` takes that level as known.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.data.estimates import EstimateObserver
from suspnet.dynamics import PARAMETERS, ResponseGenerator
from suspnet.types import FloatArray

ROWS = 128
ROUNDING = 1e-24
"""Share of a slope's square that rounding leaves where the slope is parallel to a."""
THREE_SENSORS = ("axle box", "bogie", "body")


def places(generator: ResponseGenerator) -> tuple[str, ...]:
    """Return the names of the places of sensors: the three, then ``further_places``."""
    return THREE_SENSORS + generator.further_places


def _rates_hz(generator: ResponseGenerator, three: Sequence[float]) -> tuple[float, ...]:
    """Return the sampling rate of each place from those of axle box, bogie and body, [Hz]."""
    axle_box, bogie, body = three
    return (axle_box, bogie, body, *((bogie, body, axle_box) if generator.further_places else ()))


def place_responses(generator: ResponseGenerator, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
    """Return the response from the axle box to each of ``places``, (n_vehicles, n_places, n_freq).

    Parameters
    ----------
    generator : ResponseGenerator
    ratios : tensor of shape (n_vehicles, 5), [-]
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    """
    bogie, to_body = generator.responses(ratios, frequencies_hz)
    three = torch.stack([torch.ones_like(bogie), bogie, bogie * to_body], dim=1)
    return torch.cat([three, generator.further_responses(ratios, frequencies_hz)], dim=1)


def recording_information(
    observer: EstimateObserver, ratios: FloatArray, parameters: Sequence[str], counts: ArrayLike
) -> FloatArray:
    """Return the information of recordings on some parameters, for each choice of sensors.

    The formulae stand at the head of this module.

    Parameters
    ----------
    observer : EstimateObserver
        How long the trip is, on which track, with which noise and bins.
    ratios : array of shape (n_vehicles, 5), [-]
    parameters : sequence of str
        From ``PARAMETERS``; the others are known.
    counts : array of shape (n_choices, n_places)
        How many sensors each choice has at each of ``places(generator)``; two at one place
        have half the noise density of one.

    Returns
    -------
    array of shape (n_choices, n_vehicles, n_parameters, n_parameters)
        With respect to ratios to healthy.

    Raises
    ------
    ValueError
        If the counts have another shape, or a choice has no sensor.
    """
    generator, settings = observer.generator, observer.settings
    numbers = _checked(counts, len(places(generator)))
    bins = observer.frequencies_hz
    rates_hz = _rates_hz(generator, settings.rates_hz)
    noise = observer.noise_densities(functools.partial(place_responses, generator), rates_hz)
    track = torch.as_tensor(observer.track_density(bins.numpy()))
    level = (track / noise[:, None]).sqrt()  # (n_places, n_freq)
    per_bin = settings.n_averages / settings.welch.correlated_bins
    blocks = []
    for rows in torch.as_tensor(ratios).split(ROWS):
        response = place_responses(generator, rows, bins)
        seen = response * level.to(response.device)
        slopes = torch.stack(
            [_slope(generator, rows, bins, name) * level.to(seen.device) for name in parameters],
            dim=1,
        )  # (n, n_parameters, n_places, n_freq)
        found = [_without_track(seen, slopes, choice.to(seen.device)) for choice in numbers]
        blocks.append(per_bin * torch.stack(found).cpu().numpy())
    return np.concatenate(blocks, axis=1)


def _slope(
    generator: ResponseGenerator, rows: Tensor, frequencies_hz: Tensor, parameter: str
) -> Tensor:
    """Return the derivative of each place's response with respect to one ratio."""
    tangent = torch.zeros_like(rows)
    tangent[:, PARAMETERS.index(parameter)] = 1
    pair = torch.func.jvp(
        lambda r: place_responses(generator, r, frequencies_hz), (rows,), (tangent,)
    )
    slope: Tensor = pair[1]
    return slope


def _without_track(a: Tensor, da: Tensor, count: Tensor) -> Tensor:
    """Return sum over bins of 2 q / (1 + q) Re(u_i^H u_j) with `count` sensors at each place.

    Parameters
    ----------
    a : complex tensor of shape (n, n_places, n_freq)
        Of one sensor at each place.
    da : complex tensor of shape (n, n_parameters, n_places, n_freq)
        The derivatives of a.
    count : tensor of shape (n_places,)
    """
    used = count > 0
    many = count[used].sqrt()[:, None]
    a, da = a[:, used] * many, da[:, :, used] * many
    q = a.abs().square().sum(dim=1)[:, None, None]
    along = (a.conj()[:, None] * da).sum(dim=2, keepdim=True) / q
    u = da - along * a[:, None]
    size = (u.abs().square().sum(dim=(2, 3)), da.abs().square().sum(dim=(2, 3)))
    u[size[0] <= ROUNDING * size[1]] = 0
    flat = torch.view_as_real(u * (2 * q / (1 + q)).sqrt()).flatten(2)
    return flat @ flat.transpose(1, 2)


def _checked(counts: ArrayLike, n_places: int) -> Tensor:
    """Return the counts as a tensor; raise ValueError if they are not such a table."""
    numbers = torch.as_tensor(np.asarray(counts, dtype=np.float64))
    if numbers.ndim != 2 or numbers.shape[1] != n_places:
        raise ValueError(
            f"`counts` must have shape (n_choices, {n_places}), got {tuple(numbers.shape)}"
        )
    if not bool((numbers >= 0).all() and (numbers.sum(dim=1) > 0).all()):
        raise ValueError("`counts` must be >= 0 and each choice must have a sensor")
    return numbers
