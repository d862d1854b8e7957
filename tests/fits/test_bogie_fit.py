"""Parts of a bogie from spectral matrices: derivatives, known answers, bad input."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commissioned_example import NO_SCATTER
from scipy.stats import norm
from scipy.stats import t as student_t
from vehicles import AM96

from suspnet.curves.welch import Welch
from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.estimation.suspension_law import SuspensionLaw
from suspnet.ground.parameters import COMPONENTS, DAMPERS, FORWARD, REVERSE
from suspnet.trains.fits import bogie_fit, bogie_search, posterior
from suspnet.trains.fits import healthy_scatter as bogie_scatter
from suspnet.trains.fits.bogie_fit import (
    EXPLAINED,
    MISFIT_OF_FEW,
    SENSITIVITY,
    SENSITIVITY_OF_FEW,
    commission_bogie,
    fit_parts,
    healthy_misfit,
)
from suspnet.trains.fits.bogie_misfit import BogieMisfit
from suspnet.trains.fits.bogie_search import (
    SearchEnd,
    best_end,
    better_end,
    freed,
    healthy_end,
    learnt_end,
    search,
    tolerances,
)
from suspnet.trains.fits.healthy_scatter import expected_noise, read_as_later
from suspnet.trains.fits.posterior import (
    LEAST_CHANCE,
    bent,
    posterior_covariance,
    step_left,
    with_chance_at,
)
from suspnet.trains.fits.worn_parts import expected_losses, least_losses, worn_parts
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.subspace import SpectralMatrix
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import BOGIE_MASS_DEVIATION

BINS = torch.arange(1.0, 12.0, 0.75, dtype=torch.float64)
N_AVERAGES = 400
MASSES = (0.95, 1.05, 1.15)
UNCERTAIN = {f"healthy_{name}": 0.05 for name in COMPONENTS[:-1]} | {"healthy_k_s": 0.2}
VEHICLE = SpatialVehicle(
    AM96, parts=("bushings", "frame_sway", "frame_yaw", "body_yaw"), distribution=UNCERTAIN
)
CONDITIONS = np.array(
    [[-10.0, -10.0, 0.1, 0.2, 0.1, 0.2, 0.1], [0.0] * 7, [10.0, 10.0, -0.2, 0.1, -0.2, 0.1, -0.2]]
)
NOISE = torch.tensor([4e-3, 4e-3, 5e-6, 5e-6, 2e-7, 2e-7], dtype=torch.float64)


def normal(rng, *shape):
    """Return complex normal numbers of variance 1."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / math.sqrt(2)


def drawn(
    vehicle, ratios, seed, n_averages=N_AVERAGES, exact=False, size=1.0, uneven=None, bins=BINS
):
    """Return the spectral matrix of a trip, its inputs of any spectra and coherence.

    `size` is the amplitude of the track; with `uneven`, the mean of both rails is coherent with
    that much of the cross level alone.
    """
    rng = np.random.default_rng(seed)
    responses = vehicle.channels(ratios, bins)[0].permute(2, 1, 0).numpy()
    n_freq, n_sensors, n_inputs = responses.shape
    inputs = size * normal(rng, n_freq, n_inputs, n_inputs)
    if uneven is not None:
        inputs[:, 0, 1:] = inputs[:, 1:, 0] = 0.0
        inputs[:, 1, 0] = uneven * inputs[:, 0, 0]
    spectra = responses @ inputs @ inputs.conj().swapaxes(1, 2) @ responses.conj().swapaxes(1, 2)
    spectra += np.diag(NOISE[:n_sensors])
    if not exact:
        root = np.linalg.cholesky(spectra)
        signals = root @ normal(rng, n_freq, n_sensors, n_averages)
        spectra = signals @ signals.conj().swapaxes(1, 2) / n_averages
    return SpectralMatrix(torch.as_tensor(spectra), n_averages)


def trip(spectra, speed_m_per_s, direction=FORWARD):
    """Return a trip on the bins of all of them."""
    return BogieTrip(BINS, spectra, speed_m_per_s, direction)


def relative(estimate):
    """Return the covariance of an estimate, M_s relative to the bogie's mass."""
    of_mass = np.zeros_like(estimate.covariance)
    of_mass[-1, -1] = BOGIE_MASS_DEVIATION**2
    return estimate.covariance - of_mass


def at_damper_speed(vehicle, ratios, seed, m_per_s):
    """Return a trip on a track that stretches secondary dampers at that speed."""
    usual = trip(drawn(vehicle, ratios, seed), 70.0).damper_speeds(VEHICLE.sensors)[1]
    return trip(drawn(vehicle, ratios, seed, size=m_per_s / usual), 70.0)


def true_vehicle(seed=0):
    """Return a vehicle with numbers of its own, as one row of all columns."""
    rng = np.random.default_rng(seed)
    numbers = VEHICLE.distribution.ratios(rng.standard_normal((1, len(UNCERTAIN))))
    return torch.as_tensor(numbers)


def row(parts, mass=1.05, seed=0):
    """Return all columns of the true vehicle with these ratios of parts."""
    given = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
    for name, ratio in parts.items():
        given[0, COMPONENTS.index(name)] = ratio
    given[0, -1] = mass
    return VEHICLE.with_uncertain(given, true_vehicle(seed))


def ratios(parts, mass=1.05):
    """Return the ratios of a worn vehicle, near which a search that is not tested here starts."""
    return np.array([parts.get(name, 1.0) for name in COMPONENTS[:-1]] + [mass])


@cache
def commissioned_bogie():
    """Return the bogie that three healthy trips show, for all modules that ask for it."""
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    return commission_bogie(VEHICLE, trips)


@pytest.fixture(scope="module")
def commissioned():
    return commissioned_bogie()


def loaded(vehicle, rows, load_m):
    """Return all columns of a vehicle whose load has its centre of mass there."""
    rows = vehicle.complete(rows).clone()
    for name, metres in zip(("load_ahead", "load_aside"), load_m, strict=True):
        rows[:, vehicle.columns.index(name)] = metres
    return rows


# reference


def without(one, lost):
    """Return a trip without some sensors of the vehicle."""
    kept = [i for i, place in enumerate(VEHICLE.sensors) if place not in lost]
    values = one.spectra.values[:, kept][:, :, kept]
    return replace(one, spectra=replace(one.spectra, values=values), lost=tuple(lost))


def test_bins_that_are_left_out_have_no_effect(commissioned):
    worn = {"c_p_axle2_right": 0.6}
    clean = trip(drawn(VEHICLE, row(worn), 9), 70.0)
    left_out = torch.zeros(len(BINS), dtype=torch.bool)
    left_out[[3, 7]] = True
    values = clean.spectra.values.clone()
    values[left_out, 0, 0] *= 10  # a line that one axle box alone feels
    disturbed = replace(clean, spectra=replace(clean.spectra, values=values))
    with_all, expected, found, spoilt = (
        fit_parts(commissioned, one, start=ratios(worn))
        for one in (
            clean,
            replace(clean, left_out=left_out),
            replace(disturbed, left_out=left_out),
            disturbed,
        )
    )
    np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert spoilt.misfit > 1.3 * found.misfit
    # the bins that remain are all that the estimate rests on
    widened = expected.deviations / with_all.deviations
    assert 1 <= widened[:-1].max() < 2


def test_healthy_trips_may_differ_in_the_bins_that_are_left_out(commissioned):
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    left_out = torch.arange(len(BINS)) == 5
    trips[1].spectra.values[left_out, 0, 0] *= 100
    found = commission_bogie(VEHICLE, [trips[0], replace(trips[1], left_out=left_out), trips[2]])
    assert found.misfit == pytest.approx(commissioned.misfit, rel=0.05)
    # the found vehicle explains this trip without the bin, and not with it
    assert fit_parts(found, trips[1], start=ratios({})).misfit > 1.2 * found.misfit


@pytest.mark.every_value
@pytest.mark.parametrize("are_healthy", [True, False])
@pytest.mark.parametrize("parts", [(), ("load",)])
@pytest.mark.parametrize("lost", [(), ("axle_box_axle1_left", "body_right")])
def test_derivatives_are_those_of_differences(are_healthy, parts, lost):
    trips = [
        without(trip(drawn(VEHICLE, row({"k_p_axle1_left": 0.8}), 5), 70.0), lost),
        trip(drawn(VEHICLE, row({}, 1.1), 6), 60.0, REVERSE),
    ]
    noise = NOISE[[place not in lost for place in VEHICLE.sensors]]
    fit = BogieMisfit(VEHICLE.with_parts(parts), [noise, NOISE], trips, are_healthy)
    x = fit.start() + 0.03 * np.random.default_rng(1).standard_normal(len(fit.start()))
    residuals, step = fit.at(0.01, fit.all_bins), 1e-5
    found = residuals.jacobian(x)
    scale = np.abs(found).max()
    for j in range(len(x)):
        moved = np.eye(len(x))[j] * step
        ends = [residuals(x + sign * moved) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(found[:, j], numeric, atol=1e-6 * scale, rtol=1e-4)


def test_scatter_that_few_trips_show_widens_intervals(commissioned):
    """The covariance is C + tau^2 V + D, as the docstring says, and that of the bogie's mass."""
    one, parts = trip(drawn(VEHICLE, row({}), 5), 70.0), len(COMPONENTS) - 1
    exact = replace(commissioned, scatter=NO_SCATTER, misfit=1.0)
    of_noise = relative(fit_parts(exact, one, start=ratios({})))
    own, alike = (0.01, 0.02, 0.0, 0.03), (0.0, 0.01, 0.02, 0.0)
    scatter = HealthyScatter(own, alike, 5, ())
    bogie = replace(commissioned, scatter=scatter, misfit=2.0)
    later = fit_parts(bogie, one, start=ratios({}))
    tau = student_t(4).ppf(0.95) / norm.ppf(0.95)
    logs, expected = np.log(later.values[:-1]), np.zeros_like(of_noise)
    for i, j in np.ndindex(parts, parts):
        kinds = COMPONENTS[i][:3], COMPONENTS[j][:3]
        if kinds[0] == kinds[1]:
            kind = ("k_p", "c_p", "k_s", "c_s").index(kinds[0])
            expected[i, j] = tau**2 * (alike[kind] ** 2 + (i == j) * own[kind] ** 2)
    for i, log in enumerate(logs):
        wear = max(abs(log), np.abs(logs).max() / 2)
        expected[i, i] += (1 - 1 / 2.0**2) * (SENSITIVITY[COMPONENTS[i][:3]] * wear) ** 2
    np.testing.assert_allclose(relative(later), of_noise + expected, rtol=1e-9)


def test_kinds_that_are_read_as_one_have_errors_of_their_own(commissioned):
    one, alike = trip(drawn(VEHICLE, row({}), 5), 70.0), (0.01, 0.02, 0.03, 0.04)
    scatter = HealthyScatter((0.0,) * 4, alike, 5, ())
    bogies = [
        replace(commissioned, scatter=found, misfit=misfit)
        for found, misfit in ((NO_SCATTER, 1.0), (scatter, 2.0))
    ]
    plain, wide = (fit_parts(bogie, one, start=ratios({}), equal=True) for bogie in bogies)
    logs = np.log(wide.values[:-1])
    wear = np.maximum(np.abs(logs), np.abs(logs).max() / 2)
    sizes = np.append([SENSITIVITY_OF_FEW[name] for name in wide.names[:-1]] * wear, 0.15)
    tau = student_t(4).ppf(0.95) / norm.ppf(0.95)
    of_trips = np.append(tau**2 * np.square(alike), 0.0)
    shares = np.array([1 / MISFIT_OF_FEW**2] * 4 + [1.0]) - 1 / 2.0**2
    found = relative(plain) + np.diag(of_trips + shares * sizes**2)
    np.testing.assert_allclose(relative(wide), found, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("load_m", [None, (0.3, -0.04)])
def test_exact_spectra_give_the_exact_parts(load_m):
    worn = {"c_p_axle2_left": 0.6, "k_s_right": 1.2, "k_p_axle1_right": 0.7}
    plain = replace(VEHICLE, distribution={"healthy_k_s": 1e-3})
    given = torch.ones(1, 13, dtype=torch.float64)
    for name, ratio in worn.items():
        given[0, COMPONENTS.index(name)] = ratio
    if load_m is not None:
        plain = plain.with_parts(("load",))
    spectra = drawn(plain, loaded(plain, given, load_m or (0.0, 0.0)), 0, 10**6, exact=True)
    known = CommissionedBogie(plain, NOISE, np.ones(3), 1.0, True, NO_SCATTER)
    found = fit_parts(known, trip(spectra, 70.0))
    assert found.converged
    np.testing.assert_allclose(found.values, given[0].numpy(), rtol=2e-3)
    # where it is not one of the vehicle's numbers, a load that shifts is taken for wear
    if load_m is not None:
        centred = replace(plain, parts=VEHICLE.parts)
        taken = fit_parts(replace(known, generator=centred), trip(spectra, 70.0))
        assert abs(taken.values[COMPONENTS.index("k_s_left")] - 1) > 0.02


# the less bins leak, the more of it dampers' own forces can be taken for
@pytest.mark.parametrize(("segment_s", "share"), [(40.0, 0.1), (120.0, 0.4)])
def test_what_bins_leak_is_no_error_of_the_vehicle(commissioned, segment_s, share):
    """Exact spectra, with neighbours 1 / T away: the residuals are those of the leakage alone."""
    welch, worn = Welch(segment_s), {"c_p_axle2_left": 0.6}
    density = np.diag([1.0, 0.5, 0.1])
    spectra = np.diag(NOISE.numpy()).astype(complex)
    for tap, weight in zip((-1, 0, 1), welch.smear().tolist(), strict=True):
        h = VEHICLE.channels(row(worn), BINS + tap / segment_s)[0].permute(2, 1, 0).numpy()
        spectra = spectra + weight * h @ density @ h.conj().swapaxes(1, 2)
    one = trip(SpectralMatrix(torch.as_tensor(spectra), N_AVERAGES), 70.0)
    found, unaware = (
        fit_parts(commissioned, replace(one, welch=leaks), start=ratios(worn))
        for leaks in (welch, None)
    )
    assert found.misfit < share * unaware.misfit
    np.testing.assert_allclose(found.values, ratios(worn), rtol=2e-3)


def test_a_speed_that_varies_within_the_trip_is_no_error_of_the_vehicle(commissioned):
    """Exact spectra at three speeds that have the mean and the standard deviation."""
    worn, scatter = {"c_p_axle2_left": 0.6}, 0.01
    density = np.diag([1.0, 0.5, 0.1])
    spectra = np.diag(NOISE.numpy()).astype(complex)
    for off, weight in ((-math.sqrt(1.5), 1 / 3), (0.0, 1 / 3), (math.sqrt(1.5), 1 / 3)):
        vehicle = replace(VEHICLE, speed_m_per_s=70.0 * (1 + off * scatter))
        h = vehicle.channels(row(worn), BINS)[0].permute(2, 1, 0).numpy()
        spectra = spectra + weight * h @ density @ h.conj().swapaxes(1, 2)
    one = trip(SpectralMatrix(torch.as_tensor(spectra), N_AVERAGES), 70.0)
    found, unaware = (
        fit_parts(commissioned, replace(one, speed_scatter=known), start=ratios(worn))
        for known in (scatter, 0.0)
    )
    assert found.misfit < 0.3 * unaware.misfit
    np.testing.assert_allclose(found.values, ratios(worn), rtol=2e-3)


def test_parts_are_found_without_the_sensor_that_sensitivities_are_relative_to():
    parts = (*VEHICLE.parts, "sensors")
    gains = {"gain_frame_axle1_left": 1e-3, "gain_body_left": 1e-3}
    vehicle = replace(VEHICLE, parts=parts, distribution=gains)
    prior = vehicle.distribution
    vehicle = replace(vehicle, distribution=replace(prior, mean=tuple(np.log([1.1, 0.95]))))
    given = torch.ones(1, 13, dtype=torch.float64)
    given[0, COMPONENTS.index("c_p_axle2_left")] = 0.6
    rows = vehicle.with_uncertain(given, torch.tensor([[1.1, 0.95]], dtype=torch.float64))
    spectra = drawn(vehicle, rows, 0, 10**6, exact=True)
    known = CommissionedBogie(vehicle, NOISE, np.ones(3), 1.0, True, NO_SCATTER)
    one, start = trip(spectra, 70.0), ratios({"c_p_axle2_left": 0.7})
    found = fit_parts(known, without(one, VEHICLE.sensors[:1]), start=start)
    assert found.converged
    np.testing.assert_allclose(found.values, given[0].numpy(), rtol=3e-3)
    assert (found.deviations > fit_parts(known, one, start=start).deviations).all()


@pytest.mark.parametrize(
    ("near", "misfits", "converged", "chosen", "searched"),
    [
        ((1.1, 9.0), (1.0, 9.0), (True, True), 0, "wf"),
        ((1.1, 1.1), (1.05, 1.06), (False, True), 1, "wfwf"),
        ((2.0, 1.1), (1.6, 1.0), (True, True), 1, "wwf"),
        ((1.4, 1.3), (1.3, 1.2), (True, True), 1, "wwff"),
        ((1.3, 1.4), (1.2, 1.3), (True, True), 0, "wwff"),
        ((1.2, 1.4), (1.1, 1.3), (True, True), 0, "wwf"),
    ],
)
def test_another_start_is_tried_where_the_first_fails(
    monkeypatch, near, misfits, converged, chosen, searched
):
    order = []

    def end(misfit, has_converged):
        one = SearchEnd(None, None, has_converged)
        object.__setattr__(one, "misfit", misfit)
        return one

    ends = [end(*one) for one in zip(misfits, converged, strict=True)]
    starts = [
        SimpleNamespace(misfit=m, finished=lambda _, e=e: order.append("f") or e)
        for m, e in zip(near, ends, strict=True)
    ]
    left = iter(starts)
    monkeypatch.setattr(bogie_search, "end_near", lambda *_: order.append("w") or next(left))
    one = trip(drawn(VEHICLE, row({}), 5), 70.0)
    found = best_end(BogieMisfit(VEHICLE, [NOISE], [one], are_healthy=False), explained=1.15)
    assert found is ends[chosen]
    assert "".join(order) == searched


def test_a_search_that_creeps_is_continued_and_ends_where_the_parts_have_no_way_to_go(
    commissioned, monkeypatch
):
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    fit = BogieMisfit(VEHICLE, [NOISE] * 3, trips, are_healthy=True)
    end = SearchEnd(fit, fit.start(), False).finished(math.inf)
    assert step_left(fit, end.x) < 0.1
    monkeypatch.setattr(bogie_search, "STEPS", 3)  # not enough at once
    assert not search(fit, fit.start(), 0.0, fit.all_bins, tolerances(fit)[1])[1]
    far = SearchEnd(fit, fit.start(), False)
    assert not far.finished(0.0).converged  # nor continued where the trips are not explained
    continued = far.finished(math.inf)
    assert continued.converged
    assert step_left(fit, continued.x) < bogie_search.SETTLED
    # without an end, what the parts still have to go decides
    monkeypatch.setattr(bogie_search, "search", lambda *args: (args[1], False))
    moved = end.x.copy()
    moved[fit.numbers.names.index("healthy_k_s")] += 0.5
    for x, has_ended in ((end.x, True), (moved, False)):
        assert SearchEnd(fit, x, False).finished(math.inf).converged == has_ended


def test_masses_are_expected_about_those_of_the_healthy_trips(commissioned, monkeypatch):
    def stopped(fit, x, first):
        starts.append((x[-1], fit.prior(x)[-1]))
        raise StopIteration

    starts = []
    monkeypatch.setattr(bogie_fit, "narrowed", stopped)
    light = replace(commissioned, masses=np.array([0.5, 0.72]))
    with pytest.raises(StopIteration):
        fit_parts(light, trip(drawn(VEHICLE, row({}), 5), 70.0))
    np.testing.assert_allclose(starts, [(np.log(0.6), 0.0)], atol=1e-12)


@pytest.mark.parametrize("is_explained", [True, False])
def test_trips_are_searched_in_widening_bands_only_where_the_healthy_vehicle_is_far(
    commissioned, monkeypatch, is_explained
):
    called = []
    monkeypatch.setattr(bogie_fit, "best_end", lambda *args: called.append(args) or best_end(*args))
    if not is_explained:
        monkeypatch.setattr(bogie_fit, "EXPLAINED", 0.0)
    worn = trip(drawn(VEHICLE, row({"c_p_axle2_left": 0.5}), 5), 70.0)
    found = fit_parts(commissioned, worn)
    assert len(called) == (not is_explained)
    assert found.misfit < 1.1
    assert found.values[COMPONENTS.index("c_p_axle2_left")] == pytest.approx(0.5, abs=0.02)


def test_the_valley_is_chosen_by_the_slowest_and_the_fastest_trip(monkeypatch):
    """The others start from the mean of these two."""
    spectra = drawn(VEHICLE, row({}), 5)
    trips = [trip(spectra, speed) for speed in (60.0, 75.0, 50.0, 70.0)]
    fit = BogieMisfit(VEHICLE, [NOISE] * 4, trips, are_healthy=True)
    numbers, searched = np.arange(fit.n_numbers), []

    def ended(fit, x, *_):
        searched.append(fit.trips)
        return np.concatenate([numbers, [0.1, 0.3]]), True

    monkeypatch.setattr(bogie_search, "search", ended)
    monkeypatch.setattr(bogie_search, "narrowed", lambda _, x: x)
    start = bogie_search.end_near(fit)
    assert searched == [[trips[1], trips[2]]] * bogie_search.LOWEST_BANDS
    np.testing.assert_allclose(start, [*numbers, 0.2, 0.1, 0.3, 0.2])


@pytest.mark.parametrize(("n_trips", "is_found"), [(3, True), (2, False)])
def test_two_other_trips_choose_the_valley_where_the_first_end_explains_little(
    monkeypatch, n_trips, is_found
):
    trips = [trip(drawn(VEHICLE, row({}), i), 70.0) for i in range(n_trips)]
    fit, started = healthy_misfit(VEHICLE, trips), []
    right = learnt_end(fit).x

    def ended(fit, rough=1.0, first=0):
        started.append(first)
        return right + (0.0 if first else 2.0)

    monkeypatch.setattr(bogie_search, "_first_step", ended)
    monkeypatch.setattr(bogie_search, "search", lambda *args: (args[1], True))
    found = better_end(fit)
    assert started == [0, 1][: n_trips - 1]
    assert (found.bare_misfit < 1.3) == is_found


# property


@pytest.mark.parametrize(
    ("masses", "part"),
    # 0.22 and 0.44 of a deviation where the decrease may be 1e-3
    [(MASSES[:1], 0.2), pytest.param(MASSES, 0.3, marks=pytest.mark.slow)],
    ids=["one", "three"],
)
def test_healthy_trips_end_at_the_minimum(masses, part):
    vehicle = SpatialVehicle(AM96, parts=PARTS_OF_BOGIE).with_prior()
    prior = vehicle.distribution.without(("cross_level", "alignment"))
    vehicle = replace(vehicle, distribution=prior)
    numbers = prior.ratios(np.random.default_rng(3).standard_normal((1, len(prior.names))))
    trips = []
    for i, mass in enumerate(masses):
        parts = torch.ones(1, len(COMPONENTS), dtype=torch.float64)
        parts[0, -1] = mass
        true = vehicle.with_uncertain(parts, torch.as_tensor(numbers))
        trips.append(trip(drawn(vehicle, true, i), 70.0))
    fit = BogieMisfit(vehicle, [NOISE] * len(trips), trips, are_healthy=True)
    end = healthy_end(fit, (), EXPLAINED).finished(math.inf)
    residuals, slopes = end.fit.exact(end.x), end.fit.exact.jacobian(end.x)
    step = np.linalg.lstsq(slopes, -residuals, rcond=None)[0]
    deviations = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    assert end.converged
    assert (np.abs(step) < part * deviations).all()


def test_healthy_trips_show_the_vehicle(commissioned):
    assert commissioned.converged
    assert commissioned.misfit == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(commissioned.noise.numpy(), NOISE.numpy(), rtol=0.3)
    np.testing.assert_allclose(commissioned.masses, MASSES, rtol=0.02)
    found = commissioned.generator.distribution
    z = (np.log(found.median) - np.log(true_vehicle()[0].numpy())) / found.deviations
    assert np.sqrt(np.mean(z**2)) < 2.5


def test_healthy_trips_of_different_temperatures_show_the_slopes_of_damping(commissioned):
    slopes, temperatures_c = (-0.008, -0.001), (-5.0, 15.0, 35.0, None)
    trips = []
    for i, celsius in enumerate(temperatures_c):
        warmer = 0.0 if celsius is None else celsius - 15.0
        parts = {
            name: math.exp(slopes[name[2] == "s"] * warmer) for name in COMPONENTS if name[0] == "c"
        }
        whole = row(parts, MASSES[i % 3])
        for name, slope in zip(("other_c_p", "other_c_s"), slopes, strict=True):
            whole[0, VEHICLE.columns.index(name)] *= math.exp(slope * warmer)
        trips.append(trip(drawn(VEHICLE, whole, i), 70.0))
    found = commission_bogie(VEHICLE, trips, temperatures_c)
    assert found.misfit == pytest.approx(1, abs=0.1)
    assert found.law.healthy_c == 15.0
    np.testing.assert_allclose(found.law.slopes[:2], slopes, atol=3e-4)
    assert not np.any(found.law.slopes[2:])
    deviations = np.sqrt(np.diag(found.law.covariance))
    assert deviations[:2].max() < 2e-4
    assert found.law.healthy_m_per_s == (None, None)
    np.testing.assert_allclose(found.masses, (*MASSES, MASSES[0]), rtol=0.02)
    # without their temperatures the trips are not explained, and equal ones tell no slope
    assert learnt_end(healthy_misfit(VEHICLE, trips[:3])).bare_misfit > 1.2
    alike = commission_bogie(VEHICLE, trips[1:2] * 3, [20.0] * 3)
    usual = SuspensionLaw(20.0)
    np.testing.assert_allclose(alike.law.slopes[:2], usual.slopes[:2], rtol=1e-6)
    np.testing.assert_allclose(np.diag(alike.law.covariance)[:2], np.diag(usual.covariance)[:2])
    assert commissioned.law is None


def test_a_warm_and_rough_trip_is_read_as_under_the_conditions_of_the_healthy_ones(commissioned):
    """Dampers of both bogies follow the law: it is the weather, and one has worn."""
    slopes, deviations = (-0.01, -0.02, -0.5, 0.3, 0.0, 0.0, 0.0), (1e-3, 2e-3, 0.1, 0.2, 0, 0, 0)
    faster = np.log([1.1, 0.8])
    shifts = np.array([-0.1, -0.2]) + np.multiply(slopes[2:4], faster)
    of_kind = dict(zip(("c_p", "c_s"), np.exp(shifts), strict=True))
    parts = {name: of_kind[name[:3]] for name in COMPONENTS if name[0] == "c"}
    parts["c_p_axle2_right"] *= 0.8
    whole = row(parts)
    for name, factor in of_kind.items():
        whole[0, VEHICLE.columns.index(f"other_{name}")] *= factor
    one = trip(drawn(VEHICLE, whole, 5), 70.0)
    healthy_m_per_s = one.damper_speeds(VEHICLE.sensors) / np.exp(faster)
    covariance = tuple(map(tuple, np.diag(np.square(deviations)).tolist()))
    law = SuspensionLaw(10.0, tuple(healthy_m_per_s.tolist()), slopes, covariance)
    bogie = replace(commissioned, law=law)
    found = fit_parts(bogie, one, start=ratios({}), temperature_c=20.0)
    worn = ratios({"c_p_axle2_right": 0.8})
    np.testing.assert_allclose(found.values, worn, rtol=0.06)
    assert [part.names for part in worn_parts(found)] == [("c_p_axle2_right",)]
    # all but the error of the slopes is that of the fit
    spreads = np.hypot([0.01, 0.02], np.array([0.1, 0.2]) * faster)
    exact = replace(law, covariance=tuple(map(tuple, np.zeros((7, 7)).tolist())))
    known = fit_parts(replace(bogie, law=exact), one, start=ratios({}), temperature_c=20.0)
    for i, name in enumerate(COMPONENTS):
        spread = spreads["ps".index(name[2])] if name[0] == "c" else 0.0
        assert found.deviations[i] == pytest.approx(math.hypot(known.deviations[i], spread))
    # unless the temperature is told, the trip looks like one of weak dampers
    unknown = fit_parts(bogie, one, start=ratios({}))
    assert unknown.values[COMPONENTS.index("c_s_left")] < 0.9


def speeds_of_dampers(vehicle, rows, seed):
    """Return the speeds of all dampers and of both pairs' ends on the track of `drawn`, naively."""
    inputs = normal(np.random.default_rng(seed), len(BINS), 3, 3)
    strokes, channels = vehicle.strokes(rows, BINS)[0], vehicle.channels(rows, BINS)[0]
    ends = [channels[:, above] - channels[:, above - 2] for above in (2, 3, 4, 5)]
    squares = np.zeros(16)
    for i, motion in enumerate([*strokes.transpose(0, 1), *ends]):
        for j, f in enumerate(BINS.tolist()):
            velocity = motion[:, j].numpy() @ inputs[j] / (2 * math.pi * f)
            squares[i] += float((np.abs(velocity) ** 2).sum())
    return np.sqrt(squares[:12]), np.sqrt([squares[12:14].mean(), squares[14:].mean()])


def test_dampers_are_read_as_at_their_own_speeds_while_healthy():
    """Wear changes the speed of each damper by another factor than that between the sensors."""
    plain = replace(VEHICLE, distribution={"healthy_k_s": 1e-3})
    slopes, of_kind = (0.0, 0.0, -0.6, -0.4, 0.0, 0.0, 0.0), {"c_p": -0.6, "c_s": -0.4}
    dampers = [name for name in COMPONENTS if name[0] == "c"]
    worn = {"k_p_axle2_right": 0.5, "c_s_right": 0.8}

    def rows(parts, others):
        whole = torch.ones(1, len(plain.columns), dtype=torch.float64)
        for name, ratio in (parts | others).items():
            whole[0, plain.columns.index(name)] = ratio
        return whole

    healthy, healthy_pairs = speeds_of_dampers(plain, rows({}, {}), 5)
    parts, others = dict(worn), {}
    for _ in range(20):  # to where damping and speeds agree
        own, pairs = speeds_of_dampers(plain, rows(parts, others), 5)
        for name, faster in zip(dampers, (own / healthy)[:6], strict=True):
            parts[name] = worn.get(name, 1.0) * faster ** of_kind[name[:3]]
        by_pairs = dict(zip(of_kind, pairs / healthy_pairs, strict=True))
        others = {f"other_{kind}": by_pairs[kind] ** slope for kind, slope in of_kind.items()}
    one = trip(drawn(plain, rows(parts, others), 5, 10**6, exact=True), 70.0)
    m_per_s = one.damper_speeds(VEHICLE.sensors) / np.array(list(by_pairs.values()))
    scale = one.damper_speeds(VEHICLE.sensors)[0] / pairs[0]
    usual = tuple(np.log(scale * healthy))
    law = SuspensionLaw(None, tuple(m_per_s), slopes, ((0.0,) * 7,) * 7, usual)
    vehicle = plain.with_parts(("nonlinear_dampers",))
    found = fit_parts(
        CommissionedBogie(vehicle, NOISE, np.ones(3), 1.0, True, NO_SCATTER, law), one
    )
    np.testing.assert_allclose(found.values, ratios(worn, 1.0), rtol=5e-3)
    of_sensors = np.array([by_pairs[name[:3]] for name in dampers])
    assert np.abs(np.log((own / healthy)[:6] / of_sensors)).max() > 0.2


def test_healthy_trips_both_ways_show_each_damper_at_its_own_speed():
    """The axle that trails moves more than the one with the sensors, which leads."""
    plain = replace(VEHICLE, distribution={"healthy_k_s": 1e-3})
    slopes, trips, speeds = (-0.6, -0.4), [], []
    for i, size in enumerate((1.0, 0.8, 1.3, 1.1)):
        direction, logs = (FORWARD, REVERSE)[i % 2], np.zeros(12)
        vehicle = plain.running(direction)
        for _ in range(20):  # to where damping and speeds agree
            rows = torch.ones(1, len(plain.columns), dtype=torch.float64)
            for name, log in zip(DAMPERS, logs, strict=True):
                rows[0, plain.columns.index(name)] = math.exp(slopes["_s_" in name] * log)
            own, _ = speeds_of_dampers(vehicle, rows, i)
            logs = np.log(size * own / 0.5)
        spectra = drawn(vehicle, rows, i, 10**6, exact=True, size=size)
        trips.append(trip(spectra, 70.0, direction))
        speeds.append(logs)
    of_own = [name if name.startswith("other_") else f"healthy_{name}" for name in DAMPERS]
    vehicle = replace(plain, distribution=dict.fromkeys(of_own, 0.5))
    law = commission_bogie(vehicle.with_parts(("nonlinear_dampers",)), trips).law
    np.testing.assert_allclose(law.slopes[2:4], slopes, atol=0.02)
    found, expected = np.array(law.own_speeds), np.mean(speeds, axis=0)
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=0.01)
    differ = np.array(speeds)[:, 4] - np.array(speeds)[:, 0]
    assert np.ptp(differ) > 0.2  # by which an axle without sensors is faster


def test_dampers_that_vary_by_chance_show_no_dependence_on_speed():
    """Rougher trips have less c_s by chance: that is a slope of -0.67 if nothing else varies."""
    vehicle, trips = VEHICLE.with_parts(("nonlinear_dampers",)), []
    for by_chance, faster in zip((-0.04, 0.0, 0.01, 0.03), (0.03, 0.03, -0.03, -0.03), strict=True):
        parts = {f"c_s_{side}": math.exp(by_chance) for side in ("left", "right")}
        rows, m_per_s = row(parts), 0.5 * math.exp(faster)
        rows[0, VEHICLE.columns.index("other_c_s")] *= math.exp(by_chance)
        # of one load and on one track, so that none of the dampers is faster than others
        trips.append(at_damper_speed(VEHICLE, rows, 0, m_per_s))
    law = commission_bogie(vehicle, trips).law
    slope, deviation = law.slopes[3], math.sqrt(law.covariance[3][3])
    assert -0.5 < slope < 0.1
    assert 0.05 < deviation < 0.3  # little more is known than before: sides are nearly alike


def test_scatter_of_dampers_is_learnt_from_healthy_trips():
    vehicle = VEHICLE.with_parts(("nonlinear_dampers",))
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    fit = healthy_misfit(vehicle, trips, 0.1 * CONDITIONS)
    x = fit.start()
    x[fit.n_shared :: fit.n_own] = 0.01, -0.02, 0.03
    variances = np.diag(posterior_covariance(fit, x, 1.0))[fit.n_shared :: fit.n_own]
    found = with_chance_at(fit, x).chance
    assert found[0] == pytest.approx(math.sqrt(np.mean(np.array([1e-4, 4e-4, 9e-4]) + variances)))
    known = np.sum(1 - variances / fit.chance[0] ** 2)
    at_end = with_chance_at(fit, x, at_end=True).chance
    assert at_end == (pytest.approx(math.sqrt(14e-4 / known)), LEAST_CHANCE)
    linear = healthy_misfit(VEHICLE, trips, CONDITIONS)
    assert with_chance_at(linear, linear.start()) is linear


def test_speeds_of_dampers_are_those_of_their_ends():
    one = trip(drawn(VEHICLE, row({}), 0), 70.0)
    naive = []
    for pairs in (((0, 2), (1, 3)), ((2, 4), (3, 5))):
        squares = []
        for below, above in pairs:
            for f, matrix in zip(BINS.tolist(), one.spectra.values.numpy(), strict=True):
                ends = np.zeros(6)
                ends[[below, above]] = -1.0, 1.0
                squares.append((ends @ matrix @ ends).real / (2 * math.pi * f) ** 2 * 0.75 / 2)
        naive.append(math.sqrt(sum(squares)))
    np.testing.assert_allclose(one.damper_speeds(VEHICLE.sensors), naive)
    bodiless = without(one, ("body_left", "body_right"))
    found = bodiless.damper_speeds(VEHICLE.sensors)
    assert found[0] == pytest.approx(naive[0])
    assert np.isnan(found[1])


def test_derivatives_by_the_slopes_are_those_of_differences():
    trips = [trip(drawn(VEHICLE, row({}, mass), i), 70.0) for i, mass in enumerate(MASSES)]
    vehicle = VEHICLE.with_parts(("nonlinear_dampers", "rubber"))
    fit = BogieMisfit(vehicle, [NOISE] * 3, trips, are_healthy=True, conditions=CONDITIONS)
    x = fit.start() + 0.1
    jacobian = fit.exact.jacobian(x)
    assert fit.n_slopes == len(CONDITIONS[0])
    losses = map(fit.numbers.names.index, ("rubber_loss", "secondary_loss"))
    for column in (*losses, *range(fit.n_numbers, fit.n_shared + 1)):
        step = 1e-5 * np.eye(len(x))[column]
        ends = [fit.exact(x + sign * step) for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / 2e-5
        scale = np.abs(difference).max()
        np.testing.assert_allclose(jacobian[:, column], difference, atol=1e-5 * scale)


def floor_trips():
    """Return healthy trips with a soft floor below one sensor of the body."""
    richer = VEHICLE.with_parts(("floors",))
    trips = []
    for i, mass in enumerate(MASSES):
        whole = dict(zip(VEHICLE.columns, row({}, mass)[0].tolist(), strict=True))
        whole |= {"floor_softness_body_left": 1.4, "floor_softness_body_right": 0.0}
        ratios_of = torch.tensor([[whole.get(name, 1.0) for name in richer.columns]])
        trips.append(trip(drawn(richer, ratios_of.double(), i), 70.0))
    return trips


@cache
def bogie_on_floors():
    """Return the bogie of `floor_trips` without the part that explains them."""
    return commission_bogie(VEHICLE, floor_trips())


@pytest.mark.parametrize("enriched_from", [1.3, math.inf], ids=["all at once", "what is worth it"])
def test_what_does_not_explain_its_trips_is_given_further_parts(monkeypatch, enriched_from):
    monkeypatch.setattr(bogie_search, "ENRICHED_FROM", enriched_from)
    trips, parts = floor_trips(), ("track", "floors")
    found = commission_bogie(VEHICLE, trips, further_parts=parts)
    numbers = found.generator.distribution
    assert numbers.names[: len(UNCERTAIN)] == VEHICLE.distribution.names
    # a track that does not give way is not worth it
    assert ("track" in found.generator.parts) == math.isfinite(enriched_from)
    assert bogie_on_floors().misfit > 1.3
    assert found.misfit == pytest.approx(1, abs=0.1)
    softness = dict(zip(numbers.names, numbers.median, strict=True))
    assert softness["floor_softness_body_left"] == pytest.approx(1.4, abs=0.05)
    assert softness["floor_softness_body_right"] == pytest.approx(0, abs=0.05)


def test_errors_do_not_hide_a_much_better_end():
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    fit = healthy_misfit(VEHICLE, trips)
    x = fit.start()
    x[fit.numbers.names.index("healthy_k_s")] = -3.0
    errors = torch.full((len(BINS), len(VEHICLE.sensors)), 0.5, dtype=torch.float64)
    hidden = SearchEnd(replace(fit.with_noise_at(x), errors=errors), x, True)
    assert hidden.misfit < 1.0 < 2.0 < hidden.bare_misfit
    found = freed(hidden)
    assert found.bare_misfit == pytest.approx(learnt_end(fit).bare_misfit, rel=0.02)
    assert freed(found) is found


def test_what_explains_its_trips_is_given_none():
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    found = commission_bogie(VEHICLE, trips, further_parts=("track", "floors"))
    assert found.generator.parts == VEHICLE.parts


def test_errors_of_the_vehicle_are_learnt_where_they_are(commissioned):
    """The floor moves the body's left sensor, and parts are read in spite of it."""
    found = bogie_on_floors()
    assert found.misfit > 1.3
    errors = dict(zip(VEHICLE.sensors, found.errors.square().mean(dim=0).sqrt(), strict=True))
    assert errors["body_left"] > 0.05
    assert commissioned.errors.max() < 0.1 * errors["body_left"]


# loaded farthest to either end
@pytest.mark.parametrize(("parts", "i"), [(("load",), 3), (("load", "nonlinear_dampers"), 0)])
def test_healthy_trips_are_left_out_as_by_a_fit_to_the_others(parts, i, monkeypatch):
    # how much dampers vary by chance is what all trips show, not the others
    monkeypatch.setattr(bogie_search, "with_chance_at", lambda fit, _, at_end=False: fit)
    is_linear, trips = "nonlinear_dampers" not in parts, []
    # the reference of nonlinear dampers is what the healthy trips show
    dampers = [f"healthy_{name}" for name in COMPONENTS if name[0] == "c"]
    wide = {} if is_linear else dict.fromkeys((*dampers, "other_c_p", "other_c_s"), 0.3)
    vehicle = replace(VEHICLE, distribution=UNCERTAIN | wide).with_parts(parts)
    for n, mass in enumerate((*MASSES, 1.0)):
        rows = loaded(vehicle, row({}, mass), (0.2 * n - 0.3, 0.0))
        if is_linear:
            trips.append(trip(drawn(vehicle, rows, n), 70.0))
        else:
            trips.append(at_damper_speed(vehicle, rows, n, 0.5 + 0.02 * (-1) ** n))
    law = SuspensionLaw.of_trips([None] * 4, [one.damper_speeds(VEHICLE.sensors) for one in trips])
    conditions = [law.conditions(None, one.damper_speeds(VEHICLE.sensors)) for one in trips]
    fit = healthy_misfit(vehicle, trips, np.array(conditions))
    end = healthy_end(fit, (), EXPLAINED).finished(math.inf)
    logs, covariances = read_as_later(end.fit, end.x)
    one = trips[i]
    others = commission_bogie(vehicle, [other for other in trips if other is not one])
    later = fit_parts(replace(others, scatter=NO_SCATTER, misfit=1.0), one, start=ratios({}))
    deviations = np.sqrt(np.diag(covariances[i]))
    found = np.sqrt(np.diag(relative(later)))
    np.testing.assert_allclose(found, deviations, rtol=0.15 if is_linear else 0.2)
    # noise and dampers' forces, which a step keeps, are in the fit those of the other trips
    assert (np.abs(np.log(later.values) - logs[i]) < 0.7 * deviations)[:12].all()


def test_losses_are_known_before_commissioning():
    """They are those that the commissioned vehicle gives, but for the scatter of its few trips."""
    trips = [trip(drawn(VEHICLE, row({}, mass), i), 70.0) for i, mass in enumerate(MASSES)]
    expected = expected_losses(VEHICLE, trips[0], len(trips))
    bogie = commissioned_bogie()
    noise_alone = replace(bogie.scatter, own=(0.0,) * 4, alike=(0.0,) * 4)
    found = least_losses(replace(bogie, misfit=1.0, scatter=noise_alone))
    np.testing.assert_allclose([*expected.values()], [*found.values()], rtol=0.15)
    # fewer healthy trips show less
    fit = healthy_misfit(VEHICLE, trips[:1])
    fewer, more = (expected_noise(fit, fit.start(), n) for n in (1, 3))
    assert (np.diag(fewer) > np.diag(more)).all()


def test_scatter_is_what_noise_does_not_explain(monkeypatch):
    rng = np.random.default_rng(0)
    n, kinds = 4000, np.array([name[:3] for name in COMPONENTS[:-1]])
    noise = np.diag(rng.uniform(0.005, 0.01, 13) ** 2)
    logs = rng.multivariate_normal(np.zeros(13), noise, n)
    own, alike = (0.02, 0.0, 0.01, 0.03), (0.01, 0.03, 0.0, 0.02)
    for kind, scatter, shared in zip(("k_p", "c_p", "k_s", "c_s"), own, alike, strict=True):
        of = np.flatnonzero(kinds == kind)
        logs[:, of] += scatter * rng.standard_normal((n, len(of)))
        logs[:, of] += shared * rng.standard_normal((n, 1))
    monkeypatch.setattr(
        bogie_scatter, "read_as_later", lambda *_: (logs, np.tile(noise, (n, 1, 1)))
    )
    found = bogie_scatter.healthy_scatter(
        SimpleNamespace(trips=[None] * n, generator=VEHICLE), np.zeros(1)
    )
    np.testing.assert_allclose(found.own, own, atol=2e-3)
    np.testing.assert_allclose(found.alike, alike, atol=2e-3)
    assert found.n_trips == n


def test_the_bend_of_the_valley_widens_the_posterior_as_the_docstring_says(monkeypatch):
    monkeypatch.setattr(posterior, "DRAWS", 3)
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    end = learnt_end(healthy_misfit(VEHICLE, trips))
    fit, x = end.fit, end.x
    flat = posterior_covariance(fit, x, 1.0)
    found, residuals, slopes = bent(fit, x, flat), fit.exact, fit.exact.jacobian(x)
    root, expected = np.linalg.cholesky(flat), flat.copy()
    for draw in np.random.default_rng(0).standard_normal((3, len(x))):
        d = root @ draw
        q = (residuals(x + d) + residuals(x - d)) / 2 - residuals(x)
        s = -np.linalg.inv(slopes.T @ slopes) @ slopes.T @ q
        expected += np.outer(s, s) / 3
        # after that step the residuals are nearer to those at the minimum
        off = residuals(x + d) - residuals(x) - slopes @ d
        assert np.linalg.norm(q + slopes @ s) < np.linalg.norm(q) <= 3 * np.linalg.norm(off)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)


def test_lasting_errors_widen_the_posterior_as_the_docstring_says():
    trips = [trip(drawn(VEHICLE, row({}, m), i), 70.0) for i, m in enumerate(MASSES)]
    errors = torch.full((len(BINS), 6), 0.03, dtype=torch.float64)
    fit = BogieMisfit(VEHICLE, [NOISE] * 3, trips, are_healthy=True, errors=errors)
    x, excess = fit.start(), 1.3
    jacobian = fit.exact.jacobian(x)
    data, prior = jacobian[: -len(x)], jacobian[-len(x) :]
    n_alike = 3 / 0.75
    weights = [1 + share * (n_alike - 1) for share in fit.exact.error_shares(x)]
    middle = sum(w * np.outer(j, j) for w, j in zip(weights, data, strict=True)) / excess
    inverse = np.linalg.inv(data.T @ data / excess + prior.T @ prior)
    expected = inverse @ (middle + prior.T @ prior) @ inverse
    np.testing.assert_allclose(posterior_covariance(fit, x, excess), expected, rtol=1e-6)
    certain = posterior_covariance(replace(fit, errors=None), x, excess)
    assert (np.diag(expected)[:10] > np.diag(certain)[:10]).all()


@pytest.mark.parametrize(
    "worn", [{"c_p_axle2_left": 0.62}, {"k_p_axle1_right": 0.73, "c_s_left": 0.5}, {}]
)
def test_the_worn_part_is_found_and_no_other_one_is(commissioned, worn):
    found = fit_parts(commissioned, trip(drawn(VEHICLE, row(worn), 50), 70.0))
    errors = np.log(found.values / ratios(worn))
    springs = np.array([name.startswith("k") for name in COMPONENTS])
    assert np.abs(errors[springs]).max() < 0.01
    assert np.abs(errors).max() < 0.06
    assert np.sqrt(np.mean((errors / found.deviations) ** 2)) < 2
    estimate = found.as_estimate()
    assert estimate.names == COMPONENTS
    half = np.log(estimate.high / estimate.low)[0] / 2
    np.testing.assert_allclose(half, 1.6449 * found.deviations, rtol=1e-4)


def test_a_trip_in_reverse_and_at_another_speed_is_read_too(commissioned):
    there = replace(VEHICLE, speed_m_per_s=55.0).running(REVERSE)
    spectra = drawn(there, row({"k_s_left": 0.8}), 60)
    found = fit_parts(commissioned, trip(spectra, 55.0, REVERSE), start=ratios({}))
    assert found.values[COMPONENTS.index("k_s_left")] == pytest.approx(0.8, rel=0.01)
    assert found.misfit < 1.2


# error


def test_spectra_of_other_sensors_are_refused(commissioned):
    spectra = drawn(VEHICLE, row({}), 0)
    fewer = SpectralMatrix(spectra.values[:, :5, :5], spectra.n_averages)
    with pytest.raises(ValueError, match="6 x 6 on 15 bins for the sensors axle_box_axle1_left"):
        fit_parts(commissioned, trip(fewer, 70.0))


def test_too_few_trips_and_certain_vehicles_are_refused():
    one = trip(drawn(VEHICLE, row({}), 0), 70.0)
    with pytest.raises(ValueError, match="at least 3 are needed"):
        commission_bogie(VEHICLE, [one] * 2)
    lost = [without(one, ["body_left"])] * 3
    with pytest.raises(ValueError, match="healthy trips need all sensors, one has none at body_l"):
        commission_bogie(VEHICLE, lost)
    with pytest.raises(ValueError, match="nothing of the vehicle is uncertain"):
        commission_bogie(replace(VEHICLE, distribution=None), [one] * 3)
