"""What trips in a row name as worn: small wear, a part that was replaced, healthy trains."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm
from vehicles import AM96

from suspnet import SpatialVehicle
from suspnet.depot.live.results import report
from suspnet.depot.live.suspension import SectionEstimate
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.estimation.estimate import HealthyValues
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import together
from suspnet.ground.parameters import BOGIE_PARTS, COMPONENTS
from suspnet.ground.records import ERROR, Place, TripResult
from suspnet.trains.fits.bogie_fit import PartsEstimate
from suspnet.trains.fits.worn_parts import worn_parts
from suspnet.trains.history import History
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.pages.board import Board, BoardSettings
from suspnet.trains.trips.joint_verdicts import with_joint_verdicts

LEVEL = 0.9
NOISE = np.diag([0.004**2 if name[0] == "k" else 0.015**2 for name in BOGIE_PARTS])
SCATTER = HealthyScatter((0.0,) * 4, (0.0,) * 4, 6, tuple(map(tuple, NOISE)))
BOGIE = CommissionedBogie(SpatialVehicle(AM96), None, np.ones(6), 1.0, True, SCATTER)
PART = "c_p_axle2_left"


@pytest.fixture
def models(monkeypatch):
    model = BogieModel.__new__(BogieModel)
    training = {"commissioned": {"mileage_km": [0.0]}}
    healthy = HealthyValues(COMPONENTS, np.ones(13), np.zeros(13))
    values = {"bogie": BOGIE, "training": training, "healthy": healthy}
    for name, value in (values | {"generator": SimpleNamespace(vehicle=AM96)}).items():
        object.__setattr__(model, name, value)
    return [model]


def trips_of(levels, seed=0, part=PART):
    """Return the results of trips on which a part has these levels, read with noise."""
    rng, results = np.random.default_rng(seed), []
    deviations = np.sqrt(np.diag(NOISE))
    common = rng.multivariate_normal(np.zeros(12), NOISE / 7)
    for i, level in enumerate(levels):
        logs = common + rng.multivariate_normal(np.zeros(12), NOISE * 6 / 7)
        logs[BOGIE_PARTS.index(part)] += np.log(level)
        parts = PartsEstimate(
            np.append(np.exp(logs), 1.0), np.diag(np.append(deviations, 0.1) ** 2), 1.0, True, LEVEL
        )
        widths = norm.ppf((1 + LEVEL) / 2) * deviations
        results.append(
            TripResult(
                f"trip_{i}",
                f"trip_{i}.yaml",
                mileage_km=1000.0 * i,
                estimates=dict(zip(BOGIE_PARTS, np.exp(logs).tolist(), strict=True)),
                half_widths=dict(zip(BOGIE_PARTS, widths.tolist(), strict=True)),
                healthy_since_km=0.0,
                worn=together(one.finding for one in worn_parts(parts)),
            )
        )
    return results


def test_small_wear_is_named_by_several_trips(models):
    n_alone, n_joint, wrong = 0, 0, 0
    for seed in range(40):
        alone = trips_of([0.93] * 5, seed)
        joint = with_joint_verdicts(alone, models, LEVEL)
        n_alone += PART in str(getattr(alone[-1].worn, "values", {}).get("names"))
        names = getattr(joint[-1].worn, "values", {}).get("names", ())
        n_joint += names == (PART,)
        wrong += any(name != PART for name in names)
    assert n_alone < 12
    assert n_joint >= 30
    assert wrong == 0


def test_a_monitor_stores_what_several_trips_name(models, tmp_path, caplog):
    caplog.set_level("INFO")
    alone = [replace(one, vehicle=AM96.name) for one in trips_of([0.93] * 5)]
    joint = with_joint_verdicts(alone, models, LEVEL)
    assert sum(a.worn != j.worn for a, j in zip(alone, joint, strict=True)) > 0
    assert joint[-1].worn != alone[-1].worn
    suspension = SimpleNamespace(name="S", models=models)
    with History(tmp_path / "history.db") as store:
        settings = FleetSettings(TripSettings())
        for one in [*alone, alone[-1]]:  # the last one twice, as after a kill
            report(store, settings, suspension, SectionEstimate(one, {}, 1000.0))
        stored = store.read(AM96.name, Place())
    assert [one.worn for one in stored] == [one.worn for one in joint]
    assert str(joint[-1].worn) in caplog.text
    board = Board(str(tmp_path / "history.db"), BoardSettings())
    board.refresh()
    assert board.view.states[0].worn == joint[-1].worn


def test_the_finding_says_of_how_many_trips_it_is(models):
    joint = with_joint_verdicts(trips_of([0.93] * 5), models, LEVEL)
    named = [one.worn for one in joint if one.worn]
    assert all("for the last" in str(worn) and "axle 2, left" in str(worn) for worn in named)
    # the estimates are each trip's own
    assert [one.estimates for one in joint] == [one.estimates for one in trips_of([0.93] * 5)]


def test_what_a_trip_names_alone_stays(models):
    alone = trips_of([1.0, 1.0, 0.5, 0.5])
    joint = with_joint_verdicts(alone, models, LEVEL)
    assert [one.worn for one in joint] == [one.worn for one in alone]
    assert alone[-1].worn


def test_a_part_that_was_replaced_is_not_named_by_the_trips_before(models):
    joint = with_joint_verdicts(trips_of([0.7] * 4 + [1.02]), models, LEVEL)
    assert joint[-2].worn
    assert not joint[-1].worn


def test_trips_of_another_commissioning_and_without_an_estimate_do_not_count(models):
    alone = trips_of([0.93] * 5, seed=1)
    others = [replace(one, healthy_since_km=9e9) for one in alone[:-1]]
    assert with_joint_verdicts([*others, alone[-1]], models, LEVEL) == [*others, alone[-1]]
    failed = [replace(one, status=ERROR, estimates={}, worn="") for one in alone[:-1]]
    assert with_joint_verdicts([*failed, alone[-1]], models, LEVEL) == [*failed, alone[-1]]
    plain = [SimpleNamespace(bogie=None)]
    assert with_joint_verdicts(alone, plain, LEVEL) == alone


def test_healthy_trips_name_nothing(models):
    named = [
        one.worn
        for seed in range(30)
        for one in with_joint_verdicts(trips_of([1.0] * 10, seed), models, LEVEL)
        if one.worn
    ]
    assert named == []
