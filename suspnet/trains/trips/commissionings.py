"""Commissionings: which models read a trip of a suspension, and its healthy reference.

A vehicle is commissioned again after maintenance. Its trips from the first new healthy one on are
read with the new models, relative to the new healthy values. Values in SI units compare across
commissionings: the trend figure shows all trips relative to the first one's healthy values, while
limits and tests use the trips since the last one.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from suspnet.curves.speeds import range_words
from suspnet.estimation.fitted import FittedMethod, Model, ModelFileError
from suspnet.estimation.from_spectra import trip_settings
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, REVERSE
from suspnet.ground.records import Commissioning, Place, TripResult
from suspnet.trains.spectra.steady_parts import speed_range

NAMED = 6  # largest number of suspensions that an error names


def since_km(model: Model) -> float:
    """Return the mileage of a model's first healthy trip, [km]; NaN if it is not commissioned."""
    commissioned = model.training.get("commissioned")
    return float(commissioned["mileage_km"][0]) if commissioned else math.nan


def eras(models: Sequence[Model]) -> list[list[Model]]:
    """Return the models of each commissioning, the earliest first.

    ModelFileError is raised if one model is commissioned and another is not.
    """
    starts = [since_km(model) for model in models]
    if all(map(math.isnan, starts)):
        return [list(models)]
    if any(map(math.isnan, starts)):
        raise ModelFileError(Finding("run-not-commissioned"))
    return [
        [model for model, km in zip(models, starts, strict=True) if km == start]
        for start in sorted(set(starts))
    ]


def models_at(models: Sequence[Model], mileage_km: float) -> list[Model]:
    """Return the models of the latest commissioning that starts at or before a trip.

    A trip before all of them is read with the first, one without a mileage with the last.
    """
    all_eras = eras(models)
    before = [era for era in all_eras if not since_km(era[0]) > mileage_km]
    return before[-1] if before else all_eras[0]


def commissionings(models: Sequence[Model], results: Sequence[TripResult]) -> list[Commissioning]:
    """Return the commissionings that trips were read with; empty if there is at most one."""
    starts = {r.healthy_since_km for r in results}
    used = [healthy_state(era[0]) for era in eras(models) if since_km(era[0]) in starts]
    if len(used) < 2:
        return []
    first = used[0].healthy_si
    relative = [{name: si / first[name] for name, si in each.healthy_si.items()} for each in used]
    return [replace(each, relative=own) for each, own in zip(used, relative, strict=True)]


def healthy_state(model: Model) -> Commissioning:
    """Return the healthy state that a model's estimates are relative to."""
    values_si = dict(zip(model.healthy.names, model.healthy.values.tolist(), strict=True))
    trips = model.training.get("commissioned", {}).get("trips", ())
    return Commissioning(since_km(model), values_si, trips=tuple(trips))


def with_truth_of_each(
    results: Sequence[TripResult], several: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results whose truth, if known, is relative to their commissioning's healthy trips."""
    usual: dict[float, dict[str, float]] = {}
    for commissioning in several:
        truths = [r.truth for r in results if r.trip in commissioning.trips and r.truth]
        known = set.intersection(*map(set, truths)) - {BODY_MASS} if truths else set()
        medians = {name: float(np.median([truth[name] for truth in truths])) for name in known}
        usual[commissioning.since_km] = medians
    relative = []
    for r in results:
        medians = usual.get(r.healthy_since_km, {})
        truth = {name: value / medians.get(name, 1.0) for name, value in r.truth.items()}
        relative.append(replace(r, truth=truth))
    return relative


def check_models(models: Sequence[Model]) -> tuple[str, ...]:
    """Return the outputs of models that can read trips together.

    ModelFileError is raised if one was not trained on estimates from trips or needs a measured
    mass, or if they differ in vehicle or outputs or share a speed.
    """
    for model in models:
        trip_settings(model)
        if isinstance(model, FittedMethod) and model.task.mass_known:
            raise ModelFileError("models with protocol.mass_known=true cannot read trips")
    identities = [(model.vehicle, model.outputs) for model in models]
    if any(identity != identities[0] for identity in identities):
        raise ModelFileError(Finding("models-unlike"))
    for era in eras(models):
        if len({model.generator.bogie for model in era} - {None}) > 1:
            raise ModelFileError(Finding("both-bogies"))
        speeds = {(speed_range(model), model.generator.direction) for model in era}
        if len(speeds) < len(era):
            words = together(dict.fromkeys(map(speed_words, era)), ", ")
            raise ModelFileError(Finding("same-speed-twice", words=words))
    return models[0].outputs


def speed_words(model: Model) -> str:
    """Return the speeds that a model reads, as text."""
    speeds = speed_range(model)
    words = "any" if speeds is None else range_words([speeds])
    return Finding("in-reverse", words=words) if model.generator.direction == REVERSE else words


def place_of(model: Model) -> Place | None:
    """Return the suspension that a model was commissioned on; None if unknown."""
    noted = model.training.get("commissioned", {}).get("place")
    return Place(**noted) if noted else None


def models_of(models: Sequence[Model], place: Place) -> list[Model]:
    """Return the models that read a suspension's trips.

    If `models` were commissioned on several suspensions, these are the ones of `place`; otherwise
    those of its bogie, if it is named. ModelFileError is raised if there is none, or if they cannot
    read trips together.
    """
    places = sorted(
        {model_place for model_place in map(place_of, models) if model_place is not None}
    )
    if len(places) > 1:
        models = [model for model in models if place_of(model) == place]
        if not models:
            words = together(map(str, places[:NAMED]))
            if (n_more := len(places) - NAMED) > 0:
                words = Finding("and-others", words=words, n=n_more)
            raise ModelFileError(Finding("not-commissioned-on", place=place, named=words))
    fitting = [m for m in models if not place.bogie or m.generator.bogie in (None, place.bogie)]
    if not fitting:
        raise ModelFileError(
            Finding("models-of-other-bogie", bogie=place.bogie, bogie2=place.bogie)
        )
    check_models(fitting)
    return fitting
