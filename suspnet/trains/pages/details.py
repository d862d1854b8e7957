"""The details section of a report: model, settings and version, as text."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from suspnet._version import __version__
from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.fitted import FittedMethod, Model
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import Limits, limits_words
from suspnet.ground.records import TripResult
from suspnet.ground.storage import printable
from suspnet.ground.wording import kilometres, thousands
from suspnet.runs.language import N_
from suspnet.trains.pages.tables import files_read_as
from suspnet.trains.trips.commissionings import eras, speed_words


def report_details(
    folder: Path,
    models: Sequence[Model],
    results: list[TripResult],
    limits: Mapping[str, Limits],
    level: float,
) -> dict[str, str]:
    """Return the details of a report: model, settings and version.

    `level` is the probability of the intervals.
    """
    first = models[0]
    healthy = together((healthy_words(era[0]) for era in eras(models)), "; then ")
    misfits = together((misfit_words(era[0]) for era in eras(models)), "; then ")
    return {
        N_("trips"): printable(str(folder)),
        N_("bogie"): together(dict.fromkeys(m.generator.bogie or "any" for m in models), ", "),
        "suspnet": __version__,
        N_("date"): datetime.now().astimezone().isoformat(" ", "seconds"),
        N_("model"): _model_words(first),
        N_("speeds"): together(dict.fromkeys(map(speed_words, models)), ", "),
        N_("healthy is"): healthy,
        N_("misfit of the healthy trips"): misfits,
        N_("intervals"): _interval_words(first, level),
        N_("limits"): limits_words(limits),
    } | files_read_as(results)


def _model_words(model: Model) -> str:
    if isinstance(model, BogieModel):
        is_each = model.bogie.generator.shows_parts
        return Finding("commissioned-bogie" if is_each else "commissioned-vehicle")
    n, kind = model.training.get("n_train", 0), type(model.generator).__name__
    return Finding("trained", name=model.name, n=n, kind=kind)


def _interval_words(model: Model, level: float) -> str:
    """Return the source of the intervals, as text."""
    if isinstance(model, BogieModel):
        return Finding("intervals-of-posterior", level=100 * level)
    if not isinstance(model, FittedMethod) or model.intervals is None:
        return "none: the model was trained with data.n_calibrate=null"
    return Finding("calibrated", level=100 * level, n_scores=len(model.intervals.conformal.scores))


def healthy_words(model: Model) -> str:
    """Return the reference of a model's estimates, as text."""
    notes = model.training.get("commissioned")
    if not notes:
        return "the vehicle file's drawing"
    trips, (first, last) = Finding("trips", n=notes["n_trips"]), notes["mileage_km"]
    showed = Finding("showed-at", trips=trips, km=first)
    if kilometres(first) != kilometres(last):
        ends = {"low": thousands(first), "high": kilometres(last)}
        showed = Finding("showed-between", trips=trips, **ends)
    law = model.bogie.law if isinstance(model, BogieModel) else None
    at = Finding("damping-at", celsius=law.healthy_c) if law and law.healthy_c is not None else ""
    return together((showed, at), ", ")


def misfit_words(model: Model) -> str:
    """Return the misfit of a model's healthy trips, as text."""
    if not isinstance(model, BogieModel):
        return "none: the vehicle is that of the drawing, not commissioned"
    kind = "misfit-of-parts" if model.bogie.generator.shows_parts else "misfit-of-noise"
    return Finding(kind, misfit=model.bogie.misfit)
