"""Several commissionings of one suspension: which a trip is read with, and how they compare.

After maintenance a vehicle is commissioned anew. Its trips from the first new healthy one on are
read with the models of the new commissioning, and their estimates are relative to the new healthy
values. Values in SI units compare across: the figure of the trend shows all trips relative to the
healthy values of the first commissioning, while limits and tests are about the trips since the last
one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.wording import kilometres
from suspnet.history.records import TripResult, relative_truth
from suspnet.maintenance.trend import PAYLOAD


@dataclass(frozen=True)
class Commissioning:
    """One healthy state of a suspension.

    Attributes
    ----------
    since_km : float, [km]
        Mileage of its first healthy trip.
    healthy_si : dict of float, [N/m, N s/m, kg]
    relative : dict of float, [-]
        Its healthy values over those of the first commissioning.
    trips : tuple of str
        Names of its healthy trips.
    """

    since_km: float
    healthy_si: dict[str, float]
    relative: dict[str, float]
    trips: tuple[str, ...]

    @property
    def words(self) -> str:
        """What healthy is now, in % of the first commissioning."""
        told = ", ".join(
            f"{name} {100 * ratio:.3g} %"
            for name, ratio in self.relative.items()
            if name != PAYLOAD
        )
        return f"from {kilometres(self.since_km)} on healthy is {told} of the first commissioning"


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
            "one run is commissioned and another is not, so that they do not mean the same by "
            "healthy; give runs that were trained with healthy=DIR"
        )
    return [
        [model for model, km in zip(models, starts, strict=True) if km == start]
        for start in sorted(set(starts))
    ]


def models_at(models: Sequence[TrainedModel], mileage_km: float) -> list[TrainedModel]:
    """Return the models of the latest commissioning that begins at or before a trip.

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
    first = used[0].healthy
    return [
        Commissioning(
            since_km(model),
            dict(zip(first.names, model.healthy.values.tolist(), strict=True)),
            dict(zip(first.names, (model.healthy.values / first.values).tolist(), strict=True)),
            tuple(model.training["commissioned"].get("trips", ())),
        )
        for model in used
    ]


def of_last_era(results: Sequence[TripResult], found: Sequence[Commissioning]) -> list[TripResult]:
    """Return the trips since the last commissioning; all, if there is none."""
    if not found:
        return list(results)
    return [r for r in results if r.healthy_since_km == found[-1].since_km]


def with_truth_of_each(
    results: Sequence[TripResult], found: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results whose truth, where it is known, is relative to their healthy trips'."""
    done = list(results)
    for one in found:
        healthy = [r for r in results if r.trip in one.trips]
        done = [
            relative_truth(r, healthy) if r.healthy_since_km == one.since_km else r for r in done
        ]
    return done


def relative_to_first_healthy(
    results: Sequence[TripResult], found: Sequence[Commissioning]
) -> list[TripResult]:
    """Return results relative to the healthy values of the first commissioning."""
    factors = {one.since_km: one.relative for one in found}
    return [_times(r, factors.get(r.healthy_since_km, {})) for r in results]


def _times(result: TripResult, factors: dict[str, float]) -> TripResult:
    """Return a result with estimates and truth multiplied by factors, 1 where there is none."""
    estimates, truth = (
        {name: value * factors.get(name, 1.0) for name, value in part.items()}
        for part in (result.estimates, result.truth)
    )
    return replace(result, estimates=estimates, truth=truth)


def check_one_reference(models: Sequence[TrainedModel]) -> None:
    """Raise ValueError if there are several commissionings: first trips are healthy of one only."""
    if len(eras(models)) > 1:
        raise ValueError(
            "monitor.reference=first_trips is for one healthy state, and run= names several "
            "commissionings: leave it out, or give one run"
        )
