"""Which of some models read a suspension's trips, and whether they can do so together."""

from __future__ import annotations

from collections.abc import Sequence

from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.steady_parts import speed_range
from suspnet.estimation.trained import TrainedModel
from suspnet.recordings.manifest import Place
from suspnet.spectra.speeds import range_words
from suspnet.trips.commissionings import eras

NAMED = 6
"""Number of suspensions that an error names."""


def check_models(models: Sequence[TrainedModel]) -> tuple[str, ...]:
    """Return the outputs of models that can read trips together.

    Raises
    ------
    ModelFileError
        If one was not trained on estimates from trips, needs a measured mass, or if they differ
        in vehicle or outputs or share a speed.
    """
    for model in models:
        trip_settings(model)
        if model.task.mass_known:
            raise ModelFileError("models with protocol.mass_known=true cannot read trips")
    first = models[0]
    for model in models[1:]:
        if (model.vehicle, model.task.outputs) != (first.vehicle, first.task.outputs):
            raise ModelFileError(
                "the models of `run` must share vehicle and outputs; give runs of one vehicle"
            )
    for era in eras(models):
        _check_together(era)
    return first.task.outputs


def _check_together(models: Sequence[TrainedModel]) -> None:
    """Raise ModelFileError if models of one commissioning are for both bogies or share a speed."""
    if len({model.generator.bogie for model in models} - {None}) > 1:
        raise ModelFileError(
            "the models are for both bogies: name `bogie: leading` or `bogie: trailing` in the "
            "manifests, or give the folder of one run"
        )
    speeds = [model.generator.speed_m_per_s for model in models]
    if len(set(speeds)) < len(speeds):
        words = ", ".join(dict.fromkeys(map(speed_words, models)))
        raise ModelFileError(
            f"two models are for the same speed ({words}); give the folder of one run, or of a "
            "multirun over speed_m_per_s alone"
        )


def speed_words(model: TrainedModel) -> str:
    """Return the speeds that a model reads, in words."""
    found = speed_range(model)
    return "any" if found is None else range_words([found])


def place_of(model: TrainedModel) -> Place | None:
    """Return the suspension that a model was commissioned on; None if its file does not say it."""
    noted = model.training.get("commissioned", {}).get("place")
    return Place(**noted) if noted else None


def models_of(models: Sequence[TrainedModel], place: Place) -> list[TrainedModel]:
    """Return the models that read a suspension's trips.

    Of models that were commissioned on several suspensions, those of this one; of others, those of
    its bogie, if it is named.

    Parameters
    ----------
    models : sequence of TrainedModel
        Of one suspension or vehicle, or of each suspension of a fleet.
    place : Place

    Raises
    ------
    ModelFileError
        If there is none, or if the models cannot read trips together.
    """
    known = sorted({one for one in map(place_of, models) if one is not None})
    if len(known) > 1:
        models = [model for model in models if place_of(model) == place]
        if not models:
            raise ModelFileError(
                f"none of the models is commissioned on {place}, but on {_named(known)}: "
                "commission it too, with healthy=DIR of its own trips"
            )
    fitting = [m for m in models if not place.bogie or m.generator.bogie in (None, place.bogie)]
    if not fitting:
        raise ModelFileError(
            f"the trips are of the {place.bogie} bogie, the models of the other one: train one "
            f"with generator.bogie={place.bogie}"
        )
    check_models(fitting)
    return fitting


def _named(places: Sequence[Place]) -> str:
    """Return the first places in words, and how many more there are."""
    words = "; ".join(map(str, places[:NAMED]))
    return words if len(places) <= NAMED else f"{words} and {len(places) - NAMED} others"
