"""One page that says how a suspension is, for people who maintain it."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from suspnet.data.storage import write_atomically
from suspnet.monitoring.records import OK, TripResult
from suspnet.monitoring.trend import PAYLOAD, Trend

NAMES = {
    "k_p": "stiffness of the primary spring",
    "c_p": "damping of the primary damper",
    "k_s": "stiffness of the secondary spring",
    "c_s": "damping of the secondary damper",
    "M_s": "mass of the car body",
}
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
        "line that leaves its level, not for single dots. Red ticks at the bottom are trips "
        "without an estimate.",
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
SVG_LIMIT = 400_000
"""Figures whose SVG has more bytes than this are embedded as PNG."""
PNG_DPI = 130
NO_NUMBER = "\N{EN DASH}"


def write_report(
    path: Path,
    title: str,
    results: Sequence[TripResult],
    outputs: Sequence[str],
    figures: Mapping[str, Figure],
    trends: Sequence[Trend],
    details: Mapping[str, str],
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
    trends : sequence of Trend
    details : mapping of str
        Model, settings, version, date.

    Returns
    -------
    Path
        The file, written atomically.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": _number, "thousands": _thousands, "symbol": _symbol}
    template = environment.from_string(
        resources.files("suspnet.monitoring").joinpath("report.html").read_text(encoding="utf-8")
    )
    trips = sorted(results, key=lambda r: (not math.isfinite(r.mileage_km), r.mileage_km, r.trip))
    tone, finding = _finding(trends)
    page = template.render(
        title=title,
        headline=_headline(trips),
        tone=tone,
        finding=finding,
        standing_out=[t for t in trends if t.stands_out],
        trends=trends,
        figures=[_embedded(name, figures[name]) for name in _ordered(figures)],
        trips=trips,
        outputs=outputs,
        names=NAMES,
        roles=ROLES,
        ok=OK,
        details=details,
    )
    return write_atomically(path, page.encode("utf-8", errors="replace"))


def _headline(trips: Sequence[TripResult]) -> dict[str, str]:
    """Return what the page is about: label and text."""
    mileage = [r.mileage_km for r in trips if math.isfinite(r.mileage_km)]
    span = "unknown"
    if mileage:
        span = " to ".join(dict.fromkeys(_thousands(km) for km in (min(mileage), max(mileage))))
        span += " km"
    starts = sorted(r.start for r in trips if r.start)
    dates = " to ".join(dict.fromkeys(s[:10] for s in (starts[0], starts[-1]))) if starts else ""
    done = sum(r.status == OK for r in trips)
    texts = {
        "Vehicle": ", ".join(dict.fromkeys(r.vehicle for r in trips if r.vehicle)),
        "Suspension": ", ".join(dict.fromkeys(r.suspension for r in trips if r.suspension)),
        "Mileage": span,
        "Dates": dates,
        "Trips": f"{len(trips)}, of which {done} with an estimate",
    }
    return {label: text for label, text in texts.items() if text}


def _finding(trends: Sequence[Trend]) -> tuple[str, str]:
    """Return the tone (note, good or plain) and a sentence on all parameters but the pay-load."""
    judged = [t for t in trends if t.parameter != PAYLOAD]
    n_tested = sum(math.isfinite(t.p_value) for t in judged)
    n_changed = sum(t.stands_out for t in judged)
    if n_changed:
        verb = "stands" if n_changed == 1 else "stand"
        return "note", f"{n_changed} of {len(judged)} parameters {verb} out:"
    if n_tested == 0:
        return "plain", "There are too few trips with an estimate to tell whether anything changed."
    if n_tested < len(judged):
        return "plain", "Nothing stands out, but some parameters have too few trips to tell."
    return "good", "Nothing stands out: no parameter changed by more than its trips scatter."


def _ordered(figures: Mapping[str, Figure]) -> list[str]:
    known = [name for name in CAPTIONS if name in figures]
    return known + [name for name in figures if name not in CAPTIONS]


def _embedded(name: str, figure: Figure) -> dict[str, Any]:
    """Return a figure's heading, explanation and image, as a data URI."""
    heading, explanation = CAPTIONS.get(name, (name.replace("_", " ").capitalize(), ""))
    stream = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "suspnet"}):  # the same figure gives the same bytes
        figure.savefig(stream, format="svg", metadata={"Date": None})
    kind = "svg+xml"
    if stream.tell() > SVG_LIMIT:
        kind, stream = "png", io.BytesIO()
        figure.savefig(stream, format="png", dpi=PNG_DPI)
    image = f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"
    return {"name": name, "heading": heading, "explanation": explanation, "image": image}


def _number(value: float | None, digits: int = 1, scale: float = 1.0) -> str:
    """Return a number with a true minus sign, or a dash if there is none."""
    if value is None or not math.isfinite(value):
        return NO_NUMBER
    text = f"{value * scale:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}" if float(text) else "")


def _thousands(value: float) -> str:
    """Return a whole number with no-break spaces between thousands, or a dash."""
    if not math.isfinite(value):
        return NO_NUMBER
    return f"{value:,.0f}".replace(",", "\N{NO-BREAK SPACE}")


def _symbol(name: str) -> Markup:
    """Return a parameter's symbol with its index."""
    letter, _, index = name.partition("_")
    return Markup("<i>{}</i><sub>{}</sub>").format(letter, index)
