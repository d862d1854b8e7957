"""Bounds of sensor layouts: naive information, scatter of fits, what sensors buy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_bogie_fit import BINS, MASSES, UNCERTAIN, drawn, trip
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.ground.parameters import COMPONENTS
from suspnet.trains.fits.bogie_fit import commission_bogie, fit_parts
from suspnet.trains.fits.bogie_misfit import WEAR, BogieMisfit
from suspnet.trains.fits.bogie_search import search
from suspnet.trains.fits.posterior import posterior_covariance
from suspnet.trains.identification import layouts
from suspnet.trains.identification.layouts import (
    LAYOUTS,
    _Trip,
    layout_bounds,
    spectral_information,
)
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.covariance_matching import CovarianceMisfit
from suspnet.trains.spectra.subspace import SpectralMatrix, SubspaceMisfit
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import MASS_DEVIATION, MASS_MEAN

PARTS = ("bushings", "sensors", "frame_sway", "frame_yaw", "body_yaw")
GENERATOR = SpatialVehicle(AM96, parts=PARTS)
SETTINGS = EstimateSettings()
SEVEN, NO_BOX = "seven: 4 axle boxes, 2 frame corners, 1 body", "four: no axle box"
SIX, NO_BODY = "six: pairs, frame above the axle", "four: no body"
NOISE = {"axle_box": 4e-3, "frame": 5e-6, "body": 2e-7}
N_DRAWS, N_AVERAGES = 30, 400


@pytest.fixture(scope="module", autouse=True)
def few_bins():
    """Take a third of the bins: the sums over them differ little."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layouts, "SPACING_HZ", 1.0)
        yield


def normal(rng, *shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def random_case(seed, n_directions=3, p=3, m=5, n_freq=4):
    """Return responses, their changes, the inputs' density and the noise, as arrays."""
    rng = np.random.default_rng(seed)
    density, noise = rng.uniform(2, 5, n_freq), rng.uniform(0.5, 2, m)
    return normal(rng, p, m, n_freq), normal(rng, n_directions, p, m, n_freq), density, noise


def noise_of_places(places):
    values = [next(NOISE[kind] for kind in NOISE if place.startswith(kind)) for place in places]
    return torch.tensor(values, dtype=torch.float64)


# reference


@pytest.mark.parametrize(
    ("coherent", "alone"),
    [((0, 1, 2), ()), ((), ([0], [1], [2])), ((1, 2), ([0],)), ((0,), ([1, 2],))],
)
def test_information_is_that_of_slepian_and_bangs(coherent, alone):
    responses, changes, density, noise = random_case(0)
    found = spectral_information(
        *map(torch.as_tensor, (responses, changes, density, noise)), coherent, alone
    )
    expected = 0.0
    for f, power in enumerate(density):
        h, moved = responses[..., f].T, changes[..., f].swapaxes(1, 2)
        inverse = np.linalg.inv(power * h @ h.conj().T + np.diag(noise))
        slopes = [power * (one @ h.conj().T + h @ one.conj().T) for one in moved]
        for i in coherent:  # real and imaginary parts of the inputs' spectra
            for j in (j for j in coherent if j >= i):
                cross = np.outer(h[:, i], h[:, j].conj())
                slopes += [cross + cross.conj().T]
                slopes += [1j * (cross - cross.conj().T)] if j > i else []
        slopes += [sum(np.outer(h[:, i], h[:, i].conj()) for i in one) for one in alone]
        whole = np.array(
            [[np.trace(inverse @ a @ inverse @ b).real for b in slopes] for a in slopes]
        )
        n = len(moved)
        across = whole[:n, n:]
        expected += whole[:n, :n] - across @ np.linalg.solve(whole[n:, n:], across.T)
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_information_is_that_of_subspace_residuals_at_exact_spectra():
    responses, changes, density, noise = map(torch.as_tensor, random_case(1))
    columns = responses.permute(2, 1, 0)
    exact = density[:, None, None] * columns @ columns.mH + torch.diag(noise)
    misfit = SubspaceMisfit(SpectralMatrix(exact, N_AVERAGES), noise, 3)
    slopes = misfit.derivative(responses, changes)[1]
    found = N_AVERAGES * spectral_information(responses, changes, density, noise, range(3))
    np.testing.assert_allclose(found, (slopes @ slopes.T).numpy(), rtol=1e-9)


def test_information_of_three_sensors_is_that_of_matched_covariances():
    responses, changes, density, noise = map(torch.as_tensor, random_case(2, m=3))
    columns = responses.permute(2, 1, 0)
    exact = density[:, None, None] * columns @ columns.mH + torch.diag(noise)
    misfit = CovarianceMisfit(SpectralMatrix(exact, N_AVERAGES), noise, 3)
    slopes = misfit.derivative(responses, changes)[1]
    found = N_AVERAGES * spectral_information(responses, changes, density, noise, (1, 2), [[0]])
    np.testing.assert_allclose(found, (slopes @ slopes.T).numpy(), rtol=1e-9)


def test_bounds_of_a_known_vehicle_are_the_scatter_of_fits():
    vehicle = SpatialVehicle(AM96, parts=PARTS, distribution={"healthy_k_s": 1e-6})
    rows = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
    rows[0, -1] = np.exp(MASS_MEAN)
    noise = noise_of_places(vehicle.sensors)
    responses, changes = vehicle.channels_along(
        rows, BINS, torch.eye(len(vehicle.columns), dtype=torch.float64)[: len(COMPONENTS)]
    )
    one = torch.ones_like(BINS)
    information = N_AVERAGES * spectral_information(responses[0], changes[0], one, noise, range(3))
    columns = responses[0].permute(2, 1, 0)
    exact = columns @ columns.mH + torch.diag(noise)
    root, rng, errors = np.linalg.cholesky(exact.numpy()), np.random.default_rng(2), []
    for _ in range(N_DRAWS):
        signals = root @ normal(rng, *exact.shape[:2], N_AVERAGES) / np.sqrt(2)
        values = torch.as_tensor(signals @ signals.conj().swapaxes(1, 2) / N_AVERAGES)
        one_trip = BogieTrip(BINS, SpectralMatrix(values, N_AVERAGES), vehicle.speed_m_per_s)
        fit = BogieMisfit(vehicle, [noise], [one_trip], are_healthy=False)
        errors.append(
            search(fit, fit.start(), 0.0, fit.all_bins, 1e-3)[0][1:] - np.log(rows[0].numpy())
        )
    information += np.diag([WEAR**-2] * 12 + [MASS_DEVIATION**-2])
    bounds = np.sqrt(np.diag(np.linalg.inv(information)))
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    # 30 draws: a deviation's own deviation is 13 %, that of the mean of 13 of them about 5 %
    np.testing.assert_allclose(scatter / bounds, 1, atol=0.45)
    assert np.mean(scatter / bounds) == pytest.approx(1, abs=0.12)


def test_bounds_of_a_learnt_vehicle_are_the_posterior_of_its_trips():
    found = _Trip.of(GENERATOR, LAYOUTS[SEVEN], SETTINGS, 0.0)
    vehicle, bins, noise = found.vehicle, found.frequencies_hz, found.noise

    def exact(ratios):
        rows = found.medians.clone()
        for name, ratio in ratios.items():
            rows[0, COMPONENTS.index(name)] = ratio
        h = vehicle.channels(rows, bins)[0].permute(2, 1, 0)
        matrix = found.density[:, None, None] * (h @ h.mH) + torch.diag(noise)
        return BogieTrip(bins, SpectralMatrix(matrix, found.n_averages), vehicle.speed_m_per_s)

    healthy = [exact({"M_s": ratio}) for ratio in layouts.HEALTHY_MASSES]
    fit = BogieMisfit(vehicle, [noise] * len(healthy), healthy, are_healthy=True)
    n = fit.n_numbers
    x = np.concatenate([np.zeros(n), np.log(layouts.HEALTHY_MASSES)])
    factor = vehicle.distribution.factor
    covariance = factor @ posterior_covariance(fit, x, 1.0)[:n, :n] @ factor.T
    known = replace(vehicle.distribution, covariance=(covariance + covariance.T) / 2)
    learnt = replace(vehicle, distribution=known)
    bounds = []
    for part in COMPONENTS[:-1]:
        own = {part: layouts.WORN, "M_s": np.exp(MASS_MEAN)}
        later = BogieMisfit(learnt, [noise], [exact(own)], are_healthy=False)
        logs = [np.log(own.get(name, 1.0)) for name in COMPONENTS]
        posterior = posterior_covariance(later, np.concatenate([np.zeros(n), logs]), 1.0)
        bounds.append(100 * np.sqrt(np.diag(posterior)[n:]))
    np.testing.assert_allclose(found.bounds(3)[1], np.max(bounds, axis=0), rtol=1e-3)


# property


@pytest.fixture(scope="module")
def found():
    names = (SEVEN, SIX, "five: body on one side", NO_BOX, NO_BODY)
    return {
        one.layout: one
        for one in layout_bounds(GENERATOR, {name: LAYOUTS[name] for name in names}, SETTINGS)
    }


def test_six_sensors_have_the_bounds_of_the_design(found):
    """0.014 to 0.018, 0.035 to 0.05, 0.041 and 0.023 % in a prototype of another vehicle."""
    kinds = {"k_p": 0.016, "c_p": 0.05, "k_s": 0.041, "c_s": 0.023, "M_s": 0.02}
    for kind, expected in kinds.items():
        own = [b for b, n in zip(found[SIX].known, COMPONENTS, strict=True) if n.startswith(kind)]
        assert expected / 5 < max(own) < 3 * expected


def test_more_sensors_and_known_numbers_lower_every_bound(found):
    for one in found.values():
        assert (one.known < one.learnt).all()
        assert one.known.shape == one.learnt.shape == (13,)
    for fewer in ("five: body on one side", NO_BOX, NO_BODY):
        assert (found[SIX].known < found[fewer].known).all()


def test_wheelsets_that_are_excited_alone_raise_the_bounds(found):
    (alone,) = layout_bounds(GENERATOR, {SEVEN: LAYOUTS[SEVEN]}, SETTINGS, wheelset_share=0.01)
    assert (alone.known > found[SEVEN].known).all()


def test_three_sensors_have_bounds_where_the_track_has_no_side():
    name = "three: one side"
    (one,) = layout_bounds(GENERATOR, {name: LAYOUTS[name]}, SETTINGS)
    assert (one.known < 20).all()
    assert np.isfinite(one.known).all()


def test_trips_of_twice_the_length_have_bounds_lower_by_the_root_of_two(found):
    longer = replace(SETTINGS, minutes=40.0)
    (one,) = layout_bounds(GENERATOR, {SIX: LAYOUTS[SIX]}, longer)
    np.testing.assert_allclose(one.known, found[SIX].known / np.sqrt(2), rtol=1e-3)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", [SEVEN, NO_BOX])
def test_other_sensors_commission_a_bogie_and_find_its_worn_parts(name, monkeypatch):
    worn = {"k_p_axle1_right": 0.73, "c_s_left": 0.5}
    vehicle = SpatialVehicle(
        AM96, parts=PARTS[:1] + PARTS[2:], distribution=UNCERTAIN, sensors=LAYOUTS[name]
    )
    monkeypatch.setattr("test_bogie_fit.NOISE", noise_of_places(vehicle.sensors))
    numbers = np.random.default_rng(0).standard_normal((1, len(UNCERTAIN)))
    numbers = torch.as_tensor(vehicle.distribution.ratios(numbers))

    def rows(mass, **parts):
        ratios = [parts.get(part, 1.0) for part in COMPONENTS[:-1]]
        return vehicle.with_uncertain(torch.tensor([[*ratios, mass]]).double(), numbers)

    trips = [trip(drawn(vehicle, rows(mass), i), 70.0) for i, mass in enumerate(MASSES)]
    commissioned = commission_bogie(vehicle, trips)
    estimate = fit_parts(commissioned, trip(drawn(vehicle, rows(1.05, **worn), 51), 70.0))
    assert commissioned.converged
    assert estimate.converged
    assert estimate.misfit < 1.3
    truth = [worn.get(part, 1.0) for part in COMPONENTS[:-1]]
    errors = np.log(estimate.values[:-1] / truth)
    assert np.abs(errors).max() < 0.02
    assert np.sqrt(np.mean((errors / estimate.deviations[:-1]) ** 2)) < 2


# error


def test_unknown_places_and_shares_are_refused():
    with pytest.raises(ValueError, match="`sensors` must be one of"):
        layout_bounds(GENERATOR, {"roof": ["roof", *LAYOUTS[SIX]]}, SETTINGS)
    with pytest.raises(ValueError, match="`wheelset_share` must be a finite number"):
        layout_bounds(GENERATOR, LAYOUTS, SETTINGS, wheelset_share=-0.1)
    with pytest.raises(ValueError, match="`n_healthy` must be a whole number"):
        layout_bounds(GENERATOR, LAYOUTS, SETTINGS, n_healthy=0)
