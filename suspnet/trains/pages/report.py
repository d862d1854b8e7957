"""The report page of one suspension, for its maintainers."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import BODY_MASS, KIND_NAMES, Severity, part_words
from suspnet.ground.records import INTERVAL_LEVEL, OK, Commissioning, TripResult, by_mileage
from suspnet.ground.wording import span, thousands
from suspnet.runs.figures import data_uri
from suspnet.runs.language import decimal, gettext, spoken
from suspnet.trains.maintenance.alarms import Acknowledgement, newest_of
from suspnet.trains.maintenance.assessment import Assessment, joined, overall, worst_first
from suspnet.trains.maintenance.series import N_LAST
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.bogie import bogie_of, small_figures
from suspnet.trains.pages.failing_sensors import failing_words
from suspnet.trains.pages.tables import sensor_rows, trip_table
from suspnet.trains.pages.templates import KILO, SEVERITIES, with_unit, write_page

FIGURES = ("trend", "responses", "signals")  # those that come first, with an explanation
NAMED = 3  # largest number of parameters that the first sentence of a report names


@dataclass(frozen=True, eq=False)
class Report:
    """Content of the files of one suspension.

    `results` are in the order of the mileage; `outputs` are the columns of the trip table.
    `details` are model, settings, version and date; `level` is the probability of the intervals.
    `commissionings` are given if there are several; the state covers the trips since the last one.
    `seen` are acknowledgements of the alarms.
    """

    results: list[TripResult]
    outputs: tuple[str, ...]
    state: State
    details: Mapping[str, str] = field(default_factory=dict)
    level: float = INTERVAL_LEVEL
    commissionings: Sequence[Commissioning] = ()
    seen: Sequence[Acknowledgement] = ()


def write_report(
    path: Path,
    title: str,
    report: Report,
    figures: Mapping[str, Figure],
    small: Mapping[str, Figure] | None = None,
) -> Path:
    """Write one self-contained HTML file atomically; return its path.

    The figures "trend", "responses" and "signals" come first, in this order and with an
    explanation; others follow under their own names. `small` are the trends of each parameter where
    parts of a bogie are read.
    """
    state, assessments = report.state, report.state.assessments
    trips = by_mileage(report.results)
    severity, finding = overall(assessments)
    findings = joined(worst_first(assessments))
    # remarks on the trips, each a sentence or empty
    doubts, unread = _doubts(trips), _unread(trips)
    wheels, dead = wheels_finding(trips), failing_words(trips)
    worn = _worn_on_last(trips)
    table = trip_table(trips, report.outputs, report.level)
    order = dict.fromkeys([*(name for name in FIGURES if name in figures), *figures])
    alarms = sorted(state.watched.alarms, key=lambda a: (not a.is_open, -a.severity, a.begin_km))
    tone = SEVERITIES[severity][0]
    # without an alarm but with remarks the page is neutral
    is_neutral = tone == "good" and any((doubts, unread, findings, worn, wheels, dead))
    drawn_parts = {name: data_uri(figure) for name, figure in (small or {}).items()}
    return write_page(
        path,
        "report.html",
        title=title,
        headline=_headline(trips),
        tone="plain" if is_neutral else tone,
        named=named_first(assessments, trips),
        finding=finding,
        doubts=doubts,
        unread=unread,
        worn=worn,
        wheels=wheels,
        dead=dead,
        findings=findings,
        assessments=[list(run) for _, run in groupby(assessments, lambda a: (a.severity, a.words))],
        limits=state.limits,
        alarms=[(alarm, newest_of(alarm, report.seen)) for alarm in alarms],
        bogie=bogie_of(state),
        small=small_figures(state, drawn_parts),
        figures={name: data_uri(figures[name]) for name in order},
        table=table,
        sensors=sensor_rows(state.series),
        commissionings=report.commissionings,
        events=state.series.events,
        healthy=_healthy(trips),
        level=table.level,
        healthy_level=f"{100 * report.level:g}",
        kinds=KIND_NAMES,
        details=report.details,
    )


def named_first(assessments: Sequence[Assessment], trips: Sequence[TripResult]) -> str:
    """Return the first sentence of a report with a finding, which names it; empty without one.

    It names the parameters of the largest severity, ``NAMED`` at most, and the suspension.
    """
    severity = overall(assessments)[0]
    if severity < Severity.NOTICE:
        return ""
    names = [
        part_words(assessment.parameter)
        for assessment in assessments
        if assessment.severity == severity and assessment.parameter != BODY_MASS
    ]
    text = f"{gettext(SEVERITIES[severity][1])}: " + "; ".join(map(spoken, names[:NAMED]))
    if len(names) > NAMED:
        text += " " + gettext("and %(n)s more") % {"n": len(names) - NAMED}
    places = dict.fromkeys(spoken(str(trip.place)) for trip in trips if trip.place.suspension)
    if not places:
        return text
    where = gettext("suspension %(name)s") % {"name": "; ".join(places)}
    return f"{text} ({where})"


def _worn_on_last(trips: Sequence[TripResult]) -> str:
    """Return a sentence on those of the last trips that show a worn part; empty without any."""
    last = [r for r in trips if r.status == OK][-N_LAST:]
    affected = [r for r in last if r.worn]
    if not affected:
        return ""
    on = Finding("last-trip")
    if len(last) > 1:
        on = Finding("last-trips", n=len(affected), n_last=len(last))
    newest = affected[-1]
    on = Finding("on-newest", trips=on, trip=newest.trip)
    return Finding("worn-on", trips=on, words=newest.worn)


def wheels_finding(trips: Sequence[TripResult]) -> str:
    """Return a sentence on out-of-round wheels, from the last trips; empty without a finding."""
    last = list(trips)[-N_LAST:]
    affected = [r for r in last if r.quality.wheels]
    if not affected:
        return ""
    kind = "wheels-on-trips" if len(last) > 1 else "wheels-on-trip"
    newest = {"trip": affected[-1].trip, "words": affected[-1].quality.wheels}
    return Finding(kind, **newest, n=len(affected), n_last=len(last))


def _headline(trips: Sequence[TripResult]) -> dict[str, Any]:
    """Return what the head of the page says; texts are empty where nothing is known."""
    mileage = [r.mileage_km for r in trips if math.isfinite(r.mileage_km)]
    starts = sorted(r.start[:10] for r in trips if r.start)
    misfits = [r.quality.misfit for r in trips if math.isfinite(r.quality.misfit)]
    places = dict.fromkeys(spoken(str(r.place)) for r in trips if r.place.suspension)
    return {
        "vehicle": ", ".join(dict.fromkeys(r.vehicle for r in trips if r.vehicle)),
        "suspension": "; ".join(places),
        "km": span(thousands(min(mileage)), thousands(max(mileage))) if mileage else "",
        "dates": span(starts[0], starts[-1]) if starts else "",
        "misfit": span(f"{min(misfits):.2f}", f"{max(misfits):.2f}") if misfits else "",
        "n": len(trips),
        "n_done": sum(r.status == OK for r in trips),
        "n_flagged": sum(bool(r.flags) for r in trips),
    }


def _doubts(trips: Sequence[TripResult]) -> str:
    """Return a sentence on flagged trips; empty if there is none."""
    done, flagged = sum(r.status == OK for r in trips), sum(bool(r.flags) for r in trips)
    if not flagged:
        return ""
    why = _commonest(r.flags for r in trips if r.flags)
    if flagged == done > 1:
        return Finding("all-flagged", n=done, why=why)
    return Finding("some-flagged", n=flagged, trips=Finding("trips", n=done), why=why)


def _unread(trips: Sequence[TripResult]) -> str:
    """Return a sentence on trips without an estimate; empty if there is none, or no other trip."""
    reasons = [r.reason for r in trips if r.status != OK]
    if len(reasons) in (0, len(trips)):
        return ""
    of_all, why = Finding("trips", n=len(trips)), _commonest(reasons)
    return Finding("no-estimate-of", n=len(reasons), trips=of_all, why=why)


def _commonest(reasons: Iterable[str]) -> str:
    """Return the reason that most trips have."""
    (most, n), *others = Counter(reasons).most_common()
    return Finding("n-of-them", n=n, words=most) if others else most


def _healthy(trips: Sequence[TripResult]) -> dict[str, str]:
    newest = next((r for r in reversed(trips) if r.healthy_si), TripResult("", ""))
    texts = {}
    for name, value in newest.healthy_si.items():
        half = 100 * newest.healthy_half_widths.get(name, 0.0)
        texts[name] = with_unit(f"{value / KILO:.4g}", name)
        if half > 0:
            texts[name] += f" ±\N{NO-BREAK SPACE}{decimal(f'{half:.2g}')}\N{NO-BREAK SPACE}%"
    return texts
