"""The details section of a report: model, settings and version, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from suspnet._version import __version__
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.temperature import DampingByTemperature
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.parameters import Limits, limits_words
from suspnet.ground.records import TripResult
from suspnet.ground.storage import printable
from suspnet.ground.wording import count, kilometres
from suspnet.maintenance.relative import first_trips
from suspnet.maintenance.state import UNKNOWN_HEALTHY
from suspnet.report.language import N_
from suspnet.report.tables import files_read_as
from suspnet.trips.commissionings import eras, speed_words

ALONE = "by this suspension alone, as no other of its vehicle shows how fast such parts wear"
NO_STORE = "; with those of a history (store=) the plan of a fleet may give others"


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
    trained = trip_settings(first)
    reference = "; then ".join(healthy_words(era[0]) for era in eras(models))
    if n_reference is not None:
        first_ones = first_trips(results, n_reference)
        reference = f"the median of the first {count(len(first_ones), 'trip')} (k and c)"
        flagged = sum(bool(r.flags) for r in first_ones)
        if flagged:
            reference += f", {flagged} of them flagged"
        missing = missing_reference(results, n_reference)
        if missing:
            reference = f"{reference}; {missing}" if first_ones else missing
    return {
        N_("trips"): printable(str(folder)),
        N_("bogie"): ", ".join(dict.fromkeys(m.generator.bogie or "any" for m in models)),
        "suspnet": __version__,
        N_("date"): datetime.now().astimezone().isoformat(" ", "seconds"),
        N_("model"): f"{first.name}, trained on {first.training.get('n_train', 0)} curves of "
        f"{type(first.generator).__name__}",
        N_("speeds"): ", ".join(dict.fromkeys(map(speed_words, models))),
        N_("transfer functions"): f"{trained.method}, {trained.window} windows of "
        f"{trained.segment_s:g} s",
        N_("healthy is"): reference,
        N_("misfit of the healthy trips"): "; then ".join(
            misfit_words(era[0]) for era in eras(models)
        ),
        N_("intervals"): _interval_words(first, level),
        N_("limits"): limits_words(limits),
    } | files_read_as(results)


def missing_reference(results: list[TripResult], n_reference: int | None) -> str:
    """Return what the first trips lack to define healthy; empty if nothing."""
    if n_reference is None:
        return ""
    n_found = len(first_trips(results, n_reference))
    if n_found == n_reference:
        return ""
    have = "has" if n_found == 1 else "have"
    return (
        f"{UNKNOWN_HEALTHY}: {count(n_found, 'trip')} {have} an estimate, the first "
        f"{n_reference} are needed (lower monitor.n_reference, or take "
        "monitor.reference=vehicle)"
    )


def healthy_words(model: TrainedModel) -> str:
    """Return the reference of a model's estimates, as text."""
    found = model.training.get("commissioned")
    if not found:
        return "the vehicle file's drawing"
    first, last = map(kilometres, found["mileage_km"])
    span = f"at {first}" if first == last else f"from {first.removesuffix(' km')} to {last}"
    law = DampingByTemperature.noted(model.training)
    at = f", damping at {law.healthy_c:.0f} °C" if law else ""
    return f"what {count(found['n_trips'], 'trip')} {span} showed{at}"


def misfit_words(model: TrainedModel) -> str:
    """Return the misfit of a model's healthy trips, as text."""
    misfit = model.training.get("commissioned", {}).get("misfit")
    of_equal = "" if misfit is None else f"{misfit:.2f} times the noise"
    if model.bogie is None:
        return of_equal or "none: the vehicle is that of the drawing, not commissioned"
    of_parts = f"{model.bogie.misfit:.2f} times the noise with each part read"
    return f"{of_parts}, {of_equal} with both sides and axles as equal" if of_equal else of_parts


def _interval_words(model: TrainedModel, level: float) -> str:
    """Return the source of the intervals, as text."""
    if model.intervals is None:
        return "none: the model was trained with data.n_calibrate=null"
    return (
        f"{100 * level:g} %, calibrated on {len(model.intervals.conformal.scores)} simulated "
        "curves that the model was not trained on, then adapted to the noise of each trip"
    )


def wear_words(n_learnt: int, is_history: bool) -> str:
    """Return whose rates of wear predict the lives; with 0 suspensions only its own."""
    words = ALONE
    if n_learnt:
        where = "the history" if is_history else "this folder"
        words = f"with the rates of wear of {count(n_learnt, 'suspension')} of {where}"
    return words if is_history else words + NO_STORE
