"""Models of a fleet: each suspension is read with those that were commissioned on it."""

from dataclasses import asdict, replace

import pytest
from trip_fixtures import changed, model_at

from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.trip_settings import TripSettings
from suspnet.estimation.validity import check_model
from suspnet.ground.records import Place
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.trips.commissionings import NAMED, models_of, place_of

HERE, THERE = Place("S1", "leading", "", "1", "1"), Place("S1", "leading", "", "1", "2")


def commissioned(place, first_km=1000.0, speed=70.0):
    """Return a model with the notes of a commissioning on a place; None says nothing of it."""
    notes = {"n_trips": 3, "mileage_km": [first_km, first_km + 1000.0], "trips": []}
    if place is not None:
        notes["place"] = asdict(place)
    model = model_at()
    generator = replace(model.generator, speed_m_per_s=speed)
    return replace(model, generator=generator, training=model.training | {"commissioned": notes})


def test_models_are_those_of_the_very_place():
    here, there = commissioned(HERE), commissioned(THERE)
    faster, anew = commissioned(HERE, speed=80.0), commissioned(HERE, 9e4)
    models = [there, here, faster, anew]
    assert models_of(models, HERE) == [here, faster, anew]
    assert models_of(models, THERE) == [there]
    assert (place_of(here), place_of(commissioned(None))) == (HERE, None)


def test_models_of_one_place_or_none_read_any_trip_of_their_bogie():
    here, older = commissioned(HERE), commissioned(None, 9e4)
    for models in ([here], [older], [here, older], [model_at()]):
        assert models_of(models, THERE) == models
        assert models_of(models, Place()) == models
    leading = model_at()
    both = [leading, replace(leading, generator=replace(leading.generator, bogie="trailing"))]
    assert models_of(both, Place("a", "trailing")) == both[1:]
    with pytest.raises(ModelFileError, match=r"of the trailing bogie, .* generator\.bogie=trail"):
        models_of(both[:1], Place("a", "trailing"))
    with pytest.raises(ModelFileError, match="the models are for both bogies"):
        models_of(both, Place("a"))


def test_place_without_a_model_is_told_with_those_that_have_one():
    unknown = replace(HERE, car="9")
    with pytest.raises(
        ModelFileError,
        match=r"none .* commissioned on train 1, car 9, S1, leading bogie, but on train 1, car 1, "
        r"S1, leading bogie; train 1, car 2, S1, leading bogie: commission it too",
    ):
        models_of([commissioned(HERE), commissioned(THERE)], unknown)
    several = [commissioned(replace(HERE, car=f"{i}")) for i in range(NAMED + 18)]
    with pytest.raises(ModelFileError, match=r"car 0, .* and 18 others: commission it too"):
        models_of(several, Place("S2"))


def test_models_of_one_place_must_still_fit_together():
    with pytest.raises(ModelFileError, match="two models are for the same speed"):
        models_of([commissioned(THERE), commissioned(HERE), commissioned(HERE)], HERE)


@pytest.mark.parametrize(
    "place",
    ["train 1", {"suspension": "S1"}, asdict(HERE) | {"side": 1}, asdict(HERE) | {"more": ""}],
)
def test_forged_place_is_refused(place):
    model = commissioned(HERE)
    check_model(model)
    model.training["commissioned"]["place"] = place
    with pytest.raises(TypeError, match=r"training\.commissioned\.place"):
        check_model(model)


def test_fleet_is_read_with_the_model_of_each_suspension(manifests, no_figures, tmp_path, caplog):
    for name, place in (("a", HERE), ("b", THERE), ("c", replace(HERE, car="9"))):
        (tmp_path / "trips" / name).mkdir(parents=True)
        told = {key: text for key, text in asdict(place).items() if text}
        changed(manifests[0], tmp_path / "trips" / name, "trip", **told)
    models = [commissioned(HERE, 1000.0), commissioned(THERE, 500.0)]
    settings = FleetSettings(TripSettings())
    done = evaluate_fleet(tmp_path / "trips", models, tmp_path / "out", settings, progress=False)
    read = {one.name: [r.healthy_since_km for r in one.results] for one in done}
    assert read == {"a": [1000.0], "b": [500.0], "c": []}
    assert "c is not read: none of the models is commissioned on train 1, car 9" in caplog.text
