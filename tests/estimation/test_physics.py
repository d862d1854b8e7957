"""What healthy trips leave unexplained: nothing is made of noise, a systematic error is found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from trip_fixtures import OUTPUTS, model_at

from suspnet.curves.problem import Problem
from suspnet.estimation.estimate import KINDS, Estimate
from suspnet.estimation.flags import COSTLY, NOT_CONVERGED, Residual, Unexplained
from suspnet.estimation.from_curves import estimate_curves
from suspnet.estimation.from_spectra import COMMON, UNWORN, estimate_with_noise, unworn_deviations
from suspnet.ground.types import FloatArray
from suspnet.runs.predict import with_unexplained

COSTS = np.array([0.01, 0.1, 0.02, 0.03, 0.0])
LEVEL = 0.9


def unworn(model, ratios):
    """Return what friction costs at some ratios, written out."""
    shares = {name: model.vehicle.primary_friction_share * u for name, u in UNWORN.items()}
    costs = [shares.get(name, 0) * abs(1 - r) / r for name, r in zip(OUTPUTS, ratios, strict=True)]
    factors = model.intervals.conformal
    return np.log(1 + np.array(costs)) * factors.factors(LEVEL) / factors.factors(0.6827)


def groups(error, n_groups=5, n_freq=400, seed=0):
    """Return observed and fitted curves that differ by `error` and noise, and its deviations."""
    random = np.random.default_rng(seed)
    shape = (n_groups, 2, n_freq)
    deviations = random.uniform(0.01, 0.03, shape)
    fitted = np.exp(random.standard_normal(shape) + 1j * random.standard_normal(shape))
    noise = deviations * (random.standard_normal(shape) + 1j * random.standard_normal(shape))
    return fitted * np.exp(error + noise), fitted, deviations


def incomplete(model, misfit=5.7):
    return replace(model, unexplained=Unexplained(misfit, COSTS))


def trip(model, ratio=0.9):
    """Return the mean spectra of a worn vehicle."""
    observer = model.settings.observer(model.generator)
    mean = observer.expected(torch.full((1, 5), ratio, dtype=torch.float64))
    return type(mean)(mean.auto[0], mean.cross[0], mean.n_averages)


# reference


def test_residual_is_the_weighted_mean_less_what_noise_makes():
    error = 0.05 * np.exp(1j * np.linspace(0, 6, 400))
    observed, fitted, deviations = groups(error)
    found = Residual.of(3.0, observed, fitted, deviations).logs
    for link in range(2):
        weights = deviations[:, link] ** -2.0
        mean = np.average(np.log((observed / fitted)[:, link]), axis=0, weights=weights)
        noise = 2 / weights.sum(axis=0)
        share = 1 - 1 / np.mean(np.abs(mean) ** 2 / noise)
        np.testing.assert_allclose(found[link], np.sqrt(share) * mean, rtol=1e-9)
    assert np.abs(found - error).max() < 0.06
    assert np.abs(found.mean() / error.mean() - 1) < 0.1


# limit


@pytest.mark.parametrize("share", [0.0, 0.1])
@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.4])
def test_what_does_not_wear_costs_the_worn_primary_spring_only(ratio, share):
    costs = unworn_deviations(("k_p", "c_p", "c_s", "k_s"), np.full(4, ratio), share)
    unworn = share * UNWORN["k_p"]
    read = (1 - unworn) * ratio + unworn  # the spring wears, the share beside it stays
    np.testing.assert_allclose(costs[0], np.log(1 + abs(read - ratio) / ratio), atol=1e-12)
    assert (costs[1:] == 0).all()


def test_noise_alone_leaves_next_to_nothing():
    observed, fitted, deviations = groups(0.0)
    left = np.abs(Residual.of(1.0, observed, fitted, deviations).logs) ** 2
    of_noise = 2 / (deviations**-2.0).sum(axis=0)
    assert left.mean() < 0.15 * of_noise.mean()


def test_bins_that_tell_nothing_have_no_residual():
    observed, fitted, deviations = groups(0.1)
    deviations[:, 1, 7] = np.inf
    found = Residual.of(3.0, observed, fitted, deviations).logs
    assert found[1, 7] == 0
    assert np.isfinite(found).all()
    deviations[:, 0] = np.inf
    assert (Residual.of(3.0, observed, fitted, deviations).logs[0] == 0).all()


def test_nothing_unexplained_costs_nothing():
    model = model_at()
    bins = len(model.settings.frequencies_hz())
    problem = Problem(model.generator, model.task, model.settings)
    found = with_unexplained(problem, model, Residual(0.99, np.zeros((2, bins), complex)))
    assert (found.unexplained.costs == 0).all()
    assert not found.unexplained.is_incomplete
    one, share = estimate_with_noise(model, trip(model), LEVEL)
    other, _ = estimate_with_noise(found, trip(model), LEVEL)
    # what lasts is common to all trips of a commissioned vehicle
    wider = np.sqrt(share + COMMON**2 * (1 - share))
    expected = np.hypot(one.half_widths[0] * wider, COMMON * unworn(model, one.values[0]))
    np.testing.assert_allclose(other.half_widths[0], expected, rtol=1e-9)
    assert (wider > 1.05).any()
    assert one.flags.reasons == other.flags.reasons == ("",)


# property


def test_a_factor_on_both_curves_costs_what_it_moves_the_estimates():
    # corrections of the few vehicles that the regression misses are not linear
    model = replace(model_at(), corrected=False)
    problem = Problem(model.generator, model.task, model.settings)
    bins = len(model.settings.frequencies_hz())
    costs: list[FloatArray] = [
        with_unexplained(
            problem, model, Residual(2.0, np.full((2, bins), size, complex))
        ).unexplained.costs
        for size in (0.001, 0.002)
    ]
    assert (costs[0] > 1e-4).all()
    np.testing.assert_allclose(costs[1] / costs[0], 2.0, rtol=0.02)


def test_every_estimate_of_incomplete_physics_is_flagged_and_wider():
    model, spectra = model_at(), trip(model_at())
    plain, share = estimate_with_noise(model, spectra, LEVEL)
    found, less = estimate_with_noise(incomplete(model), spectra, LEVEL)
    factors = model.intervals.conformal
    sigma = COSTS * factors.factors(LEVEL) / factors.factors(0.6827)
    usual = plain.half_widths[0] * np.sqrt(share + COMMON**2 * (1 - share))
    sigma = np.hypot(sigma, unworn(model, plain.values[0]))
    np.testing.assert_allclose(found.half_widths[0], np.hypot(usual, COMMON * sigma), rtol=1e-9)
    np.testing.assert_array_equal(found.values, plain.values)
    assert (less[:4] < share[:4]).all()  # it is the same in every speed bin
    assert np.flatnonzero(found.flags.found[0]).tolist() == [KINDS.index("physics")]
    assert found.flags.reasons[0] == (
        "the commissioned vehicle leaves 5.7 times the noise of its healthy trips unexplained, "
        "which can cost 10 %"
    )


def test_curves_are_flagged_and_wider_too():
    model = model_at()
    observer = model.settings.observer(model.generator)
    curves = observer.noise_free(torch.full((2, 5), 0.9, dtype=torch.float64))
    plain, found = (estimate_curves(m, observer, curves, LEVEL) for m in (model, incomplete(model)))
    factors = model.intervals.conformal
    sigma = COSTS * factors.factors(LEVEL) / factors.factors(0.6827)
    expected = np.hypot(plain.half_widths, sigma)
    np.testing.assert_allclose(found.half_widths, expected, rtol=1e-9)
    assert found.flags.found[:, KINDS.index("physics")].all()
    assert "leaves 5.7 times" in found.flags.reasons[1]


def test_small_misfit_that_costs_much_is_incomplete_too():
    costs = np.array([0.0, 1.01 * COSTLY, 0.0, 0.0, 0.0])
    assert Unexplained(1.05, costs).words == (
        "the commissioned vehicle leaves 1.05 times the noise of its healthy trips unexplained, "
        "which can cost 5.1 %"
    )
    assert not Unexplained(1.05, costs / 1.02).is_incomplete
    assert Unexplained(1.05, 20 * costs).words.endswith("which can cost 100 %")


def test_noise_alone_is_not_called_incomplete_physics():
    assert not Unexplained(0.95, 2 * COSTS + COSTLY).is_incomplete


def test_model_without_intervals_is_flagged():
    model = replace(incomplete(model_at()), intervals=None, ood=None)
    found: Estimate = estimate_with_noise(model, trip(model), LEVEL)[0]
    assert found.flags.flagged.all()
    assert found.names == OUTPUTS


# failure


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"misfit": np.array([-1.0]), "costs": COSTS}, "`misfit` must be one number >= 0"),
        ({"misfit": np.array([1.0]), "costs": -COSTS}, "`costs` must be a list of numbers >= 0"),
    ],
)
def test_damaged_arrays_are_refused(arrays, message):
    with pytest.raises(ValueError, match=message):
        Unexplained.restored(arrays)


def test_curves_without_features_get_one_clear_error():
    model = model_at()
    bins = len(model.settings.frequencies_hz())
    problem = Problem(model.generator, model.task, model.settings)
    residual = Residual(9.0, np.full((2, bins), np.inf, complex))
    with pytest.raises(ValueError, match="no curve keeps its features"), np.errstate(all="ignore"):
        with_unexplained(problem, model, residual)


@cache
def estimate_without_notes():
    return estimate_with_noise(model_at(), trip(model_at()), LEVEL)[0]


@pytest.mark.parametrize(
    ("noted", "flagged"), [({}, 0), ({"converged": True}, 0), ({"converged": False}, 1)]
)
def test_trips_of_a_commissioning_that_did_not_converge_are_flagged(noted, flagged):
    known = replace(model_at(), training=model_at().training | {"commissioned": noted})
    estimate, _ = estimate_with_noise(known, trip(known), LEVEL)
    plain = estimate_without_notes()
    assert estimate.flags.reasons == (NOT_CONVERGED * flagged,)
    assert estimate.flags.has("physics").tolist() == [bool(flagged)]
    np.testing.assert_array_equal(estimate.values, plain.values)
    assert "commission again" in NOT_CONVERGED
