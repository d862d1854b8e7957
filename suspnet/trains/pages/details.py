"""The details section of a report: model, settings and version, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from suspnet._version import __version__
from suspnet.estimation.temperature import DampingByTemperature
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import Limits, limits_words
from suspnet.ground.records import TripResult
from suspnet.ground.storage import printable
from suspnet.ground.wording import kilometres, thousands
from suspnet.runs.language import N_
from suspnet.trains.maintenance.relative import first_trips
from suspnet.trains.maintenance.state import UNKNOWN_HEALTHY
from suspnet.trains.pages.tables import files_read_as
from suspnet.trains.trips.commissionings import eras, speed_words

ALONE = "by this suspension alone, as no other of its vehicle shows how fast such parts wear"
NO_STORE = "with those of a history (store=) the plan of a fleet may give others"


def report_details(
    folder: Path,
    models: Sequence[TrainedModel],
    results: list[TripResult],
    limits: Mapping[str, Limits],
    level: float,
    n_reference: int | None,
) -> dict[str, str]:
    """Return the details of a report: model, settings and version.

    `level` is the probability of the intervals, and `n_reference` the number of first trips that
    define healthy (None: the models do).
    """
    first = models[0]
    healthy = together((healthy_words(era[0]) for era in eras(models)), "; then ")
    if n_reference is not None:
        reference = first_trips(results, n_reference)
        n_flagged = sum(bool(r.flags) for r in reference)
        flagged = Finding("of-them-flagged", n=n_flagged) if n_flagged else ""
        median = Finding("first-trips-median", n=len(reference)) if reference else ""
        missing = missing_reference(results, n_reference)
        healthy = together((together((median, flagged), ", "), missing))
    misfits = together((misfit_words(era[0]) for era in eras(models)), "; then ")
    kind = type(first.generator).__name__
    intervals: str = "none: the model was trained with data.n_calibrate=null"
    if first.intervals is not None:
        n_scores = len(first.intervals.conformal.scores)
        intervals = Finding("calibrated", level=100 * level, n_scores=n_scores)
    return {
        N_("trips"): printable(str(folder)),
        N_("bogie"): together(dict.fromkeys(m.generator.bogie or "any" for m in models), ", "),
        "suspnet": __version__,
        N_("date"): datetime.now().astimezone().isoformat(" ", "seconds"),
        N_("model"): Finding(
            "trained", name=first.name, n=first.training.get("n_train", 0), kind=kind
        ),
        N_("speeds"): together(dict.fromkeys(map(speed_words, models)), ", "),
        N_("healthy is"): healthy,
        N_("misfit of the healthy trips"): misfits,
        N_("intervals"): intervals,
        N_("limits"): limits_words(limits),
    } | files_read_as(results)


def missing_reference(results: list[TripResult], n_reference: int | None) -> str:
    """Return what the first trips lack to define healthy; empty if nothing."""
    if n_reference is None:
        return ""
    n = len(first_trips(results, n_reference))
    if n == n_reference:
        return ""
    return Finding("reference-lacks", why=UNKNOWN_HEALTHY, n=n, n_needed=n_reference)


def healthy_words(model: TrainedModel) -> str:
    """Return the reference of a model's estimates, as text."""
    notes = model.training.get("commissioned")
    if not notes:
        return "the vehicle file's drawing"
    trips, (first, last) = Finding("trips", n=notes["n_trips"]), notes["mileage_km"]
    showed = Finding("showed-at", trips=trips, km=first)
    if kilometres(first) != kilometres(last):
        ends = {"low": thousands(first), "high": kilometres(last)}
        showed = Finding("showed-between", trips=trips, **ends)
    law = DampingByTemperature.noted(model.training)
    at = Finding("damping-at", celsius=law.healthy_c) if law else ""
    return together((showed, at), ", ")


def misfit_words(model: TrainedModel) -> str:
    """Return the misfit of a model's healthy trips, as text."""
    misfit = model.training.get("commissioned", {}).get("misfit")
    of_equal = "" if misfit is None else Finding("misfit-of-noise", misfit=misfit)
    if model.bogie is None:
        return of_equal or "none: the vehicle is that of the drawing, not commissioned"
    of_parts = Finding("misfit-of-parts", misfit=model.bogie.misfit)
    of_equal = of_equal and Finding("times-equal", words=of_equal)
    return together((of_parts, of_equal), ", ")


def wear_words(n_learnt: int, is_history: bool) -> str:
    """Return whose rates of wear predict the lives; with 0 suspensions only its own."""
    words: str = ALONE
    if n_learnt:
        where = "the history" if is_history else "this folder"
        words = Finding("wear-of-suspensions", n=n_learnt, where=where)
    return words if is_history else together((words, NO_STORE))
