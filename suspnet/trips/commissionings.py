"""Commissionings: which models read a trip of a suspension, and its healthy reference.

A vehicle is commissioned again after maintenance. Its trips from the first new healthy one on are
read with the models of the new commissioning, and their estimates are relative to the new healthy
values. Values in SI units compare across commissionings: the trend figure shows all trips relative
to the healthy values of the first commissioning, while limits and tests use the trips since the
last one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from suspnet.dynamics import Vehicle
from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.steady_parts import speed_range
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BODY_MASS, REVERSE
from suspnet.ground.records import Commissioning, Place, TripResult
from suspnet.maintenance.relative import divided, medians
from suspnet.spectra.speeds import range_words

NAMED = 6
"""Largest number of suspensions that an error names."""


def since_km(model: TrainedModel) -> float:
    """Return the mileage of a model's first healthy trip, [km]; NaN if it is not commissioned."""
    found = model.training.get("commissioned")
    return float(found["mileage_km"][0]) if found else math.nan


def eras(models: Sequence[TrainedModel]) -> list[list[TrainedModel]]:
    """Return the models of each commissioning, the earliest first.

    Raises
    ------
    ModelFileError
        If one model is commissioned and another is not.
    """
    starts = [since_km(model) for model in models]
    if all(map(math.isnan, starts)):
        return [list(models)]
    if any(map(math.isnan, starts)):
        raise ModelFileError(
            "one run is commissioned and another is not, so their healthy values "
            "differ; give runs that were trained with healthy=DIR"
        )
    return [
        [model for model, km in zip(models, starts, strict=True) if km == start]
        for start in sorted(set(starts))
    ]


def models_at(models: Sequence[TrainedModel], mileage_km: float) -> list[TrainedModel]:
    """Return the models of the latest commissioning that starts at or before a trip.

    A trip before all of them is read with the first, one without a mileage with the last.
    """
    found = eras(models)
    before = [era for era in found if not since_km(era[0]) > mileage_km]
    return before[-1] if before else found[0]


def commissionings(
    models: Sequence[TrainedModel], results: Sequence[TripResult]
) -> list[Commissioning]:
    """Return the commissionings that trips were read with; empty if there is at most one."""
    seen = {r.healthy_since_km for r in results}
    used = [era[0] for era in eras(models) if since_km(era[0]) in seen]
    if len(used) < 2:
        return []
    values = [_healthy_si(model) for model in used]
    return [
        Commissioning(
            since_km(model),
            own,
            {name: value / values[0][name] for name, value in own.items()},
            tuple(model.training["commissioned"].get("trips", ())),
        )
        for model, own in zip(used, values, strict=True)
    ]


def _healthy_si(model: TrainedModel) -> dict[str, float]:
    """Return the healthy value of each parameter, and of each part if these are read."""
    return {
        name: value
        for one in model.references
        for name, value in zip(one.names, one.values.tolist(), strict=True)
    }


def with_truth_of_each(
    results: Sequence[TripResult], found: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results whose truth, if known, is relative to their commissioning's healthy trips."""
    done = list(results)
    for one in found:
        healthy = [r for r in results if r.trip in one.trips]
        done = [
            relative_truth(r, healthy) if r.healthy_since_km == one.since_km else r for r in done
        ]
    return done


def check_one_reference(models: Sequence[TrainedModel]) -> None:
    """Raise ValueError for several commissionings: first trips define only one reference."""
    if len(eras(models)) > 1:
        raise ValueError(
            "monitor.reference=first_trips is for one healthy state, and run= names several "
            "commissionings: leave it out, or give one run"
        )


def relative_truth(result: TripResult, healthy: Sequence[TripResult]) -> TripResult:
    """Return a result whose true k and c, if known, are relative to the median of healthy trips."""
    known = [r.truth for r in healthy if r.truth]
    names = [name for name in result.truth if name != BODY_MASS and all(name in t for t in known)]
    return replace(result, truth=divided(result.truth, medians(known, names)))


def check_models(models: Sequence[TrainedModel]) -> tuple[str, ...]:
    """Return the outputs of models that can read trips together.

    ModelFileError is raised if one was not trained on estimates from trips or needs a measured
    mass, or if they differ in vehicle or outputs or share a speed.
    """
    for model in models:
        trip_settings(model)
        if model.task.mass_known:
            raise ModelFileError("models with protocol.mass_known=true cannot read trips")
    first = models[0]
    for model in models[1:]:
        if _read_by(model) != _read_by(first):
            raise ModelFileError(
                "the models of `run` must share vehicle and outputs; give runs of one vehicle"
            )
    for era in eras(models):
        _check_together(era)
    return first.task.outputs


def _read_by(model: TrainedModel) -> tuple[Vehicle, tuple[str, ...], bool]:
    return model.vehicle, model.task.outputs, model.bogie is None


def _check_together(models: Sequence[TrainedModel]) -> None:
    if len({model.generator.bogie for model in models} - {None}) > 1:
        raise ModelFileError(Finding("both-bogies"))
    speeds = [(model.generator.speed_m_per_s, model.generator.direction) for model in models]
    if len(set(speeds)) < len(speeds):
        words = together(dict.fromkeys(map(speed_words, models)), ", ")
        raise ModelFileError(Finding("same-speed-twice", words=words))


def speed_words(model: TrainedModel) -> str:
    """Return the speeds that a model reads, as text."""
    found = speed_range(model)
    words = "any" if found is None else range_words([found])
    return Finding("in-reverse", words=words) if model.generator.direction == REVERSE else words


def place_of(model: TrainedModel) -> Place | None:
    """Return the suspension that a model was commissioned on; None if unknown."""
    noted = model.training.get("commissioned", {}).get("place")
    return Place(**noted) if noted else None


def models_of(models: Sequence[TrainedModel], place: Place) -> list[TrainedModel]:
    """Return the models that read a suspension's trips.

    If `models` were commissioned on several suspensions, these are the ones of `place`; otherwise
    those of its bogie, if it is named. ModelFileError is raised if there is none, or if they cannot
    read trips together.
    """
    known = sorted({one for one in map(place_of, models) if one is not None})
    if len(known) > 1:
        models = [model for model in models if place_of(model) == place]
        if not models:
            raise ModelFileError(Finding("not-commissioned-on", place=place, named=_named(known)))
    fitting = [m for m in models if not place.bogie or m.generator.bogie in (None, place.bogie)]
    if not fitting:
        raise ModelFileError(
            Finding("models-of-other-bogie", bogie=place.bogie, bogie2=place.bogie)
        )
    check_models(fitting)
    return fitting


def _named(places: Sequence[Place]) -> str:
    words = together(map(str, places[:NAMED]))
    n_more = len(places) - NAMED
    return Finding("and-others", words=words, n=n_more) if n_more > 0 else words
