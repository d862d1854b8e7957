"""Output files of a fleet: tables, figures, metrics and the report."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.figure import Figure
from tabulate import tabulate

from suspnet.ground.findings import Finding, parts_of, together
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, PARAMETERS, Cause, Severity
from suspnet.ground.records import OK, TripResult
from suspnet.ground.storage import write_atomically, write_json, write_table
from suspnet.ground.wording import count, kilometres
from suspnet.runs.figures import as_png, data_uri
from suspnet.runs.language import gettext
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, newest_of
from suspnet.trains.maintenance.assessment import overall
from suspnet.trains.maintenance.life import Life
from suspnet.trains.maintenance.plan import Plan, joined
from suspnet.trains.maintenance.series import relative_to_first_healthy
from suspnet.trains.pages import overview, trip_figures
from suspnet.trains.pages.bogie import bogies_shown
from suspnet.trains.pages.failing_sensors import LISTED, failing_sensors
from suspnet.trains.pages.report import Report, write_report
from suspnet.trains.pages.templates import write_page
from suspnet.trains.pages.trend import health_trend, small_trends, trend_of_trips

KNOWN_ERROR_PERCENT = "rms error %"
COVERAGE_PERCENT = "intervals hold %"


def summary(results: Sequence[TripResult], outputs: Sequence[str]) -> str:
    """Return a table of all trips, errors where the truth is known, and all reasons and flags."""
    of_parts = [name for name in outputs if name in BOGIE_PARTS]
    estimated = {name for result in results for name in result.estimates}
    columns = [name for name in outputs if name in estimated and name not in BOGIE_PARTS]
    rows: list[dict[str, Any]] = []
    for r in results:
        row = {"trip": r.trip, "1000 km": r.mileage_km / 1000}
        row |= {name: r.estimates.get(name) for name in columns}
        if of_parts:  # a table of its own has the estimates
            row["worn parts"] = ", ".join(map(_short, parts_of(r.worn)))
        state = "flagged" if r.flags else "" if r.status == OK else r.status
        rows.append(row | {"averages": r.quality.n_averages, "state": state})
    header = list(rows[0]) if rows else ["trip"]
    # errors and coverage below the estimates that they are of
    for label, values in (
        (KNOWN_ERROR_PERCENT, errors_percent(results, outputs)),
        (COVERAGE_PERCENT, coverage_percent(results, outputs)),
    ):
        if values:
            rows.append({"trip": label} | {name: values.get(name) for name in columns})
    texts = [i for i, name in enumerate(header) if name in ("trip", "worn parts", "state")]
    cells = [[row.get(name) for name in header] for row in rows]
    formats = ("", ".1f", *[".4g"] * 20)
    table = tabulate(cells, header, tablefmt="github", floatfmt=formats, disable_numparse=texts)
    n_done = sum(r.status == OK for r in results)
    n_flagged = sum(bool(r.flags) for r in results)
    have, are = "has" if n_done == 1 else "have", "is" if n_flagged == 1 else "are"
    trips = count(len(results), "trip")
    lines = [f"{n_done} of {trips} {have} an estimate, {n_flagged} {are} flagged", table]
    if of_parts:
        lines.append(f"\n{_part_table(results, of_parts)}")
    return "\n".join([*lines, *_reasons(results)])


def _short(worn: str) -> str:
    """Return a worn part in the few characters that a table has for it."""
    if not isinstance(worn, Finding):
        return worn  # of a kind that is not known any more
    names = worn.values["names"]
    name = names[0] if len(names) == 1 else f"one of {len(names)} parts"
    return f"{name} {worn.values['percent']:.0f} %"


def _part_table(results: Sequence[TripResult], parts: Sequence[str]) -> str:
    """Return a row for each part: first and newest trip [%], and errors where truth is known."""
    errors, coverage = errors_percent(results, parts), coverage_percent(results, parts)
    rows = []
    for name in parts:
        done = [r for r in results if name in r.estimates]
        low, high = (100 * end for end in done[-1].interval(name))
        ends = [100 * r.estimates[name] for r in (done[0], done[-1])]
        interval = Finding("span-of-ratios", low=low, high=high)
        rows.append([name, *ends, interval, errors.get(name), coverage.get(name)])
    header = ["part", "first %", "newest %", "interval %", KNOWN_ERROR_PERCENT, COVERAGE_PERCENT]
    shown = [i for i in range(len(header)) if any(row[i] is not None for row in rows)]
    cells, names = [[row[i] for i in shown] for row in rows], [header[i] for i in shown]
    return tabulate(cells, names, tablefmt="github", floatfmt=".4g", disable_numparse=[0, 3])


def _reasons(results: Sequence[TripResult]) -> list[str]:
    """Return a paragraph for each reason and flag with its trips, as Markdown.

    Trips without an estimate also say which faults their sensors have.
    """
    trips: dict[str, list[str]] = {}
    for result in results:
        faults = "" if result.status == OK else result.quality.faults
        if words := together((result.reason or result.flags, faults)):
            trips.setdefault(words, []).append(result.trip)
    return [f"\n{', '.join(names)}: {words}" for words, names in trips.items()]


def sensor_lines(results: Sequence[TripResult], alarms: Sequence[Alarm]) -> list[str]:
    """Return a line for a terminal on each sensor with an alarm, and on each failing one."""
    lines = [
        f"{alarm.words} (alarm since {kilometres(alarm.begin_km)})"
        for alarm in alarms
        if alarm.cause == Cause.SENSOR and alarm.is_open
    ]
    for words, names in failing_sensors(results).items():
        more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
        lines.append(f"sensor {words} (in {', '.join(names[:LISTED])}{more})")
    return [f"  {Severity.NOTICE!s:7s}  {line}" for line in lines]


def errors_percent(results: Sequence[TripResult], outputs: Sequence[str]) -> dict[str, float]:
    """Return the rms relative error of each output over trips with known truth, [%]."""
    errors = {}
    for name in outputs:
        both = [r for r in results if name in r.truth and name in r.estimates]
        ratios = np.array([r.estimates[name] / r.truth[name] for r in both])
        if both:
            with np.errstate(over="ignore"):  # a manifest may contain any truth
                errors[name] = 100 * float(np.sqrt(np.mean((ratios - 1) ** 2)))
    return errors


def coverage_percent(results: Sequence[TripResult], outputs: Sequence[str]) -> dict[str, float]:
    """Return how often the intervals hold the truth, over trips with known truth, [%].

    Outputs without a trip that has both truth and interval are left out.
    """
    coverage = {}
    for name in outputs:
        ends = [(*r.interval(name), r.truth[name]) for r in results if name in r.truth]
        is_covered = [
            low <= truth <= high for low, high, truth in ends if np.isfinite([low, high]).all()
        ]
        if is_covered:
            coverage[name] = 100 * float(np.mean(is_covered))
    return coverage


def write_tables(results: Sequence[TripResult], outputs: tuple[str, ...], output: Path) -> None:
    """Write trips.parquet and trips.csv, a row a trip, and responses.parquet, a row a bin."""
    rows = pa.Table.from_pylist([result.row(outputs) for result in results])
    write_table(rows, output / "trips")
    tables = []
    for result in results:
        if (curves := result.curves) is None:
            continue
        names = [result.trip] * len(curves.frequencies_hz)
        columns: dict[str, Any] = {"trip": names, "frequency_hz": curves.frequencies_hz}
        for i, link in enumerate(("p", "s")):
            columns[f"magnitude_{link}"] = np.abs(curves.responses[i])
            columns[f"phase_rad_{link}"] = np.angle(curves.responses[i])
            columns[f"coherence_{link}"] = curves.coherences[i]
            columns[f"deviation_{link}"] = curves.deviations[i]
        tables.append(pa.table(columns))
    if tables:
        stream = io.BytesIO()
        pq.write_table(pa.concat_tables(tables), stream)
        write_atomically(output / "responses.parquet", stream.getvalue())


def write_pages(report: Report, output: Path, *, draw: bool = True) -> None:
    """Write figures if `draw`, metrics.json and report.html.

    The trend figure is relative to the first of several commissionings.
    """
    results, outputs = report.results, report.outputs
    done = [r for r in results if r.status == OK]
    # where parts are read, each has a figure of its own in place of the common trend
    figures, small = {}, {}
    if draw:
        relative = relative_to_first_healthy(results, report.commissionings)
        trend = trend_of_trips(relative, report.state, outputs, report.level, report.commissionings)
        small = small_trends(trend)
        has_parts = bool(set(outputs) & set(BOGIE_PARTS))
        figures = {} if has_parts else {"trend": health_trend(trend)}
        figures |= {
            "responses": trip_figures.response_figure([(r.mileage_km, r.curves) for r in results]),
            "signals": trip_figures.trip_signals(done[-1] if done else results[-1]),
        }
    named = {f"trend_{name}": figure for name, figure in small.items()}
    for name, figure in (figures | named).items():
        write_atomically(output / "figures" / f"{name}.png", as_png(figure))
    # NumPy's numbers become plain ones on the way through JSON
    metrics = json.loads(json.dumps(_metrics(report), default=float))
    write_json(output / "metrics.json", metrics)
    write_report(output / overview.REPORT, gettext("Suspension report"), report, figures, small)


def _metrics(report: Report) -> dict[str, Any]:
    results, state = report.results, report.state
    severity, sentence = overall(state.assessments)
    # the state that the report shows too, so that programs and people read the same verdict
    return {
        "severity": str(severity),
        "verdict": sentence,
        "n_trips": len(results),
        "n_estimated": sum(r.status == OK for r in results),
        "n_flagged": sum(bool(r.flags) for r in results),
        "rms_error_percent": errors_percent(results, report.outputs),
        "coverage_percent": coverage_percent(results, report.outputs),
        "limits": {
            name: state.limits[name].to_dict() for name in report.outputs if name in state.limits
        },
        "trends": [
            asdict(assessment.trend)
            | {
                "severity": str(assessment.severity),
                "words": assessment.words,
                "now": assessment.now,
                "life": _life_row(assessment.life),
                "unknown_life": assessment.unknown_life,
            }
            for assessment in state.assessments
        ],
        "commissionings": [asdict(commissioning) for commissioning in report.commissionings],
        "maintenance": [asdict(event) for event in state.series.events],
        "alarms": [_alarm_row(alarm, report.seen) for alarm in state.watched.alarms],
        "details": dict(report.details),
    }


def write_overview(done: Sequence[overview.Evaluated], output: Path) -> str:
    """Write overview.parquet, .csv and .html of a folder, and return the overview as text.

    `done` is in the order of the rows. Each suspension is a link to its report.
    """
    rows = [suspension.row() for suspension in done]
    entries = [
        (str(suspension.place), f"{suspension.name}/{overview.REPORT}", suspension.state)
        for suspension in done
        if suspension.state is not None
    ]
    linked = [
        row | ({"address": quote(row["report"])} if row["report"] else {})
        for row in _write_table_of(rows, output)
    ]
    shown = bogies_shown(entries)
    _write_fleet_page(linked, output, **shown, address=quote)
    return overview.overview_table(rows)


def write_fleet(view: overview.FleetView, plan: Plan, figure: Figure, output: Path) -> None:
    """Write the files of a fleet: overview.html, .csv and .parquet, plan.csv and .parquet.

    The page holds overview, plan with its calendar `figure`, and sister suspensions; it is
    self-contained.
    """
    rows = _write_table_of(view.rows, output)
    jobs: list[dict[str, Any]] = plan.rows()
    if jobs:
        write_table(pa.Table.from_pylist(jobs), output / "plan")
    write_atomically(output / "calendar.png", as_png(figure, 150))
    _write_fleet_page(
        rows,
        output,
        plan=plan,
        jobs=joined(jobs),
        calendar=data_uri(figure),
        **bogies_shown(view.entries, plan),
    )


def _write_table_of(rows: Sequence[Mapping[str, Any]], output: Path) -> list[dict[str, Any]]:
    """Write the overview as a table, and return its rows, each with the columns of all.

    A row has NaN in those that it lacks, as of parts not read.
    """
    names = dict.fromkeys(name for row in rows for name in row)
    whole = [{name: row.get(name, np.nan) for name in names} for row in rows]
    write_table(pa.Table.from_pylist(whole), output / "overview")
    return whole


def _write_fleet_page(rows: Sequence[Mapping[str, Any]], output: Path, **values: Any) -> None:
    values = {"plan": None, "address": None} | values
    parameters = [name for name in PARAMETERS if name != BODY_MASS]
    sentences = {"finding": overview.finding(rows), "most_severe": overview.most_severe(rows)}
    values |= {"rows": rows, "parameters": parameters}
    write_page(output / "overview.html", "fleet.html", **sentences, **values)


def _life_row(life: Life | None) -> dict[str, Any] | None:
    """Return a remaining life for JSON, which writes an infinite one as null."""
    if life is None:
        return None
    low, high = life.interval_km()
    ends = {"low_km": low, "high_km": high, "median_km": life.quantile_km(0.5)}
    return {"model": life.model, **ends}


def _alarm_row(alarm: Alarm, seen: Sequence[Acknowledgement]) -> dict[str, Any]:
    """Return an alarm for JSON, with the name of the person who acknowledged it last."""
    by = newest_of(alarm, seen)
    return asdict(alarm) | {"severity": str(alarm.severity), "seen_by": by.by if by else ""}
