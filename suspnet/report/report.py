"""One page that says how a suspension is, for people who maintain it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from suspnet.ground.parameters import NAMES
from suspnet.ground.storage import write_atomically
from suspnet.ground.wording import count, span, thousands, unbroken
from suspnet.history import Event
from suspnet.history.records import OK, TripResult
from suspnet.maintenance.alarms import Acknowledgement, Alarm, newest_of
from suspnet.maintenance.assessment import Assessment, joined, overall, worst_first
from suspnet.maintenance.limits import Limits
from suspnet.report.figures import data_uri
from suspnet.report.templates import KILO, SEVERITIES, render, with_unit
from suspnet.report.trip_table import sides_finding, trip_table
from suspnet.trips.commissionings import Commissioning

ROLES = {
    "k_p": ", between axle box and bogie frame.",
    "c_p": ", between axle box and bogie frame.",
    "k_s": ", between bogie frame and car body; often an air spring.",
    "c_s": ", between bogie frame and car body.",
    "M_s": ": it varies with the pay-load and says nothing about faults.",
}
CAPTIONS = {
    "trend": (
        "Health along the mileage",
        "Each dot is a trip and 100 % is healthy: dots that stay level mean no change; look for a "
        "line that leaves its level, and at the newest trips. Dashed lines are the limits, where "
        "they are near. Red ticks at the bottom are trips without an estimate.{intervals}{flags}",
    ),
    "responses": (
        "How the suspension passes vibration on",
        "Above: by how much each suspension amplifies vibration of each frequency, one line for "
        "each trip; a suspension that does not change draws the same line again and again. Below: "
        "the coherence, which is near 1 where the sensors explain each other.",
    ),
    "signals": (
        "Signals of one trip",
        "Grey is the range of the measured vibration, red its mean. A channel that is flat, cut "
        "off at a straight edge, or unlike the others points to a sensor, not to the suspension.",
    ),
    "quality": (
        "Quality of the recordings",
        "More averages, a coherence nearer to 1 and a larger usable share make the estimates of a "
        "trip more certain.",
    ),
}
INTERVALS_SHOWN = (
    " The bar through a dot is its {level} % interval: on {level} of 100 trips the true value lies "
    "within it, if vehicle and recording are like those of the training. Where no bar is to be "
    "seen, it is shorter than the dot."
)
FLAGS_SHOWN = (
    " A hollow circle is a flagged trip: it shows something that was not trained for, and its "
    "place may be wrong. A triangle at an edge is a trip beyond it, with its value."
)
ANEW = (
    "Commissioned anew: {}. Severities, medians and changes are of the trips since; each trip's "
    "percentages are of its own healthy values, those of the figure of the first ones."
)
MAINTAINED = "Maintenance: {}. Severities, medians and changes are of the trips since the last."


def write_report(
    path: Path,
    title: str,
    results: Sequence[TripResult],
    outputs: Sequence[str],
    figures: Mapping[str, Figure],
    assessments: Sequence[Assessment],
    details: Mapping[str, str],
    level: float = 0.9,
    limits: Mapping[str, Limits] | None = None,
    states: Sequence[Commissioning] = (),
    events: Sequence[Event] = (),
    alarms: Sequence[Alarm] = (),
    seen: Sequence[Acknowledgement] = (),
) -> Path:
    """Write one HTML file that needs no other file and no network.

    Parameters
    ----------
    path : Path
    title : str
    results : sequence of TripResult
        In any order; the table of trips follows the mileage.
    outputs : sequence of str
        Parameters, the columns of that table.
    figures : mapping of Figure
        "trend", "responses", "signals" and "quality" come first, in this order and with an
        explanation; others follow under their own name.
    assessments : sequence of Assessment
        One for each parameter.
    details : mapping of str
        Model, settings, version, date.
    level : float
        Probability of the intervals.
    limits : mapping of Limits, optional
        Of each parameter, for the table.
    states : sequence of Commissioning
        Several healthy states; `assessments` are of the trips since the last.
    events : sequence of Event
        Maintenance; `assessments` are of the trips since the last.
    alarms : sequence of Alarm
        Those that stand and those that ended.
    seen : sequence of Acknowledgement
        Of these.

    Returns
    -------
    Path
        The file, written atomically.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    trips = sorted(results, key=lambda r: (not math.isfinite(r.mileage_km), r.mileage_km, r.trip))
    severity, finding = overall(assessments)
    told = joined(worst_first(assessments))
    doubts, sides = _doubts(trips), sides_finding(trips)
    table = trip_table(trips, outputs, level)
    shown = {
        "intervals": INTERVALS_SHOWN.format(level=table.level) if table.level else "",
        "flags": FLAGS_SHOWN if doubts else "",
    }
    tone = SEVERITIES[severity][0]
    page = render(
        "report.html",
        title=title,
        headline=_headline(trips),
        tone="plain" if tone == "good" and (doubts or told or sides) else tone,
        finding=finding,
        doubts=doubts,
        sides=sides,
        told=told,
        assessments=[list(run) for _, run in groupby(assessments, lambda a: (a.severity, a.words))],
        limits=limits or {},
        alarms=[
            (one, newest_of(one, seen))
            for one in sorted(alarms, key=lambda a: (not a.is_open, -a.severity, a.begin_km))
        ],
        figures=[_embedded(name, figures[name], shown) for name in _ordered(figures)],
        table=table,
        anew=_anew(states, events),
        healthy=_healthy(trips),
        level=table.level,
        healthy_level=f"{100 * level:g}",
        names=NAMES,
        roles=ROLES,
        details=details,
    )
    return write_atomically(path, page.encode("utf-8", errors="replace"))


def _anew(states: Sequence[Commissioning], events: Sequence[Event]) -> str:
    """Return in words since when the assessments count; empty if since the first trip."""
    told = []
    if states:
        told.append(ANEW.format("; ".join(one.words for one in states[1:])))
    if events:
        told.append(MAINTAINED.format("; ".join(map(str, events))))
    return " ".join(told)


def _headline(trips: Sequence[TripResult]) -> dict[str, str]:
    """Return what the page is about: label and text."""
    mileage = [r.mileage_km for r in trips if math.isfinite(r.mileage_km)]
    between = "unknown"
    if mileage:
        between = unbroken(f"{span(thousands(min(mileage)), thousands(max(mileage)))} km")
    starts = sorted(r.start for r in trips if r.start)
    dates = " to ".join(dict.fromkeys(s[:10] for s in (starts[0], starts[-1]))) if starts else ""
    done = sum(r.status == OK for r in trips)
    flagged = sum(bool(r.flags) for r in trips)
    texts = {
        "Vehicle": ", ".join(dict.fromkeys(r.vehicle for r in trips if r.vehicle)),
        "Suspension": "; ".join(dict.fromkeys(str(r.place) for r in trips if r.place.suspension)),
        "Mileage": between,
        "Dates": dates,
        "Trips": f"{len(trips)}, of which {done} with an estimate"
        + (f", {flagged} of these flagged" if flagged else ""),
    }
    return {label: text for label, text in texts.items() if text}


def _doubts(trips: Sequence[TripResult]) -> str:
    """Return a sentence on flagged trips; empty if there is none."""
    done, flagged = sum(r.status == OK for r in trips), sum(bool(r.flags) for r in trips)
    if not flagged:
        return ""
    reasons = Counter(r.flags for r in trips if r.flags)
    most, n = reasons.most_common(1)[0]
    why = most if len(reasons) == 1 else f"{n} of them: {most}"
    if flagged == done > 1:
        return f"All {done} trips are flagged, and none of these numbers is to be relied on: {why}."
    are = "is" if flagged == 1 else "are"
    return f"{flagged} of {count(done, 'trip')} {are} flagged, see the table; {why}."


def _ordered(figures: Mapping[str, Figure]) -> list[str]:
    """Return the names of figures, those with a caption first."""
    known = [name for name in CAPTIONS if name in figures]
    return known + [name for name in figures if name not in CAPTIONS]


def _embedded(name: str, figure: Figure, shown: Mapping[str, str]) -> dict[str, Any]:
    """Return a figure's heading, explanation with what is `shown`, and image, as a data URI."""
    heading, explanation = name.replace("_", " ").capitalize(), ""
    if name in CAPTIONS:
        heading, explanation = CAPTIONS[name][0], CAPTIONS[name][1].format(**shown)
    return {
        "name": name,
        "heading": heading,
        "explanation": explanation,
        "image": data_uri(figure),
    }


def _healthy(trips: Sequence[TripResult]) -> dict[str, str]:
    """Return what 100 % of each parameter is on the last trip that has an estimate."""
    known = [r for r in trips if r.healthy_si]
    if not known:
        return {}
    found = {}
    for name, value in known[-1].healthy_si.items():
        half = 100 * known[-1].healthy_half_widths.get(name, 0.0)
        found[name] = with_unit(f"{value / KILO:.4g}", name)
        if half > 0:
            found[name] += f" ±\N{NO-BREAK SPACE}{half:.2g}\N{NO-BREAK SPACE}%"
    return found
