"""Intervals of single trips follow their noise and hold the truth; what is odd is flagged."""

from dataclasses import replace
from itertools import chain, repeat
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats
from trip_fixtures import OUTPUTS, model_at

from suspnet.bounds.information import output_bounds
from suspnet.curves import cross_spectra
from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation import from_spectra as trust
from suspnet.estimation.from_curves import corrected, estimate_curves
from suspnet.estimation.from_spectra import CORRECTIONS, ONE_SIGMA, estimate_with_noise
from suspnet.estimation.intervals import Conformal, Intervals
from suspnet.vehicle import PARAMETERS
from suspnet.vehicle.quantities import FAILED_OTHER, OF_THE_TRIP, UNMEASURED, LogNormal

LEVEL = 0.9
WORN = {"k_p": 0.8, "c_s": 0.7, "M_s": 1.1}
ORDER = [PARAMETERS.index(name) for name in OUTPUTS]


@pytest.fixture(scope="module")
def model():
    """Sensors so noisy that noise is about half of the error at the averages of the training."""
    return model_at(n_train=500, snr_db=20.0, n_calibrate=150)


def refined(model, widened=1.0):
    """Return the model with refined estimates whose errors are `widened` times their deviations."""
    scores = stats.halfnorm.ppf((np.arange(1000) + 0.5) / 1000) * widened
    intervals = Intervals(Conformal(np.tile(scores[:, None], len(OUTPUTS))), True, None)
    return replace(model, refined=True, intervals=intervals)


def ratios_of(changes):
    return torch.tensor([[changes.get(name, 1.0) for name in PARAMETERS]], dtype=torch.float64)


def in_range(n, seed):
    """Return ratios (n, 5) spread over the range trained for."""
    low, high = [0.5] * 4 + [0.8], [1.6] * 4 + [1.3]
    return torch.as_tensor(np.random.default_rng(seed).uniform(low, high, (n, 5)))


def expected(model, ratios, share=1.0, generator=None):
    """Return the mean spectra of vehicles' trips with `share` of the averages of the training."""
    mean = model.settings.observer(generator or model.generator).expected(ratios)
    return CrossSpectra(mean.auto, mean.cross, mean.n_averages * share)


def drawn(mean, model, seed=0):
    """Return what one trip of each vehicle measures."""
    taps = moving_average_with(model.settings.welch.correlation().numpy())
    return sample_spectra(mean, taps, torch.Generator().manual_seed(seed))


def row(spectra, i=0):
    return CrossSpectra(spectra.auto[i], spectra.cross[i], spectra.n_averages)


def inputs_of(model, spectra):
    observer = model.settings.observer(model.generator)
    responses = observer.for_features(spectra.responses(model.settings.method)[None])
    return model.features(responses, model.settings.frequencies_hz())[0]


def regression(model, inputs):
    """Return what the regression makes of a trip's inputs, less its own error."""
    observer = model.settings.observer(model.generator)
    return corrected(model, observer, model.predict(inputs), CORRECTIONS)


def noise_part(model, spectra):
    """Return the half widths that the noise of a trip's spectra alone would give."""
    factors = [model.intervals.conformal.factors(p) for p in (LEVEL, ONE_SIGMA)]
    noise = trust._noise(model, model.settings.observer(model.generator), spectra)
    return noise * factors[0] / factors[1]


def read(model, spectra, level=LEVEL):
    """Return values and half widths (n_outputs,) and the flags in words."""
    found = estimate_with_noise(model, spectra, level)[0]
    return SimpleNamespace(
        values=found.values[0], half_widths=found.half_widths[0], flags=found.flags.reasons[0]
    )


def half_widths(model, share, changes=WORN):
    """Return the half widths of a trip whose spectra are as expected."""
    return read(model, row(expected(model, ratios_of(changes), share))).half_widths


def held(model, share, n, seed=7):
    """Return which truths lie in their interval, (n, n_outputs), and how many trips are flagged."""
    ratios = in_range(n, seed)
    spectra = drawn(expected(model, ratios, share), model, seed)
    found = [read(model, row(spectra, i)) for i in range(n)]
    errors = np.log(np.stack([one.values for one in found]) / ratios.numpy()[:, ORDER])
    inside = np.abs(errors) <= np.stack([one.half_widths for one in found])
    return inside, sum(bool(one.flags) for one in found)


# reference


@pytest.mark.parametrize(("output", "ends"), [(1e4, [3.2] * 4 + [2.6]), (-9e2, [0.25] * 4 + [0.4])])
def test_a_regression_far_off_gives_bounded_estimates(model, output, ends):
    outputs = chain([output, output], repeat(-output))  # its correction would go farther
    wild = SimpleNamespace(predict=lambda rows: np.full((len(rows), len(OUTPUTS)), next(outputs)))
    inputs = inputs_of(model, row(expected(model, ratios_of(WORN))))
    wild = replace(model, estimator=wild, corrected=True)
    assert np.abs(np.log(model.predict(inputs))).max() < 1  # far within the bounds
    np.testing.assert_allclose(wild.predict(inputs)[0], ends, rtol=1e-12)
    np.testing.assert_allclose(regression(wild, inputs)[0], ends, rtol=1e-12)


def test_a_trip_like_those_of_the_training_has_the_calibrated_interval(model, monkeypatch):
    spectra = row(expected(model, ratios_of(WORN)))
    monkeypatch.setattr(
        trust, "complete_ratios", lambda *_: ratios_of(WORN).numpy()
    )  # what is estimated is true
    inputs = inputs_of(model, spectra)
    found = read(model, spectra)
    predicted = regression(model, inputs)
    np.testing.assert_array_equal(found.values, predicted[0])
    scale = model.intervals.residual_scale.predict(model.with_estimates(inputs, predicted))
    limits = model.intervals.ends(predicted, scale, LEVEL)
    calibrated, noise = np.log(limits[1] / predicted)[0], noise_part(model, spectra)
    # the error is next to all noise; a residual scale learnt from 100 curves may be less than it
    assert (noise < 2 * calibrated).all()
    assert (noise < calibrated).sum() >= 4
    np.testing.assert_allclose(found.half_widths, np.maximum(calibrated, noise))
    assert (found.half_widths > 0.005).all()


@pytest.mark.every_value
@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("expected_noise", [0.5, 2.0])
def test_noise_of_the_training_is_replaced(model, monkeypatch, noise, expected_noise):
    """Noise in units of s_0; more of it than of the whole error cannot be taken away."""
    spectra = row(expected(model, ratios_of(WORN)))
    inputs = inputs_of(model, spectra)
    predicted = regression(model, inputs)
    factors = {p: model.intervals.conformal.factors(p) for p in (LEVEL, ONE_SIGMA)}
    known = model.with_estimates(inputs, predicted)
    s_0 = model.intervals.residual_scale.predict(known)[0] * factors[ONE_SIGMA]
    noises = iter([expected_noise * s_0, noise * s_0])
    monkeypatch.setattr(trust, "_noise", lambda *_: next(noises))
    lasting = max(1 - expected_noise**2, 0)
    s = s_0 * np.sqrt(lasting + noise**2)
    expected_half = s * factors[LEVEL] / factors[ONE_SIGMA]
    np.testing.assert_allclose(read(model, spectra).half_widths, expected_half)


def test_noise_is_the_spread_of_estimates_from_other_draws(model):
    mean = expected(model, ratios_of(WORN), share=0.5)
    many = CrossSpectra(
        mean.auto.expand(500, -1, -1), mean.cross.expand(500, -1, -1), mean.n_averages
    )
    observer = model.settings.observer(model.generator)
    responses = observer.for_features(drawn(many, model, seed=5).responses("IV"))
    inputs = model.features(responses, model.settings.frequencies_hz())[0]
    estimates = np.log(regression(model, inputs))
    found = trust._noise(model, observer, row(mean))
    low, high = np.quantile(estimates, stats.norm.cdf([-1, 1]), axis=0)
    # three times 0.96 / sqrt(64), the scatter of the spread of 64 draws
    np.testing.assert_allclose(found, (high - low) / 2, rtol=0.36)
    assert np.mean(found / ((high - low) / 2)) == pytest.approx(1, abs=0.25)


def test_refined_interval_is_that_of_the_information(model):
    """Where the calibration confirms the deviations of Gauss-Newton, they are the interval."""
    observer = model.settings.observer(model.generator)
    ratios = ratios_of(WORN)
    bounds = output_bounds(model.task, observer, ratios.numpy())[0] / ratios.numpy()[0, ORDER]
    found = half_widths(refined(model), 1.0)
    # measured covariances are averaged over five bins, and widened by n / (n - 2)
    np.testing.assert_allclose(found, stats.norm.ppf(0.95) * bounds, rtol=0.06)


@pytest.mark.parametrize(
    "share", [0.25, *(pytest.param(one, marks=pytest.mark.slow) for one in (1.0, 4.0))]
)
def test_error_of_the_generator_does_not_average_out(model, share):
    """Calibrated errors six times the deviations are not noise."""
    observer = model.settings.observer(model.generator)
    ratios = ratios_of(WORN)
    bounds = output_bounds(model.task, observer, ratios.numpy())[0] / ratios.numpy()[0, ORDER]
    deviations = half_widths(refined(model), share) / stats.norm.ppf(0.95)
    s = np.sqrt((6**2 - 1) * bounds**2 + deviations**2)
    found = half_widths(refined(model, widened=6.0), share)
    # the start of the search, where the noise is looked up, is a little off
    np.testing.assert_allclose(found, stats.norm.ppf(0.95) * s, rtol=0.05)


def test_smoothing_agrees_with_a_loop():
    rng = np.random.default_rng(0)
    covariance = rng.normal(size=(2, 2, 9)) + 1j * rng.normal(size=(2, 2, 9))
    found = cross_spectra._smoothed(torch.as_tensor(covariance)).numpy()
    for bin_ in range(9):
        near = [covariance[..., min(max(k, 0), 8)] for k in range(bin_ - 2, bin_ + 3)]
        np.testing.assert_allclose(found[..., bin_], sum(near) / 5)


def test_independent_bins_are_those_of_the_variance_of_their_mean():
    rho = torch.tensor([1.0, 4 / 9, 1 / 36], dtype=torch.float64)
    matrix = sum(
        r * (np.eye(5, k=k) + np.eye(5, k=-k)) / (2 if k == 0 else 1)
        for k, r in enumerate(rho.numpy())
    )
    assert cross_spectra._independent(rho) == pytest.approx(1 / (matrix.sum() / 25))
    assert cross_spectra._independent(torch.tensor([1.0])) == 5


# limit


def test_interval_goes_with_the_root_of_the_averages_where_noise_dominates(model):
    short, long = (half_widths(refined(model), share) for share in (0.5, 2.0))
    # at 13 averages n / (n - 2) adds 2.6 %
    np.testing.assert_allclose(short / long, 2, rtol=0.06)
    observer = model.settings.observer(model.generator)
    mean = [row(expected(model, ratios_of(WORN), share)) for share in (0.5, 2.0)]
    noise = [trust._noise(model, observer, spectra) for spectra in mean]
    # the same random numbers; their spread is not quite linear in the noise
    np.testing.assert_allclose(noise[0] / noise[1], 2, rtol=0.25)


def test_error_of_the_regression_stays_however_long_the_trip(model):
    conformal = Conformal(3 * model.intervals.conformal.scores)
    poor = replace(model, intervals=replace(model.intervals, conformal=conformal))
    usual, long, longer = (half_widths(poor, share) for share in (1, 1e3, 1e5))
    np.testing.assert_allclose(longer, long, rtol=0.02)
    assert (longer < 0.99 * usual).all()
    assert (longer > 0.3 * usual).all()
    noise = noise_part(poor, row(expected(poor, ratios_of(WORN))))
    np.testing.assert_allclose(longer, np.sqrt(usual**2 - noise**2), rtol=1e-3)
    assert (half_widths(refined(model), 1e5) < 0.01 * usual).all()


# property


@pytest.mark.parametrize("kind", ["as predicted", "refined"])
def test_g_s_beyond_its_band_does_not_matter_to_curves(model, kind):
    one = refined(model) if kind == "refined" else model
    observer = model.settings.observer(model.generator)
    ratios, rng = in_range(5, 3), np.random.default_rng(4)
    curves = observer.observe(ratios, 2)
    beyond = observer.frequencies_hz > model.settings.body_high_hz + 1e-9
    assert 5 < int(beyond.sum()) < 50
    changed, shape = curves.clone(), (5, int(beyond.sum()))
    other = 10.0 ** rng.uniform(-3, 3, shape) * np.exp(1j * rng.uniform(-np.pi, np.pi, shape))
    changed[:, 1, beyond] = torch.as_tensor(other)
    assert torch.equal(observer.for_features(changed), observer.for_features(curves))
    rows = torch.arange(5)
    residuals = [observer.misfit(part, ratios)(ratios, rows) for part in (curves, changed)]
    assert torch.equal(*residuals)
    assert float(residuals[0].abs().sum()) > 100
    estimates = [estimate_curves(one, observer, part, LEVEL) for part in (curves, changed)]
    for name in ("values", "low", "high"):
        np.testing.assert_array_equal(*(getattr(found, name) for found in estimates))
    assert estimates[0].flags.reasons == estimates[1].flags.reasons


@pytest.mark.parametrize("kind", ["as predicted", "refined"])
def test_g_s_beyond_its_band_does_not_matter_to_a_trip(model, kind):
    """Its phase is changed by that of the body, which leaves G_p as it is."""
    one = refined(model) if kind == "refined" else model
    spectra = row(drawn(expected(model, ratios_of(WORN)), model, 5))
    beyond = model.settings.frequencies_hz() > model.settings.body_high_hz + 1e-9
    phase = torch.as_tensor(np.random.default_rng(6).uniform(-np.pi, np.pi, len(beyond)))
    turned = spectra.cross.clone()
    turned[1:] *= torch.polar(beyond.double(), phase) + ~beyond  # axle box and bogie to body
    other = replace(spectra, cross=turned)
    both = spectra.responses("IV"), other.responses("IV")
    torch.testing.assert_close(both[0][0], both[1][0])
    assert float((both[0][1] - both[1][1]).abs()[beyond].median()) > 1e-3
    before, after = read(one, spectra), read(one, other)
    assert before.flags == after.flags
    if kind == "as predicted":
        np.testing.assert_allclose(after.values, before.values, rtol=1e-9)
        # the same noise, drawn otherwise: twice the scatter of two spreads of 64 draws
        np.testing.assert_allclose(after.half_widths, before.half_widths, rtol=0.34)
    else:  # the noise of a bin is told by its neighbours too, up to two bins off
        close = {"rtol": 0, "atol": 0.02 * float(before.half_widths.min())}
        np.testing.assert_allclose(after.values, before.values, **close)
        np.testing.assert_allclose(after.half_widths, before.half_widths, **close)


@pytest.mark.parametrize(
    ("kind", "share"), [("as predicted", 4.0), pytest.param("refined", 0.4, marks=pytest.mark.slow)]
)
def test_intervals_hold_the_truth_at_other_averages(model, kind, share):
    """10 trips, and an error that 20 would have: 90 % +- 6.7 %, and +- 3 % of the calibration."""
    one = refined(model) if kind == "refined" else model
    inside, n_flagged = held(one, share, 10)
    assert inside.mean() == pytest.approx(LEVEL, abs=3 * 0.073)
    assert n_flagged <= 1


@pytest.mark.parametrize(
    "change",
    [
        {"k_p": 0.3},
        {"k_s": 2.5},
        pytest.param({"c_s": 0.3}, marks=pytest.mark.slow),
        pytest.param({"M_s": 2.5}, marks=pytest.mark.slow),
    ],
)
def test_beyond_the_range_of_the_training_the_curve_decides(model, change):
    mean = expected(model, ratios_of(change))
    found = [read(model, row(drawn(mean, model, seed))) for seed in range(3)]
    truth = np.array([change.get(name, 1.0) for name in model.task.outputs])
    errors = np.array([np.log(one.values / truth) for one in found])
    assert [one.flags for one in found] == [""] * 3
    assert np.abs(errors[:, truth != 1]).max() < 0.02
    inside = np.abs(errors) < [one.half_widths for one in found]
    assert inside.mean() >= 0.7  # 90 %, less two deviations of a draw of 15


@pytest.mark.parametrize("order", [(1, 0, 2), pytest.param((0, 2, 1), marks=pytest.mark.slow)])
def test_swapped_channels_are_flagged(model, order):
    spectra = row(drawn(expected(model, ratios_of(WORN)), model))
    cross = [spectra.between(order[x], order[y]) for x, y in ((0, 1), (0, 2), (1, 2))]
    swapped = CrossSpectra(spectra.auto[list(order)], torch.stack(cross), spectra.n_averages)
    assert read(model, swapped).flags


def test_another_vehicle_is_flagged(model):
    vehicle = replace(model.vehicle, bogie_gyration_m=1.5 * model.vehicle.bogie_gyration_m)
    other = replace(model.generator, vehicle=vehicle)
    spectra = row(drawn(expected(model, ratios_of(WORN), generator=other), model))
    assert "the model cannot explain the curve" in read(model, spectra).flags


@pytest.mark.parametrize(("share", "seen"), [(0.25, 1.5), (1.0, 2.0), (4.0, 2.0)])
def test_misfit_is_that_of_trips_as_long_as_in_training(model, share, seen):
    """With a misfit of 2 the generator's errors are 3 times the noise in mean square."""
    found, _ = trust._refined(
        model,
        model.settings.observer(model.generator),
        row(expected(model, ratios_of({}))),
        np.ones((1, len(OUTPUTS))),
    )
    odd = replace(found, misfit=np.array([2.0]))
    expected_misfit = np.sqrt(1 + 3 * 0.25) if share == 0.25 else seen
    assert trust._as_in_training(odd, share).misfit[0] == pytest.approx(expected_misfit)


def test_error_of_estimates_without_logarithms_becomes_relative(model):
    """Half widths of such a model are differences of ratios."""
    spectra = row(expected(model, ratios_of({"k_p": 0.5, "c_p": 1.6})))
    inputs = inputs_of(model, spectra)
    predicted = model.predict(inputs)
    relative = trust._residual_scale(model, inputs, predicted)
    plain = replace(model, intervals=replace(model.intervals, log=False))
    np.testing.assert_allclose(
        trust._residual_scale(plain, inputs, predicted), relative / predicted[0]
    )


def test_trips_on_another_device_are_read_on_this_one(model, monkeypatch):
    """The spectra of a recording are on the CPU, wherever the model is."""
    spectra = row(drawn(expected(model, ratios_of(WORN)), model))
    seen = []
    original = type(model.settings).observer
    monkeypatch.setattr(
        type(model.settings),
        "observer",
        lambda settings, generator: seen.append(generator) or original(settings, generator),
    )
    moved = replace(model.generator)
    object.__setattr__(moved, "device", "cuda")
    estimate_with_noise(replace(model, generator=moved), spectra, LEVEL)
    assert [generator.device for generator in seen] == ["cpu"]


# failure


def test_sensors_that_share_no_motion_give_no_estimate(model):
    spectra = row(drawn(expected(model, ratios_of(WORN)), model))
    apart = replace(spectra, cross=1e-4 * spectra.cross)
    with pytest.raises(NoEstimateError, match="at no frequency do axle box, frame and body"):
        estimate_with_noise(model, apart, LEVEL)


def test_model_without_calibration_has_neither_interval_nor_flags(model):
    spectra = row(drawn(expected(model, ratios_of(WORN)), model))
    plain = read(replace(model, intervals=None, ood=None), spectra)
    taken_further = read(replace(model, intervals=None, ood=None, refined=True), spectra)
    for one in (plain, taken_further):
        assert np.isnan(one.half_widths).all()
        assert one.flags == ""
    np.testing.assert_array_equal(plain.values, read(model, spectra).values)
    np.testing.assert_array_equal(taken_further.values, read(refined(model), spectra).values)
    assert not np.array_equal(plain.values, taken_further.values)


def test_draws_without_features_make_the_interval_infinite(model, monkeypatch):
    spectra = row(expected(model, ratios_of(WORN)))
    inputs = inputs_of(model, spectra)
    missing = np.full((trust.N_DRAWS, inputs.shape[1]), np.nan)
    missing[: trust.N_DRAWS // 2 - 1] = inputs
    original = type(model).features

    def of_draws(one, curves, bins):
        found = original(one, curves, bins)
        return (missing, found[1]) if len(curves) == trust.N_DRAWS else found

    monkeypatch.setattr(type(model), "features", of_draws)
    assert (read(model, spectra).half_widths == np.inf).all()


@pytest.mark.parametrize("widened", [1.0, 6.0])
def test_what_a_curve_does_not_tell_has_an_infinite_interval(model, monkeypatch, widened):
    spectra = row(expected(model, ratios_of(WORN)))
    found, _ = trust._refined(
        model, model.settings.observer(model.generator), spectra, np.ones((1, len(OUTPUTS)))
    )
    infinite = np.full_like(found.deviations, np.inf)
    blind = replace(found, deviations=infinite, noise=infinite)
    monkeypatch.setattr(trust, "_refined", lambda *_: (blind, ""))
    # without a warning either: these are errors in all tests
    assert (read(refined(model, widened), spectra).half_widths == np.inf).all()


# the other bogie


@pytest.mark.representatives(2)
@pytest.mark.parametrize("words", ["", *FAILED_OTHER])
def test_failed_air_spring_of_the_other_bogie_is_found_and_misleads_nothing(words):
    model = model_at()
    prior = LogNormal.independent(dict.fromkeys(OF_THE_TRIP, 0.2))
    uncertain = replace(model.generator, distribution=prior)
    model = replace(model, generator=uncertain)
    row = uncertain.complete(ratios_of(WORN))
    for name, ratio in zip(OF_THE_TRIP, FAILED_OTHER.get(words, (0.9, 1.2)), strict=True):
        row[0, len(PARAMETERS) + UNMEASURED.index(name)] = 1.1 * ratio
    mean = expected(model, row)
    spectra = CrossSpectra(mean.auto[0], mean.cross[0], mean.n_averages)
    found, _ = estimate_with_noise(model, spectra, LEVEL)
    assert found.found == (f"the other bogie has failed: {words}" if words else "")
    truth = ratios_of(WORN)[0, ORDER].numpy()
    np.testing.assert_allclose(found.values[0], truth, rtol=2e-3)
    assert not found.flags.flagged.any()


def test_numbers_are_renewed_about_changed_medians():
    posterior = LogNormal(
        ("other_k_s", "half_wheelbase"), (0.1, 0.02), ((0.01, 0.002), (0.002, 0.0004))
    )
    usual = posterior.renewed(("other_k_s",))
    failed = posterior.renewed(("other_k_s",), (8.0,), 0.5)
    np.testing.assert_allclose(usual.mean, posterior.mean)
    np.testing.assert_allclose(failed.median, posterior.median * [8.0, 1.0])
    np.testing.assert_allclose(usual.covariance, [[0.2**2, 0], [0, 0.0004]])
    np.testing.assert_allclose(failed.covariance, [[0.5**2, 0], [0, 0.0004]])
