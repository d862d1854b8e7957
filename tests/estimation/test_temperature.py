"""Damping at equal temperature: naive formulas, slopes that healthy trips show, whole trips."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scipy.stats import norm
from trip_fixtures import changed, model_at, write_trips
from vehicles import AM96

from suspnet.curves.cross_spectra import CrossSpectra, moving_average_with, sample_spectra
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import Speeds
from suspnet.estimation.estimate import Estimate, Flags
from suspnet.estimation.temperature import (
    DAMPINGS,
    NOTE,
    SLOPE_DEVIATION,
    USUAL_SLOPE,
    DampingByTemperature,
    kelvins_warmer,
)
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.fits.commissioning import commission
from suspnet.trains.fits.healthy_misfit import HealthyMisfit, HealthySpectra
from suspnet.trains.pages.details import healthy_words
from suspnet.trains.simulation.fleet import Scenario
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import VerticalVehicle

SETTINGS = EstimateSettings(
    segment_s=5.0, rates_hz=(1000.0, 500.0, 500.0), high_hz=9.9, body_high_hz=9.0
).bound(AM96)
GENERATOR = VerticalVehicle(AM96, distribution={f"healthy_{name}": 0.3 for name in ("c_p", "c_s")})
MASSES = (0.95, 1.05, 1.15)
SLOPES = {"c_p": -0.007, "c_s": -0.002}
LAW = DampingByTemperature(15.0, (-0.004, -0.005), (0.002, 0.001))


def healthy(temperatures_c, known=True, slopes=SLOPES):
    """Return drawn spectra of healthy trips whose damping follows their temperature."""
    source, groups = torch.Generator().manual_seed(0), []
    taps = moving_average_with(SETTINGS.welch.correlation().numpy())
    middle = np.mean(temperatures_c)
    for i, (mass, warm_c) in enumerate(zip(MASSES, temperatures_c, strict=True)):
        c_p, c_s = (math.exp(slopes[name] * (warm_c - middle)) for name in DAMPINGS)
        bogies = replace(GENERATOR, distribution=None, other_bogie="same")
        rows = torch.tensor([[1.0, c_p, 1.0, c_s, mass]], dtype=torch.float64)
        at = Speeds((70.0,), (1.0,))
        drawn = sample_spectra(SETTINGS.observer(bogies).at(at).expected(rows), taps, source)
        spectra = CrossSpectra(drawn.auto[0], drawn.cross[0], drawn.n_averages)
        given = warm_c if known else None
        groups.append(HealthySpectra(i, f"trip_{i}", at, spectra, temperature_c=given))
    return groups


# reference


@pytest.mark.parametrize("warm_c", [-20.0, 15.0, 41.5])
def test_a_trip_is_compared_as_the_formula_says(warm_c):
    names = ("k_p", "c_p", "k_s", "c_s")
    values = np.array([[1.01, 0.8, 0.97, 1.2], [0.9, 1.1, 1.0, 0.6]])
    low, high = values * [0.98, 0.9, 0.99, 0.95], values * [1.02, 1.1, 1.01, 1.08]
    found = LAW.compared(Estimate(names, values, low, high, 0.9, Flags.none(2)), warm_c)
    np.testing.assert_array_equal(found.values[:, ::2], values[:, ::2])  # springs
    np.testing.assert_array_equal(found.low[:, ::2], low[:, ::2])
    z = norm.ppf(0.95)
    for row in range(2):
        for j, b, deviation in ((1, -0.004, 0.002), (3, -0.005, 0.001)):
            log = math.log(values[row, j]) - b * (warm_c - 15.0)
            assert found.values[row, j] == pytest.approx(math.exp(log))
            common = z * deviation * abs(warm_c - 15.0)
            below = math.hypot(math.log(values[row, j] / low[row, j]), common)
            above = math.hypot(math.log(high[row, j] / values[row, j]), common)
            assert found.low[row, j] == pytest.approx(math.exp(log - below))
            assert found.high[row, j] == pytest.approx(math.exp(log + above))


def test_trips_of_all_temperatures_have_the_sum_of_squares_of_the_damping_there():
    groups = healthy((-5.0, 10.0, 31.0))
    target = HealthyMisfit(GENERATOR, SETTINGS, groups)
    assert target.n_of_damping == 2
    standard = np.array([0.4, -1.3])
    z = np.array([0.1, -0.2])
    theta = np.concatenate([z, np.log(MASSES), standard])
    found = target.residuals(torch.as_tensor(theta)[None], 0.0).square().sum()
    expected = np.sum(z**2) + np.sum(standard**2)
    expected += np.sum(((np.log(MASSES) - math.log(1.05)) / 0.15) ** 2)
    healthy_logs = GENERATOR.distribution.factor @ z
    for group, warm_c in zip(groups, (-5.0, 10.0, 31.0), strict=True):
        own = -0.004 + 0.002 * standard
        c_p, c_s = np.exp(healthy_logs + own * (warm_c - 12.0))
        bogies = replace(GENERATOR, distribution=None, other_bogie="same")
        row = torch.tensor([[1.0, c_p, 1.0, c_s, MASSES[group.trip]]], dtype=torch.float64)
        observer = SETTINGS.observer(bogies).at(group.speeds)
        misfit = observer.measured_misfit(group.spectra)
        u = 1 - observer.noise_free(row) / misfit.observed
        white = misfit.whitened(u, torch.zeros(1, dtype=torch.int64), 0.0)
        expected += float(white.square().sum())
    assert float(found) == pytest.approx(expected, rel=1e-9)


def test_slopes_are_found_where_healthy_trips_differ_in_temperature():
    found = commission(GENERATOR, SETTINGS, healthy((-5.0, 10.0, 31.0)), n_starts=1)
    law = found.laws.temperature
    assert law.healthy_c == 12.0
    for name, slope, deviation in zip(DAMPINGS, law.slopes, law.deviations, strict=True):
        assert deviation < 0.3 * SLOPE_DEVIATION
        assert abs(slope - SLOPES[name]) < 4 * deviation
    assert found.misfit < 1.1
    np.testing.assert_allclose(found.masses, MASSES, rtol=0.02)
    unknown = commission(GENERATOR, SETTINGS, healthy((-5.0, 10.0, 31.0), False), n_starts=1)
    assert unknown.laws.temperature is None
    assert unknown.misfit > 1.5  # one damping does not explain trips of all temperatures


# whole trips


@pytest.fixture(scope="module")
def warm_trip(tmp_path_factory):
    """A trip whose dampers have lost 8 %."""
    lost = {"from_km": 0, "to_km": 0, "ratio": 0.92}
    folder = tmp_path_factory.mktemp("warm")
    (path,) = write_trips(folder, scenario=Scenario("warm", dict.fromkeys(DAMPINGS, lost)))
    return changed(path, folder, "at_35", temperature_c=35.0), path


def test_a_warm_trip_reads_healthy_where_its_temperature_is_known(warm_trip):
    known, unknown = warm_trip
    plain = model_at()
    notes = {"n_trips": 3, "mileage_km": [0.0, 10.0], NOTE: asdict(DampingByTemperature(15.0))}
    model = replace(plain, training=plain.training | {"commissioned": notes})
    as_before = evaluate_trip(known, [plain], TripSettings())
    cold, warm = (evaluate_trip(one, [model], TripSettings()) for one in (unknown, known))
    assert cold.estimates == as_before.estimates
    assert cold.half_widths == as_before.half_widths
    for name in DAMPINGS:
        assert cold.estimates[name] == pytest.approx(0.92, abs=0.02)
        assert warm.estimates[name] == pytest.approx(cold.estimates[name] * math.exp(0.08))
        assert abs(math.log(warm.estimates[name])) < warm.half_widths[name]
        assert warm.half_widths[name] > norm.ppf(0.95) * 0.04
    assert warm.estimates["k_s"] == cold.estimates["k_s"]
    assert healthy_words(model) == "what 3 trips from 0 to 10 km showed, damping at 15 °C"
    alone = model.estimate(known)
    assert dict(zip(alone.names, alone.values[0].tolist(), strict=True)) == warm.estimates


# limits


@pytest.mark.parametrize("temperatures_c", [(12.0, 12.0, 12.0), (None, 12.0, None)])
def test_trips_of_one_temperature_leave_the_prior(temperatures_c):
    groups = [
        replace(one, temperature_c=warm_c)
        for one, warm_c in zip(healthy((0.0, 0.0, 0.0)), temperatures_c, strict=True)
    ]
    target = HealthyMisfit(GENERATOR, SETTINGS, groups)
    assert target.n_of_damping == 0
    _, laws, _ = target.posterior(np.concatenate([np.zeros(2), np.log(MASSES)]))
    assert laws.temperature == DampingByTemperature(
        12.0, (USUAL_SLOPE,) * 2, (SLOPE_DEVIATION,) * 2
    )


def test_an_unknown_temperature_changes_nothing():
    one = Estimate(("c_p",), *np.ones((3, 1, 1)), 0.9, Flags.none(1))
    assert LAW.compared(one, None) is one
    assert DampingByTemperature.noted({"commissioned": {"n_trips": 3}}) is None
    assert DampingByTemperature.noted({"seed": 0}) is None
    assert kelvins_warmer([None, 5.0, 9.0]) == (7.0, [0.0, -2.0, 2.0])
    assert kelvins_warmer([None, None]) == (None, [0.0, 0.0])


def test_intervals_that_are_missing_or_reach_0_stay_so():
    nan = np.full((1, 1), np.nan)
    found = LAW.compared(Estimate(("c_s",), np.ones((1, 1)), nan, nan, 0.9, Flags.none(1)), 25.0)
    assert found.values[0, 0] == pytest.approx(math.exp(0.05))
    assert np.isnan([found.low, found.high]).all()
    ends = np.zeros((1, 1)), np.full((1, 1), np.inf)
    found = LAW.compared(Estimate(("c_s",), np.ones((1, 1)), *ends, 0.9, Flags.none(1)), 25.0)
    assert (found.low[0, 0], found.high[0, 0]) == (0.0, np.inf)


# misuse


@pytest.mark.parametrize(
    ("note", "message"),
    [
        ({"healthy_c": math.nan}, "healthy_c` must be a finite number"),
        ({"healthy_c": 10.0, "slopes": [0.0]}, "slopes` must be 2 numbers"),
        ({"healthy_c": 10.0, "deviations": [0.001, math.inf]}, "deviations` must be a finite"),
    ],
)
def test_a_law_that_cannot_be_is_refused(note, message):
    with pytest.raises(ValueError, match=message):
        DampingByTemperature.noted({"commissioned": {NOTE: note}})
