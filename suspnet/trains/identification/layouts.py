"""How well layouts of sensors show each spring and damper of a bogie, before sensors are bought.

The Fisher information of a trip is that of the spectral matrix of its sensors, the inputs' spectra
unknown in every bin. On a trip of a known vehicle its twelve parts and its mass are unknown; on one
of a vehicle that was learnt, all its numbers z are too, with the information of their prior and of
the healthy trips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.expected_spectra import noise_densities
from suspnet.ground.parameters import COMPONENTS
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_misfit import WEAR
from suspnet.trains.identification.bogie_trips import HIGH_HZ, LOW_HZ
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import MASS_DEVIATION, MASS_MEAN, LogNormal
from suspnet.vehicle.track import TrackSpectrum, acceleration_density, track_spectrum

_BOXES = tuple(f"axle_box_axle{axle}_{side}" for axle in (1, 2) for side in ("left", "right"))
_FRAME, _BODY = ("frame_axle1_left", "frame_axle1_right"), ("body_left", "body_right")
_CENTRE, _DIAGONAL = (
    ("frame_centre_left", "frame_centre_right"),
    ("frame_axle1_left", "frame_axle2_right"),
)
LAYOUTS: Mapping[str, tuple[str, ...]] = {
    "eight: 4 axle boxes, 2 frame corners, 2 body": (*_BOXES, *_DIAGONAL, *_BODY),
    "seven: 4 axle boxes, 2 frame corners, 1 body": (*_BOXES, *_DIAGONAL, _BODY[0]),
    "seven, body in the middle": (*_BOXES, *_DIAGONAL, "body_middle"),
    "six: pairs, frame above the axle": (*_BOXES[:2], *_FRAME, *_BODY),
    "six: pairs, frame at its centre": (*_BOXES[:2], *_CENTRE, *_BODY),
    "five: body on one side": (*_BOXES[:2], *_FRAME, _BODY[0]),
    "five: axle box on one side": (_BOXES[0], *_FRAME, *_BODY),
    "four: no axle box": (*_FRAME, *_BODY),
    "four: no body": (*_BOXES[:2], *_FRAME),
    "three: one side": (_BOXES[0], _FRAME[0], _BODY[0]),
}
"""Places of the sensors of each layout; frame corners are on a diagonal."""
SPACING_HZ = 0.35
"""Distance of the bins, each of which counts for all frequencies up to the next: bounds differ by 5
% from those at 0.1 Hz."""
WORN = 0.8
"""Ratio of the one part that is worn on a trip."""
HEALTHY_MASSES = (0.95, 1.05, 1.15)
"""Ratios of the car-body masses of the healthy trips, a third of them each."""
NUISANCES = ("cross_level", "alignment", "wheelset_share", "wheelset_roll_share")
"""Numbers of the vehicle that scale the unknown spectra of the inputs."""


@dataclass(frozen=True)
class LayoutBounds:
    """Cramer-Rao bounds of ``COMPONENTS`` for a layout, relative standard deviations, (13,), [%].

    They are the largest ones over twelve trips, on each of which one part is worn to ``WORN``.
    `known` is for a vehicle of which all other numbers are known, `learnt` for one that was learnt
    from healthy trips.
    """

    layout: str
    sensors: tuple[str, ...]
    known: FloatArray
    learnt: FloatArray


def layout_bounds(
    generator: SpatialVehicle,
    layouts: Mapping[str, Sequence[str]] = LAYOUTS,
    settings: EstimateSettings | None = None,
    n_healthy: int = 5,
    wheelset_share: float = 0.0,
) -> list[LayoutBounds]:
    """Return the bounds of each layout of sensors for one trip.

    Parameters
    ----------
    generator : SpatialVehicle
        The vehicle, its parts and its speed. Its numbers have the prior as their distribution.
    layouts : mapping of names to places of sensors
    settings : EstimateSettings, optional
        Length, track and noise of the trips, and the band if it is not 0.5 to 18 Hz.
    n_healthy : int
        Number of healthy trips that the vehicle is learnt from.
    wheelset_share : float, [-]
        Density of what lifts and what rolls each wheelset alone, over that of the mean track; both
        spectra are unknown too, the same for all wheelsets.

    Raises
    ------
    TypeError, ValueError
        If a place is unknown, or a number is out of range.

    Examples
    --------
    >>> from suspnet import SpatialVehicle, layout_bounds, read_vehicles
    >>> vehicle = SpatialVehicle(read_vehicles()["am96"], parts=("frame_sway", "frame_yaw"))
    >>> (pairs,) = layout_bounds(vehicle, {"pairs": vehicle.sensors})
    >>> pairs.known.shape, bool((pairs.learnt > pairs.known).all())
    ((13,), True)
    """
    settings = settings or EstimateSettings()
    check_number("n_healthy", n_healthy, low=1, most=1000, whole=True)
    check_number("wheelset_share", wheelset_share, low=0, most=1)
    bounds = []
    for name, places in layouts.items():
        trip = _Trip.of(generator, tuple(places), settings, wheelset_share)
        known, learnt = trip.bounds(n_healthy)
        bounds.append(LayoutBounds(name, tuple(places), known, learnt))
    return bounds


@dataclass(frozen=True)
class _Trip:
    """A layout's trip: vehicle with the prior of its numbers, bins, densities, averages."""

    vehicle: SpatialVehicle
    medians: Tensor
    frequencies_hz: Tensor
    density: Tensor
    noise: Tensor
    n_averages: float

    @classmethod
    def of(
        cls,
        generator: SpatialVehicle,
        places: tuple[str, ...],
        settings: EstimateSettings,
        wheelset_share: float,
    ) -> _Trip:
        """Return the trip of a layout."""
        parts = tuple(part for part in generator.parts if part != "wheelsets")
        parts += ("wheelsets",) if wheelset_share else ()
        vehicle = replace(generator, sensors=places, parts=parts, distribution=None)
        prior = LogNormal.prior(vehicle._groups, vehicle.quantities).without(NUISANCES)
        vehicle = replace(vehicle, distribution=prior)
        medians = vehicle.complete(torch.ones(1, len(COMPONENTS), dtype=torch.float64)).clone()
        if wheelset_share:
            nominal = dict(zip(vehicle.columns, vehicle.nominal_values(), strict=True))
            for name in NUISANCES[2:]:
                medians[0, vehicle.columns.index(name)] = wheelset_share / nominal[name]
        low = LOW_HZ if settings.low_hz is None else settings.low_hz
        high = HIGH_HZ if settings.high_hz is None else settings.high_hz
        bins = torch.arange(low, high + 1e-9, SPACING_HZ, dtype=torch.float64)
        track = track_spectrum(settings.track)
        density = acceleration_density(track, bins.numpy(), vehicle.speed_m_per_s)
        noise = _noise(vehicle, medians, track, settings)
        n_averages = 60 * settings.minutes * SPACING_HZ
        return cls(vehicle, medians, bins, torch.as_tensor(density), noise, n_averages)

    def bounds(self, n_healthy: int) -> tuple[FloatArray, FloatArray]:
        """Return the largest bounds with all other numbers known, and with them learnt, (13,)."""
        assert self.vehicle.distribution is not None
        prior = np.linalg.inv(np.array(self.vehicle.distribution.covariance))
        n, mass = len(prior), len(prior) + len(COMPONENTS) - 1
        for ratio in HEALTHY_MASSES:
            information = self._information({COMPONENTS[-1]: ratio})
            # each healthy trip has an unknown mass of its own
            shared = information[:n, mass] / np.sqrt(information[mass, mass] + MASS_DEVIATION**-2)
            n_trips = n_healthy / len(HEALTHY_MASSES)
            prior += n_trips * (information[:n, :n] - np.outer(shared, shared))
        prior_of_trip = np.diag([WEAR**-2] * (len(COMPONENTS) - 1) + [MASS_DEVIATION**-2])
        known, learnt = [], []
        for part in COMPONENTS[:-1]:
            whole = self._information({part: WORN, COMPONENTS[-1]: np.exp(MASS_MEAN)})
            whole[n:, n:] += prior_of_trip
            known.append(np.diag(np.linalg.inv(whole[n:, n:])))
            whole[:n, :n] += prior
            learnt.append(np.diag(np.linalg.inv(whole))[n:])
        return 100 * np.sqrt(np.max(known, axis=0)), 100 * np.sqrt(np.max(learnt, axis=0))

    def _information(self, ratios: Mapping[str, float]) -> FloatArray:
        """Return the information about the logarithms of z and of ``COMPONENTS``."""
        rows = self.medians.clone()
        for name, ratio in ratios.items():
            rows[0, COMPONENTS.index(name)] = ratio
        columns = [*self.vehicle.uncertain_columns, *range(len(COMPONENTS))]
        directions = torch.eye(len(self.vehicle.columns), dtype=torch.float64)[columns]
        responses, changes = self.vehicle.channels_along(rows, self.frequencies_hz, directions)
        n = sum(not name.startswith("wheelset") for name in self.vehicle.inputs)
        further = range(n, len(self.vehicle.inputs))
        alone = [list(further[i : i + 4]) for i in range(0, len(further), 4)]  # four wheelsets
        coherent = range(n)
        if len(self.vehicle.places) <= n:
            coherent, alone = range(1, n), [[0], *alone]
        information = spectral_information(
            responses[0], changes[0], self.density, self.noise, coherent, alone
        )
        return self.n_averages * information


def _noise(
    vehicle: SpatialVehicle, medians: Tensor, track: TrackSpectrum, settings: EstimateSettings
) -> Tensor:
    """Return the noise density of each sensor, (m,): white, below its signal by `snr_db`."""
    kinds = dict(zip(("axle_box", "frame", "body"), settings.rates_hz, strict=True))
    rates = [next(kinds[kind] for kind in kinds if p.startswith(kind)) for p in vehicle.places]
    return noise_densities(
        lambda grid: vehicle.channels(medians, grid)[0].abs().square().sum(dim=0).numpy(),
        lambda grid: acceleration_density(track, grid, vehicle.speed_m_per_s),
        rates,
        settings.snr_db,
    )


def spectral_information(
    responses: Tensor,
    changes: Tensor,
    density: Tensor,
    noise: Tensor,
    coherent: Sequence[int],
    alone: Sequence[Sequence[int]] = (),
) -> FloatArray:
    """Return the Fisher information of one average, (n_directions, n_directions).

    With H the responses of the sensors, D the spectral matrix of the inputs and N the sensors'
    noise, the spectral matrix is S = H D H^* + N. The information of n averages about numbers theta
    is that of Slepian and Bangs::

        I_jk = sum over the bins of n tr(W_j W_k),    W_j = L^-1 (dS / d theta_j) L^-*,  S = L L^*

    D is unknown in every bin: W_j is projected off the W of D's own numbers. This is J^T J of the
    residuals of `trains.spectra.subspace` at the exact S for D of any coherence, and of those of
    `covariance_matching` for an input that is incoherent with the others, so that fitting reaches
    it. N is known here: its estimate from all bins costs little.

    Parameters
    ----------
    responses, changes : Tensor of shape (p, m, n_freq), (n_directions, p, m, n_freq)
        H and its derivatives, complex.
    density : Tensor of shape (n_freq,), [(m/s^2)^2/Hz]
        True density of each input, which are independent of each other.
    noise : Tensor of shape (m,), [(m/s^2)^2/Hz]
    coherent : sequence of int
        Inputs whose spectral matrix may be anything.
    alone : sequence of sequences of int
        Further inputs; those of each sequence are independent, and of one unknown density.
    """
    a = responses.permute(2, 1, 0)
    s = density[:, None, None] * (a @ a.mH) + torch.diag(noise).to(a.dtype)
    root = torch.linalg.cholesky(s)
    a = torch.linalg.solve_triangular(root, a, upper=False)
    n_freq, m, p = a.shape
    moved = changes.permute(3, 2, 0, 1).reshape(n_freq, m, -1)
    moved = torch.linalg.solve_triangular(root, moved, upper=False)
    moved = moved.reshape(n_freq, m, -1, p).transpose(1, 2)  # (n_freq, n_directions, m, p)
    half = density[:, None, None, None] * (moved @ a.mH[:, None])
    spectra = [a[:, :, list(inputs)] @ a[:, :, list(inputs)].mH for inputs in alone]
    w = torch.cat([half + half.mH, *(spectrum[:, None] for spectrum in spectra)], dim=1)
    if coherent:
        basis = torch.linalg.qr(a[:, :, list(coherent)])[0]
        projector = (basis @ basis.mH)[:, None]
        w = w - projector @ w @ projector
    rows = torch.view_as_real(w).flatten(2)
    n = len(changes)
    rows, nuisances = rows[:, :n], rows[:, n:]
    inverse = torch.linalg.pinv(nuisances @ nuisances.mT, hermitian=True)
    shared = rows @ nuisances.mT
    information = rows @ rows.mT - shared @ inverse @ shared.mT
    return np.asarray(information.sum(dim=0).numpy())
