"""Information in the recordings themselves: what sensors at given places could tell at best.

Sensors whose responses from the axle box are h = (1, G_p, G_p G_s, ...) record, in each frequency
bin, a complex normal vector with the spectral matrix::

    S = S_w h h^H + diag(N),    S_w the track's level, N the sensors' noise densities

The information in n averages of it is, by Whittle's likelihood (P. Whittle, The analysis of
multiple stationary time series, Journal of the Royal Statistical Society B 15, 1953)::

    I_ij = n / r sum over bins of Re tr(S^-1 dS_i S^-1 dS_j)

with r from the correlation of the bins, as in `information.estimate_information`. N is known, S_w
is not: it is one more unknown of each bin, eliminated by its Schur complement. S is the identity
plus a rank of one, once each sensor is divided by its noise, so that both steps have a closed form.
With a = sqrt(S_w / N) h, q = |a|^2 and u_i the part of da_i that is perpendicular to a::

    I_ij - I_is I_sj / I_ss = n / r sum over bins of 2 q / (1 + q) Re(u_i^H u_j)

What moves all sensors alike, in size or in phase, cannot be told from the track: no part of u.

The recordings tell more than the estimate IV made of them, since that lets neighbouring bins leak
into each other. H1, H2 and Hv may seem to tell more in strong noise: they are biased by an amount
that depends on the track's level, and `estimate_information` takes that level as known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from suspnet.data.estimates import EstimateObserver
from suspnet.dynamics import PARAMETERS, ResponseGenerator, VerticalVehicle

ROWS = 128
ROUNDING = 1e-24
"""What is left of a slope's square that lies along a: no information."""
THREE_SENSORS = ("axle box", "bogie", "body")
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FromAxleBox:
    """Responses of a generator's sensors on frame and body, both from the axle box: G_p, G_p G_s.

    In the shape of a generator, so that whatever takes one takes this.

    Parameters
    ----------
    generator : ResponseGenerator
    """

    generator: ResponseGenerator

    def responses(self, ratios: Tensor, frequencies_hz: Tensor) -> tuple[Tensor, Tensor]:
        """Return complex responses from axle box to frame and to body, (n_vehicles, n_freq)."""
        primary, secondary = self.generator.responses(ratios, frequencies_hz)
        return primary, primary * secondary

    def magnitudes(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return their absolute values, shape (n_vehicles, 2, n_freq)."""
        return torch.stack(self.responses(ratios, frequencies_hz), dim=1).abs()


@dataclass(frozen=True)
class Places:
    """Where a generator's vehicle can carry sensors: the three it has, then those it could have.

    Parameters
    ----------
    generator : ResponseGenerator
        A quarter car has three places only. A vertical vehicle has six: besides its own three the
        other place on the frame (above the axle, or the centre), the body above the other bogie,
        and the second axle box of the measured bogie.
    """

    generator: ResponseGenerator

    @property
    def elsewhere(self) -> VerticalVehicle | None:
        """The generator with its frame and body sensor at the further places, if there are any."""
        generator = self.generator
        if not isinstance(generator, VerticalVehicle):
            return None
        body_sensor_m = _other_body_place(generator)
        if generator.frame_sensor == "axle":
            return replace(generator, frame_sensor="centre", body_sensor_m=body_sensor_m)
        return replace(generator, frame_sensor="axle", body_sensor_m=body_sensor_m)

    @property
    def further(self) -> tuple[str, ...]:
        """Names of the places besides axle box, bogie and body."""
        elsewhere = self.elsewhere
        if elsewhere is None:
            return ()
        frame = {"centre": "frame centre", "axle": "frame above the axle"}[elsewhere.frame_sensor]
        bogie = "other" if elsewhere.body_sensor_m else "measured"
        return frame, f"body above the {bogie} bogie", "second axle box"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all places."""
        return THREE_SENSORS + self.further

    def rates_hz(self, three: Sequence[float]) -> tuple[float, ...]:
        """Return the sampling rate of each place from those of axle box, bogie and body, [Hz]."""
        axle_box, bogie, body = three
        return (axle_box, bogie, body, *((bogie, body, axle_box) if self.further else ()))

    def responses(self, ratios: Tensor, frequencies_hz: Tensor) -> Tensor:
        """Return the response from the axle box to each place.

        The track reaches the second axle box a wheelbase later, or earlier if it leads.

        Parameters
        ----------
        ratios : tensor of shape (n_vehicles, 5), [-]
        frequencies_hz : tensor of shape (n_freq,), [Hz]

        Returns
        -------
        complex tensor of shape (n_vehicles, n_places, n_freq), [-]
        """
        bogie, body = FromAxleBox(self.generator).responses(ratios, frequencies_hz)
        found = [torch.ones_like(bogie), bogie, body]
        elsewhere = self.elsewhere
        if elsewhere is not None:
            found += FromAxleBox(elsewhere).responses(ratios, frequencies_hz)
            found.append(
                _second_axle_box(elsewhere, frequencies_hz.to(bogie.device)).expand_as(bogie)
            )
        return torch.stack(found, dim=1)


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
        How many sensors each choice has at each of ``Places(generator).names``; two at one place
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
    places, settings = Places(observer.generator), observer.settings
    numbers = _checked(counts, len(places.names))
    bins = observer.frequencies_hz
    noise = observer.noise_densities(places.responses, places.rates_hz(settings.rates_hz))
    track = torch.as_tensor(observer.track_density(bins.numpy()))
    level = (track / noise[:, None]).sqrt()  # (n_places, n_freq)
    correlation = settings.welch.correlation()
    per_bin = settings.n_averages / float(2 * correlation.sum() - correlation[0])
    blocks = []
    for rows in torch.as_tensor(ratios).split(ROWS):
        response = places.responses(rows, bins)
        seen = response * level.to(response.device)
        slopes = torch.stack(
            [_slope(places, rows, bins, name) * level.to(response.device) for name in parameters],
            dim=1,
        )  # (n, n_parameters, n_places, n_freq)
        found = [_without_track(seen, slopes, choice.to(seen.device)) for choice in numbers]
        blocks.append(per_bin * torch.stack(found).cpu().numpy())
    return np.concatenate(blocks, axis=1)


def _slope(places: Places, rows: Tensor, frequencies_hz: Tensor, parameter: str) -> Tensor:
    """Return the derivative of each place's response with respect to one ratio."""
    tangent = torch.zeros_like(rows)
    tangent[:, PARAMETERS.index(parameter)] = 1
    pair = torch.func.jvp(lambda r: places.responses(r, frequencies_hz), (rows,), (tangent,))
    slope: Tensor = pair[1]
    return slope


def _without_track(seen: Tensor, slopes: Tensor, count: Tensor) -> Tensor:
    """Return sum over bins of 2 q / (1 + q) Re(u_i^H u_j) with `count` sensors at each place.

    Parameters
    ----------
    seen : complex tensor of shape (n, n_places, n_freq)
        a of one sensor at each place.
    slopes : complex tensor of shape (n, n_parameters, n_places, n_freq)
        Its derivatives.
    count : tensor of shape (n_places,)
    """
    used = count > 0
    many = count[used].sqrt()[:, None]
    a, slopes = seen[:, used] * many, slopes[:, :, used] * many
    q = a.abs().square().sum(dim=1)[:, None, None]
    along = (a.conj()[:, None] * slopes).sum(dim=2, keepdim=True) / q
    across = slopes - along * a[:, None]
    size = (across.abs().square().sum(dim=(2, 3)), slopes.abs().square().sum(dim=(2, 3)))
    across[size[0] <= ROUNDING * size[1]] = 0
    flat = torch.view_as_real(across * (2 * q / (1 + q)).sqrt()).flatten(2)
    return flat @ flat.transpose(1, 2)


def _second_axle_box(vehicle: VerticalVehicle, frequencies_hz: Tensor) -> Tensor:
    """Return the response from the measured axle box to the bogie's other one: a pure delay."""
    half_wheelbase_m = vehicle.vehicle.half_wheelbase_m
    assert half_wheelbase_m is not None
    delay_s = 2 * half_wheelbase_m / vehicle.speed_m_per_s
    behind = 1.0 if vehicle.axle == "leading" else -1.0
    return torch.exp(-2j * math.pi * behind * delay_s * frequencies_hz)


def _other_body_place(generator: VerticalVehicle) -> float:
    """Return the place above the other bogie, or above the measured one if the sensor is there."""
    half_pivot_m = generator.vehicle.half_pivot_distance_m
    assert half_pivot_m is not None
    other_m = -2 * half_pivot_m if generator.bogie == "leading" else 2 * half_pivot_m
    return 0.0 if math.isclose(generator.body_sensor_m, other_m) else other_m


def _checked(counts: ArrayLike, n_places: int) -> Tensor:
    numbers = torch.as_tensor(np.asarray(counts, dtype=np.float64))
    if numbers.ndim != 2 or numbers.shape[1] != n_places:
        raise ValueError(
            f"`counts` must have shape (n_choices, {n_places}), got {tuple(numbers.shape)}"
        )
    if not bool((numbers >= 0).all() and (numbers.sum(dim=1) > 0).all()):
        raise ValueError("`counts` must be >= 0 and each choice must have a sensor")
    return numbers
